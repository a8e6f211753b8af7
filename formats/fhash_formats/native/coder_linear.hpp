// Zero flags and magnitudes by linear prediction, beside the contexts; four sets of mixing weights.
//
// The logit of a linear predictor, one per kind and decision, is one more input of the mixer. Four
// sets of mixing weights, chosen by different classes of the neighbourhood, give a logit each and
// learn on their own; a small second mixer sums the four (Mattern 2012). Twin:
// transform/entropy/magnitudes_portable.py.
#pragma once

#include "coder_signs.hpp"

namespace {

const int INPUTS = 64;       // of the linear predictors
const int MIX_INPUTS = 16;   // two per estimate, the linear logit, a constant; the rest are 0
const int LOGIT_INPUT = 12, CONSTANT_INPUT = 13;
const int SETS = 4;
const int SET_CLASSES[SETS] = {KINDS, 64, 343, 64 * 8};
const int SET_NUMBERS = MIX_INPUTS + 1;  // of the caller: the weights, and how often they were used
const int MAX_USES = 8191;
const int CONSTANT = 77;            // in 1/256
const int MAX_SHARE = 131071;       // of a set in the sum of the four, 1 is 65536

// Order of the numbers behind those of signs: weights and mean squares of the linear predictors by
// decision and kind; the sets of mixing weights by decision and class; the shares of the four by
// decision and kind.
const int64_t MAGNITUDE_LINEAR = SIGN_END;
const int64_t MIXING = MAGNITUDE_LINEAR + int64_t(DECISIONS) * KINDS * 2 * INPUTS;
const int64_t SHARES = MIXING + int64_t(DECISIONS) * (64 + 64 + 343 + 512) * SET_NUMBERS;

// Rate of a set after n uses, in 1/256: it falls from 127, so that steps stay in 16 bits, to 48.
struct SetRates {
    int32_t of[MAX_USES / 32 + 1];
    SetRates() {
        for (int i = 0; i <= MAX_USES / 32; i++) of[i] = min(48 + 384 / (1 + i), 127);
    }
};
const SetRates set_rates;

struct MixingSet {
    int16_t weights[MIX_INPUTS];
    int32_t uses;
};

// What is known of a vertex before its zero flag.
struct Vertex {
    int kind, coarse, near, both, parent;  // classes but `near`, see coder_run.hpp
    int expected;                          // 16ths of octaves of it, 0 for none
    int one;                               // class of the quantiser
};

// A prediction of one decision.
struct Guess {
    Mixed<CONTEXTS> contexts;
    alignas(32) int16_t inputs[MIX_INPUTS];
    Linear<INPUTS>* linear;
    MixingSet* sets[SETS];
    int32_t* shares;
    int logit, logits[SETS], p;
};

#if defined(FHASH_SSE2)

// The logit of each set.
FHASH_INLINE void find_logits(Guess& to) {
    const __m128i* const in = reinterpret_cast<const __m128i*>(to.inputs);
    const __m128i low = _mm_load_si128(in), high = _mm_load_si128(in + 1);
    __m128i dots[SETS];
    for (int m = 0; m < SETS; m++) {
        const __m128i* const at = reinterpret_cast<const __m128i*>(to.sets[m]->weights);
        dots[m] = _mm_add_epi32(_mm_madd_epi16(_mm_loadu_si128(at), low),
                                _mm_madd_epi16(_mm_loadu_si128(at + 1), high));
    }
    const __m128i one = _mm_add_epi32(_mm_unpacklo_epi32(dots[0], dots[1]),
                                      _mm_unpackhi_epi32(dots[0], dots[1]));
    const __m128i two = _mm_add_epi32(_mm_unpacklo_epi32(dots[2], dots[3]),
                                      _mm_unpackhi_epi32(dots[2], dots[3]));
    const __m128i sums = _mm_add_epi32(_mm_unpacklo_epi64(one, two), _mm_unpackhi_epi64(one, two));
    __m128i logits = _mm_packs_epi32(_mm_srai_epi32(sums, 14), _mm_setzero_si128());
    logits = _mm_min_epi16(_mm_max_epi16(logits, _mm_set1_epi16(-STRETCH_MAX)),
                           _mm_set1_epi16(STRETCH_MAX));
    logits = _mm_srai_epi32(_mm_unpacklo_epi16(logits, logits), 16);
    _mm_storeu_si128(reinterpret_cast<__m128i*>(to.logits), logits);
}

// A step of the weights of a set along the inputs.
FHASH_INLINE void follow_all(int16_t* weights, const int16_t* inputs, int16_t step) {
    const __m128i* const in = reinterpret_cast<const __m128i*>(inputs);
    const __m128i by = _mm_set1_epi16(step);
    follow(weights, rounded_high(by, _mm_load_si128(in)));
    follow(weights + 8, rounded_high(by, _mm_load_si128(in + 1)));
}

#else

FHASH_INLINE void find_logits(Guess& to) {
    for (int m = 0; m < SETS; m++) {
        int32_t dot = 0;
        for (int i = 0; i < MIX_INPUTS; i++) dot += to.sets[m]->weights[i] * to.inputs[i];
        to.logits[m] = min(max(dot >> 14, -STRETCH_MAX), STRETCH_MAX);
    }
}

FHASH_INLINE void follow_all(int16_t* weights, const int16_t* inputs, int16_t step) {
    for (int i = 0; i < MIX_INPUTS; i++) {
        const int32_t weight = weights[i] + ((step * inputs[i] + 32768) >> 16);
        weights[i] = (int16_t)min(max(weight, -32767), 32767);
    }
}

#endif

struct Magnitudes {
    LinearSets<INPUTS> linear;
    std::vector<MixingSet> mixing;
    std::vector<int32_t> shares;
    MixingSet* first[SETS];
    alignas(64) int16_t inputs[INPUTS] = {};

