// The trained neighbourhood head over a tile. transform/head/head.py states the arithmetic, and
// transform/head/head_portable.py computes the same bits in numpy.
#include <cstring>
#include <memory>
#include <new>

#include "core.hpp"
#include "head_network.hpp"

namespace {

constexpr std::int64_t BAD_ARGUMENT = -1;
constexpr std::int64_t OUT_OF_MEMORY = -2;

struct Extremes {
    float low, high;
};

// Load one clipped frame, each row with its edge values repeated to whole blocks and a halo, and
// the extremes of each block with its halo.
FHASH_CLONES void load_rows(const float* FHASH_RESTRICT source, std::int64_t rows, std::int64_t x,
                            std::int64_t pitch, const Range& bounds, float* FHASH_RESTRICT frame,
                            Extremes* FHASH_RESTRICT extremes) {
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

FHASH_INLINE std::int64_t clamped(std::int64_t index, std::int64_t size) {
    return index < 0 ? 0 : index < size ? index : size - 1;
}

// Whether the inputs of the neighbours are 0 in all of a block. All its voxels then have the same
// two inputs of the centre: position and distance.
struct Flat {
    bool level;
    float position, distance;

    bool same(const Flat& other) const {
        return level && other.level && position == other.position && distance == other.distance;
    }
};

// The clipped frames t - 1, t and t + 1 of a tile, with edges repeated, and the inputs of their
// voxels.
class Frames {
public:
    const std::int64_t t, z, y, x, rows, blocks, pitch, held;

    Frames(const float* source, std::int64_t t_, std::int64_t z_, std::int64_t y_, std::int64_t x_,
           const Range& bounds)
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
        load_rows(decoded + step * rows * x, rows, x, pitch, range,
                  frames.get() + slot * rows * pitch, extremes.get() + slot * rows * blocks);
    }

    std::int64_t row(std::int64_t step, std::int64_t zi, std::int64_t yi) const {
        return step % held * rows + zi * y + yi;
    }

    // The rows of the first `count` neighbours.
    void neighbours(std::int64_t step, std::int64_t zi, std::int64_t yi, std::int64_t count,
                    std::int64_t* row_of) const {
        for (std::int64_t k = 0; k < count; ++k)
            row_of[k] = row(clamped(step + OFFSETS[k][0], t), clamped(zi + OFFSETS[k][1], z),
                            clamped(yi + OFFSETS[k][2], y));
    }

    const float* block(std::int64_t row_index, std::int64_t b) const {
        return frames.get() + row_index * pitch + b * BLOCK + HALO;
    }

    std::int64_t length(std::int64_t b) const {
        return x - b * BLOCK < BLOCK ? x - b * BLOCK : BLOCK;
    }

    // Every operation is monotone: if the difference of the extremes of a block and its neighbours
    // has the input 0, so has every difference in it.
    Flat flatness(std::int64_t own, const std::int64_t* row_of, std::int64_t b) const {
        Extremes all = extremes[own * blocks + b];
        for (int k = 0; k < NEIGHBOURS; ++k) {
            const Extremes e = extremes[row_of[k] * blocks + b];
            all.low = e.low < all.low ? e.low : all.low;
            all.high = e.high > all.high ? e.high : all.high;
        }
        const float lowest = position(all.low, range);
        const float distance = compressed((all.low - range.low) * range.inverse);
        const bool level = compressed((all.high - all.low) * range.inverse) == 0.0F &&
                           position(all.high, range) == lowest &&
                           compressed((all.high - range.low) * range.inverse) == distance;
        return {level, lowest, distance};
    }

    // The inputs of the first layer.
    void gather(std::int64_t own, const std::int64_t* row_of, std::int64_t b, std::int64_t groups,
                float* inputs) const {
        const float* const centre = block(own, b);
        for (int k = 0; k < NEIGHBOURS; ++k)
            neighbour_inputs(block(row_of[k], b) + OFFSETS[k][3], centre, range.inverse, groups,
                             inputs + k * BLOCK);
        centre_inputs(centre, range, groups, inputs + NEIGHBOURS * BLOCK);
    }

    const Range range;

private:
    const float* decoded;
    std::unique_ptr<float[]> frames;
    std::unique_ptr<Extremes[]> extremes;
};

FHASH_INLINE std::int64_t groups_of(std::int64_t n) { return (n + LANES - 1) / LANES; }

FHASH_CLONES void narrowed(const float* FHASH_RESTRICT in, std::int64_t groups,
                           std::int16_t* FHASH_RESTRICT out) {
    for (std::int64_t i = 0; i < groups * LANES; ++i) out[i] = static_cast<std::int16_t>(in[i]);
}

FHASH_CLONES void widened(const std::int16_t* FHASH_RESTRICT in, std::int64_t groups,
                          float* FHASH_RESTRICT out) {
    for (std::int64_t i = 0; i < groups * LANES; ++i) out[i] = static_cast<float>(in[i]);
}

// First-layer outputs of the frames t - 1, t and t + 1. A row holds its outputs one after the
// other, with the edges repeated once.
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

