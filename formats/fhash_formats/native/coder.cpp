// Entropy coding of quantised transform coefficients: an adaptive binary range coder whose probabilities are mixed from several contexts.
//
// Everything that a decoder computes is integer arithmetic, so that encoder and decoder can never part, whatever the machine. The portable
// coder (transform/coder_portable.py) follows this file step by step and gives the same bytes.
//
// A coefficient is coded as a zero flag, its sign, and its magnitude in unary up to 13, beyond that in an Exp-Golomb code. Each binary
// decision k (0 the zero flag, then "more than k") is predicted by CONTEXTS adaptive estimates, each with a slow and a fast rate, that are
// mixed in the logistic domain by weights which learn as well (as in the PAQ family of compressors). Contexts see magnitudes that are
// already known: to the left, above, one step and one layer before, and in the bands that come before.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <type_traits>
#include <vector>

#include "mixing.hpp"

namespace {

const int CONTEXTS = 6, SIGN_CONTEXTS = 3, LANES = 12, SET = padded(LANES);  // SET: of weights, as they are kept here
const int DECISIONS = 16, UNARY = 14, KINDS = 64, LEVELS = 128;  // LEVELS: buckets of the expected magnitude, quarter octaves
const int SIGN_LIMIT = 255;
const int MAX_MAGNITUDE = 4095;  // as contexts see it, so that sums stay in 32 bits
const int COLUMNS = 29;          // of the table of bands: low[4], high[4], kind, 4 x (band, shift[4])
const int PADDING = 2;           // zeros beside a row of magnitudes
const int VECTOR = 16;           // sums over a row are made for a multiple of it: what lies beyond the row is never looked at
// Weights of neighbours in the expected magnitude, in 1/1024: left, second left, above, its neighbours, second above, before (t or z),
// around it, second before, reference, around it.
const int LEFT = 184, LEFT2 = 20, ABOVE = 184, DIAGONAL = 61, ABOVE2 = 41, BEFORE = 102, AROUND = 20, BEFORE2 = 31, REFERENCE = 62;

const int SIZES[CONTEXTS] = {LEVELS, KINDS * 64, 729, 12 * 12 * 12, 7 * 7 * 7 * 7, 12 * 12 * KINDS};
const int SIGN_SIZES[SIGN_CONTEXTS] = {KINDS * 27, KINDS * 81, KINDS * 27};
const int64_t SECOND = int64_t(KINDS) * DECISIONS * SET, SIGNS = SECOND + 64 * DECISIONS * SET;  // where these weights begin
const int64_t ROWS = LEVELS * 64, EMPTIES = ROWS + 8;                                              // where these simple estimates begin

// A magnitude, or a sum of some, in 12 classes; without a table, so that rows of them are vectors.
FHASH_INLINE int seven(int v) { return (v > 0) + (v > 1) + (v > 2) + (v > 4) + (v > 6) + (v > 9); }
FHASH_INLINE int twelve(int v) { return seven(v) + (v > 14) + (v > 22) + (v > 36) + (v > 64) + (v > 140); }

struct Classes {
    uint8_t of[142];
    Classes() {
        for (int v = 0; v < 142; v++) of[v] = (uint8_t)twelve(v);
    }
};
const Classes classes;
FHASH_INLINE int small(int v) { return classes.of[min(v, 141)]; }

// The slots go by context, those of a context's decisions together, then those of the signs; the weights go by kind, by expected magnitude, then those of the
// signs; the simple estimates are those of the escape code, of empty rows and of empty bands.
using Prediction = Mixed<CONTEXTS>;

// What is known of a whole row beforehand, vertex by vertex: sums over its neighbours but those to the left, and what contexts take of them.
struct Sums {
    std::vector<int32_t> room;
    int32_t *expected, *plane, *before, *below, *both, *nearest, *sides, *others, *parent, *share, *level;
    explicit Sums(size_t width) : room(11 * width) {
        int32_t* at = room.data();
        for (int32_t** part : {&expected, &plane, &before, &below, &both, &nearest, &sides, &others, &parent, &share, &level}) {
            *part = at;
            at += width;
        }
    }
};

struct Reference {
    int band, shift[4];
};
struct Band {
    int low[4], size[4], kind;
    Reference references[4];
    int64_t stride[3];
    std::vector<uint16_t> magnitudes;  // rows with PADDING zeros at both ends
    std::vector<uint8_t> filled;       // by row: is anything in it
    bool any;
};

FHASH_INLINE int sign_of(int32_t v) { return v > 0 ? 2 : v < 0 ? 0 : 1; }

// MODE 0 encodes, 1 decodes, 2 encodes magnitudes that it chooses by rate and distortion.
template <int MODE> struct Coder {
    typename std::conditional<MODE == 1, Decoder, Encoder>::type range;
    State* state;
    double lambda;  // distortion, in squared steps, that 1/2048 bit is worth

    FHASH_INLINE int simple(int bit, int64_t number) { return code_simple(range, state->simples[number], bit); }

    // The magnitude next to |scaled| that costs least: it, one less, or zero.
    template <class Predict> FHASH_INLINE int choose(double s, int p, Predict predict) {
        s = s < 1e9 ? s : 1e9;  // also what is no number
        const int nearest = (int)(s + 0.5);
        if (nearest == 0 || nearest >= UNARY) return nearest;
        Prediction other;
        const double zero = s * s + lambda * tables.cost[p], other_than_zero = lambda * (tables.cost[65536 - p] + 2048);
        if (nearest == 1) {
            const int stop = predict(other, 1);
            return zero <= (s - 1) * (s - 1) + lambda * tables.cost[65536 - stop] + other_than_zero ? 0 : 1;
        }
        const int before = predict(other, nearest - 1), stop = predict(other, nearest);
        const double same = (s - nearest) * (s - nearest) + lambda * (tables.cost[before] + tables.cost[65536 - stop]);
        const double less = (s - nearest + 1) * (s - nearest + 1) + lambda * tables.cost[65536 - before];
        if (nearest == 2 && zero < min(same, less) + other_than_zero) return 0;
        return less < same ? nearest - 1 : nearest;
    }

    FHASH_INLINE int64_t run(int32_t* q, const float* scaled, const int64_t* shape, const int32_t* table, int64_t count);
};

template <int MODE>
FHASH_INLINE int64_t Coder<MODE>::run(int32_t* q, const float* scaled, const int64_t* shape, const int32_t* table, int64_t count) {
    const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
    std::vector<Band> bands(count);
    int widest = 0;
    for (int64_t b = 0; b < count; b++) {
        const int32_t* row = table + b * COLUMNS;
        for (int a = 0; a < 4; a++) {
            if (row[a] < 0 || row[a] > row[4 + a] || row[4 + a] > shape[a]) return -1;
            bands[b].low[a] = row[a];
            bands[b].size[a] = row[4 + a] - row[a];
        }
        bands[b].kind = row[8];
        for (int r = 0; r < 4; r++) {
            bands[b].references[r].band = row[9 + 5 * r];
            for (int a = 0; a < 4; a++) bands[b].references[r].shift[a] = row[10 + 5 * r + a];
        }
        bands[b].any = false;
        widest = max(widest, bands[b].size[3]);
    }
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
    std::vector<uint16_t> zeros((size_t)widest + 2 * PADDING + VECTOR, 0);
    const uint16_t* const nothing = zeros.data() + PADDING;
    Sums sums((size_t)widest + VECTOR);

    for (int64_t number = 0; number < count; number++) {
        Band& band = bands[number];
        const int n0 = band.size[0], n1 = band.size[1], n2 = band.size[2], n3 = band.size[3], kind = band.kind;
        const int64_t origin = band.low[0] * S0 + band.low[1] * S1 + band.low[2] * S2 + band.low[3];
        int any = 0;
        if (MODE != 1)
            for (int64_t r = 0; r < (int64_t)n0 * n1 * n2 && !any; r++) {
                const int32_t* row = q + origin + r / n2 / n1 * S0 + r / n2 % n1 * S1 + r % n2 * S2;
                for (int x = 0; x < n3; x++) any |= row[x] != 0;
            }
        any = simple(any, EMPTIES + kind);
        band.any = any != 0;
        if (!any) continue;
        const int64_t M2 = n3 + 2 * PADDING, M1 = M2 * n2, M0 = M1 * n1, R1 = n2, R0 = (int64_t)n1 * n2;
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

            // The row of each reference that stands for this row.
            const uint16_t* rows[4] = {nullptr, nullptr, nullptr, nullptr};
            int parent_filled = 0, row_y[4] = {0, 0, 0, 0};
            for (int k = 0; k < 4; k++) {
                const Reference& to = band.references[k];
                if (to.band < 0 || !bands[to.band].any) continue;
                const Band& other = bands[to.band];
                const int rt = min(t >> to.shift[0], other.size[0] - 1), rz = min(z >> to.shift[1], other.size[1] - 1);
                row_y[k] = min(y >> to.shift[2], other.size[2] - 1);
                rows[k] = other.magnitudes.data() + rt * other.stride[0] + rz * other.stride[1] + row_y[k] * other.stride[2] + PADDING;
                if (k == 0) parent_filled = other.filled[((int64_t)rt * other.size[1] + rz) * other.size[2] + row_y[k]];
            }
            if (!((has_y && F[-1]) || (has_z && F[-R1]) || (has_t && F[-R0]) || parent_filled)) {
                int filled = 0;
                if (MODE != 1) for (int x = 0; x < n3; x++) filled |= out[x] != 0;
                if (!simple(filled, ROWS + (n3 > 24 ? 2 : 0) + (y > 1 && F[-2] ? 1 : 0) + (r == 0 ? 4 : 0))) continue;
            }

            // What is known of the whole row beforehand.
            int32_t *FHASH_RESTRICT const expected = sums.expected, *FHASH_RESTRICT const plane = sums.plane;
            const int lanes = (n3 + VECTOR - 1) / VECTOR * VECTOR;
            for (int32_t* part : {sums.expected, sums.plane, sums.before, sums.below}) std::memset(part, 0, 4 * (size_t)lanes);
            int weight = LEFT + LEFT2;
            if (has_y) {
                weight += ABOVE + 2 * DIAGONAL;
                if (F[-1]) {
                    const uint16_t* p = M - M2;
                    FHASH_INDEPENDENT
                    for (int x = 0; x < lanes; x++) {
                        const int sides = p[x - 1] + p[x + 1];
                        expected[x] += ABOVE * p[x] + DIAGONAL * sides;
                        plane[x] += 2 * p[x] + sides;
                    }
                }
                if (y > 1) weight += ABOVE2;
                if (y > 1 && F[-2]) {
                    const uint16_t* p = M - 2 * M2;
                    FHASH_INDEPENDENT
                    for (int x = 0; x < lanes; x++) {
                        expected[x] += ABOVE2 * p[x];
                        plane[x] += p[x];
                    }
                }
            }
            auto neighbour = [&](int32_t* FHASH_RESTRICT sum, bool there, int64_t row, const uint16_t* p) FHASH_LAMBDA {
                if (!there || !F[row]) return;
                FHASH_INDEPENDENT
                for (int x = 0; x < lanes; x++) {
                    expected[x] += AROUND * p[x];
                    sum[x] += p[x];
                }
            };
            auto centre = [&](int32_t* FHASH_RESTRICT sum, int64_t row, const uint16_t* p) FHASH_LAMBDA {
                if (!F[row]) return;
                FHASH_INDEPENDENT
                for (int x = 0; x < lanes; x++) {
                    const int sides = p[x - 1] + p[x + 1];
                    expected[x] += BEFORE * p[x] + AROUND * sides;
                    sum[x] += 2 * p[x] + sides;
                }
            };
            auto second = [&](int64_t row, const uint16_t* p) FHASH_LAMBDA {
                if (!F[row]) return;
                FHASH_INDEPENDENT
                for (int x = 0; x < lanes; x++) expected[x] += BEFORE2 * p[x];
            };
            if (has_t) {
                weight += BEFORE + 4 * AROUND + (t > 1 ? BEFORE2 : 0);
                centre(sums.before, -R0, M - M0);
                neighbour(sums.before, has_y, -R0 - 1, M - M0 - M2);
                neighbour(sums.before, y + 1 < n2, -R0 + 1, M - M0 + M2);
                neighbour(sums.before, has_z, -R0 - R1, M - M0 - M1);
                neighbour(sums.before, z + 1 < n1, -R0 + R1, M - M0 + M1);
                if (t > 1) second(-2 * R0, M - 2 * M0);
            }
            if (has_z) {
                weight += BEFORE + 4 * AROUND + (z > 1 ? BEFORE2 : 0);
                centre(sums.below, -R1, M - M1);
                neighbour(sums.below, has_y, -R1 - 1, M - M1 - M2);
                neighbour(sums.below, y + 1 < n2, -R1 + 1, M - M1 + M2);
                if (z > 1) second(-2 * R1, M - 2 * M1);
            }
            int32_t *FHASH_RESTRICT const others = sums.others, *FHASH_RESTRICT const parent = sums.parent;
            std::memset(sums.others, 0, 4 * (size_t)lanes);
            std::memset(sums.parent, 0, 4 * (size_t)lanes);
            for (int k = 0; k < 4; k++) {
                if (band.references[k].band >= 0) weight += REFERENCE + 2 * AROUND;
                if (!rows[k]) continue;
                const Band& other = bands[band.references[k].band];
                const int shift = band.references[k].shift[3], last = other.size[3] - 1, scale = k == 0 ? 343 : k == 1 ? 49 : k == 2 ? 7 : 1;
                const uint16_t* const p = rows[k];
                const uint16_t* const up = row_y[k] > 0 ? p - other.stride[2] : nothing;
                const uint16_t* const down = row_y[k] + 1 < other.size[2] ? p + other.stride[2] : nothing;
                auto around = [&](int i) FHASH_LAMBDA { return 2 * p[i] + p[i - 1] + p[i + 1] + up[i] + down[i]; };
                if (shift == 0 && last >= n3 - 1) {
                    FHASH_INDEPENDENT
                    for (int x = 0; x < lanes; x++) {
                        const int sum = around(x);
                        expected[x] += REFERENCE * p[x] + AROUND * sum;
                        others[x] += seven(sum) * scale;
                    }
                    if (k == 0) {
                        FHASH_INDEPENDENT
                        for (int x = 0; x < lanes; x++) parent[x] = twelve(around(x));
                    }
                    continue;
                }
                int32_t *FHASH_RESTRICT const share = sums.share, *FHASH_RESTRICT const level = sums.level;
                const int needed = min((n3 - 1) >> shift, last) + 1;
                FHASH_INDEPENDENT
                for (int i = 0; i < needed; i++) {
                    const int sum = around(i);
                    share[i] = REFERENCE * p[i] + AROUND * sum;
                    level[i] = twelve(sum);
                }
                for (int x = 0; x < n3; x++) {
                    const int i = min(x >> shift, last);
                    expected[x] += share[i];
                    others[x] += min(level[i], 6) * scale;
                    if (k == 0) parent[x] = level[i];
                }
            }
            const int offset = 160 - log16(weight);
            const uint16_t* const Y = has_y ? M - M2 : nothing;
            const uint16_t* const Z = has_z ? M - M1 : nothing;
            const uint16_t* const T = has_t ? M - M0 : nothing;
            int32_t *FHASH_RESTRICT const both = sums.both, *FHASH_RESTRICT const nearest = sums.nearest, *FHASH_RESTRICT const sides = sums.sides;
            FHASH_INDEPENDENT
            for (int x = 0; x < lanes; x++) {
                const int before = sums.before[x], below = sums.below[x];
                nearest[x] = (((min<int>(Y[x], 2) * 3 + min<int>(Y[x - 1], 2)) * 3 + min<int>(Y[x + 1], 2)) * 3 + min<int>(T[x], 2)) * 3 + min<int>(Z[x], 2);
                sides[x] = twelve(before) * 12 + twelve(below);
                both[x] = before + below;
                parent[x] = parent[x] * KINDS + kind;
            }
            int filled = 0, left = 0, left2 = 0;

            for (int x = 0; x < n3; x++) {
                const uint32_t mu = (uint32_t)(expected[x] + LEFT * left + LEFT2 * left2);
                const int level = mu ? min((log16(mu) + offset) / 4 + 1, LEVELS - 1) : 0, coarse = level / 2;
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
                for (int i = 0; i < CONTEXTS; i++) places[i] = slots[i] + (int64_t)context[i] * DECISIONS;
                auto predict = [&](Prediction& to, int k) FHASH_LAMBDA {
                    for (int i = 0; i < CONTEXTS; i++) to.slots[i] = places[i] + k;
                    to.first = weights + ((int64_t)k * KINDS + kind) * SET;
                    to.second = weights + SECOND + ((int64_t)k * 64 + coarse) * SET;
                    return mix<CONTEXTS, true>(to);
                };
                Prediction now;
                int p = predict(now, 0), value = MODE == 1 ? 0 : out[x];
                if (MODE == 2) {
                    const float s = scaled[out - q + x];
                    const int best = choose(std::fabs((double)s), p, predict);
                    out[x] = value = s < 0 ? -best : best;
                }
                int magnitude = std::abs(value);
                const int zero = range.code(magnitude == 0, p);
                learn<CONTEXTS, true>(now, zero, SLOW_LIMIT);
                left2 = left;
                left = 0;
                if (zero) continue;
                filled = 1;
                const int left_sign = x > 0 ? sign_of(out[x - 1]) : 1, left2_sign = x > 1 ? sign_of(out[x - 2]) : 1;
                const int y_sign = has_y ? sign_of(out[x - S2]) : 1, y2_sign = y > 1 ? sign_of(out[x - 2 * S2]) : 1;
                const int z_sign = has_z ? sign_of(out[x - S1]) : 1, t_sign = has_t ? sign_of(out[x - S0]) : 1;
                Prediction sign;
                sign.slots[0] = signs[0] + kind * 27 + (left_sign * 3 + y_sign) * 3 + t_sign;
                sign.slots[1] = signs[1] + kind * 81 + ((left_sign * 3 + left2_sign) * 3 + y_sign) * 3 + y2_sign;
                sign.slots[2] = signs[2] + kind * 27 + (t_sign * 3 + z_sign) * 3 + left_sign;
                sign.first = sign.second = weights + SIGNS + kind * SET;
                const int negative = range.code(value < 0, mix<SIGN_CONTEXTS, false>(sign));
                learn<SIGN_CONTEXTS, false>(sign, negative, SIGN_LIMIT);
                int k = 1;
                for (; k < UNARY; k++) {
                    p = predict(now, k);
                    const int more = range.code(magnitude > k, p);
                    learn<CONTEXTS, true>(now, more, SLOW_LIMIT);
                    if (!more) break;
                }
                if (k == UNARY) {
                    const int64_t escape = level * 64;
                    const uint32_t rest = MODE == 1 ? 0 : (uint32_t)magnitude - UNARY + 1;
                    int bits = 0;
                    if (MODE != 1) while (rest >> bits > 1) bits++;
                    int j = 0;
                    while (simple(j < bits, escape + min(j, 20))) if (++j > 30) return -1;
                    uint32_t v = 1;
                    for (int i = j - 1; i >= 0; i--) v = (v << 1) | (uint32_t)simple((rest >> i) & 1, escape + 21 + min(j, 19) * 2 + (i != j - 1));
                    k = (int)min<uint32_t>(v + (UNARY - 1), 0x7fffffff);
                }
                if (MODE == 1) {
                    magnitude = k;
                    out[x] = negative ? -k : k;
                }
                left = min(magnitude, MAX_MAGNITUDE);
                M[x] = (uint16_t)left;
            }
            band.filled[r] = (uint8_t)filled;
        }
    }
    return 0;
}

