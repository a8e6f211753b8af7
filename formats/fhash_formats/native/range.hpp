// Range coder without carries: binary decisions of given probabilities to bytes and back, in
// integers only.
#pragma once

#include <cstdint>
#include <vector>

#include "core.hpp"

namespace {

using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

// Encodes decisions. The range is low..high. A run works on a copy of it, which can then stay in
// registers.
struct Encoder {
    std::vector<uint8_t>* out;
    uint32_t low = 0, high = 0xffffffffu;

    // Encode a bit and return it. p: probability of a 1, 1 to 65535 in 1/65536.
    FHASH_INLINE int code(int bit, uint32_t p) {
        uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        if (bit) high = middle; else low = middle + 1;
        while (((low ^ high) & 0xff000000u) == 0) {
            out->push_back((uint8_t)(high >> 24));
            low <<= 8;
            high = (high << 8) | 255;
        }
        return bit;
    }
    FHASH_INLINE int code_even(int bit, uint32_t p) { return code(bit, p); }

    // Append the fewest bytes that name a number from low to high, 4 at most, and drop zeros at the
    // end: the decoder reads zeros past the end.
    void finish() {
        for (int keep = 0; keep <= 4; keep++) {
            uint32_t v = keep == 0 ? 0 : high & ~(uint32_t)((uint64_t)0xffffffffu >> (8 * keep));
            if (v < low || v > high) continue;
            for (int i = 0; i < keep; i++) out->push_back((uint8_t)(v >> (24 - 8 * i)));
            break;
        }
        while (!out->empty() && out->back() == 0) out->pop_back();
    }
};

// Decodes what an Encoder wrote. Any bytes decode to some bits.
struct Decoder {
    const uint8_t* data;
    int64_t size, at = 0;
    uint32_t low = 0, high = 0xffffffffu, value = 0;

    // The next byte, 0 past the end.
    FHASH_INLINE uint32_t next() { return at < size ? data[at++] : 0; }

    Decoder(const uint8_t* bytes, int64_t count) : data(bytes), size(count) {
        for (int i = 0; i < 4; i++) value = (value << 8) | next();
    }

    // Decode a bit; the first argument is there for the same calls as to an Encoder.
    FHASH_INLINE int code(int, uint32_t p) {
        const uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        const int bit = value <= middle;
        if (bit) high = middle; else low = middle + 1;
        while (((low ^ high) & 0xff000000u) == 0) {
            low <<= 8;
            high = (high << 8) | 255;
            value = (value << 8) | next();
        }
        return bit;
    }

    // The same for a bit that nobody can foresee: without a branch, which would often be mistaken.
    FHASH_INLINE int code_even(int, uint32_t p) {
        const uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        const uint32_t bit = value <= middle, ones = 0 - bit;
        high = (middle & ones) | (high & ~ones);
        low = (low & ones) | ((middle + 1) & ~ones);
        while (((low ^ high) & 0xff000000u) == 0) {
            low <<= 8;
            high = (high << 8) | 255;
            value = (value << 8) | next();
        }
        return (int)bit;
    }
};

}  // namespace
