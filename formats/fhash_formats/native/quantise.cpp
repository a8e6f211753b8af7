// Coefficients to integers and back, element by element.
#include "loops.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "core.hpp"
#include "functions.h"

namespace {

// A coefficient of a steps is likely to take log2(1 + (2 a)^2) bits, whatever stands around it: of
// the transforms of 20 series it chooses those of which the fast coder takes 0.1 % more bytes.
constexpr float DEAD_ZONE = 0.62F;  // steps below which it becomes 0: a bit above 0.5, not tuned
constexpr float LARGEST = 1 << 22;  // steps from which on a coefficient has no further bits
// Sums are of integers, whose order changes nothing, and of so many that they fit.
constexpr std::int64_t SUMMED = 1 << 14;
constexpr int LOG_BITS = 11, SQUARE_BITS = 16;

// Adds the bits and squared errors, in squared steps, that coefficients times a scale have.
FHASH_CLONES void price_cloned(const float* in, std::int64_t n, float scale, std::int64_t* sums) {
    for (std::int64_t first = 0; first < n; first += SUMMED) {
        const std::int64_t last = std::min(first + SUMMED, n);
        std::int32_t bits = 0, squares = 0;
        for (std::int64_t i = first; i < last; i++) {
            const float scaled = std::fabs(in[i] * scale);
            const float a = scaled < LARGEST ? scaled : LARGEST;
            const float more = 1 + 4 * (a * a);
            std::int32_t of_more;  // 127 + log2, within 0.09, times 2^23
            std::memcpy(&of_more, &more, sizeof of_more);
            bits += (of_more - 0x3f800000) >> (23 - LOG_BITS);
            const float whole = (float)(std::int32_t)(a + 0.5F);
            const float error = a < DEAD_ZONE ? a : a - whole;
            squares += (std::int32_t)(error * error * (1 << SQUARE_BITS));
        }
        sums[0] += bits;
        sums[1] += squares;
    }
}

template <class T>
FHASH_INLINE void quantise(const T* in, std::int64_t count, T scale, T rounding, T largest,
                           std::int32_t* out, float* scaled) {
    for (std::int64_t i = 0; i < count; i++) {
        const T s = in[i] * scale;
        T magnitude = s < 0 ? -s : s;
        magnitude = magnitude < largest ? magnitude + rounding : largest;
        const std::int32_t whole = (std::int32_t)magnitude;
        out[i] = s < 0 ? -whole : whole;
        scaled[i] = (float)s;
    }
}

// shifts: offsets of magnitudes 1, 2, 3, 4, odd ones from 5 on and even ones from 6 on, in steps.
template <class T>
FHASH_INLINE void dequantise(const std::int32_t* in, std::int64_t count, T step,
                             const double* shifts, T* out) {
    T offsets[8] = {0};
    for (int i = 0; i < 6; i++) offsets[i + 1] = (T)shifts[i];
    const T signs[2] = {1, -1};
    for (std::int64_t i = 0; i < count; i++) {
        const std::int32_t q = in[i], magnitude = q < 0 ? -q : q;
        // Offsets from a table and the sign as a factor keep the loop free of branches.
        const std::int32_t number = magnitude < 5 ? magnitude : 6 - (magnitude & 1);
        const T value = ((T)magnitude + offsets[number]) * step;
        out[i] = value * signs[q < 0];
    }
}

#define FHASH_CLONED(T) \
    FHASH_CLONES void quantise_cloned(const T* in, std::int64_t n, T scale, T rounding, T largest, \
                                      std::int32_t* out, float* scaled) { \
        quantise<T>(in, n, scale, rounding, largest, out, scaled); \
    } \
    FHASH_CLONES void dequantise_cloned(const std::int32_t* in, std::int64_t n, T step, \
                                        const double* shifts, T* out) { \
        dequantise<T>(in, n, step, shifts, out); \
    }

FHASH_CLONED(float)
FHASH_CLONED(double)

}  // namespace

// A price of n coefficients times a scale, in steps: bytes, and the sum of the squared errors in
// squared steps. The bits are alike on every processor.
FHASH_KERNEL void fhash_price(const float* in, std::int64_t n, double scale, double* price) {
    std::int64_t sums[2] = {0, 0};
    price_cloned(in, n, (float)scale, sums);
    price[0] = (double)sums[0] / (8 << LOG_BITS);
    price[1] = (double)sums[1] / (1 << SQUARE_BITS);
}

FHASH_KERNEL std::int64_t fhash_quantise_f32(const float* in, std::int64_t n, double scale,
                                             double rounding, double largest, std::int32_t* out,
                                             float* scaled) {
    quantise_cloned(in, n, (float)scale, (float)rounding, (float)largest, out, scaled);
    return 0;
}
FHASH_KERNEL std::int64_t fhash_quantise_f64(const double* in, std::int64_t n, double scale,
                                             double rounding, double largest, std::int32_t* out,
                                             float* scaled) {
    quantise_cloned(in, n, scale, rounding, largest, out, scaled);
    return 0;
}
FHASH_KERNEL std::int64_t fhash_dequantise_f32(const std::int32_t* in, std::int64_t n, double step,
                                               const double* shifts, float* out) {
    dequantise_cloned(in, n, (float)step, shifts, out);
    return 0;
}
FHASH_KERNEL std::int64_t fhash_dequantise_f64(const std::int32_t* in, std::int64_t n, double step,
                                               const double* shifts, double* out) {
    dequantise_cloned(in, n, step, shifts, out);
    return 0;
}
