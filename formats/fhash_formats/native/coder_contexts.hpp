// Contexts of the coder (coder.cpp): the columns of the table of bands, the classes of magnitudes,
// and the sums over a vertex's neighbours, which are made for a whole row at a time.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "bands.hpp"
#include "mixing.hpp"

namespace {

const int MAX_MAGNITUDE = 4095; // as contexts see it, so that sums stay in 32 bits
const int RATE_CLASSES = 16 * 15 + 1;  // of the rates of sign predictors (coder_signs.hpp)

// Class, 0 to 6, of a magnitude or of a sum of some. No table, so that the compiler makes vectors.
FHASH_INLINE int seven(int v) { return (v > 0) + (v > 1) + (v > 2) + (v > 4) + (v > 6) + (v > 9); }

// The same in classes 0 to 11.
FHASH_INLINE int twelve(int v) {
    return seven(v) + (v > 14) + (v > 22) + (v > 36) + (v > 64) + (v > 140);
}

// `twelve` as a table, for one number at a time.
struct Classes {
    uint8_t of[142];
    Classes() {
        for (int v = 0; v < 142; v++) of[v] = (uint8_t)twelve(v);
    }
};
const Classes classes;

// Tables of the predictors. No value lies near a rounding boundary (a test checks that).
struct LinearTables {
    int16_t log[MAX_MAGNITUDE + 1];  // 256 log2(1 + magnitude)
    int16_t rate[RATE_CLASSES];      // rate of a weight by 16 log2 of the mean square
    LinearTables() {
        for (int i = 0; i <= MAX_MAGNITUDE; i++)
            log[i] = (int16_t)std::floor(256 * std::log2(1. + i) + .5);
        for (int i = 0; i < RATE_CLASSES; i++) {
            const double scale = 8388608 * std::exp(-i / 32. * 0.69314718055994531);
            rate[i] = (int16_t)min(std::floor(.006 * scale + .5), 32767.);
        }
    }
};
const LinearTables linear_tables;

}  // namespace

#include "target.hpp"

namespace {

const int CONTEXTS = 4, SIGN_CONTEXTS = 4;  // estimates of a magnitude, and of a sign
const int LANES = 2 * CONTEXTS, SET = padded(LANES);  // weights of a set, and with its zeros
const int DECISIONS = 16;                   // slots of a context
const int UNARY = 14;                       // magnitudes from this one on have an escape code
const int SHARED = 2;  // decisions from this one on are one for both quantisers; those of class 1
                       // before it have the slots and weights from UNARY on
const int LEVELS = 128;                     // quarter octaves of the expected magnitude
const int SIGN_LIMIT = 255;                 // as SLOW_LIMIT, for signs
const int PADDING = 2;                      // zeros beside a row of magnitudes
const int LOG_PADDING = 4;                  // zeros beside a row of logarithms
const int VECTOR = 16;  // sums over a row are made for a multiple of it; those beyond are not used

// Weights of neighbours in the expected magnitude, in 1/1024.
const int LEFT = 184, LEFT2 = 20;                 // the left neighbour, and the second one
const int ABOVE = 184, DIAGONAL = 61, ABOVE2 = 41;  // above, each beside that, the second above
const int BEFORE = 102, AROUND = 20, BEFORE2 = 31;  // before along t or z, around that, the second
const int REFERENCE = 62;  // the vertex of a reference; the sum around it has weight AROUND

const int SIZES[CONTEXTS] = {LEVELS, 729, 12 * 12 * 12, 7 * 7 * 7 * 7};
const int64_t ALL_CONTEXTS = LEVELS + 729 + 12 * 12 * 12 + 7 * 7 * 7 * 7;
const int SIGN_SIZES[SIGN_CONTEXTS] = {KINDS * 27, KINDS * 108, KINDS * 81, KINDS * 25};

// Order of the state. Slots: by context, those of the decisions of a context together; then those
// of the signs. Weights: sets by kind; from SECOND on by level; then those of coder_signs.hpp.
// Simple estimates: of the escape code; from ROWS on of empty rows; from EMPTIES on of empty bands.
const int64_t SECOND = int64_t(KINDS) * DECISIONS * SET;
const int64_t ROWS = LEVELS * 64, EMPTIES = ROWS + 8;

// The slots of zero flags, those of both classes of a context together: few lines of the cache hold
// what most vertices use. As long as a run lasts, the slots of the state have none of them.
struct Flags {
    std::vector<Slot> slots;