    Magnitudes(int32_t* numbers)
        : linear(numbers + MAGNITUDE_LINEAR, DECISIONS * KINDS, linear_tables.rate),
          mixing((size_t)((SHARES - MIXING) / SET_NUMBERS)),
          shares(numbers + SHARES, numbers + SHARES + DECISIONS * KINDS * SETS) {
        const int32_t* from = numbers + MIXING;
        for (MixingSet& set : mixing) {
            for (int i = 0; i < MIX_INPUTS; i++) set.weights[i] = (int16_t)from[i];
            set.uses = from[MIX_INPUTS];
            from += SET_NUMBERS;
        }
        MixingSet* at = mixing.data();
        for (int m = 0; m < SETS; m++) {
            first[m] = at;
            at += (int64_t)DECISIONS * SET_CLASSES[m];
        }
    }
    void keep(int32_t* numbers) const {
        linear.keep();
        int32_t* to = numbers + MIXING;
        for (const MixingSet& set : mixing) {
            std::copy(set.weights, set.weights + MIX_INPUTS, to);
            to[MIX_INPUTS] = set.uses;
            to += SET_NUMBERS;
        }
        std::copy(shares.begin(), shares.end(), numbers + SHARES);
    }

    // The inputs of the linear predictors at x.
    FHASH_INLINE void gather(const Logs& logs, int x, const Vertex& vertex) {
        int16_t* FHASH_RESTRICT const to = inputs;
        put_four(to, logs.own + x - 4);
        put_four(to + 4, logs.up + x - 2);
        for (int row = 0; row < 3; row++) {
            put_four(to + 8 + 4 * row, logs.below[row] + x - 1);
            put_four(to + 20 + 4 * row, logs.before[row] + x - 1);
        }
        for (int k = 0; k < REFERENCE_COUNT; k++) {
            const ReferenceLogs& from = logs.references[k];
            const int i = min(x >> from.shift, from.last);
            put_four(to + 32 + 4 * k, from.centre + i - 1);
            to[48 + 2 * k] = from.up[i];
            to[49 + 2 * k] = from.down[i];
        }
        to[56] = logs.up2[x];
        to[57] = logs.below2[x];
        to[58] = logs.before2[x];
        for (int i = 0; i < 59; i++) to[i] = (int16_t)(to[i] < 0 ? -to[i] : to[i]);
        to[59] = (int16_t)(8 * vertex.expected);
        to[60] = 2 * INPUT_ONE;
        to[61] = (int16_t)(vertex.one * INPUT_ONE);
        to[62] = linear_tables.log[min(vertex.near, MAX_INPUT_MAGNITUDE)];
        to[63] = (int16_t)(linear_tables.log[min(x, MAX_INPUT_MAGNITUDE)] / 4);
    }

    // Predict decision k (with the classes of the quantisers). The slots of its estimates are set.
    FHASH_INLINE int predict(Guess& to, const Vertex& vertex, int k) {
        static const int16_t none[MIX_INPUTS] = {};
        to.contexts.first = to.contexts.second = const_cast<int16_t*>(none);
        mix<CONTEXTS, false>(to.contexts);
        inputs_of(to.contexts, to.inputs);
        const int number = k * KINDS + vertex.kind;
        to.linear = &linear.at(number);
        to.logit = to.linear->logit(inputs);
        to.inputs[LOGIT_INPUT] = (int16_t)to.logit;
        to.inputs[CONSTANT_INPUT] = CONSTANT;
        to.inputs[14] = to.inputs[15] = 0;
        const int near = min(small(vertex.near), 6);
        const int bin = min(max((to.logit + 2048) >> 6, 0), 63);
        to.sets[0] = first[0] + number;
        to.sets[1] = first[1] + k * 64 + vertex.coarse;
        to.sets[2] = first[2] + k * 343 + (near * 7 + vertex.both) * 7 + vertex.parent;
        to.sets[3] = first[3] + k * 512 + bin * 8 + near;
        to.shares = shares.data() + number * SETS;
        find_logits(to);
        int32_t sum = 0;
        for (int m = 0; m < SETS; m++) sum += to.shares[m] * to.logits[m];
        sum = min(max(sum >> 16, -STRETCH_MAX), STRETCH_MAX);
        return to.p = tables.squash[sum + STRETCH_MAX];
    }

    FHASH_INLINE void learn(Guess& now, int bit) {
        const int32_t target = bit ? 65535 : 0;
        const int32_t error = target - now.p;
        for (int m = 0; m < SETS; m++) {
            const int32_t share = now.shares[m] + ((error * now.logits[m] + (1 << 18)) >> 19);
            now.shares[m] = min(max(share, -MAX_SHARE), MAX_SHARE);
            MixingSet& set = *now.sets[m];
            const int32_t own = target - tables.squash[now.logits[m] + STRETCH_MAX];
            const int32_t step = (own * set_rates.of[set.uses >> 5]) >> 8;
            follow_all(set.weights, now.inputs, (int16_t)step);
            if (set.uses < MAX_USES) set.uses++;
        }
        learn_slots<CONTEXTS>(now.contexts, bit, SLOW_LIMIT);
        now.linear->learn(inputs, now.logit, bit, linear_tables.rate);
    }
};

}  // namespace
