// The frames of a tile that the head looks at.
#pragma once

#include <memory>
#include <new>

#include "core.hpp"
#include "head_network.hpp"

namespace {

struct Extremes {
    float low, high;
};

FHASH_INLINE float clipped(float value, const Range& range) {
    const float raised = value > range.low ? value : range.low;  // NaN becomes low
    return raised < range.high ? raised : range.high;
}

// The extremes of a block with its halo, in columns that a vector holds.
FHASH_INLINE Extremes extremes_of(const float* start) {
    float low[GROUP], high[GROUP];
    for (int i = 0; i < GROUP; ++i) low[i] = high[i] = start[BLOCK + 2 * HALO - GROUP + i];
    for (int at = 0; at < BLOCK; at += GROUP)
        for (int i = 0; i < GROUP; ++i) {
            low[i] = start[at + i] < low[i] ? start[at + i] : low[i];
            high[i] = start[at + i] > high[i] ? start[at + i] : high[i];
        }
    for (int half = GROUP / 2; half > 0; half /= 2)
        for (int i = 0; i < half; ++i) {
            low[i] = low[i + half] < low[i] ? low[i + half] : low[i];
            high[i] = high[i + half] > high[i] ? high[i + half] : high[i];
        }
    return {low[0], high[0]};
}

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
        for (std::int64_t b = 0; b < blocks; ++b)
            extremes[r * blocks + b] = extremes_of(row + b * BLOCK);
    }
}

FHASH_INLINE std::int64_t clamped(std::int64_t index, std::int64_t size) {
    return index < 0 ? 0 : index < size ? index : size - 1;
}

FHASH_INLINE std::int64_t groups_of(std::int64_t n) { return (n + GROUP - 1) / GROUP; }

// Whether the inputs of the neighbours are 0 in all of a block. All its voxels then have the same
// two inputs of the centre: position and distance.
struct Flat {
    bool level;
    int position, distance;

    bool same(const Flat& other) const {
        return level && other.level && position == other.position && distance == other.distance;
    }
};

// Some rows (z, y) of a frame, counted through the frame.
struct Rows {
    std::int64_t begin, end;
};

// The clipped frames around one of a tile, with edges repeated, and the inputs of its voxels.
class Frames {
public:
    const std::int64_t t, z, y, x, rows, blocks, pitch, held;

    Frames(const float* source, const std::int64_t* shape, const Range& bounds)
        : t(shape[0]),
          z(shape[1]),
          y(shape[2]),
          x(shape[3]),
          rows(z * y),
          blocks((x + BLOCK - 1) / BLOCK),
          pitch(blocks * BLOCK + 2 * HALO),
          held(t < STEPS ? t : STEPS),
          range(bounds),
          decoded(source),
          frames(new (std::nothrow) float[held * rows * pitch]),
          extremes(new (std::nothrow) Extremes[held * rows * blocks]) {}

    bool allocated() const { return frames && extremes; }

    // Some rows, and those that their neighbours lie in.
    Rows around(const Rows& some) const {
        const std::int64_t more = HALO * ((z > 1 ? y : 0) + 1);
        return {some.begin > more ? some.begin - more : 0,
                some.end < rows - more ? some.end + more : rows};
    }

    void load(std::int64_t step, const Rows& some) {
        const std::int64_t slot = step % held * rows + some.begin;
        load_rows(decoded + (step * rows + some.begin) * x, some.end - some.begin, x, pitch, range,
                  frames.get() + slot * pitch, extremes.get() + slot * blocks);
    }

    std::int64_t row(std::int64_t step, std::int64_t zi, std::int64_t yi) const {
        return step % held * rows + zi * y + yi;
    }

    // The rows of the neighbours of row r of a frame.
    FHASH_INLINE void neighbours(std::int64_t step, std::int64_t r, std::int64_t* row_of) const {
        std::int64_t ts[STEPS], zs[STEPS], ys[STEPS];
        const std::int64_t zi = r / y, yi = r % y;
        for (int d = 0; d < STEPS; ++d) {
            zs[d] = clamped(zi + d - HALO, z) * y;
            ys[d] = clamped(yi + d - HALO, y);
            ts[d] = t > 1 ? row(clamped(step + d - HALO, t), 0, 0) : zs[d] - zi * y;
        }
        FHASH_UNROLLED
        for (int k = 0; k < NEIGHBOURS; ++k)
            row_of[k] = ts[OFFSETS[k][0] + HALO] + zs[OFFSETS[k][1] + HALO] +
                        ys[OFFSETS[k][2] + HALO];
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
        if (compressed((all.high - all.low) * range.inverse) != 0) return {false, 0, 0};
        for (int k = 0; k < NEIGHBOURS; ++k) {
            const Extremes e = extremes[row_of[k] * blocks + b];
            all.low = e.low < all.low ? e.low : all.low;
            all.high = e.high > all.high ? e.high : all.high;
        }
        const int lowest = position(all.low, range);
        const int distance = compressed((all.low - range.low) * range.inverse);
        const bool level = compressed((all.high - all.low) * range.inverse) == 0 &&
                           position(all.high, range) == lowest &&
                           compressed((all.high - range.low) * range.inverse) == distance;
        return {level, lowest, distance};
    }

    // The inputs of the first layer, in `room`; a row of pairs for each two inputs in `inputs`.
    void gather(const Kernels& kernels, std::int64_t own, const std::int64_t* row_of,
                std::int64_t b, std::int64_t groups, std::int32_t* room,
                const std::int32_t** inputs) const {
        const float* moved[NEIGHBOURS];
        FHASH_UNROLLED
        for (int k = 0; k < NEIGHBOURS; ++k) moved[k] = block(row_of[k], b) + OFFSETS[k][3];
        kernels.first_inputs(moved, block(own, b), range, groups, room);
        FHASH_UNROLLED
        for (int pair = 0; pair < INPUTS / 2; ++pair) inputs[pair] = room + pair * BLOCK;
    }

    const Range range;

private:
    const float* decoded;
    std::unique_ptr<float[]> frames;
    std::unique_ptr<Extremes[]> extremes;
};

}  // namespace
