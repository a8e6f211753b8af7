// Linear predictors of binary decisions, which learn with every bit.
//
// A predictor is a set of weights; its logit is their product with the inputs. Each weight follows
// its gradient, divided by the root of the gradient's mean square (RMSprop: Tieleman and Hinton
// 2012). All arithmetic is in integers: sums wrap at 32 bits, so that their order does not matter
// and vectors of any width give the same bits. Twin: transform/entropy/linear_portable.py.
#pragma once

#include <memory>

#include "mixing.hpp"

namespace {

const int INPUT_ONE = 256;        // 1 as an input: an octave of a magnitude
const int LINEAR_MAX = 2047;      // largest logit, in 1/256
const int GRADIENT_MAX = 181;     // largest gradient, in 1/128: the sums below stay in 16 bits
const int PERIOD = 32;            // uses after which mean squares and rates are made anew
const int BEYOND = 32;  // numbers behind weights and inputs that vectors may touch
const int RATE_CLASSES = 16 * 15 + 1;
const int MAX_INPUT_MAGNITUDE = 4095;  // as MAX_MAGNITUDE of the contexts

// Tables of the predictors. No value lies near a rounding boundary (a test checks that).
struct LinearTables {
    int16_t log[MAX_INPUT_MAGNITUDE + 1];  // 256 log2(1 + magnitude)
    int16_t sign_rate[RATE_CLASSES];       // rate by 16 log2 of the mean square
    int16_t rate[RATE_CLASSES];            // the same, for zero flags and magnitudes
    LinearTables() {
        for (int i = 0; i <= MAX_INPUT_MAGNITUDE; i++)
            log[i] = (int16_t)std::floor(256 * std::log2(1. + i) + .5);
        for (int i = 0; i < RATE_CLASSES; i++) {
            const double scale = 8388608 * std::exp(-i / 32. * 0.69314718055994531);
            sign_rate[i] = (int16_t)min(std::floor(.006 * scale + .5), 32767.);
            rate[i] = (int16_t)min(std::floor(.002 * scale + .5), 32767.);
        }
    }
};
const LinearTables linear_tables;

// The logarithm of a magnitude, with the sign of the value.
FHASH_INLINE int16_t signed_log(int magnitude, bool negative) {
    const int16_t log = linear_tables.log[min(magnitude, MAX_INPUT_MAGNITUDE)];
    return negative ? (int16_t)-log : log;
}

// The product of weights and inputs; it wraps at 32 bits.
template <int N>
FHASH_INLINE uint32_t dot_of(const int16_t* FHASH_RESTRICT weights,
                             const int16_t* FHASH_RESTRICT inputs) {
    uint32_t dot = 0;
    for (int i = 0; i < N; i++) dot += (uint32_t)((int32_t)weights[i] * inputs[i]);
    return dot;
}

// The logit of such a product, in 1/256.
FHASH_INLINE int logit_of(uint32_t dot) {
    return min(max((int32_t)dot >> 14, -LINEAR_MAX), LINEAR_MAX);
}

// N inputs, in 1/256, a multiple of 32; those that are not used are 0.
template <int N> struct Linear {
    int16_t weights[N + BEYOND] = {};  // 1 is 16384
    int16_t rates[N];  // by mean square
    uint16_t sums[N];     // of squares of gradients since the rates were made
    uint16_t squares[N];  // mean square of the gradient: 1 is 16384
    int uses = 0;

    // From the caller's numbers: N weights, then N mean squares.
    Linear(const int32_t* from, const int16_t* table) {
        for (int i = 0; i < N; i++) {
            weights[i] = (int16_t)from[i];
            squares[i] = (uint16_t)from[N + i];
            sums[i] = 0;
        }
        make_rates(table);
    }
    void make_rates(const int16_t* table) {
        for (int i = 0; i < N; i++)
            rates[i] = table[min<int>(log16(max<int>(squares[i], 1)), RATE_CLASSES - 1)];
    }
    void keep(int32_t* to) const {
        for (int i = 0; i < N; i++) {
            to[i] = weights[i];
            to[N + i] = squares[i];
        }
    }

    // The logit of a 1, in 1/256.
    FHASH_INLINE int logit(const int16_t* FHASH_RESTRICT inputs) const {
        return logit_of(dot_of<N>(weights, inputs));
    }

#if defined(FHASH_SSE2)
    // As below, eight weights at a time.
    FHASH_INLINE void adapt(const int16_t* FHASH_RESTRICT inputs, int16_t error) {
        const __m128i e = _mm_set1_epi16(error), most = _mm_set1_epi16(GRADIENT_MAX);
        const __m128i least = _mm_set1_epi16(-GRADIENT_MAX), low = _mm_set1_epi16(-32767);
        for (int i = 0; i < N; i += 8) {
            const __m128i in = _mm_loadu_si128((const __m128i*)(inputs + i));
            const __m128i rate = _mm_loadu_si128((const __m128i*)(rates + i));
            __m128i* const weight = (__m128i*)(weights + i);
            __m128i* const sum = (__m128i*)(sums + i);
            const __m128i gradient =
                _mm_min_epi16(_mm_max_epi16(rounded_high(e, in), least), most);
            // Within 16 bits: 128 gradients.
            const __m128i step = rounded_high(_mm_slli_epi16(gradient, 7), rate);
            const __m128i now = _mm_adds_epi16(_mm_loadu_si128(weight), step);
            _mm_storeu_si128(weight, _mm_max_epi16(now, low));
            const __m128i square = _mm_srli_epi16(_mm_mullo_epi16(gradient, gradient), 4);
            _mm_storeu_si128(sum, _mm_add_epi16(_mm_loadu_si128(sum), square));
        }
    }
#else
    // A step of each weight along its gradient, and the square of that.
    FHASH_INLINE void adapt(const int16_t* FHASH_RESTRICT inputs, int16_t error) {
        for (int i = 0; i < N; i++) {
            const int32_t wide = (error * inputs[i] + 32768) >> 16;
            const int32_t gradient = min(max(wide, -GRADIENT_MAX), GRADIENT_MAX);
            const int32_t weight = weights[i] + ((gradient * rates[i] + 256) >> 9);
            weights[i] = (int16_t)min(max(weight, -32767), 32767);
            sums[i] = (uint16_t)(sums[i] + ((gradient * gradient) >> 4));
        }
    }
#endif

    // Learn from the bit that came. logit: that of the same inputs.
    FHASH_INLINE void learn(const int16_t* FHASH_RESTRICT inputs, int logit, int bit,
                            const int16_t* table) {
        const int32_t p = tables.squash[logit + STRETCH_MAX];
        const int32_t error = ((-bit & 65535) - p) >> 1;
        adapt(inputs, (int16_t)error);
        if (++uses % PERIOD) return;
        for (int i = 0; i < N; i++) {
            squares[i] = (uint16_t)(squares[i] + (((sums[i] >> 1) - squares[i] + 8) >> 4));
            sums[i] = 0;
        }
        make_rates(table);
    }
};

// Predictors by number, made of the caller's numbers when they are first used.
template <int N> struct LinearSets {
    int32_t* numbers;
    const int16_t* table;
    std::vector<std::unique_ptr<Linear<N>>> sets;

    LinearSets(int32_t* from, int count, const int16_t* rates)
        : numbers(from), table(rates), sets((size_t)count) {}
    FHASH_INLINE Linear<N>& at(int number) {
        if (!sets[number]) sets[number].reset(new Linear<N>(numbers + 2 * N * number, table));
        return *sets[number];
    }
    // Write what was learned into the caller's numbers.
    void keep() const {
        for (size_t i = 0; i < sets.size(); i++)
            if (sets[i]) sets[i]->keep(numbers + 2 * N * i);
    }
};

}  // namespace
