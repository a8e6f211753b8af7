// Blocks of a tile (blocks.hpp): where they lie, their decoding, and what a part of a tile needs.
#include "blocks.hpp"

#include <algorithm>

#include "memory.hpp"
#include "region.hpp"

namespace fhash {
namespace {

// How far the values of a wavelet reach: to numbers of the low band and of the high one that lie so
// many vertices away (lifting.hpp).
struct Reach {
    int64_t low, high;
};
Reach reach_of(int kind) {
    if (kind == HAAR_KIND) return {0, 0};
    return kind == LEGALL_KIND ? Reach{1, 2} : Reach{3, 4};
}

int64_t floor_half(int64_t n) { return n >> 1; }
int64_t ceil_half(int64_t n) { return (n + 1) >> 1; }

bool is_wavelet(const AxisTransform* axes, size_t axis) { return axes && axes[axis].wavelet(); }
bool is_whole(const AxisTransform* axes, size_t axis) {
    return axes && axes[axis].kind == KLT_KIND;
}

// Blocks along an axis.
struct Axis {
    int64_t n, length, count;

    Axis(int64_t vertices, int log) : n(vertices), length(log ? int64_t(1) << log : n) {
        count = std::max<int64_t>(1, (n + length / 2) / length);
    }
    int64_t first(int64_t block) const { return block * length; }
    int64_t last(int64_t block) const { return block + 1 < count ? first(block + 1) : n; }
    int64_t block_at(int64_t vertex) const { return std::min(vertex / length, count - 1); }
};

bool is_within(const Box& block, const Box& box) {
    for (size_t a = 0; a < 4; a++)
        if (block.first[a] < box.first[a] || block.last[a] > box.last[a]) return false;
    return true;
}

// Integers of some blocks of a tile into a box of it.
struct BlockReader {
    const BlockCoding& coding;
    const Box& box;
    int32_t* const out;

    // counts: of the first bands of each block that are decoded.
    bool run(int threads, const std::vector<Box>& blocks, const std::vector<Bytes>& bytes,
             const std::vector<size_t>& counts, fhash_error& error) const {
        std::fill_n(out, vertices(box.shape()), 0);
        return each_of(threads, blocks.size(), error, [&](size_t i, fhash_error& failed) {
            return counts[i] == 0 || read(blocks[i], bytes[i], counts[i], failed);
        });
    }

