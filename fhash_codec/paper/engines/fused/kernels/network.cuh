// The layers on one tile: matrices in shared memory, a small tile of the result in each thread.
//
// The threads form GROUPS groups; a group covers all columns, four in each thread. A row of a
// matrix of activations has PITCH numbers, four more than columns: rows begin in different banks.

#ifndef FHASH_SHARED
#define FHASH_SHARED(name) extern __shared__ float4 name[]
#endif

constexpr int INPUTS = LEVELS * SIZE;
constexpr int COLUMN_GROUP = COLUMNS / 4;
constexpr int GROUPS = THREADS / COLUMN_GROUP;
constexpr int LAST_ROWS = (LAYERS ? WIDTH : INPUTS) + 1;  // inputs of the last layer and its bias
constexpr int LAST_STEPS = (LAST_ROWS + GROUPS - 1) / GROUPS;
constexpr int FIRST_LAYER = LAYERS > 0 ? (INPUTS + 1) * STRIDE : 0;
constexpr int SECOND_LAYER = LAYERS > 1 ? (WIDTH + 1) * STRIDE : 0;
constexpr int LAST_LAYER_AT = FIRST_LAYER + SECOND_LAYER;
constexpr int PARAMETERS = (LAYERS > 0 ? (INPUTS + 1) * WIDTH : 0) +
                           (LAYERS > 1 ? (WIDTH + 1) * WIDTH : 0) + LAST_ROWS;

static_assert(THREADS % COLUMN_GROUP == 0, "threads are whole groups");
static_assert(MATRICES == LAST_LAYER_AT + LAST_ROWS, "as source.py counts them");
static_assert(LAYERS <= 2, "two hidden layers at most");

// The largest number of rows, of 8, 4, 2 and 1, that leaves no group without work.
__device__ constexpr int rows_for(int rows) {
    return rows >= 8 * GROUPS ? 8 : rows >= 4 * GROUPS ? 4 : rows >= 2 * GROUPS ? 2 : 1;
}

// Where a number of the network's vector (out, in + 1 of each layer) lies in the matrices.
__device__ inline int place_in_matrices(int number) {
    if (LAYERS > 0) {
        if (number < (INPUTS + 1) * WIDTH)
            return number % (INPUTS + 1) * STRIDE + number / (INPUTS + 1);
        number -= (INPUTS + 1) * WIDTH;
    }
    if (LAYERS > 1) {
        if (number < (WIDTH + 1) * WIDTH)
            return FIRST_LAYER + number % (WIDTH + 1) * STRIDE + number / (WIDTH + 1);
        number -= (WIDTH + 1) * WIDTH;
    }
    return LAST_LAYER_AT + number;
}

// A barrier must come before the matrices are used.
__device__ inline void load_matrices(const float* network, float* matrices) {
    for (int i = threadIdx.x; i < MATRICES; i += THREADS) matrices[i] = 0.f;
    __syncthreads();
    for (int i = threadIdx.x; i < PARAMETERS; i += THREADS)
        matrices[place_in_matrices(i)] = network[i];
}

__device__ inline int thread_group() { return threadIdx.x / COLUMN_GROUP; }
__device__ inline int thread_column() { return threadIdx.x % COLUMN_GROUP * 4; }

__device__ inline const float4& four(const float* at) {
    return *reinterpret_cast<const float4*>(at);
}

__device__ inline float dot(const float4& a, const float4& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w;
}

__device__ inline void add(float (&sum)[4], float weight, const float4& values) {
    sum[0] += weight * values.x;
    sum[1] += weight * values.y;
    sum[2] += weight * values.z;
    sum[3] += weight * values.w;
}

template <int COUNT>
__device__ inline void load_weights(float (&weights)[COUNT], const float* at) {
    if constexpr (COUNT % 4 == 0) {
#pragma unroll
        for (int i = 0; i < COUNT; i += 4) {
            const float4 part = four(at + i);
            weights[i] = part.x;
            weights[i + 1] = part.y;
            weights[i + 2] = part.z;
            weights[i + 3] = part.w;
        }
    } else {
#pragma unroll
        for (int i = 0; i < COUNT; i++) weights[i] = at[i];
    }
}

