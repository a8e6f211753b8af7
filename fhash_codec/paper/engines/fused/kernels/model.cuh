// What all kernels share: the arrays of the engine, and sums over a block.
//
// source.py puts the sizes of one model in front of these files as constants: LEVELS, COARSE, SIZE,
// BRICK_Z, BRICK_Y, BRICK_X, WIDTH, LAYERS, THREADS, COLUMNS, PITCH, STRIDE, MATRICES (numbers of
// all matrices of the layers), and the places in shared memory, AT_*.
//
// A block of threads works on one brick, tile by tile. A tile is TILE_ROWS whole rows along x. Its
// vertices are columns of matrices in shared memory, COLUMNS at most, whose rows are inputs or
// hidden neurons. A matrix of a layer has a row for each input, the row of the bias last, and its
// outputs are padded to STRIDE numbers.

// 1, or 0 where the finest level is interpolated, too, and nothing is stored for the samples.
enum { FINE = LEVELS - COARSE };
constexpr int VERTICES = BRICK_Z * BRICK_Y * BRICK_X;
constexpr int BRICK_ROWS = BRICK_Z * BRICK_Y;
constexpr int TILE_ROWS = COLUMNS / BRICK_X;
constexpr int TILES = (BRICK_ROWS + TILE_ROWS - 1) / TILE_ROWS;
constexpr int MASK_BYTES = (VERTICES + 7) / 8;

// Adam's decays, 0.9 and 0.999. Computed in float32, 1 - 0.999f would be off by 1e-5.
constexpr float REST1 = 0.1f;
constexpr float BETA2 = 0.999f;
constexpr float REST2 = 0.001f;
constexpr float EPSILON = 1e-8f;
constexpr float LOG_BETA1 = -0.10536051565782628f;
constexpr float LOG_BETA2 = -0.0010005003335835335f;
constexpr int WINDOW = 200;  // steps without a gradient after which a parameter stands still

__device__ inline void adam(
    float& number, float gradient, float& mean, float& square, const Rate& rate) {
    mean += REST1 * (gradient - mean);
    square = BETA2 * square + REST2 * gradient * gradient;
    number -= rate.pace * mean / (sqrtf(square) * rate.root + EPSILON);
}

// The sum of a number of each thread, for all of them. `scratch` holds THREADS + 16 numbers; after
// the last of several sums, a barrier must come before another use of it.
__device__ inline float block_sum(float value, float* scratch) {
    scratch[threadIdx.x] = value;
    __syncthreads();
    if (threadIdx.x < 16) {
        float sum = 0.f;
        for (int i = threadIdx.x; i < THREADS; i += 16) sum += scratch[i];
        scratch[THREADS + threadIdx.x] = sum;
    }
    __syncthreads();
    float sum = 0.f;
    for (int i = 0; i < 16; i++) sum += scratch[THREADS + i];
    return sum;
}

// Effect of the steps since a brick's last one, whose gradient was zero: paper/engines/parameters.py.
struct CatchUp {
    float factor;
    float epsilon;
    float mean_decay;
    float square_decay;
};

__device__ inline CatchUp catch_up(
    const Model& model, long long visited, long long step, float* scratch) {
    CatchUp result = {0.f, EPSILON, 1.f, 1.f};
    if (visited <= 0 || step <= visited) return result;  // the same in all threads
    const long long gap = step - visited;
    const int terms = gap < WINDOW ? static_cast<int>(gap) : WINDOW;
    float factor = 0.f, inverse = 0.f;
    for (int i = threadIdx.x + 1; i <= terms; i += THREADS) {
        const long long j = visited + i < model.steps ? visited + i : model.steps - 1;
        factor += model.powers[2 * i] * model.weights[2 * j];
        inverse += model.powers[2 * i + 1] * model.weights[2 * j + 1];
    }
    result.factor = block_sum(factor, scratch);
    inverse = block_sum(inverse, scratch);
    if (inverse > 0.f) result.epsilon = EPSILON * result.factor / inverse;
    result.mean_decay = expf(static_cast<float>(gap) * LOG_BETA1);
    result.square_decay = expf(static_cast<float>(gap) * LOG_BETA2);
    return result;
}

__device__ inline float caught_up(
    const CatchUp& effect, float number, float mean, float square) {
    return number - effect.factor * mean / (sqrtf(square) + effect.epsilon);
}
