// Passes over the values of a tile, element by element.
#include "loops.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "core.hpp"
#include "functions.h"

namespace {

using std::int32_t;
using std::int64_t;
using std::uint8_t;

const int64_t PIECE = 1024;  // values after which a pass may end early

// Whether |decoded - value| <= error at every counted value. counted: a mask, or nullptr for all.
// STRICT: the difference may have been rounded down. ALL: all values are counted.
template <class T, bool STRICT, bool ALL>
FHASH_INLINE int64_t within(const T* values, const T* decoded, const uint8_t* counted, int64_t n,
                            double error) {
    const double infinity = std::numeric_limits<double>::infinity();
    for (int64_t start = 0; start < n; start += PIECE) {
        const int64_t end = std::min(start + PIECE, n);
        int bad = 0;
        for (int64_t i = start; i < end; i++) {
            const double far = std::fabs((double)values[i] - (double)decoded[i]);
            const bool near = STRICT ? (far < error) | ((far == infinity) & (error == infinity))
                                     : far <= error;
            bad |= !((values[i] == decoded[i]) | near) & (ALL || counted[i] != 0);
        }
        if (bad) return 0;
    }
    return 1;
}

// Write the quanta to add where the error exceeds half a quantum; `out` holds zeros before. The
// result is how many are not 0, or -1 where one would be above `largest`.
template <class V, class B, bool ALL>
FHASH_INLINE int64_t residual(const V* values, const B* base, const uint8_t* counted, int64_t n,
                              double quantum, double largest, int32_t* out) {
    const double half = quantum / 2;
    const double rounding = 6755399441055744.0;  // 1.5 * 2^52: adding and subtracting it rounds
    double rest[PIECE];
    int64_t nonzero = 0;
    for (int64_t start = 0; start < n; start += PIECE) {
        const int64_t count = std::min(PIECE, n - start);
        int any = 0, over = 0;
        for (int64_t i = 0; i < count; i++) {
            const double error = (double)values[start + i] - (double)base[start + i];
            rest[i] = ALL || counted[start + i] != 0 ? error : 0.0;
            any |= std::fabs(rest[i]) > half;
        }
        if (!any) continue;
        for (int64_t i = 0; i < count; i++) {
            const double quanta =
                std::fabs(rest[i]) > half ? (rest[i] / quantum + rounding) - rounding : 0.0;
            const bool fits = std::fabs(quanta) <= largest;
            over |= !fits;
            out[start + i] = (int32_t)(fits ? quanta : 0.0);
            nonzero += out[start + i] != 0;
        }
        if (over) return -1;
    }
    return nonzero;
}

template <class B, class O>
FHASH_INLINE void corrected(const B* base, const int32_t* residual, int64_t n, double quantum,
                            O* out) {
    for (int64_t i = 0; i < n; i++) out[i] = (O)((double)base[i] + (double)residual[i] * quantum);
}

// Shift the values and clip them to the range, in place. NaN stays, and a zero keeps its sign also
// where an end of the range is a zero.
template <class T>
FHASH_INLINE void clipped(T* values, int64_t n, T center, T low, T high) {
    for (int64_t i = 0; i < n; i++) {
        const T value = values[i] + center;
        const T raised = value < low ? low : value;
        values[i] = raised > high ? high : raised;
    }
}

// Replace each free value by its rebuilt one, and count them. A value is free where it is not
// counted, and where it lies at an end of the range and its rebuilt value lies beyond it.
template <class T, bool ALL>
FHASH_INLINE int64_t freed(T* target, const T* rebuilt, const uint8_t* counted, int64_t n, T low,
                           T high) {
    int64_t total = 0;
    for (int64_t i = 0; i < n; i++) {
        const T value = target[i], other = rebuilt[i];
        const bool free = ((value <= low) & (other < value)) |
                          ((value >= high) & (other > value)) | (!ALL && counted[i] == 0);
        target[i] = free ? other : value;
        total += free;
    }
    return total;
}

}  // namespace

// The functions for one type, each with its clones for the machines.
#define FHASH_VALUES(NAME, T, STRICT) \
    namespace { \
    FHASH_CLONES int64_t within_##NAME(const T* values, const T* decoded, const uint8_t* counted, \
                                       int64_t n, double error) { \
        return counted ? within<T, STRICT, false>(values, decoded, counted, n, error) \
                       : within<T, STRICT, true>(values, decoded, counted, n, error); \
    } \
    FHASH_CLONES void clipped_##NAME(T* values, int64_t n, T center, T low, T high) { \
        clipped<T>(values, n, center, low, high); \
    } \
    FHASH_CLONES int64_t freed_##NAME(T* target, const T* rebuilt, const uint8_t* counted, \
                                      int64_t n, T low, T high) { \
        return counted ? freed<T, false>(target, rebuilt, counted, n, low, high) \
                       : freed<T, true>(target, rebuilt, counted, n, low, high); \
    } \
    } \
    FHASH_KERNEL int64_t fhash_within_##NAME(const T* values, const T* decoded, \
                                             const uint8_t* counted, int64_t n, double error) { \
        return within_##NAME(values, decoded, counted, n, error); \
    } \
    FHASH_KERNEL int64_t fhash_clip_##NAME(T* values, int64_t n, double center, double low, \
                                           double high) { \
        clipped_##NAME(values, n, (T)center, (T)low, (T)high); \
        return 0; \
    } \
    FHASH_KERNEL int64_t fhash_free_##NAME(T* target, const T* rebuilt, const uint8_t* counted, \
                                           int64_t n, double low, double high) { \
        return freed_##NAME(target, rebuilt, counted, n, (T)low, (T)high); \
    }

// The functions for a pair of types.
#define FHASH_PAIR(NAME, A, B) \
    namespace { \
    FHASH_CLONES int64_t residual_##NAME(const A* values, const B* base, const uint8_t* counted, \
                                         int64_t n, double quantum, double largest, \
                                         int32_t* out) { \
        return counted ? residual<A, B, false>(values, base, counted, n, quantum, largest, out) \
                       : residual<A, B, true>(values, base, counted, n, quantum, largest, out); \
    } \
    FHASH_CLONES void corrected_##NAME(const A* base, const int32_t* residual, int64_t n, \
                                       double quantum, B* out) { \
        corrected<A, B>(base, residual, n, quantum, out); \
    } \
    } \
    FHASH_KERNEL int64_t fhash_residual_##NAME(const A* values, const B* base, \
                                               const uint8_t* counted, int64_t n, double quantum, \
                                               double largest, int32_t* out) { \
        return residual_##NAME(values, base, counted, n, quantum, largest, out); \
    } \
    FHASH_KERNEL int64_t fhash_correct_##NAME(const A* base, const int32_t* residual, int64_t n, \
                                              double quantum, B* out) { \
        corrected_##NAME(base, residual, n, quantum, out); \
        return 0; \
    }

FHASH_VALUES(f32, float, false)
FHASH_VALUES(f64, double, true)
FHASH_PAIR(f32_f32, float, float)
FHASH_PAIR(f32_f64, float, double)
FHASH_PAIR(f64_f32, double, float)
FHASH_PAIR(f64_f64, double, double)
