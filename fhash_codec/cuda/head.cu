// Training of the MLP behind the table: the updates of native/train_head.cpp, bit by bit.
//
// An update is two launches: head_slopes adds up the slopes of a batch, and head_step moves the
// parameters along them. Nothing waits for the host in between.
//
// Sums over voxels, inputs and outputs are of integers, so their order changes no bit. The native
// code has them in float64, which is exact up to 2^53. A slope is at most 2^24, an integer of a
// weight 2^22, an input 2^15 and an activation 2^12. Hence a sum over at most 64 outputs is at most
// 2^52, and one over the 4096 voxels of a batch 2^51. All other operations are rounded one by one
// in the order of the native code: compile with --fmad=false.

#ifndef FHASH_SHARED
#define FHASH_SHARED(name) extern __shared__ float4 name[]
#endif

typedef unsigned long long Sum;  // of signed numbers, modulo 2^64, as atomicAdd has it

// train_head.hpp and train_head.cpp have the same numbers.
constexpr int BLOCK = 64;  // voxels that lie together
constexpr int INPUTS = 28;
constexpr double INPUT_UNIT = 512, ACTIVATION_UNIT = 128, ERROR_UNIT = 16384, WEIGHT_UNIT = 65536;
constexpr double MAX_ACTIVATION = 4095, MAX_ERROR = 16777216;
constexpr double MAX_WEIGHT = 31, MAX_BIAS = 127;  // integers in the file
constexpr double MIN_SCALE = 1e-6;
constexpr double ROUNDING = 6755399441055744.0;
constexpr double BETA1 = 0.9, BETA2 = 0.999, EPSILON = 1e-8;
constexpr double MAX_NORM = 1, MAX_PARAMETER = 64;

// head_device.py has the same numbers.
constexpr int THREADS = 256;
constexpr int VOXELS = 32;          // of a block of threads
constexpr int PITCH = VOXELS + 1;   // of rows, so that a column lies in different banks
constexpr int GROUPS = 6;           // weights and biases of each layer, in turn
constexpr double SURELY_SHORT = 1 - 1e-9;  // roundings of a sum in another order are below 1e-11

struct alignas(16) Quad {
    int of[4];
};

__device__ inline double rounded(double value) { return (value + ROUNDING) - ROUNDING; }

__device__ inline double limited(double value, double most) {
    const double raised = value > -most ? value : -most;
    return raised < most ? raised : most;
}

// The float16 number nearest to a positive number below 65504, ties to even.
__device__ inline double nearest_half(double value) {
    int exponent;
    frexp(value, &exponent);
    const double quantum = ldexp(1.0, exponent < -13 ? -24 : exponent - 11);
    return rounded(value / quantum) * quantum;
}

// The first parameter of a group, or their number for GROUPS.
__device__ inline int start_of(int group, int first, int second) {
    int at = 0;
    if (group > 0) at += INPUTS * first;
    if (group > 1) at += first;
    if (group > 2) at += first * second;
    if (group > 3) at += second;
    if (group > 4) at += second;
    if (group > 5) at += 1;
    return at;
}

__device__ inline int quads(int outputs) { return (outputs + 3) / 4; }

// Shared memory of head_slopes. Rows are of the voxels, and a last one of 1, for the biases.
struct Tile {
    Quad *one, *two;               // integers of weights [input][output]
    Quad* back;                    // those of `two` [output][input]
    int* three;                    // those of the last layer
    double *biases, *scales, *largest;
    int *inputs, *first, *second;  // inputs and activations
    int *slopes_1, *slopes_2, *slopes_3;

    __device__ Tile(float4* memory, int width_1, int width_2) {
        one = (Quad*)memory;
        two = one + INPUTS * quads(width_1);
        back = two + width_1 * quads(width_2);
        biases = (double*)(back + width_2 * quads(width_1));
        scales = biases + width_1 + width_2 + 1;
        largest = scales + GROUPS;
        three = (int*)(largest + GROUPS * 32);
        inputs = three + width_2;
        first = inputs + (INPUTS + 1) * PITCH;
        second = first + (width_1 + 1) * PITCH;
        slopes_1 = second + (width_2 + 1) * PITCH;
        slopes_2 = slopes_1 + width_1 * PITCH;
        slopes_3 = slopes_2 + width_2 * PITCH;
    }
};

