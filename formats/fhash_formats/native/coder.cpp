// Entropy coding of quantised transform coefficients: an adaptive binary range coder whose
// probabilities are mixed from several contexts.
//
// A decoder computes with integers only, so encoder and decoder agree on every machine. The
// portable coder (transform/entropy/coder_portable.py) follows this file step by step and gives the
// same bytes.
//
// A coefficient is coded as a zero flag, its sign, and its magnitude: in unary up to 13, beyond
// that by an Exp-Golomb code. Each binary decision k (0 is the zero flag, any other asks "more than
// k") is predicted by CONTEXTS adaptive estimates, each with a slow and a fast rate. They are mixed
// in the logistic domain by weights that learn as well, as in the PAQ family of compressors.
// Contexts come from magnitudes that are already known: to the left, above, one step and one layer
// before, and in the bands that come before.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <type_traits>
#include <vector>

#include "mixing.hpp"

namespace {

const int CONTEXTS = 6, SIGN_CONTEXTS = 3;  // estimates of a magnitude, and of a sign
const int LANES = 12, SET = padded(LANES);  // weights of a set: of the caller, and as kept here
const int DECISIONS = 16;                   // slots of a context
const int UNARY = 14;                       // magnitudes from this one on have an escape code
const int KINDS = 64;                       // kinds of bands
const int LEVELS = 128;                     // quarter octaves of the expected magnitude
const int SIGN_LIMIT = 255;                 // as SLOW_LIMIT, for signs
const int MAX_MAGNITUDE = 4095;             // as contexts see it, so that sums stay in 32 bits
const int PADDING = 2;                      // zeros beside a row of magnitudes
const int VECTOR = 16;  // sums over a row are made for a multiple of it; those beyond are not used

// Columns of the table of bands (transform/entropy/table.py). LOW, HIGH and SHIFT are the first of
// four columns, for t, z, y and x. BAND and SHIFT are columns within a reference.
enum Column { LOW = 0, HIGH = 4, KIND = 8, REFERENCES = 9, BAND = 0, SHIFT = 1 };
const int REFERENCE_COUNT = 4, REFERENCE_COLUMNS = 5;
const int COLUMNS = REFERENCES + REFERENCE_COUNT * REFERENCE_COLUMNS;

// Weights of neighbours in the expected magnitude, in 1/1024.
const int LEFT = 184, LEFT2 = 20;                 // the left neighbour, and the second one
const int ABOVE = 184, DIAGONAL = 61, ABOVE2 = 41;  // above, each beside that, the second above
const int BEFORE = 102, AROUND = 20, BEFORE2 = 31;  // before along t or z, around that, the second
const int REFERENCE = 62;  // the vertex of a reference; the sum around it has weight AROUND

const int SIZES[CONTEXTS] = {LEVELS, KINDS * 64, 729, 12 * 12 * 12, 7 * 7 * 7 * 7, 12 * 12 * KINDS};
const int SIGN_SIZES[SIGN_CONTEXTS] = {KINDS * 27, KINDS * 81, KINDS * 27};

// Order of the state. Slots: by context, those of the decisions of a context together; then those
// of the signs. Weights: sets by kind; from SECOND on by level; from SIGNS on those of the signs.
// Simple estimates: of the escape code; from ROWS on of empty rows; from EMPTIES on of empty bands.
const int64_t SECOND = int64_t(KINDS) * DECISIONS * SET, SIGNS = SECOND + 64 * DECISIONS * SET;
const int64_t ROWS = LEVELS * 64, EMPTIES = ROWS + 8;

enum Mode { ENCODE, DECODE, CHOOSE };  // CHOOSE encodes magnitudes chosen by rate and distortion

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
FHASH_INLINE int small(int v) { return classes.of[min(v, 141)]; }

// 0 for a negative number, 1 for 0, 2 for a positive number.
FHASH_INLINE int sign_of(int32_t v) { return v > 0 ? 2 : v < 0 ? 0 : 1; }

using Prediction = Mixed<CONTEXTS>;

// Numbers by vertex of a row, from the neighbours that are known before the row.
struct Sums {
    std::vector<int32_t> room;
    int32_t *expected;                // weighted sum for the expected magnitude
    int32_t *plane, *before, *below;  // sums over the rows above, the step before, the layer below
    int32_t *both, *nearest, *sides, *others, *parent;  // shares in the contexts
    int32_t *share, *level;           // by vertex of a reference: share in `expected`, class
    explicit Sums(size_t width) : room(11 * width) {
        int32_t* at = room.data();
        for (int32_t** array : {&expected, &plane, &before, &below, &both, &nearest, &sides,
                                &others, &parent, &share, &level}) {
            *array = at;
            at += width;
        }
    }
};

struct Reference {
    int band, shift[4];
};
struct Band {
    int low[4], size[4], kind;
    Reference references[REFERENCE_COUNT];
    int64_t stride[3];                 // of magnitudes, along t, z and y
    std::vector<uint16_t> magnitudes;  // rows with PADDING zeros at both ends
    std::vector<uint8_t> filled;       // by row: whether it has a magnitude above 0
    bool any;                          // whether the band has one
};

// A row of a band.
struct Row {
    int t, z, y;                 // indices in the band
    uint16_t* magnitudes;        // of its vertices
    const uint8_t* filled;       // its flag; those of other rows lie around
    const uint16_t* references[REFERENCE_COUNT];  // row of each reference for this row, or null
    int reference_y[REFERENCE_COUNT];             // index of that row along y
};

// Read the table of `count` bands. False for a band that does not lie within the shape.
inline bool read_bands(const int32_t* table, const int64_t* shape, std::vector<Band>& bands) {
    for (size_t b = 0; b < bands.size(); b++) {
        const int32_t* const row = table + b * COLUMNS;
        Band& band = bands[b];
        for (int a = 0; a < 4; a++) {
            const int32_t low = row[LOW + a], high = row[HIGH + a];
            if (low < 0 || low > high || high > shape[a]) return false;
            band.low[a] = low;
            band.size[a] = high - low;
        }
        band.kind = row[KIND];
        for (int k = 0; k < REFERENCE_COUNT; k++) {
            const int32_t* const reference = row + REFERENCES + k * REFERENCE_COLUMNS;
            band.references[k].band = reference[BAND];
            for (int a = 0; a < 4; a++) band.references[k].shift[a] = reference[SHIFT + a];
        }
        band.any = false;
    }
    return true;
}

// Find the row of each reference that stands for this row. Whether the row of the parent is filled.
FHASH_INLINE int find_references(const std::vector<Band>& bands, const Band& band, Row& row) {
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
        row.references[k] = other.magnitudes.data() + t * other.stride[0] + z * other.stride[1] +
                            y * other.stride[2] + PADDING;
        if (k == 0)
            parent_filled = other.filled[((int64_t)t * other.size[1] + z) * other.size[2] + y];
    }
    return parent_filled;
}

