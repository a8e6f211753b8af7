// A run of the coder over the bands of a tile; coder.cpp says what is coded.
#pragma once

#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "coder_linear.hpp"

namespace {

// What a run is given: integers in the bands of a table, the coder's state, and bytes to write or
// to read.
struct Task {
    State* state;
    Flags* flags;
    Signs* signs;            // null BY_CONTEXTS
    Magnitudes* magnitudes;  // null but BY_LINEAR
    int32_t* q;
    const float* scaled;  // null, or what integers are chosen of
    double lambda;        // squared steps that 1/2048 bit is worth
    const int64_t* shape;
    const int32_t* table;
    int64_t count;  // bands of the table
    std::vector<uint8_t>* out;
    const uint8_t* data;
    int64_t size;
};

// A prediction of a zero flag or of "more than k".
template <Model MODEL>
using Decision = typename std::conditional<MODEL == BY_LINEAR, Guess, Prediction>::type;

template <Mode MODE>
using Range = typename std::conditional<MODE == DECODE, Decoder, Encoder>::type;

template <Mode MODE> FHASH_INLINE Range<MODE> range_of(const Task& task) {
    if constexpr (MODE == DECODE) return Decoder(task.data, task.size);
    else return Encoder{task.out};
}
FHASH_INLINE void finish(Encoder& range) { range.finish(); }
FHASH_INLINE void finish(Decoder&) {}

// One run over the bands of a tile.
template <Mode MODE, Model MODEL, bool TRELLIS> struct Coder {
    Range<MODE> range;
    const Task& task;
    State* const state = task.state;
    const double lambda = task.lambda;

    FHASH_INLINE int simple(int bit, int64_t number) {
        return code_simple(range, state->simples[number], bit);
    }

    // The magnitude next to s = |scaled| that costs least: the nearest one, one less, or zero.
    // p: probability of a zero; predict(prediction, k): probability that it is more than k.
    template <class Predict> FHASH_INLINE int choose(double s, int p, Predict predict) {
        s = s < 1e9 ? s : 1e9;  // also for NaN
        const int nearest = (int)(s + 0.5);
        if (nearest == 0 || nearest >= UNARY) return nearest;
        Decision<MODEL> other;
        const double zero = s * s + lambda * tables.cost[p];
        const double other_than_zero = lambda * (tables.cost[65536 - p] + 2048);
        // The probabilities that it is more than `nearest` - 1, if that is asked, and `nearest`.
        const int first = max(nearest - 1, 1);
        int more[2];
        for (int k = first; k <= nearest; k++) more[k - first] = predict(other, k);
        if (nearest == 1) {
            const double one = (s - 1) * (s - 1) + lambda * tables.cost[65536 - more[0]];
            return zero <= one + other_than_zero ? 0 : 1;
        }
        const double same = (s - nearest) * (s - nearest) +
                            lambda * (tables.cost[more[0]] + tables.cost[65536 - more[1]]);
        const double less = (s - nearest + 1) * (s - nearest + 1) +
                            lambda * tables.cost[65536 - more[0]];
        if (nearest == 2 && zero < min(same, less) + other_than_zero) return 0;
        return less < same ? nearest - 1 : nearest;
    }

    // A magnitude from UNARY on, as an Exp-Golomb number; -1 for one that no encoder writes.
    FHASH_INLINE int code_escape(int magnitude, int level) {
        const int64_t escape = level * 64;
        const uint32_t rest = MODE == DECODE ? 0 : (uint32_t)magnitude - UNARY + 1;
        int bits = 0;
        if (MODE != DECODE) while (rest >> bits > 1) bits++;
        int j = 0;
        while (simple(j < bits, escape + min(j, 20))) if (++j > 30) return -1;
        uint32_t v = 1;
        for (int i = j - 1; i >= 0; i--) {
            const int64_t number = escape + 21 + min(j, 19) * 2 + (i != j - 1);
            v = (v << 1) | (uint32_t)simple((rest >> i) & 1, number);
        }
        return (int)min<uint32_t>(v + (UNARY - 1), 0x7fffffff);
    }

    // The sign of the integer at `out`, by contexts alone.
    FHASH_INLINE int code_sign(const int32_t* out, int x, const Row& row, int64_t S0, int64_t S1,
                               int64_t S2, Slot* const* signs, int kind, int bit) {
        const int left = x > 0 ? sign_of(out[-1]) : 1, left2 = x > 1 ? sign_of(out[-2]) : 1;
        const int up = row.y > 0 ? sign_of(out[-S2]) : 1;
        const int up2 = row.y > 1 ? sign_of(out[-2 * S2]) : 1;
        const int below = row.z > 0 ? sign_of(out[-S1]) : 1;
        const int before = row.t > 0 ? sign_of(out[-S0]) : 1;
        Prediction sign;
        sign.slots[0] = signs[0] + kind * 27 + (left * 3 + up) * 3 + before;
        sign.slots[1] = signs[1] + kind * 81 + ((left * 3 + left2) * 3 + up) * 3 + up2;
        sign.slots[2] = signs[2] + kind * 27 + (before * 3 + below) * 3 + left;
        sign.first = sign.second = state->weights.data() + SIGNS + kind * SET;
        bit = range.code(bit, mix<SIGN_CONTEXTS, false>(sign));
        learn<SIGN_CONTEXTS, false>(sign, bit, SIGN_LIMIT);
        return bit;
    }

    FHASH_INLINE int64_t run();
};

// Code all bands. 0, or -1 for bytes that no encoder writes and for a band beyond the shape, or
// NO_TRELLIS.
template <Mode MODE, Model MODEL, bool TRELLIS>
FHASH_INLINE int64_t Coder<MODE, MODEL, TRELLIS>::run() {
    int32_t* const q = task.q;
    const float* const scaled = task.scaled;
    const int64_t* const shape = task.shape;
    const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
    const int64_t count = task.count;
    std::vector<Band> bands(count);
    if (!read_bands(task.table, shape, bands)) return -1;
    int widest = 0;
    for (const Band& band : bands) widest = max(widest, band.size[3]);
    Slot *slots[CONTEXTS], *flags[CONTEXTS];
    Slot* signs[SIGN_CONTEXTS];
    Slot *at = state->slots.data(), *flag_at = task.flags->slots.data();
    for (int i = 0; i < CONTEXTS; i++) {
        slots[i] = at;
        flags[i] = flag_at;
        at += (int64_t)SIZES[i] * DECISIONS;
        flag_at += (int64_t)SIZES[i] * 2;
    }
    for (int i = 0; i < SIGN_CONTEXTS; i++) {
        signs[i] = at;
        at += SIGN_SIZES[i];
    }
    int16_t* const weights = state->weights.data();
    // A row of zeros stands for rows that do not exist.
    std::vector<uint16_t> zeros((size_t)widest + 2 * PADDING + VECTOR, 0);
    const uint16_t* const nothing = zeros.data() + PADDING;
    Sums sums((size_t)widest + VECTOR);
    const size_t log_count = MODEL != BY_CONTEXTS ? (size_t)widest + 2 * LOG_PADDING : 0;
    const std::vector<int16_t> no_logs(log_count, 0);
    const int16_t* const no_log = no_logs.data() + (MODEL != BY_CONTEXTS ? LOG_PADDING : 0);
    Logs logs;
    int trellis = 0;
    int settled[2] = {0, 0};  // by class: probability of a 0 among zeros, as long as it stays

    for (int64_t number = 0; number < count; number++) {
        Band& band = bands[number];
        const int n0 = band.size[0], n1 = band.size[1], n2 = band.size[2], n3 = band.size[3];
        const int kind = band.kind, lanes = (n3 + VECTOR - 1) / VECTOR * VECTOR;
        const int64_t origin = band.low[0] * S0 + band.low[1] * S1 + band.low[2] * S2 + band.low[3];

        // Whether the band has an integer other than 0.
        int any = 0;
        if (MODE != DECODE)
            for (int64_t r = 0; r < (int64_t)n0 * n1 * n2 && !any; r++) {
                const int32_t* row = q + origin + r / n2 / n1 * S0 + r / n2 % n1 * S1 + r % n2 * S2;
                for (int x = 0; x < n3; x++) any |= row[x] != 0;
            }
        any = simple(any, EMPTIES + kind);
        band.any = any != 0;
        settled[0] = settled[1] = 0;
        if (!any) {
            if (TRELLIS) trellis = after_zeros(trellis, (int64_t)n0 * n1 * n2 * n3);
            continue;
        }
        const int64_t M2 = n3 + 2 * PADDING, M1 = M2 * n2, M0 = M1 * n1;
        const int64_t R1 = n2, R0 = (int64_t)n1 * n2;
        band.stride[0] = M0;
        band.stride[1] = M1;
        band.stride[2] = M2;
        band.magnitudes.assign((size_t)M0 * n0 + VECTOR, 0);
        band.filled.assign((size_t)R0 * n0, 0);
        const int64_t L2 = n3 + 2 * LOG_PADDING;
        if (MODEL != BY_CONTEXTS) band.logs.assign((size_t)(R0 * n0 * L2), 0);

        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            const int64_t r = t * R0 + z * R1 + y;
            int32_t* const out = q + origin + t * S0 + z * S1 + y * S2;
            uint16_t* const M = band.magnitudes.data() + r * M2 + PADDING;
            const uint8_t* const F = band.filled.data() + r;
            const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
            Row row = {t, z, y, M, F, {}, {}};

            // Whether the row has an integer other than 0, where no row around it has one.
            const int parent_filled = find_references(bands, band, row);
            if (!((has_y && F[-1]) || (has_z && F[-R1]) || (has_t && F[-R0]) || parent_filled)) {
                int filled = 0;
                if (MODE != DECODE) for (int x = 0; x < n3; x++) filled |= out[x] != 0;
                const int flag = (n3 > 24 ? 2 : 0) + (y > 1 && F[-2] ? 1 : 0) + (r == 0 ? 4 : 0);
                if (!simple(filled, ROWS + flag)) {
                    if (TRELLIS) trellis = after_zeros(trellis, n3);
                    continue;
                }
            }

            const Around around = rows_around(band, row, nothing);
            const int weight =
                around.weight + sum_references(bands, band, row, lanes, nothing, sums);
            const int offset = 160 - log16(weight);
            sum_neighbours<true>(around, kind, lanes, sums);
            const int32_t* FHASH_RESTRICT const expected = sums.expected;
            const int32_t* FHASH_RESTRICT const plane = sums.plane;
            const int32_t* FHASH_RESTRICT const both = sums.both;
            const int32_t* FHASH_RESTRICT const nearest = sums.nearest;
            const int32_t* FHASH_RESTRICT const sides = sums.sides;
            const int32_t* FHASH_RESTRICT const others = sums.others;
            const int32_t* FHASH_RESTRICT const parent = sums.parent;
            const int32_t* FHASH_RESTRICT const nears = sums.near;
            const int32_t* FHASH_RESTRICT const wide = sums.wide;
            int filled = 0, left = 0, left2 = 0;
            if (MODEL == BY_LINEAR) find_logs(bands, band, t, z, y, no_log, logs);

            // Whether the integer at x is, or may be read as, 0 without a choice.
            auto may_be_zero = [&](const int32_t* from, int x) FHASH_LAMBDA {
                if (MODE == DECODE) return true;
                if (MODE == ENCODE) return from[x] == 0;
                if (!(std::fabs(scaled[from - q + x]) < 0.5F)) return false;
                out[x] = 0;
                return true;
            };

            for (int x = 0; x < n3; x++) {
                const uint32_t mu = (uint32_t)(expected[x] + LEFT * left + LEFT2 * left2);
                const int one = TRELLIS ? trellis & 1 : 0;  // class of the quantiser
                // Where all around is 0 and nothing moves any more, only the range does.
                int begun = 0;
                if (MODEL != BY_LINEAR && !mu && settled[one] && may_be_zero(out, x)) {
                    if (range.code(1, (uint32_t)settled[one])) {
                        if (TRELLIS) trellis = TRELLIS_NEXT[trellis][0];
                        continue;
                    }
                    begun = 1;
                }
                const int level = level_of(mu, offset), coarse = level / 2;
                const int near = plane[x] + 2 * left + left2;
                int context[CONTEXTS] = {level,    kind * 64 + coarse, nearest[x],
                                         nears[x], others[x],          wide[x]};
                if (left | left2) {
                    context[2] += min(left, 2) * 243;
                    context[3] = small(near) * 144 + sides[x];
                    context[5] = small((near + both[x]) / 2) * (12 * KINDS) + parent[x];
                }
                const Vertex vertex = {kind,
                                       coarse,
                                       near,
                                       min(small(both[x]), 6),
                                       min(parent[x] / KINDS, 6),
                                       mu ? max(log16(mu) + offset + 4, 0) : 0,
                                       one};
                if constexpr (MODEL == BY_LINEAR) task.magnitudes->gather(logs, x, vertex);
                auto predict = [&](Decision<MODEL>& to, int asked) FHASH_LAMBDA {
                    const int k = TRELLIS && one && asked < SHARED ? UNARY + asked : asked;
                    Slot** places;
                    if constexpr (MODEL == BY_LINEAR) places = to.contexts.slots;
                    else places = to.slots;
                    for (int i = 0; i < CONTEXTS; i++)
                        places[i] = asked ? slots[i] + (int64_t)context[i] * DECISIONS + k
                                          : flags[i] + (int64_t)context[i] * 2 + one;
                    if constexpr (MODEL == BY_LINEAR) {
                        return task.magnitudes->predict(to, vertex, k);
                    } else {
                        to.first = weights + ((int64_t)k * KINDS + kind) * SET;
                        to.second = weights + SECOND + ((int64_t)k * 64 + coarse) * SET;
                        return mix<CONTEXTS, true>(to);
                    }
                };
                auto learn_from = [&](Decision<MODEL>& from, int bit) FHASH_LAMBDA {
                    if constexpr (MODEL == BY_LINEAR) task.magnitudes->learn(from, bit);
                    else learn<CONTEXTS, true>(from, bit, SLOW_LIMIT);
                };

                // The zero flag.
                Decision<MODEL> now;
                int p = predict(now, 0), value = MODE == DECODE ? 0 : out[x];
                if (TRELLIS && MODE != DECODE && value && (value & 1) != one) return NO_TRELLIS;
                if (MODE == CHOOSE) {
                    const float s = scaled[out - q + x];
                    const int best = choose(std::fabs((double)s), p, predict);
                    out[x] = value = s < 0 ? -best : best;
                }
                int magnitude = TRELLIS ? (std::abs(value) + one) / 2 : std::abs(value);
                const int zero = begun ? 0 : range.code(magnitude == 0, p);
                if constexpr (MODEL != BY_LINEAR) {
                    const bool stays = !mu && zero && settled_at_one<CONTEXTS>(now, SLOW_LIMIT);
                    settled[one] = stays ? p : 0;
                    if (!stays) learn_from(now, zero);
                } else {
                    learn_from(now, zero);
                }
                left2 = left;
                left = 0;
                if (zero) {
                    if (TRELLIS) trellis = TRELLIS_NEXT[trellis][0];
                    continue;
                }

                // The sign. What it takes to predict the magnitude is computed beside it.
                p = predict(now, 1);
                int negative;
                if (MODEL != BY_CONTEXTS) {
                    if (MODEL == BY_SIGNS && !filled)
                        find_logs(bands, band, t, z, y, no_log, logs);
                    negative = task.signs->code(range, logs, kind, t, y, x, value < 0);
                } else {
                    negative = code_sign(out + x, x, row, S0, S1, S2, signs, kind, value < 0);
                }
                filled = 1;

                // The magnitude.
                int k = 1;
                for (; k < UNARY; k++) {
                    if (k > 1) p = predict(now, k);
                    const int more = range.code(magnitude > k, p);
                    learn_from(now, more);
                    if (!more) break;
                }
                if (k == UNARY) {
                    k = code_escape(magnitude, level);
                    if (k < 0) return -1;
                }
                if (MODE == DECODE) {
                    magnitude = k;
                    if (TRELLIS) k = (int)(min<int64_t>(2 * (int64_t)k - one, 0x7fffffff));
                    out[x] = (k ^ -negative) + negative;
                }
                if (TRELLIS) trellis = TRELLIS_NEXT[trellis][magnitude & 1];
                if (MODEL != BY_CONTEXTS)
                    band.logs[r * L2 + LOG_PADDING + x] = signed_log(magnitude, negative != 0);
                left = min(magnitude, MAX_MAGNITUDE);
                M[x] = (uint16_t)left;
            }
            band.filled[r] = (uint8_t)filled;
        }
    }
    return 0;
}

}  // namespace
