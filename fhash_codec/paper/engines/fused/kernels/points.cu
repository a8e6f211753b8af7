// Values and slopes of a network at free places, all at one time.
//
// A block takes the tiles b, b + blocks, ... of COLUMNS places. The threads of a column share its levels. All
// columns are added up in the same order, so a place has the same bits whatever other places are
// evaluated with it.

constexpr int SHARES = THREADS / COLUMNS;
static_assert(THREADS % COLUMNS == 0, "the threads of a column are whole shares");

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
