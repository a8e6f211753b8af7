// The coder of labels: any bytes decode to labels below the count, and what it encodes comes back.
#include <algorithm>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

using Bytes = std::vector<std::uint8_t>;

using Labels = std::vector<std::uint16_t>;

struct Tile {
    std::vector<int64_t> shape;
    int64_t count;  // of different labels
};

Labels decoded(const Tile& tile, const Bytes& data) {
    Labels labels(static_cast<std::size_t>(volume(tile.shape)), 255);
    const int64_t code = fhash_decode_labels(labels.data(), tile.count, tile.shape.data(),
                                             data.data(), static_cast<int64_t>(data.size()));
    require(code == 0, "bytes that are refused");
    for (const int64_t label : labels) require(label < tile.count, "a label that does not exist");
    return labels;
}

// The bytes of labels, by a first call with little room and a second one with as much as it asked
// for. The coder may write to its labels.
Bytes encoded(const Tile& tile, const Labels& labels, std::size_t room) {
    Bytes data(room);
    Labels work;
    const auto encode = [&] {
        work = labels;
        return fhash_encode_labels(work.data(), tile.count, tile.shape.data(), data.data(),
                                   static_cast<int64_t>(data.size()));
    };
    const int64_t size = encode();
    require(size >= 0, "labels that are refused");
    require(work == labels, "labels that the encoder changed");
    if (static_cast<std::size_t>(size) > room) {
        data.assign(static_cast<std::size_t>(size), 0);
        require(encode() == size, "another size the second time");
    }
    data.resize(static_cast<std::size_t>(size));
    data.shrink_to_fit();
    return data;
}

// Labels below a count in regions, of which the input says how long they are along x, y, z and t,
// and which vertices have a label of their own.
Labels drawn(Reader& in, const Tile& tile) {
    int64_t lengths[4];
    for (int64_t& length : lengths) length = in.within(1, 40);
    using Label = std::uint16_t;
    const Labels palette = in.numbers<Label>(16), others = in.numbers<Label>(8);
    const std::uint8_t noise = in.byte();
    Labels labels;
    std::size_t at = 0;
    for (int64_t t = 0; t < tile.shape[0]; t++)
        for (int64_t z = 0; z < tile.shape[1]; z++)
            for (int64_t y = 0; y < tile.shape[2]; y++)
                for (int64_t x = 0; x < tile.shape[3]; x++, at++) {
                    const int64_t region = x / lengths[0] + 3 * (y / lengths[1]) +
                                           5 * (z / lengths[2]) + 7 * (t / lengths[3]);
                    const bool alone = (at * 167 + at / 13) % 256 < noise;
                    const Label label =
                        alone ? static_cast<Label>(others[at % 8] + at / 8)
                              : palette[static_cast<std::size_t>(region) % palette.size()];
                    labels.push_back(static_cast<Label>(label % tile.count));
                }
    return labels;
}

Tile tile_of(Reader& in) {
    Tile tile;
    // Rows of up to three segments.
    for (const int64_t most : {4, 4, 6, 40}) tile.shape.push_back(in.within(1, most));
    // A byte, and another one that counts where it is odd: as many tiles of few labels as of many.
    const int64_t low = in.byte(), high = in.byte();
    tile.count = 1 + low + (high % 2 ? 256 * high : 0);
    return tile;
}

}  // namespace

void decode_label_bytes(Reader& in) {
    const Tile tile = tile_of(in);
    decoded(tile, in.rest());
}

void label_round_trip(Reader& in) {
    const Tile tile = tile_of(in);
    const std::size_t room = in.byte();
    const auto labels = drawn(in, tile);
    require(decoded(tile, encoded(tile, labels, room)) == labels, "other labels");
}
