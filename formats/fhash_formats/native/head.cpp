// The trained neighbourhood head over a tile. transform/head.py states the arithmetic, and
// tests/reference/head.py computes the same bits in numpy.
#include <cstring>
#include <memory>
#include <new>

#if defined(__GNUC__) && !defined(__clang__)
// gcc 12 warns of its own headers.
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif

#include "core.hpp"
#include "functions.h"
#include "head_frames.hpp"
#include "head_lanes_wide.hpp"
#include "head_network.hpp"

namespace {

constexpr std::int64_t BAD_ARGUMENT = -1;
constexpr std::int64_t OUT_OF_MEMORY = -2;

namespace plain {
#define FHASH_LANES PlainLanes
#define FHASH_TARGET
#include "head_kernels.hpp"
#undef FHASH_LANES
#undef FHASH_TARGET
}  // namespace plain

#if defined(__GNUC__)
namespace vectors {
#define FHASH_LANES VectorLanes
#define FHASH_TARGET
#include "head_kernels.hpp"
#undef FHASH_LANES
#undef FHASH_TARGET
}  // namespace vectors
#endif

#if defined(FHASH_HEAD_SSE2)
namespace sse2 {
#define FHASH_LANES Sse2Lanes
#define FHASH_TARGET
#include "head_kernels.hpp"
#undef FHASH_LANES
#undef FHASH_TARGET
}  // namespace sse2
#endif

#if defined(FHASH_HEAD_WIDE)
namespace avx2 {
#define FHASH_LANES Avx2Lanes
#define FHASH_TARGET FHASH_AVX2
#include "head_kernels.hpp"
#undef FHASH_LANES
#undef FHASH_TARGET
}  // namespace avx2

namespace avx512 {
#define FHASH_LANES Avx512Lanes
#define FHASH_TARGET FHASH_AVX512
#include "head_kernels.hpp"
#undef FHASH_LANES
#undef FHASH_TARGET
}  // namespace avx512
#endif

// The kernels of a set of lanes by its number, null where this machine has none: 1 plain, 2 the
// compiler's vectors, 3 SSE2, 4 AVX2, 5 AVX-512 with VNNI. 0: the fastest that this machine has.
inline const Kernels* kernels_of(std::int64_t lanes) {
#if defined(FHASH_HEAD_WIDE)
    const unsigned has = fhash_instructions();
    if ((lanes == 0 || lanes == 5) && has & FHASH_HAS_VNNI) return &avx512::kernels;
    if ((lanes == 0 || lanes == 4) && has & FHASH_HAS_V3) return &avx2::kernels;
#endif
#if defined(FHASH_HEAD_SSE2)
    if (lanes == 0 || lanes == 3) return &sse2::kernels;
#endif
#if defined(__GNUC__)
    if (lanes == 0 || lanes == 2) return &vectors::kernels;
#endif
    return lanes == 0 || lanes == 1 ? &plain::kernels : nullptr;
}

// The last correction of a flat block; the next block may have the same.
struct Last {
    Flat flat{false, 0, 0};
    float correction = 0.0F;
};

// Rows of pairs that the layers of a block work on.
struct Rooms {
    alignas(64) std::int32_t first[MAX_PAIRS * BLOCK];
    alignas(64) std::int32_t second[MAX_PAIRS * BLOCK];
    alignas(64) float values[BLOCK];
};

// The layers of a network over inputs that are gathered; the corrected values of a block, and the
// correction of its first voxel.
inline float evaluate(const Kernels& kernels, const Stage* stages, std::int64_t layers,
                      const std::int32_t** inputs, const float* centre, const Range& range,
                      std::int64_t groups, Rooms& rooms, float* out) {
    std::int32_t *room = rooms.second, *other = rooms.first;
    for (std::int64_t layer = 0; layer + 1 < layers; ++layer) {
        kernels.hidden_layer(inputs, stages[layer], groups, room);
        for (std::int64_t pair = 0; pair < stages[layer].outputs / 2; ++pair)
            inputs[pair] = room + pair * BLOCK;
        std::int32_t* const swapped = room;
        room = other;
        other = swapped;
    }
    return kernels.last_layer(inputs, stages[layers - 1], centre, range, groups, out);
}

// Correct some rows of one time step.
inline void correct(const Frames& frames, const Kernels& kernels, const Stage* stages,
                    std::int64_t layers, std::int64_t step, const Rows& some, Rooms& rooms,
                    Last& last, float* out) {
    for (std::int64_t r = some.begin; r < some.end; ++r) {
        std::int64_t row_of[NEIGHBOURS];
        frames.neighbours(step, r, row_of);
        const std::int64_t own = frames.row(step, 0, r);
        for (std::int64_t b = 0; b < frames.blocks; ++b) {
            const float* const centre = frames.block(own, b);
            const std::int64_t n = frames.length(b), groups = groups_of(n);
            float* const target = out + (step * frames.rows + r) * frames.x + b * BLOCK;
            float* const corrected = n % GROUP ? rooms.values : target;
            const Flat flat = frames.flatness(own, row_of, b);
            if (flat.same(last.flat)) {
                kernels.correct_all(centre, last.correction, frames.range, groups, corrected);
            } else {
                const std::int32_t* inputs[MAX_PAIRS];
                frames.gather(kernels, own, row_of, b, groups, rooms.first, inputs);
                const float correction = evaluate(kernels, stages, layers, inputs, centre,
                                                  frames.range, groups, rooms, corrected);
                if (flat.level) last = {flat, correction};
            }
            if (corrected != target)
                std::memcpy(target, corrected, static_cast<std::size_t>(n) * sizeof(float));
        }
    }
}

FHASH_INLINE bool sound(const std::int64_t* shape, std::int64_t layers,
                        const std::int64_t* widths) {
    for (int axis = 0; axis < 4; ++axis)
        if (shape[axis] < 1) return false;
    if (layers < 1 || layers > MAX_LAYERS || widths[0] != INPUTS || widths[layers] != 1)
        return false;
    for (std::int64_t layer = 1; layer <= layers; ++layer)
        if (widths[layer] < 1 || widths[layer] > MAX_WIDTH) return false;
    return true;
}

// The stages of a network. False where memory ran out.
inline bool make_stages(const Network& network, int tile, Stage* stages) {
    const float* weights = network.weights;
    const float* biases = network.biases;
    for (std::int64_t layer = 0; layer < network.layers; ++layer) {
        const std::int64_t inputs = network.widths[layer], outputs = network.widths[layer + 1];
        if (!make_stage(weights, biases, network.scales[layer], inputs, outputs,
                        layer + 1 == network.layers, tile, stages[layer]))
            return false;
        weights += inputs * outputs;
        biases += outputs;
    }
    return true;
}

inline void apply(Frames& frames, const Kernels& kernels, const Stage* stages,
                  std::int64_t layers, const Rows& some, float* out) {
    Rooms rooms;
    Last last;
    const Rows seen = frames.around(some);
    for (std::int64_t step = 0; step < HALO && step < frames.t; ++step) frames.load(step, seen);
    for (std::int64_t step = 0; step < frames.t; ++step) {
        if (step + HALO < frames.t) frames.load(step + HALO, seen);
        correct(frames, kernels, stages, layers, step, some, rooms, last, out);
    }
}

}  // namespace

