/* What Python calls of the network's library: each function is described where it is defined.
 *
 * Python takes its declarations from this text (setup.py): plain C, no macros but numbers.
 */
#ifndef FHASH_NETWORK_H
#define FHASH_NETWORK_H

#include <stdint.h>

#include "core.hpp"

#ifdef __cplusplus
extern "C" {
#endif

#define FHASH_GROUP 16   // vertices along x that are interpolated together
#define FHASH_REACH 32   // corners that they need, at most 17, rounded up to whole vectors
#define FHASH_BLOCK 32   // numbers of the largest coarse table that Adam moves together
#define FHASH_WIDEST 128   // neurons of a hidden layer, at most
#define FHASH_PAD 64     // numbers behind a row or a plane that a last vector may touch

// A coarse level. A brick's coordinate along an axis chooses the row of each table.
typedef struct FhashLevel {
    int64_t corners[4];             // of a brick's sub-lattice along t, z, y, x
    int64_t stride[4];              // numbers from one corner to the next in the flat tables
    const int64_t* start[4];        // (coordinates,): where the sub-lattice begins, in numbers
    const float* time;              // (coordinates, 2): weights of the corners along t
    const int32_t* first[2];        // z, y: (coordinates, vertices): first corner of two
    const float* weight[2];         // z, y: (coordinates, vertices, 2): weights of the two
    const int32_t* reach;           // x: (coordinates, groups, 2): first corner, and their number
    const float* spread;            // x: (coordinates, groups, FHASH_REACH, FHASH_GROUP): weights
    const float* gathered;          // x: (coordinates, groups, FHASH_GROUP, FHASH_REACH): the same
} FhashLevel;

// Closed form of Adam's steps without a gradient, by the number of the last step that had one.
typedef struct FhashGaps {
    const double* weight;     // (steps + 1,): rate times the corrections of both moments
    const double* inverse;    // (steps + 1,): rate times the correction of the mean
    double* weight_sum;       // (steps + 1,): sums over the missed steps, see gaps.hpp
    double* inverse_sum;      // (steps + 1,)
    float* factor;            // (steps + 1,)
    float* epsilon;           // (steps + 1,)
    const float* mean_decay;    // (steps + 1,): by the number of missed steps
    const float* square_decay;  // (steps + 1,)
} FhashGaps;

typedef struct FhashBricks {
    // Sizes.
    int64_t path;                 // instructions: FHASH_PATH_...
    int64_t embedding;            // numbers of an embedding
    int64_t own;                  // those of the finest one, stored for the samples: all, or none
    int64_t levels;               // coarse levels
    int64_t hidden, width;        // hidden layers and their neurons
    int64_t shape[3];             // vertices of a brick, z, y, x
    int64_t threads;              // threads of this step
    // The coreset.
    const int32_t* bricks;        // (bricks, 4): key frame, z, y, x
    const uint8_t* mask;          // (bricks, mask_bytes): bits of the samples
    int64_t mask_bytes;
    const float* values;          // (samples,)
    const int64_t* offsets;       // (bricks + 1,)
    // The model and its moments.
    int64_t samples;              // of all bricks
    float* fine;                  // (own, samples): those of a brick from its offset on
    float* fine_mean;
    float* fine_square;
    int64_t* visited;             // (bricks,): last step with a gradient
    float* flat;                  // coarse tables and layers
    float* flat_mean;
    float* flat_square;
    int64_t coarse;               // numbers of the coarse tables in `flat`
    int64_t numbers;              // all numbers in `flat`
    int64_t lazy;                 // numbers of the largest coarse table, which come first
    int64_t* blocks;              // (blocks,): last step with a gradient, of FHASH_BLOCK numbers
    const int32_t* rank;          // place in `flat` by position in the tables; null for the same
    const FhashLevel* level;      // (levels,)
    const float* current;         // `flat` with all blocks caught up, for evaluation
    FhashGaps gaps;
    // A step.
    int64_t step;                 // number of the step, or of the last one in evaluation
    double rate;                  // learning rate
    double scale;                 // factor of the gradients, 2 / samples
    const int64_t* chosen;        // (count,): bricks
    int64_t count;
    int64_t* stamps;              // (blocks,): last step that touched a block
    int64_t* touched;             // (blocks,): blocks that the step touches
    int64_t touches;              // their number
    float* gradient;              // (threads, numbers): zeros up to `coarse` between steps
    float* work;                  // (threads, fhash_bricks_work): of each thread
    int64_t work_size;            // numbers of `work` for a thread
    double* error;                // (threads,): sums of squared errors
    float* out;                   // (samples of `chosen`,): values, in evaluation
    const int64_t* places;        // (count + 1,): where those of each brick begin
} FhashBricks;

/* network.cpp */
FHASH_EXPORT int64_t fhash_network_abi_version(void);
/* peak.cpp */
FHASH_EXPORT int64_t fhash_network_paths(void);
FHASH_EXPORT int64_t fhash_network_fma(int64_t path, int64_t rounds);
FHASH_EXPORT int64_t fhash_network_copy(void* to, const void* from, int64_t bytes);
/* points.cpp */
FHASH_EXPORT int64_t fhash_network_points(const int64_t* sizes, const int64_t* levels,
                                          const int64_t* layers, const int64_t* columns,
                                          int64_t count, int64_t path, float* values, float* slopes,
                                          float* by_inputs);
FHASH_EXPORT int64_t fhash_network_still(const int64_t* sizes, const int64_t* level, double time,
                                         int64_t path, float* numbers);
/* train_bricks.cpp */
FHASH_EXPORT int64_t fhash_bricks_work(const FhashBricks* task);
FHASH_EXPORT int64_t fhash_bricks_gaps(const FhashBricks* task, int64_t first, int64_t last);
FHASH_EXPORT int64_t fhash_bricks_touch(const FhashBricks* task);
FHASH_EXPORT int64_t fhash_bricks_run(const FhashBricks* task, int64_t first, int64_t last);

#ifdef __cplusplus
}
#endif
#endif
