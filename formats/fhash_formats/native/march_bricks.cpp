// What bricks of a frame hold, and how far the next is that matters (fhash_codec/render/bricks.py has the portable twins).
#include <algorithm>
#include <cstdint>
#include <limits>

#include "core.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::max;
using std::min;

FHASH_CLONES void extend(const float* row, int64_t count, float* low, float* high) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {  // comparisons with NaN are false: what has no value changes nothing
        low[i] = row[i] < low[i] ? row[i] : low[i];
        high[i] = row[i] > high[i] ? row[i] : high[i];
    }
}

}  // namespace

// The smallest and largest value of layers first to stop of bricks of `side` cells, the vertices of their faces included; infinity and
// minus infinity where a brick has no value. values (z, y, x) of `shape`; low, high (z, y, x) of `bricks`; scratch: 2 rows of x.
FHASH_EXPORT int64_t fhash_march_bricks(const float* values, const int64_t* shape, const int64_t* bricks, int64_t side, int64_t first,
                                        int64_t stop, float* low, float* high, float* scratch) {
    const float far = std::numeric_limits<float>::infinity();
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    float* const least = scratch;
    float* const most = scratch + nx;
    for (int64_t bz = first; bz < stop; bz++)
        for (int64_t by = 0; by < bricks[1]; by++) {
            std::fill(least, least + nx, far);
            std::fill(most, most + nx, -far);
            for (int64_t z = bz * side; z < min(bz * side + side + 1, nz); z++)
                for (int64_t y = by * side; y < min(by * side + side + 1, ny); y++) extend(values + (z * ny + y) * nx, nx, least, most);
            for (int64_t bx = 0; bx < bricks[2]; bx++) {
                const int64_t at = (bz * bricks[1] + by) * bricks[2] + bx, end = min(bx * side + side + 1, nx);
                low[at] = *std::min_element(least + bx * side, least + end);
                high[at] = *std::max_element(most + bx * side, most + end);
            }
        }
    return 0;
}

// The chessboard distance (z, y, x) to the nearest 0: two sweeps, each from the neighbours that come before. In: 0 or a number above all.
FHASH_EXPORT int64_t fhash_march_distance(const int64_t* shape, int32_t* distance) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    for (int turn = 0; turn < 2; turn++) {
        const int64_t way = turn ? 1 : -1;
        for (int64_t zz = 0; zz < nz; zz++)
            for (int64_t yy = 0; yy < ny; yy++)
                for (int64_t xx = 0; xx < nx; xx++) {
                    const int64_t z = turn ? nz - 1 - zz : zz, y = turn ? ny - 1 - yy : yy, x = turn ? nx - 1 - xx : xx;
                    int32_t& here = distance[(z * ny + y) * nx + x];
                    if (here == 0) continue;
                    int32_t least = here - 1;
                    for (int n = 0; n < 13; n++) {  // the 13 neighbours before this one in the order of the sweep
                        const int64_t dz = n < 9 ? way : 0, dy = n < 9 ? n / 3 - 1 : n < 12 ? way : 0, dx = n < 9 ? n % 3 - 1 : n < 12 ? n - 10 : way;
                        const int64_t c = z + dz, r = y + dy, i = x + dx;
                        if (c < 0 || c >= nz || r < 0 || r >= ny || i < 0 || i >= nx) continue;
                        least = min(least, distance[(c * ny + r) * nx + i]);
                    }
                    here = least + 1;
                }
    }
    return 0;
}