// The units of all groups, into tile.scales.
__device__ inline void find_scales(
    const Tile& tile, const double* parameters, int first, int second, bool as_in_file) {
    const int t = threadIdx.x, lane = t % 32;
    if (as_in_file)
        for (int group = t / 32; group < GROUPS; group += THREADS / 32) {
            const int end = start_of(group + 1, first, second);
            double largest = 0;
            for (int i = start_of(group, first, second) + lane; i < end; i += 32) {
                const double magnitude = fabs(parameters[i]);
                largest = magnitude > largest ? magnitude : largest;
            }
            tile.largest[group * 32 + lane] = largest;
        }
    __syncthreads();
    if (t < GROUPS) {
        double largest = 0;
        for (int i = 0; as_in_file && i < 32; i++) {
            const double other = tile.largest[t * 32 + i];
            largest = other > largest ? other : largest;
        }
        const double scale = largest / (t % 2 ? MAX_BIAS : MAX_WEIGHT);
        tile.scales[t] =
            as_in_file ? nearest_half(scale > MIN_SCALE ? scale : MIN_SCALE) : 1 / WEIGHT_UNIT;
    }
    __syncthreads();
}

// Integers of weights in rows of whole quads, 0 beyond the columns.
__device__ inline void fill_weights(
    int* to, int rows, int columns, int pitch, const double* weights, int row_step,
    int column_step, double scale, bool as_in_file) {
    for (int i = threadIdx.x; i < rows * pitch; i += THREADS) {
        const int row = i / pitch, column = i % pitch;
        double integer = 0;
        if (column < columns) {
            const double weight = weights[row * row_step + column * column_step];
            integer = as_in_file ? limited(rounded(weight / scale), MAX_WEIGHT)
                                 : limited(rounded(weight * WEIGHT_UNIT),
                                           WEIGHT_UNIT * MAX_PARAMETER);
        }
        to[i] = (int)integer;
    }
}

__device__ inline void fill_biases(
    double* to, int count, const double* biases, double unit, bool as_in_file) {
    for (int i = threadIdx.x; i < count; i += THREADS)
        to[i] = as_in_file ? limited(rounded(biases[i] / unit), MAX_BIAS) * unit : biases[i];
}

// done(output, voxel, sum over the inputs of weight times input), for all outputs and voxels.
template <class Done>
__device__ inline void products(
    const int* inputs, int count, const Quad* weights, int outputs, Done done) {
    const int pitch = quads(outputs);
    for (int i = threadIdx.x; i < VOXELS * pitch; i += THREADS) {
        const int voxel = i % VOXELS, quad = i / VOXELS;
        long long sums[4] = {};
#pragma unroll 4
        for (int k = 0; k < count; k++) {
            const Quad weight = weights[k * pitch + quad];
            const long long input = inputs[k * PITCH + voxel];
            for (int j = 0; j < 4; j++) sums[j] += weight.of[j] * input;
        }
        for (int j = 0; j < 4; j++)
            if (4 * quad + j < outputs) done(4 * quad + j, voxel, sums[j]);
    }
}

// Add the sums over voxels of slope times input to those of a layer's weights and biases.
__device__ inline void gather(
    const int* slopes, int outputs, const int* inputs, int count, Sum* weights) {
    Sum* const biases = weights + outputs * count;
    for (int i = threadIdx.x; i < (count + 1) * quads(outputs); i += THREADS) {
        const int k = i % (count + 1), o = i / (count + 1) * 4;
        const int* const input = inputs + k * PITCH;
        const int* slope[4];
        for (int j = 0; j < 4; j++)
            slope[j] = slopes + (o + j < outputs ? o + j : outputs - 1) * PITCH;
        long long sums[4] = {};
#pragma unroll 4
        for (int v = 0; v < VOXELS; v++)
            for (int j = 0; j < 4; j++) sums[j] += (long long)slope[j][v] * input[v];
        for (int j = 0; j < 4; j++)
            if (o + j < outputs)
                atomicAdd(k < count ? weights + (o + j) * count + k : biases + o + j,
                          (Sum)sums[j]);
    }
}

