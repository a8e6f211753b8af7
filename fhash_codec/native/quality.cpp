// How far decoded values are from the original: sums of squared errors, and structural similarity (Wang et al. 2004).
//
// fhash_scan and fhash_errors add in a stated order, so that their numpy twins give the same bits: value i goes to lane i % LANES of
// its piece of PIECE values, lanes are added up in order, then pieces. The similarity agrees with its numpy twin to rounding only.
#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core.hpp"
#include "guard.hpp"

namespace {

using std::int64_t;
using std::uint8_t;

const int LANES = 256;
const int64_t PIECE = 1 << 14;
const int RADIUS = 5, TAPS = 2 * RADIUS + 1, FIELDS = 4;

FHASH_INLINE double lane_sum(const double* lanes) {
    double sum = 0;
    for (int lane = 0; lane < LANES; lane++) sum += lanes[lane];
    return sum;
}

// result: least, greatest and sum of value * factor; only of what is finite. The number of those.
template <class T> FHASH_INLINE int64_t scan(const T* values, int64_t n, double factor, double* result) {
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
    result[0] = *std::min_element(lows, lows + LANES);
    result[1] = *std::max_element(highs, highs + LANES);
    result[2] = total;
    return count;
}

// result: sum of the squares, and the largest, of (original - decoded) * scale where the original is finite and `mask`, if any, is set.
// The number of those, or -1 where a difference is not finite.
template <class T, bool MASKED>
FHASH_INLINE int64_t errors(const T* original, const T* decoded, const uint8_t* mask, int64_t n, double scale, double* result) {
    const T limit = sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX;
    int64_t count = 0;
    double total = 0, largest = 0;
    for (int64_t start = 0; start < n; start += PIECE) {
        const int64_t stop = std::min(start + PIECE, n);
        double sums[LANES] = {0}, most[LANES] = {0}, wrong[LANES] = {0};
        for (int64_t i = start; i < stop; i += LANES) {
            const int width = (int)std::min<int64_t>(LANES, stop - i);
            const T *const ones = original + i, *const others = decoded + i;
            const uint8_t* const chosen = MASKED ? mask + i : nullptr;
            int counted_here = 0;
            for (int lane = 0; lane < width; lane++) {
                const T one = ones[lane];
                const bool counted = ((one < 0 ? -one : one) <= limit) & (!MASKED || chosen[lane] != 0);
                const T first = counted ? one : (T)0, second = counted ? others[lane] : (T)0;
                const double difference = (double)first * scale - (double)second * scale, size = std::fabs(difference);
                sums[lane] += difference * difference;
                most[lane] = size > most[lane] ? size : most[lane];
                wrong[lane] += difference - difference;  // 0, or NaN for good
                counted_here += counted;
            }
            count += counted_here;
        }
        total += lane_sum(sums);
        for (int lane = 0; lane < LANES; lane++) {
            if (wrong[lane] != 0) return -1;
            largest = std::max(largest, most[lane]);
        }
    }
    result[0] = total;
    result[1] = largest;
    return count;
}

FHASH_INLINE int64_t mirrored(int64_t i, int64_t size) {
    i %= 2 * size;
    if (i < 0) i += 2 * size;
    return i < size ? i : 2 * size - 1 - i;
}

struct Frame {
    int64_t shape[3];
    const uint8_t* mask;
    double scale, mean, c1, c2, weights[RADIUS + 1];  // of the window, from its middle outwards
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

// Sum over a tile of the local similarity of the vertices that count, whose number is returned, or -1 where a decoded value is not finite.
template <class T> FHASH_INLINE int64_t similarity(const T* original, const T* decoded, const Frame& frame, const int64_t* tile, double* result) {
    const int64_t Y = frame.shape[1], X = frame.shape[2];
    const int64_t ny = tile[3] - tile[2], nx = tile[5] - tile[4], wy = ny + 2 * RADIUS, wx = nx + 2 * RADIUS, plane = ny * nx;
    const T limit = sizeof(T) == 4 ? (T)FLT_MAX : (T)DBL_MAX;
    std::vector<double> ring((size_t)(TAPS * FIELDS * plane)), rows((size_t)(FIELDS * wy * nx)), line((size_t)(FIELDS * wx)), sums((size_t)(FIELDS * nx));
    std::vector<int64_t> columns((size_t)wx);
    for (int64_t x = 0; x < wx; x++) columns[x] = mirrored(tile[4] - RADIUS + x, X);
    const bool inner = columns[0] == tile[4] - RADIUS && columns[wx - 1] == tile[5] + RADIUS - 1;
    const double* const w = frame.weights;
    int64_t count = 0;
    double total = 0;
    for (int64_t z = tile[0] - RADIUS; z < tile[1] + RADIUS; z++) {
        const int64_t source_z = mirrored(z, frame.shape[0]);
        double* const into = ring.data() + (z - tile[0] + RADIUS) % TAPS * FIELDS * plane;
        for (int64_t y = 0; y < wy; y++) {
            const int64_t row = (source_z * Y + mirrored(tile[2] - RADIUS + y, Y)) * X;
            double *const a = line.data(), *const b = a + wx, *const squares = b + wx, *const products = squares + wx;
            int wrong = 0;
            const auto load = [&](int64_t x, int64_t at) FHASH_LAMBDA {
                const T one = original[at];
                const bool finite = (one < 0 ? -one : one) <= limit;
                const double first = finite ? (double)one * frame.scale - frame.mean : 0.0;
                const bool other = finite && (!frame.mask || frame.mask[at]);
                const double second = other ? (double)decoded[at] * frame.scale - frame.mean : first;
                wrong |= !(std::fabs(second) <= DBL_MAX);
                a[x] = first;
                b[x] = second;
                squares[x] = first * first + second * second;
                products[x] = first * second;
            };
            if (inner) for (int64_t x = 0; x < wx; x++) load(x, row + tile[4] - RADIUS + x);
            else for (int64_t x = 0; x < wx; x++) load(x, row + columns[x]);
            if (wrong) return -1;
            for (int f = 0; f < FIELDS; f++) {
                const double* const p = line.data() + f * wx;
                double* const out = rows.data() + (f * wy + y) * nx;
                for (int64_t x = 0; x < nx; x++) {
                    const double* const q = p + x;
                    out[x] = w[0] * q[5] + w[1] * (q[4] + q[6]) + w[2] * (q[3] + q[7]) + w[3] * (q[2] + q[8]) + w[4] * (q[1] + q[9]) + w[5] * (q[0] + q[10]);
                }
            }
        }
        for (int f = 0; f < FIELDS; f++)
            for (int64_t y = 0; y < ny; y++) {
                const double* const p = rows.data() + (f * wy + y) * nx;
                double* const out = into + f * plane + y * nx;
                for (int64_t x = 0; x < nx; x++) {
                    const double* const q = p + x;
                    out[x] = w[0] * q[5 * nx] + w[1] * (q[4 * nx] + q[6 * nx]) + w[2] * (q[3 * nx] + q[7 * nx]) + w[3] * (q[2 * nx] + q[8 * nx]) +
                             w[4] * (q[nx] + q[9 * nx]) + w[5] * (q[0] + q[10 * nx]);
                }
            }
        const int64_t out_z = z - RADIUS;
        if (out_z < tile[0]) continue;
        const double* planes[TAPS];
        for (int k = 0; k < TAPS; k++) planes[k] = ring.data() + (out_z - tile[0] + k) % TAPS * FIELDS * plane;
        for (int64_t y = 0; y < ny; y++) {
            for (int f = 0; f < FIELDS; f++) {
                const int64_t at = f * plane + y * nx;
                const double *const p0 = planes[0] + at, *const p1 = planes[1] + at, *const p2 = planes[2] + at, *const p3 = planes[3] + at,
                             *const p4 = planes[4] + at, *const p5 = planes[5] + at, *const p6 = planes[6] + at, *const p7 = planes[7] + at,
                             *const p8 = planes[8] + at, *const p9 = planes[9] + at, *const p10 = planes[10] + at;
                double* const out = sums.data() + f * nx;
                for (int64_t x = 0; x < nx; x++)
                    out[x] = w[0] * p5[x] + w[1] * (p4[x] + p6[x]) + w[2] * (p3[x] + p7[x]) + w[3] * (p2[x] + p8[x]) + w[4] * (p1[x] + p9[x]) + w[5] * (p0[x] + p10[x]);
            }
            const int64_t row = (out_z * Y + tile[2] + y) * X + tile[4];
            const double *const a = sums.data(), *const b = a + nx, *const squares = b + nx, *const products = squares + nx;
            double* const local = line.data();
            for (int64_t x = 0; x < nx; x++) {
                const double covariance = products[x] - a[x] * b[x], variances = squares[x] - a[x] * a[x] - b[x] * b[x];
                const double one = a[x] + frame.mean, other = b[x] + frame.mean;
                const double above = (2 * one * other + frame.c1) * (2 * covariance + frame.c2);
                local[x] = above / ((one * one + other * other + frame.c1) * (variances + frame.c2));
            }
            for (int64_t x = 0; x < nx; x++) {
                const T one = original[row + x];
                if (!((one < 0 ? -one : one) <= limit) || (frame.mask && !frame.mask[row + x])) continue;
                total += local[x];
                count++;
            }
        }
    }
    *result = total;
    return count;
}

FHASH_CLONES int64_t scan_float(const float* values, int64_t n, double factor, double* result) { return scan<float>(values, n, factor, result); }
FHASH_CLONES int64_t scan_double(const double* values, int64_t n, double factor, double* result) { return scan<double>(values, n, factor, result); }
FHASH_CLONES int64_t errors_float(const float* one, const float* other, int64_t n, double scale, double* result) {
    return errors<float, false>(one, other, nullptr, n, scale, result);
}
FHASH_CLONES int64_t errors_double(const double* one, const double* other, int64_t n, double scale, double* result) {
    return errors<double, false>(one, other, nullptr, n, scale, result);
}
FHASH_CLONES int64_t masked_errors_float(const float* one, const float* other, const uint8_t* mask, int64_t n, double scale, double* result) {
    return errors<float, true>(one, other, mask, n, scale, result);
}
FHASH_CLONES int64_t masked_errors_double(const double* one, const double* other, const uint8_t* mask, int64_t n, double scale, double* result) {
    return errors<double, true>(one, other, mask, n, scale, result);
}
FHASH_CLONES int64_t similarity_float(const float* one, const float* other, const Frame& frame, const int64_t* tile, double* result) {
    return guarded([&]() FHASH_LAMBDA { return similarity<float>(one, other, frame, tile, result); });
}
FHASH_CLONES int64_t similarity_double(const double* one, const double* other, const Frame& frame, const int64_t* tile, double* result) {
    return guarded([&]() FHASH_LAMBDA { return similarity<double>(one, other, frame, tile, result); });
}

}  // namespace

// What is finite among n values: their number; result gets the least, the greatest and the sum of value * factor.
FHASH_EXPORT int64_t fhash_scan_f32(const float* values, int64_t n, double factor, double* result) { return scan_float(values, n, factor, result); }
FHASH_EXPORT int64_t fhash_scan_f64(const double* values, int64_t n, double factor, double* result) { return scan_double(values, n, factor, result); }

// Errors of n decoded values, times scale, where the original is finite and the mask (nullptr: everywhere) is not 0: their number; result
// gets the sum of their squares and the largest. -1 where one is not finite.
FHASH_EXPORT int64_t fhash_errors_f32(const float* original, const float* decoded, const uint8_t* mask, int64_t n, double scale, double* result) {
    return mask ? masked_errors_float(original, decoded, mask, n, scale, result) : errors_float(original, decoded, n, scale, result);
}
FHASH_EXPORT int64_t fhash_errors_f64(const double* original, const double* decoded, const uint8_t* mask, int64_t n, double scale, double* result) {
    return mask ? masked_errors_double(original, decoded, mask, n, scale, result) : errors_double(original, decoded, n, scale, result);
}

// Structural similarity over a tile of two frames (codec: ssim.py). shape: (z, y, x) of the frames; tile: start and stop along each axis;
// numbers: scale, mean after scaling, c1, c2, and the window's six weights from its middle outwards. result gets the sum of the local
// similarity of the vertices that count (finite in the original, and set in the mask, nullptr being all); their number is returned, -1
// where a decoded value that is compared is not finite, NO_MEMORY.
FHASH_EXPORT int64_t fhash_ssim_f32(const float* original, const float* decoded, const uint8_t* mask, const int64_t* shape, const int64_t* tile, const double* numbers, double* result) {
    return similarity_float(original, decoded, make_frame(mask, shape, numbers), tile, result);
}
FHASH_EXPORT int64_t fhash_ssim_f64(const double* original, const double* decoded, const uint8_t* mask, const int64_t* shape, const int64_t* tile, const double* numbers, double* result) {
    return similarity_double(original, decoded, make_frame(mask, shape, numbers), tile, result);
}

// How large n coefficients are: counts and squares by the upper bits of their magnitude, bits >> shift, of which there are 2^(31 - shift).
FHASH_EXPORT int64_t fhash_magnitudes(const float* values, int64_t n, int64_t shift, int64_t* counts, double* squares) {
    for (int64_t i = 0; i < n; i++) {
        std::uint32_t bits;
        std::memcpy(&bits, values + i, sizeof bits);
        const std::uint32_t bin = (bits & 0x7fffffffu) >> shift;
        counts[bin]++;
        squares[bin] += (double)values[i] * (double)values[i];
    }
    return 0;
}