// Correct the rows `first` to before `last`, counted through (z, y), of each step of a tile.
//
// decoded, out: (t, z, y, x) of `shape`, every length at least 1; of `out` only those rows are
// written. Both may be the same array if the rows are all of them.
// lanes: 0 for the widest that this machine has; tests ask for others, see kernels_of.
//
// Returns 0, or -1 for arguments out of range and lanes that this machine lacks, or -2 where memory
// ran out.
FHASH_KERNEL std::int64_t fhash_head_apply(const float* decoded, const std::int64_t* shape,
                                           std::int64_t first, std::int64_t last,
                                           std::int64_t layers, const std::int64_t* widths,
                                           const float* weights, const float* biases,
                                           const float* scales, const float* constants,
                                           std::int64_t lanes, float* out) {
    if (!sound(shape, layers, widths)) return BAD_ARGUMENT;
    if (first < 0 || last > shape[1] * shape[2] || first > last) return BAD_ARGUMENT;
    const Kernels* const kernels = kernels_of(lanes);
    if (!kernels) return BAD_ARGUMENT;
    const Range range = {constants[0], constants[1], constants[2], constants[3]};
    Frames frames(decoded, shape, range);
    Stage stages[MAX_LAYERS];
    const Network network{layers, widths, weights, biases, scales};
    if (!frames.allocated() || !make_stages(network, kernels->tile, stages)) return OUT_OF_MEMORY;
    apply(frames, *kernels, stages, layers, {first, last}, out);
    return 0;
}
