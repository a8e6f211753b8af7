// Forward and inverse transform of one tile (t, z, y, x): lifting wavelets and matrix products.
// tests/reference/transform.py computes the same bits in numpy.
//
// Along t, z and y a block of columns is gathered into a small buffer, lifted there through all
// levels in place (level l at stride 2^l), and scattered to the bands, low first. Along x a row is
// split into its even and odd halves. Coupled y and x go level by level through one plane at a
// time.
#include "loops.hpp"

#include <functional>
#include <vector>

#include "core.hpp"
#include "functions.h"
#include "guard.hpp"
#include "lifting_tile.hpp"
#include "threads.hpp"

namespace {

template <class T>
bool sound(const Axis<T>& axis) {
    if (axis.n < 1 || axis.kind < NONE || axis.kind > KLT) return false;
    if (axis.depth < 0 || axis.depth > MAX_DEPTH) return false;
    return axis.kind != KLT || (axis.rank >= 0 && axis.rank <= axis.n && axis.matrix);
}

// The axes of a tile; whether all are in range.
template <class T>
bool read_axes(const i64* shape, const i64* kinds, const i64* depths, const i64* ranks,
               const T* const* matrices, Axis<T>* axes) {
    for (int a = 0; a < 4; a++) {
        axes[a] = {shape[a], kinds[a], depths[a], ranks[a], matrices[a]};
        if (!sound(axes[a])) return false;
    }
    return true;
}

// A tile whose passes are done in stripes, by some threads.
template <class T>
struct Stripes {
    std::vector<Tile<T>> tiles;  // one for each thread
    i64 error = 0;

    Stripes(const i64* shape, const i64* kinds, const i64* depths, const i64* ranks,
            const T* const* matrices, const T* scale_tz, const T* scale_yx, i64 threads,
            bool inverse) {
        Axis<T> axes[4];
        if (!read_axes(shape, kinds, depths, ranks, matrices, axes)) error = BAD_ARGUMENT;
        tiles.reserve((std::size_t)threads);
        for (i64 i = 0; i < threads && !error; i++) {
            tiles.emplace_back(axes, scale_tz, scale_yx, inverse);
            if (!tiles.back().allocated()) error = OUT_OF_MEMORY;
        }
    }

    // Calls `work` with a tile and the ends of each stripe of `n`, of whole blocks of `unit`.
    [[gnu::noinline]] void each(i64 n, i64 unit,
                                const std::function<void(Tile<T>&, i64, i64)>& work) {
        const i64 count = larger(smaller((i64)tiles.size(), n / unit), 1);
        const auto from = [&](i64 number) {
            return number == count ? n : n * number / count / unit * unit;
        };
        const auto run = [&](int number) {
            work(tiles[(std::size_t)number], from(number), from(number + 1));
        };
        if (count > 1) fhash::together((int)count, run);
        else run(0);
    }
};

constexpr i64 COLUMNS = 32;  // of a block: whole vectors

template <class T>
[[gnu::noinline]] i64 transform(const T* in, T* out, const i64* shape, const i64* kinds,
                                const i64* depths, const i64* ranks, const T* const* matrices,
                                const T* scale_tz, const T* scale_yx, i64 threads, bool inverse) {
    return guarded([&]() -> i64 {
        Stripes<T> of(shape, kinds, depths, ranks, matrices, scale_tz, scale_yx, threads, inverse);
        if (of.error) return of.error;
        const bool idle = of.tiles[0].time_is_idle();
        const auto over_time = [&](const T* from) {
            of.each(shape[1] * shape[2] * shape[3], COLUMNS, [&](Tile<T>& tile, i64 a, i64 b) {
                tile.over_time(from, out, a, b);
            });
        };
        if (!inverse && !idle) over_time(in);
        const T* const frames = inverse || idle ? in : out;
        of.each(shape[0], 1, [&](Tile<T>& tile, i64 a, i64 b) { tile.frames(frames, out, a, b); });
        if (inverse && !idle) over_time(out);
        return 0;
    });
}

// numbers: step, the six offsets, then center, low and high.
template <class T>
i64 reconstruct(const std::int32_t* in, T* out, const i64* shape, const i64* kinds,
                const i64* depths, const i64* ranks, const T* const* matrices, const T* scale_tz,
                const T* scale_yx, i64 threads, const double* numbers) {
    return guarded([&]() -> i64 {
        Stripes<T> of(shape, kinds, depths, ranks, matrices, scale_tz, scale_yx, threads, true);
        if (of.error) return of.error;
        Reconstruction<T> values = {(T)numbers[0], {}};
        for (int i = 1; i <= 6; i++) values.offsets[i] = (T)numbers[i];
        const Limits<T> limits = {(T)numbers[7], (T)numbers[8], (T)numbers[9]};
        std::vector<unsigned char> filled((std::size_t)shape[0]);
        of.each(shape[0], 1, [&](Tile<T>& tile, i64 a, i64 b) {
            tile.reconstruct_frames(in, out, values, limits, filled.data(), a, b);
        });
        if (of.tiles[0].time_is_idle()) return 0;
        of.each(shape[1] * shape[2] * shape[3], COLUMNS, [&](Tile<T>& tile, i64 a, i64 b) {
            tile.over_time(out, out, a, b, &limits, filled.data());
        });
        return 0;
    });
}

}  // namespace

