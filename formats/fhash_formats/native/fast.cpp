// The fast entropy coder: fixed distributions, coded in lanes side by side, and their prices.
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
// With PRICE nothing is written: the bytes are those that it would take, and by these transforms
// are compared.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>

#include "bands.hpp"
#include "mixing.hpp"

namespace {

using std::int8_t;

enum Mode { PRICE, CHOOSE, ENCODE, DECODE };  // CHOOSE encodes magnitudes chosen by rate and error

const int LANES = 8;      // values that are coded side by side
const int BLOCK = 16;     // vertices along x that share a flag: the even and the odd lanes
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

// Contexts: of magnitudes by group, parity and level, then of signs; the last one is of nothing.
const int OF_SIGNS = GROUPS * 2 * LEVELS, CONTEXTS = OF_SIGNS + SIGN_LEVELS;
const int NOTHING = CONTEXTS;
// Distributions of the prior: of tokens, and then of signs; the last one is that of nothing.
const int CHOICES = 64, CERTAIN = 2 * CHOICES, DISTRIBUTIONS = CERTAIN + 1;
const int CHOICE_BITS = 6;
const int PRECISION = 11;  // bits of a probability
const uint32_t SLOTS = 1u << PRECISION, LEAST_STATE = 1u << 16;

const int FLAG_CLASSES = 14;  // of flags of blocks, by the magnitudes around; from here on no flag
const int LOWEST_FLAG = 3;    // the first class has means up to this many octaves below 1
enum Flag { BANDS = 0, ROWS = 1, SHIFTS = 3, BLOCKS = 8, FLAGS = BLOCKS + 4 * FLAG_CLASSES };

// Weights of the magnitudes around: above along y and beside that, two above; the same one layer
// and one step before; the vertices of references and beside them; to the left and to the right.
const int ABOVE = 16, ABOVE_SIDES = 6, ABOVE2 = 3;
const int BELOW = 16, BELOW_SIDES = 2, BELOW_NEAR = 4, BELOW2 = 4;
const int BEFORE = 8, BEFORE_SIDES = 1, BEFORE_NEAR = 3, BEFORE2 = 3;
const int REFERENCE[REFERENCE_COUNT] = {4, 12, 4, 3};
const int REFERENCE_SIDES[REFERENCE_COUNT] = {1, 2, 0, 1};
const int SIDE = 16;

// The prior (transform/coder.py): a distribution is the slots that each of its symbols has.
struct Prior {
    const uint16_t (*slots)[TOKENS];
    const uint8_t* defaults;  // by context
    const uint32_t* lookup;   // by distribution and slot: symbol, place among its slots, its slots
};

struct Band : BandPlace {
    int shift = 0;      // low bits that are left raw everywhere
    int blocks = 0;     // of a row
    int64_t pitch = 0;  // of rows
    bool any = false;   // whether an integer is not 0
    std::vector<uint8_t> magnitudes;
    std::vector<int8_t> signs;    // even and then odd places of each block
    std::vector<uint8_t> filled;  // by block, with a 0 at both ends of each row

    int64_t row(int t, int z, int y) const { return ((int64_t)t * size[1] + z) * size[2] + y; }
    uint8_t* magnitudes_of(int64_t row) { return magnitudes.data() + row * pitch + PADDING; }
    int8_t* signs_of(int64_t row) { return signs.data() + row * pitch + PADDING; }
    uint8_t* filled_of(int64_t row) { return filled.data() + row * (blocks + 2) + 1; }
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
FHASH_INLINE int low_bits(int level) { return max((level - SHIFTED) >> 1, 0); }
FHASH_INLINE int token_of(int magnitude) {
    return magnitude < DIRECT ? magnitude : min(significant((uint32_t)magnitude - 7) + 7, LAST);
}

// Bits in the order in which they are read, the lowest of a byte first.
struct BitsOut {
    std::vector<uint8_t> bytes;
    uint64_t now = 0;
    int used = 0;

    void put(uint64_t value, int count) {  // at most 32
        now |= value << used;
        for (used += count; used >= 8; used -= 8, now >>= 8) bytes.push_back((uint8_t)now);
    }
    void finish() {
        if (used) bytes.push_back((uint8_t)now);
        now = 0;
        used = 0;
    }
};
struct BitsIn {
    std::vector<uint8_t> bytes;  // with zeros behind the end
    uint64_t at = 0, end = 0;    // in bits
    bool damaged = false;

