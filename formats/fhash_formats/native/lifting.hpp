// Kernels of the transform of a tile: lifting steps, even and odd halves of a row, matrix products.
#pragma once

#include <cstring>

#include "core.hpp"

namespace {

using i64 = std::int64_t;

enum Kind : i64 { NONE = 0, HAAR = 1, W53 = 2, W97 = 3, KLT = 4 };

// One lifting step: whether the odd half changes, and the factor.
struct LiftStep {
    bool odd;
    double factor;
};
constexpr LiftStep STEPS_53[] = {{true, -0.5}, {false, 0.25}};
constexpr LiftStep STEPS_97[] = {{true, -1.586134342059924},
                                 {false, -0.052980118572961},
                                 {true, 0.882911075530934},
                                 {false, 0.443506852043971}};

FHASH_INLINE const LiftStep* steps_of(i64 kind) { return kind == W97 ? STEPS_97 : STEPS_53; }
FHASH_INLINE int step_count(i64 kind) { return kind == W97 ? 4 : 2; }
FHASH_INLINE i64 half(i64 n) { return (n + 1) / 2; }
FHASH_INLINE i64 smaller(i64 a, i64 b) { return a < b ? a : b; }
FHASH_INLINE i64 larger(i64 a, i64 b) { return a > b ? a : b; }
FHASH_INLINE i64 padded(i64 n) { return (n + 31) / 32 * 32; }

template <class T>
FHASH_INLINE std::size_t bytes_of(i64 n) {
    return static_cast<std::size_t>(n) * sizeof(T);
}

template <class T>
FHASH_INLINE void lift(T* FHASH_RESTRICT out, const T* FHASH_RESTRICT a, const T* FHASH_RESTRICT b,
                       T factor, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] += factor * (a[i] + b[i]);
}

// One Haar level on `n` rows, in place; arguments as in lift_rows.
template <class T>
FHASH_INLINE void haar_rows(T* rows, i64 n, i64 stride, i64 width, bool inverse) {
    for (i64 r = 0; r + 1 < n; r += 2) {
        T* FHASH_RESTRICT low = rows + r * stride;
        T* FHASH_RESTRICT high = low + stride;
        if (inverse) {
            for (i64 i = 0; i < width; i++) {
                low[i] -= T(0.5) * high[i];
                high[i] += low[i];
            }
        } else {
            for (i64 i = 0; i < width; i++) {
                high[i] -= low[i];
                low[i] += T(0.5) * high[i];
            }
        }
    }
}

// One level on `n` rows of `width` numbers, `stride` apart, in place: even rows become the low
// band, odd rows the high band.
template <class T>
FHASH_INLINE void lift_rows(T* rows, i64 n, i64 stride, i64 width, i64 kind, bool inverse) {
    if (n < 2) return;
    if (kind == HAAR) {
        haar_rows(rows, n, stride, width, inverse);
        return;
    }
    const LiftStep* steps = steps_of(kind);
    const int count = step_count(kind);
    for (int s = 0; s < count; s++) {
        const LiftStep step = steps[inverse ? count - 1 - s : s];
        const T factor = T(inverse ? -step.factor : step.factor);
        for (i64 r = step.odd ? 1 : 0; r < n; r += 2) {
            const i64 before = r > 0 ? r - 1 : 1, after = r + 1 < n ? r + 1 : r - 1;
            lift(rows + r * stride, rows + before * stride, rows + after * stride, factor, width);
        }
    }
}

// One Haar level on the halves of a row, in place.
template <class T>
FHASH_INLINE void haar_halves(T* FHASH_RESTRICT low, T* FHASH_RESTRICT high, i64 odds,
                              bool inverse) {
    if (inverse) {
        for (i64 i = 0; i < odds; i++) low[i] -= T(0.5) * high[i];
        for (i64 i = 0; i < odds; i++) high[i] += low[i];
    } else {
        for (i64 i = 0; i < odds; i++) high[i] -= low[i];
        for (i64 i = 0; i < odds; i++) low[i] += T(0.5) * high[i];
    }
}

