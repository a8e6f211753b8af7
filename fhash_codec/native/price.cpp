// Approximate bytes and error of quantised coefficients, without coding them: by these, transforms
// are compared.
//
// Integers are looked at as a coder with fixed statistics would: band by band, row by row, in
// blocks of 16 along x, the even places of a block before the odd ones, which lie between them. A
// magnitude has a context, the weighted mean of the magnitudes around it that a decoder would know;
// a sign the agreement that the signs around it have shown so far. The bytes are the entropies of
// what was counted in each context.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>

#include "core.hpp"
#include "guard.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::int8_t;
using std::max;
using std::min;
using std::uint16_t;
using std::uint32_t;
using std::uint8_t;

const int BLOCK = 16;     // vertices along x that share a flag
const int PADDING = 16;   // zeros before a row of magnitudes, and at least as many behind it
const int LEVELS = 24;    // half octaves of the mean magnitude around a vertex
const int LOWEST = 5;     // the first of them begins this many octaves below 1
const int SHIFTED = 13;   // every second level from here on leaves one more low bit raw
const int LARGEST = 255;  // magnitude as contexts see it, after the band's shift
const int MANY = 24;      // mean magnitude above which a band is shifted
const int GROUPS = 4;     // of bands: low-low, and the three orientations of a plane
const int KINDS = 64;     // of bands (transform/lifting.py)
const int PLANE_OF_BASIS = 13;
const float ROUNDING = 0.45F;     // added to a magnitude above 1 before it is rounded down
const double BIT = 0.09;          // squared steps that a bit is worth
const double CONTEXT_BITS = 6;    // that a context costs which is used

// Tokens of a magnitude: itself up to 8, then intervals of 2, 4, 8 ... magnitudes, beside which
// the place within is raw; the last one has no end.
const int TOKENS = 16, DIRECT = 9;
const int FIRST[TOKENS] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 15, 23, 39, 71, 135};

const int FLAG_CLASSES = 14;  // of flags of blocks, by the magnitudes around; from here on no flag
const int LOWEST_FLAG = 3;    // the first class has means up to this many octaves below 1
const int SIGNS = 5;          // signs that predict one: above, below, before, to the left and right
const int SIGN_LEVELS = 24;   // half octaves of the odds of a sign

// Weights of the magnitudes around: above along y and beside that, two above; the same one layer
// and one step before; the vertices of references and beside them; to the left and to the right.
const int ABOVE = 16, ABOVE_SIDES = 6, ABOVE2 = 3;
const int BELOW = 16, BELOW_SIDES = 2, BELOW_NEAR = 4, BELOW2 = 4;
const int BEFORE = 8, BEFORE_SIDES = 1, BEFORE_NEAR = 3, BEFORE2 = 3;
const int REFERENCES = 4;
const int REFERENCE[REFERENCES] = {4, 12, 4, 3}, REFERENCE_SIDES[REFERENCES] = {1, 2, 0, 1};
const int SIDE = 16;

// Columns of the table of bands, as in transform/coder.py.
const int LOW = 0, HIGH = 4, KIND = 8, OTHERS = 9, REFERENCE_COLUMNS = 5;
const int COLUMNS = OTHERS + REFERENCES * REFERENCE_COLUMNS;

struct Band {
    int low[4], size[4], kind;
    int reference[REFERENCES], halvings[REFERENCES][4];
    int shift = 0;          // low bits that are left raw everywhere
    int blocks = 0;         // of a row
    int64_t pitch = 0;      // of rows
    bool any = false;       // whether an integer is not 0
    std::vector<uint8_t> magnitudes;
    std::vector<int8_t> signs;
    std::vector<uint8_t> filled;  // by block, with a 0 at both ends of each row

    int64_t row(int t, int z, int y) const { return ((int64_t)t * size[1] + z) * size[2] + y; }
    const uint8_t* magnitudes_of(int64_t row) const {
        return magnitudes.data() + row * pitch + PADDING;
    }
    const int8_t* signs_of(int64_t row) const { return signs.data() + row * pitch + PADDING; }
    const uint8_t* filled_of(int64_t row) const { return filled.data() + row * (blocks + 2) + 1; }
};

