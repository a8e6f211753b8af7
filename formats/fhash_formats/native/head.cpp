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
constexpr std::int64_t CROSS = 9;             // a voxel, then the ones before and after it along t, z, y, x: the first steps below
constexpr std::int64_t MAX_CROSS_WIDTH = 14;  // first-layer outputs that a cross may take
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
        const float less = 0.125F * p;  // computed for all: a product under a condition is not vectorised without masks
        const float leaky = less > p ? less : p;
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

// Where a whole block with its neighbours has differences of feature 0, all its voxels have these two features of the centre.
struct Flat {
    bool level;
    float position, distance;

    bool same(const Flat& other) const { return level && other.level && position == other.position && distance == other.distance; }
};

// The clipped frames t - 1, t and t + 1 of a tile, with edges repeated, and the features of their voxels.
class Frames {
public:
    const std::int64_t t, z, y, x, rows, blocks, pitch, held;

    Frames(const float* source, std::int64_t t_, std::int64_t z_, std::int64_t y_, std::int64_t x_, const Range& bounds)
        : t(t_),
          z(z_),
          y(y_),
          x(x_),
          rows(z_ * y_),
          blocks((x_ + BLOCK - 1) / BLOCK),
          pitch(blocks * BLOCK + 2 * HALO),
          held(t_ < 3 ? t_ : 3),
          range(bounds),
          decoded(source),
          frames(new (std::nothrow) float[held * rows * pitch]),
          extremes(new (std::nothrow) Extremes[held * rows * blocks]) {}

    bool allocated() const { return frames && extremes; }

    void load(std::int64_t step) {
        const std::int64_t slot = step % held;
        load_rows(decoded + step * rows * x, rows, x, pitch, range, frames.get() + slot * rows * pitch, extremes.get() + slot * rows * blocks);
    }

    std::int64_t row(std::int64_t step, std::int64_t zi, std::int64_t yi) const { return step % held * rows + zi * y + yi; }

    // The rows of the first `count` neighbours.
    void neighbours(std::int64_t step, std::int64_t zi, std::int64_t yi, std::int64_t count, std::int64_t* row_of) const {
        for (std::int64_t k = 0; k < count; ++k)
            row_of[k] = row(clamped(step + STEPS[k][0], t), clamped(zi + STEPS[k][1], z), clamped(yi + STEPS[k][2], y));
    }

    const float* block(std::int64_t row_index, std::int64_t b) const { return frames.get() + row_index * pitch + b * BLOCK + HALO; }

    std::int64_t length(std::int64_t b) const { return x - b * BLOCK < BLOCK ? x - b * BLOCK : BLOCK; }

    // Every operation is monotone: where the whole block's range has feature 0, so has each difference in it.
    Flat flatness(std::int64_t own, const std::int64_t* row_of, std::int64_t b) const {
        Extremes all = extremes[own * blocks + b];
        for (int k = 0; k < FEATURES - 2; ++k) {
            const Extremes e = extremes[row_of[k] * blocks + b];
            all.low = e.low < all.low ? e.low : all.low;
            all.high = e.high > all.high ? e.high : all.high;
        }
        const float place = position(all.low, range), distance = compressed((all.low - range.low) * range.inverse);
        const bool level = compressed((all.high - all.low) * range.inverse) == 0.0F && position(all.high, range) == place &&
                           compressed((all.high - range.low) * range.inverse) == distance;
        return {level, place, distance};
    }

    // The inputs of the first layer.
    void gather(std::int64_t own, const std::int64_t* row_of, std::int64_t b, std::int64_t groups, float* inputs) const {
        const float* const centre = block(own, b);
        for (int k = 0; k < FEATURES - 2; ++k)
            neighbour_features(block(row_of[k], b) + STEPS[k][3], centre, range.inverse, groups, inputs + k * BLOCK);
        centre_features(centre, range, groups, inputs + (FEATURES - 2) * BLOCK);
    }

    const Range range;

private:
    const float* decoded;
    std::unique_ptr<float[]> frames;
    std::unique_ptr<Extremes[]> extremes;
};

FHASH_INLINE std::int64_t groups_of(std::int64_t n) { return (n + LANES - 1) / LANES; }

FHASH_CLONES void narrowed(const float* FHASH_RESTRICT in, std::int64_t groups, std::int16_t* FHASH_RESTRICT out) {
    for (std::int64_t i = 0; i < groups * LANES; ++i) out[i] = static_cast<std::int16_t>(in[i]);
}

