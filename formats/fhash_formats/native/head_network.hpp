// The network of the neighbourhood head as its kernels take it.
//
// Inputs and activations are integers of 16 bits, weights are integers of 6 bits, and a weighted
// sum stays below 2^24: it is exact in any order, and as a float. All other operations are rounded
// one by one.
#pragma once

#include <memory>
#include <new>

#include "core.hpp"
#include "head_lanes.hpp"

namespace {

constexpr std::int64_t BLOCK = 64;   // most voxels along x that are evaluated together
constexpr std::int64_t GROUP = 16;   // the voxels of a shorter block are a multiple of this
constexpr std::int64_t HALO = 2;     // the farthest neighbour along an axis
constexpr std::int64_t STEPS = 2 * HALO + 1;  // that a voxel's neighbours lie in
constexpr std::int64_t INPUTS = 28;  // 26 neighbours, two functions of the centre
constexpr std::int64_t NEIGHBOURS = INPUTS - 2;
constexpr std::int64_t MAX_WIDTH = 64;
constexpr std::int64_t MAX_LAYERS = 4;
constexpr std::int64_t MAX_PAIRS = (MAX_WIDTH + 8) / 2;  // of a layer's inputs or outputs

// Offsets along (t, z, y, x) to the neighbours, in the order of the inputs. In a tile of one step
// those along t are along z.
constexpr int OFFSETS[NEIGHBOURS][4] = {
    {-1, 0, 0, 0},   {1, 0, 0, 0},   {0, -1, 0, 0},  {0, 1, 0, 0},  {0, 0, -1, 0}, {0, 0, 1, 0},
    {0, 0, 0, -1},   {0, 0, 0, 1},   {-2, 0, 0, 0},  {2, 0, 0, 0},  {0, 0, -2, 0}, {0, 0, 2, 0},
    {0, 0, 0, -2},   {0, 0, 0, 2},   {0, 0, -1, -1}, {0, 0, -1, 1}, {0, 0, 1, -1}, {0, 0, 1, 1},
    {-1, 0, 0, -1},  {-1, 0, 0, 1},  {1, 0, 0, -1},  {1, 0, 0, 1},  {-1, 0, -1, 0}, {-1, 0, 1, 0},
    {1, 0, -1, 0},   {1, 0, 1, 0},
};

// A network as the caller gives it.
struct Network {
    std::int64_t layers;
    const std::int64_t* widths;  // of the inputs, then of each layer: layers + 1 numbers
    const float* weights;        // (out, in) of each layer, one layer after the other; integers
    const float* biases;
    const float* scales;
};

struct Range {
    float low, high, inverse, unit;  // inverse = 1 / (2 sigma); unit = 1024 / (high - low)
};

// The position of a clipped value in the range, an integer in [-512, 512].
FHASH_INLINE int position(float value, const Range& range) {
    const float place = (value - range.low) * range.unit + 0.5F;
    return static_cast<int>(place < 1024.0F ? place : 1024.0F) - 512;
}

// One layer for the kernels.
struct Stage {
    std::int64_t inputs = 0;   // pairs
    std::int64_t outputs = 0;  // a multiple of `tile`; those that were added are 0
    std::int64_t tile = 0;     // outputs that are summed together
    float scale = 0.0F;
    std::unique_ptr<std::int32_t[]> held;  // the weights
    const std::int32_t* weights = nullptr;  // of each tile of outputs: (inputs, tile) pairs
    float biases[2 * MAX_PAIRS] = {};
};

// The functions of head_kernels.hpp for one set of lanes.
struct Kernels {
    void (*first_inputs)(const float* const*, const float*, const Range&, std::int64_t,
                         std::int32_t*);
    void (*hidden_layer)(const std::int32_t* const*, const Stage&, std::int64_t, std::int32_t*);
    float (*last_layer)(const std::int32_t* const*, const Stage&, const float*, const Range&,
                        std::int64_t, float*);
    void (*correct_all)(const float*, float, const Range&, std::int64_t, float*);
    int tile;  // most outputs that a hidden layer sums together
};

// Fill a stage. last: whether it is the last layer. most: outputs that a tile has at most. False
// where memory ran out.
inline bool make_stage(const float* weights, const float* biases, float scale, std::int64_t inputs,
                       std::int64_t outputs, bool last, int most, Stage& stage) {
    const std::int64_t tiles = (outputs + most - 1) / most;
    stage.tile = last ? 1 : ((outputs + tiles - 1) / tiles + 1) / 2 * 2;
    stage.outputs = (outputs + stage.tile - 1) / stage.tile * stage.tile;
    stage.inputs = (inputs + 1) / 2;
    stage.scale = scale;
    stage.held.reset(new (std::nothrow) std::int32_t[stage.inputs * stage.outputs]());
    if (!stage.held) return false;
    stage.weights = stage.held.get();
    for (std::int64_t o = 0; o < outputs; ++o) {
        stage.biases[o] = biases[o];
        std::int32_t* const tile = stage.held.get() + o / stage.tile * stage.tile * stage.inputs;
        const float* const from = weights + o * inputs;
        for (std::int64_t pair = 0; pair < stage.inputs; ++pair) {
            const int one = static_cast<int>(from[2 * pair]);
            const int two = 2 * pair + 1 < inputs ? static_cast<int>(from[2 * pair + 1]) : 0;
            tile[pair * stage.tile + o % stage.tile] = paired(one, two);
        }
    }
    return true;
}

}  // namespace
