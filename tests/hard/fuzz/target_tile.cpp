// A target for whole tiles: hostile bytes as streams, settings, values and options.
//
// Streams get the checksum of what they are, since else nothing behind it would be reached.
#include <cmath>
#include <cstring>

#include "encode.hpp"
#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

namespace {

using Bytes = std::vector<std::uint8_t>;

const std::int64_t MOST = 1 << 13, MOST_ENCODED = 1 << 9;  // vertices

fhash_context* context() {
    static fhash_context* const one = fhash_context_create(1 << 28, 2);
    return one;
}

void is_told(std::int32_t status) {
    require(status == FHASH_OK || status == FHASH_ERROR_DAMAGED || status == FHASH_ERROR_MEMORY ||
                status == FHASH_ERROR_ARGUMENT,
            "a status that cannot be");
}

std::size_t room(const fhash_tile& tile, std::int32_t lod = 0) {
    std::int64_t n = tile.shape[0];
    for (int a = 1; a < 4; a++) n *= (tile.shape[a] + (std::int64_t{1} << lod) - 1) >> lod;
    return static_cast<std::size_t>(n);
}

Bytes decoded(const fhash_tile& tile, const Bytes& stream) {
    Bytes values(room(tile) * fhash_type_size(tile.type));
    fhash_error error;
    const std::int32_t status = fhash_tile_decode(context(), &tile, stream.data(), stream.size(), 0,
                                                  values.data(), nullptr, &error);
    require(status == FHASH_OK, error.text);
    return values;
}

void decode(const fhash_tile& tile, const Bytes& stream, std::int32_t lod, bool masked) {
    Bytes values(room(tile, lod) * fhash_type_size(tile.type)), mask(masked ? room(tile) : 0);
    is_told(fhash_tile_decode(context(), &tile, stream.data(), stream.size(), lod, values.data(),
                              masked ? mask.data() : nullptr, nullptr));
    for (const std::uint8_t each : mask) require(each < 2, "a mask is 0 or 1");
    std::vector<double> table(room(tile, lod));
    std::int32_t wide;
    std::uint64_t origin[2];
    is_told(fhash_tile_table(context(), &tile, stream.data(), stream.size(), lod, table.data(),
                             &wide, origin, nullptr));
}

void decode_part(Reader& in, const fhash_tile& tile, const Bytes& stream) {
    std::int64_t part[8];
    std::size_t n = 1;
    for (int a = 0; a < 4; a++) {
        part[2 * a] = stream.empty() ? 0 : stream[static_cast<std::size_t>(a) % stream.size()] %
                                               tile.shape[a];
        part[2 * a + 1] = std::min(part[2 * a] + 1 + in.byte() % 4, tile.shape[a]);
        n *= static_cast<std::size_t>(part[2 * a + 1] - part[2 * a]);
    }
    std::vector<float> table(room(tile));
    std::int32_t done;
    is_told(fhash_tile_uncorrected(context(), &tile, stream.data(), stream.size(), part,
                                   table.data(), &done, nullptr));
    Bytes values(n * fhash_type_size(tile.type));
    is_told(fhash_tile_region(context(), &tile, stream.data(), stream.size(), part, values.data(),
                              &done, nullptr));
    is_told(fhash_tile_part(context(), &tile, table.data(), part, values.data(), nullptr));
}

// What only looks at a tile.
void look(Reader& in, const fhash_tile& tile) {
    const std::int64_t n = static_cast<std::int64_t>(room(tile));
    std::vector<double> values = repeated<double>(in, n), out(values.size());
    for (double& value : values) value = std::isfinite(value) ? value : 1.0;
    is_told(fhash_tile_forward(context(), &tile, values.data(), out.data(), nullptr));
    const Bytes counted = repeated<std::uint8_t>(in, n);
    Bytes marks(counted), finite(counted);
    for (std::size_t i = 0; i < marks.size(); i++) {
        marks[i] = counted[i] & 1;
        finite[i] = marks[i] | (counted[i] >> 1 & 1);
    }
    is_told(fhash_tile_fill(context(), &tile, marks.data(), finite.data(), in.byte() % 3,
                            values.data(), nullptr));
    std::vector<std::int32_t> whole = integers(in, n);
    for (std::int32_t& each : whole) each %= 1 << 27;
    std::int64_t size;
    is_told(fhash_tile_foretold(context(), &tile, whole.data(), marks.data(), &size, nullptr));
    for (std::int32_t& each : whole) each %= 1 << 12;
    Bytes block(static_cast<std::size_t>(8 * n + 4096));
    size = fhash_encode_block(whole.data(), tile.shape, block.data(), 8 * n + 4096);
    std::vector<std::int32_t> again(whole.size());
    require(!fhash_decode_block(block.data(), size, tile.shape, again.data()) && again == whole,
            "a block differs");
    fhash_decode_block(counted.data(), n, tile.shape, again.data());
}

// Encoders keep their promise, and know what is decoded.
template <class T> void keeps(const Bytes& values, const Bytes& found, double error) {
    std::vector<T> a(values.size() / sizeof(T)), b(a);
    std::memcpy(a.data(), values.data(), values.size());
    std::memcpy(b.data(), found.data(), found.size());
    for (std::size_t i = 0; i < a.size(); i++)
        require(std::isfinite(a[i]) ? std::abs(double(a[i]) - double(b[i])) <= error
                                    : std::isnan(a[i]) ? std::isnan(b[i]) : a[i] == b[i],
                "a bound is not kept");
}

void encode(Reader& in, const fhash_tile& tile) {
    fhash_quality quality = {-1, 0, 0, static_cast<std::int32_t>(in.within(1, 3)), 0, {}, 0};
    const double number = std::abs(in.finite<double>());
    const int kind = in.byte() % 3;
    (kind ? kind == 1 ? quality.max_error_rel : quality.step : quality.max_error) = number;
    const bool filled = in.byte() & 1;
    const Bytes fill = in.numbers<std::uint8_t>(8);
    const std::int64_t bytes =
        static_cast<std::int64_t>(room(tile) * fhash_type_size(tile.type));
    const Bytes values = repeated<std::uint8_t>(in, bytes);
    Bytes stream(fhash_tile_bound(&tile));
    std::size_t size = 0;
    const std::int32_t status =
        fhash_tile_encode(context(), &tile, values.data(), &quality, filled ? fill.data() : nullptr,
                          stream.data(), stream.size(), &size, nullptr);
    is_told(status);
    if (status) return;
    stream.resize(size);
    const Bytes found = decoded(tile, stream);
    if (kind) return;
    if (number == 0) require(found == values, "a bit is lost");
    if (tile.type == FHASH_FLOAT32) keeps<float>(values, found, number);
    if (tile.type == FHASH_FLOAT64) keeps<double>(values, found, number);
}

void code(Reader& in, const fhash_tile& tile) {
    const std::int64_t n = static_cast<std::int64_t>(room(tile));
    const bool some = in.byte() & 1;
    fhash_coding coding = {};
    coding.weight = in.byte() / 256.0;
    coding.error = in.byte() & 1 ? -1 : std::abs(in.finite<double>());
    coding.rounds = in.byte() % 3;
    for (std::int32_t* each : {&coding.filled, &coding.keep_missing,
                               &coding.own_settings, &coding.fast})
        *each = in.byte() & 1;
    coding.cut = in.byte() & 1 ? in.byte() | in.byte() << 8 : 0;
    coding.passes = 1 + in.byte() % 2;
    coding.density = in.byte() % 3;
    Bytes counted = repeated<std::uint8_t>(in, n);
    for (std::uint8_t& each : counted) each &= 1;
    const std::int64_t bytes = n * static_cast<std::int64_t>(fhash_type_size(tile.type));
    const Bytes values = repeated<std::uint8_t>(in, bytes);
    Bytes known(values.size());
    std::uint8_t* data;
    std::size_t size;
    std::int64_t nonzero;
    const std::int32_t status =
        fhash_tile_code(context(), &tile, values.data(), some ? counted.data() : nullptr, &coding,
                        known.data(), &data, &size, &nonzero, nullptr);
    is_told(status);
    if (status) return;
    const Bytes stream(data, data + size);
    fhash_tile_free(data);
    require(decoded(tile, stream) == known, "a tile decodes to other values");
}

}  // namespace

