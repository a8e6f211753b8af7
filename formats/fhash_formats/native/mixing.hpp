// Estimates of binary decisions and their mixing, for all adaptive coders.
//
// All arithmetic is in integers, so encoder and decoder agree on every machine; only the tables are
// made with floating point. SSE2 is used where it exists. FHASH_PLAIN builds the code of all other
// machines, which gives the same bits.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core.hpp"
#include "guard.hpp"
#include "range.hpp"

#if (defined(__SSE2__) || defined(_M_X64)) && !defined(FHASH_PLAIN)
#define FHASH_SSE2 1
#include <emmintrin.h>
#endif

// glibc 2.29 gave these functions a new version, which only drops the wrapper that sets errno. The
// old version binds to every glibc since 2.5, so that a wheel runs on RHEL 8, too.
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__)
__asm__(".symver exp,exp@GLIBC_2.2.5");
__asm__(".symver log,log@GLIBC_2.2.5");
__asm__(".symver log2,log2@GLIBC_2.2.5");
#endif

// Made once for the whole library, when it is loaded.
namespace fhash {

using std::int16_t;
using std::int32_t;
using std::max;
using std::min;
using std::uint16_t;
using std::uint8_t;

const int STRETCH_MAX = 2816;  // largest logit, in 1/256: 11
const int SLOW_LIMIT = 400;    // observations after which the slow rate of an estimate stays
const int FAST_LIMIT = 20;     // the same for the fast rate
const int SIMPLE_LIMIT = 60;   // the same for a simple estimate
const int LEARNING_RATE = 6;   // of the weights, in 1/16
const int ALL_TRUST = 13;      // observations from which on an estimate is believed in full

// Adaptation of an estimate after n observations: its slow and its fast rate in 1/65536, and the
// confidence in it, in 1/13 (twice, so that both estimates of a slot have one).
struct Pace {
    uint16_t slow, fast, trust, same;
};

struct Tables {
    int16_t stretch[65536];                // logit of a probability, in 1/256
    uint16_t squash[2 * STRETCH_MAX + 1];  // probability of a logit
    uint16_t cost[65537];                  // bits of a decision of a probability, in 1/2048
    uint8_t log[4096];                     // 16 log2
    int32_t rate[SLOW_LIMIT + 1];          // rate after n observations, in 1/65536
    Pace pace[SLOW_LIMIT + 1];             // by number of observations
    // No value lies near a rounding boundary (a test checks that), so every C library gives the
    // same tables. Probabilities are in 1/65536.
    Tables() {
        for (int i = 0; i < 65536; i++) {
            double p = (i + .5) / 65536;
            const int logit = (int)std::floor(std::log(p / (1 - p)) * 256 + .5);
            stretch[i] = (int16_t)min(max(logit, -STRETCH_MAX), STRETCH_MAX);
        }
        for (int i = -STRETCH_MAX; i <= STRETCH_MAX; i++) {
            const int p = (int)std::floor(65536 / (1 + std::exp(-i / 256.)) + .5);
            squash[i + STRETCH_MAX] = (uint16_t)min(max(p, 1), 65535);
        }
        for (int i = 0; i <= 65536; i++)
            cost[i] = (uint16_t)std::floor(-std::log2(max(i, 1) / 65536.) * 2048 + .5);
        log[0] = 0;
        for (int i = 1; i < 4096; i++) log[i] = (uint8_t)std::floor(std::log2((double)i) * 16 + .5);
        for (int i = 0; i <= SLOW_LIMIT; i++) rate[i] = 655360 / (10 * i + 16);
        for (int i = 0; i <= SLOW_LIMIT; i++) {
            const uint16_t trust = (uint16_t)min(i + 1, ALL_TRUST);
            pace[i] = {(uint16_t)rate[i], (uint16_t)rate[min(i, FAST_LIMIT)], trust, trust};
        }
    }
};
inline const Tables tables;

}  // namespace fhash

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

using namespace fhash;

// Encodes decisions, or counts their bits, in 1/2048. It is here and not in fast_encode.hpp, since
// `code_simple` is compiled for the baseline and inlines it.
struct FlagWriter {
    bool writes;
    Encoder encoder;
    int64_t bits;

    FHASH_INLINE int code(int bit, uint32_t p) {
        if (writes) return encoder.code(bit, p);
        bits += tables.cost[bit ? p : 65536 - p];
        return bit;
    }
};

