// Tiles of differences of neighbours, which keep every bit (FORMAT.md, Differences).
#include <cstring>

#include "inflate.hpp"
#include "numbers.hpp"
#include "tile.hpp"

namespace fhash {
namespace {

constexpr int HOLES = 1, RESTS = 2, NARROW = 4;
constexpr size_t FRONT = 18;  // flags, scale, hole, orders
constexpr int64_t CORNERS = 8;  // longest last axis whose places are planes of their own

// A word in the order of the floats whose bits it is, or the other way round.
template <class W> W ordered(W word) {
    using Signed = typename std::make_signed<W>::type;
    const W largest = (W)std::numeric_limits<Signed>::max();
    return (Signed)word < 0 ? (W)(word ^ largest) : word;
}

// The front of a tile of differences, and what follows it.
struct Front {
    int flags, rows_order, order;
    double scale;
    uint64_t hole;
};

bool bad(fhash_error& error) {
    return fail(error, FHASH_ERROR_DAMAGED,
                "a tile of differences has numbers that no encoder writes");
}

// Whole numbers whose sign is in the lowest bit, the lowest bytes of all first.
template <class W> std::vector<W> whole_numbers(const uint8_t* data, int64_t n) {
    std::vector<W> words((size_t)n);
    for (int64_t i = 0; i < n; i++) {
        W word = 0;
        for (size_t byte = 0; byte < sizeof(W); byte++)
            word = (W)(word | (W)data[byte * (size_t)n + (size_t)i] << 8 * byte);
        words[(size_t)i] = (W)(word >> 1 ^ (W)(0 - (word & 1)));
    }
    return words;
}

// Running sums of each plane (rows, columns), from row to row and along each row.
template <class W>
void sum_planes(std::vector<W>& words, int64_t rows, int64_t columns, const Front& front) {
    for (W* plane = words.data(); plane < words.data() + words.size(); plane += rows * columns) {
        for (int sums = 0; sums < front.rows_order; sums++)
            for (int64_t i = columns; i < rows * columns; i++)
                plane[i] = (W)(plane[i] + plane[i - columns]);
        for (int sums = 0; sums < front.order; sums++)
            for (int64_t row = 0; row < rows; row++)
                for (int64_t i = row * columns + 1; i < (row + 1) * columns; i++)
                    plane[i] = (W)(plane[i] + plane[i - 1]);
    }
}

// The values of a tile whose type is K, or whose float64 numbers are of float32, in planes.
template <class K, class W>
bool values_of(const std::vector<uint8_t>& data, int64_t n, int64_t rows, int64_t columns,
               const Front& front, std::vector<W>& words, fhash_error& error) {
    const bool rests = front.flags & RESTS, holes = front.flags & HOLES;
    const size_t bytes = (size_t)n * sizeof(W), marks = holes ? (size_t)(n + 7) / 8 : 0;
    if (data.size() != FRONT + bytes * (rests ? 2 : 1) + marks) return bad(error);
    if (sizeof(W) < 8 && front.hole >> 8 * (sizeof(W) & 7)) return bad(error);
    words = whole_numbers<W>(data.data() + FRONT, n);
    sum_planes(words, rows, columns, front);
    if constexpr (is_real<K>) {
        using Signed = typename std::make_signed<W>::type;
        std::vector<W> rest;
        if (rests) rest = whole_numbers<W>(data.data() + FRONT + bytes, n);
        for (int64_t i = 0; i < n; i++) {
            const K number = cast<K>((double)(Signed)words[(size_t)i] / front.scale);
            W bits;
            std::memcpy(&bits, &number, sizeof bits);
            if (rests) bits = ordered((W)(ordered(bits) + rest[(size_t)i]));
            words[(size_t)i] = bits;
        }
    }
    const uint8_t* const mark = data.data() + data.size() - marks;
    for (int64_t i = 0; holes && i < n; i++)
        if (mark[i / 8] >> (7 - i % 8) & 1) words[(size_t)i] = (W)front.hole;
    return true;
}

// Words of planes to the values of a tile, in the order of its axes.
template <class K, class W, class O>
void place(const std::vector<W>& words, const Shape& shape, O* values) {
    const bool corners = shape[3] <= CORNERS && shape[2] > CORNERS;
    size_t at = 0;
    for (int64_t t = 0; t < shape[0]; t++)
        for (int64_t z = 0; z < shape[1]; z++)
            for (int64_t y = 0; y < shape[2]; y++)
                for (int64_t x = 0; x < shape[3]; x++, at++) {
                    const int64_t from =
                        corners ? ((t * shape[3] + x) * shape[1] + z) * shape[2] + y : (int64_t)at;
                    K number;
                    std::memcpy(&number, &words[(size_t)from], sizeof number);
                    if constexpr (std::is_same<K, O>::value) values[at] = number;
                    else values[at] = (O)number;
                }
}

template <class K, class W, class O>
bool unpack(const std::vector<uint8_t>& data, const Shape& shape, const Front& front, O* values,
            fhash_error& error) {
    const bool corners = shape[3] <= CORNERS && shape[2] > CORNERS;
    std::vector<W> words;
    if (!values_of<K>(data, vertices(shape), corners ? shape[1] : shape[2],
                      corners ? shape[2] : shape[3], front, words, error))
        return false;
    place<K>(words, shape, values);
    return true;
}

}  // namespace

template <class O>
bool decode_differences(Bytes body, const Shape& shape, O* values, fhash_error& error) {
    const uint64_t n = (uint64_t)vertices(shape);
    std::vector<uint8_t> data;
    if (!zstd_exact(body.at, body.left(), FRONT, FRONT + 2 * n * sizeof(O) + (n + 7) / 8, data,
                    error))
        return false;
    Front front = {data[0], data[17] >> 4, data[17] & 15, little<double>(&data[1]),
                   little<uint64_t>(&data[9])};
    constexpr int MAX_ORDER = 6;
    if (front.flags > 7 || front.rows_order > MAX_ORDER || front.order > MAX_ORDER)
        return bad(error);
    if (is_real<O> ? !(front.scale > 0 && std::isfinite(front.scale))
                   : front.flags != 0 || front.scale != 0)
        return bad(error);
    if (front.flags & NARROW) {
        if constexpr (std::is_same<O, double>::value)
            return unpack<float, uint32_t>(data, shape, front, values, error);
        return bad(error);
    }
    return unpack<O, typename Word<sizeof(O)>::Of>(data, shape, front, values, error);
}

#define FHASH_DIFFERENCES(O) \
    template bool decode_differences(Bytes, const Shape&, O*, fhash_error&);
FHASH_DIFFERENCES(int8_t)
FHASH_DIFFERENCES(int16_t)
FHASH_DIFFERENCES(int32_t)
FHASH_DIFFERENCES(int64_t)
FHASH_DIFFERENCES(uint8_t)
FHASH_DIFFERENCES(uint16_t)
FHASH_DIFFERENCES(uint32_t)
FHASH_DIFFERENCES(uint64_t)
FHASH_DIFFERENCES(Half)
FHASH_DIFFERENCES(float)
FHASH_DIFFERENCES(double)

}  // namespace fhash
