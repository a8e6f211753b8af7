// Forward and inverse transform of one tile (t, z, y, x): lifting wavelets and matrix products, the twin of transform/lifting_portable.py
// bit for bit.
//
// Along t, z and y a block of columns is gathered into a small buffer, lifted there through all levels in place (level l at stride 2^l) and
// scattered to the bands, low first. Along x a row is split into its even and odd halves. Coupled y and x go level by level through one
// plane at a time.
#include <cstdlib>
#include <cstring>

#include "core.hpp"

namespace {

using i64 = std::int64_t;

enum Kind : i64 { NONE = 0, HAAR = 1, W53 = 2, W97 = 3, KLT = 4 };

constexpr i64 MAX_DEPTH = 10;
constexpr i64 BLOCK = 8192;  // numbers in the column buffer: 32 kB of float32
constexpr i64 ROWS = 32;     // rows of x that go through a matrix product at once

struct Step {
    bool odd;
    double factor;
};
constexpr Step STEPS_53[] = {{true, -0.5}, {false, 0.25}};
constexpr Step STEPS_97[] = {
    {true, -1.586134342059924}, {false, -0.052980118572961}, {true, 0.882911075530934}, {false, 0.443506852043971}};

FHASH_INLINE const Step* steps_of(i64 kind) { return kind == W97 ? STEPS_97 : STEPS_53; }
FHASH_INLINE int steps_in(i64 kind) { return kind == W97 ? 4 : 2; }
FHASH_INLINE i64 half(i64 n) { return (n + 1) / 2; }
FHASH_INLINE i64 smaller(i64 a, i64 b) { return a < b ? a : b; }
FHASH_INLINE i64 larger(i64 a, i64 b) { return a > b ? a : b; }

template <class T>
FHASH_INLINE void lift(T* FHASH_RESTRICT out, const T* FHASH_RESTRICT a, const T* FHASH_RESTRICT b, T factor, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] += factor * (a[i] + b[i]);
}

// One level on `n` rows of `width` numbers, `stride` apart, in place: even rows become the low band, odd rows the high band.
template <class T>
FHASH_INLINE void lift_rows(T* rows, i64 n, i64 stride, i64 width, i64 kind, bool inverse) {
    if (n < 2) return;
    if (kind == HAAR) {
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
        return;
    }
    const Step* steps = steps_of(kind);
    const int count = steps_in(kind);
    for (int s = 0; s < count; s++) {
        const Step step = steps[inverse ? count - 1 - s : s];
        const T factor = T(inverse ? -step.factor : step.factor);
        for (i64 r = step.odd ? 1 : 0; r < n; r += 2) {
            const i64 before = r > 0 ? r - 1 : 1, after = r + 1 < n ? r + 1 : r - 1;
            lift(rows + r * stride, rows + before * stride, rows + after * stride, factor, width);
        }
    }
}

