// The task of the brick engine (`FhashBricks`): a model in training on a coreset.
// fhash_codec/paper/engines/native.py says what the arrays hold.
//
// A brick is a box of vertices of one key frame. Its inputs of the MLP are rows over its samples:
// first the finest embeddings, which are stored for the samples alone, then those of each coarse
// level, interpolated at all vertices from a small sub-lattice of that level's table. Samples
// between key frames lie on no vertex of the finest table: it is then one more coarse level, and no
// embedding is stored for the samples.
#pragma once

#include "network.h"
#include "vector.hpp"

namespace {

// Adam's constants: fhash_codec/paper/engines/parameters.py.
constexpr double BETA1 = 0.9, BETA2 = 0.999, EPSILON = 1e-8;
constexpr std::int64_t WINDOW = 200;  // missed steps after which a number no longer moves

// The part of `count` things that one of several threads does: always the same one.
struct Part {
    std::int64_t first, stop;
    Part(std::int64_t count, std::int64_t thread, std::int64_t threads)
        : first(count * thread / threads), stop(count * (thread + 1) / threads) {}
};

inline std::int64_t vertices_of(const FhashBricks& b) {
    return b.shape[0] * b.shape[1] * b.shape[2];
}

// Numbers from one row of inputs to the next: no power of two, which would make rows share the
// lines of a cache, and with room for a last vector.
inline std::int64_t row_of(const FhashBricks& b) {
    return (vertices_of(b) + 15) / 16 * 16 + 16;
}

inline std::int64_t larger(std::int64_t a, std::int64_t b) { return a > b ? a : b; }
inline std::int64_t smaller(std::int64_t a, std::int64_t b) { return a < b ? a : b; }

inline std::int64_t groups_of(const FhashBricks& b) {
    return (b.shape[2] + FHASH_GROUP - 1) / FHASH_GROUP;
}

// Corners along t that a brick reads: a second one without weight is left out.
inline std::int64_t corners_in_time(const FhashLevel& l, std::int64_t key_frame) {
    return l.corners[0] > 1 && l.time[2 * key_frame + 1] != 0 ? 2 : 1;
}

// Call `each` with the place in `flat` of each of a brick's rows of corners at a level, ordered t,
// z, y. Corners of a row lie side by side: a brick needs all of them, and `rank` leaves out what no
// brick needs.
template <class Each>
FHASH_INLINE void for_rows(const FhashBricks& b, const FhashLevel& l, const std::int32_t* brick,
                           Each each) {
    const std::int64_t start = l.start[0][brick[0]] + l.start[1][brick[1]] +
                               l.start[2][brick[2]] + l.start[3][brick[3]];
    const std::int64_t nt = corners_in_time(l, brick[0]);
    for (std::int64_t t = 0; t < nt; t++)
        for (std::int64_t z = 0; z < l.corners[1]; z++)
            for (std::int64_t y = 0; y < l.corners[2]; y++) {
                const std::int64_t at =
                    start + t * l.stride[0] + z * l.stride[1] + y * l.stride[2];
                each(b.rank ? (std::int64_t)b.rank[at] : at);
            }
}

}  // namespace

// The parts of a step, in their order, and an evaluation.
enum FhashPart { CATCH_UP, TRAIN, ADAM, INFER };

// The kernels of a path: the share of a thread in a part, and the numbers of its memory.
#define FHASH_BRICK_KERNELS(NAME)                                                              \
    std::int64_t fhash_bricks_run_##NAME(const FhashBricks& b, std::int64_t part,              \
                                         std::int64_t thread);                                 \
    std::int64_t fhash_bricks_work_##NAME(const FhashBricks& b);
FHASH_BRICK_KERNELS(v4)
FHASH_BRICK_KERNELS(v3)
FHASH_BRICK_KERNELS(v1)
