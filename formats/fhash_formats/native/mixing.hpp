// What the adaptive coders share: the range coder, the estimates of a decision and their mixing. All of it is integer arithmetic, so that
// encoder and decoder can never part, whatever the machine.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core.hpp"

namespace {

using std::int16_t;
using std::int32_t;
using std::int64_t;
using std::max;
using std::min;
using std::uint16_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

const int STRETCH_MAX = 2816;  // logits in units of 1/256, so +-11
const int SLOW_LIMIT = 400, FAST_LIMIT = 20, SIMPLE_LIMIT = 60, LEARNING_RATE = 6;  // counts; the rate in 1/16

struct Tables {
    int16_t stretch[65536];
    uint16_t squash[2 * STRETCH_MAX + 1];
    uint16_t cost[65537];  // of a decision of this probability, in 1/2048 bit
    int32_t log[4096];     // 16 log2
    int32_t rate[SLOW_LIMIT + 1];
    uint8_t small[38];
    // No value lies near a rounding boundary (a test sees to it), so any C library gives the same tables.
    Tables() {
        for (int i = 0; i < 65536; i++) {
            double p = (i + .5) / 65536;
            stretch[i] = (int16_t)min(max((int)std::floor(std::log(p / (1 - p)) * 256 + .5), -STRETCH_MAX), STRETCH_MAX);
        }
        for (int i = -STRETCH_MAX; i <= STRETCH_MAX; i++)
            squash[i + STRETCH_MAX] = (uint16_t)min(max((int)std::floor(65536 / (1 + std::exp(-i / 256.)) + .5), 1), 65535);
        for (int i = 0; i <= 65536; i++) cost[i] = (uint16_t)std::floor(-std::log2(max(i, 1) / 65536.) * 2048 + .5);
        log[0] = 0;
        for (int i = 1; i < 4096; i++) log[i] = (int)std::floor(std::log2((double)i) * 16 + .5);
        for (int i = 0; i <= SLOW_LIMIT; i++) rate[i] = 655360 / (10 * i + 16);
        for (int v = 0; v < 38; v++) small[v] = v <= 2 ? v : v <= 4 ? 3 : v <= 6 ? 4 : v <= 9 ? 5 : v <= 14 ? 6 : v <= 22 ? 7 : v <= 36 ? 8 : 9;
    }
};
const Tables tables;

struct Slot {
    uint16_t slow, fast, count, spare;
};
struct Simple {
    uint16_t p, count;
};

// What adapts, laid out as the caller's arrays: estimates that are mixed, the weights of the mixing, and simple estimates.
struct State {
    std::vector<Slot> slots;
    std::vector<int32_t> weights;
    std::vector<Simple> simples;
};

struct Encoder {
    std::vector<uint8_t> out;
    uint32_t low = 0, high = 0xffffffffu;
    bool failed = false;
    FHASH_INLINE int code(int bit, uint32_t p) {  // p: probability of a 1, in 1..65535 of 65536
        uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        if (bit) high = middle; else low = middle + 1;
        while (((low ^ high) & 0xff000000u) == 0) {
            out.push_back((uint8_t)(high >> 24));
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
            for (int i = 0; i < keep; i++) out.push_back((uint8_t)(v >> (24 - 8 * i)));
            break;
        }
        while (!out.empty() && out.back() == 0) out.pop_back();
    }
};

struct Decoder {
    const uint8_t* data;
    int64_t size, at = 0;
    uint32_t low = 0, high = 0xffffffffu, value = 0;
    FHASH_INLINE uint32_t next() { return at < size ? data[at++] : 0; }
    void start() {
        for (int i = 0; i < 4; i++) value = (value << 8) | next();
    }
    FHASH_INLINE int code(int, uint32_t p) {
        uint32_t middle = low + (uint32_t)(((uint64_t)(high - low) * p) >> 16);
        int bit = value <= middle;
        if (bit) high = middle; else low = middle + 1;
        while (((low ^ high) & 0xff000000u) == 0) {
            low <<= 8;
            high = (high << 8) | 255;
            value = (value << 8) | next();
        }
        return bit;
    }
};

// A prediction from at most MOST estimates: their slots, the mixer's inputs and its one or two sets of weights.
template <int MOST> struct Mixed {
    Slot* slots[MOST];
    int32_t inputs[2 * MOST];
    int32_t *first, *second;
    int p;
};

template <int N, bool PAIR, int MOST> FHASH_INLINE int mix(Mixed<MOST>& now) {
    for (int i = 0; i < N; i++) {
        const Slot* s = now.slots[i];
        int slow = tables.stretch[s->slow], fast = tables.stretch[s->fast];
        if (s->count < 12) {  // little seen, little said
            slow = slow * (s->count + 1) / 13;
            fast = fast * (s->count + 1) / 13;
        }
        now.inputs[2 * i] = slow;
        now.inputs[2 * i + 1] = fast;
    }
    int32_t dot = 0;
    for (int i = 0; i < 2 * N; i++) dot += ((now.first[i] + (PAIR ? now.second[i] : 0)) * now.inputs[i]) >> 2;
    return now.p = tables.squash[min(max(dot >> 12, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX];
}

// 16 log2 of a number, nearly.
FHASH_INLINE int log16(uint32_t v) {
    int shift = 0;
    while ((v >> shift) >= 4096) shift++;
    return tables.log[v >> shift] + 16 * shift;
}

FHASH_INLINE int32_t bounded(int32_t weight) { return min(max(weight, -32767), 32767); }

template <int N, bool PAIR, int RATE = LEARNING_RATE, int MOST> FHASH_INLINE void learn(Mixed<MOST>& now, int bit, int limit) {
    const int target = bit ? 65535 : 0, error = ((target - now.p) * RATE) >> 4;
    for (int i = 0; i < 2 * N; i++) {
        int32_t step = (error * now.inputs[i] + 32768) >> 16;
        now.first[i] = bounded(now.first[i] + step);
        if (PAIR) now.second[i] = bounded(now.second[i] + step);
    }
    for (int i = 0; i < N; i++) {
        Slot* s = now.slots[i];
        s->slow = (uint16_t)(s->slow + (((target - s->slow) * tables.rate[s->count]) >> 16));
        s->fast = (uint16_t)(s->fast + (((target - s->fast) * tables.rate[min<int>(s->count, FAST_LIMIT)]) >> 16));
        if (s->count < limit) s->count++;
    }
}

inline State make_state(const uint16_t* slots, int64_t slot_count, const int32_t* weights, int64_t weight_count, const uint16_t* simples, int64_t simple_count) {
    State state;
    const Slot* const first = reinterpret_cast<const Slot*>(slots);
    state.slots.assign(first, first + slot_count);  // not filled with zeros before
    state.weights.assign(weights, weights + weight_count);
    state.simples.resize(simple_count);
    std::memcpy(state.simples.data(), simples, sizeof(Simple) * simple_count);
    return state;
}

inline int64_t put(const std::vector<uint8_t>& out, uint8_t* data, int64_t capacity) {
    if ((int64_t)out.size() <= capacity && !out.empty()) std::memcpy(data, out.data(), out.size());
    return (int64_t)out.size();
}

}  // namespace
