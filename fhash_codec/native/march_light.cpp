// What the volume leaves of light (fhash_codec/render/light.py has the portable twins, of the same picture within rounding).
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "core.hpp"

namespace {

using std::int64_t;

// Add `weight` times the extinction of a row of values, linear between entries of the table, none where there is no value.
FHASH_CLONES void add_extinctions(const float* FHASH_RESTRICT row, int64_t count, const float* FHASH_RESTRICT table, float last, float low, float scale, float weight, float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {
        const float e = (row[i] - low) * scale, some = e > 0 ? e : 0, at = some < last ? some : last;
        const int n = (int)at;
        const float found = table[n] + (at - (float)n) * (table[n + 1] - table[n]);
        sum[i] += row[i] == row[i] ? weight * found : 0;
    }
}

FHASH_CLONES void add_row(const float* FHASH_RESTRICT row, int64_t count, float weight, float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) sum[i] += weight * row[i];
}

int64_t within(int64_t i, int64_t count) { return i < 0 ? 0 : i < count ? i : count - 1; }

}  // namespace

// Extinctions of layers first to stop of a grid with `cell` vertices between its points: means of what is around, weighed by a tent.
// values (z, y, x) of `shape`; table (entries + 1,), the last twice; out (z, y, x) of `points`; scratch: a row of x.
FHASH_EXPORT int64_t fhash_march_extinction(const float* values, const int64_t* shape, const float* table, int64_t entries, double low,
                                            double scale, int64_t cell, const int64_t* points, int64_t first, int64_t stop, float* out,
                                            float* scratch) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], reach = cell - 1;
    for (int64_t z = first; z < stop; z++)
        for (int64_t y = 0; y < points[1]; y++) {
            for (int64_t x = 0; x < nx; x++) scratch[x] = 0;
            for (int64_t c = -reach; c <= reach; c++)
                for (int64_t b = -reach; b <= reach; b++) {
                    const double weight = (double)((cell - std::llabs(c)) * (cell - std::llabs(b))) / (double)(cell * cell * cell * cell);
                    add_extinctions(values + (within(z * cell + c, nz) * ny + within(y * cell + b, ny)) * nx, nx, table, (float)(entries - 1),
                                    (float)low, (float)scale, (float)weight, scratch);
                }
            float* row = out + (z * points[1] + y) * points[2];
            for (int64_t x = 0; x < points[2]; x++) {
                double sum = 0;
                for (int64_t a = -reach; a <= reach; a++) sum += (double)(cell - std::llabs(a)) * scratch[within(x * cell + a, nx)];
                row[x] = (float)(sum / (double)(cell * cell));
            }
        }
    return 0;
}

// The sum of extinctions at `count` places from each point of layers first to stop, half a step and then whole steps apart, trilinear and 0
// beyond the grid. Every point has the same offsets, so that a place is a shifted row. extinction, out (z, y, x) of `points`; step x, y, z.
FHASH_EXPORT int64_t fhash_march_sum(const float* extinction, const int64_t* points, const double* step, int64_t count, int64_t first,
                                     int64_t stop, float* out) {
    const int64_t nz = points[0], ny = points[1], nx = points[2];
    for (int64_t z = first; z < stop; z++)
        for (int64_t y = 0; y < ny; y++) {
            float* sum = out + (z * ny + y) * nx;
            for (int64_t x = 0; x < nx; x++) sum[x] = 0;
            for (int64_t k = 0; k < count; k++) {
                const double place[3] = {(k + 0.5) * step[0], (k + 0.5) * step[1], (k + 0.5) * step[2]};
                const int64_t i = (int64_t)std::floor(place[0]), j = (int64_t)std::floor(place[1]), h = (int64_t)std::floor(place[2]);
                const double fx = place[0] - (double)i, fy = place[1] - (double)j, fz = place[2] - (double)h;
                const int64_t c = z + h, b = y + j, begin = i < 0 ? -i : 0, stop_x = nx - i - (fx > 0), end = stop_x < nx ? stop_x : nx;
                if (c < 0 || c + (fz > 0) >= nz || b < 0 || b + (fy > 0) >= ny || begin >= end) continue;
                for (int n = 0; n < 8; n++) {
                    const double weight = (n & 1 ? fx : 1 - fx) * (n & 2 ? fy : 1 - fy) * (n & 4 ? fz : 1 - fz);
                    if (weight == 0) continue;
                    add_row(extinction + ((c + (n >> 2)) * ny + b + (n >> 1 & 1)) * nx + begin + i + (n & 1), end - begin, (float)weight, sum + begin);
                }
            }
        }
    return 0;
}
