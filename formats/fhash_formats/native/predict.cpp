// Integers coded without loss by prediction: a coarse lattice first, then pass by pass the vertices between, along one axis at a time.
//
// In a pass, the vertices that are known are a dense lattice C, those to come another one, N: vertex j along the axis of the pass lies
// between j and j + 1 of C. Each is predicted from the mean of these two, its base, plus a weighted sum of how other known vertices, the
// taps, differ from the base. Where a tap does not exist it counts as the base. What is coded is the difference from the rounded
// prediction, by binary decisions mixed from several contexts (mixing.hpp): zero, sign, magnitude in unary up to 14 and beyond in an
// Exp-Golomb code; of magnitudes that are expected to be large the low bits go apart. Python builds the passes and their taps
// (transform/predictor.py), so that they are right whatever the bytes; the portable coder (predict_portable.py) follows this file.
#include <cstdlib>
#include <type_traits>

#include "mixing.hpp"

namespace {

const int CONTEXTS = 7, LANES = 14, SET = padded(LANES), DECISIONS = 16, UNARY = 14, CLASSES = 16, LEVELS = 48, HALF_LEVELS = 24, ACTIVITIES = 32, SLOPES = 27;
const int SIZES[CONTEXTS] = {LEVELS * 5, ACTIVITIES * SLOPES, CLASSES* HALF_LEVELS * 5, 3125, 81 * 5 * 8, 81 * HALF_LEVELS, ACTIVITIES* HALF_LEVELS * 5};
const int ESCAPES = 160, ROWS = 192;  // where these simple estimates begin: low bits, escapes, empty rows
const int SIDE = 20, BEFORE = 15, DIAGONAL = 7, COARSE = 4;  // weights of known differences: left and above, in t and z, diagonal, in C
const int MOST = 1 << 27;  // largest magnitude
const int CLIP = 4095;     // of differences as contexts see them
const int TAP = 5, PASS = 4;  // columns: of taps (1 if in N, offsets along t, z, y, x), of passes (axis, class, first tap, taps)
const int ACTIVE = 14;     // so many taps, the first, tell how lively the place is

struct Grid {
    int64_t n[4], stride[3];
    std::vector<int32_t> values, errors;
    void size(const int64_t* lengths) {
        for (int a = 0; a < 4; a++) n[a] = lengths[a];
        stride[2] = n[3];
        stride[1] = stride[2] * n[2];
        stride[0] = stride[1] * n[1];
        values.assign((size_t)(stride[0] * n[0]), 0);
        errors.assign((size_t)(stride[0] * n[0]), 0);
    }
    FHASH_INLINE int64_t row(int64_t t, int64_t z, int64_t y) const { return t * stride[0] + z * stride[1] + y * stride[2]; }
    FHASH_INLINE bool has(int64_t t, int64_t z, int64_t y) const { return t >= 0 && z >= 0 && y >= 0 && t < n[0] && z < n[1] && y < n[2]; }
};

FHASH_INLINE int half_octaves(uint32_t v, int most) { return v ? min(1 + log16(v) / 8, most) : 0; }
FHASH_INLINE int32_t clipped(int32_t e) { return min(std::abs(e), CLIP); }
FHASH_INLINE int few(int v) { return (v > 0) + (v > 1) + (v > 3) + (v > 8); }
FHASH_INLINE int sign_of(int32_t v) { return (v > 0) - (v < 0); }
// How far another prediction lies to which side, in 9 classes.
FHASH_INLINE int side(int64_t d) {
    const int64_t a = d < 0 ? -d : d;
    const int r = (a >= 1229) + (a >= 4096) + (a >= 9830) + (a >= 24576);
    return d < 0 ? 4 - r : 4 + r;
}

template <bool DECODES> struct Pass {
    using Range = typename std::conditional<DECODES, Decoder, Encoder>::type;
    Range range;
    State* state;
    Slot* slots[CONTEXTS];
    Grid C, N;
    // Of one row: twice the base, the weighted sum, activity, slope, known differences, the prediction by the step before, and what contexts
    // take from the differences above, below, before and in C: their sizes and their signs.
    std::vector<int32_t> base, activity, slope, known, step, sizes, signs;
    std::vector<int64_t> sum;

    Pass(Range from, State* with) : range(from), state(with) {
        Slot* at = state->slots.data();
        for (int i = 0; i < CONTEXTS; i++) {
            slots[i] = at;
            at += (int64_t)SIZES[i] * DECISIONS;
        }
    }
    FHASH_INLINE int simple(Range& range, int bit, int number) { return code_simple(range, state->simples[number], bit); }
    FHASH_INLINE int decide(Range& range, int bit, int k, const int* context, int kind, int level) {
        Mixed<CONTEXTS> now;
        for (int i = 0; i < CONTEXTS; i++) now.slots[i] = slots[i] + (int64_t)context[i] * DECISIONS + k;
        now.first = state->weights.data() + (kind * DECISIONS + k) * SET;
        now.second = state->weights.data() + ((CLASSES + level) * DECISIONS + k) * SET;
        bit = range.code(bit, (uint32_t)mix<CONTEXTS, true>(now));
        learn<CONTEXTS, true>(now, bit, SLOW_LIMIT);
        return bit;
    }

    // All vertices of N; q, care: of the whole tile; at, stride: where N lies in them. 0 or -1.
    FHASH_INLINE int64_t run(int32_t* q, const uint8_t* care, int64_t at, const int64_t* stride, int axis, int kind, const int32_t* taps,
                             const int16_t* weights, int count) {
        Range range = this->range;
        const int64_t n3 = N.n[3];
        for (std::vector<int32_t>* part : {&base, &activity, &slope, &known, &step, &sizes, &signs}) part->assign((size_t)n3, 0);
        sum.assign((size_t)n3, 0);
        const int64_t along[4] = {axis == 0, axis == 1, axis == 2, axis == 3};
        for (int64_t t = 0; t < N.n[0]; t++) for (int64_t z = 0; z < N.n[1]; z++) for (int64_t y = 0; y < N.n[2]; y++) {
            const int64_t row = N.row(t, z, y);
            int32_t* const V = N.values.data() + row;
            int32_t* const E = N.errors.data() + row;
            int64_t own[8][2];  // taps to the left in the row itself: offset, weight
            int owned = 0;
            int32_t* const B = base.data();
            std::memset(activity.data(), 0, 4 * (size_t)n3);
            std::memset(slope.data(), 0, 4 * (size_t)n3);
            std::memset(known.data(), 0, 4 * (size_t)n3);
            std::memset(sum.data(), 0, 8 * (size_t)n3);
            bool stepped = false;
            int weight = 0;
            auto differences = [&](const Grid& G, int64_t r, int64_t offset, int w) FHASH_LAMBDA {
                const int32_t* const p = G.errors.data() + r + offset;
                const int64_t first = max<int64_t>(0, -offset), last = min(n3, G.n[3] - offset);
                for (int64_t x = first; x < last; x++) known[x] += w * clipped(p[x]);
                weight += w;
            };
            if (axis < 0) {
                // The nearest vertex: above, in the layer or the step before; to the left it is found on the way.
                const int32_t* p = y > 0 ? V - N.stride[2] : z > 0 ? V - N.stride[1] : t > 0 ? V - N.stride[0] : nullptr;
                for (int64_t x = 0; x < n3; x++) B[x] = p ? 2 * p[x] : 0;
            } else {
                const int64_t r = C.row(t, z, y);
                const bool far = C.has(t + along[0], z + along[1], y + along[2]);
                const int64_t next = far ? r + along[0] * C.stride[0] + along[1] * C.stride[1] + along[2] * C.stride[2] + along[3] : r;
                const int32_t *const p = C.values.data() + r, *const o = C.values.data() + next;
                const int64_t both = axis == 3 ? min(n3, C.n[3] - 1) : n3;
                for (int64_t x = 0; x < both; x++) {
                    B[x] = p[x] + o[x];
                    slope[x] = std::abs(p[x] - o[x]);
                }
                for (int64_t x = both; x < n3; x++) B[x] = 2 * p[x];
                differences(C, r, 0, COARSE);
                if (far) differences(C, next - along[3], along[3], COARSE);
                if (axis != 0 && t > 0) {
                    stepped = true;
                    const int32_t *const v = V - N.stride[0], *const a = p - C.stride[0], *const b = o - C.stride[0];
                    for (int64_t x = 0; x < both; x++) step[x] = 2 * v[x] - a[x] - b[x];
                    for (int64_t x = both; x < n3; x++) step[x] = 2 * (v[x] - a[x]);
                }
            }
            for (int k = 0; k < count; k++) {
                const int32_t* const tap = taps + k * TAP;
                const Grid& G = tap[0] ? N : C;
                const int64_t offset = tap[4];
                const int32_t w = weights[k];
                if (tap[0] && !tap[1] && !tap[2] && !tap[3]) {
                    own[owned][0] = offset;
                    own[owned++][1] = w;
                    continue;
                }
                if (axis < 0 || !G.has(t + tap[1], z + tap[2], y + tap[3])) continue;
                const int32_t* const p = G.values.data() + G.row(t + tap[1], z + tap[2], y + tap[3]) + offset;
                const int64_t first = max<int64_t>(0, -offset), last = min(n3, G.n[3] - offset);
                if (k < ACTIVE)
                    for (int64_t x = first; x < last; x++) {
                        const int32_t d = 2 * p[x] - B[x];
                        sum[x] += (int64_t)w * d;
                        activity[x] += min(std::abs(d), 1 << 24);
                    }
                else
                    for (int64_t x = first; x < last; x++) sum[x] += (int64_t)w * (2 * p[x] - B[x]);
            }
            if (y > 0) {
                differences(N, row - N.stride[2], 0, SIDE);
                differences(N, row - N.stride[2], -1, DIAGONAL);
                differences(N, row - N.stride[2], 1, DIAGONAL);
            }
            if (z > 0) differences(N, row - N.stride[1], 0, BEFORE);
            if (t > 0) {
                differences(N, row - N.stride[0], 0, BEFORE);
                differences(N, row - N.stride[0], 1, DIAGONAL);
                if (y + 1 < N.n[2]) differences(N, row - N.stride[0] + N.stride[2], 0, DIAGONAL);
            }
            const int64_t q_row = at + t * stride[0] + z * stride[1] + y * stride[2];
            // The prediction in 1/8192.
            auto predict = [&](int64_t x) FHASH_LAMBDA {
                int64_t p = sum[x];
                if (axis < 0) {
                    if (x > 0) B[x] = 2 * V[x - 1];
                    for (int k = 0; k < count; k++) {
                        const int32_t* const tap = taps + k * TAP;
                        const int64_t at_x = x + tap[4];
                        if (at_x < 0 || at_x >= n3 || !N.has(t + tap[1], z + tap[2], y + tap[3])) continue;
                        const int32_t d = 2 * N.values[(size_t)(N.row(t + tap[1], z + tap[2], y + tap[3]) + at_x)] - B[x];
                        p += (int64_t)weights[k] * d;
                        if (k < ACTIVE) activity[x] += min(std::abs(d), 1 << 24);
                    }
                } else {
                    for (int i = 0; i < owned; i++)
                        if (x + own[i][0] >= 0) p += own[i][1] * (2 * V[x + own[i][0]] - B[x]);
                }
                const int64_t end = (int64_t)MOST << 13;
                return min(max((int64_t)B[x] * 4096 + p, -end), end);
            };
            auto rounded = [&](int64_t p) FHASH_LAMBDA { return (p + 4096) >> 13; };

            int32_t any = 0, moved = 0;
            for (int64_t x = 0; x < n3; x++) {
                any |= known[x];
                moved |= activity[x] | slope[x];
            }
            if (!any) {  // where nothing was found wrong nearby, a whole row may be right
                int wrong = 0;
                if (!DECODES)
                    for (int64_t x = 0; x < n3 && !wrong; x++) {
                        const int64_t r = rounded(predict(x)), i = q_row + x * stride[3];
                        V[x] = care && !care[i] ? (int32_t)r : q[i];
                        wrong = V[x] != r;
                    }
                wrong = simple(range, wrong, ROWS + (moved ? 1 : 0) + (t + z + y ? 2 : 0) + (n3 > 16 ? 4 : 0));
                if (!wrong) {
                    for (int64_t x = 0; x < n3; x++) {
                        if (axis < 0) activity[x] = 0;
                        q[q_row + x * stride[3]] = V[x] = (int32_t)rounded(predict(x));
                    }
                    continue;
                }
                if (axis < 0) std::memset(activity.data(), 0, 4 * (size_t)n3);
            }
            const int to_level = log16(max(weight, 1)), to_left = log16(weight + SIDE);
            const int32_t* const Y = y > 0 ? E - N.stride[2] : nullptr;
            const int32_t* const Z = z > 0 ? E - N.stride[1] : nullptr;
            const int32_t* const T = t > 0 ? E - N.stride[0] : nullptr;
            const int32_t* const L = axis < 0 ? nullptr : C.errors.data() + C.row(t, z, y);
            std::memset(sizes.data(), 0, 4 * (size_t)n3);
            std::memset(signs.data(), 0, 4 * (size_t)n3);
            auto seen = [&](const int32_t* FHASH_RESTRICT errors, int size, int sign) FHASH_LAMBDA {
                if (!errors) return;
                int32_t *FHASH_RESTRICT const to_sizes = sizes.data(), *FHASH_RESTRICT const to_signs = signs.data();
                for (int64_t x = 0; x < n3; x++) {
                    to_sizes[x] += few(clipped(errors[x])) * size;
                    to_signs[x] += sign_of(errors[x]) * sign;
                }
            };
            seen(Y, 125, 9);
            seen(Z, 25, 3);
            seen(T, 5, 1);
            seen(L, 1, 0);

            for (int64_t x = 0; x < n3; x++) {
                const int64_t p = predict(x), r = rounded(p), fraction = p - r * 8192, i = q_row + x * stride[3];
                const int sign = fraction < 0 ? -1 : 1, part = min((int)((fraction * sign * 10) >> 13), 4);
                const int left = x > 0 ? E[x - 1] : 0;
                const uint32_t mu = (uint32_t)(known[x] + SIDE * clipped(left));
                const int d16 = mu ? log16(mu) - (x > 0 ? to_left : to_level) : -1000;
                const int level = mu ? min(max(1 + (d16 + 80) * 3 / 16, 1), LEVELS - 1) : 0, half = level / 2;
                const int low = d16 > 25 ? (d16 - 26) / 16 + 1 : 0;
                const int lively_place = half_octaves((uint32_t)activity[x], ACTIVITIES - 1);
                const int steep = half_octaves((uint32_t)slope[x], SLOPES - 1);
                const int other = side(((int64_t)B[x] * 4096 - p) * sign), before = side(stepped ? (((int64_t)B[x] + step[x]) * 4096 - p) * sign : 0);
                const int context[CONTEXTS] = {
                    level * 5 + part,
                    lively_place * SLOPES + steep,
                    (kind * HALF_LEVELS + half) * 5 + part,
                    few(clipped(left)) * 625 + sizes[x],
                    ((other * 9 + before) * 5 + part) * 8 + half / 3,
                    (40 + sign * (27 * sign_of(left) + signs[x])) * HALF_LEVELS + half,
                    (lively_place * HALF_LEVELS + half) * 5 + part,
                };
                int64_t error = 0;
                if (!DECODES) {
                    if (care && !care[i]) q[i] = (int32_t)r;
                    error = (int64_t)q[i] - r;
                }
                const int64_t size = error < 0 ? -error : error;
                int64_t magnitude = size >> low;
                int positive = error * sign > 0;
                const int zero = decide(range, magnitude == 0, 0, context, kind, level);
                if (!zero) {
                    positive = decide(range, positive, 1, context, kind, level);
                    int k = 1;
                    for (; k < UNARY + 1; k++)
                        if (!decide(range, magnitude > k, k + 1, context, kind, level)) break;
                    if (k == UNARY + 1) {
                        const uint32_t rest = DECODES ? 0 : (uint32_t)(magnitude - UNARY);
                        int bits = 0, j = 0;
                        if (!DECODES) while (rest >> bits > 1) bits++;
                        while (simple(range, j < bits, ESCAPES + min(j, 31))) if (++j > 28) return -1;
                        uint32_t v = 1;
                        for (int b = j - 1; b >= 0; b--) v = (v << 1) | (uint32_t)range.code((rest >> b) & 1, 32768);
                        if (DECODES) magnitude = (int64_t)v + UNARY;
                    } else if (DECODES) magnitude = k;
                }
                if (low) {
                    const int about = (min(low, 19) * 4 + (int)min<int64_t>(zero ? 0 : magnitude, 3)) * 2;
                    int64_t v = DECODES ? (zero ? 0 : magnitude) : 0;
                    for (int b = low - 1; b >= 0; b--) {
                        const int bit = (int)((size >> b) & 1);
                        v = (v << 1) | (b > low - 3 ? simple(range, bit, about + (b != low - 1)) : range.code(bit, 32768));
                    }
                    if (DECODES) magnitude = v;
                    if (zero && (DECODES ? v != 0 : size != 0)) positive = decide(range, positive, 1, context, kind, level);
                } else if (DECODES && zero) magnitude = 0;
                if (DECODES) error = magnitude * (positive ? sign : -sign);
                const int64_t value = r + error;
                if (value > MOST || value < -MOST) return -1;
                V[x] = (int32_t)value;
                q[i] = (int32_t)value;
                E[x] = (int32_t)min<int64_t>(max<int64_t>(error, -MOST), MOST);
            }
        }
        this->range = range;
        return 0;
    }

    // Passes over a tile. levels: halvings along each axis.
    FHASH_INLINE int64_t all(int32_t* q, const uint8_t* care, const int64_t* shape, const int64_t* levels, const int32_t* passes,
                             int64_t pass_count, const int32_t* taps, const int16_t* weights) {
        const int64_t S[4] = {shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3], 1};
        int64_t shift[4], n[4];
        for (int a = 0; a < 4; a++) shift[a] = levels[a];
        for (int64_t i = 0; i < pass_count; i++) {
            const int32_t* const pass = passes + i * PASS;
            const int axis = pass[0];
            int64_t stride[4], at = 0;
            for (int a = 0; a < 4; a++) {
                n[a] = ((shape[a] - 1) >> shift[a]) + 1;
                stride[a] = S[a] << shift[a];
            }
            if (axis >= 0) {
                const int64_t length = ((shape[axis] - 1) >> (shift[axis] - 1)) + 1;
                n[axis] = length / 2;
                at = S[axis] << (shift[axis] - 1);
                shift[axis]--;
                if (!n[axis]) continue;
            }
            N.size(n);
            const int64_t code = run(q, care, at, stride, axis, pass[1], taps + (int64_t)pass[2] * TAP, weights + pass[2], pass[3]);
            if (code < 0) return code;
            if (axis < 0) {
                std::swap(C, N);
                continue;
            }
            // What was new is known: the two lattices as one.
            Grid both;
            n[axis] += C.n[axis];
            both.size(n);
            for (int64_t t = 0; t < n[0]; t++) for (int64_t z = 0; z < n[1]; z++) for (int64_t y = 0; y < n[2]; y++) {
                const int64_t place[3] = {t, z, y};
                const int64_t to = both.row(t, z, y);
                if (axis < 3) {
                    const Grid& G = place[axis] & 1 ? N : C;
                    const int64_t from = G.row(axis == 0 ? t / 2 : t, axis == 1 ? z / 2 : z, axis == 2 ? y / 2 : y);
                    std::memcpy(both.values.data() + to, G.values.data() + from, 4 * (size_t)n[3]);
                    std::memcpy(both.errors.data() + to, G.errors.data() + from, 4 * (size_t)n[3]);
                    continue;
                }
                for (int odd = 0; odd < 2; odd++) {
                    const Grid& G = odd ? N : C;
                    const int64_t from = G.row(t, z, y);
                    for (int64_t x = 0; x < G.n[3]; x++) {
                        both.values[(size_t)(to + 2 * x + odd)] = G.values[(size_t)(from + x)];
                        both.errors[(size_t)(to + 2 * x + odd)] = G.errors[(size_t)(from + x)];
                    }
                }
            }
            std::swap(C, both);
        }
        return 0;
    }
};

