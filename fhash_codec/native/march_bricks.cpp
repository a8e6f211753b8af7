// The value ranges of a frame's bricks, their distances to the nearest that matters, and the
// visible cells in them.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>

#include "codec.h"
#include "core.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::max;
using std::min;

// Extend the range at each place of a row by its values.
FHASH_CLONES void extend(const float* row, int64_t count, float* low, float* high) {
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < count; i++) {  // comparisons with NaN are false: it changes nothing
        low[i] = row[i] < low[i] ? row[i] : low[i];
        high[i] = row[i] > high[i] ? row[i] : high[i];
    }
}

// The 5 x 5 x 5 vertices of a brick lie in rows of 8 places, of which 5 are used.
constexpr int SIDE = 4;              // cells of a brick
constexpr int ROW = 8;               // places from a row to the next
constexpr int LAYER = 5 * ROW;       // places from a layer to the next
constexpr int PLACES = 5 * LAYER;    // places of a brick
constexpr int ALL = PLACES + LAYER;  // places that `fold` reads
constexpr int MAX_LIMITS = 120;      // intervals of visible values, so that a code is at most 240
constexpr unsigned char NO_VALUE = 255;
using Codes = unsigned char[ALL];

// The smaller and the larger codes of each place and the one STEP places on.
template <int STEP>
FHASH_INLINE void fold(const Codes& least, const Codes& most, Codes& lower, Codes& upper) {
    for (int i = 0; i < PLACES; i++) {
        lower[i] = least[i] < least[i + STEP] ? least[i] : least[i + STEP];
        upper[i] = most[i] > most[i + STEP] ? most[i] : most[i + STEP];
    }
}

// The visible cells of a brick. A code has a bit for each of the four cells of a row; the code of a
// row is at the row's first place.
FHASH_CLONES void visible_cells(const float* values, const float* limits, int64_t count,
                                unsigned char* seen) {
    alignas(64) Codes least = {}, most = {}, lower = {}, upper = {};
    // The code of a value is the number of limits that it lies beyond: odd where it is visible. A
    // vertex without a value has NO_VALUE as its least and 0 as its most code.
    for (int64_t n = 0; n < count; n++) {
        const float low = limits[2 * n], high = limits[2 * n + 1];
        for (int i = 0; i < PLACES; i++)
            most[i] = (unsigned char)(most[i] + (values[i] > low) + (values[i] >= high));
    }
    for (int i = 0; i < PLACES; i++) least[i] = values[i] == values[i] ? most[i] : NO_VALUE;
    fold<1>(least, most, lower, upper);
    fold<ROW>(lower, upper, least, most);
    fold<LAYER>(least, most, lower, upper);
    // Visible: a cell with two codes has a visible value between them.
    for (int i = 0; i < PLACES; i++) {
        const int visible = (upper[i] > lower[i]) | ((upper[i] == lower[i]) & upper[i] & 1);
        most[i] = (unsigned char)(visible << (i & 3));
    }
    for (int i = 0; i < PLACES; i++) seen[i] = most[i] | most[i + 1] | most[i + 2] | most[i + 3];
}

// The least number, over all lines at most r away, of the larger of r and the line's number there:
// the chessboard distance along one more axis. lines: `count` of them, `stride` apart, of `length`
// numbers. out: of line `at`.
void spread(const int32_t* lines, int64_t count, int64_t stride, int64_t length, int64_t at,
            int32_t* FHASH_RESTRICT out) {
    std::memcpy(out, lines + at * stride, (size_t)length * sizeof(int32_t));
    for (int64_t r = 1; r < count; r++) {
        int32_t most = 0;
        for (int64_t i = 0; i < length; i++) most = max(most, out[i]);
        if (most <= r) return;
        const int64_t sides[] = {at - r, at + r};
        for (const int64_t side : sides) {
            if (side < 0 || side >= count) continue;
            const int32_t* const line = lines + side * stride;
            for (int64_t i = 0; i < length; i++)
                out[i] = min(out[i], max((int32_t)r, line[i]));
        }
    }
}

// The number of bits that are set.
int64_t bit_count(uint64_t bits) {
    bits -= bits >> 1 & 0x5555555555555555u;
    bits = (bits & 0x3333333333333333u) + (bits >> 2 & 0x3333333333333333u);
    return (int64_t)(((bits + (bits >> 4)) & 0x0f0f0f0f0f0f0f0fu) * 0x0101010101010101u >> 56);
}

}  // namespace

