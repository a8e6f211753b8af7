// The fast entropy coder: fixed distributions, coded in lanes side by side.
//
// Integers are coded band by band, row by row, in blocks of 16 along x: first the eight even places
// of a block, then the odd ones, which lie between them. The context of a magnitude is the weighted
// mean of the magnitudes around it, in half octaves; a sign is predicted by the signs around it, as
// far as they have agreed before. Each context has one of the distributions of the prior, by which
// eight lanes are coded with asymmetric numeral systems (rANS, Duda 2013). What cannot be foretold,
// low bits of large magnitudes, lies beside that as it is; flags of empty bands, rows and blocks
// have adaptive estimates. Floating point is single and each result is rounded alone, so that every
// machine has the same levels. tests/reference/fast.py explains it.
//
// Here is what encoder and decoder share: the way through the bands, the flags, and what is known
// around a row. It is compiled for the baseline (fast.cpp) and for AVX2 (fast_v3.cpp).
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>

#include "bands.hpp"
#include "mixing.hpp"
#include "target.hpp"

#if !defined(__GNUC__)
#error "GCC or Clang: the lanes are vectors by their extension of the language"
#endif

namespace {

using std::int8_t;

const int LANES = 8;      // values that are coded side by side
const int BLOCK = 16;     // vertices along x that share a flag: the even and the odd lanes
const int WORD = 8;       // blocks whose flags are looked at together
const int PADDING = 16;   // zeros before a row of magnitudes, and at least as many behind it
const int LEVELS = 24;    // half octaves of the mean magnitude around a vertex
const int LOWEST = 5;     // the first of them begins this many octaves below 1
const int SHIFTED = 13;   // every second level from here on leaves one more low bit raw
const int LARGEST = 255;  // magnitude as contexts see it, after the band's shift
const int MANY = 160;     // mean magnitude above which a band is shifted
const int MAX_SHIFT = 29;
const int MAX_LOW = 30;   // low bits of a magnitude at most
const int GROUPS = 4;     // of bands: low-low, and the three orientations of a plane
const int PLANE_OF_BASIS = 13;
const uint32_t MAX_INTEGER = (1u << 30) - 1;

// Tokens of a magnitude: itself up to 8, then intervals of 2, 4, 8 ... magnitudes, beside which
// the place within is raw; the last one has no end.
const int TOKENS = 16, DIRECT = 9, LAST = TOKENS - 1;
const int FIRST[TOKENS] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 15, 23, 39, 71, 135};
const int LAST_BITS = 7;  // bits of the place in the last interval, at least

const int SIGNS = 5;         // signs that predict one: above, below, before, to the left and right
const int SIGN_LEVELS = 16;  // half octaves of the odds of a sign
const int SIGN_SHIFT = 3;    // from 16ths of octaves

const int CLASSES = 3;  // of the nearest reference: 0, at most the mean around, more than that

// Contexts: of magnitudes by group, parity, class and level, once for the plain quantiser and once
// for each of the two of a trellis; then of signs; the last one is of nothing.
const int MAGNITUDES = GROUPS * 2 * CLASSES * LEVELS, OF_SIGNS = 3 * MAGNITUDES;
const int CONTEXTS = OF_SIGNS + SIGN_LEVELS, NOTHING = CONTEXTS;
// Whether a context is one of the plain quantiser, or of a trellis; those of signs are of both.
FHASH_INLINE bool is_used(int context, bool trellis) {
    return context >= OF_SIGNS || (context >= MAGNITUDES) == trellis;
}
// Distributions of the prior: of tokens, and then of signs; the last one is that of nothing.
const int CHOICES = 64, CERTAIN = 2 * CHOICES;
const int CHOICE_BITS = 6;
const int PRECISION = 11;  // bits of a probability
const uint32_t SLOTS = 1u << PRECISION, LEAST_STATE = 1u << 16;

const int FLAG_CLASSES = 14;  // of flags of blocks, by the magnitudes around; from here on no flag
const int LOWEST_FLAG = 3;    // the first class has means up to this many octaves below 1
enum Flag { BANDS = 0, ROWS = 1, SHIFTS = 3, BLOCKS = 8, FLAGS = BLOCKS + 8 * FLAG_CLASSES };