// One level on the halves of a row of `n` numbers, in place. `even` has room for one number after
// its end, `odd` for one before its start and one after its end.
template <class T>
FHASH_INLINE void lift_halves(T* even, T* odd, i64 n, i64 kind, bool inverse) {
    const i64 evens = half(n), odds = n / 2;
    if (kind == HAAR) {
        haar_halves(even, odd, odds, inverse);
        return;
    }
    const LiftStep* steps = steps_of(kind);
    const int count = step_count(kind);
    for (int s = 0; s < count; s++) {
        const LiftStep step = steps[inverse ? count - 1 - s : s];
        const T factor = T(inverse ? -step.factor : step.factor);
        if (step.odd) {
            if (evens == odds) even[evens] = even[evens - 1];
            lift(odd, even, even + 1, factor, odds);
        } else {
            odd[-1] = odd[0];
            if (evens > odds) odd[odds] = odd[odds - 1];
            lift(even, odd - 1, odd, factor, evens);
        }
    }
}

// A row of `n` numbers to its even and odd halves.
template <class T>
FHASH_INLINE void split(const T* FHASH_RESTRICT row, T* FHASH_RESTRICT even, T* FHASH_RESTRICT odd,
                        i64 n) {
    const i64 odds = n / 2;
    for (i64 i = 0; i < odds; i++) {
        even[i] = row[2 * i];
        odd[i] = row[2 * i + 1];
    }
    if (n % 2) even[odds] = row[n - 1];
}

// The inverse of split.
template <class T>
FHASH_INLINE void merge(T* FHASH_RESTRICT row, const T* FHASH_RESTRICT even,
                        const T* FHASH_RESTRICT odd, i64 n) {
    const i64 odds = n / 2;
    for (i64 i = 0; i < odds; i++) {
        row[2 * i] = even[i];
        row[2 * i + 1] = odd[i];
    }
    if (n % 2) row[n - 1] = even[odds];
}

template <class T>
FHASH_INLINE void scaled(const T* FHASH_RESTRICT in, T* FHASH_RESTRICT out, T scale,
                         const T* FHASH_RESTRICT scales, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (in[i] * scale) * scales[i];
}

// C (M rows, n <= WIDE columns) = A (M, depth) B (depth, ...). Each sum runs over k in ascending
// order, beginning with the first product. Rows of B must be readable up to WIDE.
template <class T, int M, int WIDE>
FHASH_INLINE void product_tile(const T* a, i64 a_stride, const T* FHASH_RESTRICT b, i64 b_stride,
                               T* c, i64 c_stride, i64 depth, i64 n) {
    T sum[M][WIDE];
    for (int i = 0; i < M; i++)
        for (int j = 0; j < WIDE; j++) sum[i][j] = a[i * a_stride] * b[j];
    for (i64 k = 1; k < depth; k++)
        for (int i = 0; i < M; i++) {
            const T factor = a[i * a_stride + k];
            for (int j = 0; j < WIDE; j++) sum[i][j] += factor * b[k * b_stride + j];
        }
    for (int i = 0; i < M; i++) std::memcpy(c + i * c_stride, sum[i], bytes_of<T>(n));
}

// C (m, n) = A (m, depth) B (depth, n), in tiles of up to 4 rows and 32 columns.
template <class T>
FHASH_INLINE void product(const T* a, i64 a_stride, const T* b, i64 b_stride, T* c, i64 c_stride,
                          i64 m, i64 depth, i64 n) {
    constexpr int WIDE = 32;
    if (depth == 0) {
        for (i64 i = 0; i < m; i++) std::memset(c + i * c_stride, 0, bytes_of<T>(n));
        return;
    }
    for (i64 j = 0; j < n; j += WIDE) {
        const i64 width = smaller(i64(WIDE), n - j);
        i64 i = 0;
        for (; i + 4 <= m; i += 4)
            product_tile<T, 4, WIDE>(a + i * a_stride, a_stride, b + j, b_stride,
                                     c + i * c_stride + j, c_stride, depth, width);
        for (; i < m; i++)
            product_tile<T, 1, WIDE>(a + i * a_stride, a_stride, b + j, b_stride,
                                     c + i * c_stride + j, c_stride, depth, width);
    }
}

}  // namespace
