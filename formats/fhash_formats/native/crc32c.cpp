// CRC-32C (Castagnoli) of bytes, with which each chunk of a container ends.
//
// The processor's own instruction takes 8 bytes and makes its result some cycles later. So three
// parts of a block are summed side by side, and their sums are shifted together by tables.
#include <cstdint>
#include <cstring>

#include "core.hpp"
#include "functions.h"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(FHASH_PLAIN)
#include <nmmintrin.h>
#if defined(__clang__)  // in which the instruction has a name of its own
#define FHASH_CRC_TARGET __attribute__((target("sse4.2,crc32")))
#else
#define FHASH_CRC_TARGET __attribute__((target("sse4.2")))
#endif
#define FHASH_HAS_CRC() (fhash_instructions() & FHASH_HAS_CRC32)
#define FHASH_CRC_8(crc, value) _mm_crc32_u64(crc, value)
#define FHASH_CRC_1(crc, value) _mm_crc32_u8((std::uint32_t)(crc), value)
#elif defined(__aarch64__) && defined(__ARM_FEATURE_CRC32) && !defined(FHASH_PLAIN)
#include <arm_acle.h>
#define FHASH_CRC_TARGET
#define FHASH_HAS_CRC() true
#define FHASH_CRC_8(crc, value) __crc32cd((std::uint32_t)(crc), value)
#define FHASH_CRC_1(crc, value) __crc32cb((std::uint32_t)(crc), value)
#endif

namespace {

using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

const uint32_t POLYNOMIAL = 0x82f63b78U;      // reflected
const int64_t BLOCKS[2] = {4096, 256};  // bytes of one of three parts

// The product of two polynomials modulo that of the CRC, reflected as the CRC is.
uint32_t product(uint32_t a, uint32_t b) {
    uint32_t sum = 0;
    for (; a; a <<= 1) {
        if (a & 0x80000000U) sum ^= b;
        b = (b >> 1) ^ (b & 1 ? POLYNOMIAL : 0);
    }
    return sum;
}

struct Tables {
    uint32_t entry[8][256];      // [k][b]: the remainder of byte b with k bytes of 0 behind it
    uint32_t shift[2][4][256];  // [i][k][b]: byte k of a CRC after BLOCKS[i] bytes of 0
    Tables() {
        for (uint32_t b = 0; b < 256; b++) {
            uint32_t rest = b;
            for (int bit = 0; bit < 8; bit++) rest = (rest >> 1) ^ (rest & 1 ? POLYNOMIAL : 0);
            entry[0][b] = rest;
        }
        for (int k = 1; k < 8; k++)
            for (int b = 0; b < 256; b++)
                entry[k][b] = (entry[k - 1][b] >> 8) ^ entry[0][entry[k - 1][b] & 255];
        for (int i = 0; i < 2; i++) {
            uint32_t power = 0x00800000U;  // x^8: one byte of 0
            for (int64_t n = 1; n < BLOCKS[i]; n *= 2) power = product(power, power);
            for (int k = 0; k < 4; k++)
                for (uint32_t b = 0; b < 256; b++) shift[i][k][b] = product(power, b << (8 * k));
        }
    }
};
const Tables tables;

uint32_t by_tables(const uint8_t* in, int64_t n, uint32_t crc) {
    const auto& entry = tables.entry;
    for (; n >= 8; n -= 8, in += 8) {
        crc ^= in[0] | (uint32_t)in[1] << 8 | (uint32_t)in[2] << 16 | (uint32_t)in[3] << 24;
        crc = entry[7][crc & 255] ^ entry[6][crc >> 8 & 255] ^ entry[5][crc >> 16 & 255] ^
              entry[4][crc >> 24] ^ entry[3][in[4]] ^ entry[2][in[5]] ^ entry[1][in[6]] ^
              entry[0][in[7]];
    }
    for (; n > 0; n--) crc = (crc >> 8) ^ entry[0][(crc ^ *in++) & 255];
    return crc;
}

#if defined(FHASH_CRC_TARGET)

FHASH_INLINE uint64_t eight(const uint8_t* in) {
    uint64_t value;
    std::memcpy(&value, in, 8);
    return value;
}

FHASH_INLINE uint32_t shifted(const uint32_t (*by)[256], uint64_t crc) {
    return by[0][crc & 255] ^ by[1][crc >> 8 & 255] ^ by[2][crc >> 16 & 255] ^ by[3][crc >> 24];
}

FHASH_CRC_TARGET uint32_t by_instruction(const uint8_t* in, int64_t n, uint32_t crc) {
    uint64_t one = crc;
    for (int size = 0; size < 2; size++) {
        const int64_t part = BLOCKS[size];
        for (; n >= 3 * part; n -= 3 * part, in += 3 * part) {
            uint64_t two = 0, three = 0;
            for (int64_t i = 0; i < part; i += 8) {
                one = FHASH_CRC_8(one, eight(in + i));
                two = FHASH_CRC_8(two, eight(in + part + i));
                three = FHASH_CRC_8(three, eight(in + 2 * part + i));
            }
            one = shifted(tables.shift[size], one) ^ two;
            one = shifted(tables.shift[size], one) ^ three;
        }
    }
    for (; n >= 8; n -= 8, in += 8) one = FHASH_CRC_8(one, eight(in));
    for (; n > 0; n--) one = FHASH_CRC_1(one, *in++);
    return (uint32_t)one;
}

#endif

}  // namespace

// The CRC-32C of n bytes, continued from `crc`, that of the bytes before them; 0 at the beginning.
// plain: whether the tables are used where the processor has an instruction, too.
FHASH_KERNEL int64_t fhash_crc32c(const void* in, int64_t n, int64_t crc, int64_t plain) {
    const uint8_t* bytes = static_cast<const uint8_t*>(in);
    const uint32_t begin = ~(uint32_t)crc;
#if defined(FHASH_CRC_TARGET)
    if (!plain && FHASH_HAS_CRC()) return (uint32_t)~by_instruction(bytes, n, begin);
#else
    (void)plain;
#endif
    return (uint32_t)~by_tables(bytes, n, begin);
}