// Weights of the magnitudes around: above along y and beside that, two above; the same one layer
// and one step before; the vertices of references and beside them; to the left and to the right.
const int ABOVE = 16, ABOVE_SIDES = 6, ABOVE2 = 3;
const int BELOW = 16, BELOW_SIDES = 2, BELOW_NEAR = 4, BELOW2 = 4;
const int BEFORE = 8, BEFORE_SIDES = 1, BEFORE_NEAR = 3, BEFORE2 = 3;
const int REFERENCE[REFERENCE_COUNT] = {4, 12, 4, 3};
const int REFERENCE_SIDES[REFERENCE_COUNT] = {1, 2, 0, 1};
const int SIDE = 16;

// The prior (priors.hpp): a distribution is the slots that each of its symbols has.
struct Prior {
    const uint16_t (*slots)[TOKENS];
    const uint8_t* defaults;  // by context
    const uint32_t* lookup;   // by distribution and slot: symbol, place among its slots, its slots
};

struct Band : BandPlace {
    int shift = 0;      // low bits that are left raw everywhere
    int blocks = 0;     // of a row
    int64_t pitch = 0;  // of rows
    int64_t filled_pitch = 0;
    bool any = false;   // whether an integer is not 0
    std::vector<uint8_t> magnitudes;
    std::vector<int8_t> signs;    // even and then odd places of each block
    std::vector<uint8_t> filled;  // by block, with 0 before each row and to the end of a word

    int64_t row(int t, int z, int y) const { return ((int64_t)t * size[1] + z) * size[2] + y; }
    uint8_t* magnitudes_of(int64_t row) { return magnitudes.data() + row * pitch + PADDING; }
    int8_t* signs_of(int64_t row) { return signs.data() + row * pitch + PADDING; }
    uint8_t* filled_of(int64_t row) { return filled.data() + row * filled_pitch + 1; }
};

// The lanes, and the places of a block.
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef uint32_t Words __attribute__((vector_size(4 * LANES)));
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int64_t Halves __attribute__((vector_size(4 * LANES)));  // pairs of lanes
typedef int8_t Signs __attribute__((vector_size(LANES)));
typedef uint16_t Shorts __attribute__((vector_size(2 * LANES)));
typedef uint8_t Bytes __attribute__((vector_size(BLOCK)));
typedef uint16_t Sums __attribute__((vector_size(2 * BLOCK)));

template <class Vector> FHASH_INLINE Vector loaded(const void* from) {
    Vector vector;
    std::memcpy(&vector, from, sizeof vector);
    return vector;
}
template <class Vector> FHASH_INLINE void stored(void* to, const Vector& vector) {
    std::memcpy(to, &vector, sizeof vector);
}
FHASH_INLINE Ints all(int number) { return Ints{} + number; }
FHASH_INLINE Ints least(Ints a, Ints b) { return a < b ? a : b; }
FHASH_INLINE Ints most(Ints a, Ints b) { return a > b ? a : b; }
FHASH_INLINE Floats floats(Ints of) { return __builtin_convertvector(of, Floats); }
FHASH_INLINE bool any(Ints of) {
    const Halves pairs = (Halves)of;
    return ((pairs[0] | pairs[1]) | (pairs[2] | pairs[3])) != 0;
}
FHASH_INLINE int sum(const Ints& of) {  // of numbers that are not negative
    const Halves pairs = (Halves)of;
    const int64_t both = (pairs[0] + pairs[1]) + (pairs[2] + pairs[3]);
    return (int)(uint32_t)both + (int)(both >> 32);
}
// The lanes of the next place; 0 in the last one.
FHASH_INLINE Ints next(Ints of) {
    return Ints{of[1], of[2], of[3], of[4], of[5], of[6], of[7], 0};
}
// The lanes of a mask, as bits.
FHASH_INLINE int lanes_of(Ints mask) {
#if FHASH_TARGET == 3
    return _mm256_movemask_ps((__m256)mask);
#else
    int lanes = 0;
    for (int i = 0; i < LANES; i++) lanes |= (mask[i] & 1) << i;
    return lanes;
#endif
}
// The even places of a block, and the odd ones.
FHASH_INLINE Ints places(Sums of, int parity) {
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    parity ^= 1;
#endif
    return ((Ints)of >> 16 * parity) & 0xffff;
}
template <class Vector> FHASH_INLINE Vector evens(Vector a, Vector b) {
    return Vector{a[0], a[2], a[4], a[6], b[0], b[2], b[4], b[6]};
}
template <class Vector> FHASH_INLINE Vector odds(Vector a, Vector b) {
    return Vector{a[1], a[3], a[5], a[7], b[1], b[3], b[5], b[7]};
}

