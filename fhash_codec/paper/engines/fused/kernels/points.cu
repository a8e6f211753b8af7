// Values and slopes of a network at free places, all at one time.
//
// points.py puts SPARSE in front as well: whether the levels hold some vertices only. A block takes
// the tiles b, b + blocks, ... of COLUMNS places. The threads of a column share its levels. All
// columns are added up in the same order, so a place has the same bits whatever other places are
// evaluated with it.

constexpr int SHARES = THREADS / COLUMNS;
constexpr int STEP = SIZE % 4 == 0 ? 4 : SIZE % 2 == 0 ? 2 : 1;  // numbers that are read at a time

static_assert(THREADS % COLUMNS == 0, "the threads of a column are whole shares");

struct alignas(4 * STEP) Some {
    float at[STEP];
};

// The eight corners around a place, x first, and the weights of those after it.
struct Cell {
    long long corners[8];
    float after[3];
};

// The place of a vertex among those that a level holds: the rank of its bit.
__device__ inline long long place_of(const Level& level, long long bit) {
    if (!SPARSE) return bit;
    // The bit moves to the top of its word, and all that come after it fall out.
    const unsigned long long upto = level.words[bit >> 6] << (63 - (bit & 63));
    const long long rank = static_cast<long long>(level.blocks[bit >> 8]) +
                           level.within[bit >> 6] + __popcll(upto);
    return upto >> 63 ? rank - 1 : level.nothing;
}

// Finds the cell of a level around a place. The quotient of the position by the span is rounded and
// mended by the remainder, so that a place on a corner lies exactly in the cell that begins there.
__device__ inline Cell cell_at(const Level& level, const Places& places, const double (&at)[3]) {
    Cell cell;
    long long first = 0;
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const double span = places.span[a], last = level.scale[a] > 1. ? level.scale[a] - 1. : 0.;
        const double position = at[a] * level.scale[a];
        double before = floor(position * places.inverse[a]);
        double rest = position - before * span;
        if (rest < 0.) before -= 1., rest += span;
        if (rest >= span) before += 1., rest -= span;
        if (before > last) rest += (before - last) * span, before = last;
        if (!(before >= 0.)) rest += before * span, before = 0.;  // what is not a number, too
        cell.after[a] = static_cast<float>(rest * places.inverse[a]);
        first += static_cast<long long>(before) * level.strides[a];
    }
#pragma unroll
    for (int corner = 0; corner < 8; corner++)
        cell.corners[corner] = place_of(
            level, first + (corner & 1 ? level.strides[0] : 0) +
                       (corner & 2 ? level.strides[1] : 0) + (corner & 4 ? level.strides[2] : 0));
    return cell;
}

__device__ inline float between(float a, float b, float weight) { return a + weight * (b - a); }

// Interpolates a number of the corners along z, y and x in turn; `by` are its changes across the
// cell along x, y and z.
__device__ inline float interpolated(
    const float (&corners)[8], const float (&after)[3], float (&by)[3]) {
    float by_z[4], plane[4], by_y[2], line[2];
#pragma unroll
    for (int i = 0; i < 4; i++) {
        by_z[i] = corners[4 + i] - corners[i];
        plane[i] = corners[i] + after[2] * by_z[i];
    }
#pragma unroll
    for (int i = 0; i < 2; i++) {
        by_y[i] = plane[2 + i] - plane[i];
        line[i] = plane[i] + after[1] * by_y[i];
    }
    by[0] = line[1] - line[0];
    by[1] = between(by_y[0], by_y[1], after[0]);
    by[2] = between(
        between(by_z[0], by_z[2], after[1]), between(by_z[1], by_z[3], after[1]), after[0]);
    return line[0] + after[0] * by[0];
}

// Calls action(input, level, its value, its changes across the cell) for each input of this
// thread's share at the place of its column. Columns beyond the last place take that one.
template <class Action>
__device__ inline void each_input(
    const Level* levels, const Places& places, long long first, const Action& action) {
    const long long column = first + threadIdx.x % COLUMNS;
    const double* from = places.at + 3 * (column < places.count ? column : places.count - 1);
    const double at[3] = {from[0], from[1], from[2]};
    for (int number = threadIdx.x / COLUMNS; number < LEVELS; number += SHARES) {
        const Level& level = levels[number];
        const Cell cell = cell_at(level, places, at);
#pragma unroll 1
        for (int e = 0; e < SIZE; e += STEP) {
            Some some[8];
#pragma unroll
            for (int corner = 0; corner < 8; corner++)
                some[corner] = *reinterpret_cast<const Some*>(
                    level.table + cell.corners[corner] * SIZE + e);
#pragma unroll
            for (int i = 0; i < STEP; i++) {
                float corners[8], by[3];
#pragma unroll
                for (int corner = 0; corner < 8; corner++) corners[corner] = some[corner].at[i];
                const float value = interpolated(corners, cell.after, by);
                action(number * SIZE + e + i, level, value, by);
            }
        }
    }
}

// Shared memory of a block.
struct Tile {
    float* inputs;     // (INPUTS + 1, PITCH), the last row 1; later the slopes by them
    float* hidden[2];  // (WIDTH + 1, PITCH) each, the last row 1
    float* matrices;   // MATRICES
    float* parts;      // (GROUPS, COLUMNS) or (SHARES, 3, COLUMNS), within 4 THREADS
};