// in, out: C-ordered arrays of `shape` that do not overlap. kinds: 0 none, 1 Haar, 2 5/3, 3 9/7,
// 4 KLT. tz (t, z), yx (y, x): the factors of the norms, or of their reciprocals. threads: that
// share the work, 1 or more; they change no bit. Returns 0, or -1 for an argument out of range, or
// -2 where memory ran out.
FHASH_KERNEL i64 fhash_transform_forward_f32(const float* in, float* out, const i64* shape,
                                             const i64* kinds, const i64* depths, const i64* ranks,
                                             const float* const* matrices, const float* tz,
                                             const float* yx, std::int64_t threads) {
    return transform<float>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                            threads, false);
}
FHASH_KERNEL i64 fhash_transform_inverse_f32(const float* in, float* out, const i64* shape,
                                             const i64* kinds, const i64* depths, const i64* ranks,
                                             const float* const* matrices, const float* tz,
                                             const float* yx, std::int64_t threads) {
    return transform<float>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                            threads, true);
}
FHASH_KERNEL i64 fhash_transform_forward_f64(const double* in, double* out, const i64* shape,
                                             const i64* kinds, const i64* depths, const i64* ranks,
                                             const double* const* matrices, const double* tz,
                                             const double* yx, std::int64_t threads) {
    return transform<double>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                            threads, false);
}
FHASH_KERNEL i64 fhash_transform_inverse_f64(const double* in, double* out, const i64* shape,
                                             const i64* kinds, const i64* depths, const i64* ranks,
                                             const double* const* matrices, const double* tz,
                                             const double* yx, std::int64_t threads) {
    return transform<double>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                            threads, true);
}

// The values of a tile from its integers: numbers as in quantise.cpp, the inverse transform, and
// the clip of values.cpp, in one run. Zeros that only differ in sign before `center` is added may
// differ from those of the three.
//
// in: may be the memory of a float `out`.
// numbers: step, six offsets (of |q| = 1, 2, 3, 4, odd ones from 5 on, even ones from 6 on, in
// steps), center (not -0), low, high.
//
// The other arguments and the result are those of the inverse transform.
FHASH_KERNEL i64 fhash_reconstruct_f32(const std::int32_t* in, float* out, const i64* shape,
                                       const i64* kinds, const i64* depths, const i64* ranks,
                                       const float* const* matrices, const float* tz,
                                       const float* yx, std::int64_t threads,
                                       const double* numbers) {
    return reconstruct<float>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                              threads, numbers);
}
FHASH_KERNEL i64 fhash_reconstruct_f64(const std::int32_t* in, double* out, const i64* shape,
                                       const i64* kinds, const i64* depths, const i64* ranks,
                                       const double* const* matrices, const double* tz,
                                       const double* yx, std::int64_t threads,
                                       const double* numbers) {
    return reconstruct<double>(in, out, shape, kinds, depths, ranks, matrices, tz, yx,
                              threads, numbers);
}
