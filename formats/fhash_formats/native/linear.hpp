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

// N inputs, in 1/256, a multiple of 32; those that are not used are 0.
template <int N> struct Linear {
    int16_t weights[N];   // 1 is 16384
    int16_t rates[N];     // by mean square
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
        uint32_t dot = 0;
        for (int i = 0; i < N; i++) dot += (uint32_t)((int32_t)weights[i] * inputs[i]);
        return min(max((int32_t)dot >> 14, -LINEAR_MAX), LINEAR_MAX);
    }

    // Learn from the bit that came. logit: that of the same inputs.
    FHASH_INLINE void learn(const int16_t* FHASH_RESTRICT inputs, int logit, int bit,
                            const int16_t* table) {
        const int32_t p = tables.squash[logit + STRETCH_MAX];
        const int32_t error = ((bit ? 65535 : 0) - p) >> 1;
        for (int i = 0; i < N; i++) {
            const int32_t wide = (error * inputs[i] + 32768) >> 16;
            const int32_t gradient = min(max(wide, -GRADIENT_MAX), GRADIENT_MAX);
            const int32_t weight = weights[i] + ((gradient * rates[i] + 256) >> 9);
            weights[i] = (int16_t)min(max(weight, -32767), 32767);
            sums[i] = (uint16_t)(sums[i] + ((gradient * gradient) >> 4));
        }
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