// An estimate that is mixed: the probability of a 1 by the slow and by the fast rate, and the
// number of observations, at most SLOW_LIMIT.
struct Slot {
    uint16_t slow, fast, count, spare;
};

// An estimate that is used alone: the probability of a 1, and the number of observations, at most
// SIMPLE_LIMIT.
struct Simple {
    uint16_t p, count;
};

// The state that a coder adapts (priors.hpp). The caller's weights are int32,
// `lanes` to a set. Here they are int16, which holds all of them, and each set is filled up with
// zeros to whole vectors.
struct State {
    std::vector<Slot> slots;
    std::vector<int16_t> weights;
    std::vector<Simple> simples;
};

// Weights of a set with its zeros.
constexpr int padded(int lanes) { return (lanes + 7) & ~7; }

// Bits of a number, without leading zeros.
FHASH_INLINE int significant(uint32_t v) {
#if defined(__GNUC__)
    return v ? 32 - __builtin_clz(v) : 0;
#else
    int bits = 0;
    while (v) v >>= 1, bits++;
    return bits;
#endif
}

// 16 log2 of a number above 0, approximately.
FHASH_INLINE int log16(uint32_t v) {
    const int shift = max(significant(v) - 12, 0);
    return tables.log[v >> shift] + 16 * shift;
}

// Code a bit that one simple estimate predicts, and adapt the estimate.
template <class Range> FHASH_INLINE int code_simple(Range& range, Simple& s, int bit) {
    bit = range.code(bit, min<uint32_t>(max<uint32_t>(s.p, 32), 65504));
    s.p = (uint16_t)(s.p + ((((bit ? 65535 : 0) - (int)s.p) * tables.rate[s.count]) >> 16));
    if (s.count < SIMPLE_LIMIT) s.count++;
    return bit;
}

// A prediction from at most N_MAX estimates. The caller sets `slots` and the sets of weights:
// `first` and, with PAIR, `second`. `mix` sets the rest, and `learn` uses it.
template <int N_MAX> struct Mixed {
    Slot* slots[N_MAX];
    int16_t *first, *second;
    int p;  // probability of a 1, in 1/65536
#if defined(FHASH_SSE2)
    // Four slots each: two inputs of the mixer, two probabilities, the counts, two rates.
    __m128i inputs[(N_MAX + 3) / 4], chances[(N_MAX + 3) / 4];
    __m128i counts[(N_MAX + 3) / 4], rates[(N_MAX + 3) / 4];
#else
    int32_t inputs[2 * N_MAX];
#endif
};