// States of a trellis after some indices (bands.hpp): eight of three bits, four bits apart.
FHASH_INLINE Ints states_after(Ints states, Ints indices) {
    uint32_t next[2] = {};
    for (int state = 0; state < 8; state++)
        for (int odd = 0; odd < 2; odd++)
            next[odd] |= (uint32_t)TRELLIS_NEXT[state][odd] << (4 * state);
    const Ints even = (Ints)((Words{} + next[0]) >> (Words)(4 * states));
    const Ints odd = (Ints)((Words{} + next[1]) >> (Words)(4 * states));
    return ((indices & 1) ? odd : even) & 7;
}

// Half octaves of numbers that are not negative, from an origin far below.
FHASH_INLINE Ints half_octaves(Floats numbers) { return (Ints)numbers >> 22; }
FHASH_INLINE Ints levels_of(Floats means) {
    const Ints levels = half_octaves(means) - (2 * (127 - LOWEST) - 1);
    return least(most(levels, Ints{}), all(LEVELS - 1));
}
FHASH_INLINE int low_bits(int level) { return max((level - SHIFTED) >> 1, 0); }
// The token of a magnitude is that or, from DIRECT on, by its bits less 7.
FHASH_INLINE Ints tokens_of(Ints magnitudes) {
    const Ints bits = ((Ints)floats(least(magnitudes - 7, all(255))) >> 23) - 126;
    return magnitudes < DIRECT ? magnitudes : least(bits + 7, all(LAST));
}
const Ints PLACES = {0, 2, 4, 6, 8, 10, 12, 14};  // even ones of a block
const int OTHER = 1 << 16, MANY_BLOCKS = 1 << 14;  // see `Lattice::same`

// Eight places of a block, of one parity, and what is around them.
struct Half {
    Ints contexts, low;      // low: bits of a magnitude that are left raw
    Ints foretold, odds;     // of signs: 1 for a negative one, and its context
    Ints magnitudes, signs;  // what is coded; 0 is the sign of 0
    Ints quantisers;         // of a trellis: 0 or 1
};

