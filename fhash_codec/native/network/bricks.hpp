// The task of the brick engine: a model in training on a coreset. Mirrored field by field in
// fhash_codec/paper/engines/native.py, which also says what the arrays hold.
//
// A brick is a box of vertices of one key frame. Its inputs of the MLP are rows over its samples:
// first the finest embeddings, which are stored for the samples alone, then those of each coarse
// level, interpolated at all vertices from a small sub-lattice of that level's table. Samples
// between key frames lie on no vertex of the finest table: it is then one more coarse level, and no
// embedding is stored for the samples.
#pragma once

#include "vector.hpp"

constexpr int FHASH_GROUP = 16;  // vertices along x that are interpolated together
constexpr int FHASH_REACH = 32;  // corners that they need, at most 17, rounded up to whole vectors
constexpr int FHASH_BLOCK = 32;  // numbers of the largest coarse table that Adam moves together
constexpr int FHASH_WIDEST = 128;  // neurons of a hidden layer, at most
constexpr int FHASH_PAD = 64;    // numbers behind a row or a plane that a last vector may touch

// A coarse level. A brick's coordinate along an axis chooses the row of each table.
extern "C" struct FhashLevel {
    std::int64_t corners[4];        // of a brick's sub-lattice along t, z, y, x
    std::int64_t stride[4];         // numbers from one corner to the next in the flat tables
    const std::int64_t* start[4];   // (coordinates,): where the sub-lattice begins, in numbers
    const float* time;              // (coordinates, 2): weights of the corners along t
    const std::int32_t* first[2];   // z, y: (coordinates, vertices): first corner of two
    const float* weight[2];         // z, y: (coordinates, vertices, 2): weights of the two
    const std::int32_t* reach;      // x: (coordinates, groups, 2): first corner, and their number
    const float* spread;            // x: (coordinates, groups, FHASH_REACH, FHASH_GROUP): weights
    const float* gathered;          // x: (coordinates, groups, FHASH_GROUP, FHASH_REACH): the same
};

// Closed form of Adam's steps without a gradient, by the number of the last step that had one.
extern "C" struct FhashGaps {
    const double* weight;     // (steps + 1,): rate times the corrections of both moments
    const double* inverse;    // (steps + 1,): rate times the correction of the mean
    double* weight_sum;       // (steps + 1,): sums over the missed steps, see gaps.hpp
    double* inverse_sum;      // (steps + 1,)
    float* factor;            // (steps + 1,)
    float* epsilon;           // (steps + 1,)
    const float* mean_decay;    // (steps + 1,): by the number of missed steps
    const float* square_decay;  // (steps + 1,)
};

extern "C" struct FhashBricks {
    // Sizes.
    std::int64_t path;            // instructions: FHASH_PATH_...
    std::int64_t embedding;       // numbers of an embedding
    std::int64_t own;             // those of the finest one, stored for the samples: all, or none
    std::int64_t levels;          // coarse levels
    std::int64_t hidden, width;   // hidden layers and their neurons
    std::int64_t shape[3];        // vertices of a brick, z, y, x
    std::int64_t threads;         // threads of this step
    // The coreset.
    const std::int32_t* bricks;   // (bricks, 4): key frame, z, y, x
    const std::uint8_t* mask;     // (bricks, mask_bytes): bits of the samples
    std::int64_t mask_bytes;
    const float* values;          // (samples,)
    const std::int64_t* offsets;  // (bricks + 1,)
    // The model and its moments.
    std::int64_t samples;         // of all bricks
    float* fine;                  // (own, samples): those of a brick from its offset on
    float* fine_mean;
    float* fine_square;
    std::int64_t* visited;        // (bricks,): last step with a gradient
    float* flat;                  // coarse tables and layers
    float* flat_mean;
    float* flat_square;
    std::int64_t coarse;          // numbers of the coarse tables in `flat`
    std::int64_t numbers;         // all numbers in `flat`
    std::int64_t lazy;            // numbers of the largest coarse table, which come first
    std::int64_t* blocks;         // (blocks,): last step with a gradient, of FHASH_BLOCK numbers
    const std::int32_t* rank;     // place in `flat` by position in the tables; null for the same
    const FhashLevel* level;      // (levels,)
    const float* current;         // `flat` with all blocks caught up, for evaluation
    FhashGaps gaps;
    // A step.
    std::int64_t step;            // number of the step, or of the last one in evaluation
    double rate;                  // learning rate
    double scale;                 // factor of the gradients, 2 / samples
    const std::int64_t* chosen;   // (count,): bricks
    std::int64_t count;
    std::int64_t* stamps;         // (blocks,): last step that touched a block
    std::int64_t* touched;        // (blocks,): blocks that the step touches
    std::int64_t touches;         // their number
    float* gradient;              // (threads, numbers): zeros up to `coarse` between steps
    float* work;                  // (threads, fhash_bricks_work): of each thread
    std::int64_t work_size;       // numbers of `work` for a thread
    double* error;                // (threads,): sums of squared errors
    float* out;                   // (samples of `chosen`,): values, in evaluation
    const std::int64_t* places;   // (count + 1,): where those of each brick begin
};

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
