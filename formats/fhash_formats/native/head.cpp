// The trained neighbourhood head over a tile; transform/head.py states the arithmetic and computes the same bits in numpy.
//
// Features and activations are integers held in floats, and their weighted sums stay below 2^24: each sum is exact in any order, fused or not.
// Everything else is one rounded operation after the other, in the order written here.
#include <cstring>
#include <memory>
#include <new>

#include "core.hpp"

// The one place where contraction is let in again: the sums of `accumulate` are exact integers.
#if defined(__GNUC__) && !defined(__clang__)
#define EXACT_SUMS __attribute__((optimize("fp-contract=fast")))
#else
#define EXACT_SUMS
#endif

namespace {

constexpr std::int64_t BLOCK = 64;     // most voxels along x evaluated together
constexpr std::int64_t LANES = 16;     // a shorter block has a multiple of them
constexpr std::int64_t HALO = 2;       // the farthest neighbour along an axis
constexpr std::int64_t FEATURES = 28;  // 26 neighbours, two functions of the centre
constexpr std::int64_t MAX_WIDTH = 64;
constexpr std::int64_t MAX_LAYERS = 4;
constexpr float LIMIT = 4095.0F;
constexpr int ONE_BITS = 0x3f800000, SIGN_BIT = static_cast<int>(0x80000000U);

// Steps along (t, z, y, x) to the neighbours, in the order of the features.
constexpr int STEPS[FEATURES - 2][4] = {
    {-1, 0, 0, 0},  {1, 0, 0, 0},  {0, -1, 0, 0}, {0, 1, 0, 0},   {0, 0, -1, 0}, {0, 0, 1, 0}, {0, 0, 0, -1}, {0, 0, 0, 1},   {0, -2, 0, 0},
    {0, 2, 0, 0},   {0, 0, -2, 0}, {0, 0, 2, 0},  {0, 0, 0, -2},  {0, 0, 0, 2},  {0, 0, -1, -1}, {0, 0, -1, 1}, {0, 0, 1, -1},  {0, 0, 1, 1},
    {0, -1, 0, -1}, {0, -1, 0, 1}, {0, 1, 0, -1}, {0, 1, 0, 1},   {0, -1, -1, 0}, {0, -1, 1, 0}, {0, 1, -1, 0}, {0, 1, 1, 0},
};

struct Network {
    std::int64_t layers;
    const std::int64_t* widths;  // of the inputs, then of each layer: layers + 1
    const float* weights;        // (out, in) of each layer, one after the other; integers
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

// floor(512 log2(1 + |d|)), the logarithm linear between powers of two, with the sign of d.
FHASH_INLINE float compressed(float d) {
    const int sign = bits_of(d) & SIGN_BIT;
    const float magnitude = float_of(bits_of(d) ^ sign);
    int octaves = (bits_of(magnitude + 1.0F) - ONE_BITS) >> 14;
    octaves = octaves < 4095 ? octaves : 4095;
    return float_of(bits_of(static_cast<float>(octaves)) | sign);
}

FHASH_INLINE float position(float value, const Range& range) {
    const float place = (value - range.low) * range.unit + 0.5F;
    return static_cast<float>(static_cast<int>(place < 1024.0F ? place : 1024.0F) - 512);
}

FHASH_INLINE float clipped(float value, const Range& range) {
    const float raised = value > range.low ? value : range.low;  // NaN becomes low
    return raised < range.high ? raised : range.high;
}

FHASH_CLONES void neighbour_features(const float* FHASH_RESTRICT row, const float* FHASH_RESTRICT centre, float inverse, std::int64_t groups,
                                     float* FHASH_RESTRICT features) {
    for (std::int64_t i = 0; i < groups * LANES; ++i) features[i] = compressed((row[i] - centre[i]) * inverse);
}

FHASH_CLONES void centre_features(const float* FHASH_RESTRICT centre, const Range& bounds, std::int64_t groups, float* FHASH_RESTRICT features) {
    const Range range = bounds;
    for (std::int64_t i = 0; i < groups * LANES; ++i) {
        features[i] = position(centre[i], range);
        features[BLOCK + i] = compressed((centre[i] - range.low) * range.inverse);
    }
}

// sums[o] = sum over k of weights[o, k] * inputs[k], for the voxels of the groups.
template <int OUTPUTS>
FHASH_INLINE void accumulate_group(const float* FHASH_RESTRICT inputs, std::int64_t n, const float* FHASH_RESTRICT weights,
                                   std::int64_t groups, float* FHASH_RESTRICT sums) {
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
            for (int o = 0; o < OUTPUTS; ++o) sums[o * BLOCK + i] = sums[o * BLOCK + i] + w[o][0] * a + w[o][1] * b + w[o][2] * c + w[o][3] * d;
        }
    }
    for (; k < n; ++k)
        for (int o = 0; o < OUTPUTS; ++o)
            for (std::int64_t i = 0; i < count; ++i) sums[o * BLOCK + i] += weights[o * n + k] * inputs[k * BLOCK + i];
}