    // Compute the outputs of one frame.
    void fill(std::int64_t step, float* inputs, float* outputs) {
        for (std::int64_t zi = 0; zi < frames.z; ++zi)
            for (std::int64_t yi = 0; yi < frames.y; ++yi) {
                std::int64_t row_of[NEIGHBOURS];
                frames.neighbours(step, zi, yi, NEIGHBOURS, row_of);
                const std::int64_t own = frames.row(step, zi, yi);
                for (std::int64_t b = 0; b < frames.blocks; ++b)
                    fill_block(own, row_of, b, inputs, outputs);
                std::int16_t* const row = values.get() + own * width * pitch;
                for (std::int64_t o = 0; o < width; ++o) {
                    row[o * pitch] = row[o * pitch + 1];
                    row[o * pitch + 1 + frames.x] = row[o * pitch + frames.x];
                }
            }
    }

    // The inputs of the second layer: each output of the first at the voxel and at its neighbours
    // of the cross.
    void gather(std::int64_t own, const std::int64_t* row_of, std::int64_t b, std::int64_t groups,
                float* inputs) const {
        for (std::int64_t k = 0; k < CROSS; ++k) {
            const std::int64_t row = k == 0 ? own : row_of[k - 1];
            const std::int64_t shift = 1 + b * BLOCK + (k == 0 ? 0 : OFFSETS[k - 1][3]);
            const std::int16_t* const source = values.get() + row * width * pitch + shift;
            for (std::int64_t o = 0; o < width; ++o)
                widened(source + o * pitch, groups, inputs + (o * CROSS + k) * BLOCK);
        }
    }

    // The flatness of a block. It is level only where the block and all blocks that its cross
    // reaches have the same constant outputs.
    Flat flatness(std::int64_t own, const std::int64_t* row_of, std::int64_t b) const {
        const Flat* const here = &flats[own * frames.blocks + b];
        Flat flat = *here;
        flat.level = flat.level && (b == 0 || flat.same(here[-1])) &&
                     (b + 1 == frames.blocks || flat.same(here[1]));
        for (std::int64_t k = 0; k < CROSS - 1; ++k)
            flat.level = flat.same(flats[row_of[k] * frames.blocks + b]);
        return flat;
    }

private:
    void fill_block(std::int64_t own, const std::int64_t* row_of, std::int64_t b, float* inputs,
                    float* outputs) {
        const std::int64_t groups = groups_of(frames.length(b));
        std::int16_t* const target = values.get() + own * width * pitch + 1 + b * BLOCK;
        const Flat flat = frames.flatness(own, row_of, b);
        flats[own * frames.blocks + b] = flat;
        if (flat.same(last)) {
            for (std::int64_t o = 0; o < width; ++o)
                for (std::int64_t i = 0; i < groups * LANES; ++i)
                    target[o * pitch + i] = constant[o];
            return;
        }
        frames.gather(own, row_of, b, groups, inputs);
        accumulate(inputs, INPUTS, first.weights, width, groups, outputs);
        for (std::int64_t o = 0; o < width; ++o) {
            activate(outputs + o * BLOCK, first.scales[0], first.biases[o], groups);
            narrowed(outputs + o * BLOCK, groups, target + o * pitch);
        }
        if (!flat.level) return;
        last = flat;
        for (std::int64_t o = 0; o < width; ++o)
            constant[o] = static_cast<std::int16_t>(outputs[o * BLOCK]);
    }

    const Frames& frames;
    const Network first;
    const std::int64_t width, pitch;
    std::unique_ptr<std::int16_t[]> values;
    std::unique_ptr<Flat[]> flats;
    Flat last{false, 0.0F, 0.0F};
    std::int16_t constant[MAX_CROSS_WIDTH];
};

// The last correction of a flat block; the next block may have the same.
struct Last {
    Flat flat{false, 0.0F, 0.0F};
    float correction = 0.0F;
};