    BitsIn(const uint8_t* data, int64_t size)
        : bytes((size_t)size + 16, 0), end(8 * (uint64_t)size) {
        if (size) std::memcpy(bytes.data(), data, (size_t)size);
    }
    FHASH_INLINE uint64_t peek() {  // 57 bits at least
        at = min(at, end);
        const uint8_t* const p = bytes.data() + (at >> 3);
        uint64_t word = 0;
        for (int i = 0; i < 8; i++) word |= (uint64_t)p[i] << (8 * i);
        return word >> (at & 7);
    }
    FHASH_INLINE uint32_t take(int count) {  // at most 32
        const uint64_t value = peek() & ((1ull << count) - 1);
        at += (uint64_t)count;
        return (uint32_t)value;
    }
};

// What the lanes have coded at one time.
struct Step {
    uint8_t contexts[LANES], symbols[LANES];
};

struct Task {
    int32_t* q;          // null where prices are asked for
    const float* values;  // where integers are chosen: those that they stand for
    float scale;         // of the values: 1 / step
    double weight;       // squared steps that a bit is worth
    const int64_t* shape;
    const Prior& prior;
    std::vector<Band> bands;
};

// Stands for an Encoder where only the bits count, in 1/2048.
struct Counter {
    int64_t bits = 0;

    FHASH_INLINE int code(int bit, uint32_t p) {
        bits += tables.cost[bit ? p : 65536 - p];
        return bit;
    }
};

template <Mode MODE>
using FlagWriter = typename std::conditional<MODE == PRICE, Counter, Encoder>::type;
template <Mode MODE>
using FlagCoder = typename std::conditional<MODE == DECODE, Decoder, FlagWriter<MODE>>::type;

template <Mode MODE> struct Coder {
    static const bool CHOOSES = MODE == PRICE || MODE == CHOOSE;
    static const bool WRITES = MODE == CHOOSE || MODE == ENCODE;
    Task& task;
    FlagCoder<MODE> range;
    Simple flags[FLAGS];
    uint32_t agreed[KINDS][2][SIGNS][2] = {};  // by parity: how often a sign was the same, or not
    std::vector<uint8_t> nothing;              // a row of zeros
    std::vector<uint8_t> near;                 // by block: whether a block around it is filled
    std::vector<uint8_t> moved[REFERENCE_COUNT];  // rows of references, at the vertices of this one

    // Encoding.
    uint32_t counts[CONTEXTS + 1][TOKENS] = {};
    int64_t raw = 0;  // bits beside
    double squares = 0;
    BitsOut out;
    std::vector<Step> steps;
    float lower[CONTEXTS + 1][TOKENS] = {};  // of a magnitude: below it, one less is cheaper
    float zero_of_two[CONTEXTS + 1] = {};    // below it a 2 is worth less than its bits

    // Decoding.
    BitsIn in;
    uint32_t state[LANES] = {};
    std::vector<uint8_t> words;
    const uint8_t *word = nullptr, *end = nullptr;
    uint32_t lookups[CONTEXTS + 1];  // where the distribution of each context begins

    struct Around {
        const uint8_t *above, *above2, *below, *below2, *below_near[2];
        const uint8_t *before, *before2, *before_near[4];
        const uint8_t* references[REFERENCE_COUNT];
        int weights[REFERENCE_COUNT], sides[REFERENCE_COUNT], count;
        int weight;  // sum of the weights of all that exist, but for left and right
    } around;

    // A row of a band.
    struct Row {
        int64_t number;
        int32_t* q;
        const float* values;
        uint8_t *magnitudes, *filled;
        int8_t* signs;
        const int8_t* signs_around[3];  // above, below, before
        int odds[2][SIGNS];             // by parity, in 16ths of octaves
        float scale[2];                 // by parity: 1 / sum of weights
    };

    Coder(Task& of, FlagCoder<MODE> flag_coder, BitsIn bits)
        : task(of), range(flag_coder), in(bits) {
        for (Simple& flag : flags) flag = {32768, 0};
    }

    FHASH_INLINE int flag(int bit, int number) { return code_simple(range, flags[number], bit); }

    // Bits of the tokens by the defaults of the prior, so that magnitudes can be chosen.
    void weigh() {
        for (int context = 0; context <= NOTHING; context++) {
            const int choice = context < OF_SIGNS ? task.prior.defaults[context] : 0;
            const uint16_t* const slots = task.prior.slots[choice];
            const int level = context % LEVELS;
            float bits[DIRECT];
            for (int token = 0; token < DIRECT; token++)
                bits[token] = PRECISION - std::log2((float)max<int>(slots[token], 1)) + (token > 0);
            for (int token = 0; token < TOKENS; token++) {
                const bool raw_too = token == 0 || token >= DIRECT || low_bits(level) > 0;
                const float more = raw_too ? 0.0F : bits[token] - bits[token - 1];
                lower[context][token] = (float)(task.weight / 2) * max(more, 0.0F) - 0.5F;
            }
            const bool raw_too = low_bits(level) > 0;
            const float more = bits[2] - bits[0];
            zero_of_two[context] = raw_too ? 0.0F : 1 + (float)(task.weight / 4) * more;
        }
    }

    // Whether some of `count` values of a row are worth a symbol. Else they are zeros.
    FHASH_INLINE int some_of(const Row& row, int first, int count, float least) {
        int some = 0;
        if constexpr (MODE == ENCODE) {
            for (int x = first; x < first + count; x++) some |= row.q[x] != 0;
        } else if constexpr (CHOOSES) {
            const float scale = task.scale;
            float sum = 0;
            FHASH_INDEPENDENT
            for (int x = first; x < first + count; x++) {
                const float size = std::fabs(row.values[x] * scale);
                some |= size >= least;
                sum += size * size;
            }
            if (!some) squares += sum;
        }
        return some;
    }

    template <class Each> FHASH_INLINE void all_rows(const Band& band, Each each) {
        for (int t = 0; t < band.size[0]; t++)
            for (int z = 0; z < band.size[1]; z++)
                for (int y = 0; y < band.size[2]; y++) each(t, z, y);
    }

    FHASH_INLINE Row row_of(Band& band, int t, int z, int y) {
        const int64_t* const shape = task.shape;
        const int64_t place = (((band.low[0] + t) * shape[1] + band.low[1] + z) * shape[2] +
                               band.low[2] + y) * shape[3] + band.low[3];
        Row row;
        row.number = band.row(t, z, y);
        row.q = MODE == PRICE ? nullptr : task.q + place;
        row.values = CHOOSES ? task.values + place : nullptr;
        return row;
    }

    // Find out whether a band has integers, and how large they are.
    FHASH_INLINE void look_at(Band& band) {
        int64_t count = 0;
        double sum = 0, error = 0;
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA {
            const Row row = row_of(band, t, z, y);
            float total = 0, squared = 0;
            int some = 0;
            if constexpr (MODE == ENCODE) {
                for (int x = 0; x < band.size[3]; x++) {
                    total += (float)std::abs(row.q[x]);
                    some += row.q[x] != 0;
                }
            } else {
                const float scale = task.scale;
                FHASH_INDEPENDENT
                for (int x = 0; x < band.size[3]; x++) {
                    const float size = std::fabs(row.values[x] * scale);
                    const int large = size >= 0.5F;
                    some += large;
                    total += large ? size : 0;
                    squared += size * size;
                }
            }
            count += some;
            sum += total;
            error += squared;
        });
        band.any = count > 0;
        if (!band.any) squares += error;
        const double most = (double)MANY * count;
        while (sum > most * (1 << band.shift) && band.shift < MAX_SHIFT) band.shift++;
    }

