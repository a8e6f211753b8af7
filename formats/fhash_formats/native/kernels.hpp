// The kernels that the order of a tile calls, by overloading.
#pragma once

#include "core.hpp"
#include "functions.h"

namespace fhash {

#define FHASH_OVERLOADS(T, NAME) \
    inline std::int64_t transform_forward(const T* in, T* out, const std::int64_t* shape, \
                                          const std::int64_t* kinds, const std::int64_t* depths, \
                                          const std::int64_t* ranks, const T* const* matrices, \
                                          const T* tz, const T* yx, std::int64_t threads) { \
        return fhash_transform_forward_##NAME(in, out, shape, kinds, depths, ranks, matrices, tz, \
                                              yx, threads); \
    } \
    inline std::int64_t transform_inverse(const T* in, T* out, const std::int64_t* shape, \
                                          const std::int64_t* kinds, const std::int64_t* depths, \
                                          const std::int64_t* ranks, const T* const* matrices, \
                                          const T* tz, const T* yx, std::int64_t threads) { \
        return fhash_transform_inverse_##NAME(in, out, shape, kinds, depths, ranks, matrices, tz, \
                                              yx, threads); \
    } \
    inline std::int64_t reconstruct(const std::int32_t* in, T* out, const std::int64_t* shape, \
                                    const std::int64_t* kinds, const std::int64_t* depths, \
                                    const std::int64_t* ranks, const T* const* matrices, \
                                    const T* tz, const T* yx, std::int64_t threads, \
                                    const double* numbers) { \
        return fhash_reconstruct_##NAME(in, out, shape, kinds, depths, ranks, matrices, tz, yx, \
                                        threads, numbers); \
    } \
    inline void dequantise(const std::int32_t* in, std::int64_t n, double step, \
                           const double* shifts, T* out) { \
        fhash_dequantise_##NAME(in, n, step, shifts, out); \
    } \
    inline void quantise(const T* in, std::int64_t n, double scale, double rounding, \
                         double largest, std::int32_t* out, float* scaled) { \
        fhash_quantise_##NAME(in, n, scale, rounding, largest, out, scaled); \
    } \
    inline std::int64_t guess_path(const T* scaled, const std::int64_t* shape, \
                                   const std::int32_t* table, std::int64_t count, \
                                   std::uint8_t* buckets, std::int64_t* counts) { \
        return fhash_trellis_guess_##NAME(scaled, shape, table, count, buckets, counts); \
    } \
    inline std::int64_t choose_path(const T* scaled, const std::int64_t* shape, \
                                    const std::int32_t* table, std::int64_t count, \
                                    const std::uint8_t* buckets, const std::int32_t* rates, \
                                    std::int32_t* levels) { \
        return fhash_trellis_choose_##NAME(scaled, shape, table, count, buckets, rates, levels); \
    } \
    inline bool all_within(const T* values, const T* decoded, const std::uint8_t* counted, \
                           std::int64_t n, double error) { \
        return fhash_within_##NAME(values, decoded, counted, n, error) != 0; \
    } \
    inline std::int64_t free_values(T* target, const T* rebuilt, const std::uint8_t* counted, \
                                    std::int64_t n, double low, double high) { \
        return fhash_free_##NAME(target, rebuilt, counted, n, low, high); \
    } \
    inline void clip_shifted(T* values, std::int64_t n, double center, double low, double high) { \
        fhash_clip_##NAME(values, n, center, low, high); \
    } \
    inline std::int64_t mask_levels(const T* values, const std::int64_t* shape, const T* edges, \
                                    std::int64_t edge_count, const std::int32_t* scores, \
                                    const std::int32_t* others, std::int64_t reach, \
                                    std::uint8_t* first, std::uint8_t* second) { \
        return fhash_mask_levels_##NAME(values, shape, edges, edge_count, scores, others, reach, \
                                        first, second); \
    }
FHASH_OVERLOADS(float, f32)
FHASH_OVERLOADS(double, f64)
#undef FHASH_OVERLOADS

inline void correct(const float* base, const std::int32_t* rest, std::int64_t n, double quantum,
                    float* out) {
    fhash_correct_f32_f32(base, rest, n, quantum, out);
}
inline void correct(const float* base, const std::int32_t* rest, std::int64_t n, double quantum,
                    double* out) {
    fhash_correct_f32_f64(base, rest, n, quantum, out);
}
inline void correct(const double* base, const std::int32_t* rest, std::int64_t n, double quantum,
                    float* out) {
    fhash_correct_f64_f32(base, rest, n, quantum, out);
}
inline void correct(const double* base, const std::int32_t* rest, std::int64_t n, double quantum,
                    double* out) {
    fhash_correct_f64_f64(base, rest, n, quantum, out);
}

#define FHASH_RESIDUAL(V, B, NAME) \
    inline std::int64_t residual_of(const V* values, const B* base, const std::uint8_t* counted, \
                                    std::int64_t n, double quantum, double largest, \
                                    std::int32_t* out) { \
        return fhash_residual_##NAME(values, base, counted, n, quantum, largest, out); \
    }
FHASH_RESIDUAL(float, float, f32_f32)
FHASH_RESIDUAL(float, double, f32_f64)
FHASH_RESIDUAL(double, float, f64_f32)
FHASH_RESIDUAL(double, double, f64_f64)
#undef FHASH_RESIDUAL

}  // namespace fhash
