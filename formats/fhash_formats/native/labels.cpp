// Entropy coding of labels: few distinct values, equal over regions, without an order.
//
// The labels around a vertex that are known before it are its candidates, those that occur more
// often first. A decision says whether the vertex has the first candidate, then the second, then
// the third. Each decision is predicted from which neighbours have the candidate, as in mask.cpp.
// Where no candidate holds, the label follows bit by bit, without the labels that are excluded.
// Where all segments around are of one label, a flag stands for SEGMENT vertices of a row.
// tests/reference/labels.py explains it.
//
// Up to 256 labels are uint8. More of them (WIDE) are uint16; there a label chooses its estimates
// by a hash, and a flag says whether a label is the one after the highest so far.
#include <type_traits>

#include "mixing.hpp"
#include "rows.hpp"

namespace {

const int CONTEXTS = 8;          // estimates that are mixed for a decision about a candidate
const int BIT_CONTEXTS = 4;      // estimates that are mixed for a bit of a label
const int LANES = 2 * CONTEXTS;  // weights of a set of the caller
const int SET = padded(LANES);   // weights of a set as kept here
const int TESTED = 3;            // candidates that are tested
const int FOUND = 4;             // candidates that are looked for
const int AROUND = 20;           // neighbours
const int NEAR = 16;             // patterns of the four nearest neighbours
const int ALONE = 256;           // stands for a second candidate where there is one only
const int RATE = 2;              // LEARNING_RATE of labels
const int SIZES[CONTEXTS] = {3072, 6144, 6144, 8192, 65536, 1008, 12288, 12288};
const int CANDIDATE_SETS = TESTED * NEAR + TESTED * FOUND;  // sets of weights of candidates
const int NEXT = 10;                   // simple estimate of the label after the highest so far
const uint32_t SCATTER = 40503;        // multiplier of hashes: 2^16 over the golden ratio

// One run over labels.
template <bool DECODES, bool WIDE> struct LabelCoder {
    using Label = typename std::conditional<WIDE, uint16_t, uint8_t>::type;
    using Known = typename std::conditional<WIDE, int32_t, int16_t>::type;
    static constexpr int NONE = WIDE ? 65536 : 256;  // label of vertices that do not exist
    static constexpr int MIXED = NONE + 1;           // state of a segment of more than one label
    static constexpr int NOTHING = NONE + 2;         // state of a segment that does not exist
    static constexpr int BIT_LEVELS = WIDE ? 16 : 8;  // sets of weights of bits
    static constexpr int BIT_SIZE = WIDE ? 65536 : 16384;  // contexts of an estimate of bits

    typename std::conditional<DECODES, Decoder, Encoder>::type range;
    State* state;
    Slot *slots[CONTEXTS], *bit_slots[BIT_CONTEXTS];
    int count;        // number of labels
    int highest = -1;  // highest label so far; only where WIDE

    // Number below 256 by which a label chooses its estimates.
    FHASH_INLINE static int key(int label) {
        return WIDE ? (int)(((uint32_t)label * SCATTER >> 8) & 255) : label;
    }

    // Context of a bit of a label, by another label.
    FHASH_INLINE static int beside(int label, int node) {
        if (WIDE) return (int)(((uint32_t)label * SCATTER + (uint32_t)node) & (BIT_SIZE - 1));
        return (label * 256 + node) & (BIT_SIZE - 1);
    }

    // Code whether a vertex has candidate k of `found`. around: the labels of the neighbours.
    FHASH_INLINE int test(int bit, int k, const int* candidates, int found, const int* around) {
        const int other = found > 1 ? key(candidates[k ? 0 : 1]) : ALONE;
        const int c = key(candidates[k]);
        int e[AROUND];
        for (int i = 0; i < AROUND; i++) e[i] = around[i] == candidates[k];
        const int near = e[0] | e[1] << 1 | e[2] << 2 | e[3] << 3;
        const int plane = e[0] | e[1] << 1 | e[4] << 2 | e[5] << 3 | e[16] << 4 | e[17] << 5;
        const int below = e[2] | e[6] << 1 | e[7] << 2 | e[8] << 3 | e[9] << 4;
        const int before =
            e[3] | e[10] << 1 | e[11] << 2 | e[12] << 3 | e[13] << 4 | e[14] << 5 | e[15] << 6;
        const int second = e[16] | e[17] << 1 | e[18] << 2 | e[19] << 3;
        const int sum_plane = e[0] + e[1] + e[4] + e[5] + e[16] + e[17];
        const int sum_below = e[2] + e[6] + e[7] + e[8] + e[9];
        const int sum_before = e[3] + e[10] + e[11] + e[12] + e[13] + e[14] + e[15];
        const int mixed = e[2] << 6 | e[3] << 7 | e[6] << 8 | e[8] << 9 | e[10] << 10 | e[12] << 11;
        const int context[CONTEXTS] = {
            ((k * FOUND + found - 1) * NEAR + near) * 16 + second,
            (k * 64 + plane) * 32 + below,
            (k * 128 + before) * NEAR + near,
            ((k > 0 ? 256 : 0) + c) * NEAR + near,
            ((c * 259 + other) & 4095) * NEAR + near,
            ((k * 7 + sum_plane) * 6 + sum_below) * 8 + sum_before,
            k << 12 | mixed | plane,
            k << 12 | before << 5 | below,
        };
        Mixed<CONTEXTS> now;
        for (int i = 0; i < CONTEXTS; i++) now.slots[i] = slots[i] + context[i];
        now.first = state->weights.data() + (k * NEAR + near) * SET;
        now.second = state->weights.data() + (TESTED * NEAR + k * FOUND + found - 1) * SET;
        return code_mixed<CONTEXTS, true, RATE>(range, now, bit);
    }

    // Number of labels from `low` to `high` - 1 that are not among the first `tested` candidates.
    FHASH_INLINE int allowed(int low, int high, const int* candidates, int tested) const {
        int n = max(min(high, count) - low, 0);
        for (int i = 0; i < tested; i++) n -= candidates[i] >= low && candidates[i] < high;
        return n;
    }

    // Code a label that is none of the first `tested` candidates, from its highest bit on.
    FHASH_INLINE int spell(int label, const int* candidates, int tested, const int* around) {
        if (WIDE && highest + 1 < count &&
            code_simple(range, state->simples[NEXT], label == highest + 1))
            return highest + 1;
        int low = 0, node = 1, level = significant((uint32_t)(count - 1));
        while (level-- > 0) {
            const int middle = low + (1 << level);
            int bit = label >= middle;
            if (!allowed(low, middle, candidates, tested)) bit = 1;
            else if (!allowed(middle, middle + (1 << level), candidates, tested)) bit = 0;
            else {
                const int context[BIT_CONTEXTS] = {
                    node,
                    beside(tested ? candidates[0] : 0, node),
                    beside(around[3], node),
                    beside(around[2], node),
                };
                Mixed<CONTEXTS> now;
                for (int i = 0; i < BIT_CONTEXTS; i++) now.slots[i] = bit_slots[i] + context[i];
                now.first = state->weights.data() + (CANDIDATE_SETS + level) * SET;
                now.second = state->weights.data() + (CANDIDATE_SETS + BIT_LEVELS + tested) * SET;
                bit = code_mixed<BIT_CONTEXTS, true, RATE>(range, now, bit);
            }
            if (bit) low = middle;
            node = node * 2 + bit;
        }
        return low;
    }

    // Code the label of a vertex. around: the labels of its neighbours, NONE for none.
    FHASH_INLINE int vertex(int label, const int* around) {
        // The first labels around, those that occur more often first; the nearest count threefold.
        int candidates[FOUND], votes[FOUND], found = 0;
        for (int i = 0; i < AROUND; i++) {
            const int v = around[i], weight = i < 4 ? 3 : 1;
            if (v == NONE) continue;
            int k = 0;
            while (k < found && candidates[k] != v) k++;
            if (k == FOUND) continue;
            if (k == found) {
                candidates[found] = v;
                votes[found++] = 0;
            }
            votes[k] += weight;
            for (; k > 0 && votes[k] > votes[k - 1]; k--) {
                std::swap(votes[k], votes[k - 1]);
                std::swap(candidates[k], candidates[k - 1]);
            }
        }
        const int tested = min(found, TESTED);
        for (int k = 0; k < tested; k++) {
            if (k == count - 1) return candidates[k];  // no other label is left
            if (test(label == candidates[k], k, candidates, found, around)) return candidates[k];
        }
        return spell(label, candidates, tested, around);
    }

    // Code all labels (t, z, y, x), each below `count`.
    FHASH_INLINE void run(Label* labels, const int64_t* shape) {
        const int n0 = (int)shape[0], n1 = (int)shape[1], n2 = (int)shape[2], n3 = (int)shape[3];
        const int segments = (n3 + SEGMENT - 1) / SEGMENT;
        // Strides of labels and of the states of segments.
        const int64_t S2 = n3, S1 = S2 * n2, S0 = S1 * n1;
        const int64_t G2 = segments + 2, G1 = G2 * n2, G0 = G1 * n1;
        PaddedRows<Known> known(shape, NONE);
        std::vector<Known> segment_states((size_t)G0 * n0, NOTHING);
        std::vector<Known> no_states((size_t)G2, NOTHING);
        slots[0] = state->slots.data();
        for (int i = 1; i < CONTEXTS; i++) slots[i] = slots[i - 1] + SIZES[i - 1];
        bit_slots[0] = slots[CONTEXTS - 1] + SIZES[CONTEXTS - 1];
        bit_slots[1] = bit_slots[0] + (WIDE ? BIT_SIZE : 256);
        for (int i = 2; i < BIT_CONTEXTS; i++) bit_slots[i] = bit_slots[i - 1] + BIT_SIZE;

        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
            Label* const out = labels + t * S0 + z * S1 + y * S2;
            const auto [K, N, NN, P, PP, PN, PS, B, BB, BN, BS, BP, BF] = known.around(t, z, y);
            // States of the segments of this row and of the rows before it.
            Known* const G = segment_states.data() + t * G0 + z * G1 + y * G2 + 1;
            const Known* const no_state = no_states.data() + 1;
            const Known* const GN = has_y ? G - G2 : no_state;
            const Known* const GP = has_z ? G - G1 : no_state;
            const Known* const GB = has_t ? G - G0 : no_state;

            for (int s = 0; s < segments; s++) {
                const int x0 = s * SEGMENT, x1 = min(x0 + SEGMENT, n3);
                // The state that all segments around have, as far as they exist.
                const int near[7] = {G[s - 1], GN[s], GP[s],     GB[s],
                                     GN[s + 1], GP[s + 1], GB[s + 1]};
                int around, differing = 0;
                const int same = common_state(near, 4, NOTHING, MIXED, around);
                for (int k = 4; k < 7; k++) differing |= near[k] != NOTHING && near[k] != same;
                if (same < NONE) {
                    int uniform = 1;
                    if (!DECODES) for (int x = x0; x < x1; x++) uniform &= out[x] == same;
                    if (code_simple(range, state->simples[around * 2 + differing], uniform)) {
                        for (int x = x0; x < x1; x++) {
                            out[x] = (Label)same;
                            K[x] = (Known)same;
                        }
                        G[s] = (Known)same;
                        continue;
                    }
                }
                int first = 0, differs = 0;
                for (int x = x0; x < x1; x++) {
                    const int neighbours[AROUND] = {
                        K[x - 1], N[x],     P[x],     B[x],  N[x - 1], N[x + 1], P[x + 1],
                        P[x - 1], PS[x],    PN[x],    B[x + 1], B[x - 1], BS[x], BN[x],
                        BF[x],    BP[x],    K[x - 2], NN[x], PP[x],    BB[x],
                    };
                    const int label = vertex(DECODES ? 0 : out[x], neighbours);
                    if (DECODES) out[x] = (Label)label;
                    K[x] = (Known)label;
                    if (WIDE) highest = max(highest, label);
                    if (x == x0) first = label;
                    differs |= label != first;
                }
                G[s] = (Known)(differs ? MIXED : first);
            }
        }
    }
};