// The way through the bands. Self codes: it has `look_at` a band before its flag, `some_in_row` and
// `some_in_block` that say what flags are to be, `begin_block`, `code_half` and `end_block`.
template <class Self, class Range> struct Lattice {
    const int64_t* shape;
    const Prior& prior;
    const bool trellis;
    const bool steps_on;  // through the states of the trellis, or stays in the first one
    Ints states = {};  // of the trellis: each lane has its own
    std::vector<Band> bands;
    Range range;
    Simple flags[FLAGS];
    uint32_t agreed[KINDS][2][SIGNS][2] = {};  // by parity: how often a sign was the same, or not
    std::vector<uint8_t> nothing;              // a row of zeros
    std::vector<uint8_t> near;                 // by block: whether a block around it is filled
    std::vector<uint8_t> kin;                  // whether that of the nearest reference is
    std::vector<uint8_t> moved[REFERENCE_COUNT];  // rows of references, at the vertices of this one

    struct Around {
        const uint8_t *above, *above2, *below, *below2, *below_near[2];
        const uint8_t *before, *before2, *before_near[4];
        const uint8_t* references[REFERENCE_COUNT];
        const uint8_t* nearest;  // the last of the references that exist
        int weights[REFERENCE_COUNT], sides[REFERENCE_COUNT], count;
        int weight;  // sum of the weights of all that exist, but for left and right
    } around;

    // A row of a band.
    struct Row {
        int64_t number, place;  // place: of its first vertex in the tile
        int length, kind, group, shift, blocks;
        uint8_t *magnitudes, *filled;
        int8_t* signs;
        const int8_t* signs_around[3];  // above, below, before
        int odds[2][SIGNS];             // by parity, in 16ths of octaves
        float scale[2];                 // by parity: 1 / sum of weights
    } row;
    // Of signs of the row, by parity: how often one was that around it, and 2^16 for each other.
    Ints same[2][SIGNS];

    Lattice(const int64_t* of, const Prior& with, bool on_trellis, bool on_states, size_t count,
            Range flag_coder)
        : shape(of), prior(with), trellis(on_trellis), steps_on(on_states), bands(count),
          range(flag_coder) {
        for (Simple& flag : flags) flag = {32768, 0};
    }

    FHASH_INLINE Self& self() { return static_cast<Self&>(*this); }
    FHASH_INLINE int flag(int bit, int number) { return code_simple(range, flags[number], bit); }

    static int group_of(int kind) {
        const int plane = kind >> 2;
        return plane == 0 || plane == PLANE_OF_BASIS ? 0 : 1 + (plane - 1) % 3;
    }

    template <class Each> FHASH_INLINE void all_rows(const Band& band, Each each) {
        for (int t = 0; t < band.size[0]; t++)
            for (int z = 0; z < band.size[1]; z++)
                for (int y = 0; y < band.size[2]; y++) each(t, z, y);
    }

    // Vertices of the row in a block.
    FHASH_INLINE int room_in(int block) const { return min(row.length - BLOCK * block, BLOCK); }

    // Of the first vertex of a row in the tile.
    FHASH_INLINE int64_t place_of(const Band& band, int t, int z, int y) const {
        return (((band.low[0] + t) * shape[1] + band.low[1] + z) * shape[2] + band.low[2] + y) *
                   shape[3] + band.low[3];
    }

    void run() {
        for (Band& band : bands) code_band(band);
    }

    void code_band(Band& band) {
        const int64_t rows = (int64_t)band.size[0] * band.size[1] * band.size[2];
        const int length = band.size[3];
        if (!rows || !length) return;
        band.blocks = (length + BLOCK - 1) / BLOCK;
        self().look_at(band);
        band.any = flag(band.any, BANDS) != 0;
        if (!band.any) return;
        int shift = 0;
        for (int bit = 4; bit >= 0; bit--)
            shift |= flag(band.shift >> bit & 1, SHIFTS + bit) << bit;
        band.shift = shift;
        band.pitch = PADDING + BLOCK * band.blocks + PADDING;
        band.magnitudes.assign((size_t)(rows * band.pitch), 0);
        band.signs.assign((size_t)(rows * band.pitch), 0);
        band.filled_pitch = (band.blocks + WORD - 1) / WORD * WORD + 1;
        band.filled.assign((size_t)(rows * band.filled_pitch) + 2 * WORD, 0);
        near.resize((size_t)(band.blocks + WORD));
        kin.resize((size_t)band.blocks);
        if ((int64_t)nothing.size() < band.pitch) nothing.assign((size_t)band.pitch, 0);
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA { code_row(band, t, z, y); });
    }

    // Whether one of some blocks is marked; behind them are zeros to the end of a word.
    FHASH_INLINE static bool any_block(const uint8_t* marks, int blocks) {
        uint64_t some = 0;
        for (int k = 0; k < blocks; k += WORD) some |= loaded<uint64_t>(marks + k);
        return some != 0;
    }

    // Find the rows around a row that a decoder knows, and which blocks lie near filled ones.
    void look_around(Band& band, int t, int z, int y) {
        for (int k = 0; k < band.blocks; k += WORD) stored(near.data() + k, uint64_t{0});
        const int64_t layer = band.size[2], step = layer * band.size[1];
        const bool up = y > 0, down = y + 1 < band.size[2];
        const bool back = z > 0, front = z + 1 < band.size[1], earlier = t > 0;
        const int blocks = band.blocks;
        auto at = [&](bool exists, int dt, int dz, int dy) FHASH_LAMBDA {
            if (!exists) return static_cast<const uint8_t*>(nothing.data() + PADDING);
            const int64_t number = row.number + dt * step + dz * layer + dy;
            const uint8_t* const filled = band.filled_of(number);
            for (int k = 0; k < blocks; k += WORD) {
                const uint64_t any_of = loaded<uint64_t>(filled + k - 1) |
                                        loaded<uint64_t>(filled + k) |
                                        loaded<uint64_t>(filled + k + 1);
                stored(near.data() + k, loaded<uint64_t>(near.data() + k) | any_of);
            }
            return static_cast<const uint8_t*>(band.magnitudes_of(number));
        };
        Around& to = around;
        to.above = at(up, 0, 0, -1);
        to.above2 = at(y > 1, 0, 0, -2);
        to.below = at(back, 0, -1, 0);
        to.below2 = at(z > 1, 0, -2, 0);
        to.below_near[0] = at(back && up, 0, -1, -1);
        to.below_near[1] = at(back && down, 0, -1, 1);
        to.before = at(earlier, -1, 0, 0);
        to.before2 = at(t > 1, -2, 0, 0);
        to.before_near[0] = at(earlier && back, -1, -1, 0);
        to.before_near[1] = at(earlier && front, -1, 1, 0);
        to.before_near[2] = at(earlier && up, -1, 0, -1);
        to.before_near[3] = at(earlier && down, -1, 0, 1);
        to.weight = 0;
        if (up) to.weight += ABOVE + 2 * ABOVE_SIDES + (y > 1 ? ABOVE2 : 0);
        if (back)
            to.weight +=
                BELOW + 2 * BELOW_SIDES + BELOW_NEAR * (up + down) + (z > 1 ? BELOW2 : 0);
        if (earlier)
            to.weight += BEFORE + 2 * BEFORE_SIDES +
                         BEFORE_NEAR * (back + front + up + down) + (t > 1 ? BEFORE2 : 0);
        to.count = 0;
        to.nearest = nothing.data() + PADDING;
        std::memset(kin.data(), 0, kin.size());
        for (int k = 0; k < REFERENCE_COUNT; k++)
            if (band.references[k].band >= 0) {
                to.weight += REFERENCE[k] + 2 * REFERENCE_SIDES[k];
                to.nearest = nothing.data() + PADDING;
                look_at_reference(band, k, t, z, y);
            }
    }

    void look_at_reference(Band& band, int k, int t, int z, int y) {
        Band& other = bands[(size_t)band.references[k].band];
        std::memset(kin.data(), 0, kin.size());
        if (!other.any) return;
        const int* const halvings = band.references[k].shift;
        const int64_t number = other.row(min(t >> halvings[0], other.size[0] - 1),
                                         min(z >> halvings[1], other.size[1] - 1),
                                         min(y >> halvings[2], other.size[2] - 1));
        const uint8_t* const filled = other.filled_of(number);
        if (!any_block(filled, other.blocks)) return;
        const int along = halvings[3], shift = other.shift - band.shift;
        for (int i = 0; i < band.blocks; i++) {
            const int j = min(i >> along, other.blocks - 1);
            const int beside =
                along ? filled[i & 1 ? j + 1 : j - 1] : filled[j - 1] | filled[j + 1];
            near[i] |= filled[j] | beside;
            kin[i] = filled[j];
        }
        const uint8_t* from = other.magnitudes_of(number);
        if (along || shift || other.size[3] != band.size[3]) {
            std::vector<uint8_t>& to = moved[around.count];
            if ((int64_t)to.size() < band.pitch) to.assign((size_t)band.pitch, 0);
            move_row(from, other.size[3], along, shift, to.data() + PADDING, band.size[3]);
            const size_t end = (size_t)(PADDING + band.size[3]);
            std::memset(to.data() + end, 0, (size_t)band.pitch - end);
            from = to.data() + PADDING;
        }
        around.references[around.count] = around.nearest = from;
        around.weights[around.count] = REFERENCE[k];
        around.sides[around.count++] = REFERENCE_SIDES[k];
    }

    // Magnitudes of a row at the vertices of one of another length, after another shift.
    static void move_row(const uint8_t* from, int count, int along, int shift,
                                      uint8_t* to, int length) {
        if (along == 1) {
            const int pairs = min(length / 2, count);
            FHASH_INDEPENDENT
            for (int i = 0; i < pairs; i++) to[2 * i] = to[2 * i + 1] = from[i];
            for (int x = 2 * pairs; x < length; x++) to[x] = from[min(x >> 1, count - 1)];
        } else
            for (int x = 0; x < length; x++) to[x] = from[min(x >> along, count - 1)];
        if (!shift) return;
        const int up = max(min(shift, 8), 0), down = max(min(-shift, 8), 0);
        for (int x = 0; x < length; x++) to[x] = (uint8_t)min(to[x] << up >> down, LARGEST);
    }

    // Weighted sums of the magnitudes around the vertices of a block, but for left and right.
    FHASH_INLINE Sums sum_block(int64_t first) const {
        const auto at = [first](const uint8_t* row, int move = 0) FHASH_LAMBDA {
            return __builtin_convertvector(loaded<Bytes>(row + first + move), Sums);
        };
        const auto beside = [at](const uint8_t* row) FHASH_LAMBDA {
            return at(row, -1) + at(row, 1);
        };
        const Around& of = around;
        Sums sums = ABOVE * at(of.above) + ABOVE_SIDES * beside(of.above) + ABOVE2 * at(of.above2) +
                    BELOW * at(of.below) + BELOW_SIDES * beside(of.below) + BELOW2 * at(of.below2) +
                    BELOW_NEAR * (at(of.below_near[0]) + at(of.below_near[1])) +
                    BEFORE * at(of.before) + BEFORE_SIDES * beside(of.before) +
                    BEFORE2 * at(of.before2) +
                    BEFORE_NEAR * (at(of.before_near[0]) + at(of.before_near[1]) +
                                   at(of.before_near[2]) + at(of.before_near[3]));
        for (int k = 0; k < of.count; k++)
            sums += (uint16_t)of.weights[k] * at(of.references[k]) +
                    (uint16_t)of.sides[k] * beside(of.references[k]);
        return sums;
    }

    void code_row(Band& band, int t, int z, int y) {
        row.number = band.row(t, z, y);
        row.place = place_of(band, t, z, y);
        row.length = band.size[3];
        row.blocks = band.blocks;
        row.kind = band.kind;
        row.group = group_of(band.kind);
        row.shift = band.shift;
        look_around(band, t, z, y);
        if (!any_block(near.data(), row.blocks) &&
            !flag(self().some_in_row(), ROWS + (row.blocks > 2)))
            return;
        row.magnitudes = band.magnitudes_of(row.number);
        row.filled = band.filled_of(row.number);
        row.signs = band.signs_of(row.number);
        const int8_t* const none = reinterpret_cast<const int8_t*>(nothing.data()) + PADDING;
        const int64_t layer = band.pitch * band.size[2];
        row.signs_around[0] = y > 0 ? row.signs - band.pitch : none;
        row.signs_around[1] = z > 0 ? row.signs - layer : none;
        row.signs_around[2] = t > 0 ? row.signs - layer * band.size[1] : none;
        row.scale[0] = 1.0F / (float)max(around.weight, 1);
        row.scale[1] = 1.0F / (float)(around.weight + 2 * SIDE);
        for (int parity = 0; parity < 2; parity++)
            for (int n = 0; n < SIGNS; n++) {
                const uint32_t* const seen = agreed[row.kind][parity][n];
                row.odds[parity][n] = log16(16 * seen[0] + 32) - log16(16 * seen[1] + 32);
                same[parity][n] = Ints{};
            }
        int before = 0;  // whether the block before may have others than zeros
        for (int k = 0; k < row.blocks; k++) {
            before = code_block(k, before);
            if (k % MANY_BLOCKS == MANY_BLOCKS - 1) note_signs();
        }
        note_signs();
    }

    // Whether the block may have others than zeros. before: whether the block before it may.
    FHASH_INLINE int code_block(int number, int before) {
        const int64_t first = (int64_t)BLOCK * number;
        Sums sums = {};
        int flags_of = 0;
        if (near[(size_t)number]) {
            sums = sum_block(first);
            const int total = sum(places(sums, 0) + places(sums, 1));
            const Floats mean = Floats{} + (float)total * row.scale[0];  // of 16 vertices
            const int octaves = half_octaves(mean)[0] - 2 * (127 - LOWEST_FLAG) + 1;
            // A path through a trellis goes through the blocks that have a flag.
            if (total) flags_of = min(max(octaves, 1), FLAG_CLASSES - trellis);
        }
        if (flags_of < FLAG_CLASSES) {
            const int context = ((row.group > 0) * FLAG_CLASSES + flags_of) * 4 +
                                before * 2 + kin[(size_t)number];
            if (!flag(self().some_in_block(number, flags_of > 0), BLOCKS + context)) return 0;
        }
        self().begin_block(number);
        const int room = room_in(number);
        Ints signs[2][SIGNS] = {};  // around
        for (int n = 0; n < 3; n++)
            for (int parity = 0; parity < 2; parity++) {
                const auto from = loaded<Signs>(row.signs_around[n] + first + LANES * parity);
                signs[parity][n] = __builtin_convertvector(from, Ints);
            }
        const auto nearest = __builtin_convertvector(loaded<Bytes>(around.nearest + first), Sums);
        Half even, odd;
        find_contexts(even, places(sums, 0), places(nearest, 0), 0, room);
        foretell_signs<3>(even, signs[0], 0);
        self().code_half(even, 0);
        step_on(even, 0, room);
        const Ints seen = least(even.magnitudes >> row.shift, all(LARGEST));
        const Ints sides = SIDE * (seen + next(seen));
        find_contexts(odd, places(sums, 1) + sides, places(nearest, 1), 1, room);
        signs[1][3] = even.signs;
        signs[1][4] = next(even.signs);
        foretell_signs<5>(odd, signs[1], 1);
        self().code_half(odd, 1);
        step_on(odd, 1, room);
        self().end_block(even, odd, number, room);
        for (int n = 0; n < 3; n++) count_signs(signs[0][n], even.signs, same[0][n]);
        for (int n = 0; n < SIGNS; n++) count_signs(signs[1][n], odd.signs, same[1][n]);
        const Ints magnitudes = seen | least(odd.magnitudes >> row.shift, all(LARGEST)) << 8;
        stored(row.magnitudes + first, __builtin_convertvector(magnitudes, Shorts));
        stored(row.signs + first, __builtin_convertvector(even.signs, Signs));
        stored(row.signs + first + LANES, __builtin_convertvector(odd.signs, Signs));
        row.filled[number] = any(even.magnitudes | odd.magnitudes);
        return 1;
    }

    // Levels and contexts by the sums around; those of places beyond a row are NOTHING.
    FHASH_INLINE void find_contexts(Half& half, Ints sums, Ints nearest, int parity,
                                    int room) const {
        const Ints levels = levels_of(floats(sums) * row.scale[parity]);
        const Ints more = nearest * (around.weight + parity * 2 * SIDE) > sums;
        const Ints of_class = -((nearest > 0) + more);
        half.contexts = levels + ((row.group * 2 + parity) * CLASSES + of_class) * LEVELS;
        if (trellis) {
            half.quantisers = states & 1;
            half.contexts += (half.quantisers + 1) * MAGNITUDES;
        }
        half.low = most((levels - SHIFTED) >> 1, Ints{}) + row.shift;
        if (room == BLOCK) return;
        const Ints beyond = PLACES + parity >= room;
        half.contexts = beyond ? all(NOTHING) : half.contexts;
        half.low &= ~beyond;
    }

    // Go on through the trellis, but for places beyond a row.
    FHASH_INLINE void step_on(const Half& half, int parity, int room) {
        if (!steps_on) return;
        const Ints after = states_after(states, half.magnitudes);
        states = PLACES + parity < room ? after : states;
    }

    // What the signs around foretell. NEAR: how many are looked at.
    template <int NEAR>
    FHASH_INLINE void foretell_signs(Half& half, const Ints* signs, int parity) const {
        Ints odds = {};
        for (int n = 0; n < NEAR; n++) odds += signs[n] * row.odds[parity][n];
        half.foretold = (odds < 0) & 1;
        odds = (odds < 0 ? -odds : odds) >> SIGN_SHIFT;
        half.odds = least(odds, all(SIGN_LEVELS - 1)) + OF_SIGNS;
    }

    FHASH_INLINE static void count_signs(Ints near_signs, Ints signs, Ints& same_or_not) {
        const Ints products = near_signs * signs;
        same_or_not += ((products > 0) & 1) + ((products < 0) & OTHER);
    }

    void note_signs() {
        for (int parity = 0; parity < 2; parity++)
            for (int n = 0; n < (parity ? SIGNS : 3); n++) {
                const Ints of = same[parity][n];
                agreed[row.kind][parity][n][0] += (uint32_t)sum(of & (OTHER - 1));
                agreed[row.kind][parity][n][1] += (uint32_t)sum(of >> 16);
                same[parity][n] = Ints{};
            }
    }

    FHASH_INLINE Ints integers_of(const Half& half) const {
        Ints units = half.magnitudes;
        if (trellis) units = (2 * units - half.quantisers) & (units != 0);
        return units * half.signs;
    }

    // Write the integers of a block.
    FHASH_INLINE void keep_integers(int32_t* q, const Half& even, const Half& odd, int number,
                                    int room) const {
        const Ints a = integers_of(even), b = integers_of(odd);
        const Ints low = {a[0], b[0], a[1], b[1], a[2], b[2], a[3], b[3]};
        const Ints high = {a[4], b[4], a[5], b[5], a[6], b[6], a[7], b[7]};
        int32_t* const to = q + row.place + (int64_t)BLOCK * number;
        if (room == BLOCK) {
            stored(to, low);
            stored(to + LANES, high);
            return;
        }
        const Ints both[] = {low, high};
        std::memcpy(to, both, sizeof *to * (size_t)room);
    }
};

}  // namespace