FHASH_CLONES void widened(const std::int16_t* FHASH_RESTRICT in, std::int64_t groups, float* FHASH_RESTRICT out) {
    for (std::int64_t i = 0; i < groups * LANES; ++i) out[i] = static_cast<float>(in[i]);
}

// First-layer outputs of the frames t - 1, t and t + 1, row by row, the outputs of a row one after the other, its edges repeated once.
class Hidden {
public:
    Hidden(const Frames& source, const Network& layer)
        : frames(source),
          first(layer),
          width(layer.widths[1]),
          pitch(source.blocks * BLOCK + 2),
          values(new (std::nothrow) std::int16_t[source.held * source.rows * width * pitch]()),
          flats(new (std::nothrow) Flat[source.held * source.rows * source.blocks]) {}

    bool allocated() const { return values && flats; }

    void fill(std::int64_t step, float* inputs, float* outputs) {
        for (std::int64_t zi = 0; zi < frames.z; ++zi)
            for (std::int64_t yi = 0; yi < frames.y; ++yi) {
                std::int64_t row_of[FEATURES - 2];
                frames.neighbours(step, zi, yi, FEATURES - 2, row_of);
                const std::int64_t own = frames.row(step, zi, yi);
                std::int16_t* const row = values.get() + own * width * pitch;
                for (std::int64_t b = 0; b < frames.blocks; ++b) {
                    const std::int64_t groups = groups_of(frames.length(b));
                    const Flat flat = frames.flatness(own, row_of, b);
                    flats[own * frames.blocks + b] = flat;
                    if (flat.same(last)) {
                        for (std::int64_t o = 0; o < width; ++o)
                            for (std::int64_t i = 0; i < groups * LANES; ++i) row[o * pitch + 1 + b * BLOCK + i] = constant[o];
                        continue;
                    }
                    frames.gather(own, row_of, b, groups, inputs);
                    accumulate(inputs, FEATURES, first.weights, width, groups, outputs);
                    for (std::int64_t o = 0; o < width; ++o) {
                        activate(outputs + o * BLOCK, first.scales[0], first.biases[o], groups);
                        narrowed(outputs + o * BLOCK, groups, row + o * pitch + 1 + b * BLOCK);
                    }
                    if (flat.level) {
                        last = flat;
                        for (std::int64_t o = 0; o < width; ++o) constant[o] = static_cast<std::int16_t>(outputs[o * BLOCK]);
                    }
                }
                for (std::int64_t o = 0; o < width; ++o) {
                    row[o * pitch] = row[o * pitch + 1];
                    row[o * pitch + 1 + frames.x] = row[o * pitch + frames.x];
                }
            }
    }

    // The inputs of the second layer: of each output of the first its values at the voxel and at each neighbour of the cross.
    void gather(std::int64_t own, const std::int64_t* row_of, std::int64_t b, std::int64_t groups, float* inputs) const {
        for (std::int64_t k = 0; k < CROSS; ++k) {
            const std::int64_t row = k == 0 ? own : row_of[k - 1], shift = k == 0 ? 0 : STEPS[k - 1][3];
            const std::int16_t* const source = values.get() + row * width * pitch + 1 + b * BLOCK + shift;
            for (std::int64_t o = 0; o < width; ++o) widened(source + o * pitch, groups, inputs + (o * CROSS + k) * BLOCK);
        }
    }

    // Whether the block and all that its cross reaches have the same constant outputs; level only then.
    Flat flatness(std::int64_t own, const std::int64_t* row_of, std::int64_t b) const {
        const Flat* const here = &flats[own * frames.blocks + b];
        Flat flat = *here;
        flat.level = flat.level && (b == 0 || flat.same(here[-1])) && (b + 1 == frames.blocks || flat.same(here[1]));
        for (std::int64_t k = 0; k < CROSS - 1; ++k) flat.level = flat.same(flats[row_of[k] * frames.blocks + b]);
        return flat;
    }

private:
    const Frames& frames;
    const Network first;
    const std::int64_t width, pitch;
    std::unique_ptr<std::int16_t[]> values;
    std::unique_ptr<Flat[]> flats;
    Flat last{false, 0.0F, 0.0F};
    std::int16_t constant[MAX_CROSS_WIDTH];
};

// The last correction of a flat block, which the next one may have as well.
struct Last {
    Flat flat{false, 0.0F, 0.0F};
    float correction = 0.0F;
};

