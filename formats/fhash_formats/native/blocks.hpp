// Blocks of a tile: boxes of its vertices whose coefficients are coded alone, so that a part of the
// tile needs some of them (FORMAT.md, Blocks).
//
// A block is as long as a power of two along each axis that is cut, not less than 2^depth of the
// axis's wavelet. Its coefficients are those whose vertices lie in it: the bands of a tile of its
// own shape, each a box of a band of the tile.
#pragma once

#include <algorithm>
#include <functional>

#include "plan.hpp"

namespace fhash {

// Logarithms of the lengths of blocks along t, z, y, x, to the base 2; 0 where an axis is whole.
using Cut = std::array<uint8_t, 4>;
constexpr size_t CUT_BYTES = 2;     // four bits for each axis
constexpr size_t MAX_BLOCKS = 1024;  // of a tile: each begins with a state of a MiB

inline bool is_cut(const Cut& cut) { return cut != Cut{}; }
// Whether blocks hold whole coefficients of a transform.
bool fits(const Cut& cut, const AxisTransform* axes);

// A box: first vertices along t, z, y, x, and those after the last.
struct Box {
    Shape first, last;

    Shape shape() const {
        return {last[0] - first[0], last[1] - first[1], last[2] - first[2], last[3] - first[3]};
    }
};

size_t count_blocks(const Shape& shape, const Cut& cut);
// The blocks in the order in which they are coded, t first. What is left of an axis is a block of
// its own if it is at least half as long as the others, else a part of the last one.
std::vector<Box> blocks_of(const Shape& shape, const Cut& cut);

// Whether coefficients are those of a low half of an axis, and after how many levels.
struct BandHalf {
    bool high;
    size_t level;
};
// The halves of a band of a tile or a block of a shape. axes: those of the transform; null for
// numbers that were not transformed. row: of its table.
std::array<BandHalf, 4> halves_of(const AxisTransform* axes, const Shape& shape,
                                  const int32_t* row);

// Where the coefficients of a box, which begins and ends where blocks do, lie among those of a
// tile.
class BlockPlaces {
public:
    // axes: as above.
    BlockPlaces(const AxisTransform* axes, const Shape& tile, const Box& box);

    template <class N> void gather(const N* tile, N* box) const {
        each_run([&](int64_t from, int64_t to, int64_t count) {
            std::copy_n(tile + from, count, box + to);
        });
    }
    template <class N> void scatter(const N* box, N* tile) const {
        each_run([&](int64_t to, int64_t from, int64_t count) {
            std::copy_n(box + from, count, tile + to);
        });
    }

private:
    // First coefficients of a band in the tile and in the box, and its lengths.
    struct Band {
        Shape in_tile, in_box, size;
    };
    Shape whole, own;  // of the tile and of the box
    std::vector<Band> bands;

    // Calls work(in the tile, in the box, count) for each row of each band.
    template <class Work> void each_run(Work work) const {
        const auto place = [](const Shape& of, const Shape& first, int64_t t, int64_t z,
                              int64_t y) {
            return (((first[0] + t) * of[1] + first[1] + z) * of[2] + first[2] + y) * of[3] +
                   first[3];
        };
        for (const Band& band : bands)
            for (int64_t t = 0; t < band.size[0]; t++)
                for (int64_t z = 0; z < band.size[1]; z++)
                    for (int64_t y = 0; y < band.size[2]; y++)
                        work(place(whole, band.in_tile, t, z, y),
                             place(own, band.in_box, t, z, y), band.size[3]);
    }
};

// The bands of a block of a shape. axes: as above.
Table block_table(const AxisTransform* axes, const Shape& shape);

// Calls work(number, error) for each number from 0 to before `count`, in so many threads; false
// where one of the calls is.
bool each_of(int threads, size_t count, fhash_error& error,
             const std::function<bool(size_t, fhash_error&)>& work);

// What the integers of blocks share.
struct BlockCoding {
    const AxisTransform* axes;  // null for numbers that were not transformed
    Shape shape;                // of the tile
    Cut cut;
    bool trellis, fast;
};

// The sections of blocks in the bytes of all: lengths of all but the last one, then the bytes.
bool split_blocks(Bytes all, size_t count, std::vector<Bytes>& blocks, fhash_error& error);

// How many of the first bands of a table hold the coefficients of a corner of a shape.
int64_t bands_within(const Table& table, const Shape& corner);

// The integers of a tile from its blocks, by so many threads; of a level of detail at least those
// that it needs. `out` need not be zeros.
bool decode_blocks(const BlockCoding& coding, int lod, int threads, Bytes bytes, int32_t* out,
                   fhash_error& error);

// The way from a part of the values of a tile back to what it depends on.
struct Need {
    struct Ends {
        int64_t low, high;
    };
    struct Level {
        Ends low, high;  // indices in the low band after so many levels, and in the high band
    };
    Box box;                       // of whole blocks, with all that is needed
    std::vector<Level> levels[4];  // of wavelets; the first has the part itself as low band

    Need(const AxisTransform* axes, const Shape& shape, const Cut& cut, const Box& part);
    // How many of the first bands of a block are needed. table: its bands.
    size_t bands(const AxisTransform* axes, const Box& block, const Table& table) const;
};

// The integers of a box of blocks, as those of a tile of its shape; those that are not needed may
// be zeros.
bool decode_needed(const BlockCoding& coding, const Need& need, int threads, Bytes bytes,
                   int32_t* out, fhash_error& error);
// How many integers `decode_needed` decodes.
int64_t count_needed(const BlockCoding& coding, const Need& need);

}  // namespace fhash