    explicit Flags(const State& state) : slots((size_t)(2 * ALL_CONTEXTS)) {
        const Slot* from = state.slots.data();
        for (size_t i = 0; i < slots.size(); i += 2, from += DECISIONS) {
            slots[i] = from[0];
            slots[i + 1] = from[UNARY];
        }
    }
    void keep(State& state) const {
        Slot* to = state.slots.data();
        for (size_t i = 0; i < slots.size(); i += 2, to += DECISIONS) {
            to[0] = slots[i];
            to[UNARY] = slots[i + 1];
        }
    }
};

enum Mode { ENCODE, DECODE };

FHASH_INLINE int small(int v) { return classes.of[min(v, 141)]; }

const int NO_TRELLIS = -3;  // an integer that the quantiser of its state does not have

// The state after n zeros, which repeat after at most four.
FHASH_INLINE int after_zeros(int state, int64_t n) {
    for (n &= 3; n > 0; n--) state = TRELLIS_NEXT[state][0];
    return state;
}

// 0 for a negative number, 1 for 0, 2 for a positive number.
FHASH_INLINE int sign_of(int32_t v) { return 1 + (v > 0) - (v < 0); }

using Prediction = Mixed<CONTEXTS>;

// Level of a weighted sum; offset: added to 16ths of its octaves.
FHASH_INLINE int level_of(uint32_t mu, int offset) {
    return mu ? min((log16(mu) + offset) / 4 + 1, LEVELS - 1) : 0;
}

// Numbers by vertex of a row, from the neighbours that are known before the row.
struct Sums {
    std::vector<int32_t> room;
    int32_t *expected;                // weighted sum for the expected magnitude
    int32_t* plane;                   // sum over the rows above
    int32_t *nearest, *sides, *others;  // shares in the contexts
    int32_t *share, *level;           // by vertex of a reference: share in `expected`, class
    int32_t* near;                    // context where both neighbours to the left are 0
    explicit Sums(size_t width) : room(8 * width) {
        int32_t* at = room.data();
        for (int32_t** array :
             {&expected, &plane, &nearest, &sides, &others, &share, &level, &near}) {
            *array = at;
            at += width;
        }
    }
};

struct Band : BandPlace {
    int64_t stride[3];                 // of magnitudes, along t, z and y
    std::vector<uint16_t> magnitudes;  // rows with PADDING zeros at both ends
    std::vector<uint8_t> filled;       // by row: whether it has a magnitude above 0
    std::vector<int16_t> logs;         // rows of logarithms, see coder_signs.hpp
    bool any = false;                  // whether the band has one
};

// A row of a band.
struct Row {
    int t, z, y;                 // indices in the band
    uint16_t* magnitudes;        // of its vertices
    const uint8_t* filled;       // its flag; those of other rows lie around
    const uint16_t* references[REFERENCE_COUNT];  // row of each reference for this row, or null
    int reference_y[REFERENCE_COUNT];             // index of that row along y
};

// Find the row of each reference that stands for this row; none where it and the rows above and
// below it are zeros, which add nothing. Whether the row of the parent is filled.
int find_references(const std::vector<Band>& bands, const Band& band, Row& row) {
    int parent_filled = 0;
    for (int k = 0; k < REFERENCE_COUNT; k++) {
        const Reference& to = band.references[k];
        row.references[k] = nullptr;
        row.reference_y[k] = 0;
        if (to.band < 0 || !bands[to.band].any) continue;
        const Band& other = bands[to.band];
        const int t = min(row.t >> to.shift[0], other.size[0] - 1);
        const int z = min(row.z >> to.shift[1], other.size[1] - 1);
        const int y = min(row.y >> to.shift[2], other.size[2] - 1);
        row.reference_y[k] = y;
        const uint8_t* const filled =
            other.filled.data() + ((int64_t)t * other.size[1] + z) * other.size[2] + y;
        if (k == 0) parent_filled = filled[0];
        if (filled[0] || (y > 0 && filled[-1]) || (y + 1 < other.size[2] && filled[1]))
            row.references[k] = other.magnitudes.data() + t * other.stride[0] +
                                z * other.stride[1] + y * other.stride[2] + PADDING;
    }
    return parent_filled;
}

// The rows around a row of a band, each a row of zeros where there is none.
struct Around {
    const uint16_t *above, *above2;
    const uint16_t *before, *before2, *before_near[4];  // step t - 1: z and y by -1 and by +1
    const uint16_t *below, *below2, *below_near[2];     // layer z - 1: y by -1 and by +1
    int weight;  // sum of the weights of the neighbours that exist, those to the left included
};

Around rows_around(const Band& band, const Row& row, const uint16_t* nothing) {
    const int t = row.t, z = row.z, y = row.y, n1 = band.size[1], n2 = band.size[2];
    const uint16_t* const M = row.magnitudes;
    const int64_t M0 = band.stride[0], M1 = band.stride[1], M2 = band.stride[2];
    auto at = [&](bool exists, int64_t offset) FHASH_LAMBDA {
        return exists ? M + offset : nothing;
    };
    Around to;
    to.above = at(y > 0, -M2);
    to.above2 = at(y > 1, -2 * M2);
    to.before = at(t > 0, -M0);
    to.before2 = at(t > 1, -2 * M0);
    to.before_near[0] = at(t > 0 && z > 0, -M0 - M1);
    to.before_near[1] = at(t > 0 && z + 1 < n1, -M0 + M1);
    to.before_near[2] = at(t > 0 && y > 0, -M0 - M2);
    to.before_near[3] = at(t > 0 && y + 1 < n2, -M0 + M2);
    to.below = at(z > 0, -M1);
    to.below2 = at(z > 1, -2 * M1);
    to.below_near[0] = at(z > 0 && y > 0, -M1 - M2);
    to.below_near[1] = at(z > 0 && y + 1 < n2, -M1 + M2);
    to.weight = LEFT + LEFT2;
    if (y > 0) to.weight += ABOVE + 2 * DIAGONAL + (y > 1 ? ABOVE2 : 0);
    if (t > 0) to.weight += BEFORE + 4 * AROUND + (t > 1 ? BEFORE2 : 0);
    if (z > 0) to.weight += BEFORE + 4 * AROUND + (z > 1 ? BEFORE2 : 0);
    return to;
}

// Add the neighbours within the band, but those to the left, for `lanes` vertices: to the expected
// magnitude, and with SHARES as shares in the contexts.
template <bool SHARES>
void sum_neighbours(const Around& rows, int lanes, Sums& sums) {
    const uint16_t *const a = rows.above, *const a2 = rows.above2;
    const uint16_t *const b = rows.before, *const b2 = rows.before2;
    const uint16_t *const bp = rows.before_near[0], *const bf = rows.before_near[1];
    const uint16_t *const bn = rows.before_near[2], *const bs = rows.before_near[3];
    const uint16_t *const d = rows.below, *const d2 = rows.below2;
    const uint16_t *const dn = rows.below_near[0], *const ds = rows.below_near[1];
    int32_t *FHASH_RESTRICT const expected = sums.expected, *FHASH_RESTRICT const near = sums.near;
    int32_t *FHASH_RESTRICT const plane = sums.plane, *FHASH_RESTRICT const sides = sums.sides;
    int32_t* FHASH_RESTRICT const nearest = sums.nearest;
    // The compiler makes vectors of inner loops only whose length is a constant, with -fwrapv.
    for (int64_t begin = 0; begin < lanes; begin += VECTOR) {
        FHASH_INDEPENDENT
        for (int i = 0; i < VECTOR; i++) {
            const int64_t x = begin + i;
            const int a_sides = a[x - 1] + a[x + 1];
            const int b_sides = b[x - 1] + b[x + 1], b_near = bp[x] + bf[x] + bn[x] + bs[x];
            const int d_sides = d[x - 1] + d[x + 1], d_near = dn[x] + ds[x];
            expected[x] += ABOVE * a[x] + DIAGONAL * a_sides + ABOVE2 * a2[x] +
                           BEFORE * (b[x] + d[x]) + BEFORE2 * (b2[x] + d2[x]) +
                           AROUND * (b_sides + b_near + d_sides + d_near);
            if (!SHARES) continue;
            const int in_plane = 2 * a[x] + a_sides + a2[x];
            const int before = 2 * b[x] + b_sides + b_near, below = 2 * d[x] + d_sides + d_near;
            const int side = twelve(before) * 12 + twelve(below);
            int digits = min<int>(a[x], 2) * 3 + min<int>(a[x - 1], 2);
            digits = digits * 3 + min<int>(a[x + 1], 2);
            digits = digits * 3 + min<int>(b[x], 2);
            nearest[x] = digits * 3 + min<int>(d[x], 2);
            plane[x] = in_plane;
            sides[x] = side;
            near[x] = twelve(in_plane) * 144 + side;
        }
    }
}

// Begin the sums of a row with those over its references. Sum of the weights of the references that
// exist.
int sum_references(const std::vector<Band>& bands, const Band& band, const Row& row,
                                int lanes, const uint16_t* nothing, Sums& sums) {
    const int n3 = band.size[3];
    int32_t* FHASH_RESTRICT const expected = sums.expected;
    int32_t* FHASH_RESTRICT const others = sums.others;
    std::memset(sums.expected, 0, 4 * (size_t)lanes);
    std::memset(sums.others, 0, 4 * (size_t)lanes);
    int weight = 0;
    for (int k = 0; k < REFERENCE_COUNT; k++) {
        if (band.references[k].band >= 0) weight += REFERENCE + 2 * AROUND;
        if (!row.references[k]) continue;
        const Band& other = bands[band.references[k].band];
        const int shift = band.references[k].shift[3], last = other.size[3] - 1;
        const int scale = k == 0 ? 343 : k == 1 ? 49 : k == 2 ? 7 : 1;
        const uint16_t* const p = row.references[k];
        const uint16_t* const up = row.reference_y[k] > 0 ? p - other.stride[2] : nothing;
        const bool has_down = row.reference_y[k] + 1 < other.size[2];
        const uint16_t* const down = has_down ? p + other.stride[2] : nothing;
        auto around = [&](int64_t i) FHASH_LAMBDA {
            return 2 * p[i] + p[i - 1] + p[i + 1] + up[i] + down[i];
        };
        if (shift == 0 && last >= n3 - 1) {
            for (int64_t begin = 0; begin < lanes; begin += VECTOR) {
                FHASH_INDEPENDENT
                for (int i = 0; i < VECTOR; i++) {
                    const int64_t x = begin + i;
                    const int sum = around(x);
                    expected[x] += REFERENCE * p[x] + AROUND * sum;
                    others[x] += seven(sum) * scale;
                }
            }
            continue;
        }
        int32_t *FHASH_RESTRICT const share = sums.share, *FHASH_RESTRICT const level = sums.level;
        const int needed = min((n3 - 1) >> shift, last) + 1;
        for (int64_t begin = 0; begin < needed; begin += VECTOR / 2) {
            FHASH_INDEPENDENT
            for (int n = 0; n < VECTOR / 2; n++) {
                const int64_t i = begin + n;
                const int sum = around(i);
                share[i] = REFERENCE * p[i] + AROUND * sum;
                level[i] = seven(sum);
            }
        }
        int done = 0;
        if (shift == 1 && 2 * needed >= n3) {
            done = 2 * needed;
            for (int64_t begin = 0; begin < needed; begin += VECTOR / 2) {
                FHASH_INDEPENDENT
                for (int n = 0; n < VECTOR / 2; n++) {
                    const int64_t i = begin + n;
                    const int digit = level[i] * scale;
                    expected[2 * i] += share[i];
                    expected[2 * i + 1] += share[i];
                    others[2 * i] += digit;
                    others[2 * i + 1] += digit;
                }
            }
        }
        for (int x = done; x < n3; x++) {
            const int i = min(x >> shift, last);
            expected[x] += share[i];
            others[x] += level[i] * scale;
        }
    }
    return weight;
}

}  // namespace
