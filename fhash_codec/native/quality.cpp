// Figures of how far decoded values are from the original: sums of squared errors, and structural
// similarity (Wang et al. 2004).
//
// fhash_scan and fhash_errors add in a stated order, so that every machine gets the same bits:
// value i of a piece of PIECE values goes to lane i % LANES; the lanes are added up in order, then
// the pieces.
#include "loops.hpp"

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "codec.h"
#include "core.hpp"
#include "guard.hpp"

namespace {

using std::int64_t;
using std::uint8_t;

const int LANES = 256;
const int64_t PIECE = 1 << 14;
const int RADIUS = 5;  // of the window, in vertices
const int TAPS = 2 * RADIUS + 1;
const int FIELDS = 4;  // of a filtered plane
const int FIGURES = 4;  // of a row that is scanned
const int ERRORS = 5;  // figures of a row that is compared

FHASH_INLINE double lane_sum(const double* lanes) {
    double sum = 0;
    for (int lane = 0; lane < LANES; lane++) sum += lanes[lane];
    return sum;
}

// result: the number of the finite values, their least, their greatest, and the sum of
// value * factor.
template <class T>
FHASH_INLINE void scan(const T* values, int64_t n, double factor, double* result) {
    const T largest = sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX;
    int64_t count = 0;
    double total = 0;
    T lows[LANES], highs[LANES];
    for (int lane = 0; lane < LANES; lane++) {
        lows[lane] = (T)INFINITY;
        highs[lane] = (T)-INFINITY;
    }
    for (int64_t start = 0; start < n; start += PIECE) {
        const int64_t stop = std::min(start + PIECE, n);
        double sums[LANES] = {0};
        for (int64_t i = start; i < stop; i += LANES) {
            const int width = (int)std::min<int64_t>(LANES, stop - i);
            const T* const at = values + i;
            int finite_here = 0;
            for (int lane = 0; lane < width; lane++) {
                const T value = at[lane];
                const bool finite = (value < 0 ? -value : value) <= largest;
                const T low = finite ? value : (T)INFINITY, high = finite ? value : (T)-INFINITY;
                lows[lane] = low < lows[lane] ? low : lows[lane];
                highs[lane] = high > highs[lane] ? high : highs[lane];
                const double wide = (double)value * factor;
                sums[lane] += finite ? wide : 0.0;
                finite_here += finite;
            }
            count += finite_here;
        }
        total += lane_sum(sums);
    }
    result[0] = (double)count;
    result[1] = *std::min_element(lows, lows + LANES);
    result[2] = *std::max_element(highs, highs + LANES);
    result[3] = total;
}

// result: the number of the values that count, those with a finite original where `mask`, if any,
// is set, or -1 where a difference is not finite; the sum of the squares of (original - decoded) *
// scale, and its largest magnitude. With BULK also the number and the sum of those whose original
// lies from `low` to `high`.
template <class T, bool MASKED, bool BULK>
FHASH_INLINE void errors(const T* original, const T* decoded, const uint8_t* mask, int64_t n,
                         double scale, double low, double high, double* result) {
    const T limit = sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX;
    int64_t count = 0, bulk_count = 0;
    double total = 0, largest = 0, bulk_total = 0;
    for (int64_t start = 0; start < n; start += PIECE) {
        const int64_t stop = std::min(start + PIECE, n);
        double sums[LANES] = {0}, most[LANES] = {0}, wrong[LANES] = {0}, bulk_sums[LANES] = {0};
        for (int64_t i = start; i < stop; i += LANES) {
            const int width = (int)std::min<int64_t>(LANES, stop - i);
            const T *const ones = original + i, *const others = decoded + i;
            const uint8_t* const chosen = MASKED ? mask + i : nullptr;
            int counted_here = 0, bulk_here = 0;
            for (int lane = 0; lane < width; lane++) {
                const T one = ones[lane];
                const bool finite = (one < 0 ? -one : one) <= limit;
                const bool counted = finite & (!MASKED || chosen[lane] != 0);
                const T first = counted ? one : (T)0, second = counted ? others[lane] : (T)0;
                const double difference = (double)first * scale - (double)second * scale;
                const double size = std::fabs(difference);
                const double square = difference * difference;
                sums[lane] += square;
                most[lane] = size > most[lane] ? size : most[lane];
                wrong[lane] += difference - difference;  // 0, or NaN for good
                counted_here += counted;
                if (BULK) {
                    const bool inside = counted & ((double)one >= low) & ((double)one <= high);
                    bulk_sums[lane] += inside ? square : 0.0;
                    bulk_here += inside;
                }
            }
            count += counted_here;
            bulk_count += bulk_here;
        }
        total += lane_sum(sums);
        if (BULK) bulk_total += lane_sum(bulk_sums);
        for (int lane = 0; lane < LANES; lane++) {
            if (wrong[lane] != 0) {
                result[0] = -1;
                return;
            }
            largest = std::max(largest, most[lane]);
        }
    }
    result[0] = (double)count;
    result[1] = total;
    result[2] = largest;
    result[3] = (double)bulk_count;
    result[4] = bulk_total;
}

// The same of rows of n values each. Without a bulk, low is greater than high.
template <class T>
FHASH_INLINE void errors_of_rows(const T* one, const T* other, const uint8_t* mask, int64_t rows,
                                 int64_t n, double scale, double low, double high,
                                 double* result) {
    const bool bulk = low <= high;
    for (int64_t row = 0; row < rows; row++, one += n, other += n, result += ERRORS) {
        const uint8_t* const set = mask ? mask + row * n : nullptr;
        if (mask && bulk) errors<T, true, true>(one, other, set, n, scale, low, high, result);
        else if (mask) errors<T, true, false>(one, other, set, n, scale, 0, 0, result);
        else if (bulk) errors<T, false, true>(one, other, nullptr, n, scale, low, high, result);
        else errors<T, false, false>(one, other, nullptr, n, scale, 0, 0, result);
    }
}

// Add n values to a histogram of equal bins, of which the first begins at `low`, after scaling;
// factor: bins per unit. Values beyond either end go to the bin there, so that ranks stay right.
template <class T>
FHASH_INLINE int64_t histogram(const T* values, int64_t n, double scale, double low, double factor,
                               int64_t bins, int64_t* counts) {
    const T largest = sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX;
    const double last = (double)(bins - 1);
    int64_t count = 0;
    for (int64_t i = 0; i < n; i++) {
        const T value = values[i];
        if (!((value < 0 ? -value : value) <= largest)) continue;
        const double place = ((double)value * scale - low) * factor;
        counts[(int64_t)(place < 0 ? 0.0 : place > last ? last : place)]++;
        count++;
    }
    return count;
}

FHASH_INLINE int64_t mirrored(int64_t i, int64_t size) {
    i %= 2 * size;
    if (i < 0) i += 2 * size;
    return i < size ? i : 2 * size - 1 - i;
}

// Two frames to compare: how their values are scaled, and the constants of the measure.
struct Frame {
    int64_t shape[3];
    const uint8_t* mask;
    double scale, mean, c1, c2;
    double weights[RADIUS + 1];  // of the window, from its middle outwards
};

Frame make_frame(const uint8_t* mask, const int64_t* shape, const double* numbers) {
    Frame frame;
    std::memcpy(frame.shape, shape, sizeof frame.shape);
    frame.mask = mask;
    frame.scale = numbers[0];
    frame.mean = numbers[1];
    frame.c1 = numbers[2];
    frame.c2 = numbers[3];
    std::memcpy(frame.weights, numbers + 4, sizeof frame.weights);
    return frame;
}

// The weights of the window, in a local copy, so that no loop has to read them again after a store.
struct Weights {
    double w[RADIUS + 1];
    explicit FHASH_INLINE Weights(const Frame& frame) {
        for (int k = 0; k <= RADIUS; k++) w[k] = frame.weights[k];
    }
    FHASH_INLINE double operator[](int k) const { return w[k]; }
};

// The window's weighted sum of the values `stride` apart, of which `q` is the first.
FHASH_INLINE double windowed(const Weights& w, const double* q, int64_t stride) {
    return w[0] * q[5 * stride] + w[1] * (q[4 * stride] + q[6 * stride]) +
           w[2] * (q[3 * stride] + q[7 * stride]) + w[3] * (q[2 * stride] + q[8 * stride]) +
           w[4] * (q[stride] + q[9 * stride]) + w[5] * (q[0] + q[10 * stride]);
}

// The comparison of a tile of two frames. Planes of the tile and the window around it are filtered
// along x and y, one after the other; a ring of the last TAPS of them is filtered along z. A plane
// has FIELDS fields: both values, the sum of their squares, and their product.
template <class T> struct Comparison {
    const T *const original, *const decoded;
    const Frame& frame;
    const int64_t* const tile;  // first and stop along z, y and x
    const int64_t ny, nx;       // vertices of the tile
    const int64_t wy, wx;       // vertices of the tile and the window around it
    const int64_t plane;        // numbers of a field of a filtered plane
    std::vector<double> ring, rows, line, sums;
    std::vector<int64_t> columns;  // of the frame, mirrored at its borders
    bool inner;                    // whether no column is mirrored

    Comparison(const T* one, const T* other, const Frame& both, const int64_t* ends)
        : original(one), decoded(other), frame(both), tile(ends), ny(tile[3] - tile[2]),
          nx(tile[5] - tile[4]), wy(ny + 2 * RADIUS), wx(nx + 2 * RADIUS), plane(ny * nx),
          ring((size_t)(TAPS * FIELDS * plane)), rows((size_t)(FIELDS * wy * nx)),
          line((size_t)(FIELDS * wx)), sums((size_t)(FIELDS * nx)), columns((size_t)wx) {
        for (int64_t x = 0; x < wx; x++)
            columns[x] = mirrored(tile[4] - RADIUS + x, frame.shape[2]);
        inner = columns[0] == tile[4] - RADIUS && columns[wx - 1] == tile[5] + RADIUS - 1;
    }

    static FHASH_INLINE bool finite(T value) {
        return (value < 0 ? -value : value) <= (sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX);
    }

    // Load the fields of a row of the frame that begins at `row`. False where a decoded value that
    // is compared is not finite.
    FHASH_INLINE bool load(int64_t row) {
        // Local copies, so that no loop has to read them again after a store.
        const T *const ones = original, *const others = decoded;
        const uint8_t* const mask = frame.mask;
        const double scale = frame.scale, mean = frame.mean;
        double *const a = line.data(), *const b = a + wx, *const squares = b + wx;
        double* const products = squares + wx;
        int wrong = 0;
        const auto fill = [&](int64_t x, int64_t at) FHASH_LAMBDA {
            const T one = ones[at];
            const bool known = finite(one);
            const double first = known ? (double)one * scale - mean : 0.0;
            const bool other = known && (!mask || mask[at]);
            const double second = other ? (double)others[at] * scale - mean : first;
            wrong |= !(std::fabs(second) <= DBL_MAX);
            a[x] = first;
            b[x] = second;
            squares[x] = first * first + second * second;
            products[x] = first * second;
        };
        const int64_t first = row + tile[4] - RADIUS, count = wx;
        const int64_t* const mirror = columns.data();
        if (inner) for (int64_t x = 0; x < count; x++) fill(x, first + x);
        else for (int64_t x = 0; x < count; x++) fill(x, row + mirror[x]);
        return !wrong;
    }

    double* filtered_plane(int64_t number) { return ring.data() + number % TAPS * FIELDS * plane; }

    // Filter plane z of the frame along x and y, into the ring. False as `load`.
    FHASH_INLINE bool filter_plane(int64_t z) {
        const Weights w(frame);
        const int64_t source_z = mirrored(z, frame.shape[0]);
        const int64_t Y = frame.shape[1], X = frame.shape[2];
        const int64_t width = nx, stride = wx;
        for (int64_t y = 0; y < wy; y++) {
            if (!load((source_z * Y + mirrored(tile[2] - RADIUS + y, Y)) * X)) return false;
            for (int f = 0; f < FIELDS; f++) {
                const double* const p = line.data() + f * stride;
                double* const out = rows.data() + (f * wy + y) * width;
                FHASH_INDEPENDENT
                for (int64_t x = 0; x < width; x++) out[x] = windowed(w, p + x, 1);
            }
        }
        double* const into = filtered_plane(z - tile[0] + RADIUS);
        for (int f = 0; f < FIELDS; f++)
            for (int64_t y = 0; y < ny; y++) {
                const double* const p = rows.data() + (f * wy + y) * width;
                double* const out = into + f * plane + y * width;
                FHASH_INDEPENDENT
                for (int64_t x = 0; x < width; x++) out[x] = windowed(w, p + x, width);
            }
        return true;
    }

    // Filter row y of plane z of the tile along z, into `sums`.
    FHASH_INLINE void filter_row(int64_t z, int64_t y) {
        const Weights w(frame);
        const int64_t width = nx;
        const double* planes[TAPS];
        for (int k = 0; k < TAPS; k++) planes[k] = filtered_plane(z - tile[0] + k);
        for (int f = 0; f < FIELDS; f++) {
            const int64_t at = f * plane + y * width;
            const double *const p0 = planes[0] + at, *const p1 = planes[1] + at;
            const double *const p2 = planes[2] + at, *const p3 = planes[3] + at;
            const double *const p4 = planes[4] + at, *const p5 = planes[5] + at;
            const double *const p6 = planes[6] + at, *const p7 = planes[7] + at;
            const double *const p8 = planes[8] + at, *const p9 = planes[9] + at;
            const double* const p10 = planes[10] + at;
            double* const out = sums.data() + f * width;
            FHASH_INDEPENDENT
            for (int64_t x = 0; x < width; x++)
                out[x] = w[0] * p5[x] + w[1] * (p4[x] + p6[x]) + w[2] * (p3[x] + p7[x]) +
                         w[3] * (p2[x] + p8[x]) + w[4] * (p1[x] + p9[x]) + w[5] * (p0[x] + p10[x]);
        }
    }

    // Add the local similarity of the vertices of a row that count. row: of its first vertex.
    FHASH_INLINE void add_row(int64_t row, double& total, int64_t& count) {
        const int64_t width = nx;
        const double *const a = sums.data(), *const b = a + width, *const squares = b + width;
        const double* const products = squares + width;
        double* const local = line.data();
        const double mean = frame.mean, c1 = frame.c1, c2 = frame.c2;
        FHASH_INDEPENDENT
        for (int64_t x = 0; x < width; x++) {
            const double covariance = products[x] - a[x] * b[x];
            const double variances = squares[x] - a[x] * a[x] - b[x] * b[x];
            const double one = a[x] + mean, other = b[x] + mean;
            const double above = (2 * one * other + c1) * (2 * covariance + c2);
            local[x] = above / ((one * one + other * other + c1) * (variances + c2));
        }
        for (int64_t x = 0; x < width; x++) {
            if (!finite(original[row + x]) || (frame.mask && !frame.mask[row + x])) continue;
            total += local[x];
            count++;
        }
    }
};

// The sum over a tile of the local similarity of the vertices that count, whose number is returned,
// or -1 where a decoded value is not finite.
template <class T>
FHASH_INLINE int64_t similarity(const T* original, const T* decoded, const Frame& frame,
                                const int64_t* tile, double* result) {
    Comparison<T> comparison(original, decoded, frame, tile);
    int64_t count = 0;
    double total = 0;
    for (int64_t z = tile[0] - RADIUS; z < tile[1] + RADIUS; z++) {
        if (!comparison.filter_plane(z)) return -1;
        const int64_t out_z = z - RADIUS;
        if (out_z < tile[0]) continue;
        for (int64_t y = tile[2]; y < tile[3]; y++) {
            comparison.filter_row(out_z, y - tile[2]);
            const int64_t row = (out_z * frame.shape[1] + y) * frame.shape[2] + tile[4];
            comparison.add_row(row, total, count);
        }
    }
    *result = total;
    return count;
}

FHASH_CLONES void scan_float(const float* values, int64_t rows, int64_t n, double factor,
                             double* result) {
    for (int64_t row = 0; row < rows; row++)
        scan<float>(values + row * n, n, factor, result + row * FIGURES);
}
FHASH_CLONES void scan_double(const double* values, int64_t rows, int64_t n, double factor,
                              double* result) {
    for (int64_t row = 0; row < rows; row++)
        scan<double>(values + row * n, n, factor, result + row * FIGURES);
}
FHASH_CLONES void errors_float(const float* one, const float* other, const uint8_t* mask,
                               int64_t rows, int64_t n, double scale, double low, double high,
                               double* result) {
    errors_of_rows<float>(one, other, mask, rows, n, scale, low, high, result);
}
FHASH_CLONES void errors_double(const double* one, const double* other, const uint8_t* mask,
                                int64_t rows, int64_t n, double scale, double low, double high,
                                double* result) {
    errors_of_rows<double>(one, other, mask, rows, n, scale, low, high, result);
}
FHASH_CLONES int64_t similarity_float(const float* one, const float* other, const Frame& frame,
                                      const int64_t* tile, double* result) {
    return guarded(
        [&]() FHASH_LAMBDA { return similarity<float>(one, other, frame, tile, result); });
}
FHASH_CLONES int64_t similarity_double(const double* one, const double* other, const Frame& frame,
                                       const int64_t* tile, double* result) {
    return guarded(
        [&]() FHASH_LAMBDA { return similarity<double>(one, other, frame, tile, result); });
}

}  // namespace

