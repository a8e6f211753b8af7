// Values and derivatives of the network at scattered points: what points.cpp gives to the kernels
// (point_kernels.hpp).
#pragma once

#include "vector.hpp"

#if defined(FHASH_VECTORS)
namespace fhash_points {

constexpr int AXES = 4;

// One axis of one level: its vertices, the first one in the part, and the numbers from one to the
// next.
struct Axis {
    std::int64_t vertices, first, stride;
};

// A bitmap of the vertices that a level holds (paper/network.py), and the row of zeros behind
// their embeddings. Without words the level holds all vertices.
struct Held {
    const std::uint64_t* words;
    const std::uint32_t* blocks;
    const std::uint8_t* within;
    std::int64_t nothing;
};

// A part of a level's table: its numbers, how many there are, and its axes t, z, y, x. Where it
// holds some vertices only, the axes count bits of the bitmap, and the table has one time.
struct Level {
    const float* table;
    std::int64_t numbers;
    Axis axes[AXES];
    Held held;
};

// A layer as a matrix (outputs + 1, inputs + 1) with the bias in its last column; the last row is
// not read.
struct Layer {
    const float* matrix;
    std::int64_t outputs, inputs;
};

// Points (t, z, y, x): coordinate `a` of point i is columns[a][i * steps[a]].
struct Points {
    const double* columns[AXES];
    std::int64_t steps[AXES];
};

struct Task {
    const Level* levels;
    std::int64_t level_count;
    const Layer* layers;
    std::int64_t layer_count;
    const std::int64_t* sizes;  // vertices of the box and key frames, t, z, y, x
    std::int64_t embedding;     // numbers at each vertex
    bool times;                 // whether tables hold more than one time node
    std::int64_t width;         // largest number of outputs of a layer
    std::int64_t inputs;
};

// The kernels of a path. `run`: values of the points, derivatives (n, 4) where `slopes` is not
// null, and those by the inputs (inputs, n) where `by_inputs` is not. `still`: the numbers of a
// part at one time, between its two time nodes around it.
#define FHASH_POINT_KERNELS(NAME)                                                                \
    std::int64_t run_##NAME(const Task& task, const Points& points, std::int64_t count,          \
                            float* values, float* slopes, float* by_inputs);                     \
    std::int64_t still_##NAME(const Level& level, const std::int64_t* sizes, double time,        \
                              std::int64_t count, float* still);
FHASH_POINT_KERNELS(v4)
FHASH_POINT_KERNELS(v3)
FHASH_POINT_KERNELS(v1)

}  // namespace fhash_points
#endif  // FHASH_VECTORS
