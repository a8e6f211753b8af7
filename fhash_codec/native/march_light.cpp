// The light that the volume takes away.
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "codec.h"
#include "core.hpp"

namespace {

using std::int64_t;

// Add `weight` times the extinctions of a row of values, linear between the entries of a table; a
// missing value adds nothing. last: number of the last entry. factors: of each extinction; or null.
FHASH_CLONES void add_extinctions(const float* FHASH_RESTRICT row, int64_t count,
                                  const float* FHASH_RESTRICT table, float last, float low,
                                  float scale, float weight, const float* factors,
                                  float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {
        const float entry = (row[i] - low) * scale, least = entry > 0 ? entry : 0;
        const float at = least < last ? least : last;
        const int n = (int)at;
        const float extinction = table[n] + (at - (float)n) * (table[n + 1] - table[n]);
        const float factor = factors ? factors[i] : 1;
        sum[i] += row[i] == row[i] ? weight * extinction * factor : 0;
    }
}

// Add `weight` times a row.
FHASH_CLONES void add_row(const float* FHASH_RESTRICT row, int64_t count, float weight,
                          float* FHASH_RESTRICT sum) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) sum[i] += weight * row[i];
}

int64_t within(int64_t i, int64_t count) { return i < 0 ? 0 : i < count ? i : count - 1; }

}  // namespace

// Extinctions at the points of a grid, which lie `cell` vertices apart: means of the vertices
// around each, weighed by a tent. values: (z, y, x) of `shape`. table: (entries + 1,), the last one
// twice; the entry of a value is (value - low) * scale. first, stop: layers of points. factors: (z,
// y, x) of `shape`, of the extinctions at the vertices; or null. out: (z, y, x) of `points`.
// scratch: a row of x.
FHASH_EXPORT int64_t fhash_march_extinction(const float* values, const int64_t* shape,
                                            const float* table, int64_t entries, double low,
                                            double scale, int64_t cell, const int64_t* points,
                                            int64_t first, int64_t stop, const float* factors,
                                            float* out, float* scratch) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], reach = cell - 1;
    for (int64_t z = first; z < stop; z++)
        for (int64_t y = 0; y < points[1]; y++) {
            for (int64_t x = 0; x < nx; x++) scratch[x] = 0;
            for (int64_t c = -reach; c <= reach; c++)
                for (int64_t b = -reach; b <= reach; b++) {
                    const int64_t tent = (cell - std::llabs(c)) * (cell - std::llabs(b));
                    const double weight = (double)tent / (double)(cell * cell * cell * cell);
                    const int64_t row = within(z * cell + c, nz) * ny + within(y * cell + b, ny);
                    add_extinctions(values + row * nx, nx, table, (float)(entries - 1), (float)low,
                                    (float)scale, (float)weight,
                                    factors ? factors + row * nx : nullptr, scratch);
                }
            float* row = out + (z * points[1] + y) * points[2];
            for (int64_t x = 0; x < points[2]; x++) {
                double sum = 0;
                for (int64_t a = -reach; a <= reach; a++)
                    sum += (double)(cell - std::llabs(a)) * scratch[within(x * cell + a, nx)];
                row[x] = (float)(sum / (double)(cell * cell));
            }
        }
    return 0;
}

// Sums of the extinctions at `count` places on the way from each point: half a step away and then a
// step apart. Extinctions are trilinear between the points and 0 beyond the grid. All points have
// the same offsets, so that the places of a row are a shifted row. extinction, out: (z, y, x) of
// `points`. step: x, y, z, in cells of the grid. first, stop: layers of points.
FHASH_EXPORT int64_t fhash_march_sum(const float* extinction, const int64_t* points,
                                     const double* step, int64_t count, int64_t first, int64_t stop,
                                     float* out) {
    const int64_t nz = points[0], ny = points[1], nx = points[2];
    for (int64_t z = first; z < stop; z++)
        for (int64_t y = 0; y < ny; y++) {
            float* sum = out + (z * ny + y) * nx;
            for (int64_t x = 0; x < nx; x++) sum[x] = 0;
            for (int64_t k = 0; k < count; k++) {
                const double px = (k + 0.5) * step[0], py = (k + 0.5) * step[1];
                const double pz = (k + 0.5) * step[2];
                const int64_t i = (int64_t)std::floor(px), j = (int64_t)std::floor(py);
                const int64_t h = (int64_t)std::floor(pz);
                const double fx = px - (double)i, fy = py - (double)j, fz = pz - (double)h;
                const int64_t c = z + h, b = y + j, begin = i < 0 ? -i : 0;
                const int64_t stop_x = nx - i - (fx > 0), end = stop_x < nx ? stop_x : nx;
                const bool beyond = c < 0 || c + (fz > 0) >= nz || b < 0 || b + (fy > 0) >= ny;
                if (beyond || begin >= end) continue;
                for (int n = 0; n < 8; n++) {  // the corners around the places
                    const double weight =
                        (n & 1 ? fx : 1 - fx) * (n & 2 ? fy : 1 - fy) * (n & 4 ? fz : 1 - fz);
                    if (weight == 0) continue;
                    const int64_t row = (c + (n >> 2)) * ny + b + (n >> 1 & 1);
                    add_row(extinction + row * nx + begin + i + (n & 1), end - begin, (float)weight,
                            sum + begin);
                }
            }
        }
    return 0;
}