    bool read(const Box& block, Bytes bytes, size_t count, fhash_error& error) const {
        const Shape shape = block.shape();
        Table table = block_table(coding.axes, shape);
        table.resize(std::min(table.size(), count * TABLE_COLUMNS));
        std::vector<int32_t> integers;
        make_room(integers, (size_t)vertices(shape));
        if (!decode_integers(bytes.at, bytes.left(), shape, table, coding.trellis, coding.fast,
                             integers.data(), error))
            return false;
        BlockPlaces(coding.axes, box.shape(), relative(block, box)).scatter(integers.data(), out);
        return true;
    }
};

}  // namespace

bool fits(const Cut& cut, const AxisTransform* axes) {
    for (size_t a = 0; a < 4; a++)
        if (cut[a] && (is_whole(axes, a) || (axes && cut[a] < axes[a].depth))) return false;
    return true;
}

size_t count_blocks(const Shape& shape, const Cut& cut) {
    size_t count = 1;  // at most that of the vertices
    for (size_t a = 0; a < 4; a++) count *= (size_t)Axis(shape[a], cut[a]).count;
    return count;
}

std::vector<Box> blocks_of(const Shape& shape, const Cut& cut) {
    std::vector<Box> blocks = {{{}, {}}};
    for (size_t a = 0; a < 4; a++) {
        const Axis axis(shape[a], cut[a]);
        std::vector<Box> finer;
        for (Box block : blocks)
            for (int64_t i = 0; i < axis.count; i++) {
                block.first[a] = axis.first(i);
                block.last[a] = axis.last(i);
                finer.push_back(block);
            }
        blocks = std::move(finer);
    }
    return blocks;
}

std::array<BandHalf, 4> halves_of(const AxisTransform* axes, const Shape& shape,
                                  const int32_t* row) {
    std::array<BandHalf, 4> halves = {};
    for (size_t a = 0; a < 4; a++) {
        if (!is_wavelet(axes, a)) continue;
        const auto lengths = band_lengths(shape[a], axes[a].depth);
        BandHalf& half = halves[a];
        half.high = row[a] > 0;
        half.level = (size_t)axes[a].depth;
        // A short axis has one length after several levels, but one high half that begins there.
        while (half.high && (lengths[half.level] != row[a] ||
                             lengths[half.level - 1] != row[4 + a]))
            half.level--;
    }
    // Of coupled axes a low half is that of the level of the other one.
    if (axes && is_coupled(axes[2], axes[3]) && halves[2].high != halves[3].high)
        halves[2].level = halves[3].level = halves[halves[2].high ? 2 : 3].level;
    return halves;
}

BlockPlaces::BlockPlaces(const AxisTransform* axes, const Shape& tile, const Box& box)
    : whole(tile), own(box.shape()) {
    const Table table = block_table(axes, own);
    std::vector<int64_t> lengths[4];
    for (size_t a = 0; a < 4; a++)
        lengths[a] = band_lengths(tile[a], is_wavelet(axes, a) ? axes[a].depth : 0);
    for (size_t at = 0; at < table.size(); at += TABLE_COLUMNS) {
        const int32_t* const row = &table[at];
        const auto halves = halves_of(axes, own, row);
        Band band;
        for (size_t a = 0; a < 4; a++) {
            const BandHalf& half = halves[a];
            band.in_box[a] = row[a];
            band.size[a] = row[4 + a] - row[a];
            band.in_tile[a] = (box.first[a] >> half.level) +
                              (half.high ? lengths[a][half.level] : 0);
        }
        bands.push_back(band);
    }
}

bool each_of(int threads, size_t count, fhash_error& error,
             const std::function<bool(size_t, fhash_error&)>& work) {
    const size_t workers = std::max<size_t>(1, std::min((size_t)std::max(threads, 1), count));
    std::vector<fhash_error> errors(workers);
    std::vector<uint8_t> good(workers, 1);
    const auto run = [&](int worker) {
        const size_t number = (size_t)worker;
        for (size_t i = number; i < count && good[number]; i += workers)
            good[number] = work(i, errors[number]);
    };
    together((int)workers, run);
    for (size_t i = 0; i < workers; i++) {
        if (good[i]) continue;
        error = errors[i];
        return false;
    }
    return true;
}

Table block_table(const AxisTransform* axes, const Shape& shape) {
    return axes ? band_table(axes, shape) : single_band(shape);
}

bool split_blocks(Bytes all, size_t count, std::vector<Bytes>& blocks, fhash_error& error) {
    std::vector<uint64_t> lengths(count, 0);
    for (size_t i = 0; i + 1 < count; i++)
        if (!all.leb(lengths[i]))
            return fail(error, FHASH_ERROR_DAMAGED, "the blocks of a tile are cut short");
    // The last length is that of all that is left; what the others take is not.
    uint64_t others = 0;
    for (size_t i = 0; i + 1 < count; i++) others += lengths[i];
    if (others > all.left())
        return fail(error, FHASH_ERROR_DAMAGED, "the blocks of a tile are cut short");
    lengths.back() = all.left() - others;
    for (const uint64_t length : lengths) {
        blocks.push_back({all.at, all.at + length});
        all.at += length;
    }
    return true;
}

int64_t bands_within(const Table& table, const Shape& corner) {
    int64_t count = 0;
    for (int64_t band = 0; band < (int64_t)table.size() / TABLE_COLUMNS; band++) {
        bool within = true;
        for (size_t a = 0; a < 4; a++)
            within = within && table[(size_t)(band * TABLE_COLUMNS) + a] < corner[a];
        if (within) count = band + 1;
    }
    return count;
}

bool decode_blocks(const BlockCoding& coding, int lod, int threads, Bytes bytes, int32_t* out,
                   fhash_error& error) {
    const std::vector<Box> blocks = blocks_of(coding.shape, coding.cut);
    std::vector<Bytes> sections;
    if (!split_blocks(bytes, blocks.size(), sections, error)) return false;
    std::vector<size_t> counts(blocks.size(), SIZE_MAX);
    for (size_t i = 0; lod && i < blocks.size(); i++) {
        Shape corner = blocks[i].shape();
        const Table table = block_table(coding.axes, corner);
        for (size_t a = 1; a < 4; a++) {
            const int depth = is_wavelet(coding.axes, a) ? coding.axes[a].depth : 0;
            corner[a] = band_lengths(corner[a], std::min(lod, depth)).back();
        }
        counts[i] = (size_t)bands_within(table, corner);
    }
    const Box all = {{}, coding.shape};
    return BlockReader{coding, all, out}.run(threads, blocks, sections, counts, error);
}

Need::Need(const AxisTransform* axes, const Shape& shape, const Cut& cut, const Box& part) {
    for (size_t a = 0; a < 4; a++) {
        const Axis axis(shape[a], cut[a]);
        Ends at = {part.first[a], part.last[a]}, all = at;  // in vertices
        levels[a].push_back({at, {0, 0}});
        const int depth = is_wavelet(axes, a) ? axes[a].depth : 0;
        const auto lengths = band_lengths(shape[a], depth);
        for (int l = 1; l <= depth; l++) {
            const Reach reach = reach_of(axes[a].kind);
            const int64_t low = lengths[(size_t)l], high = lengths[(size_t)l - 1] - low;
            const int64_t first = at.low, last = at.high - 1;
            const bool haar = axes[a].kind == HAAR_KIND;
            Level level;
            level.low = {haar ? floor_half(first) : ceil_half(first - reach.low),
                         floor_half(last + reach.low) + 1};
            level.high = {haar ? floor_half(first) : ceil_half(first - reach.high - 1),
                          floor_half(haar ? last : last + reach.high - 1) + 1};
            level.low = {std::max<int64_t>(level.low.low, 0), std::min(level.low.high, low)};
            level.high = {std::max<int64_t>(level.high.low, 0), std::min(level.high.high, high)};
            levels[a].push_back(level);
            for (const Ends& ends : {level.low, level.high}) {
                if (ends.low >= ends.high) continue;
                all.low = std::min(all.low, ends.low << l);
                all.high = std::max(all.high, std::min(((ends.high - 1) << l) + 1, shape[a]));
            }
            at = level.low;
        }
        if (is_whole(axes, a)) all = {0, shape[a]};
        box.first[a] = axis.first(axis.block_at(all.low));
        box.last[a] = axis.last(axis.block_at(all.high - 1));
    }
}

size_t Need::bands(const AxisTransform* axes, const Box& block, const Table& table) const {
    const Shape shape = block.shape();
    for (size_t band = table.size() / TABLE_COLUMNS; band > 0; band--) {
        const int32_t* const row = &table[(band - 1) * TABLE_COLUMNS];
        const auto halves = halves_of(axes, shape, row);
        bool needed = true;
        for (size_t a = 0; a < 4; a++) {
            if (is_whole(axes, a)) continue;
            const Level& level = levels[a][halves[a].level];
            const Ends ends = halves[a].high ? level.high : level.low;
            const int64_t first = block.first[a] >> halves[a].level;
            needed = needed && ends.low - first < row[4 + a] - row[a] && ends.high > first;
        }
        if (needed) return band;
    }
    return 0;
}

bool decode_needed(const BlockCoding& coding, const Need& need, int threads, Bytes bytes,
                   int32_t* out, fhash_error& error) {
    const std::vector<Box> blocks = blocks_of(coding.shape, coding.cut);
    std::vector<Bytes> sections;
    if (!split_blocks(bytes, blocks.size(), sections, error)) return false;
    std::vector<size_t> counts;
    for (const Box& block : blocks) {
        const bool within = is_within(block, need.box);
        counts.push_back(
            within ? need.bands(coding.axes, block, block_table(coding.axes, block.shape())) : 0);
    }
    return BlockReader{coding, need.box, out}.run(threads, blocks, sections, counts, error);
}

int64_t count_needed(const BlockCoding& coding, const Need& need) {
    int64_t count = 0;
    for (const Box& block : blocks_of(coding.shape, coding.cut)) {
        if (!is_within(block, need.box)) continue;
        const Table table = block_table(coding.axes, block.shape());
        const size_t bands = need.bands(coding.axes, block, table);
        for (size_t band = 0; band < bands; band++) {
            const int32_t* const row = &table[band * TABLE_COLUMNS];
            int64_t size = 1;
            for (size_t a = 0; a < 4; a++) size *= row[4 + a] - row[a];
            count += size;
        }
    }
    return count;
}

}  // namespace fhash
