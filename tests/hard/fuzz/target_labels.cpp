// The coder of labels: any bytes decode to labels below the count, and what it encodes comes back.
#include <algorithm>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

using Bytes = std::vector<std::uint8_t>;

// The coder of up to 256 labels.
struct Narrow {
    using Labels = std::vector<std::uint8_t>;
    static const State& state() { return setups().labels; }
    static constexpr auto encode = fhash_encode_labels;
    static constexpr auto decode = fhash_decode_labels;
};

// The coder of more labels.
struct Wide {
    using Labels = std::vector<std::uint16_t>;
    static const State& state() { return setups().wide_labels; }
    static constexpr auto encode = fhash_encode_wide_labels;
    static constexpr auto decode = fhash_decode_wide_labels;
};

struct Tile {
    std::vector<int64_t> shape;
    int64_t count;  // of different labels
};

template <class Coder> typename Coder::Labels decoded(const Tile& tile, const Bytes& data) {
    const State& blank = Coder::state();
    typename Coder::Labels labels(static_cast<std::size_t>(volume(tile.shape)), 255);
    const int64_t code = Coder::decode(
        labels.data(), tile.count, tile.shape.data(), blank.slots.data(),
        static_cast<int64_t>(blank.slots.size() / 4), blank.weights.data(),
        static_cast<int64_t>(blank.weights.size()), blank.simples.data(),
        static_cast<int64_t>(blank.simples.size() / 2), data.data(),
        static_cast<int64_t>(data.size()));
    require(code == 0, "bytes that are refused");
    for (const int64_t label : labels) require(label < tile.count, "a label that does not exist");
    return labels;
}

// The bytes of labels, by a first call with little room and a second one with as much as it asked
// for. The coder may write to its labels.
template <class Coder>
Bytes encoded(const Tile& tile, const typename Coder::Labels& labels, std::size_t room) {
    const State& blank = Coder::state();
    Bytes data(room);
    typename Coder::Labels work;
    const auto encode = [&] {
        work = labels;
        return Coder::encode(
            work.data(), tile.count, tile.shape.data(), blank.slots.data(),
            static_cast<int64_t>(blank.slots.size() / 4), blank.weights.data(),
            static_cast<int64_t>(blank.weights.size()), blank.simples.data(),
            static_cast<int64_t>(blank.simples.size() / 2), data.data(),
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
template <class Labels> Labels drawn(Reader& in, const Tile& tile) {
    int64_t lengths[4];
    for (int64_t& length : lengths) length = in.within(1, 40);
    using Label = typename Labels::value_type;
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
    // A byte, and another one that counts where it is odd: as many narrow tiles as wide ones.
    const int64_t low = in.byte(), high = in.byte();
    tile.count = 1 + low + (high % 2 ? 256 * high : 0);
    return tile;
}

template <class Coder> void round_trip(Reader& in, const Tile& tile) {
    const std::size_t room = in.byte();
    const auto labels = drawn<typename Coder::Labels>(in, tile);
    require(decoded<Coder>(tile, encoded<Coder>(tile, labels, room)) == labels, "other labels");
}

}  // namespace

void decode_label_bytes(Reader& in) {
    const Tile tile = tile_of(in);
    if (tile.count > 256) decoded<Wide>(tile, in.rest());
    else decoded<Narrow>(tile, in.rest());
}

void label_round_trip(Reader& in) {
    const Tile tile = tile_of(in);
    if (tile.count > 256) round_trip<Wide>(in, tile);
    else round_trip<Narrow>(in, tile);
}