// For each of the rows of n values: the number of the finite ones, the least, the greatest and the
// sum of value * factor. Returns 0.
FHASH_EXPORT int64_t fhash_scan_f32(const float* values, int64_t rows, int64_t n, double factor,
                                    double* result) {
    scan_float(values, rows, n, factor, result);
    return 0;
}
FHASH_EXPORT int64_t fhash_scan_f64(const double* values, int64_t rows, int64_t n, double factor,
                                    double* result) {
    scan_double(values, rows, n, factor, result);
    return 0;
}

// Errors of the rows of n decoded values, times scale. For each row: the number of the values that
// count, those with a finite original where the mask (nullptr: everywhere) is not 0, or -1 where
// one of them has no finite error; the sum of the squared errors, and the largest; the number of
// the values that count whose original lies from low to high, and the sum of their squares.
// Returns 0.
FHASH_EXPORT int64_t fhash_errors_f32(const float* original, const float* decoded,
                                      const uint8_t* mask, int64_t rows, int64_t n, double scale,
                                      double low, double high, double* result) {
    errors_float(original, decoded, mask, rows, n, scale, low, high, result);
    return 0;
}
FHASH_EXPORT int64_t fhash_errors_f64(const double* original, const double* decoded,
                                      const uint8_t* mask, int64_t rows, int64_t n, double scale,
                                      double low, double high, double* result) {
    errors_double(original, decoded, mask, rows, n, scale, low, high, result);
    return 0;
}