template <class Coder, class Label>
FHASH_INLINE int64_t run_all(Coder& coder, Label* labels, const int64_t* shape) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(labels, shape);
        return 0;
    });
}
FHASH_CLONES int64_t encode(LabelCoder<false, false>& coder, uint8_t* labels,
                            const int64_t* shape) {
    return run_all(coder, labels, shape);
}
FHASH_CLONES int64_t encode(LabelCoder<false, true>& coder, uint16_t* labels,
                            const int64_t* shape) {
    return run_all(coder, labels, shape);
}
FHASH_CLONES int64_t decode(LabelCoder<true, false>& coder, uint8_t* labels,
                            const int64_t* shape) {
    return run_all(coder, labels, shape);
}
FHASH_CLONES int64_t decode(LabelCoder<true, true>& coder, uint16_t* labels,
                            const int64_t* shape) {
    return run_all(coder, labels, shape);
}

// The exported functions, for labels of either type.
template <bool WIDE, class Label>
int64_t encode_all(Label* labels, int64_t count, const int64_t* shape, const uint16_t* slots,
                   int64_t slot_count, const int32_t* weights, int64_t weight_count,
                   const uint16_t* simples, int64_t simple_count, uint8_t* data,
                   int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        std::vector<uint8_t> out;
        LabelCoder<false, WIDE> coder{{&out}, &state, {}, {}, (int)count};
        const int64_t code = encode(coder, labels, shape);
        if (code < 0) return code;
        coder.range.finish();
        return put(out, data, capacity);
    });
}
template <bool WIDE, class Label>
int64_t decode_all(Label* labels, int64_t count, const int64_t* shape, const uint16_t* slots,
                   int64_t slot_count, const int32_t* weights, int64_t weight_count,
                   const uint16_t* simples, int64_t simple_count, const uint8_t* data,
                   int64_t size) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        LabelCoder<true, WIDE> coder{{data, size}, &state, {}, {}, (int)count};
        return decode(coder, labels, shape);
    });
}

}  // namespace

