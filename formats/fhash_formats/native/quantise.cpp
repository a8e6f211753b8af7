// Coefficients to integers and back, element by element.
#include "loops.hpp"

#include <cmath>
#include <cstdint>

#include "core.hpp"

namespace {

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
