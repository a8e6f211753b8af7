// Levels of a mask from decoded values: how likely each vertex is occupied
// (transform/spec.py says what they mean).
//
// Scores of values are summed over the vertices within reach along z, then y, then x, and cut after
// each axis. Each sum is that of the vertex before, plus one value, less one.
#include "loops.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

#include "functions.h"
#include "guard.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::uint16_t;
using std::uint8_t;

const int32_t MAX_SCORE = 4095;
// Sums at which level 1, 2, ... begins; level 16 begins at one bit, at even odds.
const int BOUNDS[31] = {1,   2,   3,   4,   6,   8,   11,  15,  20,  27,   36,
                        48,  64,  85,  110, 128, 155, 190, 230, 275, 325,  385,
                        455, 540, 640, 760, 900, 1100, 1350, 1700, 2200};

struct Levels {
    uint8_t of[MAX_SCORE + 1];  // the first level of each sum
    Levels() {
        int level = 0;
        for (int sum = 0; sum <= MAX_SCORE; sum++) {
            while (level < 31 && sum >= BOUNDS[level]) level++;
            of[sum] = (uint8_t)level;
        }
    }
};
const Levels levels;

// Sums along one axis of `count` vertices, each a row of n values; a row of n sums is `sums`.
FHASH_INLINE void sum_along(const uint16_t* in, uint16_t* out, int64_t count, int64_t n,
                            int64_t reach, int32_t* sums) {
    std::fill(sums, sums + n, 0);
    for (int64_t k = 0; k < std::min(reach, count); k++)
        for (int64_t i = 0; i < n; i++) sums[i] += in[k * n + i];
    for (int64_t k = 0; k < count; k++) {
        if (k + reach < count) {
            const uint16_t* next = in + (k + reach) * n;
            for (int64_t i = 0; i < n; i++) sums[i] += next[i];
        }
        if (k > reach) {
            const uint16_t* last = in + (k - reach - 1) * n;
            for (int64_t i = 0; i < n; i++) sums[i] -= last[i];
        }
        for (int64_t i = 0; i < n; i++) out[k * n + i] = (uint16_t)std::min(sums[i], MAX_SCORE);
    }
}

FHASH_INLINE void sum_row(const uint16_t* in, uint16_t* out, int64_t n, int64_t reach) {
    int32_t sum = 0;
    for (int64_t i = 0; i < std::min(reach, n); i++) sum += in[i];
    for (int64_t i = 0; i < n; i++) {
        if (i + reach < n) sum += in[i + reach];
        if (i > reach) sum -= in[i - reach - 1];
        out[i] = (uint16_t)std::min(sum, MAX_SCORE);
    }
}

// Scores of a frame to their sums, in `scores` again; `other` has as much room.
FHASH_INLINE void sum_frame(uint16_t* scores, uint16_t* other, const int64_t* shape, int64_t reach,
                            int32_t* sums) {
    if (reach == 0) return;
    const int64_t z = shape[1], y = shape[2], x = shape[3];
    sum_along(scores, other, z, y * x, reach, sums);
    for (int64_t k = 0; k < z; k++)
        sum_along(other + k * y * x, scores + k * y * x, y, x, reach, sums);
    for (int64_t row = 0; row < z * y; row++) sum_row(scores + row * x, other + row * x, x, reach);
    std::memcpy(scores, other, (size_t)(z * y * x) * sizeof(uint16_t));
}

template <class T>
FHASH_INLINE int64_t levels_of(const T* values, const int64_t* shape, const T* edges,
                               int64_t edge_count, const int32_t* scores, const int32_t* others,
                               int64_t reach, uint8_t* first, uint8_t* second) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        const int64_t n = shape[1] * shape[2] * shape[3];
        std::vector<uint8_t> classes((size_t)n);
        std::vector<uint16_t> one((size_t)n), two((size_t)(reach ? n : 0));
        std::vector<int32_t> sums((size_t)(reach ? std::max<int64_t>(n / shape[1], 1) : 0));
        for (int64_t t = 0; t < shape[0]; t++, values += n, first += n, second += n) {
            std::fill(classes.begin(), classes.end(), (uint8_t)0);
            for (int64_t e = 0; e < edge_count; e++)
                for (int64_t i = 0; i < n; i++) classes[(size_t)i] += values[i] >= edges[e];
            for (int64_t i = 0; i < n; i++) one[(size_t)i] = (uint16_t)scores[classes[(size_t)i]];
            if (!others)
                for (int64_t i = 0; i < n; i++) second[i] = levels.of[one[(size_t)i]] / 2;
            sum_frame(one.data(), two.data(), shape, reach, sums.data());
            for (int64_t i = 0; i < n; i++) first[i] = levels.of[one[(size_t)i]];
            if (!others) continue;
            for (int64_t i = 0; i < n; i++) one[(size_t)i] = (uint16_t)others[classes[(size_t)i]];
            sum_frame(one.data(), two.data(), shape, reach, sums.data());
            for (int64_t i = 0; i < n; i++) second[i] = levels.of[one[(size_t)i]] / 2;
        }
        return 0;
    });
}

FHASH_CLONES int64_t levels_f32(const float* values, const int64_t* shape, const float* edges,
                                int64_t edge_count, const int32_t* scores, const int32_t* others,
                                int64_t reach, uint8_t* first, uint8_t* second) {
    return levels_of(values, shape, edges, edge_count, scores, others, reach, first, second);
}
FHASH_CLONES int64_t levels_f64(const double* values, const int64_t* shape, const double* edges,
                                int64_t edge_count, const int32_t* scores, const int32_t* others,
                                int64_t reach, uint8_t* first, uint8_t* second) {
    return levels_of(values, shape, edges, edge_count, scores, others, reach, first, second);
}

}  // namespace

// The two levels of each vertex of a tile (t, z, y, x), 0 to 31 and 0 to 15.
//
// edges: at most 15, ascending; a value v is in class i if i edges are <= v.
// scores, others: of each class, 0 to 4095; `others` may be null.
// reach: 0 to 64.
//
// Returns 0 or NO_MEMORY.
FHASH_KERNEL int64_t fhash_mask_levels_f32(const float* values, const int64_t* shape,
                                           const float* edges, int64_t edge_count,
                                           const int32_t* scores, const int32_t* others,
                                           int64_t reach, uint8_t* first, uint8_t* second) {
    return levels_f32(values, shape, edges, edge_count, scores, others, reach, first, second);
}
FHASH_KERNEL int64_t fhash_mask_levels_f64(const double* values, const int64_t* shape,
                                           const double* edges, int64_t edge_count,
                                           const int32_t* scores, const int32_t* others,
                                           int64_t reach, uint8_t* first, uint8_t* second) {
    return levels_f64(values, shape, edges, edge_count, scores, others, reach, first, second);
}
