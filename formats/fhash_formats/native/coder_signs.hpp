// Signs by linear prediction: predictors of binary decisions that learn with every bit, and their
// inputs, the signed logarithms of known neighbours.
//
// A predictor is a set of weights; its logit is their product with the inputs. Each weight follows
// its gradient, divided by the root of the gradient's mean square (RMSprop: Tieleman and Hinton
// 2012). All arithmetic is in integers: sums wrap at 32 bits, so that their order does not matter
// and vectors of any width give the same bits.
//
// Bands keep these logarithms in rows with LOG_PADDING zeros at both ends. Rows that do not exist
// are rows of zeros.
#pragma once

#include <memory>

#include "coder_contexts.hpp"

namespace {

const int SIGN_INPUTS = 96;   // see `gather_signs`
const int OWN_INPUTS = 40;    // those of the same band, which come first; a multiple of 8
const int BEYOND = 32;        // numbers behind weights and inputs that vectors may touch
const int LINEAR_MAX = 2047;  // largest logit, in 1/256
const int GRADIENT_MAX = 181;  // largest gradient, in 1/128: the sums below stay in 16 bits
const int PERIOD = 32;         // uses after which mean squares and rates are made anew
const int LOGIT_BIN = 85;      // a third, in 1/256: width of the classes of the logit
const int SIGN_SET = 16;       // mixing weights of a sign: of SIGN_CONTEXTS estimates, of the logit

// Order of the weights of signs, behind the sets of contexts. The caller's sets of these have LANES
// weights each, those of signs have no gaps.
const int64_t BASE_WEIGHTS = int64_t(KINDS + 64) * DECISIONS * LANES;
const int64_t SIGN_LINEAR = BASE_WEIGHTS + KINDS * SIGN_SET;

// The logarithm of a magnitude, with the sign of the value.
FHASH_INLINE int16_t signed_log(int magnitude, bool negative) {
    const int16_t log = linear_tables.log[min(magnitude, MAX_MAGNITUDE)];
    return negative ? (int16_t)-log : log;
}

// The predictor of the signs of a kind. Inputs are in 1/256: an octave of a magnitude is 1.
// `used`: inputs that may be other than 0. The others change nothing but their mean squares, which
// then nobody needs.
struct Linear {
    int16_t weights[SIGN_INPUTS + BEYOND] = {};  // 1 is 16384
    int16_t rates[SIGN_INPUTS];                  // by mean square
    uint16_t sums[SIGN_INPUTS] = {};  // of squares of gradients since the rates were made
    uint16_t squares[SIGN_INPUTS];    // mean square of the gradient: 1 is 16384
    int uses = 0;