// Sums to activations: leaky, clipped, rounded half to even.
__device__ inline int activated(long long sum, double scale, double bias) {
    const double value = (double)sum * scale + bias * ACTIVATION_UNIT;
    const double less = 0.125 * value;
    return (int)rounded(limited(less > value ? less : value, MAX_ACTIVATION));
}

// Slopes of sums from those of activations.
__device__ inline int descended(long long slope, double scale, int activation) {
    const double leaky = activation > 0 ? 1.0 : 0.125;
    return (int)rounded(limited((double)slope * scale * leaky, MAX_ERROR));
}

// Adds the slopes of VOXELS voxels of a batch to `sums`, one for each parameter.
//
// inputs (batches, blocks, INPUTS, BLOCK); targets, lowest, highest and weights (batches, blocks,
// BLOCK): `Batches` in compact/head_training.py.
// parameters: weights (out, in) and biases (out) of each layer in turn.
// sums: two arrays, used by turns; that of this update is 0 before.
extern "C" __global__ void __launch_bounds__(THREADS) head_slopes(
    const short* inputs, const int* targets, const int* lowest, const int* highest,
    const float* weights, const double* parameters, Sum* sums, int batches, int first, int second,
    int as_in_file, int update) {
    FHASH_SHARED(memory);
    const Tile tile(memory, first, second);
    const int t = threadIdx.x, number = start_of(GROUPS, first, second);
    const int starts[3] = {0, start_of(2, first, second), start_of(4, first, second)};
    const int halves = BLOCK / VOXELS;
    const int block = update % batches * (gridDim.x / halves) + blockIdx.x / halves;
    const int half = blockIdx.x % halves * VOXELS;
    sums += update % 2 * number;

    find_scales(tile, parameters, first, second, as_in_file);
    const double* const scales = tile.scales;
    fill_weights((int*)tile.one, INPUTS, first, 4 * quads(first), parameters, 1, INPUTS,
                 scales[0], as_in_file);
    fill_weights((int*)tile.two, first, second, 4 * quads(second), parameters + starts[1], 1,
                 first, scales[2], as_in_file);
    fill_weights((int*)tile.back, second, first, 4 * quads(first), parameters + starts[1], first,
                 1, scales[2], as_in_file);
    fill_weights(tile.three, 1, second, second, parameters + starts[2], 0, 1, scales[4],
                 as_in_file);
    fill_biases(tile.biases, first, parameters + starts[1] - first, scales[1], as_in_file);
    fill_biases(tile.biases + first, second, parameters + starts[2] - second, scales[3],
                as_in_file);
    fill_biases(tile.biases + first + second, 1, parameters + number - 1, scales[5], as_in_file);
    for (int i = t; i < INPUTS * VOXELS; i += THREADS) {
        const int k = i / VOXELS, v = i % VOXELS;
        tile.inputs[k * PITCH + v] = inputs[(block * INPUTS + k) * BLOCK + half + v];
    }
    for (int v = t; v < VOXELS; v += THREADS)
        tile.inputs[INPUTS * PITCH + v] = tile.first[first * PITCH + v] =
            tile.second[second * PITCH + v] = 1;
    __syncthreads();

    products(tile.inputs, INPUTS, tile.one, first, [&](int o, int v, long long sum) {
        const double scale = scales[0] * (ACTIVATION_UNIT / INPUT_UNIT);
        tile.first[o * PITCH + v] = activated(sum, scale, tile.biases[o]);
    });
    __syncthreads();
    products(tile.first, first, tile.two, second, [&](int o, int v, long long sum) {
        tile.second[o * PITCH + v] = activated(sum, scales[2], tile.biases[first + o]);
    });
    __syncthreads();

    // An output beyond the clip range is clipped, and its slope is 0.
    if (t < VOXELS) {
        const int at = block * BLOCK + half + t;
        const double low = lowest[at], high = highest[at];
        long long sum = 0;
        for (int k = 0; k < second; k++)
            sum += (long long)tile.three[k] * tile.second[k * PITCH + t];
        const double shift = tile.biases[first + second] * ERROR_UNIT;
        const double out =
            rounded((double)sum * (scales[4] * (ERROR_UNIT / ACTIVATION_UNIT)) + shift);
        const double raised = out > low ? out : low;
        const double clipped = raised < high ? raised : high;
        const double error = limited(clipped - (double)targets[at], MAX_ERROR);
        tile.slopes_3[t] = clipped == out ? (int)rounded(error * (double)weights[at]) : 0;
    }
    __syncthreads();

    for (int i = t; i < VOXELS * second; i += THREADS) {
        const int o = i / VOXELS, at = o * PITCH + i % VOXELS;
        tile.slopes_2[at] = descended((long long)tile.three[o] * tile.slopes_3[i % VOXELS],
                                      scales[4], tile.second[at]);
    }
    gather(tile.slopes_3, 1, tile.second, second, sums + starts[2]);
    __syncthreads();
    products(tile.slopes_2, second, tile.back, first, [&](int o, int v, long long sum) {
        tile.slopes_1[o * PITCH + v] = descended(sum, scales[2], tile.first[o * PITCH + v]);
    });
    gather(tile.slopes_2, second, tile.first, first, sums + starts[1]);
    __syncthreads();
    gather(tile.slopes_1, first, tile.inputs, INPUTS, sums);
}

