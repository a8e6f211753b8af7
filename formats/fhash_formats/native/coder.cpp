// Entropy coding of quantised transform coefficients: an adaptive binary range coder whose
// probabilities are mixed from several contexts.
//
// A decoder computes with integers only, so encoder and decoder agree on every machine. The
// portable coder (transform/entropy/coder_portable.py) follows this file step by step and gives the
// same bytes.
//
// A coefficient is coded as a zero flag, its sign, and its magnitude: in unary up to 13, beyond
// that by an Exp-Golomb code. Each binary decision k (0 is the zero flag, any other asks "more than
// k") is predicted by CONTEXTS adaptive estimates, each with a slow and a fast rate. They are mixed
// in the logistic domain by weights that learn as well, as in the PAQ family of compressors.
// Contexts come from magnitudes that are already known: to the left, above, one step and one layer
// before, and in the bands that come before.
//
// With TRELLIS the integers are those of two quantisers: the index of each is coded, and says how
// the state goes on that chooses the next quantiser (FORMAT.md, Two quantisers).
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "coder_contexts.hpp"

namespace {

// One run over the bands of a tile.
template <Mode MODE, bool TRELLIS> struct Coder {
    typename std::conditional<MODE == DECODE, Decoder, Encoder>::type range;
    State* state;
    double lambda;  // squared steps that 1/2048 bit is worth

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
        if (nearest == 1) {
            const int stop = predict(other, 1);
            const double one = (s - 1) * (s - 1) + lambda * tables.cost[65536 - stop];
            return zero <= one + other_than_zero ? 0 : 1;
        }
        const int before = predict(other, nearest - 1), stop = predict(other, nearest);
        const double same = (s - nearest) * (s - nearest) +
                            lambda * (tables.cost[before] + tables.cost[65536 - stop]);
        const double less = (s - nearest + 1) * (s - nearest + 1) +
                            lambda * tables.cost[65536 - before];
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

    FHASH_INLINE int64_t run(int32_t* q, const float* scaled, const int64_t* shape,
                             const int32_t* table, int64_t count);
};

// Code all bands. q, scaled, shape, table, count: as for fhash_encode and fhash_decode below.
// 0, or -1 for bytes that no encoder writes and for a band beyond the shape, or NO_TRELLIS.
template <Mode MODE, bool TRELLIS>
FHASH_INLINE int64_t Coder<MODE, TRELLIS>::run(int32_t* q, const float* scaled,
                                               const int64_t* shape,
                                               const int32_t* table, int64_t count) {
    const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
    std::vector<Band> bands(count);
    if (!read_bands(table, shape, bands)) return -1;
    int widest = 0;
    for (const Band& band : bands) widest = max(widest, band.size[3]);
    Slot* slots[CONTEXTS];
    Slot* signs[SIGN_CONTEXTS];
    Slot* at = state->slots.data();
    for (int i = 0; i < CONTEXTS; i++) {
        slots[i] = at;
        at += (int64_t)SIZES[i] * DECISIONS;
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
    int trellis = 0;

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

            const int weight = sum_neighbours(band, row, lanes, sums) +
                               sum_references(bands, band, row, lanes, nothing, sums);
            const int offset = 160 - log16(weight);
            prepare_contexts(band, row, lanes, nothing, sums);
            const int32_t* FHASH_RESTRICT const expected = sums.expected;
            const int32_t* FHASH_RESTRICT const plane = sums.plane;
            const int32_t* FHASH_RESTRICT const both = sums.both;
            const int32_t* FHASH_RESTRICT const nearest = sums.nearest;
            const int32_t* FHASH_RESTRICT const sides = sums.sides;
            const int32_t* FHASH_RESTRICT const others = sums.others;
            const int32_t* FHASH_RESTRICT const parent = sums.parent;
            int filled = 0, left = 0, left2 = 0;

            for (int x = 0; x < n3; x++) {
                const uint32_t mu = (uint32_t)(expected[x] + LEFT * left + LEFT2 * left2);
                const int level = mu ? min((log16(mu) + offset) / 4 + 1, LEVELS - 1) : 0;
                const int coarse = level / 2;
                const int near = plane[x] + 2 * left + left2;
                const int context[CONTEXTS] = {
                    level,
                    kind * 64 + coarse,
                    min(left, 2) * 243 + nearest[x],
                    small(near) * 144 + sides[x],
                    others[x],
                    small((near + both[x]) / 2) * (12 * KINDS) + parent[x],
                };
                Slot* places[CONTEXTS];
                for (int i = 0; i < CONTEXTS; i++)
                    places[i] = slots[i] + (int64_t)context[i] * DECISIONS;
                const int one = TRELLIS ? trellis & 1 : 0;  // class of the quantiser
                auto predict = [&](Prediction& to, int asked) FHASH_LAMBDA {
                    const int k = TRELLIS && one && asked < SHARED ? UNARY + asked : asked;
                    for (int i = 0; i < CONTEXTS; i++) to.slots[i] = places[i] + k;
                    to.first = weights + ((int64_t)k * KINDS + kind) * SET;
                    to.second = weights + SECOND + ((int64_t)k * 64 + coarse) * SET;
                    return mix<CONTEXTS, true>(to);
                };

                // The zero flag.
                Prediction now;
                int p = predict(now, 0), value = MODE == DECODE ? 0 : out[x];
                if (TRELLIS && MODE != DECODE && value && (value & 1) != one) return NO_TRELLIS;
                if (MODE == CHOOSE) {
                    const float s = scaled[out - q + x];
                    const int best = choose(std::fabs((double)s), p, predict);
                    out[x] = value = s < 0 ? -best : best;
                }
                int magnitude = TRELLIS ? (std::abs(value) + one) / 2 : std::abs(value);
                const int zero = range.code(magnitude == 0, p);
                learn<CONTEXTS, true>(now, zero, SLOW_LIMIT);
                left2 = left;
                left = 0;
                if (zero) {
                    if (TRELLIS) trellis = TRELLIS_NEXT[trellis][0];
                    continue;
                }
                filled = 1;

                // The sign.
                const int left_sign = x > 0 ? sign_of(out[x - 1]) : 1;
                const int left2_sign = x > 1 ? sign_of(out[x - 2]) : 1;
                const int y_sign = has_y ? sign_of(out[x - S2]) : 1;
                const int y2_sign = y > 1 ? sign_of(out[x - 2 * S2]) : 1;
                const int z_sign = has_z ? sign_of(out[x - S1]) : 1;
                const int t_sign = has_t ? sign_of(out[x - S0]) : 1;
                Prediction sign;
                sign.slots[0] = signs[0] + kind * 27 + (left_sign * 3 + y_sign) * 3 + t_sign;
                sign.slots[1] = signs[1] + kind * 81 +
                                ((left_sign * 3 + left2_sign) * 3 + y_sign) * 3 + y2_sign;
                sign.slots[2] = signs[2] + kind * 27 + (t_sign * 3 + z_sign) * 3 + left_sign;
                sign.first = sign.second = weights + SIGNS + kind * SET;
                const int negative = range.code(value < 0, mix<SIGN_CONTEXTS, false>(sign));
                learn<SIGN_CONTEXTS, false>(sign, negative, SIGN_LIMIT);

                // The magnitude.
                int k = 1;
                for (; k < UNARY; k++) {
                    p = predict(now, k);
                    const int more = range.code(magnitude > k, p);
                    learn<CONTEXTS, true>(now, more, SLOW_LIMIT);
                    if (!more) break;
                }
                if (k == UNARY) {
                    k = code_escape(magnitude, level);
                    if (k < 0) return -1;
                }
                if (MODE == DECODE) {
                    magnitude = k;
                    if (TRELLIS) k = (int)(min<int64_t>(2 * (int64_t)k - one, 0x7fffffff));
                    out[x] = negative ? -k : k;
                }
                if (TRELLIS) trellis = TRELLIS_NEXT[trellis][magnitude & 1];
                left = min(magnitude, MAX_MAGNITUDE);
                M[x] = (uint16_t)left;
            }
            band.filled[r] = (uint8_t)filled;
        }
    }
    return 0;
}

