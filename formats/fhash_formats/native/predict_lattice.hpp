// Lattices and passes of the predicted coder (predict.cpp), and the classes of its contexts.
#pragma once

#include <cstdlib>

#include "mixing.hpp"

namespace {

const int CONTEXTS = 7;                     // estimates that are mixed for a decision
const int LANES = 14, SET = padded(LANES);  // weights of a set: of the caller, and as kept here
const int DECISIONS = 16;                   // slots of a context
const int UNARY = 14;                       // largest magnitude in unary
const int CLASSES = 16;                     // kinds of passes
const int LEVELS = 48, HALF_LEVELS = 24;    // classes of the expected difference
const int ACTIVITIES = 32;                  // classes of how far the taps differ from the base
const int SLOPES = 27;                      // classes of how far the vertices of the base differ
const int SIZES[CONTEXTS] = {
    LEVELS * 5,
    ACTIVITIES * SLOPES,
    CLASSES * HALF_LEVELS * 5,
    3125,
    81 * 5 * 8,
    81 * HALF_LEVELS,
    ACTIVITIES * HALF_LEVELS * 5,
};

// First simple estimates of the escape code and of rows without a difference; those of low bits
// come before.
const int ESCAPES = 160, ROWS = 192;

// Weights of known differences: to the left and above, in the layer and the step before, beside
// these, and in C.
const int SIDE = 20, BEFORE = 15, DIAGONAL = 7, COARSE = 4;

const int MAX_VALUE = 1 << 27;         // largest magnitude of an integer
const int MAX_ACTIVITY = 1 << 24;      // largest share of a tap in the activity
const int CLIP = 4095;                 // largest difference that contexts see
const int ACTIVE = 14;                 // number of taps, the first ones, that make up the activity
const int FRACTION_BITS = 13;          // of a prediction
const int MAX_ROW_TAPS = 8;            // most taps to the left in the row itself

const int MAX_TAPS = 64;               // most taps of a pass
const int TOGETHER = 8;                // vertices that are worked on at a time
const int ROOM = 16;                   // numbers on both sides of a lattice that may be read

typedef std::uint32_t Numbers __attribute__((vector_size(4 * TOGETHER)));

// A tap for the vertices of a row: its values and weight, and where it exists.
struct RowTap {
    const int32_t* values;
    int32_t weight;
    int64_t first, last;
};

// Columns of the taps: the lattice (1 for N, 0 for C), then offsets along t, z, y and x.
enum TapColumn { IN_N, OFFSET_T, OFFSET_Z, OFFSET_Y, OFFSET_X, TAP_COLUMNS };
// Columns of the passes.
enum PassColumn { AXIS, KIND, FIRST_TAP, TAP_COUNT, PASS_COLUMNS };

// A dense lattice: integers, and their differences from the rounded predictions.
struct Grid {
    int64_t n[4], stride[3];
    std::vector<int32_t> values, errors;  // with room on both sides, see `sum_narrow`

    // Give it these lengths, and zeros.
    void size(const int64_t* lengths) {
        for (int a = 0; a < 4; a++) n[a] = lengths[a];
        stride[2] = n[3];
        stride[1] = stride[2] * n[2];
        stride[0] = stride[1] * n[1];
        values.assign((size_t)(stride[0] * n[0] + 2 * ROOM), 0);
        errors.assign((size_t)(stride[0] * n[0] + 2 * ROOM), 0);
    }
    FHASH_INLINE int64_t row(int64_t t, int64_t z, int64_t y) const {
        return ROOM + t * stride[0] + z * stride[1] + y * stride[2];
    }
    FHASH_INLINE bool has(int64_t t, int64_t z, int64_t y) const {
        return t >= 0 && z >= 0 && y >= 0 && t < n[0] && z < n[1] && y < n[2];
    }
};

// Class of a number: 0 for 0, then two per doubling, at most `most`.
FHASH_INLINE int half_octaves(uint32_t v, int most) { return v ? min(1 + log16(v) / 8, most) : 0; }
FHASH_INLINE int32_t clipped(int32_t e) { return min(std::abs(e), CLIP); }
// Class, 0 to 4, of a clipped difference.
FHASH_INLINE int few(int v) { return (v > 0) + (v > 1) + (v > 3) + (v > 8); }
FHASH_INLINE int sign_of(int32_t v) { return (v > 0) - (v < 0); }
// Class, 0 to 8, of how far and to which side another prediction lies; d in 1/8192.
FHASH_INLINE int side(int64_t d) {
    const int64_t a = d < 0 ? -d : d;
    const int r = (a >= 1229) + (a >= 4096) + (a >= 9830) + (a >= 24576);
    return d < 0 ? 4 - r : 4 + r;
}
// The integer nearest to a prediction.
FHASH_INLINE int64_t rounded(int64_t p) {
    return (p + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS;
}

// What a pass is given: where its vertices lie in the tile, its axis (-1 for the first lattice) and
// kind, and its taps with their weights.
struct PassPlan {
    int64_t at, stride[4];
    int axis, kind, count;
    const int32_t* taps;
    const int16_t* weights;
    int64_t reach;  // the largest sum of taps, as a multiple of the largest value
};

// A row of N.
struct Row {
    int64_t t, z, y;
    int32_t *values, *errors;           // of its vertices
    int64_t own[MAX_ROW_TAPS][2];       // taps to the left in the row: offset, twice the weight
    int owned;                          // their number
    bool narrow;                        // whether 32 bits hold the sums
    bool stepped;                       // whether `step` holds: there is a step before
    int weight;                         // sum of the weights of the known differences
};

}  // namespace