FHASH_CLONES int64_t encode(Pass<false>& pass, int32_t* q, const uint8_t* care, const int64_t* shape, const int64_t* levels,
                            const int32_t* passes, int64_t pass_count, const int32_t* taps, const int16_t* weights) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        const int64_t code = pass.all(q, care, shape, levels, passes, pass_count, taps, weights);
        pass.range.finish();
        return code;
    });
}
FHASH_CLONES int64_t decode(Pass<true>& pass, int32_t* q, const int64_t* shape, const int64_t* levels, const int32_t* passes,
                            int64_t pass_count, const int32_t* taps, const int16_t* weights) {
    return guarded([&]() FHASH_LAMBDA { return pass.all(q, nullptr, shape, levels, passes, pass_count, taps, weights); });
}

}  // namespace

// Encode integers q (t, z, y, x), |q| <= 2^27; those that care (bytes, or nullptr for all) does not mark become what is predicted.
// levels: halvings along each axis; passes, taps, weights: see transform/predictor.py. Bytes needed; data is filled if they fit. -1 if a
// prediction runs out of bounds, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_encode_predicted(int32_t* q, const uint8_t* care, const int64_t* shape, const int64_t* levels, const int32_t* passes,
                                            int64_t pass_count, const int32_t* taps, const int16_t* tap_weights, const uint16_t* slots,
                                            int64_t slot_count, const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                                            int64_t simple_count, uint8_t* data, int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count, LANES);
        std::vector<uint8_t> out;
        Pass<false> pass{{&out}, &state};
        const int64_t code = encode(pass, q, care, shape, levels, passes, pass_count, taps, tap_weights);
        if (code < 0) return code;
        return put(out, data, capacity);
    });
}

// Decode into q. 0, or -1 for bytes that no encoder writes, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode_predicted(int32_t* q, const int64_t* shape, const int64_t* levels, const int32_t* passes, int64_t pass_count,
                                            const int32_t* taps, const int16_t* tap_weights, const uint16_t* slots, int64_t slot_count,
                                            const int32_t* weights, int64_t weight_count, const uint16_t* simples, int64_t simple_count,
                                            const uint8_t* data, int64_t size) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count, LANES);
        Pass<true> pass{{data, size}, &state};
        return decode(pass, q, shape, levels, passes, pass_count, taps, tap_weights);
    });
}