// Probability of a sum of products of weights (1 is 16384) and logits, before its last shifts.
FHASH_INLINE int squashed(int32_t dot) {
    return tables.squash[min(max(dot >> 12, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX];
}

#if defined(FHASH_SSE2)

// This branch does the arithmetic of the other one for eight numbers of 16 bits at a time: the slow
// and the fast estimates of four slots.

// Eight bytes as the lower half of a vector.
FHASH_INLINE __m128i half(const void* from) {
    return _mm_loadl_epi64(static_cast<const __m128i*>(from));
}

// Probability of a 1, mixed from N estimates with one or two (PAIR) sets of weights.
// more: a term of the sum that comes from elsewhere.
template <int N, bool PAIR, int N_MAX> FHASH_INLINE int mix(Mixed<N_MAX>& now, int32_t more = 0) {
    const __m128i zero = _mm_setzero_si128();
    __m128i dot = zero;
    for (int v = 0; 4 * v < N; v++) {
        const int n = min(N - 4 * v, 4);
        Slot* const* const s = now.slots + 4 * v;
        const __m128i one = _mm_unpacklo_epi32(half(s[0]), n > 1 ? half(s[1]) : zero);
        const __m128i two =
            n < 3 ? zero : _mm_unpacklo_epi32(half(s[2]), n > 3 ? half(s[3]) : zero);
        now.chances[v] = _mm_unpacklo_epi64(one, two);
        now.counts[v] = _mm_unpackhi_epi64(one, two);
        auto pace_of = [&](int i) FHASH_LAMBDA { return half(&tables.pace[s[i]->count]); };
        const __m128i pace = _mm_unpacklo_epi32(pace_of(0), n > 1 ? pace_of(1) : zero);
        const __m128i others =
            n < 3 ? zero : _mm_unpacklo_epi32(pace_of(2), n > 3 ? pace_of(3) : zero);
        now.rates[v] = _mm_unpacklo_epi64(pace, others);
        const __m128i trust = _mm_unpackhi_epi64(pace, others);
        __m128i in = _mm_cvtsi32_si128((uint16_t)tables.stretch[s[0]->slow]);
        in = _mm_insert_epi16(in, tables.stretch[s[0]->fast], 1);
        if (n > 1) {
            in = _mm_insert_epi16(in, tables.stretch[s[1]->slow], 2);
            in = _mm_insert_epi16(in, tables.stretch[s[1]->fast], 3);
        }
        if (n > 2) {
            in = _mm_insert_epi16(in, tables.stretch[s[2]->slow], 4);
            in = _mm_insert_epi16(in, tables.stretch[s[2]->fast], 5);
        }
        if (n > 3) {
            in = _mm_insert_epi16(in, tables.stretch[s[3]->slow], 6);
            in = _mm_insert_epi16(in, tables.stretch[s[3]->fast], 7);
        }
        const __m128i doubted = _mm_cmplt_epi16(trust, _mm_set1_epi16(ALL_TRUST));
        if (_mm_movemask_epi8(doubted) & ((1 << 4 * n) - 1)) {
            // |in| * trust / 13, rounded down: with 20165 / 2^18 for 1/13 that is exact for
            // products below 2^16.
            const __m128i sign = _mm_srai_epi16(in, 15);
            in = _mm_mullo_epi16(_mm_sub_epi16(_mm_xor_si128(in, sign), sign), trust);
            in = _mm_srli_epi16(_mm_mulhi_epu16(in, _mm_set1_epi16(20165)), 2);
            in = _mm_sub_epi16(_mm_xor_si128(in, sign), sign);
        }
        now.inputs[v] = in;
        // Pairs of weights times pairs of the same input: (first + second) * input, in 32 bits.
        auto weights_at = [&](const int16_t* set) FHASH_LAMBDA {
            return _mm_loadu_si128(reinterpret_cast<const __m128i*>(set + 8 * v));
        };
        const __m128i first = weights_at(now.first), second = PAIR ? weights_at(now.second) : zero;
        const __m128i low =
            _mm_madd_epi16(_mm_unpacklo_epi16(first, second), _mm_unpacklo_epi16(in, in));
        dot = _mm_add_epi32(dot, _mm_srai_epi32(low, 2));
        if (n > 2) {
            const __m128i high =
                _mm_madd_epi16(_mm_unpackhi_epi16(first, second), _mm_unpackhi_epi16(in, in));
            dot = _mm_add_epi32(dot, _mm_srai_epi32(high, 2));
        }
    }
    dot = _mm_add_epi32(dot, _mm_shuffle_epi32(dot, 0x4e));
    dot = _mm_add_epi32(dot, _mm_shuffle_epi32(dot, 0xb1));
    return now.p = squashed(_mm_cvtsi128_si32(dot) + more);
}

// (a * b + 32768) >> 16
FHASH_INLINE __m128i rounded_high(__m128i a, __m128i b) {
    return _mm_add_epi16(_mm_mulhi_epi16(a, b), _mm_srli_epi16(_mm_mullo_epi16(a, b), 15));
}

// Add a step to eight weights, within +-32767.
FHASH_INLINE void follow(int16_t* weights, __m128i step) {
    __m128i* const at = reinterpret_cast<__m128i*>(weights);
    const __m128i sum = _mm_adds_epi16(_mm_loadu_si128(at), step);
    _mm_storeu_si128(at, _mm_max_epi16(sum, _mm_set1_epi16(-32767)));
}

// Adapt the estimates to a bit that is known where this is called.
template <int N, int N_MAX>
FHASH_INLINE void learn_slots_bit(Mixed<N_MAX>& now, const int bit, int limit) {
    const __m128i ones = _mm_set1_epi16((int16_t)-bit);
    for (int v = 0; 4 * v < N; v++) {
        const int n = min(N - 4 * v, 4);
        Slot* const* const s = now.slots + 4 * v;
        // The distance of each probability from 1 (after a 1) or from 0 (after a 0) shrinks by its
        // rate. The product is rounded down for a 1 and up for a 0.
        __m128i far = _mm_xor_si128(now.chances[v], ones);
        const __m128i product = _mm_mullo_epi16(far, now.rates[v]);
        const __m128i exact = _mm_cmpeq_epi16(product, _mm_setzero_si128());
        far = _mm_sub_epi16(far, _mm_mulhi_epu16(far, now.rates[v]));
        far = _mm_add_epi16(far, _mm_andnot_si128(_mm_or_si128(exact, ones), _mm_set1_epi16(-1)));
        const __m128i chances = _mm_xor_si128(far, ones);
        const __m128i grows = _mm_cmplt_epi32(now.counts[v], _mm_set1_epi32(limit));
        const __m128i counts = _mm_sub_epi32(now.counts[v], grows);
        const __m128i one = _mm_unpacklo_epi32(chances, counts);
        const __m128i two = _mm_unpackhi_epi32(chances, counts);
        _mm_storel_epi64(reinterpret_cast<__m128i*>(s[0]), one);
        if (n > 1) _mm_storeh_pd(reinterpret_cast<double*>(s[1]), _mm_castsi128_pd(one));
        if (n > 2) _mm_storel_epi64(reinterpret_cast<__m128i*>(s[2]), two);
        if (n > 3) _mm_storeh_pd(reinterpret_cast<double*>(s[3]), _mm_castsi128_pd(two));
    }
}

// Whether estimates stay as they are when a 1 comes after `mix`.
template <int N, int N_MAX> FHASH_INLINE bool stay_at_one(const Mixed<N_MAX>& now, int limit) {
    __m128i moves = _mm_setzero_si128();
    for (int v = 0; 4 * v < N; v++) {
        const __m128i far = _mm_xor_si128(now.chances[v], _mm_set1_epi16(-1));
        const int n = min(N - 4 * v, 4);
        const __m128i used = _mm_setr_epi32(-1, -(n > 1), -(n > 2), -(n > 3));
        const __m128i grows = _mm_cmplt_epi32(now.counts[v], _mm_set1_epi32(limit));
        moves = _mm_or_si128(moves, _mm_mulhi_epu16(far, now.rates[v]));
        moves = _mm_or_si128(moves, _mm_and_si128(grows, used));
    }
    return _mm_movemask_epi8(_mm_cmpeq_epi8(moves, _mm_setzero_si128())) == 0xffff;
}

// `learn` for a bit that is known where it is called.
template <int N, bool PAIR, int RATE, int N_MAX>
FHASH_INLINE void learn_bit(Mixed<N_MAX>& now, const int bit, int limit) {
    const __m128i error = _mm_set1_epi16((int16_t)((((-bit & 65535) - now.p) * RATE) >> 4));
    for (int v = 0; 4 * v < N; v++) {
        const __m128i step = rounded_high(error, now.inputs[v]);
        follow(now.first + 8 * v, step);
        if (PAIR) follow(now.second + 8 * v, step);
    }
    learn_slots_bit<N>(now, bit, limit);
}

// Adapt weights and estimates to the bit that came after `mix`. limit: observations after which the
// slow rate stays, at most SLOW_LIMIT.
template <int N, bool PAIR, int RATE = LEARNING_RATE, int N_MAX>
FHASH_INLINE void learn(Mixed<N_MAX>& now, int bit, int limit) {
    if (bit) learn_bit<N, PAIR, RATE>(now, 1, limit);
    else learn_bit<N, PAIR, RATE>(now, 0, limit);
}

// The same for a bit that nobody can foresee: without a branch, which would often be mistaken.
template <int N, bool PAIR, int RATE = LEARNING_RATE, int N_MAX>
FHASH_INLINE void learn_evenly(Mixed<N_MAX>& now, int bit, int limit) {
    learn_bit<N, PAIR, RATE>(now, bit, limit);
}

#else

template <int N, bool PAIR, int N_MAX> FHASH_INLINE int mix(Mixed<N_MAX>& now, int32_t more = 0) {
    int32_t dot = more;
    for (int i = 0; i < N; i++) {
        const Slot* s = now.slots[i];
        const int trust = tables.pace[s->count].trust;
        const int slow = tables.stretch[s->slow], fast = tables.stretch[s->fast];
        now.inputs[2 * i] = trust < ALL_TRUST ? slow * trust / ALL_TRUST : slow;
        now.inputs[2 * i + 1] = trust < ALL_TRUST ? fast * trust / ALL_TRUST : fast;
    }
    for (int i = 0; i < 2 * N; i++)
        dot += ((now.first[i] + (PAIR ? now.second[i] : 0)) * now.inputs[i]) >> 2;
    return now.p = squashed(dot);
}

template <int N, int N_MAX> FHASH_INLINE bool stay_at_one(const Mixed<N_MAX>& now, int limit) {
    for (int i = 0; i < N; i++) {
        const Slot& s = *now.slots[i];
        const Pace& pace = tables.pace[s.count];
        if (s.count < limit || ((65535 - s.slow) * (int64_t)pace.slow) >> 16) return false;
        if (((65535 - s.fast) * (int64_t)pace.fast) >> 16) return false;
    }
    return true;
}

template <int N, bool PAIR, int RATE = LEARNING_RATE, int N_MAX>
FHASH_INLINE void learn(Mixed<N_MAX>& now, int bit, int limit) {
    const int target = bit ? 65535 : 0, error = ((target - now.p) * RATE) >> 4;
    for (int i = 0; i < 2 * N; i++) {
        const int32_t step = (error * now.inputs[i] + 32768) >> 16;
        now.first[i] = (int16_t)min(max(now.first[i] + step, -32767), 32767);
        if (PAIR) now.second[i] = (int16_t)min(max(now.second[i] + step, -32767), 32767);
    }
    for (int i = 0; i < N; i++) {
        Slot* s = now.slots[i];
        const Pace& pace = tables.pace[s->count];
        s->slow = (uint16_t)(s->slow + (((target - s->slow) * (int64_t)pace.slow) >> 16));
        s->fast = (uint16_t)(s->fast + (((target - s->fast) * (int64_t)pace.fast) >> 16));
        if (s->count < limit) s->count++;
    }
}

template <int N, bool PAIR, int RATE = LEARNING_RATE, int N_MAX>
FHASH_INLINE void learn_evenly(Mixed<N_MAX>& now, int bit, int limit) {
    learn<N, PAIR, RATE>(now, bit, limit);
}

#endif

// Whether `learn` changes nothing when a 1 comes after `mix`: no estimate moves, and the error is
// so small that the step of every weight is rounded to 0.
template <int N, int RATE = LEARNING_RATE, int N_MAX>
FHASH_INLINE bool settled_at_one(const Mixed<N_MAX>& now, int limit) {
    const int error = ((65535 - now.p) * RATE) >> 4;
    return error * STRETCH_MAX < 32768 && stay_at_one<N>(now, limit);
}

// Code a bit that N estimates predict together, and adapt them.
template <int N, bool PAIR, int RATE, class Range, int N_MAX>
FHASH_INLINE int code_mixed(Range& range, Mixed<N_MAX>& now, int bit) {
    bit = range.code(bit, (uint32_t)mix<N, PAIR>(now));
    learn<N, PAIR, RATE>(now, bit, SLOW_LIMIT);
    return bit;
}

// The state in the caller's arrays; lanes: weights of a set there. Throws std::bad_alloc.
inline State make_state(const uint16_t* slots, int64_t slot_count, const int32_t* weights,
                        int64_t weight_count, const uint16_t* simples, int64_t simple_count,
                        int lanes) {
    State state;
    const Slot* const first = reinterpret_cast<const Slot*>(slots);
    state.slots.assign(first, first + slot_count);  // unlike resize, writes no zeros first
    state.weights.assign((size_t)(weight_count / lanes * padded(lanes)), 0);
    for (int64_t set = 0; set < weight_count / lanes; set++) {
        int16_t* const to = state.weights.data() + set * padded(lanes);
        for (int i = 0; i < lanes; i++) to[i] = (int16_t)weights[set * lanes + i];
    }
    state.simples.resize((size_t)simple_count);
    std::memcpy(state.simples.data(), simples, sizeof(Simple) * (size_t)simple_count);
    return state;
}

// Write an adapted state into the caller's arrays.
inline void keep_state(const State& state, uint16_t* slots, int32_t* weights, uint16_t* simples,
                       int lanes) {
    std::memcpy(slots, state.slots.data(), sizeof(Slot) * state.slots.size());
    for (size_t set = 0; set < state.weights.size() / padded(lanes); set++)
        for (int i = 0; i < lanes; i++)
            weights[set * lanes + i] = state.weights[set * padded(lanes) + i];
    std::memcpy(simples, state.simples.data(), sizeof(Simple) * state.simples.size());
}

// Copy the bytes to `data` if they fit; their number.
inline int64_t put(const std::vector<uint8_t>& out, uint8_t* data, int64_t capacity) {
    if ((int64_t)out.size() <= capacity && !out.empty()) std::memcpy(data, out.data(), out.size());
    return (int64_t)out.size();
}

}  // namespace