// Sum over the neighbours of a row within its band, but those to the left, for `lanes` vertices.
// Sum of the weights of the neighbours that exist, those to the left included.
FHASH_INLINE int sum_neighbours(const Band& band, const Row& row, int lanes, Sums& sums) {
    const int t = row.t, z = row.z, y = row.y, n1 = band.size[1], n2 = band.size[2];
    const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
    // Magnitudes and flags of this row, and the strides of both.
    const uint16_t* const M = row.magnitudes;
    const uint8_t* const F = row.filled;
    const int64_t M0 = band.stride[0], M1 = band.stride[1], M2 = band.stride[2];
    const int64_t R1 = n2, R0 = (int64_t)n1 * n2;
    int32_t* FHASH_RESTRICT const expected = sums.expected;
    int32_t* FHASH_RESTRICT const plane = sums.plane;
    for (int32_t* array : {sums.expected, sums.plane, sums.before, sums.below})
        std::memset(array, 0, 4 * (size_t)lanes);
    int weight = LEFT + LEFT2;
    if (has_y) {
        weight += ABOVE + 2 * DIAGONAL;
        if (F[-1]) {
            const uint16_t* p = M - M2;
            FHASH_INDEPENDENT
            for (int x = 0; x < lanes; x++) {
                const int sides = p[x - 1] + p[x + 1];
                expected[x] += ABOVE * p[x] + DIAGONAL * sides;
                plane[x] += 2 * p[x] + sides;
            }
        }
        if (y > 1) weight += ABOVE2;
        if (y > 1 && F[-2]) {
            const uint16_t* p = M - 2 * M2;
            FHASH_INDEPENDENT
            for (int x = 0; x < lanes; x++) {
                expected[x] += ABOVE2 * p[x];
                plane[x] += p[x];
            }
        }
    }
    // Add the row p one step or layer before; r is the offset of its flag.
    auto centre = [&](int32_t* FHASH_RESTRICT sum, int64_t r, const uint16_t* p) FHASH_LAMBDA {
        if (!F[r]) return;
        FHASH_INDEPENDENT
        for (int x = 0; x < lanes; x++) {
            const int sides = p[x - 1] + p[x + 1];
            expected[x] += BEFORE * p[x] + AROUND * sides;
            sum[x] += 2 * p[x] + sides;
        }
    };
    // Add a row beside that one, if it exists.
    auto neighbour = [&](int32_t* FHASH_RESTRICT sum, bool exists, int64_t r,
                         const uint16_t* p) FHASH_LAMBDA {
        if (!exists || !F[r]) return;
        FHASH_INDEPENDENT
        for (int x = 0; x < lanes; x++) {
            expected[x] += AROUND * p[x];
            sum[x] += p[x];
        }
    };
    // Add the row two steps or layers before.
    auto second = [&](int64_t r, const uint16_t* p) FHASH_LAMBDA {
        if (!F[r]) return;
        FHASH_INDEPENDENT
        for (int x = 0; x < lanes; x++) expected[x] += BEFORE2 * p[x];
    };
    if (has_t) {
        weight += BEFORE + 4 * AROUND + (t > 1 ? BEFORE2 : 0);
        centre(sums.before, -R0, M - M0);
        neighbour(sums.before, has_y, -R0 - 1, M - M0 - M2);
        neighbour(sums.before, y + 1 < n2, -R0 + 1, M - M0 + M2);
        neighbour(sums.before, has_z, -R0 - R1, M - M0 - M1);
        neighbour(sums.before, z + 1 < n1, -R0 + R1, M - M0 + M1);
        if (t > 1) second(-2 * R0, M - 2 * M0);
    }
    if (has_z) {
        weight += BEFORE + 4 * AROUND + (z > 1 ? BEFORE2 : 0);
        centre(sums.below, -R1, M - M1);
        neighbour(sums.below, has_y, -R1 - 1, M - M1 - M2);
        neighbour(sums.below, y + 1 < n2, -R1 + 1, M - M1 + M2);
        if (z > 1) second(-2 * R1, M - 2 * M1);
    }
    return weight;
}

