// The range coder: binary decisions of given probabilities to bytes and back. Integers only, carryless.
#pragma once

#include <cstdint>
#include <vector>

#include "core.hpp"

namespace {

using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

// A coder works on a copy of its range, which can then stay in registers.
struct Encoder {
    std::vector<uint8_t>* out;
    uint32_t low = 0, high = 0xffffffffu;
    FHASH_INLINE int code(int bit, uint32_t p) {  // p: probability of a 1, in 1..65535 of 65536
        uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        if (bit) high = middle; else low = middle + 1;
        while (((low ^ high) & 0xff000000u) == 0) {
            out->push_back((uint8_t)(high >> 24));
            low <<= 8;
            high = (high << 8) | 255;
        }
        return bit;
    }
    // The fewest bytes that name a number from low to high; the decoder reads zeros past the end.
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

struct Decoder {
    const uint8_t* data;
    int64_t size, at = 0;
    uint32_t low = 0, high = 0xffffffffu, value = 0;
    FHASH_INLINE uint32_t next() { return at < size ? data[at++] : 0; }
    Decoder(const uint8_t* bytes, int64_t count) : data(bytes), size(count) {
        for (int i = 0; i < 4; i++) value = (value << 8) | next();
    }
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
};

}  // namespace