    FHASH_INLINE void code_band(Band& band) {
        const int64_t rows = (int64_t)band.size[0] * band.size[1] * band.size[2];
        const int length = band.size[3];
        if (!rows || !length) return;
        if (MODE != DECODE) look_at(band);
        band.any = flag(band.any, BANDS) != 0;
        if (!band.any) return;
        int shift = 0;
        for (int bit = 4; bit >= 0; bit--)
            shift |= flag(band.shift >> bit & 1, SHIFTS + bit) << bit;
        band.shift = shift;
        band.blocks = (length + BLOCK - 1) / BLOCK;
        band.pitch = PADDING + BLOCK * band.blocks + PADDING;
        band.magnitudes.assign((size_t)(rows * band.pitch), 0);
        band.signs.assign((size_t)(rows * band.pitch), 0);
        band.filled.assign((size_t)(rows * (band.blocks + 2)), 0);
        near.resize((size_t)band.blocks);
        if ((int64_t)nothing.size() < band.pitch) nothing.assign((size_t)band.pitch, 0);
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA { code_row(band, t, z, y); });
    }

    // Find the rows around a row that a decoder knows, and which blocks lie near filled ones.
    FHASH_INLINE void look_around(Band& band, int t, int z, int y) {
        std::fill(near.begin(), near.end(), 0);
        const bool up = y > 0, down = y + 1 < band.size[2];
        const bool back = z > 0, front = z + 1 < band.size[1], earlier = t > 0;
        const int blocks = band.blocks;
        auto at = [&](bool exists, int dt, int dz, int dy) FHASH_LAMBDA {
            if (!exists) return static_cast<const uint8_t*>(nothing.data() + PADDING);
            const int64_t row = band.row(t + dt, z + dz, y + dy);
            const uint8_t* const filled = band.filled_of(row);
            for (int k = 0; k < blocks; k++) near[k] |= filled[k - 1] | filled[k] | filled[k + 1];
            return static_cast<const uint8_t*>(band.magnitudes_of(row));
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
        for (int k = 0; k < REFERENCE_COUNT; k++)
            if (band.references[k].band >= 0) {
                to.weight += REFERENCE[k] + 2 * REFERENCE_SIDES[k];
                look_at_reference(band, k, t, z, y);
            }
    }

    FHASH_INLINE void look_at_reference(Band& band, int k, int t, int z, int y) {
        Band& other = task.bands[(size_t)band.references[k].band];
        if (!other.any) return;
        const int* const halvings = band.references[k].shift;
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
        if (along || shift || other.size[3] != band.size[3]) {
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

    FHASH_INLINE void code_row(Band& band, int t, int z, int y) {
        Row row = row_of(band, t, z, y);
        look_around(band, t, z, y);
        const int group = group_of(band.kind);
        const float far = 1 + lower[group * 2 * LEVELS][1];  // least value worth a symbol
        if (!std::memchr(near.data(), 1, near.size()) &&
            !flag(some_of(row, 0, band.size[3], far), ROWS + (band.blocks > 2)))
            return;
        row.magnitudes = band.magnitudes_of(row.number);
        row.filled = band.filled_of(row.number);
        row.signs = band.signs_of(row.number);
        const int8_t* const none = reinterpret_cast<const int8_t*>(nothing.data()) + PADDING;
        const int64_t layer = band.pitch * band.size[2];
        row.signs_around[0] = y > 0 ? row.signs - band.pitch : none;
        row.signs_around[1] = z > 0 ? row.signs - layer : none;
        row.signs_around[2] = t > 0 ? row.signs - layer * band.size[1] : none;
        for (int parity = 0; parity < 2; parity++) {
            const int weight = parity ? around.weight + 2 * SIDE : max(around.weight, 1);
            row.scale[parity] = 1.0F / (float)weight;
            for (int n = 0; n < SIGNS; n++) {
                const uint32_t* const seen = agreed[band.kind][parity][n];
                row.odds[parity][n] = log16(16 * seen[0] + 32) - log16(16 * seen[1] + 32);
            }
        }
        int before = 0;
        for (int k = 0; k < band.blocks; k++)
            row.filled[k] = (uint8_t)code_block(band, row, group, k, before, far);
    }

    static int group_of(int kind) {
        const int plane = kind >> 2;
        return plane == 0 || plane == PLANE_OF_BASIS ? 0 : 1 + (plane - 1) % 3;
    }

    // One half of a block: the places of one parity.
    struct Half {
        int magnitudes[LANES], signs[LANES], around[SIGNS][LANES];
    };

    // Whether the block has an integer that is not 0. before: whether the block before it may.
    FHASH_INLINE int code_block(Band& band, const Row& row, int group, int number, int& before,
                                float far) {
        const int first = BLOCK * number, room = min(band.size[3] - first, BLOCK);
        uint16_t sums[BLOCK] = {};
        int flags_of = 0;
        if (near[(size_t)number]) {
            sum_block(first, sums);
            uint32_t total = 0;
            for (int i = 0; i < BLOCK; i++) total += sums[i];
            const float mean = (float)total * row.scale[0];  // of 16 vertices
            const int octaves = half_octaves(mean) - 2 * (127 - LOWEST_FLAG) + 1;
            if (total) flags_of = min(max(octaves, 1), FLAG_CLASSES);
        }
        if (flags_of < FLAG_CLASSES) {
            const int some = some_of(row, first, room, flags_of ? 0.5F : far);
            const int context = (group > 0) * 2 * FLAG_CLASSES + flags_of * 2 + before;
            before = flag(some, BLOCKS + context);
            if (!before) return 0;
        } else before = 1;
        Half halves[2];
        int level[LANES];
        for (int n = 0; n < 3; n++)
            for (int i = 0; i < LANES; i++) {
                halves[0].around[n][i] = row.signs_around[n][first + i];
                halves[1].around[n][i] = row.signs_around[n][first + LANES + i];
            }
        for (int i = 0; i < LANES; i++) level[i] = level_of((float)sums[2 * i] * row.scale[0]);
        code_half<3>(band, row, first, room, 0, group, level, halves[0]);
        int seen[LANES + 1];
        for (int i = 0; i < LANES; i++)
            seen[i] = min(halves[0].magnitudes[i] >> band.shift, LARGEST);
        seen[LANES] = 0;
        for (int i = 0; i < LANES; i++) {
            const int sum = sums[2 * i + 1] + SIDE * (seen[i] + seen[i + 1]);
            level[i] = level_of((float)sum * row.scale[1]);
            halves[1].around[3][i] = halves[0].signs[i];
            halves[1].around[4][i] = i + 1 < LANES ? halves[0].signs[i + 1] : 0;
        }
        code_half<5>(band, row, first, room, 1, group, level, halves[1]);
        int some = 0;
        uint8_t* const magnitudes = row.magnitudes + first;
        int8_t* const signs = row.signs + first;
        for (int i = 0; i < LANES; i++) {
            magnitudes[2 * i] = (uint8_t)seen[i];
            magnitudes[2 * i + 1] = (uint8_t)min(halves[1].magnitudes[i] >> band.shift, LARGEST);
            signs[i] = (int8_t)halves[0].signs[i];
            signs[LANES + i] = (int8_t)halves[1].signs[i];
            some |= halves[0].magnitudes[i] | halves[1].magnitudes[i];
        }
        return some != 0;
    }

    // The symbols of some contexts.
    FHASH_INLINE void decode_lanes(const int* contexts, int* symbols) {
        const uint32_t* const lookup = task.prior.lookup;
        uint32_t entries[LANES];
        for (int i = 0; i < LANES; i++)
            entries[i] = lookup[lookups[contexts[i]] | (state[i] & (SLOTS - 1))];
        FHASH_INDEPENDENT
        for (int i = 0; i < LANES; i++) {
            symbols[i] = (int)(entries[i] & (TOKENS - 1));
            state[i] = (entries[i] >> 16) * (state[i] >> PRECISION) + (entries[i] >> 4 & 0xfff);
        }
        // Each lane that is low reads a word, in their order.
        uint32_t needed[LANES], places[LANES], read = 0;
        FHASH_INDEPENDENT
        for (int i = 0; i < LANES; i++) needed[i] = state[i] < LEAST_STATE;
        for (int i = 0; i < LANES; i++) {
            places[i] = read;
            read += needed[i];
        }
        for (int i = 0; i < LANES; i++) {
            const uint8_t* const at = word + 2 * places[i];
            const uint32_t next = state[i] << 16 | (uint32_t)(at[0] | at[1] << 8);
            state[i] = needed[i] ? next : state[i];
        }
        word = min(word + 2 * read, end);
    }

    FHASH_INLINE void code_lanes(const int* contexts, const int* symbols) {
        for (int i = 0; i < LANES; i++) counts[contexts[i]][symbols[i]]++;
        if (!WRITES) return;
        steps.emplace_back();
        Step& step = steps.back();
        for (int i = 0; i < LANES; i++) {
            step.contexts[i] = (uint8_t)contexts[i];
            step.symbols[i] = (uint8_t)symbols[i];
        }
    }

    // Choose the magnitude that costs least: the nearest one, one less, or zero.
    FHASH_INLINE int choose(float size, int context) {
        size = size < 1e9F ? size : 1e9F;  // also for NaN
        const int nearest = (int)(size + 0.5F);
        int chosen = nearest;
        if (nearest && size < (float)nearest + lower[context][min(nearest, LAST)]) chosen--;
        if (chosen == 2 && size < zero_of_two[context]) chosen = 0;
        return chosen;
    }

    // Code the places of one parity in a block. NEAR: signs around that are looked at.
    template <int NEAR>
    FHASH_INLINE void code_half(Band& band, const Row& row, int first, int room, int parity,
                                int group, const int* level, Half& half) {
        int contexts[LANES], tokens[LANES], low[LANES], lows = 0;
        for (int i = 0; i < LANES; i++) {
            const bool inside = 2 * i + parity < room;
            contexts[i] = inside ? level[i] + (group * 2 + parity) * LEVELS : NOTHING;
            low[i] = inside ? band.shift + low_bits(level[i]) : 0;
            lows |= low[i];
        }
        int* const magnitudes = half.magnitudes;
        int negative[LANES];
        if constexpr (MODE == DECODE) {
            decode_lanes(contexts, tokens);
            int large = lows;
            for (int i = 0; i < LANES; i++) {
                magnitudes[i] = tokens[i];
                large |= tokens[i] >= DIRECT;
            }
            if (large)
                for (int i = 0; i < LANES; i++)
                    if (tokens[i] >= DIRECT || low[i])
                        magnitudes[i] = read_magnitude(tokens[i], low[i]);
        } else {
            int large = lows;
            for (int i = 0; i < LANES; i++) {
                const int x = first + 2 * i + parity;
                const bool inside = 2 * i + parity < room;
                magnitudes[i] = negative[i] = 0;
                if (inside && CHOOSES) {
                    const float size = std::fabs(row.values[x] * task.scale);
                    negative[i] = row.values[x] < 0;
                    magnitudes[i] = choose(size, contexts[i]);
                    const float rest = size - (float)magnitudes[i];
                    squares += rest * rest;
                    if (MODE == CHOOSE) row.q[x] = negative[i] ? -magnitudes[i] : magnitudes[i];
                } else if (inside) {
                    negative[i] = row.q[x] < 0;
                    magnitudes[i] = std::abs(row.q[x]);
                }
                tokens[i] = token_of(magnitudes[i] >> low[i]);
                large |= tokens[i] >= DIRECT;
            }
            code_lanes(contexts, tokens);
            if (large)
                for (int i = 0; i < LANES; i++)
                    if (tokens[i] >= DIRECT || low[i])
                        write_magnitude(magnitudes[i], tokens[i], low[i]);
        }
        int some = 0;
        for (int i = 0; i < LANES; i++) some |= magnitudes[i];
        for (int i = 0; i < LANES; i++) half.signs[i] = 0;
        if (some) code_signs<NEAR>(row, parity, negative, agreed[band.kind][parity], half);
        if constexpr (MODE == DECODE)
            for (int i = 0; i < LANES; i++)
                if (2 * i + parity < room)
                    row.q[first + 2 * i + parity] = magnitudes[i] * half.signs[i];
    }

    template <int NEAR>
    FHASH_INLINE void code_signs(const Row& row, int parity, const int* negative,
                                 uint32_t (*seen)[2], Half& half) {
        int contexts[LANES], differs[LANES], foretold[LANES], sums[LANES] = {};
        const int* const magnitudes = half.magnitudes;
        for (int n = 0; n < NEAR; n++)
            for (int i = 0; i < LANES; i++) sums[i] += half.around[n][i] * row.odds[parity][n];
        for (int i = 0; i < LANES; i++) {
            foretold[i] = sums[i] < 0;
            const int level = min(std::abs(sums[i]) >> SIGN_SHIFT, SIGN_LEVELS - 1);
            contexts[i] = magnitudes[i] ? OF_SIGNS + level : NOTHING;
        }
        if constexpr (MODE == DECODE) decode_lanes(contexts, differs);
        else {
            for (int i = 0; i < LANES; i++)
                differs[i] = (negative[i] ^ foretold[i]) & (magnitudes[i] != 0);
            code_lanes(contexts, differs);
        }
        int signs[LANES];
        for (int i = 0; i < LANES; i++)
            signs[i] = (1 - 2 * (differs[i] ^ foretold[i])) * (magnitudes[i] != 0);
        for (int n = 0; n < NEAR; n++) {
            int same = 0, other = 0;
            for (int i = 0; i < LANES; i++) {
                same += (half.around[n][i] * signs[i]) > 0;
                other += (half.around[n][i] * signs[i]) < 0;
            }
            seen[n][0] += (uint32_t)same;
            seen[n][1] += (uint32_t)other;
        }
        for (int i = 0; i < LANES; i++) half.signs[i] = signs[i];
    }

    FHASH_INLINE void write_magnitude(int magnitude, int token, int low) {
        const int high = magnitude >> low;
        int bits = low;
        if (token >= DIRECT) bits += token - DIRECT + 1;
        if (token == LAST) {
            const uint32_t rest = (uint32_t)(high - FIRST[LAST]) + (1u << LAST_BITS);
            const int length = significant(rest) - 1;
            bits += 2 * (length - LAST_BITS) + 1;
            if (WRITES) {
                out.put(1ull << (length - LAST_BITS), length - LAST_BITS + 1);
                out.put(rest & ((1u << length) - 1), length);
            }
        } else if (WRITES && token >= DIRECT) {
            out.put((uint64_t)(high - FIRST[token]), token - DIRECT + 1);
        }
        if (WRITES) out.put((uint64_t)magnitude & ((1ull << low) - 1), low);
        raw += bits;
    }

    FHASH_INLINE int read_magnitude(int token, int low) {
        uint64_t high = (uint64_t)token;
        if (token == LAST) {
            const uint64_t ahead = in.peek();
            int more = 0;
            while (more < MAX_LOW && !(ahead >> more & 1)) more++;
            const int length = min(more + LAST_BITS, 30);
            in.at += (uint64_t)more + 1;
            high = FIRST[LAST] + ((1ull << length) | in.take(length)) - (1u << LAST_BITS);
        } else if (token >= DIRECT) high = (uint64_t)FIRST[token] + in.take(token - DIRECT + 1);
        low = min(low, MAX_LOW);
        const uint64_t magnitude = high << low | in.take(low);
        if (magnitude > MAX_INTEGER) in.damaged = true;
        return (int)min<uint64_t>(magnitude, MAX_INTEGER);
    }

    FHASH_INLINE void run() {
        for (Band& band : task.bands) code_band(band);
    }
};

// The distribution of each context that takes the fewest bits for what was counted. Their bits.
double choose_distributions(const uint32_t (*counts)[TOKENS], const Prior& prior, uint8_t* chosen) {
    std::vector<float> bits((size_t)CERTAIN * TOKENS);
    for (int d = 0; d < CERTAIN; d++)
        for (int token = 0; token < TOKENS; token++) {
            const int slots = prior.slots[d][token];
            bits[(size_t)d * TOKENS + token] = slots ? PRECISION - std::log2((float)slots) : 1e6F;
        }
    double total = 0;
    for (int context = 0; context < CONTEXTS; context++) {
        const int first = context < OF_SIGNS ? 0 : CHOICES;
        double least = 0;
        chosen[context] = prior.defaults[context];
        for (int pass = -1; pass < CHOICES; pass++) {
            const int choice = pass < 0 ? prior.defaults[context] : pass;
            double sum = pass < 0 ? 0 : CHOICE_BITS;
            const float* const of = &bits[(size_t)(first + choice) * TOKENS];
            for (int token = 0; token < TOKENS; token++)
                sum += counts[context][token] * (double)of[token];
            if (pass >= 0 && sum >= least) continue;
            least = sum;
            chosen[context] = (uint8_t)choice;
        }
        total += least;
    }
    return total;
}

// The words of the lanes: the steps are coded backwards, so that they are read forwards.
std::vector<uint8_t> words_of(const std::vector<Step>& steps, const Prior& prior,
                              const uint8_t* chosen) {
    struct Symbol {
        uint32_t slots, first;
    };
    std::vector<Symbol> symbols((size_t)(CONTEXTS + 1) * TOKENS);
    for (int context = 0; context <= NOTHING; context++) {
        const int first_choice = context < OF_SIGNS ? 0 : CHOICES;
        const int d = context == NOTHING ? CERTAIN : chosen[context] + first_choice;
        uint32_t first = 0;
        for (int token = 0; token < TOKENS; token++) {
            symbols[(size_t)context * TOKENS + token] = {prior.slots[d][token], first};
            first += prior.slots[d][token];
        }
    }
    std::vector<uint8_t> data;
    if (steps.empty()) return data;
    uint32_t state[LANES];
    for (uint32_t& x : state) x = LEAST_STATE;
    for (size_t n = steps.size(); n-- > 0;)
        for (int i = LANES; i-- > 0;) {
            const Symbol& of = symbols[(size_t)steps[n].contexts[i] * TOKENS + steps[n].symbols[i]];
            if (of.slots == SLOTS) continue;
            uint32_t x = state[i];
            if (x >= (uint64_t)of.slots << (32 - PRECISION)) {
                data.push_back((uint8_t)(x >> 8));
                data.push_back((uint8_t)x);
                x >>= 16;
            }
            state[i] = (x / of.slots << PRECISION) + x % of.slots + of.first;
        }
    for (int i = LANES; i-- > 0;)
        for (int byte = 3; byte >= 0; byte--) data.push_back((uint8_t)(state[i] >> (8 * byte)));
    std::reverse(data.begin(), data.end());
    return data;
}

void put_section(std::vector<uint8_t>& to, const std::vector<uint8_t>& section) {
    uint64_t size = section.size();
    for (; size > 127; size >>= 7) to.push_back((uint8_t)(size | 128));
    to.push_back((uint8_t)size);
    to.insert(to.end(), section.begin(), section.end());
}

// The section at the start of some bytes, which are then those after it. False where there is none.
bool take_section(const uint8_t*& data, int64_t& size, const uint8_t*& section, int64_t& length) {
    uint64_t number = 0;
    for (int shift = 0;; shift += 7) {
        if (!size || shift > 56) return false;
        const uint8_t byte = *data++;
        size--;
        number |= (uint64_t)(byte & 127) << shift;
        if (byte < 128) break;
    }
    if (number > (uint64_t)size) return false;
    section = data;
    length = (int64_t)number;
    data += number;
    size -= length;
    return true;
}

template <Mode MODE>
FHASH_INLINE int64_t encode_into(Task& task, std::vector<uint8_t>& bytes, double* results) {
    std::vector<uint8_t> flag_bytes;
    const BitsIn none(nullptr, 0);
    FlagCoder<MODE> flag_coder;
    if constexpr (MODE != PRICE) flag_coder.out = &flag_bytes;
    const auto coder = std::make_unique<Coder<MODE>>(task, flag_coder, none);
    if (Coder<MODE>::CHOOSES) coder->weigh();
    coder->run();
    uint8_t chosen[CONTEXTS];
    results[0] = choose_distributions(coder->counts, task.prior, chosen) + (double)coder->raw;
    results[1] = coder->squares;
    if constexpr (MODE == PRICE) results[0] += (double)coder->range.bits / 2048;
    results[0] /= 8;
    if constexpr (MODE == PRICE) return 0;
    else coder->range.finish();
    BitsOut choices;
    for (int context = 0; context < CONTEXTS; context++) {
        const bool other = chosen[context] != task.prior.defaults[context];
        choices.put(other, 1);
        if (other) choices.put(chosen[context], CHOICE_BITS);
    }
    choices.finish();
    coder->out.finish();
    std::vector<uint8_t>& raw = coder->out.bytes;
    raw.insert(raw.begin(), choices.bytes.begin(), choices.bytes.end());
    while (!raw.empty() && !raw.back()) raw.pop_back();  // the decoder reads zeros past the end
    put_section(bytes, flag_bytes);
    put_section(bytes, raw);
    const std::vector<uint8_t> words = words_of(coder->steps, task.prior, chosen);
    bytes.insert(bytes.end(), words.begin(), words.end());
    return 0;
}

FHASH_INLINE int64_t decode_from(Task& task, const uint8_t* data, int64_t size) {
    const uint8_t *flags, *raw;
    int64_t flag_count, raw_count;
    if (!take_section(data, size, flags, flag_count) || !take_section(data, size, raw, raw_count))
        return -1;
    const auto coder =
        std::make_unique<Coder<DECODE>>(task, Decoder(flags, flag_count), BitsIn(raw, raw_count));
    for (int context = 0; context < CONTEXTS; context++) {
        uint32_t choice = task.prior.defaults[context];
        if (coder->in.take(1)) choice = coder->in.take(CHOICE_BITS);
        coder->lookups[context] = (choice + (context < OF_SIGNS ? 0 : CHOICES)) << PRECISION;
    }
    coder->lookups[NOTHING] = (uint32_t)CERTAIN << PRECISION;
    coder->in.at = (coder->in.at + 7) & ~7ull;
    coder->words.assign((size_t)size + 4 * LANES + 2 * LANES, 0);
    if (size) std::memcpy(coder->words.data(), data, (size_t)size);
    coder->word = coder->words.data();
    for (uint32_t& x : coder->state)
        for (int byte = 0; byte < 4; byte++) x |= (uint32_t)*coder->word++ << (8 * byte);
    coder->end = coder->words.data() + max<int64_t>(size, 4 * LANES);
    coder->run();
    return coder->in.damaged ? -1 : 0;
}

FHASH_TWO_CLONES int64_t encode(Task& task, std::vector<uint8_t>& bytes, double* results) {
    return guarded([&]() FHASH_LAMBDA { return encode_into<ENCODE>(task, bytes, results); });
}
FHASH_TWO_CLONES int64_t choose(Task& task, std::vector<uint8_t>& bytes, double* results) {
    return guarded([&]() FHASH_LAMBDA { return encode_into<CHOOSE>(task, bytes, results); });
}
FHASH_TWO_CLONES int64_t price(Task& task, std::vector<uint8_t>& bytes, double* results) {
    return guarded([&]() FHASH_LAMBDA { return encode_into<PRICE>(task, bytes, results); });
}
FHASH_TWO_CLONES int64_t decode(Task& task, const uint8_t* data, int64_t size) {
    return guarded([&]() FHASH_LAMBDA { return decode_from(task, data, size); });
}

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (transform/lifting.py), or
// foretell what that takes. Integers outside the bands count as 0.
//
// values, scale, weight: null, or what integers are chosen of: values times scale, in steps, where
// a bit is worth so many squared steps. q receives them, and must be zeros; without q they are
// priced.
// table: (count, COLUMNS). slots, defaults: the prior (transform/coder.py).
// data: receives the bytes if they fit the capacity. If they do not, call again with more room.
// results: receives the bytes that are foretold, and where integers are chosen the sum of the
// squared errors, in squared steps.
//
// Returns the number of bytes (0 for a price), -1 for a band beyond the shape, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_fast_encode(int32_t* q, const float* values, double scale, double weight,
                                       const int64_t* shape, const int32_t* table, int64_t count,
                                       const uint16_t* slots, const uint8_t* defaults,
                                       uint8_t* data, int64_t capacity, double* results) {
    return guarded([&]() -> int64_t {
        const Prior prior = {reinterpret_cast<const uint16_t(*)[TOKENS]>(slots), defaults, nullptr};
        std::vector<Band> bands((size_t)count);
        Task task = {q, values, (float)scale, weight, shape, prior, bands};
        if (!read_bands(table, shape, task.bands)) return -1;
        std::vector<uint8_t> bytes;
        const int64_t code = !q ? price(task, bytes, results)
                             : values ? choose(task, bytes, results)
                                      : encode(task, bytes, results);
        if (code < 0) return code;
        if ((int64_t)bytes.size() <= capacity && !bytes.empty())
            std::memcpy(data, bytes.data(), bytes.size());
        return (int64_t)bytes.size();
    });
}

// Decode integers into q, which must be zeros. lookup: (DISTRIBUTIONS, SLOTS) of the prior.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_fast_decode(int32_t* q, const int64_t* shape, const int32_t* table,
                                       int64_t count, const uint8_t* defaults,
                                       const uint32_t* lookup, const uint8_t* data, int64_t size) {
    return guarded([&]() -> int64_t {
        const Prior prior = {nullptr, defaults, lookup};
        Task task = {q, nullptr, 0, 0, shape, prior, std::vector<Band>((size_t)count)};
        if (!read_bands(table, shape, task.bands)) return -1;
        return decode(task, data, size);
    });
}
