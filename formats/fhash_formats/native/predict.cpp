// Integers coded without loss by prediction: a coarse lattice first, then pass by pass the vertices
// between, along one axis at a time.
//
// A pass has two dense lattices: C of the vertices that are known, and N of the new ones. Vertex j
// of N along the axis of the pass lies between j and j + 1 of C. It is predicted from the mean of
// these two, its base, plus a weighted sum of the differences of other known vertices, the taps,
// from the base. A tap that does not exist counts as the base.
//
// The difference of each integer from its rounded prediction is coded by binary decisions, which
// are mixed from several contexts (mixing.hpp): zero, sign, and the magnitude, in unary up to 14
// and beyond in an Exp-Golomb code. Where large magnitudes are expected, their low bits are coded
// apart.
//
// Python builds the passes and their taps (transform/predict.py), so they are right
// whatever the bytes. tests/reference/predictor.py decodes the same.
#include <cstdlib>
#include <type_traits>

#include "functions.h"
#include "mixing.hpp"
#include "target.hpp"

#include "predict_rows.hpp"

namespace {

// A pass: its integers to decisions, or back.
template <bool DECODES> struct Pass : Rows {
    using Range = typename std::conditional<DECODES, Decoder, Encoder>::type;
    Range range;
    State* state;
    Slot* slots[CONTEXTS];

    Pass(Range from, State* with) : range(from), state(with) {
        Slot* at = state->slots.data();
        for (int i = 0; i < CONTEXTS; i++) {
            slots[i] = at;
            at += (int64_t)SIZES[i] * DECISIONS;
        }
    }

    FHASH_INLINE int simple(Range& range, int bit, int number) {
        return code_simple(range, state->simples[number], bit);
    }

    // Code decision k of a difference: 0 is zero, 1 the sign, k + 1 "more than k".
    FHASH_INLINE int decide(Range& range, int bit, int k, const int* context, int kind, int level) {
        Mixed<CONTEXTS> now;
        for (int i = 0; i < CONTEXTS; i++)
            now.slots[i] = slots[i] + (int64_t)context[i] * DECISIONS + k;
        now.first = state->weights.data() + (kind * DECISIONS + k) * SET;
        now.second = state->weights.data() + ((CLASSES + level) * DECISIONS + k) * SET;
        bit = range.code(bit, (uint32_t)mix<CONTEXTS, true>(now));
        learn<CONTEXTS, true>(now, bit, SLOW_LIMIT);
        return bit;
    }

    // Code by a flag whether a row differs from its predictions anywhere; if not, it becomes these.
    // q_row: where the row begins in the tile.
    int code_whole_row(Range& range, const PassPlan& plan, const Row& row, int32_t* q,
                                    const uint8_t* counted, int64_t q_row, bool moved) {
        const int64_t n3 = N.n[3], stride = plan.stride[3];
        int differs = 0;
        if (!DECODES)
            for (int64_t x = 0; x < n3 && !differs; x++) {
                const int64_t r = rounded(predict(plan, row, x)), i = q_row + x * stride;
                row.values[x] = counted && !counted[i] ? (int32_t)r : q[i];
                differs = row.values[x] != r;
            }
        const int flag = (moved ? 1 : 0) + (row.t + row.z + row.y ? 2 : 0) + (n3 > 16 ? 4 : 0);
        differs = simple(range, differs, ROWS + flag);
        if (differs) {
            // `predict` has added to the activity of the first lattice.
            if (plan.axis < 0) std::memset(activity.data(), 0, 4 * (size_t)n3);
            return differs;
        }
        for (int64_t x = 0; x < n3; x++) {
            if (plan.axis < 0) activity[x] = 0;
            q[q_row + x * stride] = row.values[x] = (int32_t)rounded(predict(plan, row, x));
        }
        return differs;
    }

    // Code a number from 1 on as an Exp-Golomb number; 0 for one that no encoder writes.
    uint32_t code_escape(Range& range, uint32_t rest) {
        int bits = 0, j = 0;
        if (!DECODES) while (rest >> bits > 1) bits++;
        while (simple(range, j < bits, ESCAPES + min(j, 31))) if (++j > 28) return 0;
        uint32_t v = 1;
        for (int b = j - 1; b >= 0; b--)
            v = (v << 1) | (uint32_t)range.code((rest >> b) & 1, 32768);
        return v;
    }

    // Code a difference: zero flag, sign and magnitude without its `low` low bits, then these.
    // sign: that of the likelier difference. False for one that no encoder writes.
    FHASH_INLINE bool code_difference(Range& range, int64_t& error, int sign, int low,
                                      const int* context, int kind, int level) {
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
                const uint32_t v = code_escape(range, DECODES ? 0 : (uint32_t)(magnitude - UNARY));
                if (!v) return false;
                if (DECODES) magnitude = (int64_t)v + UNARY;
            } else if (DECODES) magnitude = k;
        }
        if (low) {
            const int64_t upper = zero ? 0 : magnitude;
            const int flag = (min(low, 19) * 4 + (int)min<int64_t>(upper, 3)) * 2;
            int64_t v = DECODES ? upper : 0;
            for (int b = low - 1; b >= 0; b--) {
                const int bit = (int)((size >> b) & 1);
                // The two highest bits are predicted, the others at even odds.
                const bool predicted = b > low - 3;
                v = (v << 1) | (predicted ? simple(range, bit, flag + (b != low - 1))
                                          : range.code(bit, 32768));
            }
            if (DECODES) magnitude = v;
            if (zero && (DECODES ? v != 0 : size != 0))
                positive = decide(range, positive, 1, context, kind, level);
        } else if (DECODES && zero) magnitude = 0;
        if (DECODES) error = magnitude * (positive ? sign : -sign);
        return true;
    }

    // Code all vertices of N. q, counted: of the whole tile. 0 or -1.
    int64_t run(const PassPlan& plan, int32_t* q, const uint8_t* counted) {
        Range range = this->range;
        const int64_t n3 = N.n[3];
        const int kind = plan.kind;
        for (std::vector<int32_t>* array :
             {&base, &activity, &slope, &known, &step, &sizes, &signs, &narrow})
            array->assign((size_t)n3 + TOGETHER, 0);
        wide.assign((size_t)n3, 0);
        const int64_t n0 = N.n[0], n1 = N.n[1], n2 = N.n[2];
        for (int64_t t = 0; t < n0; t++)
        for (int64_t z = 0; z < n1; z++)
        for (int64_t y = 0; y < n2; y++) {
            const int64_t r_row = N.row(t, z, y);
            Row row = {t,  z, y,     N.values.data() + r_row, N.errors.data() + r_row,
                       {}, 0, false, false,                   0};
            prepare(plan, row);
            const int64_t q_row =
                plan.at + t * plan.stride[0] + z * plan.stride[1] + y * plan.stride[2];
            int32_t any = 0, moved = 0;
            for (int64_t x = 0; x < n3; x++) {
                any |= known[x];
                moved |= activity[x] | slope[x];
            }
            // Where no difference is known nearby, a whole row may be as predicted.
            if (!any && !code_whole_row(range, plan, row, q, counted, q_row, moved != 0)) {
                note_largest(row);
                continue;
            }
            const int to_level = log16(max(row.weight, 1)), to_left = log16(row.weight + SIDE);
            prepare_contexts(plan, row);
            int32_t *const V = row.values, *const E = row.errors;

            for (int64_t x = 0; x < n3; x++) {
                const int64_t p = predict(plan, row, x), r = rounded(p);
                const int64_t i = q_row + x * plan.stride[3];
                const int64_t fraction = p - r * (1 << FRACTION_BITS);
                const int sign = fraction < 0 ? -1 : 1;
                const int tenths = min((int)((fraction * sign * 10) >> FRACTION_BITS), 4);
                const int left = x > 0 ? E[x - 1] : 0;
                // 16 log2 of the expected difference, its class, and the low bits that go apart.
                const uint32_t mu = (uint32_t)(known[x] + SIDE * clipped(left));
                const int d16 = mu ? log16(mu) - (x > 0 ? to_left : to_level) : -1000;
                const int level = mu ? min(max(1 + (d16 + 80) * 3 / 16, 1), LEVELS - 1) : 0;
                const int half = level / 2;
                const int low = d16 > 25 ? (d16 - 26) / 16 + 1 : 0;
                const int lively = half_octaves((uint32_t)activity[x], ACTIVITIES - 1);
                const int steep = half_octaves((uint32_t)slope[x], SLOPES - 1);
                const int64_t twice = base[x];
                const int base_side = side((twice * 4096 - p) * sign);
                const int step_side = side(row.stepped ? ((twice + step[x]) * 4096 - p) * sign : 0);
                const int context[CONTEXTS] = {
                    level * 5 + tenths,
                    lively * SLOPES + steep,
                    (kind * HALF_LEVELS + half) * 5 + tenths,
                    few(clipped(left)) * 625 + sizes[x],
                    ((base_side * 9 + step_side) * 5 + tenths) * 8 + half / 3,
                    (40 + sign * (27 * sign_of(left) + signs[x])) * HALF_LEVELS + half,
                    (lively * HALF_LEVELS + half) * 5 + tenths,
                };
                int64_t error = 0;
                if (!DECODES) {
                    if (counted && !counted[i]) q[i] = (int32_t)r;
                    error = (int64_t)q[i] - r;
                }
                if (!code_difference(range, error, sign, low, context, kind, level)) return -1;
                const int64_t value = r + error;
                if (value > MAX_VALUE || value < -MAX_VALUE) return -1;
                V[x] = (int32_t)value;
                q[i] = (int32_t)value;
                E[x] = (int32_t)min<int64_t>(max<int64_t>(error, -MAX_VALUE), MAX_VALUE);
            }
            note_largest(row);
        }
        this->range = range;
        return 0;
    }

    // Join the two lattices, their vertices by turns along the axis, into C.
    void join(int axis) {
        int64_t n[4] = {N.n[0], N.n[1], N.n[2], N.n[3]};
        n[axis] += C.n[axis];
        joined.size(n);
        const int64_t n0 = n[0], n1 = n[1], n2 = n[2], n3 = N.n[3], c3 = C.n[3];
        for (int64_t t = 0; t < n0; t++)
        for (int64_t z = 0; z < n1; z++)
        for (int64_t y = 0; y < n2; y++) {
            const int64_t to = joined.row(t, z, y);
            int64_t place[3] = {t, z, y};
            const Grid& G = axis < 3 && place[axis] & 1 ? N : C;
            if (axis < 3) place[axis] /= 2;
            const int64_t from = G.row(place[0], place[1], place[2]), new_from = N.row(t, z, y);
            for (auto of : {&Grid::values, &Grid::errors}) {
                int32_t* FHASH_RESTRICT const into = (joined.*of).data() + to;
                const int32_t* FHASH_RESTRICT const a = (G.*of).data() + from;
                if (axis < 3) {
                    std::memcpy(into, a, 4 * (size_t)n3);
                    continue;
                }
                const int32_t* FHASH_RESTRICT const b = (N.*of).data() + new_from;
                for (int64_t x = 0; x < n3; x++) {
                    into[2 * x] = a[x];
                    into[2 * x + 1] = b[x];
                }
                if (c3 > n3) into[2 * n3] = a[n3];
            }
        }
        std::swap(C, joined);
    }

    // Code all passes over a tile; arguments as for fhash_encode_predicted. 0 or -1.
    int64_t all(int32_t* q, const uint8_t* counted, const int64_t* shape,
                             const int64_t* levels, const int32_t* passes, int64_t pass_count,
                             const int32_t* taps, const int16_t* weights) {
        const int64_t S[4] = {shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3], 1};
        int64_t shift[4], n[4];
        for (int a = 0; a < 4; a++) shift[a] = levels[a];
        for (int64_t i = 0; i < pass_count; i++) {
            const int32_t* const pass = passes + i * PASS_COLUMNS;
            const int axis = pass[AXIS];
            const int32_t* const first_tap = taps + (int64_t)pass[FIRST_TAP] * TAP_COLUMNS;
            PassPlan plan = {0, {}, axis, pass[KIND], pass[TAP_COUNT], first_tap,
                             weights + pass[FIRST_TAP], 8192};
            for (int k = 0; k < plan.count; k++) plan.reach += 4 * std::abs(plan.weights[k]);
            for (int a = 0; a < 4; a++) {
                n[a] = ((shape[a] - 1) >> shift[a]) + 1;
                plan.stride[a] = S[a] << shift[a];
            }
            if (axis >= 0) {
                const int64_t length = ((shape[axis] - 1) >> (shift[axis] - 1)) + 1;
                n[axis] = length / 2;
                plan.at = S[axis] << (shift[axis] - 1);
                shift[axis]--;
                if (!n[axis]) continue;
            }
            N.size(n);
            const int64_t code = run(plan, q, counted);
            if (code < 0) return code;
            if (axis < 0) std::swap(C, N);
            else if (i + 1 < pass_count) join(axis);
        }
        return 0;
    }
};

}  // namespace