// Sum over the references of a row. Sum of the weights of the references that exist.
FHASH_INLINE int sum_references(const std::vector<Band>& bands, const Band& band, const Row& row,
                                int lanes, const uint16_t* nothing, Sums& sums) {
    const int n3 = band.size[3];
    int32_t* FHASH_RESTRICT const expected = sums.expected;
    int32_t *FHASH_RESTRICT const others = sums.others, *FHASH_RESTRICT const parent = sums.parent;
    std::memset(sums.others, 0, 4 * (size_t)lanes);
    std::memset(sums.parent, 0, 4 * (size_t)lanes);
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
        auto around = [&](int i) FHASH_LAMBDA {
            return 2 * p[i] + p[i - 1] + p[i + 1] + up[i] + down[i];
        };
        if (shift == 0 && last >= n3 - 1) {
            FHASH_INDEPENDENT
            for (int x = 0; x < lanes; x++) {
                const int sum = around(x);
                expected[x] += REFERENCE * p[x] + AROUND * sum;
                others[x] += seven(sum) * scale;
            }
            if (k == 0) {
                FHASH_INDEPENDENT
                for (int x = 0; x < lanes; x++) parent[x] = twelve(around(x));
            }
            continue;
        }
        int32_t *FHASH_RESTRICT const share = sums.share, *FHASH_RESTRICT const level = sums.level;
        const int needed = min((n3 - 1) >> shift, last) + 1;
        FHASH_INDEPENDENT
        for (int i = 0; i < needed; i++) {
            const int sum = around(i);
            share[i] = REFERENCE * p[i] + AROUND * sum;
            level[i] = twelve(sum);
        }
        for (int x = 0; x < n3; x++) {
            const int i = min(x >> shift, last);
            expected[x] += share[i];
            others[x] += min(level[i], 6) * scale;
            if (k == 0) parent[x] = level[i];
        }
    }
    return weight;
}

