// Entropy coding of quantised transform coefficients: an adaptive binary range coder whose
// probabilities are mixed from several contexts.
//
// A decoder computes with integers only, so encoder and decoder agree on every machine.
// tests/reference/integers.py explains it.
//
// A coefficient is coded as a zero flag, its sign, and its magnitude: in unary up to 13, beyond
// that by an Exp-Golomb code. Each binary decision k (0 is the zero flag, any other asks "more than
// k") is predicted by CONTEXTS adaptive estimates, each with a slow and a fast rate. They are mixed
// in the logistic domain by weights that learn as well, as in the PAQ family of compressors.
// Contexts come from magnitudes that are already known: to the left, above, one step and one layer
// before, and in the bands that come before. Signs are predicted by coder_signs.hpp.
//
// On a trellis the integers are those of two quantisers: the index of each is coded, and says how
// the state goes on that chooses the next quantiser (FORMAT.md, Two quantisers).
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "coder_signs.hpp"
#include "functions.h"

namespace {

// What a run is given: integers in the bands of a table, the coder's state, and bytes to write or
// to read.
struct Task {
    State* state;
    Flags* flags;
    Signs* signs;
    int32_t* q;
    bool trellis;         // whether the integers are those of two quantisers
    const float* scaled;  // null, or what integers are chosen of
    double lambda;        // squared steps that 1/2048 bit is worth
    const int64_t* shape;
    const int32_t* table;
    int64_t count;  // bands of the table
    std::vector<uint8_t>* out;
    const uint8_t* data;
    int64_t size;
};

template <Mode MODE>
using Range = typename std::conditional<MODE == DECODE, Decoder, Encoder>::type;

template <Mode MODE> FHASH_INLINE Range<MODE> range_of(const Task& task) {
    if constexpr (MODE == DECODE) return Decoder(task.data, task.size);
    else return Encoder{task.out};
}
FHASH_INLINE void finish(Encoder& range) { range.finish(); }
FHASH_INLINE void finish(Decoder&) {}

// One run over the bands of a tile.
template <Mode MODE> struct Coder {
    Range<MODE> range;
    const Task& task;
    const bool trellised = task.trellis;
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
        Prediction other;
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
    int code_escape(int magnitude, int level) {
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

    int64_t run();
};

// Code all bands. 0, or -1 for bytes that no encoder writes and for a band beyond the shape, or
// NO_TRELLIS.
template <Mode MODE> int64_t Coder<MODE>::run() {
    int32_t* const q = task.q;
    const float* const scaled = task.scaled;
    const int64_t* const shape = task.shape;
    const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
    const int64_t count = task.count;
    std::vector<Band> bands(count);
    if (!read_bands(task.table, shape, bands)) return -1;
    int widest = 0;
    bool referred = false;  // whether bands have references
    for (const Band& band : bands) {
        widest = max(widest, band.size[3]);
        for (const Reference& reference : band.references) referred |= reference.band >= 0;
    }
    Slot *slots[CONTEXTS], *flags[CONTEXTS];
    Slot *at = state->slots.data(), *flag_at = task.flags->slots.data();
    for (int i = 0; i < CONTEXTS; i++) {
        slots[i] = at;
        flags[i] = flag_at;
        at += (int64_t)SIZES[i] * DECISIONS;
        flag_at += (int64_t)SIZES[i] * 2;
    }
    int16_t* const weights = state->weights.data();
    // A row of zeros stands for rows that do not exist.
    std::vector<uint16_t> zeros((size_t)widest + 2 * PADDING + VECTOR, 0);
    const uint16_t* const nothing = zeros.data() + PADDING;
    Sums sums((size_t)widest + VECTOR);
    const std::vector<int16_t> no_logs((size_t)widest + 2 * LOG_PADDING, 0);
    const int16_t* const no_log = no_logs.data() + LOG_PADDING;
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
            if (trellised) trellis = after_zeros(trellis, (int64_t)n0 * n1 * n2 * n3);
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
        band.logs.assign((size_t)(R0 * n0 * L2), 0);

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
                    if (trellised) trellis = after_zeros(trellis, n3);
                    continue;
                }
            }