// Encode integers q (t, z, y, x), |q| <= 2^27.
//
// counted: by vertex, whether its integer must come back (null: all must). The others become their
// predictions, also in q.
// levels: halvings of the first lattice along each axis.
// passes, taps, tap_weights: see pass_arrays in transform/predict.py. At most
// MAX_ROW_TAPS taps of a pass lie in the row of the vertex.
// slots, weights, simples: the state to begin from.
// data: receives the bytes if they fit the capacity.
//
// Returns the number of bytes, or -1 where a value runs out of bounds, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_encode_predicted,
                  (int32_t* q, const uint8_t* counted, const int64_t* shape,
                   const int64_t* levels, const int32_t* passes, int64_t pass_count,
                   const int32_t* taps, const int16_t* tap_weights, const uint16_t* slots,
                   int64_t slot_count, const int32_t* weights, int64_t weight_count,
                   const uint16_t* simples, int64_t simple_count, uint8_t* data, int64_t capacity),
                  (q, counted, shape, levels, passes, pass_count, taps, tap_weights, slots,
                   slot_count, weights, weight_count, simples, simple_count, data, capacity)) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        std::vector<uint8_t> out;
        Pass<false> pass{{&out}, &state};
        const int64_t code =
            pass.all(q, counted, shape, levels, passes, pass_count, taps, tap_weights);
        if (code < 0) return code;
        pass.range.finish();
        return put(out, data, capacity);
    });
}

// Decode integers into q; the other arguments are those of fhash_encode_predicted.
//
// Returns 0, or -1 for bytes that no encoder writes, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_decode_predicted,
                  (int32_t* q, const int64_t* shape, const int64_t* levels, const int32_t* passes,
                   int64_t pass_count, const int32_t* taps, const int16_t* tap_weights,
                   const uint16_t* slots, int64_t slot_count, const int32_t* weights,
                   int64_t weight_count, const uint16_t* simples, int64_t simple_count,
                   const uint8_t* data, int64_t size),
                  (q, shape, levels, passes, pass_count, taps, tap_weights, slots, slot_count,
                   weights, weight_count, simples, simple_count, data, size)) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        Pass<true> pass{{data, size}, &state};
        return pass.all(q, nullptr, shape, levels, passes, pass_count, taps, tap_weights);
    });
}
