// Lanes of AVX2 and of AVX-512 for the head (head_lanes.hpp).
#pragma once

#include "head_lanes.hpp"

#if defined(FHASH_HEAD_WIDE)

namespace {

struct Avx2Lanes {
    static constexpr int COUNT = 8;
    static constexpr int TILE = 6;
    using Floats = __m256;
    using Ints = __m256i;

    static FHASH_AVX2 FHASH_INLINE Floats load(const float* from) { return _mm256_loadu_ps(from); }
    static FHASH_AVX2 FHASH_INLINE Ints load(const std::int32_t* from) {
        return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from));
    }
    static FHASH_AVX2 FHASH_INLINE void store(float* to, Floats from) {
        _mm256_storeu_ps(to, from);
    }
    static FHASH_AVX2 FHASH_INLINE void store(std::int32_t* to, Ints from) {
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), from);
    }
    static FHASH_AVX2 FHASH_INLINE Floats all(float value) { return _mm256_set1_ps(value); }
    static FHASH_AVX2 FHASH_INLINE Ints all(std::int32_t value) {
        return _mm256_set1_epi32(value);
    }
    static FHASH_AVX2 FHASH_INLINE Ints dot(Ints sum, Ints a, Ints b) {
        return _mm256_add_epi32(sum, _mm256_madd_epi16(a, b));
    }
    static FHASH_AVX2 FHASH_INLINE Ints octaves(Floats d) {
        const __m256 sized = _mm256_and_ps(d, _mm256_castsi256_ps(all(MAGNITUDE_BITS)));
        const __m256 more = _mm256_add_ps(sized, _mm256_castsi256_ps(all(ONE_BITS)));
        return _mm256_castps_si256(_mm256_min_ps(more, _mm256_castsi256_ps(all(LARGEST_BITS))));
    }
    static FHASH_AVX2 FHASH_INLINE Ints differences(Floats a, Floats b, Floats centre,
                                                    Floats inverse) {
        const __m256 first = _mm256_mul_ps(_mm256_sub_ps(a, centre), inverse);
        const __m256 second = _mm256_mul_ps(_mm256_sub_ps(b, centre), inverse);
        const __m256i low = _mm256_srli_epi32(octaves(first), OCTAVE_SHIFT);
        const __m256i high = _mm256_slli_epi32(octaves(second), 16 - OCTAVE_SHIFT);
        const __m256i size = _mm256_sub_epi16(
            _mm256_blend_epi16(low, high, 0xaa),
            _mm256_set1_epi16(static_cast<short>(ONE_BITS >> OCTAVE_SHIFT)));
        // Where the upper half of a difference is 0, and its sign with it, its size is 0, too.
        const __m256i sign =
            _mm256_blend_epi16(_mm256_srli_epi32(_mm256_castps_si256(first), 16),
                               _mm256_castps_si256(second), 0xaa);
        return _mm256_sign_epi16(size, sign);
    }
    static FHASH_AVX2 FHASH_INLINE Floats weighted(Ints sum, Floats scale, Floats bias) {
        return _mm256_add_ps(_mm256_mul_ps(_mm256_cvtepi32_ps(sum), scale), bias);
    }
    static FHASH_AVX2 FHASH_INLINE Ints activated(Ints sum, Floats scale, Floats bias) {
        const __m256 p = weighted(sum, scale, bias);
        const __m256 leaky = _mm256_max_ps(_mm256_mul_ps(p, all(0.125F)), p);
        const __m256 above = _mm256_max_ps(leaky, all(-LIMIT));
        const __m256 within = _mm256_min_ps(above, all(LIMIT));
        return _mm256_cvtps_epi32(within);
    }
    static FHASH_AVX2 FHASH_INLINE Ints pairs(Ints first, Ints second) {
        return _mm256_blend_epi16(first, _mm256_slli_epi32(second, 16), 0xaa);
    }
    static FHASH_AVX2 FHASH_INLINE Floats clipped_sum(Floats a, Floats b, Floats low, Floats high) {
        return _mm256_min_ps(_mm256_max_ps(_mm256_add_ps(a, b), low), high);
    }
};

