// Passes over the values of a tile, element by element (transform/elementwise.py has the portable twins).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "core.hpp"

namespace {

using std::int32_t;
using std::int64_t;
using std::uint8_t;

const int64_t PIECE = 1024;

// Whether |one - other| <= error wherever it counts. counts: bytes, or nullptr for all. strict: the difference may have been rounded down.
template <class T, bool STRICT, bool ALL> FHASH_INLINE int64_t within(const T* one, const T* other, const uint8_t* counts, int64_t n, double error) {
    const double most = std::numeric_limits<double>::infinity();
    for (int64_t at = 0; at < n; at += PIECE) {
        const int64_t end = std::min(at + PIECE, n);
        int bad = 0;
        for (int64_t i = at; i < end; i++) {
            const double far = std::fabs((double)one[i] - (double)other[i]);
            const bool near = STRICT ? (far < error) | ((far == most) & (error == most)) : far <= error;
            bad |= !((one[i] == other[i]) | near) & (ALL || counts[i] != 0);
        }
        if (bad) return 0;
    }
    return 1;
}

// Whole quanta to add where the error is above half a quantum, into zeros: how many are not 0, or -1 where one would be above `largest`.
template <class V, class B, bool ALL>
FHASH_INLINE int64_t residual(const V* values, const B* base, const uint8_t* counts, int64_t n, double quantum, double largest, int32_t* out) {
    const double half = quantum / 2, rounding = 6755399441055744.0;  // 1.5 * 2^52: adding and taking it away rounds half to even
    double rest[PIECE];
    int64_t found = 0;
    for (int64_t at = 0; at < n; at += PIECE) {
        const int64_t count = std::min(PIECE, n - at);
        int any = 0, over = 0;
        for (int64_t i = 0; i < count; i++) {
            const double error = (double)values[at + i] - (double)base[at + i];
            rest[i] = ALL || counts[at + i] != 0 ? error : 0.0;
            any |= std::fabs(rest[i]) > half;
        }
        if (!any) continue;
        for (int64_t i = 0; i < count; i++) {
            const double whole = std::fabs(rest[i]) > half ? (rest[i] / quantum + rounding) - rounding : 0.0;
            const bool fits = std::fabs(whole) <= largest;
            over |= !fits;
            out[at + i] = (int32_t)(fits ? whole : 0.0);
            found += out[at + i] != 0;
        }
        if (over) return -1;
    }
    return found;
}

template <class B, class O> FHASH_INLINE void corrected(const B* base, const int32_t* residual, int64_t n, double quantum, O* out) {
    for (int64_t i = 0; i < n; i++) out[i] = (O)((double)base[i] + (double)residual[i] * quantum);
}

// Within the range, in place. NaN stays, and a zero keeps its sign where a bound is one, too.
template <class T> FHASH_INLINE void clipped(T* values, int64_t n, T center, T low, T high) {
    for (int64_t i = 0; i < n; i++) {
        const T value = values[i] + center;
        const T raised = value < low ? low : value;
        values[i] = raised > high ? high : raised;
    }
}

// Take the decoded value where it is as good: what does not count, and what lies at an end of the range and decodes beyond it.
template <class T, bool ALL> FHASH_INLINE int64_t freed(T* target, const T* rebuilt, const uint8_t* counts, int64_t n, T low, T high) {
    int64_t found = 0;
    for (int64_t i = 0; i < n; i++) {
        const T value = target[i], other = rebuilt[i];
        const bool any = ((value <= low) & (other < value)) | ((value >= high) & (other > value)) | (!ALL && counts[i] == 0);
        target[i] = any ? other : value;
        found += any;
    }
    return found;
}

}  // namespace

// One function of each kind for each pair of types, and its clone for the machine.
#define FHASH_VALUES(NAME, T, STRICT) \
    namespace { \
    FHASH_CLONES int64_t within_##NAME(const T* one, const T* other, const uint8_t* counts, int64_t n, double error) { \
        return counts ? within<T, STRICT, false>(one, other, counts, n, error) : within<T, STRICT, true>(one, other, counts, n, error); \
    } \
    FHASH_CLONES void clipped_##NAME(T* values, int64_t n, T center, T low, T high) { clipped<T>(values, n, center, low, high); } \
    FHASH_CLONES int64_t freed_##NAME(T* target, const T* rebuilt, const uint8_t* counts, int64_t n, T low, T high) { \
        return counts ? freed<T, false>(target, rebuilt, counts, n, low, high) : freed<T, true>(target, rebuilt, counts, n, low, high); \
    } \
    } \
    FHASH_EXPORT int64_t fhash_within_##NAME(const T* one, const T* other, const uint8_t* counts, int64_t n, double error) { \
        return within_##NAME(one, other, counts, n, error); \
    } \
    FHASH_EXPORT int64_t fhash_clip_##NAME(T* values, int64_t n, double center, double low, double high) { \
        clipped_##NAME(values, n, (T)center, (T)low, (T)high); \
        return 0; \
    } \
    FHASH_EXPORT int64_t fhash_free_##NAME(T* target, const T* rebuilt, const uint8_t* counts, int64_t n, double low, double high) { \
        return freed_##NAME(target, rebuilt, counts, n, (T)low, (T)high); \
    }

#define FHASH_PAIR(NAME, A, B) \
    namespace { \
    FHASH_CLONES int64_t residual_##NAME(const A* values, const B* base, const uint8_t* counts, int64_t n, double quantum, double largest, \
                                         int32_t* out) { \
        return counts ? residual<A, B, false>(values, base, counts, n, quantum, largest, out) : residual<A, B, true>(values, base, counts, n, quantum, largest, out); \
    } \
    FHASH_CLONES void corrected_##NAME(const A* base, const int32_t* residual, int64_t n, double quantum, B* out) { \
        corrected<A, B>(base, residual, n, quantum, out); \
    } \
    } \
    FHASH_EXPORT int64_t fhash_residual_##NAME(const A* values, const B* base, const uint8_t* counts, int64_t n, double quantum, \
                                               double largest, int32_t* out) { \
        return residual_##NAME(values, base, counts, n, quantum, largest, out); \
    } \
    FHASH_EXPORT int64_t fhash_correct_##NAME(const A* base, const int32_t* residual, int64_t n, double quantum, B* out) { \
        corrected_##NAME(base, residual, n, quantum, out); \
        return 0; \
    }

FHASH_VALUES(f32, float, false)
FHASH_VALUES(f64, double, true)
FHASH_PAIR(f32_f32, float, float)
FHASH_PAIR(f32_f64, float, double)
FHASH_PAIR(f64_f32, double, float)
FHASH_PAIR(f64_f64, double, double)