// Numbers of what was seen in each context.
struct Counts {
    uint32_t tokens[GROUPS * 2][LEVELS][TOKENS] = {};
    uint32_t blocks[2][FLAG_CLASSES][2][2] = {}, rows[2][2] = {}, signs[SIGN_LEVELS][2] = {};
    uint32_t agreed[KINDS][2][SIGNS][2] = {};  // by parity: how often a sign was the same, or not
    int64_t raw = 0;                           // bits
};

// Half octaves of a number above 0, from an origin far below.
FHASH_INLINE int half_octaves(float number) {
    int32_t bits;
    std::memcpy(&bits, &number, sizeof bits);
    return bits >> 22;
}

FHASH_INLINE int level_of(float mean) {
    return min(max(half_octaves(mean) - 2 * (127 - LOWEST) + 1, 0), LEVELS - 1);
}

template <int N> double entropy(const uint32_t (&counts)[N]) {
    double total = 0, bits = 0;
    int used = 0;
    for (uint32_t count : counts) {
        total += count;
        used += count > 0;
    }
    for (uint32_t count : counts)
        if (count) bits -= count * std::log2(count / total);
    return used > 1 ? bits + CONTEXT_BITS : bits;
}

struct Pricer {
    const float* coefficients;
    const int64_t* shape;
    float scale;  // 1 / step
    std::vector<Band> bands;
    Counts counts;
    double squares = 0;              // of the errors, in squared steps
    float zero_below[LEVELS];        // magnitudes that are worth less than their bits, by level
    std::vector<uint8_t> nothing;    // a row of zeros
    std::vector<uint8_t> near;       // by block: whether a block around it is filled
    std::vector<uint8_t> moved[REFERENCES];  // rows of references, at the vertices of this one
    std::vector<int> integers;       // magnitudes of a row
    struct Around {
        const uint8_t *above, *above2, *below, *below2, *below_near[2];
        const uint8_t *before, *before2, *before_near[4];
        const uint8_t* references[REFERENCES];
        int weights[REFERENCES], sides[REFERENCES], count;
        int weight;  // sum of the weights of all that exist, but for left and right
    } around;

    const float* values(const Band& band, int t, int z, int y) const {
        return coefficients + (((band.low[0] + t) * shape[1] + band.low[1] + z) * shape[2] +
                               band.low[2] + y) * shape[3] + band.low[3];
    }

    // Round the magnitudes of a row. The squared error; count, sum: of those that are not 0.
    FHASH_INLINE float round_row(const float* from, int length, int64_t& count, double& sum) {
        int* FHASH_RESTRICT const to = integers.data();
        float error = 0, total = 0;
        int some = 0;
        FHASH_INDEPENDENT
        for (int x = 0; x < length; x++) {
            const float any = std::fabs(from[x] * scale);
            const float size = any < 1e9F ? any : 1e9F;  // also for NaN
            const int whole = (int)(size + ROUNDING);
            const float rest = size - (float)whole;
            to[x] = whole;
            error += rest * rest;
            total += (float)whole;
            some += whole > 0;
        }
        count += some;
        sum += total;
        return error;
    }

    template <class Each> FHASH_INLINE void all_rows(const Band& band, Each each) {
        for (int t = 0; t < band.size[0]; t++)
            for (int z = 0; z < band.size[1]; z++)
                for (int y = 0; y < band.size[2]; y++) each(t, z, y);
    }

