// Inputs of the neighbourhood head for voxels drawn from a tile. compact/head_training.py
// states where they go; they are the numbers that head.cpp of fhash_formats computes.
#include "loops.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "codec.h"
#include "core.hpp"
#include "guard.hpp"

#if defined(__GNUC__)
#define FHASH_PREFETCH(address) __builtin_prefetch(address)
#else
#define FHASH_PREFETCH(address) ((void)(address))
#endif

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
constexpr int64_t AHEAD = 3;     // voxels whose surroundings are fetched before they are used
constexpr int64_t BAD_ARGUMENT = -1;

// The range that values are clipped to, and the scales of their differences and of their place.
struct Range {
    float low, high, inverse, unit;

    FHASH_INLINE float clipped(float value) const {
        const float raised = value > low ? value : low;
        return raised < high ? raised : high;
    }

    FHASH_INLINE static int16_t compressed(float scaled) {
        const float magnitude = std::fabs(scaled) + 1.0f;
        int32_t octaves;
        std::memcpy(&octaves, &magnitude, sizeof octaves);
        octaves = (octaves - 0x3F800000) >> 14;
        octaves = octaves < LIMIT ? octaves : LIMIT;
        int32_t bits;
        std::memcpy(&bits, &scaled, sizeof bits);
        const int32_t sign = bits >> 31;  // -1 where the sign is set, also that of a zero
        return (int16_t)((octaves ^ sign) - sign);
    }

    FHASH_INLINE int16_t located(float value) const {
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

// Largest magnitude of some offsets along each axis.
struct Farthest {
    int64_t along[AXES] = {0, 0, 0, 0};

    Farthest(const int64_t* offsets, int64_t count) {
        for (int64_t i = 0; i < count * AXES; ++i) {
            const int64_t step = offsets[i] < 0 ? -offsets[i] : offsets[i];
            along[i % AXES] = step > along[i % AXES] ? step : along[i % AXES];
        }
    }
};

bool reaches(const int64_t* offsets, int64_t count) {
    for (int64_t i = 0; i < count * AXES; ++i)
        if (offsets[i] < -REACH || offsets[i] > REACH) return false;
    return true;
}

// The drawn voxels of a tile, and the offsets of their neighbours.
struct Drawn {
    const float* decoded;
    const int64_t *shape, *places, *slots;
    int64_t count;
    const int64_t* neighbours;
};

// First places of the rows that the inputs of a voxel look at, relative to it.
std::vector<int64_t> rows_of(const Drawn& drawn, const int64_t* far) {
    std::vector<int64_t> rows;
    for (int k = 0; k < NEIGHBOURS; ++k) rows.push_back(far[k] - drawn.neighbours[k * AXES + 3]);
    std::sort(rows.begin(), rows.end());
    rows.erase(std::unique(rows.begin(), rows.end()), rows.end());
    return rows;
}

// Inputs of all voxels. Their places around a voxel are at fixed distances where it is not near an
// end of the tile.
FHASH_INLINE void write_inputs(const Drawn& drawn, const Range& range, int16_t* out) {
    const int64_t* const shape = drawn.shape;
    const int64_t strides[AXES] = {shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3],
                                   1};
    const int64_t own[AXES] = {0, 0, 0, 0};
    const Farthest near(drawn.neighbours, NEIGHBOURS);
    int64_t far[NEIGHBOURS];
    for (int k = 0; k < NEIGHBOURS; ++k) {
        far[k] = 0;
        for (int axis = 0; axis < AXES; ++axis)
            far[k] += drawn.neighbours[k * AXES + axis] * strides[axis];
    }
    const int64_t size = strides[0] * shape[0];
    const std::vector<int64_t> rows = rows_of(drawn, far);
    for (int64_t i = 0; i < drawn.count; ++i) {
        if (i + AHEAD < drawn.count) {
            int64_t next = 0;
            for (int axis = 0; axis < AXES; ++axis)
                next += drawn.places[axis * drawn.count + i + AHEAD] * strides[axis];
            for (const int64_t row : rows)
                FHASH_PREFETCH(drawn.decoded + inside(next + row, size));
        }
        int16_t* const slot =
            out + drawn.slots[i] / BLOCK * INPUTS * BLOCK + drawn.slots[i] % BLOCK;
        int64_t voxel[AXES], at = 0;
        bool inner = true;  // all that is looked at lies inside the tile
        for (int axis = 0; axis < AXES; ++axis) {
            voxel[axis] = drawn.places[axis * drawn.count + i];
            at += voxel[axis] * strides[axis];
            const int64_t reach = near.along[axis];
            inner &= voxel[axis] >= reach && voxel[axis] + reach < shape[axis];
        }
        float values[NEIGHBOURS];
        if (inner) {
            for (int k = 0; k < NEIGHBOURS; ++k) values[k] = drawn.decoded[at + far[k]];
        } else {
            const Around around(voxel, shape, strides);
            at = around(own);
            for (int k = 0; k < NEIGHBOURS; ++k)
                values[k] = drawn.decoded[around(drawn.neighbours + k * AXES)];
        }
        const float centre = range.clipped(drawn.decoded[at]);
        int16_t inputs[NEIGHBOURS];
        for (int k = 0; k < NEIGHBOURS; ++k)
            inputs[k] = Range::compressed((range.clipped(values[k]) - centre) * range.inverse);
        for (int k = 0; k < NEIGHBOURS; ++k) slot[k * BLOCK] = inputs[k];
        slot[NEIGHBOURS * BLOCK] = range.located(centre);
        slot[(NEIGHBOURS + 1) * BLOCK] = Range::compressed((centre - range.low) * range.inverse);
    }
}

FHASH_CLONES int64_t write_inputs_cloned(const Drawn& drawn, const Range& range, int16_t* out) {
    return guarded([&]() FHASH_LAMBDA {
        write_inputs(drawn, range, out);
        return (int64_t)0;
    });
}

}  // namespace

// Write the inputs of drawn voxels into their slots.
//
// decoded: the tile, of this shape (4 lengths).
// places: coordinates (4, count) of the voxels; slots: number of each among the voxels of `out`.
// neighbours: offsets (26, 4) of the neighbours.
// out: (blocks, INPUTS, BLOCK).
FHASH_EXPORT int64_t fhash_head_inputs(const float* decoded, const int64_t* shape,
                                       const int64_t* places, const int64_t* slots, int64_t count,
                                       const int64_t* neighbours, double low, double high,
                                       double inverse, double unit, int16_t* out) {
    if (!reaches(neighbours, NEIGHBOURS)) return BAD_ARGUMENT;
    const Range range = {(float)low, (float)high, (float)inverse, (float)unit};
    return write_inputs_cloned({decoded, shape, places, slots, count, neighbours}, range, out);
}
