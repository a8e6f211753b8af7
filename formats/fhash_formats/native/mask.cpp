// Entropy coding of masks, which say which vertices of a tile are occupied.
//
// Each bit is predicted by CONTEXTS adaptive estimates that are mixed as in coder.cpp. Contexts
// come from the bits before it (to the left, above, one layer and one step before) and from two
// levels of the vertex and of its neighbours, also of those after it: encoder and decoder have the
// levels from the decoded values (mask_levels.cpp). Where all segments around
// agree, a flag stands for SEGMENT vertices of a row.
// tests/reference/masks.py explains it.
#include <cstdlib>
#include <type_traits>

#include "functions.h"
#include "mixing.hpp"
#include "rows.hpp"
#include "target.hpp"

namespace {

const int CONTEXTS = 10;         // estimates that are mixed for a bit
const int LANES = 2 * CONTEXTS;  // weights of a set of the caller
const int SET = padded(LANES);   // weights of a set as kept here
const int LEVELS = 32, EVEN = 16;  // levels of a vertex; from EVEN on it is more likely occupied
const int NEAR = 16;               // patterns of the four nearest bits; each has a set of weights
const int RATE = 2;                // LEARNING_RATE of masks
const int SEGMENT = 16;            // vertices of a row that share a flag
const int SIZES[CONTEXTS] = {512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048};

// States of a segment: its bits are all 0, all 1, or both; or it does not exist.
const int ZEROS = 0, ONES = 1, MIXED = 2, NOTHING = 3;
// A segment has a flag only if all its levels are among the QUIET ones at the end that agrees.
const int QUIET = 12;

// The bit of a vertex, and above it 1 for a 0 that the level spoke against, 2 for such a 1, else 0.
FHASH_INLINE uint8_t mark(int bit, int level) {
    return (uint8_t)(bit ? (level < EVEN ? 5 : 1) : level < EVEN ? 0 : 2);
}

// The state that segments around have, as far as they exist: `nothing` where none exists, `mixed`
// where they differ. existing: receives their number.
FHASH_INLINE int common_state(const int* states, int count, int nothing, int mixed, int& existing) {
    int same = nothing;
    existing = 0;
    for (int k = 0; k < count; k++) {
        if (states[k] == nothing) continue;
        existing++;
        same = same == nothing || same == states[k] ? states[k] : mixed;
    }
    return same;
}

// One run over a mask.
template <bool DECODES> struct MaskCoder {
    typename std::conditional<DECODES, Decoder, Encoder>::type range;
    State* state;

    FHASH_INLINE int simple(int bit, int64_t number) {
        return code_simple(range, state->simples[number], bit);
    }

    // Code all bits. mask, level, other, shape: as for fhash_encode_mask and fhash_decode_mask.
    void run(uint8_t* mask, const uint8_t* level, const uint8_t* other,
                          const int64_t* shape) {
        const int n0 = (int)shape[0], n1 = (int)shape[1], n2 = (int)shape[2], n3 = (int)shape[3];
        const int segments = (n3 + SEGMENT - 1) / SEGMENT;
        // Strides of vertices and of the states of segments.
        const int64_t S2 = n3, S1 = S2 * n2, S0 = S1 * n1;
        const int64_t G2 = segments + 1, G1 = G2 * n2, G0 = G1 * n1;
        PaddedRows<uint8_t> marks(shape, 0);
        std::vector<uint8_t> segment_states((size_t)G0 * n0, NOTHING);
        Slot* slots[CONTEXTS];
        slots[0] = state->slots.data();
        for (int i = 1; i < CONTEXTS; i++) slots[i] = slots[i - 1] + SIZES[i - 1];
        int informed = 0;  // whether any level is above 0
        for (int64_t i = 0; i < S0 * n0; i++) informed |= level[i];

        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
            const bool more_y = y + 1 < n2, more_z = z + 1 < n1, more_t = t + 1 < n0;
            const int64_t at = t * S0 + z * S1 + y * S2;
            uint8_t* const out = mask + at;
            uint8_t* const G = segment_states.data() + t * G0 + z * G1 + y * G2 + 1;
            const auto [K, N, NN, P, PP, PN, PS, B, BB, BN, BS, BP, BF] = marks.around(t, z, y);
            // Levels of this row (A, and O for the second ones) and of the next ones along y, z, t.
            const uint8_t *const A = level + at, *const O = other + at;
            const uint8_t* const AS = more_y ? A + S2 : A;
            const uint8_t* const AF = more_z ? A + S1 : A;
            const uint8_t* const AT = more_t ? A + S0 : A;

            for (int s = 0; s < segments; s++) {
                const int x0 = s * SEGMENT, x1 = min(x0 + SEGMENT, n3);
                int low = LEVELS - 1, high = 0;
                for (int x = x0; x < x1; x++) {
                    low = min<int>(low, A[x]);
                    high = max<int>(high, A[x]);
                }
                // The state that all segments around have, as far as they exist; where none exists,
                // the state that the levels suggest.
                const int near[4] = {G[s - 1], has_y ? G[s - G2] : NOTHING,
                                     has_z ? G[s - G1] : NOTHING, has_t ? G[s - G0] : NOTHING};
                int around;
                int same = common_state(near, 4, NOTHING, MIXED, around);
                if (same == NOTHING)
                    same = !informed || high < 4 ? ZEROS : low > LEVELS - 5 ? ONES : MIXED;

                // A flag for all bits of the segment.
                if (same != MIXED) {
                    const int away = !informed ? 0 : same == ONES ? LEVELS - 1 - low : high;
                    if (away < QUIET) {
                        int uniform = 1;
                        if (!DECODES) for (int x = x0; x < x1; x++) uniform &= out[x] == same;
                        if (simple(uniform, (same * 3 + away / 4) * 5 + around)) {
                            for (int x = x0; x < x1; x++) {
                                out[x] = (uint8_t)same;
                                K[x] = mark(same, A[x]);
                            }
                            G[s] = (uint8_t)same;
                            continue;
                        }
                    }
                }

                // The bits, one by one. Those before a vertex are w, n, p and b along x, y, z and
                // t. A second letter moves on along x (w, e), y (n, s) or z (p, f). A 2 is for two
                // vertices before.
                int ones = 0;
                for (int x = x0; x < x1; x++) {
                    const int a = A[x], ahead = x + 1 < n3 ? A[x + 1] : a, half = a >> 1;
                    const int w = K[x - 1] & 1, n = N[x] & 1, p = P[x] & 1, b = B[x] & 1;
                    const int nw = N[x - 1] & 1, ne = N[x + 1] & 1;
                    const int pw = P[x - 1] & 1, pe = P[x + 1] & 1, ps = PS[x] & 1, pn = PN[x] & 1;
                    const int bw = B[x - 1] & 1, be = B[x + 1] & 1, bs = BS[x] & 1, bn = BN[x] & 1;
                    const int bf = BF[x] & 1, bp = BP[x] & 1;
                    const int w2 = K[x - 2] & 1, y2 = NN[x] & 1, z2 = PP[x] & 1, t2 = BB[x] & 1;
                    const int near_bits = w | n << 1 | p << 2 | b << 3;
                    const int before =
                        b | be << 1 | bw << 2 | bs << 3 | bn << 4 | bf << 5 | bp << 6;
                    const int sum_plane = w + n + nw + ne, sum_below = p + pw + pe + ps + pn;
                    const int sum_before = b + bw + be + bs + bn + bf + bp;
                    const int against = (a * 3 + (K[x - 1] >> 1)) * 3 + (N[x] >> 1);
                    const int plane = w2 << 4 | nw << 5 | ne << 6 | y2 << 7;
                    const int second = w2 << 4 | y2 << 5 | z2 << 6 | t2 << 7;
                    const int context[CONTEXTS] = {
                        a * NEAR + near_bits,
                        (a * 16 + O[x]) * 2 + w,
                        near_bits | plane | pe << 8 | ps << 9 | be << 10 | bs << 11,
                        ((half * 8 + (ahead >> 2)) * 8 + (AS[x] >> 2)) * 2 + w,
                        ((half * 8 + (AF[x] >> 2)) * 8 + (AT[x] >> 2)) * 2 + p,
                        ((sum_plane * 6 + sum_below) * 8 + sum_before) * 8 + (a >> 2),
                        (against * 3 + (P[x] >> 1)) * 3 + (B[x] >> 1),
                        (a >> 3) << 10 | before | w << 7 | n << 8 | p << 9,
                        near_bits | second | be << 8 | bs << 9 | bf << 10 | pe << 11,
                        half << 7 | before,
                    };
                    Mixed<CONTEXTS> now;
                    for (int i = 0; i < CONTEXTS; i++) now.slots[i] = slots[i] + context[i];
                    now.first = state->weights.data() + a * SET;
                    now.second = state->weights.data() + (LEVELS + near_bits) * SET;
                    const int bit =
                        code_mixed<CONTEXTS, true, RATE>(range, now, DECODES ? 0 : out[x]);
                    if (DECODES) out[x] = (uint8_t)bit;
                    K[x] = mark(bit, a);
                    ones += bit;
                }
                G[s] = (uint8_t)(ones == 0 ? ZEROS : ones == x1 - x0 ? ONES : MIXED);
            }
        }
    }
};

}  // namespace