// The smallest and the largest value of bricks, the vertices of their faces included; infinity and
// minus infinity where a brick has no value. values: (z, y, x) of `shape`. strides: values from a
// layer to the next and from a row to the next. side: cells of a brick. first, stop: layers of
// bricks. low, high: (z, y, x) of `bricks`. scratch: 2 rows of x.
FHASH_EXPORT int64_t fhash_march_bricks(const float* values, const int64_t* shape,
                                        const int64_t* strides, const int64_t* bricks,
                                        int64_t side, int64_t first, int64_t stop, float* low,
                                        float* high, float* scratch) {
    const float far = std::numeric_limits<float>::infinity();
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    float* const least = scratch;
    float* const most = scratch + nx;
    for (int64_t bz = first; bz < stop; bz++)
        for (int64_t by = 0; by < bricks[1]; by++) {
            std::fill(least, least + nx, far);
            std::fill(most, most + nx, -far);
            for (int64_t z = bz * side; z < min(bz * side + side + 1, nz); z++)
                for (int64_t y = by * side; y < min(by * side + side + 1, ny); y++)
                    extend(values + z * strides[0] + y * strides[1], nx, least, most);
            for (int64_t bx = 0; bx < bricks[2]; bx++) {
                const int64_t at = (bz * bricks[1] + by) * bricks[2] + bx;
                const int64_t end = min(bx * side + side + 1, nx);
                low[at] = *std::min_element(least + bx * side, least + end);
                high[at] = *std::max_element(most + bx * side, most + end);
            }
        }
    return 0;
}

// The chessboard distance (z, y, x) to the nearest 0 is found along x and y in layers, and then
// along z in rows of every layer. On entry every number is 0 or larger than any distance.
// first, stop: layers. lines: a layer of scratch.
FHASH_EXPORT int64_t fhash_march_distance_layers(const int64_t* shape, int32_t* distance,
                                                 int64_t first, int64_t stop, int32_t* lines) {
    const int64_t ny = shape[1], nx = shape[2];
    for (int64_t z = first; z < stop; z++) {
        int32_t* const layer = distance + z * ny * nx;
        for (int64_t y = 0; y < ny; y++) {
            int32_t* const row = layer + y * nx;
            for (int64_t x = 1; x < nx; x++) row[x] = min(row[x], row[x - 1] + 1);
            for (int64_t x = nx - 2; x >= 0; x--) row[x] = min(row[x], row[x + 1] + 1);
        }
        std::copy_n(layer, ny * nx, lines);
        for (int64_t y = 0; y < ny; y++) spread(lines, ny, nx, nx, y, layer + y * nx);
    }
    return 0;
}

// The same along z, after all layers. first, stop: rows along y. lines: nz rows of scratch.
FHASH_EXPORT int64_t fhash_march_distance_rows(const int64_t* shape, int32_t* distance,
                                               int64_t first, int64_t stop, int32_t* lines) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    for (int64_t y = first; y < stop; y++) {
        for (int64_t z = 0; z < nz; z++)
            std::copy_n(distance + (z * ny + y) * nx, nx, lines + z * nx);
        for (int64_t z = 0; z < nz; z++)
            spread(lines, nz, nx, nx, z, distance + (z * ny + y) * nx);
    }
    return 0;
}

// The visible cells of bricks. A brick has a bit x + 4 y + 16 z for each cell, of 64, the lower
// half first. values: (z, y, x) of `shape`. limits: (count, 2), ascending, at most MAX_LIMITS:
// values strictly between two of them are visible. numbers: of bricks, in rows of `bricks`, from
// `first` to `stop`. cells: two words for every brick of the frame. Returns the number of visible
// cells.
FHASH_EXPORT int64_t fhash_march_cells(const float* values, const int64_t* shape,
                                       const int64_t* bricks, const float* limits, int64_t count,
                                       const int64_t* numbers, int64_t first, int64_t stop,
                                       uint32_t* cells) {
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2];
    if (count < 0 || count > MAX_LIMITS) return -1;
    alignas(64) float vertices[PLACES] = {};
    alignas(64) unsigned char seen[PLACES];
    int64_t visible = 0;
    for (int64_t n = first; n < stop; n++) {
        const int64_t brick = numbers[n], x = brick % bricks[2] * SIDE;
        const int64_t y = brick / bricks[2] % bricks[1] * SIDE;
        const int64_t z = brick / bricks[2] / bricks[1] * SIDE;
        for (int64_t k = 0; k <= SIDE; k++)
            for (int64_t j = 0; j <= SIDE; j++) {
                const int64_t layer = min(z + k, nz - 1);
                const float* const row = values + (layer * ny + min(y + j, ny - 1)) * nx;
                float* const to = vertices + k * LAYER + j * ROW;
                if (x + SIDE < nx) std::memcpy(to, row + x, (SIDE + 1) * sizeof(float));
                else for (int64_t i = 0; i <= SIDE; i++) to[i] = row[min(x + i, nx - 1)];
            }
        visible_cells(vertices, limits, count, seen);
        uint64_t bits = 0;
        for (int c = 0; c < SIDE * SIDE; c++)
            bits |= (uint64_t)seen[c / SIDE * LAYER + c % SIDE * ROW] << (4 * c);
        cells[2 * brick] = (uint32_t)bits;
        cells[2 * brick + 1] = (uint32_t)(bits >> 32);
        visible += bit_count(bits);
    }
    return visible;
}