// One level on the halves of a row. `even` has room for one number after its end, `odd` for one before and one after.
template <class T>
FHASH_INLINE void lift_halves(T* even, T* odd, i64 n, i64 kind, bool inverse) {
    const i64 evens = half(n), odds = n / 2;
    if (kind == HAAR) {
        T* FHASH_RESTRICT low = even;
        T* FHASH_RESTRICT high = odd;
        if (inverse) {
            for (i64 i = 0; i < odds; i++) low[i] -= T(0.5) * high[i];
            for (i64 i = 0; i < odds; i++) high[i] += low[i];
        } else {
            for (i64 i = 0; i < odds; i++) high[i] -= low[i];
            for (i64 i = 0; i < odds; i++) low[i] += T(0.5) * high[i];
        }
        return;
    }
    const Step* steps = steps_of(kind);
    const int count = steps_in(kind);
    for (int s = 0; s < count; s++) {
        const Step step = steps[inverse ? count - 1 - s : s];
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

template <class T>
FHASH_INLINE void split(const T* FHASH_RESTRICT row, T* FHASH_RESTRICT even, T* FHASH_RESTRICT odd, i64 n) {
    const i64 odds = n / 2;
    for (i64 i = 0; i < odds; i++) {
        even[i] = row[2 * i];
        odd[i] = row[2 * i + 1];
    }
    if (n % 2) even[odds] = row[n - 1];
}

template <class T>
FHASH_INLINE void merge(T* FHASH_RESTRICT row, const T* FHASH_RESTRICT even, const T* FHASH_RESTRICT odd, i64 n) {
    const i64 odds = n / 2;
    for (i64 i = 0; i < odds; i++) {
        row[2 * i] = even[i];
        row[2 * i + 1] = odd[i];
    }
    if (n % 2) row[n - 1] = even[odds];
}

template <class T>
FHASH_INLINE void scaled(const T* FHASH_RESTRICT in, T* FHASH_RESTRICT out, T scale, const T* FHASH_RESTRICT scales, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (in[i] * scale) * scales[i];
}

// C (M rows, n <= WIDE) = A (M, depth) B (depth, ...), each sum over k ascending, from the first product on. Rows of B must be readable to
// WIDE.
template <class T, int M, int WIDE>
FHASH_INLINE void product_tile(const T* a, i64 a_stride, const T* FHASH_RESTRICT b, i64 b_stride, T* c, i64 c_stride, i64 depth, i64 n) {
    T sum[M][WIDE];
    for (int i = 0; i < M; i++)
        for (int j = 0; j < WIDE; j++) sum[i][j] = a[i * a_stride] * b[j];
    for (i64 k = 1; k < depth; k++)
        for (int i = 0; i < M; i++) {
            const T factor = a[i * a_stride + k];
            for (int j = 0; j < WIDE; j++) sum[i][j] += factor * b[k * b_stride + j];
        }
    for (int i = 0; i < M; i++) std::memcpy(c + i * c_stride, sum[i], static_cast<std::size_t>(n) * sizeof(T));
}

template <class T>
FHASH_INLINE void product(const T* a, i64 a_stride, const T* b, i64 b_stride, T* c, i64 c_stride, i64 m, i64 depth, i64 n) {
    constexpr int WIDE = 32;
    if (depth == 0) {
        for (i64 i = 0; i < m; i++) std::memset(c + i * c_stride, 0, static_cast<std::size_t>(n) * sizeof(T));
        return;
    }
    for (i64 j = 0; j < n; j += WIDE) {
        const i64 width = smaller(i64(WIDE), n - j);
        i64 i = 0;
        for (; i + 4 <= m; i += 4) {
            product_tile<T, 4, WIDE>(a + i * a_stride, a_stride, b + j, b_stride, c + i * c_stride + j, c_stride, depth, width);
        }
        for (; i < m; i++) product_tile<T, 1, WIDE>(a + i * a_stride, a_stride, b + j, b_stride, c + i * c_stride + j, c_stride, depth,
            width);
    }
}

FHASH_INLINE i64 padded(i64 n) { return (n + 31) / 32 * 32; }

template <class T>
struct Axis {
    i64 n, kind, depth, rank;
    const T* matrix;  // forward (rank, n), inverse (n, rank); along x the transpose

    FHASH_INLINE bool idle() const { return kind == NONE || (kind != KLT && (depth == 0 || n == 1)); }
};

// Where the rows of a block stand among the bands: slot[i] is the place, within the lifted block, of band entry i.
FHASH_INLINE void band_slots(i64 n, i64 depth, i64* slot) {
    i64 at = 0;
    for (i64 low = 0; low < n; low += i64(1) << depth) slot[at++] = low;
    for (i64 level = depth; level >= 1; level--)
        for (i64 high = i64(1) << (level - 1); high < n; high += i64(1) << level) slot[at++] = high;
}

// One axis of (n, inner), in place or from `in` to `out`. `work` holds block_room(...) numbers.
template <class T>
FHASH_INLINE void along_rows(const T* in, T* out, i64 inner, const Axis<T>& axis, bool inverse, T* work, i64* slot) {
    const i64 n = axis.n;
    const i64 width = padded(larger(32, smaller(smaller(BLOCK / n, 1024), inner) / 32 * 32));
    if (axis.kind != KLT) band_slots(n, axis.depth, slot);
    for (i64 from = 0; from < inner; from += width) {
        const i64 w = smaller(width, inner - from);
        const std::size_t bytes = static_cast<std::size_t>(w) * sizeof(T);
        if (axis.kind == KLT) {
            const i64 taken = inverse ? axis.rank : n, made = inverse ? n : axis.rank;
            for (i64 r = 0; r < taken; r++) std::memcpy(work + r * width, in + r * inner + from, bytes);
            product(axis.matrix, taken, work, width, out + from, inner, made, taken, w);
            for (i64 r = made; r < n; r++) std::memset(out + r * inner + from, 0, bytes);
        } else if (inverse) {
            for (i64 r = 0; r < n; r++) std::memcpy(work + slot[r] * width, in + r * inner + from, bytes);
            for (i64 l = axis.depth - 1; l >= 0; l--) lift_rows(work, (n + (i64(1) << l) - 1) >> l, width << l, w, axis.kind, true);
            for (i64 r = 0; r < n; r++) std::memcpy(out + r * inner + from, work + r * width, bytes);
        } else {
            for (i64 r = 0; r < n; r++) std::memcpy(work + r * width, in + r * inner + from, bytes);
            for (i64 l = 0; l < axis.depth; l++) lift_rows(work, (n + (i64(1) << l) - 1) >> l, width << l, w, axis.kind, false);
            for (i64 r = 0; r < n; r++) std::memcpy(out + r * inner + from, work + slot[r] * width, bytes);
        }
    }
}

// The x axis on its own, `rows` rows in place. `work` holds the halves of a row or ROWS rows, `matrix` the padded matrix of a KLT.
template <class T>
FHASH_INLINE void along_x(T* rows_at, i64 rows, const Axis<T>& axis, bool inverse, T* work, const T* matrix) {
    const i64 n = axis.n;
    if (axis.kind == KLT) {
        const i64 taken = inverse ? axis.rank : n, made = inverse ? n : axis.rank;
        for (i64 r = 0; r < rows; r += ROWS) {
            const i64 count = smaller(ROWS, rows - r);
            T* block = rows_at + r * n;
            std::memcpy(work, block, static_cast<std::size_t>(count * n) * sizeof(T));
            product(work, n, matrix, padded(made), block, n, count, taken, made);
            if (made < n)
                for (i64 i = 0; i < count; i++) std::memset(block + i * n + made, 0, static_cast<std::size_t>(n - made) * sizeof(T));
        }
        return;
    }
    T* even = work;
    T* odd = work + half(n) + 32;
    i64 lengths[MAX_DEPTH + 1];
    lengths[0] = n;
    for (i64 l = 0; l < axis.depth; l++) lengths[l + 1] = half(lengths[l]);
    for (i64 r = 0; r < rows; r++) {
        T* row = rows_at + r * n;
        for (i64 step = 0; step < axis.depth; step++) {
            const i64 l = inverse ? axis.depth - 1 - step : step, m = lengths[l];
            if (m < 2) continue;
            if (inverse) {
                std::memcpy(even, row, static_cast<std::size_t>(half(m)) * sizeof(T));
                std::memcpy(odd, row + half(m), static_cast<std::size_t>(m / 2) * sizeof(T));
                lift_halves(even, odd, m, axis.kind, true);
                merge(row, even, odd, m);
            } else {
                split(row, even, odd, m);
                lift_halves(even, odd, m, axis.kind, false);
                std::memcpy(row, even, static_cast<std::size_t>(half(m)) * sizeof(T));
                std::memcpy(row + half(m), odd, static_cast<std::size_t>(m / 2) * sizeof(T));
            }
        }
    }
}

// One level along y of the (ny, nx) corner of a plane, a strip of columns at a time.
template <class T>
FHASH_INLINE void plane_y(T* plane, i64 ny, i64 nx, i64 stride, i64 kind, bool inverse) {
    const i64 strip = larger(64, smaller(BLOCK / larger(ny, 1), 1024) / 16 * 16);
    for (i64 from = 0; from < nx; from += strip) lift_rows(plane + from, ny, stride, smaller(strip, nx - from), kind, inverse);
}

// Coupled y and x of one plane, then the norms: per level y, then x, of the low-low corner. `plane` is used up, `out` may not overlap it.
template <class T>
FHASH_INLINE void plane_forward(T* plane, T* out, const Axis<T>& y, const Axis<T>& x, T scale, const T* scales, T* work) {
    const i64 stride = x.n;
    i64 ny = y.n, nx = x.n;
    T* even = work;
    T* odd = work + half(nx) + 32;
    for (i64 l = 0; l < y.depth; l++) {
        const i64 low_y = half(ny), low_x = half(nx);
        plane_y(plane, ny, nx, stride, y.kind, false);
        for (i64 r = 0; r < ny; r++) {
            const i64 band_row = r % 2 ? low_y + r / 2 : r / 2;
            const bool kept = r % 2 == 0 && l + 1 < y.depth;
            const T* low = plane + r * stride;
            if (nx > 1) {
                split(plane + r * stride, even, odd, nx);
                lift_halves(even, odd, nx, x.kind, false);
                low = even;
                scaled(odd, out + band_row * stride + low_x, scale, scales + band_row * stride + low_x, nx - low_x);
            }
            if (kept) {
                std::memmove(plane + band_row * stride, low, static_cast<std::size_t>(low_x) * sizeof(T));
            } else {
                scaled(low, out + band_row * stride, scale, scales + band_row * stride, low_x);
            }
        }
        ny = low_y;
        nx = low_x;
    }
}

// The inverse of plane_forward, `in` to `plane`, which may not overlap.
template <class T>
FHASH_INLINE void plane_inverse(const T* in, T* plane, const Axis<T>& y, const Axis<T>& x, T scale, const T* scales, T* work) {
    const i64 stride = x.n;
    i64 ys[MAX_DEPTH + 1], xs[MAX_DEPTH + 1];
    ys[0] = y.n;
    xs[0] = x.n;
    for (i64 l = 0; l < y.depth; l++) {
        ys[l + 1] = half(ys[l]);
        xs[l + 1] = half(xs[l]);
    }
    T* even = work;
    T* odd = work + half(x.n) + 32;
    for (i64 l = y.depth - 1; l >= 0; l--) {
        const i64 ny = ys[l], nx = xs[l], low_y = ys[l + 1], low_x = xs[l + 1];
        for (i64 r = ny - 1; r >= 0; r--) {
            const i64 band_row = r % 2 ? low_y + r / 2 : r / 2;
            const i64 at = band_row * stride;
            if (r % 2 == 0 && l + 1 < y.depth) {
                std::memcpy(even, plane + at, static_cast<std::size_t>(low_x) * sizeof(T));
            } else {
                scaled(in + at, even, scale, scales + at, low_x);
            }
            if (nx > 1) {
                scaled(in + at + low_x, odd, scale, scales + at + low_x, nx - low_x);
                lift_halves(even, odd, nx, x.kind, true);
                merge(plane + r * stride, even, odd, nx);
            } else {
                plane[r * stride] = even[0];
            }
        }
        plane_y(plane, ny, nx, stride, y.kind, true);
    }
}

// The passes over a tile, compiled once per type and machine.
FHASH_CLONES void pass_rows(const float* in, float* out, i64 inner, const Axis<float>& axis, bool inverse, float* work, i64* slot) {
    along_rows<float>(in, out, inner, axis, inverse, work, slot);
}
FHASH_CLONES void pass_x(float* rows_at, i64 rows, const Axis<float>& axis, bool inverse, float* work, const float* matrix) {
    along_x<float>(rows_at, rows, axis, inverse, work, matrix);
}
FHASH_CLONES void pass_scale(const float* in, float* out, float scale, const float* scales, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (in[i] * scale) * scales[i];
}
FHASH_CLONES void pass_plane_forward(float* plane, float* out, const Axis<float>& y, const Axis<float>& x, float scale,
        const float* scales, float* work) {
    plane_forward<float>(plane, out, y, x, scale, scales, work);
}
FHASH_CLONES void pass_plane_inverse(const float* in, float* plane, const Axis<float>& y, const Axis<float>& x, float scale,
        const float* scales, float* work) {
    plane_inverse<float>(in, plane, y, x, scale, scales, work);
}
FHASH_CLONES void pass_rows(const double* in, double* out, i64 inner, const Axis<double>& axis, bool inverse, double* work, i64* slot) {
    along_rows<double>(in, out, inner, axis, inverse, work, slot);
}
FHASH_CLONES void pass_x(double* rows_at, i64 rows, const Axis<double>& axis, bool inverse, double* work, const double* matrix) {
    along_x<double>(rows_at, rows, axis, inverse, work, matrix);
}
FHASH_CLONES void pass_scale(const double* in, double* out, double scale, const double* scales, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (in[i] * scale) * scales[i];
}
FHASH_CLONES void pass_plane_forward(double* plane, double* out, const Axis<double>& y, const Axis<double>& x, double scale,
        const double* scales, double* work) {
    plane_forward<double>(plane, out, y, x, scale, scales, work);
}
FHASH_CLONES void pass_plane_inverse(const double* in, double* plane, const Axis<double>& y, const Axis<double>& x, double scale,
        const double* scales, double* work) {
    plane_inverse<double>(in, plane, y, x, scale, scales, work);
}

template <class T>
i64 tile(const T* in, T* out, const i64* shape, const i64* kinds, const i64* depths, const i64* ranks, const T* const* matrices,
        const T* scale_tz,
         const T* scale_yx, bool inverse) {
    Axis<T> axes[4];
    i64 longest = 1;
    for (int a = 0; a < 4; a++) {
        axes[a] = {shape[a], kinds[a], depths[a], ranks[a], matrices[a]};
        if (shape[a] < 1 || kinds[a] < NONE || kinds[a] > KLT || depths[a] < 0 || depths[a] > MAX_DEPTH) return -1;
        if (kinds[a] == KLT && (ranks[a] < 0 || ranks[a] > shape[a] || !matrices[a])) return -1;
        longest = larger(longest, shape[a]);
    }
    const Axis<T>&t = axes[0], &z = axes[1], &y = axes[2], &x = axes[3];
    const i64 plane = y.n * x.n, slab = z.n * plane;
    const bool coupled = y.kind == x.kind && y.depth == x.depth && y.kind != NONE && y.kind != KLT && y.depth > 0;
    const i64 x_made = inverse ? x.n : x.rank, x_taken = inverse ? x.rank : x.n;
    const i64 matrix_room = x.kind == KLT ? x_taken * padded(x_made) + 64 : 0;
    const i64 work_room = larger(larger(BLOCK, longest * 32) + 64 * longest, ROWS * x.n) + x.n + 256;
    const i64 room = work_room + matrix_room + plane;
    T* work = static_cast<T*>(std::malloc(static_cast<std::size_t>(room) * sizeof(T)));
    i64* slot = static_cast<i64*>(std::malloc(static_cast<std::size_t>(longest) * sizeof(i64)));
    if (!work || !slot) {
        std::free(work);
        std::free(slot);
        return -2;
    }
    std::memset(work, 0, static_cast<std::size_t>(work_room + matrix_room) * sizeof(T));
    T* matrix = work + work_room;
    T* spare = matrix + matrix_room;
    if (x.kind == KLT)
        for (i64 k = 0; k < x_taken; k++)
            std::memcpy(matrix + k * padded(x_made), x.matrix + k * x_made, static_cast<std::size_t>(x_made) * sizeof(T));

    if (!inverse && !t.idle()) {
        pass_rows(in, out, slab, t, false, work, slot);
        in = out;
    }
    for (i64 i = 0; i < t.n; i++) {
        const T* from = in + i * slab;
        T* to = out + i * slab;
        if (!inverse && !z.idle()) {
            pass_rows(from, to, plane, z, false, work, slot);
            from = to;
        }
        for (i64 k = 0; k < z.n; k++) {
            const T scale = scale_tz[i * z.n + k];
            const T* source = from + k * plane;
            T* target = to + k * plane;
            if (coupled && inverse) {
                pass_plane_inverse(source, target, y, x, scale, scale_yx, work);
            } else if (coupled) {
                std::memcpy(spare, source, static_cast<std::size_t>(plane) * sizeof(T));
                pass_plane_forward(spare, target, y, x, scale, scale_yx, work);
            } else if (inverse) {
                pass_scale(source, target, scale, scale_yx, plane);
                if (!x.idle()) pass_x(target, y.n, x, true, work, matrix);
                if (!y.idle()) pass_rows(target, target, x.n, y, true, work, slot);
            } else {
                if (source != target) std::memcpy(target, source, static_cast<std::size_t>(plane) * sizeof(T));
                if (!y.idle()) pass_rows(target, target, x.n, y, false, work, slot);
                if (!x.idle()) pass_x(target, y.n, x, false, work, matrix);
                pass_scale(target, target, scale, scale_yx, plane);
            }
        }
        if (inverse && !z.idle()) pass_rows(to, to, plane, z, true, work, slot);
    }
    if (inverse && !t.idle()) pass_rows(out, out, slab, t, true, work, slot);
    std::free(work);
    std::free(slot);
    return 0;
}

}  // namespace

// `in` and `out`: C-order arrays of `shape` that do not overlap. kinds: 0 none, 1 Haar, 2 5/3, 3 9/7, 4 KLT. `tz` (t, z) and `yx` (y, x):
// the factors of the norms, or of their reciprocals. Returns 0, -1 for an argument out of range, -2 where memory ran out.
FHASH_EXPORT i64 fhash_transform_forward_f32(const float* in, float* out, const i64* shape, const i64* kinds, const i64* depths,
                                             const i64* ranks, const float* const* matrices, const float* tz, const float* yx) {
    return tile<float>(in, out, shape, kinds, depths, ranks, matrices, tz, yx, false);
}
FHASH_EXPORT i64 fhash_transform_inverse_f32(const float* in, float* out, const i64* shape, const i64* kinds, const i64* depths,
                                             const i64* ranks, const float* const* matrices, const float* tz, const float* yx) {
    return tile<float>(in, out, shape, kinds, depths, ranks, matrices, tz, yx, true);
}
FHASH_EXPORT i64 fhash_transform_forward_f64(const double* in, double* out, const i64* shape, const i64* kinds, const i64* depths,
                                             const i64* ranks, const double* const* matrices, const double* tz, const double* yx) {
    return tile<double>(in, out, shape, kinds, depths, ranks, matrices, tz, yx, false);
}
FHASH_EXPORT i64 fhash_transform_inverse_f64(const double* in, double* out, const i64* shape, const i64* kinds, const i64* depths,
                                             const i64* ranks, const double* const* matrices, const double* tz, const double* yx) {
    return tile<double>(in, out, shape, kinds, depths, ranks, matrices, tz, yx, true);
}
