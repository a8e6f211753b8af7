// Little-endian numbers in bytes, and float16.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace fhash {

template <class T> inline T little(const uint8_t* data) {
    uint64_t bits = 0;
    for (size_t i = 0; i < sizeof(T); i++) bits |= (uint64_t)data[i] << 8 * i;
    T value;
    if (sizeof(T) == 8) {
        std::memcpy(&value, &bits, sizeof(T));
    } else if (sizeof(T) == 4) {
        const uint32_t narrow = (uint32_t)bits;
        std::memcpy(&value, &narrow, sizeof(T));
    } else if (sizeof(T) == 2) {
        const uint16_t narrow = (uint16_t)bits;
        std::memcpy(&value, &narrow, sizeof(T));
    } else {
        const uint8_t narrow = (uint8_t)bits;
        std::memcpy(&value, &narrow, sizeof(T));
    }
    return value;
}

// The number of a float16's bits.
inline float from_half(uint16_t half) {
    const uint32_t sign = (uint32_t)(half & 0x8000) << 16, exponent = half >> 10 & 31;
    const uint32_t fraction = half & 1023;
    uint32_t bits = sign;
    float value;
    if (exponent == 31) {
        bits |= 0x7f800000 | fraction << 13;
    } else if (exponent > 0) {
        bits |= (exponent + 112) << 23 | fraction << 13;
    } else {
        value = (float)fraction * 0x1p-24f;  // exact
        return sign ? -value : value;
    }
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// The bits of the float16 nearest to a number, ties to even.
inline uint16_t to_half(double value) {
    uint64_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    const uint16_t sign = (uint16_t)(bits >> 48 & 0x8000);
    const double size = std::fabs(value);
    if (std::isnan(value)) return (uint16_t)(sign | 0x7e00 | (bits >> 42 & 1023));
    if (size >= 65520) return sign | 0x7c00;  // rounds beyond the largest number, 65504
    if (size < 0x1p-14) {  // a multiple of 2^-24; adding 2^28 rounds it, exactly
        const double whole = (size + 0x1p28) - 0x1p28;
        return (uint16_t)(sign | (uint16_t)(whole * 0x1p24));
    }
    uint64_t rest = bits & 0x7fffffffffffffff;
    rest += (1ull << 41) - 1 + (rest >> 42 & 1);  // round the 42 bits that go, ties to even
    return (uint16_t)(sign | ((rest >> 42) - ((1023 - 15) << 10)));
}

}  // namespace fhash