    FHASH_INLINE void price_band(Band& band) {
        const int64_t rows = (int64_t)band.size[0] * band.size[1] * band.size[2];
        const int length = band.size[3];
        if (!rows || !length) return;
        integers.resize((size_t)length);
        int64_t count = 0;
        double sum = 0;
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA {
            squares += round_row(values(band, t, z, y), length, count, sum);
        });
        band.any = count > 0;
        if (!band.any) return;
        while (sum > (double)MANY * count * (1 << band.shift) && band.shift < 29) band.shift++;
        band.blocks = (length + BLOCK - 1) / BLOCK;
        band.pitch = PADDING + BLOCK * band.blocks + PADDING;
        band.magnitudes.assign((size_t)(rows * band.pitch), 0);
        band.signs.assign((size_t)(rows * band.pitch), 0);
        band.filled.assign((size_t)(rows * (band.blocks + 2)), 0);
        near.resize((size_t)band.blocks);
        if ((int64_t)nothing.size() < band.pitch) nothing.assign((size_t)band.pitch, 0);
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA { price_row(band, t, z, y); });
    }

    // Find the rows around a row that a decoder would know, and which blocks lie near filled ones.
    FHASH_INLINE void look_around(const Band& band, int t, int z, int y) {
        std::fill(near.begin(), near.end(), 0);
        const bool up = y > 0, down = y + 1 < band.size[2];
        const bool back = z > 0, front = z + 1 < band.size[1], earlier = t > 0;
        const int blocks = band.blocks;
        auto at = [&](bool exists, int dt, int dz, int dy) FHASH_LAMBDA {
            if (!exists) return static_cast<const uint8_t*>(nothing.data() + PADDING);
            const int64_t row = band.row(t + dt, z + dz, y + dy);
            const uint8_t* const filled = band.filled_of(row);
            for (int k = 0; k < blocks; k++) near[k] |= filled[k - 1] | filled[k] | filled[k + 1];
            return band.magnitudes_of(row);
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
        for (int k = 0; k < REFERENCES; k++)
            if (band.reference[k] >= 0) {
                to.weight += REFERENCE[k] + 2 * REFERENCE_SIDES[k];
                look_at_reference(band, k, t, z, y);
            }
    }

    FHASH_INLINE void look_at_reference(const Band& band, int k, int t, int z, int y) {
        const Band& other = bands[(size_t)band.reference[k]];
        if (!other.any) return;
        const int* const halvings = band.halvings[k];
        const int64_t row = other.row(min(t >> halvings[0], other.size[0] - 1),
                                      min(z >> halvings[1], other.size[1] - 1),
                                      min(y >> halvings[2], other.size[2] - 1));
        const uint8_t* const filled = other.filled_of(row);
        if (!std::memchr(filled, 1, (size_t)other.blocks)) return;
        const int along = halvings[3], shift = other.shift - band.shift;
        for (int i = 0; i < band.blocks; i++) {
            const int j = min(i >> along, other.blocks - 1);
            const int beside =
                along ? filled[i & 1 ? j + 1 : j - 1] : filled[j - 1] | filled[j + 1];
            near[i] |= filled[j] | beside;
        }
        const uint8_t* from = other.magnitudes_of(row);
        if (along || shift || other.pitch < band.pitch) {
            std::vector<uint8_t>& to = moved[around.count];
            to.assign((size_t)band.pitch, 0);
            for (int x = 0; x < band.size[3]; x++) {
                const int value = from[min(x >> along, other.size[3] - 1)];
                const int same = shift >= 0 ? value << min(shift, 8) : value >> min(-shift, 8);
                to[PADDING + x] = (uint8_t)min(same, LARGEST);
            }
            from = to.data() + PADDING;
        }
        around.references[around.count] = from;
        around.weights[around.count] = REFERENCE[k];
        around.sides[around.count++] = REFERENCE_SIDES[k];
    }

    // Weighted sums of the magnitudes around the vertices of a block, but for left and right.
    FHASH_INLINE void sum_block(int64_t first, uint16_t* FHASH_RESTRICT sums) const {
        const Around& of = around;
        const uint8_t *const a = of.above + first, *const a2 = of.above2 + first;
        const uint8_t *const c = of.below + first, *const c2 = of.below2 + first;
        const uint8_t *const cn = of.below_near[0] + first, *const cs = of.below_near[1] + first;
        const uint8_t *const b = of.before + first, *const b2 = of.before2 + first;
        const uint8_t *const bp = of.before_near[0] + first, *const bf = of.before_near[1] + first;
        const uint8_t *const bn = of.before_near[2] + first, *const bs = of.before_near[3] + first;
        FHASH_INDEPENDENT
        for (int i = 0; i < BLOCK; i++)
            sums[i] = (uint16_t)(ABOVE * a[i] + ABOVE_SIDES * (a[i - 1] + a[i + 1]) +
                                 ABOVE2 * a2[i] + BELOW * c[i] +
                                 BELOW_SIDES * (c[i - 1] + c[i + 1]) +
                                 BELOW_NEAR * (cn[i] + cs[i]) + BELOW2 * c2[i] + BEFORE * b[i] +
                                 BEFORE_SIDES * (b[i - 1] + b[i + 1]) +
                                 BEFORE_NEAR * (bp[i] + bf[i] + bn[i] + bs[i]) + BEFORE2 * b2[i]);
        for (int k = 0; k < of.count; k++) {
            const uint8_t* const p = of.references[k] + first;
            const int weight = of.weights[k], sides = of.sides[k];
            FHASH_INDEPENDENT
            for (int i = 0; i < BLOCK; i++)
                sums[i] = (uint16_t)(sums[i] + weight * p[i] + sides * (p[i - 1] + p[i + 1]));
        }
    }

    // Make the integer at x 0, and add what that changes of the error.
    FHASH_INLINE void drop(const float* from, int x) {
        const float size = std::fabs(from[x] * scale);
        squares += size * size - (size - 1) * (size - 1);
        integers[(size_t)x] = 0;
    }

    FHASH_INLINE void price_row(Band& band, int t, int z, int y) {
        const int64_t row = band.row(t, z, y);
        const float* const from = values(band, t, z, y);
        const int length = band.size[3];
        int64_t count = 0;
        double sum = 0;
        round_row(from, length, count, sum);
        look_around(band, t, z, y);
        if (!std::memchr(near.data(), 1, near.size())) {
            int some = 0;
            for (int x = 0; count && x < length; x++) {
                if (integers[x] == 1 && std::fabs(from[x] * scale) < zero_below[0]) drop(from, x);
                some |= integers[x];
            }
            counts.rows[band.blocks > 2][some != 0]++;
            if (!some) return;
        }
        const auto& agreed = counts.agreed[band.kind];
        int odds[2][SIGNS];
        for (int parity = 0; parity < 2; parity++)
            for (int k = 0; k < SIGNS; k++)
                odds[parity][k] = (int)(8 * std::log2((agreed[parity][k][0] + 2.0F) /
                                                      (agreed[parity][k][1] + 2.0F)));
        int before = 0;
        for (int k = 0; k < band.blocks; k++)
            before = price_block(band, row, from, k, before, odds);
    }

    // Whether the block has an integer that is not 0. before: the same of the block before it.
    FHASH_INLINE int price_block(Band& band, int64_t row, const float* from, int number, int before,
                                 const int (&odds)[2][SIGNS]) {
        const int plane = band.kind >> 2;
        const int group = plane == 0 || plane == PLANE_OF_BASIS ? 0 : 1 + (plane - 1) % 3;
        const int first = BLOCK * number, room = min(band.size[3] - first, BLOCK);
        uint8_t* const to = const_cast<uint8_t*>(band.magnitudes_of(row)) + first;
        uint16_t sums[BLOCK] = {};
        int flag = 0;
        if (near[(size_t)number]) {
            sum_block(first, sums);
            uint32_t total = 0;
            for (int i = 0; i < BLOCK; i++) total += sums[i];
            const float mean = (float)total / (float)(BLOCK * max(around.weight, 1));
            const int octaves = half_octaves(mean * BLOCK) - 2 * (127 - LOWEST_FLAG) + 1;
            if (total) flag = min(max(octaves, 1), FLAG_CLASSES);
        }
        int levels[BLOCK], any = 0;
        for (int parity = 0; parity < 2; parity++)
            for (int i = parity; i < room; i += 2) {
                const int x = first + i;
                int sum = sums[i], weight = max(around.weight, 1);
                if (parity) {
                    sum += SIDE * (to[i - 1] + (i + 1 < BLOCK ? to[i + 1] : 0));
                    weight = around.weight + 2 * SIDE;
                }
                levels[i] = level_of((float)sum / (float)weight);
                if (integers[x] == 1 && std::fabs(from[x] * scale) < zero_below[levels[i]])
                    drop(from, x);
                to[i] = (uint8_t)min(integers[x] >> band.shift, LARGEST);
                any |= integers[x];
            }
        if (flag < FLAG_CLASSES) {
            counts.blocks[group > 0][flag][before][any != 0]++;
            if (!any) return 0;
        }
        const_cast<uint8_t*>(band.filled_of(row))[number] = any != 0;
        for (int i = 0; i < room; i++) {
            const int low = band.shift + max((levels[i] - SHIFTED) >> 1, 0);
            const int magnitude = integers[first + i] >> low;
            int token = min(magnitude, DIRECT);
            while (token >= DIRECT && token + 1 < TOKENS && magnitude >= FIRST[token + 1]) token++;
            counts.tokens[2 * group + (i & 1)][levels[i]][token]++;
            counts.raw += low + max(token - DIRECT + 1, 0);
            if (token == TOKENS - 1)
                for (int rest = magnitude; rest >= 4 * FIRST[token]; rest >>= 1) counts.raw += 2;
        }
        price_signs(band, row, from, first, room, odds);
        return 1;
    }

    FHASH_INLINE void price_signs(Band& band, int64_t row, const float* from, int first, int room,
                                  const int (&odds)[2][SIGNS]) {
        const int8_t* const none = reinterpret_cast<const int8_t*>(nothing.data()) + PADDING;
        int8_t* const signs = const_cast<int8_t*>(band.signs_of(row));
        const int64_t layer = band.size[2], step = layer * band.size[1];
        const int64_t z = row / layer % band.size[1];
        const int8_t* const above = row % layer ? band.signs_of(row - 1) : none;
        const int8_t* const below = z ? band.signs_of(row - layer) : none;
        const int8_t* const before = row >= step ? band.signs_of(row - step) : none;
        auto& agreed = counts.agreed[band.kind];
        for (int x = first; x < first + room; x++)
            signs[x] = (int8_t)(integers[x] ? (from[x] < 0 ? -1 : 1) : 0);
        for (int x = first; x < first + room; x++) {
            if (!signs[x]) continue;
            const int parity = x & 1, last = x + 1 == first + BLOCK;
            const int others[SIGNS] = {above[x], below[x], before[x], parity ? signs[x - 1] : 0,
                                       parity && !last ? signs[x + 1] : 0};
            int sum = 0;
            for (int k = 0; k < SIGNS; k++) sum += others[k] * odds[parity][k];
            const int foretold = signs[x] == (sum < 0 ? -1 : 1);
            counts.signs[min(std::abs(sum) >> 2, SIGN_LEVELS - 1)][foretold]++;
            for (int k = 0; k < SIGNS; k++)
                if (others[k]) agreed[parity][k][others[k] != signs[x]]++;
        }
    }

    double bytes() const {
        double bits = (double)counts.raw;
        for (const auto& group : counts.tokens)
            for (const auto& level : group) bits += entropy(level);
        for (const auto& group : counts.blocks)
            for (const auto& flag : group)
                for (const auto& after : flag) bits += entropy(after);
        for (const auto& flag : counts.rows) bits += entropy(flag);
        for (const auto& level : counts.signs) bits += entropy(level);
        return bits / 8;
    }
};