// Shares in the contexts of a row that do not depend on the vertices to the left.
FHASH_INLINE void prepare_contexts(const Band& band, const Row& row, int lanes,
                                   const uint16_t* nothing, Sums& sums) {
    const int kind = band.kind;
    const uint16_t* const above = row.y > 0 ? row.magnitudes - band.stride[2] : nothing;
    const uint16_t* const below = row.z > 0 ? row.magnitudes - band.stride[1] : nothing;
    const uint16_t* const before = row.t > 0 ? row.magnitudes - band.stride[0] : nothing;
    int32_t *FHASH_RESTRICT const both = sums.both, *FHASH_RESTRICT const nearest = sums.nearest;
    int32_t *FHASH_RESTRICT const sides = sums.sides, *FHASH_RESTRICT const parent = sums.parent;
    FHASH_INDEPENDENT
    for (int x = 0; x < lanes; x++) {
        const int sum_before = sums.before[x], sum_below = sums.below[x];
        int digits = min<int>(above[x], 2) * 3 + min<int>(above[x - 1], 2);
        digits = digits * 3 + min<int>(above[x + 1], 2);
        digits = digits * 3 + min<int>(before[x], 2);
        nearest[x] = digits * 3 + min<int>(below[x], 2);
        sides[x] = twelve(sum_before) * 12 + twelve(sum_below);
        both[x] = sum_before + sum_below;
        parent[x] = parent[x] * KINDS + kind;
    }
}

// One run over the bands of a tile.
template <Mode MODE> struct Coder {
    typename std::conditional<MODE == DECODE, Decoder, Encoder>::type range;
    State* state;
    double lambda;  // squared steps that 1/2048 bit is worth

    FHASH_INLINE int simple(int bit, int64_t number) {
        return code_simple(range, state->simples[number], bit);
    }

    // The magnitude next to s = |scaled| that costs least: the nearest one, one less, or zero.
    // p: probability of a zero; predict(prediction, k): probability that it is more than k.
    template <class Predict> FHASH_INLINE int choose(double s, int p, Predict predict) {
        s = s < 1e9 ? s : 1e9;  // also for NaN
        const int nearest = (int)(s + 0.5);
        if (nearest == 0 || nearest >= UNARY) return nearest;
        Prediction other;
        const double zero = s * s + lambda * tables.cost[p];
        const double other_than_zero = lambda * (tables.cost[65536 - p] + 2048);
        if (nearest == 1) {
            const int stop = predict(other, 1);
            const double one = (s - 1) * (s - 1) + lambda * tables.cost[65536 - stop];
            return zero <= one + other_than_zero ? 0 : 1;
        }
        const int before = predict(other, nearest - 1), stop = predict(other, nearest);
        const double same = (s - nearest) * (s - nearest) +
                            lambda * (tables.cost[before] + tables.cost[65536 - stop]);
        const double less = (s - nearest + 1) * (s - nearest + 1) +
                            lambda * tables.cost[65536 - before];
        if (nearest == 2 && zero < min(same, less) + other_than_zero) return 0;
        return less < same ? nearest - 1 : nearest;
    }

    // A magnitude from UNARY on, as an Exp-Golomb number; -1 for one that no encoder writes.
    FHASH_INLINE int code_escape(int magnitude, int level) {
        const int64_t escape = level * 64;
        const uint32_t rest = MODE == DECODE ? 0 : (uint32_t)magnitude - UNARY + 1;
        int bits = 0;
        if (MODE != DECODE) while (rest >> bits > 1) bits++;
        int j = 0;
        while (simple(j < bits, escape + min(j, 20))) if (++j > 30) return -1;
        uint32_t v = 1;
        for (int i = j - 1; i >= 0; i--) {
            const int64_t number = escape + 21 + min(j, 19) * 2 + (i != j - 1);
            v = (v << 1) | (uint32_t)simple((rest >> i) & 1, number);
        }
        return (int)min<uint32_t>(v + (UNARY - 1), 0x7fffffff);
    }

    FHASH_INLINE int64_t run(int32_t* q, const float* scaled, const int64_t* shape,
                             const int32_t* table, int64_t count);
};

