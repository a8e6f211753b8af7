// What a frame's gradients give before rays are marched: smoother values to shade by, and factors
// of opacity by gradient.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "codec.h"
#include "core.hpp"

namespace {

using std::int64_t;

// Add `weight` times the pair of values on both sides of each value of a row. Where one of the two
// is missing, twice the value itself stands for the pair, so that linear values stay as they are.
// Their mean counts twice: the sum of two values near the largest one is infinite.
FHASH_CLONES void add_pairs(const float* row, const float* before, const float* behind,
                            int64_t count, float weight, float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {
        const float mean = 0.5f * before[i] + 0.5f * behind[i];
        sum[i] += 2 * weight * (mean == mean ? mean : row[i]);
    }
}

// Add `weight` times a row.
FHASH_CLONES void add_times(const float* row, int64_t count, float weight,
                            float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) sum[i] += weight * row[i];
}

// The smoothed row `at` of `rows` rows, `stride` apart.
void across(const float* rows, int64_t at, int64_t number, int64_t stride, int64_t count,
            const float* weights, int64_t radius, float* out) {
    const float* const row = rows + at * stride;
    std::fill(out, out + count, 0.f);
    add_times(row, count, weights[0], out);
    for (int64_t k = 1; k <= radius; k++) {
        const bool both = at - k >= 0 && at + k < number;
        if (both) add_pairs(row, row - k * stride, row + k * stride, count, weights[k], out);
        else add_times(row, count, 2 * weights[k], out);
    }
}

// The difference per vertex at one value by its neighbours, of which the missing ones do not count.
double slope(double before, double here, double behind) {
    const bool first = before == before, second = behind == behind;
    if (first && second) return (behind - before) / 2;
    return first ? here - before : second ? behind - here : 0;
}

}  // namespace

// Values smoothed along x and y, for layers first to stop. A missing value stays missing. values,
// out: (z, y, x) of `shape`. weights: (radius + 1,), of a value itself and of those 1, 2 and so on
// away on both sides. scratch: a layer.
FHASH_EXPORT int64_t fhash_march_smooth_layers(const float* values, const int64_t* shape,
                                               const float* weights, int64_t radius, int64_t first,
                                               int64_t stop, float* out, float* scratch) {
    const int64_t ny = shape[1], nx = shape[2];
    for (int64_t z = first; z < stop; z++) {
        for (int64_t y = 0; y < ny; y++) {
            const float* const row = values + (z * ny + y) * nx;
            float* const to = scratch + y * nx;
            std::fill(to, to + nx, 0.f);
            add_times(row, nx, weights[0], to);
            for (int64_t k = 1; k <= radius; k++) {
                const int64_t edge = std::min(k, nx), begin = std::max(nx - k, edge);
                add_times(row, edge, 2 * weights[k], to);
                add_times(row + begin, nx - begin, 2 * weights[k], to + begin);
                if (begin > edge)
                    add_pairs(row + edge, row + edge - k, row + edge + k, begin - edge, weights[k],
                              to + edge);
            }
        }
        for (int64_t y = 0; y < ny; y++)
            across(scratch, y, ny, nx, nx, weights, radius, out + (z * ny + y) * nx);
    }
    return 0;
}

// The same along z, for rows first to stop along y.
FHASH_EXPORT int64_t fhash_march_smooth_rows(const float* values, const int64_t* shape,
                                             const float* weights, int64_t radius, int64_t first,
                                             int64_t stop, float* out) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    for (int64_t y = first; y < stop; y++)
        for (int64_t z = 0; z < nz; z++)
            across(values + y * nx, z, nz, ny * nx, nx, weights, radius, out + (z * ny + y) * nx);
    return 0;
}

// Factors of the extinction by the size of the gradient at vertices, by central differences; 0
// where a value is missing. scale: x, y, z, entries of the table to a difference of 1 per vertex.
// table: (entries + 1,), the last one twice. first, stop: layers. values, out: (z, y, x), of the
// shape `shape`.
FHASH_EXPORT int64_t fhash_march_factors(const float* values, const int64_t* shape,
                                         const double* scale, const float* table, int64_t entries,
                                         int64_t first, int64_t stop, float* out) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    const double none = std::numeric_limits<double>::quiet_NaN();
    for (int64_t z = first; z < stop; z++)
        for (int64_t y = 0; y < ny; y++)
            for (int64_t x = 0; x < nx; x++) {
                const int64_t at = z * layer + y * nx + x;
                const double here = values[at];
                if (!(here == here)) {
                    out[at] = 0;
                    continue;
                }
                const double along_x = slope(x > 0 ? values[at - 1] : none, here,
                                             x + 1 < nx ? values[at + 1] : none);
                const double along_y = slope(y > 0 ? values[at - nx] : none, here,
                                             y + 1 < ny ? values[at + nx] : none);
                const double along_z = slope(z > 0 ? values[at - layer] : none, here,
                                             z + 1 < nz ? values[at + layer] : none);
                const double gx = along_x * scale[0], gy = along_y * scale[1];
                const double gz = along_z * scale[2];
                const double size = std::sqrt(gx * gx + gy * gy + gz * gz);
                const double grade = std::min(size, (double)(entries - 1));
                const int64_t n = (int64_t)grade;
                out[at] = table[n] + (float)(grade - (double)n) * (table[n + 1] - table[n]);
            }
    return 0;
}
