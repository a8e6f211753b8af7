// Lanes of the head's arithmetic: several voxels at a time, for each instruction set.
//
// A lane of `Ints` is one number of 32 bits, or a pair of numbers of 16 bits, the first of them in
// the lower half. All sets give the same bits: sums are exact, and floating-point operations are
// rounded one by one, in the order in which PlainLanes states them.
#pragma once

#include <cstdint>
#include <cstring>

#include "core.hpp"

#if (defined(__SSE2__) || defined(_M_X64)) && !defined(FHASH_PLAIN)
#define FHASH_HEAD_SSE2 1
#include <immintrin.h>
#endif

// Wider sets need a compiler that takes them function by function and a run-time choice.
#if defined(FHASH_HEAD_SSE2) && defined(__x86_64__) && \
    (defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 9))
#define FHASH_HEAD_WIDE 1
#define FHASH_AVX2 __attribute__((target("avx2")))
#define FHASH_AVX512 __attribute__((target("avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")))
#endif

namespace {

constexpr float LIMIT = 4095.0F;              // largest magnitude of an input or activation
constexpr int ONE_BITS = 0x3f800000;          // the bits of 1.0F
constexpr int MAGNITUDE_BITS = 0x7fffffff;    // all bits of a float but its sign
constexpr int LARGEST_BITS = 0x437fffff;      // of the largest float whose octaves are 4095
constexpr int OCTAVE_SHIFT = 14;              // bits below 1/512 of an octave
constexpr float ROUNDING = 12582912.0F;       // 1.5 * 2^23: adding and subtracting it rounds

FHASH_INLINE int bits_of(float value) {
    int bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

FHASH_INLINE float float_of(int bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// Two numbers of 16 bits in one of 32.
FHASH_INLINE std::int32_t paired(int first, int second) {
    const auto low = static_cast<std::uint32_t>(first) & 0xffffU;
    return static_cast<std::int32_t>(low | static_cast<std::uint32_t>(second) << 16);
}

// floor(512 log2(1 + |d|)) with the sign of d, at most 4095. The logarithm is linear between powers
// of two.
FHASH_INLINE int compressed(float d) {
    const float magnitude = float_of(bits_of(d) & MAGNITUDE_BITS) + 1.0F;
    const float largest = float_of(LARGEST_BITS);
    const float most = magnitude < largest ? magnitude : largest;
    const int octaves = (bits_of(most) - ONE_BITS) >> OCTAVE_SHIFT;
    return bits_of(d) < 0 ? -octaves : octaves;
}

// For compilers without one of the sets below, and the definition of each operation.
struct PlainLanes {
    static constexpr int COUNT = 8;  // voxels
    static constexpr int TILE = 4;   // outputs that are summed together
    struct Floats {
        float lane[COUNT];
    };
    struct Ints {
        std::int32_t lane[COUNT];
    };

    static Floats load(const float* from) {
        Floats to;
        std::memcpy(to.lane, from, sizeof to.lane);
        return to;
    }
    static Ints load(const std::int32_t* from) {
        Ints to;
        std::memcpy(to.lane, from, sizeof to.lane);
        return to;
    }
    static void store(float* to, Floats from) { std::memcpy(to, from.lane, sizeof from.lane); }
    static void store(std::int32_t* to, Ints from) { std::memcpy(to, from.lane, sizeof from.lane); }
    static Floats all(float value) {
        Floats to;
        for (float& lane : to.lane) lane = value;
        return to;
    }
    static Ints all(std::int32_t value) {
        Ints to;
        for (std::int32_t& lane : to.lane) lane = value;
        return to;
    }
    // sum + the products of both numbers of the pairs.
    static Ints dot(Ints sum, Ints a, Ints b) {
        for (int i = 0; i < COUNT; ++i)
            sum.lane[i] += static_cast<std::int16_t>(a.lane[i]) *
                               static_cast<std::int16_t>(b.lane[i]) +
                           (a.lane[i] >> 16) * (b.lane[i] >> 16);
        return sum;
    }
    // Pairs of the compressed differences of a and b from the centre.
    static Ints differences(Floats a, Floats b, Floats centre, Floats inverse) {
        Ints to;
        for (int i = 0; i < COUNT; ++i)
            to.lane[i] = paired(compressed((a.lane[i] - centre.lane[i]) * inverse.lane[i]),
                                compressed((b.lane[i] - centre.lane[i]) * inverse.lane[i]));
        return to;
    }
    static Floats weighted(Ints sum, Floats scale, Floats bias) {
        Floats to;
        for (int i = 0; i < COUNT; ++i)
            to.lane[i] = static_cast<float>(sum.lane[i]) * scale.lane[i] + bias.lane[i];
        return to;
    }
    // Activations of sums: leaky, clipped, rounded half to even.
    static Ints activated(Ints sum, Floats scale, Floats bias) {
        const Floats weight = weighted(sum, scale, bias);
        Ints to;
        for (int i = 0; i < COUNT; ++i) {
            const float p = weight.lane[i], less = 0.125F * p;
            const float leaky = less > p ? less : p;
            const float above = leaky > -LIMIT ? leaky : -LIMIT;
            const float within = above < LIMIT ? above : LIMIT;
            to.lane[i] = static_cast<std::int32_t>((within + ROUNDING) - ROUNDING);
        }
        return to;
    }
    static Ints pairs(Ints first, Ints second) {
        for (int i = 0; i < COUNT; ++i) first.lane[i] = paired(first.lane[i], second.lane[i]);
        return first;
    }
    // The sum, clipped; NaN becomes low.
    static Floats clipped_sum(Floats a, Floats b, Floats low, Floats high) {
        for (int i = 0; i < COUNT; ++i) {
            const float value = a.lane[i] + b.lane[i];
            const float raised = value > low.lane[i] ? value : low.lane[i];
            a.lane[i] = raised < high.lane[i] ? raised : high.lane[i];
        }
        return a;
    }
};

#if defined(__GNUC__)

// Vectors of 128 bits in the compiler's own terms, for ARM and others.
struct VectorLanes {
    static constexpr int COUNT = 4;
    static constexpr int TILE = 4;
    typedef float Floats __attribute__((vector_size(16)));
    typedef std::int32_t Ints __attribute__((vector_size(16)));

    static FHASH_INLINE Floats load(const float* from) {
        Floats to;
        std::memcpy(&to, from, sizeof to);
        return to;
    }
    static FHASH_INLINE Ints load(const std::int32_t* from) {
        Ints to;
        std::memcpy(&to, from, sizeof to);
        return to;
    }
    static FHASH_INLINE void store(float* to, Floats from) { std::memcpy(to, &from, sizeof from); }
    static FHASH_INLINE void store(std::int32_t* to, Ints from) {
        std::memcpy(to, &from, sizeof from);
    }
    static FHASH_INLINE Floats all(float value) { return Floats{value, value, value, value}; }
    static FHASH_INLINE Ints all(std::int32_t value) { return Ints{value, value, value, value}; }
    // The lower numbers of pairs.
    static FHASH_INLINE Ints lower(Ints pairs) { return (Ints)((pairs << 16)) >> 16; }
    static FHASH_INLINE Ints dot(Ints sum, Ints a, Ints b) {
        return sum + lower(a) * lower(b) + (a >> 16) * (b >> 16);
    }
    // One vector where the mask has ones, another where it has zeros.
    static FHASH_INLINE Floats chosen(Ints mask, Floats one, Floats other) {
        return (Floats)(((Ints)one & mask) | ((Ints)other & ~mask));
    }
    static FHASH_INLINE Floats larger(Floats a, Floats b) { return chosen(a > b, a, b); }
    static FHASH_INLINE Floats smaller(Floats a, Floats b) { return chosen(a < b, a, b); }
    static FHASH_INLINE Ints compressed_all(Floats d) {
        const Floats size = (Floats)((Ints)d & MAGNITUDE_BITS) + 1.0F;
        const Ints most = (Ints)smaller(size, (Floats)all(LARGEST_BITS));
        const Ints octaves = (most - ONE_BITS) >> OCTAVE_SHIFT, sign = (Ints)d >> 31;
        return (octaves ^ sign) - sign;
    }
    static FHASH_INLINE Ints differences(Floats a, Floats b, Floats centre, Floats inverse) {
        return pairs(compressed_all((a - centre) * inverse),
                     compressed_all((b - centre) * inverse));
    }
    static FHASH_INLINE Floats weighted(Ints sum, Floats scale, Floats bias) {
        return __builtin_convertvector(sum, Floats) * scale + bias;
    }
    static FHASH_INLINE Ints activated(Ints sum, Floats scale, Floats bias) {
        const Floats p = weighted(sum, scale, bias), leaky = larger(0.125F * p, p);
        const Floats within = smaller(larger(leaky, all(-LIMIT)), all(LIMIT));
        return __builtin_convertvector((within + ROUNDING) - ROUNDING, Ints);
    }
    static FHASH_INLINE Ints pairs(Ints first, Ints second) {
        return (first & 0xffff) | (Ints)(second << 16);
    }
    static FHASH_INLINE Floats clipped_sum(Floats a, Floats b, Floats low, Floats high) {
        return smaller(larger(a + b, low), high);
    }
};

#endif

// MAX and MIN of the sets below give the second number where one is NaN.
#if defined(FHASH_HEAD_SSE2)

struct Sse2Lanes {
    static constexpr int COUNT = 4;
    static constexpr int TILE = 4;
    using Floats = __m128;
    using Ints = __m128i;

    static FHASH_INLINE Floats load(const float* from) { return _mm_loadu_ps(from); }
    static FHASH_INLINE Ints load(const std::int32_t* from) {
        return _mm_loadu_si128(reinterpret_cast<const __m128i*>(from));
    }
    static FHASH_INLINE void store(float* to, Floats from) { _mm_storeu_ps(to, from); }
    static FHASH_INLINE void store(std::int32_t* to, Ints from) {
        _mm_storeu_si128(reinterpret_cast<__m128i*>(to), from);
    }
    static FHASH_INLINE Floats all(float value) { return _mm_set1_ps(value); }
    static FHASH_INLINE Ints all(std::int32_t value) { return _mm_set1_epi32(value); }
    static FHASH_INLINE Ints dot(Ints sum, Ints a, Ints b) {
        return _mm_add_epi32(sum, _mm_madd_epi16(a, b));
    }
    // Lower halves of the lanes of one and upper halves of the other.
    static FHASH_INLINE Ints halves(Ints low, Ints high) {
        const __m128i lower = _mm_set1_epi32(0xffff);
        return _mm_or_si128(_mm_and_si128(lower, low), _mm_andnot_si128(lower, high));
    }
    static FHASH_INLINE Ints octaves(Floats d) {
        const __m128 sized = _mm_and_ps(d, _mm_castsi128_ps(_mm_set1_epi32(MAGNITUDE_BITS)));
        const __m128 one = _mm_castsi128_ps(_mm_set1_epi32(ONE_BITS));
        const __m128 largest = _mm_castsi128_ps(_mm_set1_epi32(LARGEST_BITS));
        return _mm_castps_si128(_mm_min_ps(_mm_add_ps(sized, one), largest));
    }
    static FHASH_INLINE Ints differences(Floats a, Floats b, Floats centre, Floats inverse) {
        const __m128 first = _mm_mul_ps(_mm_sub_ps(a, centre), inverse);
        const __m128 second = _mm_mul_ps(_mm_sub_ps(b, centre), inverse);
        const __m128i low = _mm_srli_epi32(octaves(first), OCTAVE_SHIFT);
        const __m128i high = _mm_slli_epi32(octaves(second), 16 - OCTAVE_SHIFT);
        // The bits of 1.0 are subtracted modulo 2^16.
        const __m128i size = _mm_sub_epi16(
            halves(low, high), _mm_set1_epi16(static_cast<short>(ONE_BITS >> OCTAVE_SHIFT)));
        const __m128i sign = _mm_srai_epi16(
            halves(_mm_srli_epi32(_mm_castps_si128(first), 16), _mm_castps_si128(second)), 15);
        return _mm_sub_epi16(_mm_xor_si128(size, sign), sign);
    }
    static FHASH_INLINE Floats weighted(Ints sum, Floats scale, Floats bias) {
        return _mm_add_ps(_mm_mul_ps(_mm_cvtepi32_ps(sum), scale), bias);
    }
    static FHASH_INLINE Ints activated(Ints sum, Floats scale, Floats bias) {
        const __m128 p = weighted(sum, scale, bias);
        const __m128 leaky = _mm_max_ps(_mm_mul_ps(p, _mm_set1_ps(0.125F)), p);
        const __m128 above = _mm_max_ps(leaky, _mm_set1_ps(-LIMIT));
        const __m128 within = _mm_min_ps(above, _mm_set1_ps(LIMIT));
        return _mm_cvtps_epi32(within);
    }
    static FHASH_INLINE Ints pairs(Ints first, Ints second) {
        return halves(first, _mm_slli_epi32(second, 16));
    }
    static FHASH_INLINE Floats clipped_sum(Floats a, Floats b, Floats low, Floats high) {
        return _mm_min_ps(_mm_max_ps(_mm_add_ps(a, b), low), high);
    }
};

#endif

}  // namespace
