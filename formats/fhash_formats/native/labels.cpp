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
#include <cstring>

#include "mixing.hpp"
#include "rows.hpp"

namespace {

FHASH_INLINE int ones(int bits) { return __builtin_popcount((unsigned)bits); }

const int CONTEXTS = 8;          // estimates that are mixed for a decision about a candidate
const int BIT_CONTEXTS = 4;      // estimates that are mixed for a bit of a label
const int LANES = 2 * CONTEXTS;  // weights of a set of the caller
const int SET = padded(LANES);   // weights of a set as kept here
const int TESTED = 3;            // candidates that are tested
const int FOUND = 4;             // candidates that are looked for
const int AROUND = 20;           // neighbours
const int ROOM = 24;             // for them
const int NEAR = 16;             // patterns of the four nearest neighbours
const int ALONE = 256;           // stands for a second candidate where there is one only
const int RATE = 2;              // LEARNING_RATE of labels
const int SIZES[CONTEXTS] = {3072, 6144, 6144, 8192, 65536, 1008, 12288, 12288};
const int CANDIDATE_SETS = TESTED * NEAR + TESTED * FOUND;  // sets of weights of candidates
const int BIT_LEVELS = 16;       // sets of weights of bits
const int NEXT = 10;             // simple estimate of the label after the highest so far
const int ALIKE = 11, RUNS = 4;  // first one of vertices amid equal labels; classes of their runs
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
    state.simples.assign(ALIKE + 8 * RUNS, {32768, 0});
    return state;
}

// Bits of the neighbours that have a label.
FHASH_INLINE uint32_t which(const int* around, int label) {
    typedef uint32_t Lanes __attribute__((vector_size(32)));
    const Lanes one = {1, 2, 4, 8, 16, 32, 64, 128};
    Lanes bits = {};
    for (int i = 0; i < ROOM; i += 8) {
        Lanes labels;
        std::memcpy(&labels, around + i, sizeof labels);
        bits |= (Lanes)(labels == (uint32_t)label) & one << i;
    }
    uint32_t all = 0;
    for (int i = 0; i < 8; i++) all |= bits[i];
    return all;
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

    // Code whether a vertex has candidate k of `found`. have: bits of the neighbours that have it.
    FHASH_INLINE int test(int bit, int k, const int* candidates, int found, uint32_t have) {
        const int other = found > 1 ? key(candidates[k ? 0 : 1]) : ALONE;
        const int c = key(candidates[k]);
        const auto bits = [have](int first, int count) FHASH_LAMBDA {
            return (int)(have >> first & ((1u << count) - 1));
        };
        const int near = bits(0, 4), second = bits(16, 4);
        const int plane = bits(0, 2) | bits(4, 2) << 2 | bits(16, 2) << 4;
        const int below = bits(2, 1) | bits(6, 4) << 1;
        const int before = bits(3, 1) | bits(10, 6) << 1;
        const int sum_plane = ones(plane), sum_below = ones(below), sum_before = ones(before);
        const int mixed = bits(2, 2) << 6 | bits(6, 1) << 8 | bits(8, 1) << 9 | bits(10, 1) << 10 |
                          bits(12, 1) << 11;
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
        uint32_t have[FOUND], rest = ~which(around, NONE) & ((1u << AROUND) - 1);
        while (rest && found < FOUND) {
            const int label = around[__builtin_ctz(rest)];
            const uint32_t bits = which(around, label);
            const int vote = ones((int)bits) + 2 * ones((int)bits & (NEAR - 1));
            rest &= ~bits;
            int k = found++;
            for (; k > 0 && votes[k - 1] < vote; k--) {
                candidates[k] = candidates[k - 1];
                votes[k] = votes[k - 1];
                have[k] = have[k - 1];
            }
            candidates[k] = label;
            votes[k] = vote;
            have[k] = bits;
        }
        const int tested = min(found, TESTED);
        for (int k = 0; k < tested; k++) {
            if (k == count - 1) return candidates[k];  // no other label is left
            if (test(label == candidates[k], k, candidates, found, have[k])) return candidates[k];
        }
        return spell(label, candidates, tested, around);
    }

    // Find out which vertices of a segment lie amid equal labels, as far as rows before this one
    // tell: 0 for these. like: the nearest of the rows.
    FHASH_INLINE static void find_alike(const Rows<int32_t>& of, const int32_t* none,
                                        const int32_t* like, int x0, int x1, int32_t* alike) {
        std::fill_n(alike, x1 - x0, 0);
        const auto compare = [&](const int32_t* row, int reach) FHASH_LAMBDA {
            for (int move = -reach; move <= reach && row != none; move++)
                for (int x = x0; x < x1; x++) alike[x - x0] |= row[x + move] ^ like[x];
        };
        for (const int32_t* row : {of.N, of.P, of.B}) compare(row, 1);
        for (const int32_t* row : {of.NN, of.PP, of.PN, of.PS, of.BB, of.BN, of.BS, of.BP, of.BF})
            compare(row, 0);
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
            const Rows<int32_t> rows = known.around(t, z, y);
            const auto [K, N, NN, P, PP, PN, PS, B, BB, BN, BS, BP, BF] = rows;
            const int32_t* const like = has_y ? N : has_z ? P : B;
            const int exist = count > 1 ? has_y + 2 * has_z + 4 * has_t : 0;
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
                int first = 0, differs = 0, run = 0;
                int32_t alike[SEGMENT];
                if (exist) find_alike(rows, known.none(), like, x0, x1, alike);
                for (int x = x0; x < x1; x++) {
                    const int neighbours[ROOM] = {
                        K[x - 1], N[x],     P[x],     B[x],  N[x - 1], N[x + 1], P[x + 1],
                        P[x - 1], PS[x],    PN[x],    B[x + 1], B[x - 1], BS[x], BN[x],
                        BF[x],    BP[x],    K[x - 2], NN[x], PP[x],    BB[x],
                        NONE,     NONE,     NONE,     NONE,
                    };
                    int label = DECODES ? 0 : out[x];
                    if (exist && !(alike[x - x0] | (K[x - 1] ^ like[x]) | (K[x - 2] ^ like[x]))) {
                        // By far the most vertices, for which one estimate does.
                        Simple& estimate = state->simples[ALIKE + exist * RUNS + run];
                        const bool same_again = code_simple(range, estimate, label == like[x]) != 0;
                        run = same_again ? min(run + 1, RUNS - 1) : 0;
                        label = same_again ? like[x] : spell(label, like + x, 1, neighbours);
                    } else label = vertex(label, neighbours);
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