            const Around around = rows_around(band, row, nothing);
            const int weight =
                around.weight + sum_references(bands, band, row, lanes, nothing, sums);
            const int offset = 160 - log16(weight);
            sum_neighbours<true>(around, lanes, sums);
            const int32_t* FHASH_RESTRICT const expected = sums.expected;
            const int32_t* FHASH_RESTRICT const plane = sums.plane;
            const int32_t* FHASH_RESTRICT const nearest = sums.nearest;
            const int32_t* FHASH_RESTRICT const sides = sums.sides;
            const int32_t* FHASH_RESTRICT const others = sums.others;
            const int32_t* FHASH_RESTRICT const nears = sums.near;
            int filled = 0, left = 0, left2 = 0;

            // Whether the integer at x is, or may be read as, 0 without a choice.
            auto may_be_zero = [&](const int32_t* from, int x) FHASH_LAMBDA {
                if (MODE == DECODE) return true;
                if (!scaled) return from[x] == 0;
                if (!(std::fabs(scaled[from - q + x]) < 0.5F)) return false;
                out[x] = 0;
                return true;
            };

            for (int x = 0; x < n3; x++) {
                const uint32_t mu = (uint32_t)(expected[x] + LEFT * left + LEFT2 * left2);
                const int one = trellised ? trellis & 1 : 0;  // class of the quantiser
                // Where all around is 0 and nothing moves any more, only the range does.
                int begun = 0;
                if (!mu && settled[one] && may_be_zero(out, x)) {
                    if (range.code(1, (uint32_t)settled[one])) {
                        if (trellised) trellis = TRELLIS_NEXT[trellis][0];
                        continue;
                    }
                    begun = 1;
                }
                const int level = level_of(mu, offset), coarse = level / 2;
                const int near = plane[x] + 2 * left + left2;
                int context[CONTEXTS] = {level, nearest[x], nears[x], others[x]};
                if (left | left2) {
                    context[1] += min(left, 2) * 243;
                    context[2] = small(near) * 144 + sides[x];
                }
                auto predict = [&](Prediction& to, int asked) FHASH_LAMBDA {
                    const int k = one && asked < SHARED ? UNARY + asked : asked;
                    for (int i = 0; i < CONTEXTS; i++)
                        to.slots[i] = asked ? slots[i] + (int64_t)context[i] * DECISIONS + k
                                            : flags[i] + (int64_t)context[i] * 2 + one;
                    to.first = weights + ((int64_t)k * KINDS + kind) * SET;
                    to.second = weights + SECOND + ((int64_t)k * 64 + coarse) * SET;
                    return mix<CONTEXTS, true>(to);
                };
                auto learn_from = [&](Prediction& from, int bit) FHASH_LAMBDA {
                    learn<CONTEXTS, true>(from, bit, SLOW_LIMIT);
                };

                // The zero flag.
                Prediction now;
                int p = predict(now, 0), value = MODE == DECODE ? 0 : out[x];
                if (trellised && MODE != DECODE && value && (value & 1) != one) return NO_TRELLIS;
                if (MODE == ENCODE && scaled) {
                    const float s = scaled[out - q + x];
                    const int best = choose(std::fabs((double)s), p, predict);
                    out[x] = value = s < 0 ? -best : best;
                }
                int magnitude = trellised ? (std::abs(value) + one) / 2 : std::abs(value);
                const int zero = begun ? 0 : range.code(magnitude == 0, p);
                const bool stays = !mu && zero && settled_at_one<CONTEXTS>(now, SLOW_LIMIT);
                settled[one] = stays ? p : 0;
                if (!stays) learn_from(now, zero);
                left2 = left;
                left = 0;
                if (zero) {
                    if (trellised) trellis = TRELLIS_NEXT[trellis][0];
                    continue;
                }

                // The sign. What it takes to predict the magnitude is computed beside it.
                p = predict(now, 1);
                if (!filled) find_logs(bands, band, t, z, y, no_log, logs);
                const int negative =
                    referred ? task.signs->code<true>(range, logs, kind, y, x, value < 0)
                             : task.signs->code<false>(range, logs, kind, y, x, value < 0);
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
                    if (trellised) k = (int)(min<int64_t>(2 * (int64_t)k - one, 0x7fffffff));
                    out[x] = (k ^ -negative) + negative;
                }
                if (trellised) trellis = TRELLIS_NEXT[trellis][magnitude & 1];
                band.logs[r * L2 + LOG_PADDING + x] = signed_log(magnitude, negative != 0);
                left = min(magnitude, MAX_MAGNITUDE);
                M[x] = (uint16_t)left;
            }
            band.filled[r] = (uint8_t)filled;
        }
    }
    return 0;
}