#define FHASH_LABEL_STATE                                                                          \
    const uint16_t *slots, int64_t slot_count, const int32_t *weights, int64_t weight_count,       \
        const uint16_t *simples, int64_t simple_count

// Encode labels (t, z, y, x), each from 0 to `count` - 1; count is 1 to 256, or to 65536 for wide
// ones. The labels are written to, but keep their values.
//
// slots, weights, simples: the state to begin from (transform/entropy/labels.py).
// data: receives the bytes if they fit the capacity.
//
// Returns the number of bytes, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_encode_labels(uint8_t* labels, int64_t count, const int64_t* shape,
                                         FHASH_LABEL_STATE, uint8_t* data, int64_t capacity) {
    return encode_all<false>(labels, count, shape, slots, slot_count, weights, weight_count,
                             simples, simple_count, data, capacity);
}
FHASH_EXPORT int64_t fhash_encode_wide_labels(uint16_t* labels, int64_t count,
                                              const int64_t* shape, FHASH_LABEL_STATE,
                                              uint8_t* data, int64_t capacity) {
    return encode_all<true>(labels, count, shape, slots, slot_count, weights, weight_count,
                            simples, simple_count, data, capacity);
}

// Decode into labels; the other arguments are those of the functions above. Any bytes give labels
// below `count`: the caller must check a digest.
//
// Returns 0 or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode_labels(uint8_t* labels, int64_t count, const int64_t* shape,
                                         FHASH_LABEL_STATE, const uint8_t* data, int64_t size) {
    return decode_all<false>(labels, count, shape, slots, slot_count, weights, weight_count,
                             simples, simple_count, data, size);
}
FHASH_EXPORT int64_t fhash_decode_wide_labels(uint16_t* labels, int64_t count,
                                              const int64_t* shape, FHASH_LABEL_STATE,
                                              const uint8_t* data, int64_t size) {
    return decode_all<true>(labels, count, shape, slots, slot_count, weights, weight_count,
                            simples, simple_count, data, size);
}