// Add the finite ones of n values to `counts`, a histogram of `bins` equal bins: a value goes to
// bin (value * scale - low) * factor, or to the first or last one. Returns their number.
FHASH_EXPORT int64_t fhash_histogram_f32(const float* values, int64_t n, double scale, double low,
                                         double factor, int64_t bins, int64_t* counts) {
    return histogram(values, n, scale, low, factor, bins, counts);
}
FHASH_EXPORT int64_t fhash_histogram_f64(const double* values, int64_t n, double scale, double low,
                                         double factor, int64_t bins, int64_t* counts) {
    return histogram(values, n, scale, low, factor, bins, counts);
}

// The structural similarity over a tile of two frames (measure/metrics.py). shape: (z, y,
// x) of the frames. tile: first and stop along each axis. numbers: scale, mean after scaling, c1,
// c2, and the window's six weights from its middle outwards. Returns the number of the vertices
// that count (finite in the original, and set in the mask, nullptr being all); -1 where a decoded
// value that is compared is not finite; NO_MEMORY. result gets the sum of their local similarity.
FHASH_EXPORT int64_t fhash_ssim_f32(const float* original, const float* decoded,
                                    const uint8_t* mask, const int64_t* shape, const int64_t* tile,
                                    const double* numbers, double* result) {
    return similarity_float(original, decoded, make_frame(mask, shape, numbers), tile, result);
}
FHASH_EXPORT int64_t fhash_ssim_f64(const double* original, const double* decoded,
                                    const uint8_t* mask, const int64_t* shape, const int64_t* tile,
                                    const double* numbers, double* result) {
    return similarity_double(original, decoded, make_frame(mask, shape, numbers), tile, result);
}

// Counts and sums of squares of n coefficients by the upper bits of their magnitude: bits >> shift,
// of which there are 2^(31 - shift).
FHASH_EXPORT int64_t fhash_magnitudes(const float* values, int64_t n, int64_t shift,
                                      int64_t* counts, double* squares) {
    for (int64_t i = 0; i < n; i++) {
        std::uint32_t bits;
        std::memcpy(&bits, values + i, sizeof bits);
        const std::uint32_t bin = (bits & 0x7fffffffu) >> shift;
        counts[bin]++;
        squares[bin] += (double)values[i] * (double)values[i];
    }
    return 0;
}
