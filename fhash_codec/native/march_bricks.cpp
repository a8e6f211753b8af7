// What bricks of a frame hold, and how far the next is that matters (fhash_codec/render/bricks.py has the portable twins).
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>

#include "core.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::max;
using std::min;

FHASH_CLONES void extend(const float* row, int64_t count, float* low, float* high) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {  // comparisons with NaN are false: what has no value changes nothing
        low[i] = row[i] < low[i] ? row[i] : low[i];
        high[i] = row[i] > high[i] ? row[i] : high[i];
    }
}

// Vertices of a brick in rows of 8, of which 5 count.
constexpr int SIDE = 4, ROW = 8, LAYER = 5 * ROW, PLACES = 5 * LAYER, ALL = PLACES + LAYER;
using Codes = unsigned char[ALL];

// The least and the most of each place and the one a step behind it.
template <int STEP> FHASH_INLINE void fold(const Codes& least, const Codes& most, Codes& lower, Codes& upper) {
    for (int i = 0; i < PLACES; i++) {
        lower[i] = least[i] < least[i + STEP] ? least[i] : least[i + STEP];
        upper[i] = most[i] > most[i + STEP] ? most[i] : most[i + STEP];
    }
}

// In which cells something can be seen, a bit for each of the four of a row, all of them at its first place.
FHASH_CLONES void visible_cells(const float* values, const float* limits, int64_t count, unsigned char* seen) {
    alignas(64) Codes least = {}, most = {}, lower = {}, upper = {};
    // How many of the limits each value lies beyond: odd where it can be seen. What has no value is 255 for the least, 0 for the most.
    for (int64_t n = 0; n < count; n++) {
        const float low = limits[2 * n], high = limits[2 * n + 1];
        for (int i = 0; i < PLACES; i++) most[i] = (unsigned char)(most[i] + (values[i] > low) + (values[i] >= high));
    }
    for (int i = 0; i < PLACES; i++) least[i] = values[i] == values[i] ? most[i] : 255;
    fold<1>(least, most, lower, upper);
    fold<ROW>(lower, upper, least, most);
    fold<LAYER>(least, most, lower, upper);
    for (int i = 0; i < PLACES; i++)
        most[i] = (unsigned char)(((upper[i] > lower[i]) | ((upper[i] == lower[i]) & upper[i] & 1)) << (i & 3));
    for (int i = 0; i < PLACES; i++) seen[i] = most[i] | most[i + 1] | most[i + 2] | most[i + 3];
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

// In which cells of some bricks of 4 cells something can be seen: bits x + 4 y + 16 z of 64, low half first. values (z, y, x) of `shape`;
// numbers: of the bricks, in rows of `bricks`; limits (count, 2), ascending, count at most 120: what lies strictly between two of them is
// seen; what has no value never is. cells: of all bricks. Returns how many cells.
FHASH_EXPORT int64_t fhash_march_cells(const float* values, const int64_t* shape, const int64_t* bricks, const float* limits, int64_t count,
                                       const int64_t* numbers, int64_t first, int64_t stop, uint32_t* cells) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    if (count < 0 || count > 120) return -1;
    alignas(64) float part[PLACES] = {};
    alignas(64) unsigned char seen[PLACES];
    int64_t found = 0;
    for (int64_t n = first; n < stop; n++) {
        const int64_t brick = numbers[n], x = brick % bricks[2] * SIDE;
        const int64_t y = brick / bricks[2] % bricks[1] * SIDE, z = brick / bricks[2] / bricks[1] * SIDE;
        for (int64_t k = 0; k <= SIDE; k++)
            for (int64_t j = 0; j <= SIDE; j++) {
                const float* const row = values + (min(z + k, nz - 1) * ny + min(y + j, ny - 1)) * nx;
                float* const to = part + k * LAYER + j * ROW;
                if (x + SIDE < nx) std::memcpy(to, row + x, (SIDE + 1) * sizeof(float));
                else for (int64_t i = 0; i <= SIDE; i++) to[i] = row[min(x + i, nx - 1)];
            }
        visible_cells(part, limits, count, seen);
        uint64_t bits = 0;
        for (int c = 0; c < SIDE * SIDE; c++) bits |= (uint64_t)seen[c / SIDE * LAYER + c % SIDE * ROW] << (4 * c);
        cells[2 * brick] = (uint32_t)bits;
        cells[2 * brick + 1] = (uint32_t)(bits >> 32);
        bits -= bits >> 1 & 0x5555555555555555u;  // how many are set
        bits = (bits & 0x3333333333333333u) + (bits >> 2 & 0x3333333333333333u);
        found += (int64_t)(((bits + (bits >> 4)) & 0x0f0f0f0f0f0f0f0fu) * 0x0101010101010101u >> 56);
    }
    return found;
}
