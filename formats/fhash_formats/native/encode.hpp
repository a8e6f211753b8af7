// Encoding of a tile: choice of integers, of values without data, and of the form of the stream.
#pragma once

#include <functional>

#include "kernels.hpp"
#include "numbers.hpp"
#include "tile.hpp"

namespace fhash {

constexpr double LARGEST = 1e9;                 // largest magnitude of an integer
constexpr int32_t MAX_INTEGER = (1 << 30) - 1;  // that the coder takes
constexpr double ROUNDING = 0.4;                // added to a magnitude before rounding down
// Step on the trellis as a share of the plain quantiser's of about the same error and bytes.
constexpr double TRELLIS_SHARE = 0.65;
constexpr int8_t PLAIN_OFFSETS[OFFSET_COUNT] = {-5, -1, 0, 0, 0, 0};

// A coded tile.
struct Coded {
    Buffer data;
    Buffer decoded;       // the values that the stream decodes to, in the type of the array
    int64_t nonzero = 0;  // coded integers that are not 0
};

// The bytes of an encoder, called again where they do not fit: encode(data, capacity) is the size.
template <class Encode>
bool with_room(int64_t room, Buffer& out, fhash_error& error, Encode encode) {
    for (int64_t capacity = room < 4096 ? 4096 : room;;) {
        out.resize((size_t)capacity);
        const int64_t size = encode(out.data(), capacity);
        if (size == -3)
            return fail(error, FHASH_ERROR_ARGUMENT,
                        "an integer is not one of the quantiser whose turn it is");
        if (!kernel_done(size, "a kernel refused its arguments", error)) return false;
        const bool fits = size <= capacity;
        out.resize((size_t)size);
        if (fits) return true;
        capacity = size;
    }
}

// How integers are coded.
struct IntegerCoding {
    bool trellis = false, fast = false;
    const float* scaled = nullptr;  // coefficients / step, of which the integers are chosen anew
    double weight = 0;              // squared steps that a bit is worth
};
// Codes integers, which become what the bytes decode to.
bool encode_integers(std::vector<int32_t>& integers, const Shape& shape, const Table& table,
                     const IntegerCoding& how, Buffer& out, fhash_error& error);

// Codes predicted integers, which become what the bytes decode to where they do not count.
bool encode_predicted(const Predictor& predictor, const Shape& shape, const uint8_t* counted,
                      std::vector<int32_t>& integers, Buffer& out, fhash_error& error);

// What a search on a tile needs.
template <class T> struct Search {
    fhash_context& context;
    const Settings& settings;
    Shape shape;
    std::shared_ptr<const Plan<T>> forward, inverse;

    int64_t size() const { return vertices(shape); }
    const Table& table() const { return inverse->table; }
};
template <class T>
bool make_search(fhash_context& context, const Settings& settings, const Shape& shape,
                 std::shared_ptr<Search<T>>& search, fhash_error& error);

// The squared error that coefficients predict at a step, as compact/transform.py has it of bins of
// a quarter octave: of the bin where the dead zone ends, a share becomes 0.
template <class T> double predicted_error(const std::vector<T>& coefficients, double step);

// Squared error that a choice of integers aims at, by a weight of a bit near the usual one.
struct Aim {
    double squares;  // 0 for no aim
    std::function<double(std::vector<int32_t>&)> measure;  // of integers; below 0 where it fails
};

// The integers of coefficients, which become multiples of the step; false without an error where
// the trellis has none so large.
//
// aim: null for the usual weight of a bit.
template <class T>
bool choose_integers(const Search<T>& search, std::vector<T>& coefficients,
                     const fhash_coding& coding, int passes, const Aim* aim,
                     std::vector<int32_t>& integers, fhash_error& error);
// The coded coefficients and the integers that they decode to; likewise.
template <class T>
bool code_coefficients(const Search<T>& search, std::vector<T>& coefficients,
                       const fhash_coding& coding, const Aim* aim, Buffer& data,
                       std::vector<int32_t>& integers, fhash_error& error);

// The same in blocks (blocks.hpp).
template <class T>
bool code_blocks(const Search<T>& search, const Cut& cut, std::vector<T>& coefficients,
                 const fhash_coding& coding, const Aim* aim, Buffer& data,
                 std::vector<int32_t>& integers, fhash_error& error);
// Numbers of a tile that were not transformed, in blocks.
bool encode_in_blocks(const std::vector<int32_t>& integers, const Shape& shape, const Cut& cut,
                      bool fast, int threads, Buffer& data, fhash_error& error);
// The blocks of a tile that is large enough for them (cut.cpp).
template <class T>
Cut choose_cut(const Settings& settings, const Shape& shape, bool fast,
               const std::vector<T>& coefficients);

// `target` with fill values where it is not counted (transform/tile.py, filled).
template <class T>
bool fill_uncounted(const Search<T>& search, const uint8_t* counted, const uint8_t* finite,
                    int density, std::vector<T>& target, fhash_error& error);

// Marks a vertex, one of n, as of the value with these bits; false for too many values.
bool mark(uint64_t bits, int64_t vertex, int64_t n, Marks& marks);
// Marks the values that are not finite; false for too many different ones, of which there are three
// at most unless the bits of every NaN are kept.
bool mark_not_finite(const void* values, int32_t type, int64_t n, bool every_nan, Marks& marks);

// The stream of a tile, with its decoded values. marks: all values that are not finite, and others.
bool encode_tile(fhash_context& context, const std::shared_ptr<const Settings>& settings,
                 const Shape& shape, int32_t type, const void* values, const uint8_t* in_coreset,
                 const Marks& marks, const fhash_coding& coding, Coded& coded, fhash_error& error);

// A tile stored without loss, deflated or as labels. settings: those to put into the stream, or
// null. occupied: the mask, or null. labelled: false without an error for too many labels.
bool encode_exact(const Settings* settings, const Shape& shape, int32_t type, const void* values,
                  const uint8_t* occupied, Coded& coded, fhash_error& error);
bool encode_labelled(const Settings* settings, const Shape& shape, int32_t type, const void* values,
                     const uint8_t* occupied, int64_t most, Coded& coded, fhash_error& error);

// Whether |decoded - value| <= error at every counted value.
template <class O>
bool is_within(const O* values, const O* decoded, const uint8_t* counted, int64_t n, double error) {
    if constexpr (std::is_floating_point<O>::value) {
        return all_within(values, decoded, counted, n, error);
    } else if constexpr (std::is_same<O, Half>::value) {
        std::vector<float> wide[2];
        for (int64_t i = 0; i < n; i++) {
            wide[0].push_back(from_half(values[i].bits));
            wide[1].push_back(from_half(decoded[i].bits));
        }
        return all_within(wide[0].data(), wide[1].data(), counted, n, error);
    } else {
        const uint64_t limit = error < 0 ? 0 : error >= 0x1p64 ? ~0ull : (uint64_t)error;
        for (int64_t i = 0; i < n; i++) {
            if (counted && !counted[i]) continue;
            const O value = values[i], other = decoded[i];
            // A signed difference may overflow; as an unsigned number it is right again.
            const uint64_t far = value > other ? (uint64_t)value - (uint64_t)other
                                               : (uint64_t)other - (uint64_t)value;
            if (far > limit) return false;
        }
        return true;
    }
}

// The stream of flags and sections, with its checksum.
Buffer sealed(int flags, const std::vector<Buffer>& sections);

}  // namespace fhash