// Correct one time step. source: gathers the inputs of the network, from the rows of so many neighbours.
template <class Source>
void correct(const Frames& frames, const Source& source, std::int64_t neighbours, const Network& network, std::int64_t step, float* inputs,
             float* outputs, Last& last, float* out) {
    for (std::int64_t zi = 0; zi < frames.z; ++zi)
        for (std::int64_t yi = 0; yi < frames.y; ++yi) {
            std::int64_t row_of[FEATURES - 2];
            frames.neighbours(step, zi, yi, neighbours, row_of);
            const std::int64_t own = frames.row(step, zi, yi);
            for (std::int64_t b = 0; b < frames.blocks; ++b) {
                const float* const centre = frames.block(own, b);
                float* const target = out + ((step * frames.z + zi) * frames.y + yi) * frames.x + b * BLOCK;
                const std::int64_t n = frames.length(b), groups = groups_of(n);
                const Flat flat = source.flatness(own, row_of, b);
                if (flat.same(last.flat)) {
                    for (std::int64_t i = 0; i < n; ++i) target[i] = clipped(centre[i] + last.correction, frames.range);
                    continue;
                }
                source.gather(own, row_of, b, groups, inputs);
                const float* const correction = evaluate(network, groups, inputs, outputs);
                if (flat.level) last = {flat, correction[0]};
                for (std::int64_t i = 0; i < n; ++i) target[i] = clipped(centre[i] + correction[i], frames.range);
            }
        }
}

FHASH_INLINE bool sound(std::int64_t t, std::int64_t z, std::int64_t y, std::int64_t x, std::int64_t layers, const std::int64_t* widths) {
    if (t < 1 || z < 1 || y < 1 || x < 1 || layers < 1 || layers > MAX_LAYERS || widths[0] != FEATURES || widths[layers] != 1) return false;
    for (std::int64_t layer = 1; layer <= layers; ++layer)
        if (widths[layer] < 1 || widths[layer] > MAX_WIDTH) return false;
    return true;
}

}  // namespace

// decoded and out: (t, z, y, x), every length at least 1, may not overlap. Returns 0, -1 for arguments out of range, -2 for no memory.
FHASH_EXPORT std::int64_t fhash_head_apply(const float* decoded, std::int64_t t, std::int64_t z, std::int64_t y, std::int64_t x,
                                           std::int64_t layers, const std::int64_t* widths, const float* weights, const float* biases,
                                           const float* scales, float low, float high, float inverse, float unit, float* out) {
    if (!sound(t, z, y, x, layers, widths)) return -1;
    const Network network{layers, widths, weights, biases, scales};
    Frames frames(decoded, t, z, y, x, {low, high, inverse, unit});
    if (!frames.allocated()) return -2;
    alignas(64) float first[MAX_WIDTH * BLOCK], second[MAX_WIDTH * BLOCK];
    Last last;
    frames.load(0);
    for (std::int64_t step = 0; step < t; ++step) {
        if (step + 1 < t) frames.load(step + 1);
        correct(frames, frames, FEATURES - 2, network, step, first, second, last, out);
    }
    return 0;
}

// The same with three layers, the second of which takes the first one's outputs over the cross: its weights are (out, CROSS * in).
FHASH_EXPORT std::int64_t fhash_head_apply_cross(const float* decoded, std::int64_t t, std::int64_t z, std::int64_t y, std::int64_t x,
                                                 std::int64_t layers, const std::int64_t* widths, const float* weights, const float* biases,
                                                 const float* scales, float low, float high, float inverse, float unit, float* out) {
    if (!sound(t, z, y, x, layers, widths) || layers != 3 || widths[1] > MAX_CROSS_WIDTH) return -1;
    const Network beginning{1, widths, weights, biases, scales};
    const std::int64_t rest[] = {CROSS * widths[1], widths[2], 1};
    const Network end{2, rest, weights + FEATURES * widths[1], biases + widths[1], scales + 1};
    Frames frames(decoded, t, z, y, x, {low, high, inverse, unit});
    Hidden hidden(frames, beginning);
    if (!frames.allocated() || !hidden.allocated()) return -2;
    alignas(64) float first[CROSS * MAX_CROSS_WIDTH * BLOCK], second[MAX_WIDTH * BLOCK];
    Last last;
    frames.load(0);
    for (std::int64_t ahead = 0; ahead <= t; ++ahead) {
        if (ahead + 1 < t) frames.load(ahead + 1);
        if (ahead < t) hidden.fill(ahead, first, second);
        if (ahead > 0) correct(frames, hidden, CROSS - 1, end, ahead - 1, first, second, last, out);
    }
    return 0;
}
