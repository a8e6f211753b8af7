// Entropy coding of labels: few distinct values, equal over regions, without an order.
//
// Where the rows before have one label around a vertex, and the vertex to the left has it, a flag
// says that up to RUN vertices have it. Elsewhere the labels around are the candidates of a vertex,
// those that occur more often first. A decision says whether the vertex has the first candidate,
// then the second, then the third. Each decision is predicted from which neighbours have the
// candidate, as in mask.cpp. Where no candidate holds, the label follows bit by bit, without the
// labels that are excluded.
// tests/reference/labels.py explains it.
//
// A label chooses its estimates by a hash. Before its bits, a flag says whether it is the one after
// the highest so far.
#include <bitset>

#include "functions.h"
#include "mixing.hpp"
#include "rows.hpp"
#include "target.hpp"

namespace {

const int CONTEXTS = 5;                // estimates that are mixed for a decision
const int BIT_CONTEXTS = 4;            // estimates that are mixed for a bit of a label
const int SET = padded(2 * CONTEXTS);  // weights of a set
const int TESTED = 3;                  // candidates that are tested
const int FOUND = 4;                   // candidates that are looked for
const int AROUND = 20;                 // neighbours, in the order of `run`
const int BESIDE = 15;                 // the first of them, by which a run is known
const int LEFT = 18;                   // number of the one to the left
const int NEAR = 16;                   // patterns of the four nearest neighbours
const int ALONE = 256;                 // stands for a second candidate where there is one only
const int RUN = 16;                    // vertices of a run, at most
const int BLOCK = 32;                  // vertices whose neighbours are compared together
const int RATE = 2;                    // LEARNING_RATE of labels
const int SIZES[CONTEXTS] = {6144, 49152, 12288, 65536, 65536};
const int CANDIDATE_SETS = TESTED * NEAR + TESTED * FOUND;  // sets of weights of candidates
const int BIT_LEVELS = 16;                                  // sets of weights of bits
// Simple estimates: whether a run holds, by its length and whether the one before held; whether it
// ends at a vertex, by those left; whether a label is the one after the highest so far.
const int HOLDS = 0, ENDS = 10, NEXT = 18, SIMPLES = 19;
const uint32_t SCATTER = 40503;            // multiplier of hashes: 2^16 over the golden ratio
const uint16_t QUIET = (1 << BESIDE) - 1;  // all neighbours beside

// A state that has learned nothing: even odds, and weights that believe the estimates.
State blank_state(int bit_size) {
    State state;
    int slots = BIT_CONTEXTS * bit_size;
    for (int size : SIZES) slots += size;
    state.slots.assign((size_t)slots, {32768, 32768, 0, 0});
    state.weights.assign((size_t)((CANDIDATE_SETS + BIT_LEVELS + TESTED + 1) * SET), 0);
    std::fill_n(state.weights.begin(), TESTED * NEAR * SET, (int16_t)4915);
    std::fill_n(state.weights.begin() + CANDIDATE_SETS * SET, BIT_LEVELS * SET, (int16_t)4096);
    state.simples.assign(SIMPLES, {32768, 0});
    return state;
}

// One run over labels.
template <bool DECODES> struct LabelCoder {
    typename std::conditional<DECODES, Decoder, Encoder>::type range;
    int count;     // number of labels
    int bit_size;  // contexts of an estimate of bits
    State blank;
    State* state = &blank;
    Slot *slots[CONTEXTS], *bit_slots[BIT_CONTEXTS];
    int highest = 0;             // highest label so far
    int held = 1;                // whether the last run held
    const uint16_t* at[AROUND];  // neighbours of the first vertex of a row
    // Of each vertex of a row: which neighbours beside have the label of the first one, the next
    // label there, and which have that.
    std::vector<uint16_t> in_first, others, in_second;

    // Number below 256 by which a label chooses its estimates.
    FHASH_INLINE static uint32_t key(int label) { return (uint32_t)label * SCATTER >> 8 & 255; }

    // Context of a bit of a label, by another label.
    FHASH_INLINE int beside(int label, int node) const {
        return (int)(((uint32_t)label * SCATTER + (uint32_t)node) & (uint32_t)(bit_size - 1));
    }

    // Which of the four nearest neighbours are in a set.
    FHASH_INLINE static uint32_t nearest(uint32_t set) {
        return (set & 7) | (set >> (LEFT - 3) & 8);
    }

    // Code whether a vertex has candidate k of `found`. sets: which neighbours have them.
    FHASH_INLINE int test(int bit, int k, const int* candidates, const uint32_t* sets, int found) {
        const uint32_t own = sets[k], near = nearest(own);
        const int rival = k ? 0 : 1;
        const uint32_t other = found > 1 ? key(candidates[rival]) : ALONE;
        const uint32_t both = (key(candidates[k]) * 259 + other) << 4 | near;
        const uint32_t plane = (own & 1) | (own >> 2 & 6) | (own >> 12 & 8) | (own >> 14 & 48);
        const uint32_t below = (own >> 1 & 1) | (own >> 4 & 30), before = own >> 9 & 63;
        const uint32_t order = (uint32_t)k;
        const uint32_t context[CONTEXTS] = {
            (order << 6 | plane) << 5 | below,
            ((order << 4 | near) << 4 | (found > 1 ? nearest(sets[rival]) : 0)) << 6 | before,
            ((order << 6 | before) << 1 | (own >> 2 & 1)) << 5 | below,
            both & 65535,
            (both + (own >> 3 & 63) * SCATTER) & 65535,
        };
        Mixed<CONTEXTS> now;
        for (int i = 0; i < CONTEXTS; i++) now.slots[i] = slots[i] + context[i];
        now.first = state->weights.data() + (k * NEAR + (int)near) * SET;
        now.second = state->weights.data() + (TESTED * NEAR + k * FOUND + found - 1) * SET;
        return code_mixed<CONTEXTS, true, RATE>(range, now, bit);
    }

    // Number of labels from `low` to `high` - 1 that are not among the first `tested` candidates.
    FHASH_INLINE int allowed(int low, int high, const int* candidates, int tested) const {
        int n = max(min(high, count) - low, 0);
        for (int i = 0; i < tested; i++) n -= candidates[i] >= low && candidates[i] < high;
        return n;
    }

    // Code the label of vertex x that is none of the first `tested` candidates, from its highest
    // bit on.
    int spell(int label, int x, const int* candidates, int tested) {
        const int next = highest + 1;
        if (next < count && code_simple(range, state->simples[NEXT], label == next)) return next;
        int low = 0, node = 1, level = significant((uint32_t)(count - 1));
        while (level-- > 0) {
            const int middle = low + (1 << level);
            int bit = label >= middle;
            if (!allowed(low, middle, candidates, tested)) bit = 1;
            else if (!allowed(middle, middle + (1 << level), candidates, tested)) bit = 0;
            else {
                const int context[BIT_CONTEXTS] = {
                    node,
                    beside(candidates[0], node),
                    beside(at[2][x], node),
                    beside(at[1][x], node),
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

    // Which neighbours of vertex x have a label, of those from `from` on.
    FHASH_INLINE uint32_t having(int label, int x, int from) const {
        uint32_t set = 0;
        FHASH_UNROLLED for (int i = from; i < AROUND; i++)
            set |= (uint32_t)(at[i][x] == label) << i;
        return set;
    }

    // Code the label of vertex x.
    FHASH_INLINE int vertex(int label, int x) {
        // The first labels around, those that occur more often first; the nearest count threefold.
        int candidates[FOUND], votes[FOUND], found = 0;
        uint32_t sets[FOUND], rest = (1u << AROUND) - 1;
        const auto add = [&](int candidate, uint32_t set) FHASH_LAMBDA {
            const std::bitset<AROUND> all(set), close(nearest(set));
            const int vote = (int)(all.count() + 2 * close.count());
            int k = found++;
            for (; k > 0 && vote > votes[k - 1]; k--) {
                votes[k] = votes[k - 1];
                candidates[k] = candidates[k - 1];
                sets[k] = sets[k - 1];
            }
            votes[k] = vote;
            candidates[k] = candidate;
            sets[k] = set;
            rest &= ~set;
        };
        // Most labels are among these, whose neighbours are known but for a few.
        add(at[0][x], in_first[x] | having(at[0][x], x, BESIDE));
        if (in_first[x] != QUIET) add(others[x], in_second[x] | having(others[x], x, BESIDE));
        if (rest >> LEFT & 1) add(at[LEFT][x], having(at[LEFT][x], x, 0));
        while (rest && found < FOUND) {
            const int candidate = at[significant(rest & (0 - rest)) - 1][x];
            add(candidate, having(candidate, x, 0));
        }
        const int tested = min(found, TESTED);
        for (int k = 0; k < tested; k++) {
            if (k == count - 1) return candidates[k];  // no other label is left
            if (test(label == candidates[k], k, candidates, sets, found)) return candidates[k];
        }
        return spell(label, x, candidates, tested);
    }

    // For each vertex of a row from x to `end` - 1: which neighbours beside have the label in
    // `labels`. row: `at`, as pointers that the compiler knows not to change.
    // Returns those that do for all vertices.
    static uint16_t compare(int x, int end, const uint16_t* const* row,
                                         const uint16_t* labels, uint16_t* sets) {
        uint16_t all = QUIET;
        FHASH_INDEPENDENT for (; x < end; x++) {
            uint16_t set = 0;
            FHASH_UNROLLED for (int i = 0; i < BESIDE; i++)
                set |= row[i][x] == labels[x] ? (uint16_t)(1 << i) : (uint16_t)0;
            sets[x] = set;
            all &= set;
        }
        return all;
    }

    // Look at the neighbours beside of a row of n vertices. row: see `compare`.
    void look(int n, const uint16_t* const* row) {
        uint16_t* const other = others.data();
        for (int x0 = 0; x0 < n; x0 += BLOCK) {
            const int x1 = min(x0 + BLOCK, n);
            if (compare(x0, x1, row, row[0], in_first.data()) == QUIET) continue;
            FHASH_INDEPENDENT for (int x = x0; x < x1; x++) {
                uint16_t label = row[0][x];
                FHASH_UNROLLED for (int i = BESIDE - 1; i > 0; i--)
                    label = row[i][x] != row[0][x] ? row[i][x] : label;
                other[x] = label;
            }
            compare(x0, x1, row, other, in_second.data());
        }
    }

    // Code how many of the next `length` vertices have the label that all around have. out: the
    // first of them.
    FHASH_INLINE int same(const uint16_t* out, int length, int label) {
        int end = 0;
        if (!DECODES) while (end < length && out[end] == label) end++;
        const int estimate = HOLDS + 2 * significant((uint32_t)(length - 1)) + held;
        held = code_simple(range, state->simples[estimate], end == length);
        if (held) return length;
        for (int k = 0; k < length - 1; k++) {
            Simple& ends = state->simples[ENDS + min(length - 1 - k, 7)];
            if (code_simple(range, ends, k == end)) return k;
        }
        return length - 1;
    }

    // Code all labels (t, z, y, x), each below `count`.
    void run(uint16_t* labels, const int64_t* shape) {
        const int n0 = (int)shape[0], n1 = (int)shape[1], n2 = (int)shape[2], n3 = (int)shape[3];
        PaddedRows<uint16_t> known(shape, 0);
        for (auto* row : {&in_first, &others, &in_second}) row->resize((size_t)n3);
        slots[0] = state->slots.data();
        for (int i = 1; i < CONTEXTS; i++) slots[i] = slots[i - 1] + SIZES[i - 1];
        bit_slots[0] = slots[CONTEXTS - 1] + SIZES[CONTEXTS - 1];
        for (int i = 1; i < BIT_CONTEXTS; i++) bit_slots[i] = bit_slots[i - 1] + bit_size;

        uint16_t* out = labels;
        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            auto [K, N, NN, P, PP, PN, PS, B, BB, BN, BS, BP, BF] = known.around(t, z, y);
            // A row that does not exist is as the last one before this row, so that all neighbours
            // exist and need no test.
            const uint16_t* const none = known.nothing.data() + PADDING;
            const uint16_t* const A = y ? N : z ? P : B;
            for (const uint16_t** row : {&N, &NN, &P, &PP, &PN, &PS, &B, &BB, &BN, &BS, &BP, &BF})
                if (*row == none) *row = A;
            K[-1] = K[-2] = A[0];
            const uint16_t* const around[AROUND] = {
                N,  P,  B,  N - 1, N + 1, P + 1, P - 1, PS, PN,    B + 1,
                B - 1, BS, BN, BF, BP,    NN,    PP,    BB, K - 1, K - 2,
            };
            std::copy_n(around, AROUND, at);
            look(n3, around);
            for (int x = 0; x < n3;) {
                const int label = A[x], most = min(RUN, n3 - x);
                int length = 0;
                if (K[x - 1] == label)
                    while (length < most && in_first[x + length] == QUIET) length++;
                const int end = x + (length ? same(out + x, length, label) : 0);
                for (; x < end; x++) {
                    K[x] = (uint16_t)label;
                    if (DECODES) out[x] = (uint16_t)label;
                }
                if (length && held) continue;
                // A vertex that ends a run early, or is in none.
                const int given = DECODES ? 0 : out[x];
                const int found = length ? spell(given, x, &label, 1) : vertex(given, x);
                K[x] = (uint16_t)found;
                if (DECODES) out[x] = (uint16_t)found;
                highest = max(highest, found);
                x++;
            }
            // Rows after this one see its first and its last vertex repeated.
            K[-1] = K[0];
            K[n3] = K[n3 - 1];
            out += n3;
        }
    }
};

// Contexts of an estimate of bits: more, where there are more labels.
int bit_contexts(int64_t count) {
    return 256 << min(significant((uint32_t)(count - 1)), 8);
}

}  // namespace

// Encode labels (t, z, y, x), each from 0 to `count` - 1; count is 1 to 65536. The labels are
// written to, but keep their values.
//
// data: receives the bytes if they fit the capacity.
//
// Returns the number of bytes, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_encode_labels,
                  (uint16_t* labels, int64_t count, const int64_t* shape, uint8_t* data,
                   int64_t capacity),
                  (labels, count, shape, data, capacity)) {
    return guarded([&]() -> int64_t {
        const int size = bit_contexts(count);
        std::vector<uint8_t> out;
        LabelCoder<false> coder{{&out}, (int)count, size, blank_state(size)};
        coder.run(labels, shape);
        coder.range.finish();
        return put(out, data, capacity);
    });
}

// Decode into labels; the other arguments are those of the function above. Any bytes give labels
// below `count`.
//
// Returns 0 or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_decode_labels,
                  (uint16_t* labels, int64_t count, const int64_t* shape, const uint8_t* data,
                   int64_t size),
                  (labels, count, shape, data, size)) {
    return guarded([&]() -> int64_t {
        const int contexts = bit_contexts(count);
        LabelCoder<true> coder{{data, size}, (int)count, contexts, blank_state(contexts)};
        coder.run(labels, shape);
        return 0;
    });
}