__device__ inline Tile tile_in(float* memory) {
    return {memory + AT_INPUTS, {memory + AT_HIDDEN_1, memory + AT_HIDDEN_2},
            memory + AT_MATRICES, memory + AT_PARTS};
}

// Loads the layers and the ones. A barrier must come before they are used.
__device__ inline void load_layers(const float* network, const Tile& tile) {
    load_matrices(network, tile.matrices);
    for (int i = threadIdx.x; i < PITCH; i += THREADS) {
        tile.inputs[INPUTS * PITCH + i] = 1.f;
        for (int layer = 0; layer < LAYERS; layer++) tile.hidden[layer][WIDTH * PITCH + i] = 1.f;
    }
}

// Runs the hidden layers at some places.
__device__ inline void run_hidden(
    const Level* levels, const Places& places, long long first, const Tile& tile) {
    each_input(levels, places, first, [&](int input, const Level&, float value, const float*) {
        tile.inputs[input * PITCH + threadIdx.x % COLUMNS] = value;
    });
    __syncthreads();
    if constexpr (LAYERS > 0) {
        forward<INPUTS>(tile.matrices, tile.inputs, tile.hidden[0]);
        __syncthreads();
    }
    if constexpr (LAYERS > 1) {
        forward<WIDTH>(tile.matrices + FIRST_LAYER, tile.hidden[0], tile.hidden[1]);
        __syncthreads();
    }
}

// Writes the slopes of the values by the inputs over the inputs, from the hidden layers. On a
// ReLU's kink the slope is that of its flat side.
__device__ inline void run_back(const Tile& tile) {
    float* const last = LAYERS == 0 ? tile.inputs : tile.hidden[LAYERS - 1];
    for (int i = threadIdx.x; i < (LAST_ROWS - 1) * COLUMNS; i += THREADS) {
        float* const at = last + i / COLUMNS * PITCH + i % COLUMNS;
        *at = LAYERS && !(*at > 0.f) ? 0.f : tile.matrices[LAST_LAYER_AT + i / COLUMNS];
    }
    __syncthreads();
    if constexpr (LAYERS > 1) {
        backward<WIDTH, true>(tile.matrices + FIRST_LAYER, tile.hidden[1], tile.hidden[0]);
        __syncthreads();
    }
    if constexpr (LAYERS > 0) {
        backward<INPUTS, false>(tile.matrices, tile.hidden[0], tile.inputs);
        __syncthreads();
    }
}

// Writes the normalised values (count,) at places.
extern "C" __global__ void __launch_bounds__(THREADS, 512 / THREADS) values_at(
    const Level* levels, const float* network, Places places, float* values) {
    FHASH_SHARED(memory);
    const Tile tile = tile_in(reinterpret_cast<float*>(memory));
    load_layers(network, tile);
    const long long step = static_cast<long long>(gridDim.x) * COLUMNS;
    for (long long first = blockIdx.x * COLUMNS; first < places.count; first += step) {
        run_hidden(levels, places, first, tile);
        const float* const last = LAYERS == 0 ? tile.inputs : tile.hidden[LAYERS - 1];
        last_forward(tile.matrices + LAST_LAYER_AT, last, tile.parts);
        __syncthreads();
        const int column = threadIdx.x;
        if (column < COLUMNS && first + column < places.count)
            values[first + column] = output_of(tile.parts, column);
    }
}

// Writes the derivatives (count, 3) of the normalised values by x, y and z, per vertex of the box.
extern "C" __global__ void __launch_bounds__(THREADS, 512 / THREADS) slopes_at(
    const Level* levels, const float* network, Places places, float* slopes) {
    FHASH_SHARED(memory);
    const Tile tile = tile_in(reinterpret_cast<float*>(memory));
    load_layers(network, tile);
    const long long step = static_cast<long long>(gridDim.x) * COLUMNS;
    for (long long first = blockIdx.x * COLUMNS; first < places.count; first += step) {
        run_hidden(levels, places, first, tile);
        run_back(tile);
        const int own = threadIdx.x % COLUMNS, share = threadIdx.x / COLUMNS;
        float sums[3] = {};
        const auto add_input = [&](int input, const Level& level, float, const float* by) {
            const float slope = tile.inputs[input * PITCH + own];
#pragma unroll
            for (int a = 0; a < 3; a++)
                sums[a] += slope * (static_cast<float>(level.scale[a] * places.inverse[a]) * by[a]);
        };
        each_input(levels, places, first, add_input);
        for (int a = 0; a < 3; a++) tile.parts[(share * 3 + a) * COLUMNS + own] = sums[a];
        __syncthreads();
        for (int i = threadIdx.x; i < 3 * COLUMNS; i += THREADS) {
            if (first + i / 3 >= places.count) continue;
            float sum = 0.f;
            for (int part = 0; part < SHARES; part++)
                sum += tile.parts[(part * 3 + i % 3) * COLUMNS + i / 3];
            slopes[3 * first + i] = sum;
        }
    }
}
