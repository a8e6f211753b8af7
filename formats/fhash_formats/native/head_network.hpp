// The network of the neighbourhood head, and its inputs from rows of voxels.
//
// Inputs and activations are integers held in floats, and their weighted sums stay below 2^24: each
// sum is exact in any order, fused or not. All other operations are rounded one by one, in the
// order written here.
#pragma once

#include <cstring>

#include "core.hpp"

// Contraction is allowed again for `accumulate` only, whose sums are exact integers.
#if defined(__GNUC__) && !defined(__clang__)
#define EXACT_SUMS __attribute__((optimize("fp-contract=fast")))
#else
#define EXACT_SUMS
#endif

namespace {

constexpr std::int64_t BLOCK = 64;   // most voxels along x that are evaluated together
constexpr std::int64_t LANES = 16;   // the voxels of a shorter block are a multiple of this
constexpr std::int64_t HALO = 2;     // the farthest neighbour along an axis
constexpr std::int64_t INPUTS = 28;  // 26 neighbours, two functions of the centre
constexpr std::int64_t NEIGHBOURS = INPUTS - 2;
constexpr std::int64_t MAX_WIDTH = 64;
constexpr std::int64_t MAX_LAYERS = 4;
constexpr std::int64_t CROSS = 9;             // a voxel, and the first 8 of the OFFSETS
constexpr std::int64_t MAX_CROSS_WIDTH = 14;  // first-layer outputs that a cross may take
constexpr float LIMIT = 4095.0F;              // largest magnitude of an input or activation
constexpr int ONE_BITS = 0x3f800000, SIGN_BIT = static_cast<int>(0x80000000U);

// Offsets along (t, z, y, x) to the neighbours, in the order of the inputs.
constexpr int OFFSETS[NEIGHBOURS][4] = {
    {-1, 0, 0, 0},   {1, 0, 0, 0},   {0, -1, 0, 0},  {0, 1, 0, 0},  {0, 0, -1, 0}, {0, 0, 1, 0},
    {0, 0, 0, -1},   {0, 0, 0, 1},   {0, -2, 0, 0},  {0, 2, 0, 0},  {0, 0, -2, 0}, {0, 0, 2, 0},
    {0, 0, 0, -2},   {0, 0, 0, 2},   {0, 0, -1, -1}, {0, 0, -1, 1}, {0, 0, 1, -1}, {0, 0, 1, 1},
    {0, -1, 0, -1},  {0, -1, 0, 1},  {0, 1, 0, -1},  {0, 1, 0, 1},  {0, -1, -1, 0}, {0, -1, 1, 0},
    {0, 1, -1, 0},   {0, 1, 1, 0},
};

struct Network {
    std::int64_t layers;
    const std::int64_t* widths;  // of the inputs, then of each layer: layers + 1 numbers
    const float* weights;        // (out, in) of each layer, one layer after the other; integers
    const float* biases;
    const float* scales;
};

struct Range {
    float low, high, inverse, unit;  // inverse = 1 / (2 sigma); unit = 1024 / (high - low)
};

FHASH_INLINE int bits_of(float value) {
    int bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

FHASH_INLINE float float_of(int bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// floor(512 log2(1 + |d|)) with the sign of d, at most 4095. The logarithm is linear between powers
// of two.
FHASH_INLINE float compressed(float d) {
    const int sign = bits_of(d) & SIGN_BIT;
    const float magnitude = float_of(bits_of(d) ^ sign);
    int octaves = (bits_of(magnitude + 1.0F) - ONE_BITS) >> 14;
    octaves = octaves < 4095 ? octaves : 4095;
    return float_of(bits_of(static_cast<float>(octaves)) | sign);
}

// The position of a clipped value in the range, an integer in [-512, 512].
FHASH_INLINE float position(float value, const Range& range) {
    const float place = (value - range.low) * range.unit + 0.5F;
    return static_cast<float>(static_cast<int>(place < 1024.0F ? place : 1024.0F) - 512);
}

FHASH_INLINE float clipped(float value, const Range& range) {
    const float raised = value > range.low ? value : range.low;  // NaN becomes low
    return raised < range.high ? raised : range.high;
}

FHASH_CLONES void neighbour_inputs(const float* FHASH_RESTRICT row,
                                   const float* FHASH_RESTRICT centre, float inverse,
                                   std::int64_t groups, float* FHASH_RESTRICT inputs) {
    for (std::int64_t i = 0; i < groups * LANES; ++i)
        inputs[i] = compressed((row[i] - centre[i]) * inverse);
}

FHASH_CLONES void centre_inputs(const float* FHASH_RESTRICT centre, const Range& bounds,
                                std::int64_t groups, float* FHASH_RESTRICT inputs) {
    const Range range = bounds;
    for (std::int64_t i = 0; i < groups * LANES; ++i) {
        inputs[i] = position(centre[i], range);
        inputs[BLOCK + i] = compressed((centre[i] - range.low) * range.inverse);
    }
}

// sums[o] = sum over k of weights[o, k] * inputs[k], for the voxels of the groups.
template <int OUTPUTS>
FHASH_INLINE void accumulate_group(const float* FHASH_RESTRICT inputs, std::int64_t n,
                                   const float* FHASH_RESTRICT weights, std::int64_t groups,
                                   float* FHASH_RESTRICT sums) {
    const std::int64_t count = groups * LANES;
    for (int o = 0; o < OUTPUTS; ++o)
        for (std::int64_t i = 0; i < count; ++i) sums[o * BLOCK + i] = 0.0F;
    std::int64_t k = 0;
    for (; k + 4 <= n; k += 4) {
        const float* FHASH_RESTRICT in = inputs + k * BLOCK;
        float w[OUTPUTS][4];
        for (int o = 0; o < OUTPUTS; ++o)
            for (int j = 0; j < 4; ++j) w[o][j] = weights[o * n + k + j];
        for (std::int64_t i = 0; i < count; ++i) {
            const float a = in[i], b = in[BLOCK + i], c = in[2 * BLOCK + i], d = in[3 * BLOCK + i];
            for (int o = 0; o < OUTPUTS; ++o)
                sums[o * BLOCK + i] = sums[o * BLOCK + i] + w[o][0] * a + w[o][1] * b +
                                      w[o][2] * c + w[o][3] * d;
        }
    }
    for (; k < n; ++k)
        for (int o = 0; o < OUTPUTS; ++o)
            for (std::int64_t i = 0; i < count; ++i)
                sums[o * BLOCK + i] += weights[o * n + k] * inputs[k * BLOCK + i];
}

FHASH_CLONES EXACT_SUMS void accumulate(const float* inputs, std::int64_t n, const float* weights,
                                        std::int64_t outputs, std::int64_t groups, float* sums) {
    std::int64_t o = 0;
    for (; o + 2 <= outputs; o += 2)
        accumulate_group<2>(inputs, n, weights + o * n, groups, sums + o * BLOCK);
    for (; o < outputs; ++o)
        accumulate_group<1>(inputs, n, weights + o * n, groups, sums + o * BLOCK);
}

// Sums to activations: leaky, clipped, rounded half to even.
FHASH_CLONES void activate(float* FHASH_RESTRICT values, float scale, float bias,
                           std::int64_t groups) {
    constexpr float ROUNDING = 12582912.0F;  // 1.5 * 2^23: adding and subtracting it rounds
    for (std::int64_t i = 0; i < groups * LANES; ++i) {
        const float p = values[i] * scale + bias;
        // Computed for all: a product under a condition is not vectorised without masks.
        const float less = 0.125F * p;
        const float leaky = less > p ? less : p;
        const float above = leaky > -LIMIT ? leaky : -LIMIT;
        const float within = above < LIMIT ? above : LIMIT;
        values[i] = (within + ROUNDING) - ROUNDING;
    }
}

// The correction of the voxels; it lies in one of the two buffers.
inline float* evaluate(const Network& network, std::int64_t groups, float* inputs,
                       float* outputs) {
    const float* weights = network.weights;
    const float* biases = network.biases;
    for (std::int64_t layer = 0; layer < network.layers; ++layer) {
        const std::int64_t n = network.widths[layer], width = network.widths[layer + 1];
        accumulate(inputs, n, weights, width, groups, outputs);
        if (layer + 1 < network.layers)
            for (std::int64_t o = 0; o < width; ++o)
                activate(outputs + o * BLOCK, network.scales[layer], biases[o], groups);
        else
            for (std::int64_t i = 0; i < groups * LANES; ++i)
                outputs[i] = outputs[i] * network.scales[layer] + biases[0];
        weights += n * width;
        biases += width;
        float* const swapped = inputs;
        inputs = outputs;
        outputs = swapped;
    }
    return inputs;
}

}  // namespace