// Writes a hidden layer: out = max(0, matrix^T in), WIDTH rows of INNER + 1 inputs with the ones.
// What is not a number stays.
template <int INNER>
__device__ inline void forward(const float* matrix, const float* in, float* out) {
    constexpr int ROWS = rows_for(WIDTH);
    const int column = thread_column();
    for (int first = thread_group() * ROWS; first < WIDTH; first += GROUPS * ROWS) {
        float sum[ROWS][4] = {};
#pragma unroll 4
        for (int k = 0; k <= INNER; k++) {
            const float4 values = four(in + k * PITCH + column);
            float weights[ROWS];
            load_weights<ROWS>(weights, matrix + k * STRIDE + first);
#pragma unroll
            for (int r = 0; r < ROWS; r++) add(sum[r], weights[r], values);
        }
#pragma unroll
        for (int r = 0; r < ROWS; r++) {
            if (first + r < WIDTH) {
                float* at = out + (first + r) * PITCH + column;
#pragma unroll
                for (int c = 0; c < 4; c++) at[c] = sum[r][c] < 0.f ? 0.f : sum[r][c];
            }
        }
    }
}

// Writes the gradient by the ROWS_OUT inputs of a hidden layer, matrix times `down`, over the
// inputs. HIDDEN inputs are a hidden layer, whose gradient is zero where the neuron is.
template <int ROWS_OUT, bool HIDDEN>
__device__ inline void backward(const float* matrix, const float* down, float* inputs) {
    constexpr int ROWS = rows_for(ROWS_OUT);
    constexpr int WHOLE = WIDTH / 4 * 4;
    const int column = thread_column();
    for (int first = thread_group() * ROWS; first < ROWS_OUT; first += GROUPS * ROWS) {
        float sum[ROWS][4] = {};
        const float* rows[ROWS];
#pragma unroll
        for (int r = 0; r < ROWS; r++)
            rows[r] = matrix + (first + r < ROWS_OUT ? first + r : ROWS_OUT) * STRIDE;
#pragma unroll(ROWS == 8 ? 1 : 2)
        for (int h = 0; h < WHOLE; h += 4) {
            float4 weights[ROWS];
#pragma unroll
            for (int r = 0; r < ROWS; r++) weights[r] = four(rows[r] + h);
            const float* at = down + h * PITCH + column;
            const float4 a = four(at), b = four(at + PITCH);
            const float4 c = four(at + 2 * PITCH), d = four(at + 3 * PITCH);
#pragma unroll
            for (int r = 0; r < ROWS; r++) {
                add(sum[r], weights[r].x, a);
                add(sum[r], weights[r].y, b);
                add(sum[r], weights[r].z, c);
                add(sum[r], weights[r].w, d);
            }
        }
        for (int h = WHOLE; h < WIDTH; h++) {
            const float4 values = four(down + h * PITCH + column);
#pragma unroll
            for (int r = 0; r < ROWS; r++) add(sum[r], rows[r][h], values);
        }
#pragma unroll
        for (int r = 0; r < ROWS; r++) {
            if (first + r < ROWS_OUT) {
                float* at = inputs + (first + r) * PITCH + column;
#pragma unroll
                for (int c = 0; c < 4; c++) at[c] = HIDDEN && !(at[c] > 0.f) ? 0.f : sum[r][c];
            }
        }
    }
}