// Correct one time step. source: gathers the inputs of the network from the rows of the first
// `neighbours` neighbours.
template <class Source>
void correct(const Frames& frames, const Source& source, std::int64_t neighbours,
             const Network& network, std::int64_t step, float* inputs, float* outputs, Last& last,
             float* out) {
    for (std::int64_t zi = 0; zi < frames.z; ++zi)
        for (std::int64_t yi = 0; yi < frames.y; ++yi) {
            std::int64_t row_of[NEIGHBOURS];
            frames.neighbours(step, zi, yi, neighbours, row_of);
            const std::int64_t own = frames.row(step, zi, yi);
            for (std::int64_t b = 0; b < frames.blocks; ++b) {
                const float* const centre = frames.block(own, b);
                float* const target =
                    out + ((step * frames.z + zi) * frames.y + yi) * frames.x + b * BLOCK;
                const std::int64_t n = frames.length(b), groups = groups_of(n);
                const Flat flat = source.flatness(own, row_of, b);
                if (flat.same(last.flat)) {
                    for (std::int64_t i = 0; i < n; ++i)
                        target[i] = clipped(centre[i] + last.correction, frames.range);
                    continue;
                }
                source.gather(own, row_of, b, groups, inputs);
                const float* const correction = evaluate(network, groups, inputs, outputs);
                if (flat.level) last = {flat, correction[0]};
                for (std::int64_t i = 0; i < n; ++i)
                    target[i] = clipped(centre[i] + correction[i], frames.range);
            }
        }
}

FHASH_INLINE bool sound(std::int64_t t, std::int64_t z, std::int64_t y, std::int64_t x,
                        std::int64_t layers, const std::int64_t* widths) {
    if (t < 1 || z < 1 || y < 1 || x < 1 || layers < 1 || layers > MAX_LAYERS) return false;
    if (widths[0] != INPUTS || widths[layers] != 1) return false;
    for (std::int64_t layer = 1; layer <= layers; ++layer)
        if (widths[layer] < 1 || widths[layer] > MAX_WIDTH) return false;
    return true;
}

}  // namespace

// decoded, out: (t, z, y, x), every length at least 1; they may not overlap. Returns 0, or -1 for
// arguments out of range, or -2 where memory ran out.
FHASH_EXPORT std::int64_t fhash_head_apply(const float* decoded, std::int64_t t, std::int64_t z,
                                           std::int64_t y, std::int64_t x, std::int64_t layers,
                                           const std::int64_t* widths, const float* weights,
                                           const float* biases, const float* scales, float low,
                                           float high, float inverse, float unit, float* out) {
    if (!sound(t, z, y, x, layers, widths)) return BAD_ARGUMENT;
    const Network network{layers, widths, weights, biases, scales};
    Frames frames(decoded, t, z, y, x, {low, high, inverse, unit});
    if (!frames.allocated()) return OUT_OF_MEMORY;
    alignas(64) float first[MAX_WIDTH * BLOCK], second[MAX_WIDTH * BLOCK];
    Last last;
    frames.load(0);
    for (std::int64_t step = 0; step < t; ++step) {
        if (step + 1 < t) frames.load(step + 1);
        correct(frames, frames, NEIGHBOURS, network, step, first, second, last, out);
    }
    return 0;
}

// The same with three layers, the second of which takes the first one's outputs over the cross: its
// weights are (out, CROSS * in).
FHASH_EXPORT std::int64_t fhash_head_apply_cross(const float* decoded, std::int64_t t,
                                                 std::int64_t z, std::int64_t y, std::int64_t x,
                                                 std::int64_t layers, const std::int64_t* widths,
                                                 const float* weights, const float* biases,
                                                 const float* scales, float low, float high,
                                                 float inverse, float unit, float* out) {
    if (!sound(t, z, y, x, layers, widths)) return BAD_ARGUMENT;
    if (layers != 3 || widths[1] > MAX_CROSS_WIDTH) return BAD_ARGUMENT;
    const Network beginning{1, widths, weights, biases, scales};
    const std::int64_t rest[] = {CROSS * widths[1], widths[2], 1};
    const Network end{2, rest, weights + INPUTS * widths[1], biases + widths[1], scales + 1};
    Frames frames(decoded, t, z, y, x, {low, high, inverse, unit});
    Hidden hidden(frames, beginning);
    if (!frames.allocated() || !hidden.allocated()) return OUT_OF_MEMORY;
    alignas(64) float first[CROSS * MAX_CROSS_WIDTH * BLOCK], second[MAX_WIDTH * BLOCK];
    Last last;
    frames.load(0);
    for (std::int64_t ahead = 0; ahead <= t; ++ahead) {
        if (ahead + 1 < t) frames.load(ahead + 1);
        if (ahead < t) hidden.fill(ahead, first, second);
        if (ahead > 0)
            correct(frames, hidden, CROSS - 1, end, ahead - 1, first, second, last, out);
    }
    return 0;
}