// One step of Adam along the gradient of the mean squared error, shortened to MAX_NORM.
//
// Each block finds the length of the whole gradient, and moves some of the parameters.
//
// state: parameters and Adam's means of gradients and of their squares.
// sums: as head_slopes has added them up; the array of the next update becomes 0.
// per_voxel: 2 over the unit of errors and the number of voxels.
extern "C" __global__ void __launch_bounds__(THREADS) head_step(
    double* state, Sum* sums, int first, int second, int update, double per_voxel, double rate,
    double root) {
    FHASH_SHARED(memory);
    const int t = threadIdx.x, number = start_of(GROUPS, first, second);
    double* const squares = (double*)memory;     // of the gradient
    double* const partial = squares + number;    // sums of some of them
    Sum* const now = sums + update % 2 * number;
    Sum* const next = sums + (1 - update % 2) * number;
    const auto gradient = [&](int i) {
        double unit = per_voxel;
        if (i < start_of(1, first, second))
            unit = per_voxel / INPUT_UNIT;
        else if ((i >= start_of(2, first, second) && i < start_of(3, first, second)) ||
                 (i >= start_of(4, first, second) && i < start_of(5, first, second)))
            unit = per_voxel / ACTIVATION_UNIT;
        return (double)(long long)now[i] * unit;
    };

    double sum = 0;
    for (int i = t; i < number; i += THREADS) {
        const double slope = gradient(i);
        squares[i] = slope * slope;
        sum += squares[i];
    }
    partial[t] = sum;
    __syncthreads();
    for (int half = THREADS / 2; half > 0; half /= 2) {
        if (t < half) partial[t] += partial[t + half];
        __syncthreads();
    }
    // Only of a long gradient do the last bits count: its squares are added up one by one.
    if (t == 0) {
        double squared_norm = partial[0];
        if (squared_norm > SURELY_SHORT) {
            squared_norm = 0;
#pragma unroll 8
            for (int i = 0; i < number; i++) squared_norm += squares[i];
        }
        const double norm = sqrt(squared_norm);
        partial[0] = norm > MAX_NORM ? MAX_NORM / norm : 1;
    }
    __syncthreads();

    for (int i = blockIdx.x * THREADS + t; i < number; i += gridDim.x * THREADS) {
        const double slope = gradient(i) * partial[0];
        double *const mean = state + number + i, *const square = state + 2 * number + i;
        *mean = *mean + (slope - *mean) * (1 - BETA1);
        *square = *square + (slope * slope - *square) * (1 - BETA2);
        const double move = rate * *mean / (sqrt(*square) * root + EPSILON);
        state[i] = limited(state[i] - move, MAX_PARAMETER);
        next[i] = 0;
    }
}