// Code all bands. q, scaled, shape, table, count: as for fhash_encode and fhash_decode below.
// 0, or -1 for bytes that no encoder writes and for a band beyond the shape.
template <Mode MODE>
FHASH_INLINE int64_t Coder<MODE>::run(int32_t* q, const float* scaled, const int64_t* shape,
                                      const int32_t* table, int64_t count) {
    const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
    std::vector<Band> bands(count);
    if (!read_bands(table, shape, bands)) return -1;
    int widest = 0;
    for (const Band& band : bands) widest = max(widest, band.size[3]);
    Slot* slots[CONTEXTS];
    Slot* signs[SIGN_CONTEXTS];
    Slot* at = state->slots.data();
    for (int i = 0; i < CONTEXTS; i++) {
        slots[i] = at;
        at += (int64_t)SIZES[i] * DECISIONS;
    }
    for (int i = 0; i < SIGN_CONTEXTS; i++) {
        signs[i] = at;
        at += SIGN_SIZES[i];
    }
    int16_t* const weights = state->weights.data();
    // A row of zeros stands for rows that do not exist.
    std::vector<uint16_t> zeros((size_t)widest + 2 * PADDING + VECTOR, 0);
    const uint16_t* const nothing = zeros.data() + PADDING;
    Sums sums((size_t)widest + VECTOR);

    for (int64_t number = 0; number < count; number++) {
        Band& band = bands[number];
        const int n0 = band.size[0], n1 = band.size[1], n2 = band.size[2], n3 = band.size[3];
        const int kind = band.kind, lanes = (n3 + VECTOR - 1) / VECTOR * VECTOR;
        const int64_t origin = band.low[0] * S0 + band.low[1] * S1 + band.low[2] * S2 + band.low[3];

        // Whether the band has an integer other than 0.
        int any = 0;
        if (MODE != DECODE)
            for (int64_t r = 0; r < (int64_t)n0 * n1 * n2 && !any; r++) {
                const int32_t* row = q + origin + r / n2 / n1 * S0 + r / n2 % n1 * S1 + r % n2 * S2;
                for (int x = 0; x < n3; x++) any |= row[x] != 0;
            }
        any = simple(any, EMPTIES + kind);
        band.any = any != 0;
        if (!any) continue;
        const int64_t M2 = n3 + 2 * PADDING, M1 = M2 * n2, M0 = M1 * n1;
        const int64_t R1 = n2, R0 = (int64_t)n1 * n2;
        band.stride[0] = M0;
        band.stride[1] = M1;
        band.stride[2] = M2;
        band.magnitudes.assign((size_t)M0 * n0 + VECTOR, 0);
        band.filled.assign((size_t)R0 * n0, 0);

        for (int t = 0; t < n0; t++) for (int z = 0; z < n1; z++) for (int y = 0; y < n2; y++) {
            const int64_t r = t * R0 + z * R1 + y;
            int32_t* const out = q + origin + t * S0 + z * S1 + y * S2;
            uint16_t* const M = band.magnitudes.data() + r * M2 + PADDING;
            const uint8_t* const F = band.filled.data() + r;
            const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
            Row row = {t, z, y, M, F, {}, {}};

            // Whether the row has an integer other than 0, where no row around it has one.
            const int parent_filled = find_references(bands, band, row);
            if (!((has_y && F[-1]) || (has_z && F[-R1]) || (has_t && F[-R0]) || parent_filled)) {
                int filled = 0;
                if (MODE != DECODE) for (int x = 0; x < n3; x++) filled |= out[x] != 0;
                const int flag = (n3 > 24 ? 2 : 0) + (y > 1 && F[-2] ? 1 : 0) + (r == 0 ? 4 : 0);
                if (!simple(filled, ROWS + flag)) continue;
            }

            const int weight = sum_neighbours(band, row, lanes, sums) +
                               sum_references(bands, band, row, lanes, nothing, sums);
            const int offset = 160 - log16(weight);
            prepare_contexts(band, row, lanes, nothing, sums);
            const int32_t* FHASH_RESTRICT const expected = sums.expected;
            const int32_t* FHASH_RESTRICT const plane = sums.plane;
            const int32_t* FHASH_RESTRICT const both = sums.both;
            const int32_t* FHASH_RESTRICT const nearest = sums.nearest;
            const int32_t* FHASH_RESTRICT const sides = sums.sides;
            const int32_t* FHASH_RESTRICT const others = sums.others;
            const int32_t* FHASH_RESTRICT const parent = sums.parent;
            int filled = 0, left = 0, left2 = 0;

            for (int x = 0; x < n3; x++) {
                const uint32_t mu = (uint32_t)(expected[x] + LEFT * left + LEFT2 * left2);
                const int level = mu ? min((log16(mu) + offset) / 4 + 1, LEVELS - 1) : 0;
                const int coarse = level / 2;
                const int near = plane[x] + 2 * left + left2;
                const int context[CONTEXTS] = {
                    level,
                    kind * 64 + coarse,
                    min(left, 2) * 243 + nearest[x],
                    small(near) * 144 + sides[x],
                    others[x],
                    small((near + both[x]) / 2) * (12 * KINDS) + parent[x],
                };
                Slot* places[CONTEXTS];
                for (int i = 0; i < CONTEXTS; i++)
                    places[i] = slots[i] + (int64_t)context[i] * DECISIONS;
                auto predict = [&](Prediction& to, int k) FHASH_LAMBDA {
                    for (int i = 0; i < CONTEXTS; i++) to.slots[i] = places[i] + k;
                    to.first = weights + ((int64_t)k * KINDS + kind) * SET;
                    to.second = weights + SECOND + ((int64_t)k * 64 + coarse) * SET;
                    return mix<CONTEXTS, true>(to);
                };

                // The zero flag.
                Prediction now;
                int p = predict(now, 0), value = MODE == DECODE ? 0 : out[x];
                if (MODE == CHOOSE) {
                    const float s = scaled[out - q + x];
                    const int best = choose(std::fabs((double)s), p, predict);
                    out[x] = value = s < 0 ? -best : best;
                }
                int magnitude = std::abs(value);
                const int zero = range.code(magnitude == 0, p);
                learn<CONTEXTS, true>(now, zero, SLOW_LIMIT);
                left2 = left;
                left = 0;
                if (zero) continue;
                filled = 1;

                // The sign.
                const int left_sign = x > 0 ? sign_of(out[x - 1]) : 1;
                const int left2_sign = x > 1 ? sign_of(out[x - 2]) : 1;
                const int y_sign = has_y ? sign_of(out[x - S2]) : 1;
                const int y2_sign = y > 1 ? sign_of(out[x - 2 * S2]) : 1;
                const int z_sign = has_z ? sign_of(out[x - S1]) : 1;
                const int t_sign = has_t ? sign_of(out[x - S0]) : 1;
                Prediction sign;
                sign.slots[0] = signs[0] + kind * 27 + (left_sign * 3 + y_sign) * 3 + t_sign;
                sign.slots[1] = signs[1] + kind * 81 +
                                ((left_sign * 3 + left2_sign) * 3 + y_sign) * 3 + y2_sign;
                sign.slots[2] = signs[2] + kind * 27 + (t_sign * 3 + z_sign) * 3 + left_sign;
                sign.first = sign.second = weights + SIGNS + kind * SET;
                const int negative = range.code(value < 0, mix<SIGN_CONTEXTS, false>(sign));
                learn<SIGN_CONTEXTS, false>(sign, negative, SIGN_LIMIT);

                // The magnitude.
                int k = 1;
                for (; k < UNARY; k++) {
                    p = predict(now, k);
                    const int more = range.code(magnitude > k, p);
                    learn<CONTEXTS, true>(now, more, SLOW_LIMIT);
                    if (!more) break;
                }
                if (k == UNARY) {
                    k = code_escape(magnitude, level);
                    if (k < 0) return -1;
                }
                if (MODE == DECODE) {
                    magnitude = k;
                    out[x] = negative ? -k : k;
                }
                left = min(magnitude, MAX_MAGNITUDE);
                M[x] = (uint16_t)left;
            }
            band.filled[r] = (uint8_t)filled;
        }
    }
    return 0;
}