    // From the caller's numbers: the weights, then the mean squares.
    explicit Linear(const int32_t* from) {
        for (int i = 0; i < SIGN_INPUTS; i++) {
            weights[i] = (int16_t)from[i];
            squares[i] = (uint16_t)from[SIGN_INPUTS + i];
        }
        make_rates(SIGN_INPUTS);
    }
    void make_rates(int used) {
        for (int i = 0; i < used; i++) {
            const int of_square = min(log16(max<int>(squares[i], 1)), RATE_CLASSES - 1);
            rates[i] = linear_tables.rate[of_square];
        }
    }
    void keep(int32_t* to) const {
        for (int i = 0; i < SIGN_INPUTS; i++) {
            to[i] = weights[i];
            to[SIGN_INPUTS + i] = squares[i];
        }
    }

#if defined(FHASH_SSE2)
    // As below, eight weights at a time.
    FHASH_INLINE void adapt(const int16_t* FHASH_RESTRICT inputs, int used, int16_t error) {
        const __m128i e = _mm_set1_epi16(error), most = _mm_set1_epi16(GRADIENT_MAX);
        const __m128i least = _mm_set1_epi16(-GRADIENT_MAX), low = _mm_set1_epi16(-32767);
        for (int i = 0; i < used; i += 8) {
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
    FHASH_INLINE void adapt(const int16_t* FHASH_RESTRICT inputs, int used, int16_t error) {
        for (int i = 0; i < used; i++) {
            const int32_t wide = (error * inputs[i] + 32768) >> 16;
            const int32_t gradient = min(max(wide, -GRADIENT_MAX), GRADIENT_MAX);
            const int32_t weight = weights[i] + ((gradient * rates[i] + 256) >> 9);
            weights[i] = (int16_t)min(max(weight, -32767), 32767);
            sums[i] = (uint16_t)(sums[i] + ((gradient * gradient) >> 4));
        }
    }
#endif

    // Learn from the bit that came. logit: that of the same inputs.
    FHASH_INLINE void learn(const int16_t* FHASH_RESTRICT inputs, int used, int logit, int bit) {
        const int32_t p = tables.squash[logit + STRETCH_MAX];
        adapt(inputs, used, (int16_t)(((-bit & 65535) - p) >> 1));
        if (++uses % PERIOD) return;
        for (int i = 0; i < used; i++) {
            squares[i] = (uint16_t)(squares[i] + (((sums[i] >> 1) - squares[i] + 8) >> 4));
            sums[i] = 0;
        }
        make_rates(used);
    }
};

// Rows of logarithms around a row; each points to the entry at x = 0.
struct ReferenceLogs {
    const int16_t *centre, *up, *down, *below, *above, *before;
    int shift, last;
    bool same;  // whether its vertices are those of the row
    FHASH_INLINE int16_t at(int x) const { return centre[min(x >> shift, last)]; }
};
struct Logs {
    const int16_t *own, *up, *up2;
    const int16_t *below[3], *below2;   // layer z - 1 at y - 1, y, y + 1; layer z - 2
    const int16_t *before[3], *before2;  // step t - 1 at y - 1, y, y + 1; step t - 2
    const int16_t *before_below, *before_above;  // step t - 1 at z - 1 and z + 1
    ReferenceLogs references[REFERENCE_COUNT];
};

// Logarithms of a band as rows.
struct LogRows {
    const int16_t* first;  // null for a band without integers
    const int* size;
    const int16_t* nothing;
    FHASH_INLINE const int16_t* at(int t, int z, int y) const {
        if (!first || t < 0 || z < 0 || y < 0 || t >= size[0] || z >= size[1] || y >= size[2])
            return nothing;
        return first + (((int64_t)t * size[1] + z) * size[2] + y) * (size[3] + 2 * LOG_PADDING);
    }
};

FHASH_INLINE LogRows rows_of(const Band& band, const int16_t* nothing) {
    return {band.any ? band.logs.data() + LOG_PADDING : nullptr, band.size, nothing};
}

// The rows around the row (t, z, y) of a band.
inline void find_logs(const std::vector<Band>& bands, const Band& band, int t, int z, int y,
                      const int16_t* nothing, Logs& logs) {
    const LogRows rows = rows_of(band, nothing);
    logs.own = rows.at(t, z, y);
    logs.up = rows.at(t, z, y - 1);
    logs.up2 = rows.at(t, z, y - 2);
    for (int i = 0; i < 3; i++) {
        logs.below[i] = rows.at(t, z - 1, y + i - 1);
        logs.before[i] = rows.at(t - 1, z, y + i - 1);
    }
    logs.below2 = rows.at(t, z - 2, y);
    logs.before2 = rows.at(t - 2, z, y);
    logs.before_below = rows.at(t - 1, z - 1, y);
    logs.before_above = rows.at(t - 1, z + 1, y);
    for (int k = 0; k < REFERENCE_COUNT; k++) {
        const Reference& to = band.references[k];
        ReferenceLogs& reference = logs.references[k];
        if (to.band < 0 || !bands[to.band].any) {
            reference = {nothing, nothing, nothing, nothing, nothing, nothing, 0, 0, false};
            continue;
        }
        const Band& other = bands[to.band];
        const LogRows there = rows_of(other, nothing);
        const int tt = min(t >> to.shift[0], other.size[0] - 1);
        const int zz = min(z >> to.shift[1], other.size[1] - 1);
        const int yy = min(y >> to.shift[2], other.size[2] - 1);
        reference = {there.at(tt, zz, yy),     there.at(tt, zz, yy - 1), there.at(tt, zz, yy + 1),
                     there.at(tt, zz - 1, yy), there.at(tt, zz + 1, yy), there.at(tt - 1, zz, yy),
                     to.shift[3],              other.size[3] - 1,        to.shift[3] == 0};
    }
}

// Four logarithms in a row.
FHASH_INLINE void put_four(int16_t* to, const int16_t* from) { std::memcpy(to, from, 8); }

// The inputs of the sign at x: those of the same band; the parent's centre with the parity of x and
// of y; those of the references; and for references of the same size the products of a neighbour
// here, the same neighbour there and the centre there: their signs, and the least magnitude.
// weights: of the predictor. BEYOND more numbers may be read and written behind either.
// REFERRED: whether there are references; without, OWN_INPUTS inputs are written.
// Result: the product of weights and inputs, which wraps at 32 bits.
#if defined(FHASH_SSE2)

// Eight logarithms: four in a row, and four in another one.
FHASH_INLINE __m128i two_fours(const int16_t* one, const int16_t* two) {
    return _mm_unpacklo_epi64(half(one), half(two));
}

// The signs of products of three, and the least of their magnitudes.
FHASH_INLINE __m128i least_of(__m128i a, __m128i b, __m128i c) {
    auto size = [](__m128i v) FHASH_LAMBDA {
        return _mm_max_epi16(v, _mm_sub_epi16(_mm_setzero_si128(), v));
    };
    const __m128i sign = _mm_srai_epi16(_mm_xor_si128(_mm_xor_si128(a, b), c), 15);
    const __m128i least = _mm_min_epi16(_mm_min_epi16(size(a), size(b)), size(c));
    return _mm_sub_epi16(_mm_xor_si128(least, sign), sign);
}

// The vectors of inputs stay in registers until they are multiplied: what was written in small
// parts is slow to read as a whole.
template <bool REFERRED>
FHASH_INLINE uint32_t gather_signs(const Logs& logs, int x, int y, const int16_t* weights,
                                   int16_t* FHASH_RESTRICT to) {
    __m128i dot = _mm_setzero_si128();
    auto take = [&](int at, __m128i in) FHASH_LAMBDA {
        _mm_storeu_si128(reinterpret_cast<__m128i*>(to + at), in);
        const __m128i by = _mm_loadu_si128(reinterpret_cast<const __m128i*>(weights + at));
        dot = _mm_add_epi32(dot, _mm_madd_epi16(in, by));
    };
    take(0, two_fours(logs.own + x - 4, logs.up + x - 2));
    take(8, two_fours(logs.below[0] + x - 1, logs.below[1] + x - 1));
    take(16, two_fours(logs.below[2] + x - 1, logs.before[0] + x - 1));
    take(24, two_fours(logs.before[1] + x - 1, logs.before[2] + x - 1));
    const int16_t parent = REFERRED ? logs.references[0].at(x) : (int16_t)0;
    __m128i rest = _mm_cvtsi32_si128((uint16_t)logs.up[x + 2]);
    rest = _mm_insert_epi16(rest, logs.up2[x], 1);
    rest = _mm_insert_epi16(rest, logs.below2[x], 2);
    rest = _mm_insert_epi16(rest, logs.before_below[x], 3);
    rest = _mm_insert_epi16(rest, logs.before_above[x], 4);
    rest = _mm_insert_epi16(rest, logs.before2[x], 5);
    rest = _mm_insert_epi16(rest, x & 1 ? parent : -parent, 6);
    rest = _mm_insert_epi16(rest, y & 1 ? parent : -parent, 7);
    take(32, rest);
    if (REFERRED) {
        __m128i here = _mm_setzero_si128();
        here = _mm_insert_epi16(here, logs.own[x - 1], 0);
        here = _mm_insert_epi16(here, logs.up[x], 1);
        here = _mm_insert_epi16(here, logs.below[1][x], 2);
        here = _mm_insert_epi16(here, logs.before[1][x], 3);
        here = _mm_insert_epi16(here, logs.up[x - 1], 4);
        here = _mm_insert_epi16(here, logs.up[x + 1], 5);
        for (int k = 0; k < REFERENCE_COUNT; k++) {
            const ReferenceLogs& from = logs.references[k];
            const int i = min(x >> from.shift, from.last);
            __m128i in = half(from.centre + i - 1);
            in = _mm_insert_epi16(in, from.up[i], 4);
            in = _mm_insert_epi16(in, from.down[i], 5);
            in = _mm_insert_epi16(in, from.below[i], 6);
            in = _mm_insert_epi16(in, from.above[i], 7);
            take(40 + 8 * k, in);
            __m128i there = _mm_cvtsi32_si128((uint16_t)from.centre[i - 1]);
            there = _mm_insert_epi16(there, from.up[i], 1);
            there = _mm_insert_epi16(there, from.below[i], 2);
            there = _mm_insert_epi16(there, from.before[i], 3);
            there = _mm_insert_epi16(there, from.up[i - 1], 4);
            there = _mm_insert_epi16(there, from.up[i + 1], 5);
            const __m128i counted = _mm_set1_epi16(from.same ? from.centre[i] : (int16_t)0);
            // Six numbers; the two zeros behind them give way to what follows.
            take(72 + 6 * k, least_of(here, there, counted));
        }
    }
    dot = _mm_add_epi32(dot, _mm_shuffle_epi32(dot, 0x4e));
    dot = _mm_add_epi32(dot, _mm_shuffle_epi32(dot, 0xb1));
    return (uint32_t)_mm_cvtsi128_si32(dot);
}

#else

template <bool REFERRED>
FHASH_INLINE uint32_t gather_signs(const Logs& logs, int x, int y, const int16_t* weights,
                                   int16_t* FHASH_RESTRICT to) {
    put_four(to, logs.own + x - 4);
    put_four(to + 4, logs.up + x - 2);
    for (int row = 0; row < 3; row++) {
        put_four(to + 8 + 4 * row, logs.below[row] + x - 1);
        put_four(to + 20 + 4 * row, logs.before[row] + x - 1);
    }
    const int16_t parent = REFERRED ? logs.references[0].at(x) : (int16_t)0;
    to[32] = logs.up[x + 2];
    to[33] = logs.up2[x];
    to[34] = logs.below2[x];
    to[35] = logs.before_below[x];
    to[36] = logs.before_above[x];
    to[37] = logs.before2[x];
    to[38] = (int16_t)(x & 1 ? parent : -parent);
    to[39] = (int16_t)(y & 1 ? parent : -parent);
    const int16_t here[6] = {logs.own[x - 1],   logs.up[x],     logs.below[1][x],
                             logs.before[1][x], logs.up[x - 1], logs.up[x + 1]};
    for (int k = 0; REFERRED && k < REFERENCE_COUNT; k++) {
        const ReferenceLogs& from = logs.references[k];
        const int i = min(x >> from.shift, from.last);
        int16_t* const at = to + 40 + 8 * k;
        put_four(at, from.centre + i - 1);
        at[4] = from.up[i];
        at[5] = from.down[i];
        at[6] = from.below[i];
        at[7] = from.above[i];
        const int16_t there[6] = {from.centre[i - 1], from.up[i],     from.below[i],
                                  from.before[i],     from.up[i - 1], from.up[i + 1]};
        const int16_t centre = from.same ? from.centre[i] : (int16_t)0;
        for (int n = 0; n < 6; n++) {
            const int16_t a = here[n], b = there[n];
            const int16_t sign = (int16_t)((int16_t)(a ^ b ^ centre) >> 15);
            auto size = [](int16_t v) FHASH_LAMBDA { return (int16_t)(v < 0 ? -v : v); };
            const int16_t least = min(min(size(a), size(b)), size(centre));
            to[72 + 6 * k + n] = (int16_t)((least ^ sign) - sign);
        }
    }
    uint32_t dot = 0;
    for (int i = 0; i < (REFERRED ? SIGN_INPUTS : OWN_INPUTS); i++)
        dot += (uint32_t)((int32_t)weights[i] * to[i]);
    return dot;
}

#endif

// The estimates of signs, their mixing and the linear predictors, as one run adapts them.
struct Signs {
    Slot* slots[SIGN_CONTEXTS];
    std::vector<int16_t> mixing;  // SIGN_SET weights by kind
    int32_t* numbers;             // of the linear predictors, as the caller keeps them
    std::vector<std::unique_ptr<Linear>> linear;  // by kind, made when it is first used
    alignas(64) int16_t inputs[SIGN_INPUTS + BEYOND] = {};

    // weights: the caller's, which stay where they are.
    Signs(State& state, int32_t* weights)
        : mixing(weights + BASE_WEIGHTS, weights + SIGN_LINEAR),
          numbers(weights + SIGN_LINEAR),
          linear(KINDS) {
        Slot* at = state.slots.data() + ALL_CONTEXTS * DECISIONS;
        for (int i = 0; i < SIGN_CONTEXTS; i++) {
            slots[i] = at;
            at += SIGN_SIZES[i];
        }
    }
    // Write what was learned into the caller's weights.
    void keep(int32_t* weights) const {
        std::copy(mixing.begin(), mixing.end(), weights + BASE_WEIGHTS);
        for (int kind = 0; kind < KINDS; kind++)
            if (linear[kind]) linear[kind]->keep(numbers + 2 * SIGN_INPUTS * kind);
    }

    // Code the sign at (y, x) of the row that `logs` lies around; 1 for a negative one.
    // REFERRED: whether bands have references.
    template <bool REFERRED, class Range>
    FHASH_INLINE int code(Range& range, const Logs& logs, int kind, int y, int x, int bit) {
        if (!linear[kind]) linear[kind].reset(new Linear(numbers + 2 * SIGN_INPUTS * kind));
        Linear& predictor = *linear[kind];
        const uint32_t dot = gather_signs<REFERRED>(logs, x, y, predictor.weights, inputs);
        const int logit = min(max((int32_t)dot >> 14, -LINEAR_MAX), LINEAR_MAX);
        const int left = sign_of(logs.own[x - 1]), up = sign_of(logs.up[x]);
        const int up_left = sign_of(logs.up[x - 1]), up_right = sign_of(logs.up[x + 1]);
        const int below = sign_of(logs.below[1][x]);
        const int before = sign_of(logs.before[1][x]);
        int there[3];
        for (int k = 0; k < 3; k++)
            there[k] = REFERRED ? sign_of(logs.references[k].at(x)) : sign_of(0);
        const int bin = min(max((logit + 12 * LOGIT_BIN + LOGIT_BIN / 2) / LOGIT_BIN, 0), 24);
        const int context[SIGN_CONTEXTS] = {
            kind * 27 + (before * 3 + below) * 3 + left,
            kind * 108 + ((there[0] * 3 + there[1]) * 3 + there[2]) * 4 + (x & 1) * 2 + (y & 1),
            kind * 81 + ((up_left * 3 + up_right) * 3 + left) * 3 + up,
            kind * 25 + bin,
        };
        Mixed<SIGN_CONTEXTS> sign;
        for (int i = 0; i < SIGN_CONTEXTS; i++) sign.slots[i] = slots[i] + context[i];
        int16_t* const weights = mixing.data() + kind * SIGN_SET;
        int16_t& trust = weights[2 * SIGN_CONTEXTS];
        sign.first = sign.second = weights;
        const int p = mix<SIGN_CONTEXTS, false>(sign, (trust * logit) >> 2);
        bit = range.code_even(bit, p);
        const int32_t error = (((-bit & 65535) - p) * LEARNING_RATE) >> 4;
        trust = (int16_t)min(max(trust + ((error * logit + 32768) >> 16), -32767), 32767);
        learn_evenly<SIGN_CONTEXTS, false>(sign, bit, SIGN_LIMIT);
        predictor.learn(inputs, REFERRED ? SIGN_INPUTS : OWN_INPUTS, logit, bit);
        return bit;
    }
};

}  // namespace