// Encode a mask of zeros and ones (t, z, y, x).
//
// level, other: two levels of each vertex, 0 to 31 and 0 to 15.
// slots, weights, simples: the state (priors.hpp). It is left adapted if `keep` and
// if the bytes fit.
// data: receives the bytes if they fit the capacity.
//
// Returns the number of bytes, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_encode_mask,
                  (const uint8_t* mask, const uint8_t* level, const uint8_t* other,
                   const int64_t* shape, uint16_t* slots, int64_t slot_count, int32_t* weights,
                   int64_t weight_count, uint16_t* simples, int64_t simple_count, int64_t keep,
                   uint8_t* data, int64_t capacity),
                  (mask, level, other, shape, slots, slot_count, weights, weight_count, simples,
                   simple_count, keep, data, capacity)) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        // The run writes to its mask, also in encoding.
        std::vector<uint8_t> out, bits(mask, mask + shape[0] * shape[1] * shape[2] * shape[3]);
        MaskCoder<false> coder{{&out}, &state};
        coder.run(bits.data(), level, other, shape);
        coder.range.finish();
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) keep_state(state, slots, weights, simples, LANES);
        return size;
    });
}

// Decode into a mask; the other arguments are those of fhash_encode_mask. Any bytes give some mask:
// the caller must check a digest.
//
// Returns 0 or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_decode_mask,
                  (uint8_t* mask, const uint8_t* level, const uint8_t* other,
                   const int64_t* shape, const uint16_t* slots, int64_t slot_count,
                   const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                   int64_t simple_count, const uint8_t* data, int64_t size),
                  (mask, level, other, shape, slots, slot_count, weights, weight_count, simples,
                   simple_count, data, size)) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        MaskCoder<true>{{data, size}, &state}.run(mask, level, other, shape);
        return 0;
    });
}