FHASH_TWO_CLONES int64_t price(Pricer& pricer) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        for (Band& band : pricer.bands) pricer.price_band(band);
        return 0;
    });
}

void read_band(const int32_t* row, Band& band) {
    for (int axis = 0; axis < 4; axis++) {
        band.low[axis] = row[LOW + axis];
        band.size[axis] = row[HIGH + axis] - row[LOW + axis];
    }
    band.kind = row[KIND];
    for (int k = 0; k < REFERENCES; k++) {
        const int32_t* const reference = row + OTHERS + k * REFERENCE_COLUMNS;
        band.reference[k] = reference[0];
        for (int axis = 0; axis < 4; axis++) band.halvings[k][axis] = reference[1 + axis];
    }
}

}  // namespace

// Price coefficients (t, z, y, x) in the bands of a table (transform/lifting.py) at a step.
//
// scale: 1 / step. table: (count, COLUMNS); its bands lie within the shape.
// results: receives the bytes, and the sum of the squared errors in squared steps.
//
// Returns 0, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_price(const float* coefficients, const int64_t* shape,
                                 const int32_t* table, int64_t count, double scale,
                                 double* results) {
    return guarded([&]() -> int64_t {
        const auto pricer = std::make_unique<Pricer>();
        pricer->coefficients = coefficients;
        pricer->shape = shape;
        pricer->scale = (float)scale;
        pricer->bands.resize((size_t)count);
        for (int64_t n = 0; n < count; n++)
            read_band(table + n * COLUMNS, pricer->bands[(size_t)n]);
        for (int level = 0; level < LEVELS; level++) {
            // Bits of a 1 and its sign less those of a 0, in a geometric distribution of the mean.
            const double mean = level ? std::exp2((level - 0.5) / 2 - LOWEST) : std::exp2(-8);
            const double bits = std::log2((1 + mean) / mean) + 1;
            pricer->zero_below[level] = (float)(0.5 + BIT / 2 * bits);
        }
        const int64_t code = price(*pricer);
        if (code < 0) return code;
        results[0] = pricer->bytes();
        results[1] = pricer->squares;
        return 0;
    });
}
