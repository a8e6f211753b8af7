// The transform of one tile: its passes and their order.
#pragma once

#include <cstdlib>
#include <cstring>
#include <memory>

#include "core.hpp"
#include "lifting.hpp"

namespace {

constexpr i64 BAD_ARGUMENT = -1;
constexpr i64 OUT_OF_MEMORY = -2;
constexpr i64 MAX_DEPTH = 10;
constexpr i64 BLOCK = 8192;  // numbers in the column buffer: 32 kB of float32
constexpr i64 ROWS = 32;     // rows of x that go through a matrix product at once
constexpr i64 GAP = 32;      // numbers between the even and the odd half of a row

template <class T>
struct Axis {
    i64 n, kind, depth, rank;
    const T* matrix;  // forward (rank, n), inverse (n, rank); along x the transpose

    FHASH_INLINE bool idle() const {
        return kind == NONE || (kind != KLT && (depth == 0 || n == 1));
    }
    // Rows and columns of the matrix.
    FHASH_INLINE i64 outputs(bool inverse) const { return inverse ? n : rank; }
    FHASH_INLINE i64 inputs(bool inverse) const { return inverse ? rank : n; }
};

// A shift of values, and the range that they are clipped to.
template <class T>
struct Limits {
    T center, low, high;
};

// Values moved and clipped as in values.cpp: NaN stays. `out` may be `in`.
template <class T>
FHASH_INLINE void limited(const T* in, T* out, i64 n, const Limits<T>& limits) {
    const T center = limits.center, low = limits.low, high = limits.high;
    for (i64 i = 0; i < n; i++) {
        const T value = in[i] + center;
        const T raised = value < low ? low : value;
        out[i] = raised > high ? high : raised;
    }
}

// The place in a lifted block, slot[i], of each entry i of the bands.
FHASH_INLINE void band_slots(i64 n, i64 depth, i64* slot) {
    i64 entry = 0;
    for (i64 low = 0; low < n; low += i64(1) << depth) slot[entry++] = low;
    for (i64 level = depth; level >= 1; level--)
        for (i64 high = i64(1) << (level - 1); high < n; high += i64(1) << level)
            slot[entry++] = high;
}

// One level of lifting on a block of rows, of which every 2^level-th takes part.
template <class T>
FHASH_INLINE void lift_level(T* block, i64 n, i64 level, i64 pitch, i64 width, i64 kind,
                             bool inverse) {
    lift_rows(block, (n + (i64(1) << level) - 1) >> level, pitch << level, width, kind, inverse);
}

// Columns of a block of some rows of `inner` numbers.
FHASH_INLINE i64 pitch_of(i64 rows, i64 inner) {
    return padded(larger(32, smaller(smaller(BLOCK / larger(rows, 1), 1024), inner) / 32 * 32));
}

// The product of a KLT along one axis of (n, inner), of some columns, in place or from `in` to
// `out`. filled: null,
// or which rows of `in` have a number other than 0; the others are not read. `work` holds a block
// of columns, `matrix` has room for the columns of the matrix that are left.
template <class T>
FHASH_INLINE void product_rows(const T* in, T* out, i64 inner, i64 first, i64 last,
                               const Axis<T>& axis, bool inverse, T* work, i64* slot,
                               const Limits<T>* limits, const unsigned char* filled,
                               T* matrix) {
    const i64 n = axis.n, inputs = axis.inputs(inverse), outputs = axis.outputs(inverse);
    i64 terms = 0;
    for (i64 r = 0; r < inputs; r++)
        if (!filled || filled[r]) slot[terms++] = r;
    const T* used = axis.matrix;
    if (terms < inputs) {
        for (i64 i = 0; i < outputs; i++)
            for (i64 k = 0; k < terms; k++)
                matrix[i * terms + k] = axis.matrix[i * inputs + slot[k]];
        used = matrix;
    }
    const i64 pitch = pitch_of(terms, inner);
    for (i64 from = first; from < last; from += pitch) {
        const i64 width = smaller(pitch, last - from);
        const std::size_t bytes = bytes_of<T>(width);
        for (i64 k = 0; k < terms; k++)
            std::memcpy(work + k * pitch, in + slot[k] * inner + from, bytes);
        product(used, terms, work, pitch, out + from, inner, outputs, terms, width);
        for (i64 r = outputs; r < n; r++) std::memset(out + r * inner + from, 0, bytes);
        if (limits)
            for (i64 r = 0; r < n; r++)
                limited(out + r * inner + from, out + r * inner + from, width, *limits);
    }
}

// The wavelet along one axis of (n, inner), in place or from `in` to `out`. `work` holds a block of
// columns. limits: null, or what the results of the inverse are moved by and clipped to.
template <class T>
FHASH_INLINE void along_rows(const T* in, T* out, i64 inner, i64 first, i64 last,
                             const Axis<T>& axis, bool inverse, T* work, i64* slot,
                             const Limits<T>* limits) {
    const i64 n = axis.n, pitch = pitch_of(n, inner);
    band_slots(n, axis.depth, slot);
    for (i64 from = first; from < last; from += pitch) {
        const i64 width = smaller(pitch, last - from);
        const std::size_t bytes = bytes_of<T>(width);
        if (inverse) {
            for (i64 r = 0; r < n; r++)
                std::memcpy(work + slot[r] * pitch, in + r * inner + from, bytes);
            for (i64 l = axis.depth - 1; l >= 0; l--)
                lift_level(work, n, l, pitch, width, axis.kind, true);
            for (i64 r = 0; r < n; r++) {
                if (limits) {
                    limited(work + r * pitch, out + r * inner + from, width, *limits);
                } else {
                    std::memcpy(out + r * inner + from, work + r * pitch, bytes);
                }
            }
        } else {
            for (i64 r = 0; r < n; r++)
                std::memcpy(work + r * pitch, in + r * inner + from, bytes);
            for (i64 l = 0; l < axis.depth; l++)
                lift_level(work, n, l, pitch, width, axis.kind, false);
            for (i64 r = 0; r < n; r++)
                std::memcpy(out + r * inner + from, work + slot[r] * pitch, bytes);
        }
    }
}

// A KLT along x of `rows` rows, in place. `work` holds ROWS rows, `matrix` the padded matrix.
template <class T>
FHASH_INLINE void product_x(T* first, i64 rows, const Axis<T>& axis, bool inverse, T* work,
                            const T* matrix) {
    const i64 n = axis.n, inputs = axis.inputs(inverse), outputs = axis.outputs(inverse);
    for (i64 r = 0; r < rows; r += ROWS) {
        const i64 count = smaller(ROWS, rows - r);
        T* block = first + r * n;
        std::memcpy(work, block, bytes_of<T>(count * n));
        product(work, n, matrix, padded(outputs), block, n, count, inputs, outputs);
        if (outputs == n) continue;
        for (i64 i = 0; i < count; i++)
            std::memset(block + i * n + outputs, 0, bytes_of<T>(n - outputs));
    }
}

// The x axis on its own, of `rows` rows in place. `work` holds the halves of a row or ROWS rows,
// `matrix` the padded matrix of a KLT.
template <class T>
FHASH_INLINE void along_x(T* first, i64 rows, const Axis<T>& axis, bool inverse, T* work,
                          const T* matrix) {
    if (axis.kind == KLT) {
        product_x(first, rows, axis, inverse, work, matrix);
        return;
    }
    T* even = work;
    T* odd = work + half(axis.n) + GAP;
    i64 lengths[MAX_DEPTH + 1];
    lengths[0] = axis.n;
    for (i64 l = 0; l < axis.depth; l++) lengths[l + 1] = half(lengths[l]);
    for (i64 r = 0; r < rows; r++) {
        T* row = first + r * axis.n;
        for (i64 step = 0; step < axis.depth; step++) {
            const i64 m = lengths[inverse ? axis.depth - 1 - step : step];
            if (m < 2) continue;
            if (inverse) {
                std::memcpy(even, row, bytes_of<T>(half(m)));
                std::memcpy(odd, row + half(m), bytes_of<T>(m / 2));
                lift_halves(even, odd, m, axis.kind, true);
                merge(row, even, odd, m);
            } else {
                split(row, even, odd, m);
                lift_halves(even, odd, m, axis.kind, false);
                std::memcpy(row, even, bytes_of<T>(half(m)));
                std::memcpy(row + half(m), odd, bytes_of<T>(m / 2));
            }
        }
    }
}

// One level along y of the (ny, nx) corner of a plane, a strip of columns at a time.
template <class T>
FHASH_INLINE void plane_y(T* plane, i64 ny, i64 nx, i64 stride, i64 kind, bool inverse) {
    const i64 strip = larger(64, smaller(BLOCK / larger(ny, 1), 1024) / 16 * 16);
    for (i64 from = 0; from < nx; from += strip)
        lift_rows(plane + from, ny, stride, smaller(strip, nx - from), kind, inverse);
}

// Coupled y and x of one plane, then the norms: each level goes along y, then x, of the low-low
// corner. `plane` is overwritten; `out` may not overlap it.
template <class T>
FHASH_INLINE void plane_forward(T* plane, T* out, const Axis<T>& y, const Axis<T>& x, T scale,
                                const T* scales, T* work) {
    const i64 stride = x.n;
    i64 ny = y.n, nx = x.n;
    T* even = work;
    T* odd = work + half(nx) + GAP;
    for (i64 l = 0; l < y.depth; l++) {
        const i64 low_y = half(ny), low_x = half(nx);
        plane_y(plane, ny, nx, stride, y.kind, false);
        for (i64 r = 0; r < ny; r++) {
            const i64 at = (r % 2 ? low_y + r / 2 : r / 2) * stride;
            const bool in_low_band = r % 2 == 0 && l + 1 < y.depth;
            const T* low = plane + r * stride;
            if (nx > 1) {
                split(plane + r * stride, even, odd, nx);
                lift_halves(even, odd, nx, x.kind, false);
                low = even;
                scaled(odd, out + at + low_x, scale, scales + at + low_x, nx - low_x);
            }
            if (in_low_band) {
                std::memmove(plane + at, low, bytes_of<T>(low_x));
            } else {
                scaled(low, out + at, scale, scales + at, low_x);
            }
        }
        ny = low_y;
        nx = low_x;
    }
}

// The inverse of plane_forward, from `in` to `plane`, which may not overlap. filled: null, or which
// rows of `in` have a number other than 0.
template <class T>
FHASH_INLINE void plane_inverse(const T* in, T* plane, const Axis<T>& y, const Axis<T>& x, T scale,
                                const T* scales, T* work, const unsigned char* filled) {
    const i64 stride = x.n;
    i64 ys[MAX_DEPTH + 1], xs[MAX_DEPTH + 1];
    ys[0] = y.n;
    xs[0] = x.n;
    for (i64 l = 0; l < y.depth; l++) {
        ys[l + 1] = half(ys[l]);
        xs[l + 1] = half(xs[l]);
    }
    T* even = work;
    T* odd = work + half(x.n) + GAP;
    for (i64 l = y.depth - 1; l >= 0; l--) {
        const i64 ny = ys[l], nx = xs[l], low_y = ys[l + 1], low_x = xs[l + 1];
        for (i64 r = ny - 1; r >= 0; r--) {
            const i64 band_row = r % 2 ? low_y + r / 2 : r / 2, at = band_row * stride;
            if (r % 2 == 0 && l + 1 < y.depth) {
                std::memcpy(even, plane + at, bytes_of<T>(low_x));
            } else if (filled && !filled[band_row]) {
                // Lifting makes zeros of zeros.
                std::memset(plane + r * stride, 0, bytes_of<T>(nx));
                continue;
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

// The numbers that integers q stand for: sign(q) (|q| + offset) step, and 0 for 0. The offsets are
// of |q| = 0 (which is 0), 1, 2, 3, 4, odd ones from 5 on, even ones from 6 on, in steps.
template <class T>
struct Reconstruction {
    T step, offsets[7];
};

// Whether any of n integers is not 0.
FHASH_CLONES bool any_integer(const std::int32_t* in, i64 n) {
    for (i64 from = 0; from < n; from += 1024) {
        const i64 end = smaller(from + 1024, n);
        std::int32_t all = 0;
        for (i64 i = from; i < end; i++) all |= in[i];
        if (all) return true;
    }
    return false;
}

// Rows of integers to numbers; filled: which rows have one other than 0.
template <class T>
FHASH_INLINE void reconstructed_rows(const std::int32_t* in, i64 rows, i64 columns,
                                     const Reconstruction<T>& values, T* FHASH_RESTRICT out,
                                     unsigned char* FHASH_RESTRICT filled) {
    const Reconstruction<T> of = values;
    for (i64 r = 0; r < rows; r++) {
        const std::int32_t* const row = in + r * columns;
        T* FHASH_RESTRICT const to = out + r * columns;
        std::int32_t all = 0;
        for (i64 i = 0; i < columns; i++) all |= row[i];
        filled[r] = all != 0;
        if (!all) {
            std::memset(to, 0, bytes_of<T>(columns));
            continue;
        }
        for (i64 i = 0; i < columns; i++) {
            // Choices one after the other, which are faster than a table.
            const std::int32_t q = row[i], magnitude = q < 0 ? -q : q;
            T offset = magnitude & 1 ? of.offsets[5] : of.offsets[6];
            offset = magnitude == 4 ? of.offsets[4] : offset;
            offset = magnitude == 3 ? of.offsets[3] : offset;
            offset = magnitude == 2 ? of.offsets[2] : offset;
            offset = magnitude == 1 ? of.offsets[1] : offset;
            offset = magnitude == 0 ? of.offsets[0] : offset;
            const T value = ((T)magnitude + offset) * of.step;
            to[i] = q < 0 ? -value : value;
        }
    }
}

// The passes over a tile, compiled once per type and machine.
#define FHASH_PASSES(T) \
    FHASH_CLONES void pass_rows(const T* in, T* out, i64 inner, i64 first, i64 last, \
                                const Axis<T>& axis, bool inverse, T* work, i64* slot, \
                                const Limits<T>* limits) { \
        along_rows<T>(in, out, inner, first, last, axis, inverse, work, slot, limits); \
    } \
    FHASH_CLONES void pass_product(const T* in, T* out, i64 inner, i64 first, i64 last, \
                                   const Axis<T>& axis, bool inverse, T* work, i64* slot, \
                                   const Limits<T>* limits, const unsigned char* filled, \
                                   T* matrix) { \
        product_rows<T>(in, out, inner, first, last, axis, inverse, work, slot, limits, filled, \
                        matrix); \
    } \
    FHASH_CLONES void pass_x(T* first, i64 rows, const Axis<T>& axis, bool inverse, T* work, \
                             const T* matrix) { \
        along_x<T>(first, rows, axis, inverse, work, matrix); \
    } \
    FHASH_CLONES void pass_scale(const T* in, T* out, T scale, const T* scales, i64 n) { \
        for (i64 i = 0; i < n; i++) out[i] = (in[i] * scale) * scales[i]; \
    } \
    FHASH_CLONES void pass_plane_forward(T* plane, T* out, const Axis<T>& y, const Axis<T>& x, \
                                         T scale, const T* scales, T* work) { \
        plane_forward<T>(plane, out, y, x, scale, scales, work); \
    } \
    FHASH_CLONES void pass_plane_inverse(const T* in, T* plane, const Axis<T>& y, \
                                         const Axis<T>& x, T scale, const T* scales, T* work, \
                                         const unsigned char* filled) { \
        plane_inverse<T>(in, plane, y, x, scale, scales, work, filled); \
    } \
    FHASH_CLONES void pass_limits(T* values, i64 n, const Limits<T>& limits) { \
        limited<T>(values, values, n, limits); \
    } \
    FHASH_CLONES void pass_integers(const std::int32_t* in, i64 rows, i64 columns, \
                                    const Reconstruction<T>& values, T* out, \
                                    unsigned char* filled) { \
        reconstructed_rows<T>(in, rows, columns, values, out, filled); \
    }

FHASH_PASSES(float)
FHASH_PASSES(double)

struct Free {
    void operator()(void* memory) const { std::free(memory); }
};

template <class T>
std::unique_ptr<T[], Free> allocate(i64 n) {
    return std::unique_ptr<T[], Free>(static_cast<T*>(std::malloc(bytes_of<T>(n))));
}

// The transform of one tile: its axes, the factors of (t, z) and (y, x), and scratch memory.
template <class T>
class Tile {
public:
    Tile(const Axis<T>* axes, const T* scale_tz_, const T* scale_yx_, bool inverse)
        : t(axes[0]), z(axes[1]), y(axes[2]), x(axes[3]), plane(y.n * x.n),
          coupled(y.kind == x.kind && y.depth == x.depth && y.kind != NONE && y.kind != KLT &&
                  y.depth > 0),
          is_inverse(inverse), scale_tz(scale_tz_), scale_yx(scale_yx_) {
        i64 longest = 1, room = 0;
        for (int a = 0; a < 4; a++) {
            longest = larger(longest, axes[a].n);
            if (a < 3 && axes[a].kind == KLT) room = larger(room, axes[a].n * axes[a].rank);
        }
        const i64 pitch = padded(x.outputs(inverse));
        const i64 matrix_room = x.kind == KLT ? x.inputs(inverse) * pitch + 64 : 0;
        const i64 block_room = larger(BLOCK, longest * 32) + 64 * longest;
        const i64 work_room = larger(block_room, ROWS * x.n) + x.n + 256;
        memory = allocate<T>(work_room + matrix_room + plane + room);
        slots = allocate<i64>(longest);
        filled = allocate<unsigned char>(y.n + z.n);
        if (!allocated()) return;
        work = memory.get();
        matrix = work + work_room;
        spare = matrix + matrix_room;
        columns = spare + plane;
        std::memset(work, 0, bytes_of<T>(work_room + matrix_room));
        if (x.kind != KLT) return;
        const i64 width = x.outputs(inverse);
        for (i64 k = 0; k < x.inputs(inverse); k++)
            std::memcpy(matrix + k * pitch, x.matrix + k * width, bytes_of<T>(width));
    }

    bool allocated() const { return memory && slots && filled; }

    // The axis of time, of some columns. The last two arguments are those of product_rows.
    void over_time(const T* in, T* out, i64 first, i64 last, const Limits<T>* limits = nullptr,
                   const unsigned char* some = nullptr) {
        rows(in, out, z.n * plane, first, last, t, limits, some);
    }

    bool time_is_idle() const { return t.idle(); }

    // The other axes of some steps; `in` may be `out` where it goes forward.
    void frames(const T* in, T* out, i64 first, i64 last) {
        if (is_inverse) inverse_frames(in, out, first, last);
        else forward_frames(in, out, first, last);
    }
    // The inverse from integers, but for the axis of time, of some steps; where that is idle, moved
    // and clipped. in: may be the memory of `out` where numbers have the size of integers. frames:
    // receives which steps have an integer other than 0.
    void reconstruct_frames(const std::int32_t* in, T* out, const Reconstruction<T>& values,
                            const Limits<T>& limits, unsigned char* frames, i64 first, i64 last) {
        unsigned char* const planes = filled.get() + y.n;
        for (i64 i = first; i < last; i++) {
            T* const frame = out + i * z.n * plane;
            frames[i] = 0;
            for (i64 k = 0; k < z.n; k++) {
                const std::int32_t* const from = in + (i * z.n + k) * plane;
                T* const to = frame + k * plane;
                planes[k] = any_integer(from, plane);
                if (planes[k]) {
                    pass_integers(from, y.n, x.n, values, spare, filled.get());
                    inverse_plane(spare, to, scale_tz[i * z.n + k], filled.get());
                    frames[i] = 1;
                } else if (z.kind != KLT) {  // a product does not read what is 0, and writes all
                    std::memset(to, 0, bytes_of<T>(plane));
                }
            }
            // The last of the axes that are not idle clips.
            const Limits<T>* const clips = t.idle() ? &limits : nullptr;
            if (!frames[i]) {
                if (t.kind != KLT) std::memset(frame, 0, bytes_of<T>(z.n * plane));
                if (clips) pass_limits(frame, z.n * plane, limits);
            } else if (!z.idle()) {
                rows(frame, frame, plane, 0, plane, z, clips, planes);
            } else if (clips) {
                pass_limits(frame, z.n * plane, limits);
            }
        }
    }

private:
    void forward_frames(const T* in, T* out, i64 first, i64 last) {
        for (i64 i = first; i < last; i++) {
            const T* from = in + i * z.n * plane;
            T* to = out + i * z.n * plane;
            if (!z.idle()) {
                rows(from, to, plane, 0, plane, z);
                from = to;
            }
            for (i64 k = 0; k < z.n; k++)
                forward_plane(from + k * plane, to + k * plane, scale_tz[i * z.n + k]);
        }
    }

    void inverse_frames(const T* in, T* out, i64 first, i64 last) {
        for (i64 i = first; i < last; i++) {
            const T* from = in + i * z.n * plane;
            T* to = out + i * z.n * plane;
            for (i64 k = 0; k < z.n; k++)
                inverse_plane(from + k * plane, to + k * plane, scale_tz[i * z.n + k], nullptr);
            if (!z.idle()) rows(to, to, plane, 0, plane, z);
        }
    }

    // One axis of (n, inner); the arguments are those of product_rows.
    void rows(const T* from, T* to, i64 inner, i64 first, i64 last, const Axis<T>& axis,
              const Limits<T>* limits = nullptr, const unsigned char* some = nullptr) {
        if (axis.kind == KLT) {
            pass_product(from, to, inner, first, last, axis, is_inverse, work, slots.get(), limits,
                         some, columns);
        } else {
            pass_rows(from, to, inner, first, last, axis, is_inverse, work, slots.get(), limits);
        }
    }

    void forward_plane(const T* from, T* to, T scale) {
        if (coupled) {
            std::memcpy(spare, from, bytes_of<T>(plane));
            pass_plane_forward(spare, to, y, x, scale, scale_yx, work);
            return;
        }
        if (from != to) std::memcpy(to, from, bytes_of<T>(plane));
        if (!y.idle()) rows(to, to, x.n, 0, x.n, y);
        if (!x.idle()) pass_x(to, y.n, x, false, work, matrix);
        pass_scale(to, to, scale, scale_yx, plane);
    }

    void inverse_plane(const T* from, T* to, T scale, const unsigned char* some) {
        if (coupled) {
            pass_plane_inverse(from, to, y, x, scale, scale_yx, work, some);
            return;
        }
        pass_scale(from, to, scale, scale_yx, plane);
        if (!x.idle()) pass_x(to, y.n, x, true, work, matrix);
        if (!y.idle()) rows(to, to, x.n, 0, x.n, y);
    }

    const Axis<T> t, z, y, x;
    const i64 plane;
    const bool coupled, is_inverse;
    const T *scale_tz, *scale_yx;
    std::unique_ptr<T[], Free> memory;
    std::unique_ptr<i64[], Free> slots;
    std::unique_ptr<unsigned char[], Free> filled;
    T *work = nullptr, *matrix = nullptr, *spare = nullptr, *columns = nullptr;
};

}  // namespace
