// Products of the lines of a tile along an axis, from which the data's own bases are made.
// Each product of two places is added up line after line, so that every machine gets the same bits,
// and no library for matrices starts threads of its own.
#include "loops.hpp"

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <vector>

#include "codec.h"
#include "core.hpp"
#include "guard.hpp"

namespace {

using std::int64_t;

const int64_t LINES = 64;  // added up at a time, so that they stay in the cache
const int ROWS = 4;        // of the matrix that are summed side by side
const int COLUMNS = 8;     // of the matrix that are summed side by side

// Copy a value about the centre; 0 stands for one that is not finite.
FHASH_INLINE double about(double value, double center) {
    const double moved = value - center;
    return std::fabs(moved) <= DBL_MAX ? moved : 0.0;
}

// Add the products of some lines. lines: (count, width); sums: (width, width), upper triangle of
// squares of ROWS by COLUMNS.
FHASH_INLINE void add_products(const double* FHASH_RESTRICT lines, int64_t count, int64_t width,
                               double* FHASH_RESTRICT sums) {
    for (int64_t i = 0; i < width; i += ROWS)
        for (int64_t j = i / COLUMNS * COLUMNS; j < width; j += COLUMNS) {
            double part[ROWS][COLUMNS];
            for (int r = 0; r < ROWS; r++)
                for (int c = 0; c < COLUMNS; c++) part[r][c] = sums[(i + r) * width + j + c];
            for (int64_t l = 0; l < count; l++) {
                const double* const line = lines + l * width;
                for (int r = 0; r < ROWS; r++)
                    for (int c = 0; c < COLUMNS; c++) part[r][c] += line[i + r] * line[j + c];
            }
            for (int r = 0; r < ROWS; r++)
                for (int c = 0; c < COLUMNS; c++) sums[(i + r) * width + j + c] = part[r][c];
        }
}

template <class T>
FHASH_INLINE int64_t gram(const T* values, int64_t before, int64_t length, int64_t after,
                          double center, double* out) {
    const int64_t width = (length + COLUMNS - 1) / COLUMNS * COLUMNS;
    std::vector<double> sums((size_t)(width * width), 0.0), lines((size_t)(LINES * width), 0.0);
    int64_t filled = 0;
    for (int64_t b = 0; b < before; b++)
        for (int64_t first = 0; first < after;) {
            const int64_t count = std::min(LINES - filled, after - first);
            double* const to = lines.data() + filled * width;
            for (int64_t i = 0; i < length; i++) {
                const T* const from = values + (b * length + i) * after + first;
                for (int64_t l = 0; l < count; l++) to[l * width + i] = about(from[l], center);
            }
            filled += count;
            first += count;
            if (filled == LINES) {
                add_products(lines.data(), filled, width, sums.data());
                filled = 0;
            }
        }
    add_products(lines.data(), filled, width, sums.data());
    for (int64_t i = 0; i < length; i++)
        for (int64_t j = 0; j < length; j++)
            out[i * length + j] = sums[std::min(i, j) * width + std::max(i, j)];
    return 0;
}

FHASH_CLONES int64_t gram_f32(const float* values, int64_t before, int64_t length, int64_t after,
                              double center, double* out) {
    return guarded([&]() FHASH_LAMBDA {
        return gram(values, before, length, after, center, out);
    });
}
FHASH_CLONES int64_t gram_f64(const double* values, int64_t before, int64_t length, int64_t after,
                              double center, double* out) {
    return guarded([&]() FHASH_LAMBDA {
        return gram(values, before, length, after, center, out);
    });
}

}  // namespace

// Write the sums of v v^T over the lines v of values (before, length, after) along the middle axis,
// each value less the centre, and 0 where that is not finite.
//
// out: receives (length, length).
//
// Returns 0, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_gram_f32(const float* values, int64_t before, int64_t length,
                                    int64_t after, double center, double* out) {
    return gram_f32(values, before, length, after, center, out);
}
FHASH_EXPORT int64_t fhash_gram_f64(const double* values, int64_t before, int64_t length,
                                    int64_t after, double center, double* out) {
    return gram_f64(values, before, length, after, center, out);
}
