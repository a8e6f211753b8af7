// CRC-32 (of ZIP and zlib) of integers in little-endian order.
#pragma once

#include <cstdint>

#include "core.hpp"

#if defined(__x86_64__) && !defined(FHASH_PLAIN) && \
    (defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 9))
#define FHASH_FOLDED_CRC 1
#include <immintrin.h>
#endif

namespace {

// Remainders of four bytes at a time: entry [k][b] is that of byte b with k bytes of 0 behind it.
struct CrcTables {
    std::uint32_t entry[4][256];
    CrcTables() {
        for (std::uint32_t b = 0; b < 256; b++) {
            std::uint32_t rest = b;
            for (int bit = 0; bit < 8; bit++) rest = (rest >> 1) ^ (rest & 1 ? 0xedb88320U : 0);
            entry[0][b] = rest;
        }
        for (int k = 1; k < 4; k++)
            for (int b = 0; b < 256; b++)
                entry[k][b] = (entry[k - 1][b] >> 8) ^ entry[0][entry[k - 1][b] & 255];
    }
};
const CrcTables crc_tables;

FHASH_INLINE std::uint32_t crc32_plain(const std::int32_t* in, std::int64_t n, std::uint32_t crc) {
    const auto& entry = crc_tables.entry;
    for (std::int64_t i = 0; i < n; i++) {
        crc ^= static_cast<std::uint32_t>(in[i]);
        crc = entry[3][crc & 255] ^ entry[2][crc >> 8 & 255] ^ entry[1][crc >> 16 & 255] ^
              entry[0][crc >> 24];
    }
    return crc;
}

#if defined(FHASH_FOLDED_CRC)

#define FHASH_CLMUL __attribute__((target("pclmul,sse4.1")))

FHASH_CLMUL FHASH_INLINE __m128i folded(__m128i rest, __m128i next, __m128i by) {
    const __m128i low = _mm_clmulepi64_si128(rest, by, 0x00);
    const __m128i high = _mm_clmulepi64_si128(rest, by, 0x11);
    return _mm_xor_si128(_mm_xor_si128(low, high), next);
}

// n: a multiple of 4, at least 16. Folding by 64 bytes, then by 16 (V. Gopal et al., Fast CRC
// Computation for Generic Polynomials Using PCLMULQDQ Instruction, 2009).
FHASH_CLMUL inline std::uint32_t crc32_folded(const std::int32_t* in, std::int64_t n,
                                              std::uint32_t crc) {
    const __m128i by64 = _mm_set_epi64x(0x01c6e41596, 0x0154442bd4);
    const __m128i by16 = _mm_set_epi64x(0x00ccaa009e, 0x01751997d0);
    auto next = [&](std::int64_t at) FHASH_LAMBDA {
        return _mm_loadu_si128(reinterpret_cast<const __m128i*>(in + at));
    };
    __m128i rest[4];
    for (int k = 0; k < 4; k++) rest[k] = next(4 * k);
    rest[0] = _mm_xor_si128(rest[0], _mm_cvtsi32_si128(static_cast<int>(crc)));
    std::int64_t at = 16;
    for (; at + 16 <= n; at += 16)
        for (int k = 0; k < 4; k++) rest[k] = folded(rest[k], next(at + 4 * k), by64);
    __m128i all = rest[0];
    for (int k = 1; k < 4; k++) all = folded(all, rest[k], by16);
    for (; at + 4 <= n; at += 4) all = folded(all, next(at), by16);
    // 128 bits to 64, then to 32 by Barrett's reduction.
    const __m128i lower = _mm_setr_epi32(-1, 0, -1, 0);
    all = _mm_xor_si128(_mm_srli_si128(all, 8), _mm_clmulepi64_si128(all, by16, 0x10));
    const __m128i by4 = _mm_set_epi64x(0, 0x0163cd6124);
    all = _mm_xor_si128(_mm_srli_si128(all, 4),
                        _mm_clmulepi64_si128(_mm_and_si128(all, lower), by4, 0x00));
    const __m128i barrett = _mm_set_epi64x(0x01f7011641, 0x01db710641);
    __m128i times = _mm_clmulepi64_si128(_mm_and_si128(all, lower), barrett, 0x10);
    times = _mm_clmulepi64_si128(_mm_and_si128(times, lower), barrett, 0x00);
    return static_cast<std::uint32_t>(_mm_extract_epi32(_mm_xor_si128(all, times), 1));
}

#endif

// The CRC-32 of n integers, continued from that of what stands before them; 0 at the beginning.
inline std::uint32_t crc32_of(const std::int32_t* in, std::int64_t n, std::uint32_t crc) {
    crc = ~crc;
#if defined(FHASH_FOLDED_CRC)
    if (n >= 16 && fhash_instructions() & FHASH_HAS_CLMUL) {
        const std::int64_t whole = n / 4 * 4;
        crc = crc32_folded(in, whole, crc);
        in += whole;
        n -= whole;
    }
#endif
    return ~crc32_plain(in, n, crc);
}

// The product of two polynomials modulo that of the CRC, reflected as the CRC is.
FHASH_INLINE std::uint32_t crc32_product(std::uint32_t a, std::uint32_t b) {
    std::uint32_t product = 0;
    for (; a; a <<= 1) {
        if (a & 0x80000000U) product ^= b;
        b = (b >> 1) ^ (b & 1 ? 0xedb88320U : 0);
    }
    return product;
}

// What n integers of 0 multiply a CRC by: x^(32 n).
inline std::uint32_t crc32_power(std::int64_t n) {
    std::uint32_t power = 0x80000000U, square = 0x40000000U;  // 1 and x
    for (int k = 0; k < 5; k++) square = crc32_product(square, square);
    for (; n; n >>= 1) {
        if (n & 1) power = crc32_product(power, square);
        square = crc32_product(square, square);
    }
    return power;
}

// As crc32_of, for as many integers of 0 as `power` is of.
FHASH_INLINE std::uint32_t crc32_of_zeros(std::uint32_t power, std::uint32_t crc) {
    return ~crc32_product(power, ~crc);
}

}  // namespace