FHASH_CLONES int64_t encode(Coder<ENCODE> coder, int32_t* q, const int64_t* shape,
                            const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(q, nullptr, shape, table, count);
        coder.range.finish();
        return 0;
    });
}
FHASH_CLONES int64_t encode_chosen(Coder<CHOOSE> coder, int32_t* q, const float* scaled,
                                   const int64_t* shape, const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        coder.run(q, scaled, shape, table, count);
        coder.range.finish();
        return 0;
    });
}
FHASH_CLONES int64_t decode(Coder<DECODE> coder, int32_t* q, const int64_t* shape,
                            const int32_t* table, int64_t count) {
    return guarded([&]() FHASH_LAMBDA { return coder.run(q, nullptr, shape, table, count); });
}

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (axes/bands.py). Integers
// outside the bands count as 0.
//
// scaled: null, or coefficients / step: then the magnitudes are chosen anew and written to q.
// lambda: squared steps that a bit is worth.
// table: (count, COLUMNS).
// slots, weights, simples: the state (transform/entropy/prior.py). It is left adapted if `keep` and
// if the bytes fit.
// data: receives the bytes if they fit the capacity. If they do not, call again with the same q and
// more room.
//
// Returns the number of bytes, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_encode(int32_t* q, const float* scaled, double lambda,
                                  const int64_t* shape, const int32_t* table, int64_t count,
                                  uint16_t* slots, int64_t slot_count, int32_t* weights,
                                  int64_t weight_count, uint16_t* simples, int64_t simple_count,
                                  int64_t keep, uint8_t* data, int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        std::vector<uint8_t> out;
        const Encoder range = {&out};
        const int64_t code =
            scaled ? encode_chosen({range, &state, lambda / 2048}, q, scaled, shape, table, count)
                   : encode({range, &state, 0}, q, shape, table, count);
        if (code < 0) return code;
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) keep_state(state, slots, weights, simples, LANES);
        return size;
    });
}

// Decode integers into q, which must be zeros; the other arguments are those of fhash_encode.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode(int32_t* q, const int64_t* shape, const int32_t* table,
                                  int64_t count, const uint16_t* slots, int64_t slot_count,
                                  const int32_t* weights, int64_t weight_count,
                                  const uint16_t* simples, int64_t simple_count,
                                  const uint8_t* data, int64_t size) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, weight_count, simples, simple_count,
                                 LANES);
        return decode({{data, size}, &state, 0}, q, shape, table, count);
    });
}