// The bytes of all bands behind those of `range`. 0, or a negative code.
template <Mode MODE, bool TRELLIS>
FHASH_INLINE int64_t encode_all(Coder<MODE, TRELLIS>& coder, int32_t* q, const float* scaled,
                                const int64_t* shape, const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        const int64_t code = coder.run(q, scaled, shape, table, count);
        coder.range.finish();
        return code;
    });
}

FHASH_CLONES int64_t encode(Coder<ENCODE, false> coder, int32_t* q, const int64_t* shape,
                            const int32_t* table, int64_t count) {
    return encode_all(coder, q, nullptr, shape, table, count);
}
FHASH_CLONES int64_t encode_trellis(Coder<ENCODE, true> coder, int32_t* q, const int64_t* shape,
                                    const int32_t* table, int64_t count) {
    return encode_all(coder, q, nullptr, shape, table, count);
}
FHASH_CLONES int64_t encode_chosen(Coder<CHOOSE, false> coder, int32_t* q, const float* scaled,
                                   const int64_t* shape, const int32_t* table, int64_t count) {
    return encode_all(coder, q, scaled, shape, table, count);
}
FHASH_CLONES int64_t decode(Coder<DECODE, false> coder, int32_t* q, const int64_t* shape,
                            const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA { return coder.run(q, nullptr, shape, table, count); });
}
FHASH_CLONES int64_t decode_trellis(Coder<DECODE, true> coder, int32_t* q, const int64_t* shape,
                                    const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA { return coder.run(q, nullptr, shape, table, count); });
}

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (axes/bands.py). Integers
// outside the bands count as 0.
//
// scaled: null, or coefficients / step: then the magnitudes are chosen anew and written to q.
// lambda: squared steps that a bit is worth.
// trellis: whether the integers are those of two quantisers; not together with `scaled`.
// table: (count, COLUMNS).
// slots, weights, simples: the state (transform/entropy/prior.py). It is left adapted if `keep` and
// if the bytes fit.
// data: receives the bytes if they fit the capacity. If they do not, call again with the same q and
// more room.
//
// Returns the number of bytes, NO_MEMORY, or NO_TRELLIS for an integer that its quantiser lacks.
FHASH_EXPORT int64_t fhash_encode(int32_t* q, const float* scaled, double lambda,
                                  int64_t trellis,
                                  const int64_t* shape, const int32_t* table, int64_t count,
                                  uint16_t* slots, int64_t slot_count, int32_t* weights,
                                  int64_t weight_count, uint16_t* simples, int64_t simple_count,
                                  int64_t keep, uint8_t* data, int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        std::vector<uint8_t> out;
        const Encoder range = {&out};
        const int64_t code =
            scaled ? encode_chosen({range, &state, lambda / 2048}, q, scaled, shape, table, count)
            : trellis ? encode_trellis({range, &state, 0}, q, shape, table, count)
                      : encode({range, &state, 0}, q, shape, table, count);
        if (code < 0) return code;
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) keep_state(state, slots, weights, simples, LANES);
        return size;
    });
}

// Decode integers into q, which must be zeros; the other arguments are those of fhash_encode.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode(int32_t* q, int64_t trellis, const int64_t* shape, const int32_t* table,
                                  int64_t count, const uint16_t* slots, int64_t slot_count,
                                  const int32_t* weights, int64_t weight_count,
                                  const uint16_t* simples, int64_t simple_count,
                                  const uint8_t* data, int64_t size) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        return trellis ? decode_trellis({{data, size}, &state, 0}, q, shape, table, count)
                       : decode({{data, size}, &state, 0}, q, shape, table, count);
    });
}