struct Avx512Lanes {
    static constexpr int COUNT = 16;
    static constexpr int TILE = 8;
    static constexpr unsigned UPPER = 0xaaaaaaaaU;  // the upper halves of all lanes
    // Choices of _mm512_range_ps: of the smaller magnitude, without sign and with the first's sign.
    static constexpr int SMALLER_MAGNITUDE = 10, SMALLER_WITH_SIGN = 2;
    using Floats = __m512;
    using Ints = __m512i;

    static FHASH_AVX512 FHASH_INLINE Floats load(const float* from) {
        return _mm512_loadu_ps(from);
    }
    static FHASH_AVX512 FHASH_INLINE Ints load(const std::int32_t* from) {
        return _mm512_loadu_si512(from);
    }
    static FHASH_AVX512 FHASH_INLINE void store(float* to, Floats from) {
        _mm512_storeu_ps(to, from);
    }
    static FHASH_AVX512 FHASH_INLINE void store(std::int32_t* to, Ints from) {
        _mm512_storeu_si512(to, from);
    }
    static FHASH_AVX512 FHASH_INLINE Floats all(float value) { return _mm512_set1_ps(value); }
    static FHASH_AVX512 FHASH_INLINE Ints all(std::int32_t value) {
        return _mm512_set1_epi32(value);
    }
    static FHASH_AVX512 FHASH_INLINE Ints dot(Ints sum, Ints a, Ints b) {
        // As an intrinsic, gcc 12 copies the sum before and after.
        __asm__("vpdpwssd %2, %1, %0" : "+v"(sum) : "v"(a), "v"(b));
        return sum;
    }
    static FHASH_AVX512 FHASH_INLINE Ints octaves(Floats d) {
        // The magnitude is bounded before 1 is added: the largest result is a whole number of its
        // units away from 1.
        const __m512 most = all(float_of(LARGEST_BITS) - 1.0F);
        const __m512 sized = _mm512_range_ps(d, most, SMALLER_MAGNITUDE);
        return _mm512_castps_si512(_mm512_add_ps(sized, all(1.0F)));
    }
    static FHASH_AVX512 FHASH_INLINE Ints differences(Floats a, Floats b, Floats centre,
                                                      Floats inverse) {
        const __m512 first = _mm512_mul_ps(_mm512_sub_ps(a, centre), inverse);
        const __m512 second = _mm512_mul_ps(_mm512_sub_ps(b, centre), inverse);
        const __m512i low = _mm512_srli_epi32(octaves(first), OCTAVE_SHIFT);
        const __m512i high = _mm512_slli_epi32(octaves(second), 16 - OCTAVE_SHIFT);
        const __m512i size = _mm512_sub_epi16(
            _mm512_mask_blend_epi16(UPPER, low, high),
            _mm512_set1_epi16(static_cast<short>(ONE_BITS >> OCTAVE_SHIFT)));
        const __m512i sign = _mm512_mask_blend_epi16(
            UPPER, _mm512_srli_epi32(_mm512_castps_si512(first), 16), _mm512_castps_si512(second));
        return _mm512_mask_sub_epi16(size, _mm512_movepi16_mask(sign), _mm512_setzero_si512(),
                                     size);
    }
    static FHASH_AVX512 FHASH_INLINE Floats weighted(Ints sum, Floats scale, Floats bias) {
        return _mm512_add_ps(_mm512_mul_ps(_mm512_cvtepi32_ps(sum), scale), bias);
    }
    static FHASH_AVX512 FHASH_INLINE Ints activated(Ints sum, Floats scale, Floats bias) {
        const __m512 p = weighted(sum, scale, bias);
        const __m512 leaky = _mm512_max_ps(_mm512_mul_ps(p, all(0.125F)), p);
        return _mm512_cvtps_epi32(_mm512_range_ps(leaky, all(LIMIT), SMALLER_WITH_SIGN));
    }
    static FHASH_AVX512 FHASH_INLINE Ints pairs(Ints first, Ints second) {
        return _mm512_mask_blend_epi16(UPPER, first, _mm512_slli_epi32(second, 16));
    }
    static FHASH_AVX512 FHASH_INLINE Floats clipped_sum(Floats a, Floats b, Floats low,
                                                        Floats high) {
        return _mm512_min_ps(_mm512_max_ps(_mm512_add_ps(a, b), low), high);
    }
};

}  // namespace

#endif
