// Settings of a tile: their packed block, unpacked (FORMAT.md, Settings).
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "context.hpp"

namespace fhash {

using Shape = std::array<int64_t, 4>;  // along t, z, y, x

constexpr int NONE_KIND = 0, HAAR_KIND = 1, LEGALL_KIND = 2, DAUBECHIES_KIND = 3, KLT_KIND = 4;
constexpr int OFFSET_COUNT = 6;
constexpr double OFFSET_UNIT = 128;  // units in a quantiser step

// A basis of the data's own along an axis.
struct Basis {
    int64_t n, rank;
    std::vector<float> synthesis;  // (n, rank); its columns are the vectors
};

struct AxisTransform {
    int kind = 0, depth = 0;
    std::shared_ptr<const Basis> basis;

    bool wavelet() const { return kind >= HAAR_KIND && kind <= DAUBECHIES_KIND; }
};

// A head as the kernel takes it (head.cpp).
struct Head {
    std::vector<int64_t> widths;
    std::vector<float> weights, biases, scales;
    float constants[4];  // low, high, 1 / (2 sigma), 1024 over the length of the range

    int64_t layers() const { return (int64_t)widths.size() - 1; }
};

struct MaskScores {
    std::vector<double> edges;
    std::vector<int32_t> scores, others;
    int64_t reach;
};

// A predictor as the kernel takes it (predict.cpp).
struct Predictor {
    double step, origin;
    Shape levels;
    std::vector<int32_t> passes, taps;  // (n, 4) and (m, 5)
    std::vector<int16_t> weights;       // of the taps
};

// An integer of int64 or uint64.
struct Wide {
    uint64_t bits = 0;
    bool negative = false;

    bool zero() const { return bits == 0 && !negative; }
    double real() const { return negative ? (double)(int64_t)bits : (double)bits; }
};

template <class T> struct Plan;

struct Settings {
    AxisTransform axes[4];
    double step, quantum, center, low, high;
    bool whole;                       // the ends of the range are integers
    int64_t whole_low = 0, whole_high = 0;
    Wide origin;
    int8_t offsets[OFFSET_COUNT];
    bool real64, clip, labels, trellis;  // real64: the arithmetic is in float64
    std::vector<uint8_t> packed;
    std::unique_ptr<Head> head;
    std::unique_ptr<MaskScores> mask;
    std::unique_ptr<Predictor> predictor;

    // Plans of the inverse transform that were made before, for shapes and levels of detail.
    mutable Mutex lock;
    mutable std::vector<std::shared_ptr<const Plan<float>>> plans32;
    mutable std::vector<std::shared_ptr<const Plan<double>>> plans64;
};

// The settings in a packed block; null for what no encoder writes.
std::shared_ptr<const Settings> unpack_settings(fhash_context& context, const uint8_t* data,
                                                size_t size, fhash_error& error);

// Bytes that are read from their start on.
struct Bytes {
    const uint8_t* at = nullptr;
    const uint8_t* end = nullptr;

    size_t left() const { return (size_t)(end - at); }
    bool take(size_t count, const uint8_t*& taken) {
        if (count > left()) return false;
        taken = at;
        at += count;
        return true;
    }
    template <class T> bool number(T& value);
    // A whole number in LEB128, of at most five bytes.
    bool leb(uint64_t& value);
};

// A whole number as `Bytes::leb` reads it.
void put_leb(Buffer& out, uint64_t number);

// A head from the block that settings have of it.
bool unpack_head(Bytes block, Head& head, fhash_error& error);

// Puts the block of a head into packed settings, which have an empty one in its place; or checks
// that they have none, where it is empty.
bool insert_head(std::string& settings, const std::string& head, fhash_error& error);

}  // namespace fhash
