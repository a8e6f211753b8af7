// Values of a tile in the type of its array: casts, ends of ranges, origins.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "bytes.hpp"
#include "settings.hpp"

namespace fhash {

struct Half {
    uint16_t bits;
};

inline double real(Half value) { return (double)from_half(value.bits); }
template <class T> double real(T value) { return (double)value; }

// What compares as the values do.
inline float value_of(Half value) { return from_half(value.bits); }
template <class T> T value_of(T value) { return value; }

template <class T> constexpr bool is_real = std::is_floating_point<T>::value;
template <> inline constexpr bool is_real<Half> = true;

// A number in another type: rounded to the nearest, ties to even, and for integers within the type;
// NaN becomes 0 there.
template <class O> O cast(double value) {
    if constexpr (std::is_same<O, Half>::value) {
        return {to_half(value)};
    } else if constexpr (std::is_floating_point<O>::value) {
        return (O)value;
    } else {
        constexpr double half = 6755399441055744.0;  // 1.5 * 2^52: adding and subtracting it rounds
        constexpr double low = (double)std::numeric_limits<O>::min();
        // float64 has not the largest 64-bit integers; the number below them is in the range.
        constexpr double high = sizeof(O) < 8 ? (double)std::numeric_limits<O>::max()
                                : low < 0     ? 9223372036854774784.0
                                              : 18446744073709549568.0;
        const double known = value == value ? value : 0.0;
        const double within = known < low ? low : known > high ? high : known;
        if constexpr (sizeof(O) < 8) return (O)((within + half) - half);
        else return (O)std::nearbyint(within);
    }
}

template <class I, class O> void cast_all(const I* in, O* out, int64_t n) {
    for (int64_t i = 0; i < n; i++) out[i] = cast<O>((double)in[i]);
}

// Unsigned integers of the size of a value.
template <size_t WIDTH> struct Word;
template <> struct Word<1> { using Of = uint8_t; };
template <> struct Word<2> { using Of = uint16_t; };
template <> struct Word<4> { using Of = uint32_t; };
template <> struct Word<8> { using Of = uint64_t; };

// An end of the range of the settings in a type.
template <class O> O end_of(const Settings& settings, bool low) {
    if constexpr (!is_real<O>) {
        if (settings.whole) {
            const int64_t end = low ? settings.whole_low : settings.whole_high;
            using Limits = std::numeric_limits<O>;
            if (end < 0 && Limits::min() == 0) return 0;
            if (sizeof(O) < 8)
                return (O)std::clamp(end, (int64_t)Limits::min(), (int64_t)Limits::max());
            return (O)end;
        }
    }
    return cast<O>(low ? settings.low : settings.high);
}

// Decoded values within the range, if the settings ask for it, in place; NaN and signs of zeros
// stay.
template <class O> void clip_range(O* values, int64_t n, const Settings& settings) {
    if (!settings.clip) return;
    const O low = end_of<O>(settings, true), high = end_of<O>(settings, false);
    if constexpr (std::is_same<O, Half>::value) {
        const double first = real(low), last = real(high);
        for (int64_t i = 0; i < n; i++) {
            const double value = real(values[i]);
            if (value < first) values[i] = low;
            if (value > last) values[i] = high;
        }
    } else {
        for (int64_t i = 0; i < n; i++) {
            const O raised = values[i] < low ? low : values[i];
            values[i] = raised > high ? high : raised;
        }
    }
}

template <class O> O not_a_number() {
    if constexpr (std::is_same<O, Half>::value) return {0x7e00};
    else return std::numeric_limits<O>::quiet_NaN();
}

// NaN, or in integers the centre, wherever a vertex is not occupied.
template <class O> void blank(O* values, int64_t n, const uint8_t* occupied, double center) {
    O nothing;
    if constexpr (is_real<O>) nothing = not_a_number<O>();
    else nothing = cast<O>(center);
    for (int64_t i = 0; i < n; i++)
        if (!occupied[i]) values[i] = nothing;
}

// Values that are kept bit by bit beside the coded ones: not finite ones, and fill values.
struct Marks {
    std::vector<uint64_t> values;  // their bits, ascending; at most MAX_MARKED
    std::vector<uint16_t> of;  // 0, or 1 + the number of its value, of each vertex; empty for none
};
constexpr size_t MAX_MARKED = 255;

template <class O> uint64_t bits_of(O value) {
    typename Word<sizeof(O)>::Of bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

// The marked values in their places.
template <class O> void restore(O* values, const Marks& marks) {
    for (size_t i = 0; i < marks.of.size(); i++) {
        if (!marks.of[i]) continue;
        const auto bits = (typename Word<sizeof(O)>::Of)marks.values[marks.of[i] - 1u];
        std::memcpy(values + i, &bits, sizeof bits);
    }
}

// Whether an origin is of an array of this type.
inline bool has_origin(const Wide& origin, int32_t type) {
    if (type == FHASH_INT64) return origin.negative || origin.bits >> 63 == 0;
    return type == FHASH_UINT64 && !origin.negative;
}

// The integers whose differences from an origin are given, clipped to their type, in place.
inline void add_origin(int64_t* values, int64_t n, const Wide& origin, int32_t type) {
    // The ends of the type less the origin, as far as they are int64.
    constexpr int64_t least = std::numeric_limits<int64_t>::min();
    constexpr int64_t most = std::numeric_limits<int64_t>::max();
    int64_t low = least, high = most;
    if (type == FHASH_INT64) {
        const int64_t begin = (int64_t)origin.bits;
        if (begin < 0) low = least - begin;
        if (begin > 0) high = most - begin;
    } else {
        if (origin.bits <= (uint64_t)most) low = -(int64_t)origin.bits;
        const uint64_t room = ~origin.bits;
        if (room < (uint64_t)most) high = (int64_t)room;
    }
    for (int64_t i = 0; i < n; i++)
        values[i] = (int64_t)((uint64_t)std::clamp(values[i], low, high) + origin.bits);
}

// Calls `work` with a value of the type of an array; false for a number that is no type.
template <class Work> bool with_type(int32_t type, Work work) {
    switch (type) {
        case FHASH_INT8: return work(int8_t());
        case FHASH_INT16: return work(int16_t());
        case FHASH_INT32: return work(int32_t());
        case FHASH_INT64: return work(int64_t());
        case FHASH_UINT8: return work(uint8_t());
        case FHASH_UINT16: return work(uint16_t());
        case FHASH_UINT32: return work(uint32_t());
        case FHASH_UINT64: return work(uint64_t());
        case FHASH_FLOAT16: return work(Half());
        case FHASH_FLOAT32: return work(float());
        case FHASH_FLOAT64: return work(double());
        default: return false;
    }
}

}  // namespace fhash
