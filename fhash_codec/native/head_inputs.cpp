// Inputs of the neighbourhood head for voxels drawn from a tile. compact/choices/head_samples.py
// states where they go, and computes the same numbers in numpy; head_portable.py in fhash_formats
// states what they are.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "core.hpp"

namespace {

using std::int16_t;
using std::int32_t;
using std::int64_t;

constexpr int64_t BLOCK = 64;    // voxels that the network computes together
constexpr int AXES = 4;          // t, z, y, x
constexpr int NEIGHBOURS = 26;
constexpr int INPUTS = NEIGHBOURS + 2;
constexpr int REACH = 2;         // of the farthest neighbour along an axis
constexpr int32_t LIMIT = 4095;  // magnitude of an input
constexpr int64_t BAD_ARGUMENT = -1;

// The range that values are clipped to, and the scales of their differences and of their place.
struct Range {
    float low, high, inverse, unit;

    float clipped(float value) const {
        const float raised = value > low ? value : low;
        return raised < high ? raised : high;
    }

    static int16_t compressed(float scaled) {
        const float magnitude = std::fabs(scaled) + 1.0f;
        int32_t octaves;
        std::memcpy(&octaves, &magnitude, sizeof octaves);
        octaves = (octaves - 0x3F800000) >> 14;
        octaves = octaves < LIMIT ? octaves : LIMIT;
        return (int16_t)(std::signbit(scaled) ? -octaves : octaves);
    }

    int16_t located(float value) const {
        const float position = (value - low) * unit + 0.5f;
        return (int16_t)((int32_t)(position < 1024.0f ? position : 1024.0f) - 512);
    }
};

int64_t inside(int64_t index, int64_t length) {
    return index < 0 ? 0 : (index < length ? index : length - 1);
}

// Positions of the rows, planes and so on around a voxel, each of which begins inside the tile.
struct Around {
    int64_t at[AXES][2 * REACH + 1];

    Around(const int64_t* voxel, const int64_t* shape, const int64_t* strides) {
        for (int axis = 0; axis < AXES; ++axis)
            for (int step = -REACH; step <= REACH; ++step)
                at[axis][step + REACH] = inside(voxel[axis] + step, shape[axis]) * strides[axis];
    }

    int64_t operator()(const int64_t* offset) const {
        int64_t sum = 0;
        for (int axis = 0; axis < AXES; ++axis) sum += at[axis][offset[axis] + REACH];
        return sum;
    }
};

bool reaches(const int64_t* offsets, int64_t count) {
    for (int64_t i = 0; i < count * AXES; ++i)
        if (offsets[i] < -REACH || offsets[i] > REACH) return false;
    return true;
}

}  // namespace

// Write the inputs of drawn voxels, each seen from `looked_at` places, into their slots.
//
// decoded: the tile, of this shape (4 lengths).
// places: coordinates (4, count) of the voxels; slots: number of each among the voxels of `out`.
// neighbours: offsets (26, 4) of the neighbours; offsets: (looked_at, 4) of the places.
// out: (blocks, INPUTS, looked_at, BLOCK).
FHASH_EXPORT int64_t fhash_head_inputs(const float* decoded, const int64_t* shape,
                                       const int64_t* places, const int64_t* slots, int64_t count,
                                       const int64_t* neighbours, const int64_t* offsets,
                                       int64_t looked_at, double low, double high, double inverse,
                                       double unit, int16_t* out) {
    if (!reaches(neighbours, NEIGHBOURS) || !reaches(offsets, looked_at)) return BAD_ARGUMENT;
    const Range range = {(float)low, (float)high, (float)inverse, (float)unit};
    const int64_t strides[AXES] = {shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3],
                                   1};
    for (int64_t i = 0; i < count; ++i) {
        const int64_t block = slots[i] / BLOCK;
        int16_t* const slot = out + block * INPUTS * looked_at * BLOCK + slots[i] % BLOCK;
        for (int64_t l = 0; l < looked_at; ++l) {
            int64_t voxel[AXES];
            for (int axis = 0; axis < AXES; ++axis)
                voxel[axis] =
                    inside(places[axis * count + i] + offsets[l * AXES + axis], shape[axis]);
            const Around around(voxel, shape, strides);
            const int64_t own[AXES] = {0, 0, 0, 0};
            const float centre = range.clipped(decoded[around(own)]);
            int16_t* const to = slot + l * BLOCK;
            for (int k = 0; k < NEIGHBOURS; ++k) {
                const float value = range.clipped(decoded[around(neighbours + k * AXES)]);
                to[k * looked_at * BLOCK] = Range::compressed((value - centre) * range.inverse);
            }
            to[NEIGHBOURS * looked_at * BLOCK] = range.located(centre);
            to[(NEIGHBOURS + 1) * looked_at * BLOCK] =
                Range::compressed((centre - range.low) * range.inverse);
        }
    }
    return 0;
}