FHASH_CLONES EXACT_SUMS void accumulate(const float* inputs, std::int64_t n, const float* weights, std::int64_t outputs, std::int64_t groups,
                                        float* sums) {
    std::int64_t o = 0;
    for (; o + 2 <= outputs; o += 2) accumulate_group<2>(inputs, n, weights + o * n, groups, sums + o * BLOCK);
    for (; o < outputs; ++o) accumulate_group<1>(inputs, n, weights + o * n, groups, sums + o * BLOCK);
}

FHASH_CLONES void activate(float* FHASH_RESTRICT values, float scale, float bias, std::int64_t groups) {
    constexpr float ROUNDING = 12582912.0F;  // 1.5 * 2^23: adding and taking it away rounds half to even
    for (std::int64_t i = 0; i < groups * LANES; ++i) {
        const float p = values[i] * scale + bias;
        const float leaky = p > 0.0F ? p : 0.125F * p;
        const float above = leaky > -LIMIT ? leaky : -LIMIT;
        const float within = above < LIMIT ? above : LIMIT;
        values[i] = (within + ROUNDING) - ROUNDING;
    }
}

// Leaves the correction of the voxels at the returned place, one of the two buffers.
float* evaluate(const Network& network, std::int64_t groups, float* inputs, float* outputs) {
    const float* weights = network.weights;
    const float* biases = network.biases;
    for (std::int64_t layer = 0; layer < network.layers; ++layer) {
        const std::int64_t n = network.widths[layer], width = network.widths[layer + 1];
        accumulate(inputs, n, weights, width, groups, outputs);
        if (layer + 1 < network.layers)
            for (std::int64_t o = 0; o < width; ++o) activate(outputs + o * BLOCK, network.scales[layer], biases[o], groups);
        else
            for (std::int64_t i = 0; i < groups * LANES; ++i) outputs[i] = outputs[i] * network.scales[layer] + biases[0];
        weights += n * width;
        biases += width;
        float* const swapped = inputs;
        inputs = outputs;
        outputs = swapped;
    }
    return inputs;
}

struct Extremes {
    float low, high;
};

// One frame, clipped, each row with its edge values repeated to whole blocks and a halo; and the extremes of each block with its halo.
FHASH_CLONES void load_rows(const float* FHASH_RESTRICT source, std::int64_t rows, std::int64_t x, std::int64_t pitch, const Range& bounds,
                            float* FHASH_RESTRICT frame, Extremes* FHASH_RESTRICT extremes) {
    const Range range = bounds;
    const std::int64_t blocks = (pitch - 2 * HALO) / BLOCK;
    for (std::int64_t r = 0; r < rows; ++r) {
        const float* const in = source + r * x;
        float* const row = frame + r * pitch;
        for (std::int64_t i = 0; i < x; ++i) row[HALO + i] = clipped(in[i], range);
        for (std::int64_t i = 0; i < HALO; ++i) row[i] = row[HALO];
        for (std::int64_t i = HALO + x; i < pitch; ++i) row[i] = row[HALO + x - 1];
        for (std::int64_t b = 0; b < blocks; ++b) {
            const float* const start = row + b * BLOCK;
            float low = start[0], high = start[0];
            for (std::int64_t i = 1; i < BLOCK + 2 * HALO; ++i) {
                low = start[i] < low ? start[i] : low;
                high = start[i] > high ? start[i] : high;
            }
            extremes[r * blocks + b] = {low, high};
        }
    }
}

FHASH_INLINE std::int64_t clamped(std::int64_t index, std::int64_t size) { return index < 0 ? 0 : index < size ? index : size - 1; }

// Remembers the last correction of a neighbourhood without differences: it depends on the two centre features alone.
struct Flat {
    bool known;
    float position, distance, correction;
};

}  // namespace