FHASH_CLONES int64_t encode(Coder<0> coder, int32_t* q, const int64_t* shape, const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(q, nullptr, shape, table, count);
        coder.range.finish();
        return 0;
    });
}
FHASH_CLONES int64_t encode_chosen(Coder<2> coder, int32_t* q, const float* scaled, const int64_t* shape, const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(q, scaled, shape, table, count);
        coder.range.finish();
        return 0;
    });
}
FHASH_CLONES int64_t decode(Coder<1> coder, int32_t* q, const int64_t* shape, const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA { return coder.run(q, nullptr, shape, table, count); });
}

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (bands.py); everything outside the bands counts as 0.
// scaled: nullptr, or coefficients / step: then the magnitudes are chosen anew (and put into q), lambda being the squared steps a bit is worth.
// The state is what transform/coder.py describes; it comes back as it was left if `keep`. Bytes needed; data is filled if they fit,
// and if they do not, the state is as it was: call again with the same q and more room. NO_MEMORY.
FHASH_EXPORT int64_t fhash_encode(int32_t* q, const float* scaled, double lambda, const int64_t* shape, const int32_t* table, int64_t count,
                                  uint16_t* slots, int64_t slot_count, int32_t* weights, int64_t weight_count, uint16_t* simples,
                                  int64_t simple_count, int64_t keep, uint8_t* data, int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count, LANES);
        std::vector<uint8_t> out;
        const int64_t code = scaled ? encode_chosen({{&out}, &state, lambda / 2048}, q, scaled, shape, table, count)
                                    : encode({{&out}, &state, 0}, q, shape, table, count);
        if (code < 0) return code;
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) keep_state(state, slots, weights, simples, LANES);
        return size;
    });
}

// Decode into q, which must be zeros. 0, or -1 for bytes that no encoder writes and for bands beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode(int32_t* q, const int64_t* shape, const int32_t* table, int64_t count, const uint16_t* slots,
                                  int64_t slot_count, const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                                  int64_t simple_count, const uint8_t* data, int64_t size) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count, LANES);
        return decode({{data, size}, &state, 0}, q, shape, table, count);
    });
}