void tile(Reader& in) {
    const std::uint8_t how = in.byte();
    fhash_tile tile = {};
    for (std::int64_t& n : tile.shape) n = in.within(1, 64);
    tile.type = static_cast<std::int32_t>(in.within(1, 11));
    const int kind = how & 7;
    if (tile.shape[0] * tile.shape[1] * tile.shape[2] * tile.shape[3] >
        (kind < 4 ? MOST : MOST_ENCODED))
        return;
    const Bytes settings = in.numbers<std::uint8_t>(in.word() % 4096);
    if (kind == 5) return encode(in, tile);
    tile.settings = settings.empty() ? nullptr : settings.data();
    tile.settings_size = settings.size();
    if (kind == 4) return code(in, tile);
    if (kind == 6) return look(in, tile);
    Bytes stream = in.rest();
    if (stream.size() > 4) {
        const std::int64_t size = static_cast<std::int64_t>(stream.size()) - 4;
        const std::uint32_t sum =
            static_cast<std::uint32_t>(fhash_crc32c(stream.data() + 4, size, 0, 0));
        for (std::size_t i = 0; i < 4; i++) stream[i] = static_cast<std::uint8_t>(sum >> 8 * i);
    }
    if (kind == 7) return decode_part(in, tile, stream);
    decode(tile, stream, kind & 1 ? how >> 3 & 7 : 0, kind == 2);
}
