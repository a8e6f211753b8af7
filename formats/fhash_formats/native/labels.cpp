// Entropy coding of labels: few distinct values, equal over regions, without an order.
//
// The labels around a vertex that are known before it are its candidates, those that occur more
// often first. A decision says whether the vertex has the first candidate, then the second, then
// the third. Each decision is predicted from which neighbours have the candidate, as in mask.cpp.
// Where no candidate holds, the label follows bit by bit, without the labels that are excluded.
// Where all segments around are of one label, a flag stands for SEGMENT vertices of a row.
// tests/reference/labels.py explains it.
//
// A label chooses its estimates by a hash. Before its bits, a flag says whether it is the one after
// the highest so far.
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
const int BIT_LEVELS = 16;       // sets of weights of bits
const int NEXT = 10;             // simple estimate of the label after the highest so far
const uint32_t SCATTER = 40503;  // multiplier of hashes: 2^16 over the golden ratio
const int NONE = 65536;          // label of vertices that do not exist
const int MIXED = NONE + 1;      // state of a segment of more than one label
const int NOTHING = NONE + 2;    // state of a segment that does not exist

// A state that has learned nothing: even odds, and weights that believe the estimates.
State blank_state(int bit_size) {
    State state;
    int slots = BIT_CONTEXTS * bit_size;
    for (int size : SIZES) slots += size;
    state.slots.assign((size_t)slots, {32768, 32768, 0, 0});
    state.weights.assign((size_t)((CANDIDATE_SETS + BIT_LEVELS + TESTED + 1) * SET), 0);
    std::fill_n(state.weights.begin(), TESTED * NEAR * SET, (int16_t)3072);
    std::fill_n(state.weights.begin() + CANDIDATE_SETS * SET, BIT_LEVELS * SET, (int16_t)4096);
    state.simples.assign(NEXT + 1, {32768, 0});
    return state;
}

// One run over labels.
template <bool DECODES> struct LabelCoder {
    typename std::conditional<DECODES, Decoder, Encoder>::type range;
    int count;         // number of labels
    int bit_size;      // contexts of an estimate of bits
    State blank;
    State* state = &blank;
    Slot *slots[CONTEXTS], *bit_slots[BIT_CONTEXTS];
    int highest = -1;  // highest label so far

    // Number below 256 by which a label chooses its estimates.
    FHASH_INLINE static int key(int label) {
        return (int)(((uint32_t)label * SCATTER >> 8) & 255);
    }

    // Context of a bit of a label, by another label.
    FHASH_INLINE int beside(int label, int node) const {
        return (int)(((uint32_t)label * SCATTER + (uint32_t)node) & (uint32_t)(bit_size - 1));
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
        if (highest + 1 < count &&
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
    FHASH_INLINE void run(uint16_t* labels, const int64_t* shape) {
        const int n0 = (int)shape[0], n1 = (int)shape[1], n2 = (int)shape[2], n3 = (int)shape[3];
        const int segments = (n3 + SEGMENT - 1) / SEGMENT;
        // Strides of labels and of the states of segments.
        const int64_t S2 = n3, S1 = S2 * n2, S0 = S1 * n1;
        const int64_t G2 = segments + 2, G1 = G2 * n2, G0 = G1 * n1;
        PaddedRows<int32_t> known(shape, NONE);
        std::vector<int32_t> segment_states((size_t)G0 * n0, NOTHING);
        std::vector<int32_t> no_states((size_t)G2, NOTHING);
        slots[0] = state->slots.data();
        for (int i = 1; i < CONTEXTS; i++) slots[i] = slots[i - 1] + SIZES[i - 1];
        bit_slots[0] = slots[CONTEXTS - 1] + SIZES[CONTEXTS - 1];
        for (int i = 1; i < BIT_CONTEXTS; i++) bit_slots[i] = bit_slots[i - 1] + bit_size;

        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
            uint16_t* const out = labels + t * S0 + z * S1 + y * S2;
            const auto [K, N, NN, P, PP, PN, PS, B, BB, BN, BS, BP, BF] = known.around(t, z, y);
            // States of the segments of this row and of the rows before it.
            int32_t* const G = segment_states.data() + t * G0 + z * G1 + y * G2 + 1;
            const int32_t* const no_state = no_states.data() + 1;
            const int32_t* const GN = has_y ? G - G2 : no_state;
            const int32_t* const GP = has_z ? G - G1 : no_state;
            const int32_t* const GB = has_t ? G - G0 : no_state;

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
                            out[x] = (uint16_t)same;
                            K[x] = same;
                        }
                        G[s] = same;
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
                    if (DECODES) out[x] = (uint16_t)label;
                    K[x] = label;
                    highest = max(highest, label);
                    if (x == x0) first = label;
                    differs |= label != first;
                }
                G[s] = (differs ? MIXED : first);
            }
        }
    }
};

// Contexts of an estimate of bits: more, where there are more labels.
int bit_contexts(int64_t count) {
    return 256 << min(significant((uint32_t)(count - 1)), 8);
}

template <class Coder> FHASH_INLINE int64_t run_all(Coder& coder, uint16_t* labels,
                                                    const int64_t* shape) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(labels, shape);
        return 0;
    });
}
FHASH_CLONES int64_t encode(LabelCoder<false>& coder, uint16_t* labels, const int64_t* shape) {
    return run_all(coder, labels, shape);
}
FHASH_CLONES int64_t decode(LabelCoder<true>& coder, uint16_t* labels, const int64_t* shape) {
    return run_all(coder, labels, shape);
}

}  // namespace

// Encode labels (t, z, y, x), each from 0 to `count` - 1; count is 1 to 65536. The labels are
// written to, but keep their values.
//
// data: receives the bytes if they fit the capacity.
//
// Returns the number of bytes, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_encode_labels(uint16_t* labels, int64_t count, const int64_t* shape,
                                         uint8_t* data, int64_t capacity) {
    return guarded([&]() -> int64_t {
        const int size = bit_contexts(count);
        std::vector<uint8_t> out;
        LabelCoder<false> coder{{&out}, (int)count, size, blank_state(size)};
        const int64_t code = encode(coder, labels, shape);
        if (code < 0) return code;
        coder.range.finish();
        return put(out, data, capacity);
    });
}

// Decode into labels; the other arguments are those of the function above. Any bytes give labels
// below `count`.
//
// Returns 0 or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode_labels(uint16_t* labels, int64_t count, const int64_t* shape,
                                         const uint8_t* data, int64_t size) {
    return guarded([&]() -> int64_t {
        const int contexts = bit_contexts(count);
        LabelCoder<true> coder{{data, size}, (int)count, contexts, blank_state(contexts)};
        return decode(coder, labels, shape);
    });
}