// One run. It works on a coder of its own, whose range can then stay in registers.
template <Mode MODE> int64_t run(const Task& task) {
    Coder<MODE> coder = {range_of<MODE>(task), task};
    const int64_t code = coder.run();
    finish(coder.range);
    return code;
}

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (plan.cpp).
// Integers outside the bands count as 0.
//
// scaled: null, or coefficients / step: then the magnitudes are chosen anew and written to q.
// lambda: squared steps that a bit is worth.
// trellis: whether the integers are those of two quantisers; not together with `scaled`.
// table: (count, COLUMNS).
// slots, weights, simples: the state (priors.hpp). It is left adapted if `keep` and
// if the bytes fit.
// data: receives the bytes if they fit the capacity. If they do not, call again with the same q and
// more room.
//
// Returns the number of bytes, NO_MEMORY, or NO_TRELLIS for an integer that its quantiser lacks.
FHASH_FOR_TARGETS(fhash_encode,
                  (int32_t* q, const float* scaled, double lambda, int64_t trellis,
                   const int64_t* shape, const int32_t* table, int64_t count, uint16_t* slots,
                   int64_t slot_count, int32_t* weights, int64_t weight_count, uint16_t* simples,
                   int64_t simple_count, int64_t keep, uint8_t* data, int64_t capacity),
                  (q, scaled, lambda, trellis, shape, table, count, slots, slot_count, weights,
                   weight_count, simples, simple_count, keep, data, capacity)) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, min(weight_count, BASE_WEIGHTS),
                                 simples, simple_count, LANES);
        Signs signs(state, weights);
        Flags flags(state);
        std::vector<uint8_t> out;
        const bool trellised = trellis != 0;
        const Task task = {&state, &flags, &signs, q,    trellised, scaled, lambda / 2048,
                           shape,  table,  count,  &out, nullptr,   0};
        const int64_t code = run<ENCODE>(task);
        if (code < 0) return code;
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) {
            flags.keep(state);
            keep_state(state, slots, weights, simples, LANES);
            signs.keep(weights);
        }
        return size;
    });
}

// Decode integers into q, which must be zeros; the other arguments are those of fhash_encode.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_decode,
                  (int32_t* q, int64_t trellis, const int64_t* shape, const int32_t* table,
                   int64_t count, const uint16_t* slots, int64_t slot_count,
                   const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                   int64_t simple_count, const uint8_t* data, int64_t size),
                  (q, trellis, shape, table, count, slots, slot_count, weights, weight_count,
                   simples, simple_count, data, size)) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, min(weight_count, BASE_WEIGHTS),
                                 simples, simple_count, LANES);
        Signs signs(state, const_cast<int32_t*>(weights));
        Flags flags(state);
        const bool trellised = trellis != 0;
        const Task task = {&state, &flags, &signs, q,       trellised, nullptr, 0,
                           shape,  table,  count,  nullptr, data,      size};
        return run<DECODE>(task);
    });
}