// Adds the gradient by a hidden layer's matrix: `in` (ROWS_IN rows) times the transpose of `down`.
template <int ROWS_IN>
__device__ inline void add_matrix_gradient(const float* in, const float* down, float* sums) {
    constexpr int SIDE = ROWS_IN * WIDTH > 4 * THREADS ? 4 : 2;
    constexpr int TILES_IN = (ROWS_IN + SIDE - 1) / SIDE, TILES_OUT = (WIDTH + SIDE - 1) / SIDE;
    for (int tile = threadIdx.x; tile < TILES_IN * TILES_OUT; tile += THREADS) {
        // Rows of a thread lie far apart, those of neighbouring threads in neighbouring banks.
        const int in_row = tile / TILES_OUT, out_row = tile % TILES_OUT;
        const float* ins[SIDE];
        const float* outs[SIDE];
        float sum[SIDE][SIDE] = {};
#pragma unroll
        for (int i = 0; i < SIDE; i++) {
            const int k = in_row + i * TILES_IN, h = out_row + i * TILES_OUT;
            ins[i] = in + (k < ROWS_IN ? k : 0) * PITCH;
            outs[i] = down + (h < WIDTH ? h : 0) * PITCH;
        }
#pragma unroll(SIDE == 4 ? 1 : 2)
        for (int n = 0; n < COLUMNS; n += 4) {
            float4 a[SIDE];
#pragma unroll
            for (int i = 0; i < SIDE; i++) a[i] = four(ins[i] + n);
#pragma unroll
            for (int j = 0; j < SIDE; j++) {
                const float4 b = four(outs[j] + n);
#pragma unroll
                for (int i = 0; i < SIDE; i++) sum[i][j] += dot(a[i], b);
            }
        }
#pragma unroll
        for (int i = 0; i < SIDE; i++)
#pragma unroll
            for (int j = 0; j < SIDE; j++) {
                const int k = in_row + i * TILES_IN, h = out_row + j * TILES_OUT;
                if (k < ROWS_IN && h < WIDTH) sums[k * STRIDE + h] += sum[i][j];
            }
    }
}

// Writes each group's part of the last layer's output (GROUPS, COLUMNS).
__device__ inline void last_forward(const float* vector, const float* in, float* parts) {
    const int column = thread_column();
    float sum[4] = {};
    for (int k = thread_group(); k < LAST_ROWS; k += GROUPS)
        add(sum, vector[k], four(in + k * PITCH + column));
#pragma unroll
    for (int c = 0; c < 4; c++) parts[thread_group() * COLUMNS + column + c] = sum[c];
}

__device__ inline float output_of(const float* parts, int column) {
    float sum = 0.f;
    for (int group = 0; group < GROUPS; group++) sum += parts[group * COLUMNS + column];
    return sum;
}

// Adds this thread's part of the gradient by the last layer, and writes the gradient by that
// layer's inputs over them.
__device__ inline void last_backward(
    const float* vector, const float* residual, float* in, float (&sums)[LAST_STEPS]) {
    const int column = thread_column();
    const float4 down = four(residual + column);
#pragma unroll
    for (int step = 0; step < LAST_STEPS; step++) {
        const int k = thread_group() + step * GROUPS;
        if (k < LAST_ROWS) {
            float* at = in + k * PITCH + column;
            const float4 values = four(at);
            sums[step] += dot(values, down);
            if (k < LAST_ROWS - 1) {
                const float weight = vector[k];
                at[0] = LAYERS && !(values.x > 0.f) ? 0.f : weight * down.x;
                at[1] = LAYERS && !(values.y > 0.f) ? 0.f : weight * down.y;
                at[2] = LAYERS && !(values.z > 0.f) ? 0.f : weight * down.z;
                at[3] = LAYERS && !(values.w > 0.f) ? 0.f : weight * down.w;
            }
        }
    }
}

// Adds the parts of all threads to the sums of the last layer. `scratch` holds THREADS numbers.
__device__ inline void add_last_gradient(
    const float (&parts)[LAST_STEPS], float* sums, float* scratch) {
#pragma unroll
    for (int step = 0; step < LAST_STEPS; step++) {
        scratch[threadIdx.x] = parts[step];
        __syncthreads();
        const int k = threadIdx.x + step * GROUPS;
        if (threadIdx.x < GROUPS && k < LAST_ROWS) {
            float sum = 0.f;
            for (int i = 0; i < COLUMN_GROUP; i++) sum += scratch[threadIdx.x * COLUMN_GROUP + i];
            sums[k] += sum;
        }
        __syncthreads();
    }
}