// decoded and out: (t, z, y, x), every length at least 1, may not overlap. Returns 0, -1 for arguments out of range, -2 for no memory.
FHASH_EXPORT std::int64_t fhash_head_apply(const float* decoded, std::int64_t t, std::int64_t z, std::int64_t y, std::int64_t x,
                                           std::int64_t layers, const std::int64_t* widths, const float* weights, const float* biases,
                                           const float* scales, float low, float high, float inverse, float unit, float* out) {
    if (t < 1 || z < 1 || y < 1 || x < 1 || layers < 1 || layers > MAX_LAYERS || widths[0] != FEATURES || widths[layers] != 1) return -1;
    for (std::int64_t layer = 1; layer <= layers; ++layer)
        if (widths[layer] < 1 || widths[layer] > MAX_WIDTH) return -1;
    const Network network{layers, widths, weights, biases, scales};
    const Range range{low, high, inverse, unit};
    const std::int64_t rows = z * y, blocks = (x + BLOCK - 1) / BLOCK, pitch = blocks * BLOCK + 2 * HALO;
    const std::int64_t held = t < 3 ? t : 3;  // frames t - 1, t and t + 1
    std::unique_ptr<float[]> frames(new (std::nothrow) float[held * rows * pitch]);
    std::unique_ptr<Extremes[]> extremes(new (std::nothrow) Extremes[held * rows * blocks]);
    if (!frames || !extremes) return -2;
    const auto load = [&](std::int64_t step) {
        const std::int64_t slot = step % held;
        load_rows(decoded + step * rows * x, rows, x, pitch, range, frames.get() + slot * rows * pitch, extremes.get() + slot * rows * blocks);
    };
    alignas(64) float first[MAX_WIDTH * BLOCK], second[MAX_WIDTH * BLOCK];
    Flat flat{false, 0.0F, 0.0F, 0.0F};
    load(0);
    for (std::int64_t step = 0; step < t; ++step) {
        if (step + 1 < t) load(step + 1);
        for (std::int64_t zi = 0; zi < z; ++zi)
            for (std::int64_t yi = 0; yi < y; ++yi) {
                std::int64_t row_of[FEATURES - 2];
                for (int k = 0; k < FEATURES - 2; ++k) {
                    const int* const s = STEPS[k];
                    row_of[k] = clamped(step + s[0], t) % held * rows + clamped(zi + s[1], z) * y + clamped(yi + s[2], y);
                }
                const std::int64_t own = step % held * rows + zi * y + yi;
                for (std::int64_t b = 0; b < blocks; ++b) {
                    const float* const centre = frames.get() + own * pitch + b * BLOCK + HALO;
                    float* const target = out + ((step * z + zi) * y + yi) * x + b * BLOCK;
                    const std::int64_t n = x - b * BLOCK < BLOCK ? x - b * BLOCK : BLOCK;
                    const std::int64_t groups = (n + LANES - 1) / LANES;
                    Extremes all = extremes[own * blocks + b];
                    for (int k = 0; k < FEATURES - 2; ++k) {
                        const Extremes e = extremes[row_of[k] * blocks + b];
                        all.low = e.low < all.low ? e.low : all.low;
                        all.high = e.high > all.high ? e.high : all.high;
                    }
                    // Every operation is monotone: where the whole block's range has feature 0, so has each difference in it.
                    const float place = position(all.low, range), distance = compressed((all.low - low) * inverse);
                    const bool level = compressed((all.high - all.low) * inverse) == 0.0F && position(all.high, range) == place &&
                                       compressed((all.high - low) * inverse) == distance;
                    if (level && flat.known && flat.position == place && flat.distance == distance) {
                        for (std::int64_t i = 0; i < n; ++i) target[i] = clipped(centre[i] + flat.correction, range);
                        continue;
                    }
                    for (int k = 0; k < FEATURES - 2; ++k)
                        neighbour_features(frames.get() + row_of[k] * pitch + b * BLOCK + HALO + STEPS[k][3], centre, inverse, groups,
                                           first + k * BLOCK);
                    centre_features(centre, range, groups, first + (FEATURES - 2) * BLOCK);
                    const float* const correction = evaluate(network, groups, first, second);
                    if (level) flat = {true, place, distance, correction[0]};
                    for (std::int64_t i = 0; i < n; ++i) target[i] = clipped(centre[i] + correction[i], range);
                }
            }
    }
    return 0;
}
