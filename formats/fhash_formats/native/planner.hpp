// The planner: tiles, transform and step of a series by prices of some of its parts (planner.cpp).
#pragma once

#include <array>

#include "context.hpp"

/* Parts of a series, all of one shape. Arrays are the caller's. */
typedef struct fhash_plan_parts {
    int64_t shape[4];
    int64_t count;
    const float* values;    /* (count, shape), less the centre, finite */
    const uint8_t* counted; /* likewise: 1 where a vertex counts; NULL where all do */
    const double* weights;  /* of each part: vertices of the box that one of its own stands for */
} fhash_plan_parts;

/* A series and its promise. */
typedef struct fhash_plan_task {
    int64_t shape[4];           /* of the box over all steps, t, z, y, x */
    fhash_plan_parts columns;   /* as long as the box along t and z, where they can */
    fhash_plan_parts sheets;    /* as long along y and x; count 0 where the columns are, too */
    fhash_plan_parts block;     /* one, as long along all axes as may be */
    const float* lines[4];      /* along each axis (count, shape[axis]); NULL for no basis */
    int64_t line_counts[4];
    const int64_t* tiles;   /* candidates (count, 4) */
    const double* works;    /* of each: vertices that are decoded for a region */
    int64_t tile_count;
    double worth;           /* share of the bytes that half the work for a region is worth */
    double region_ns;       /* that a region may take */
    double vertex_ns, bit_ns; /* to decode a vertex, and each of its bits */
    double most;            /* bytes that a tile may take, as a multiple of the fewest */
    double step;            /* of the quantiser, a first guess */
    /* Without a promise the step stays as it is. */
    double mean_square;     /* promised mean squared error; 0 for none */
    double size;            /* promised bytes of all tiles; 0 for none */
} fhash_plan_task;

typedef struct fhash_plan_result {
    int64_t tile[4];
    int32_t kinds[4], depths[4]; /* of the transform; a basis is fitted by the caller */
    double step;                 /* of the plain quantiser */
    double bytes;                /* of all tiles, by price */
    double price;                /* of the tiling, as a multiple of the fewest bytes */
    int64_t tried;               /* tilings that were priced */
} fhash_plan_result;

namespace fhash {

// Plans a series. bases: get the packed basis of each axis that has one of its own, fitted to the
// lines of the task.
bool plan_tile(fhash_context& context, const fhash_plan_task& task, fhash_plan_result& result,
               std::array<Buffer, 4>& bases, fhash_error& error);

}  // namespace fhash
