// Vectors of the network's kernels: one source for AVX-512, AVX2 with FMA, and the baseline.
//
// A kernel is an always-inlined template on a path (`Path1`, `Path2`, `Path4`), written with the
// vector extensions of GCC and Clang. There are two ways to compile it for each path:
// - FHASH_PATHS, for a kernel of few lines: functions of three targets that inline it, and a
//   function that returns the one of a path.
// - A source file for each path, which defines FHASH_ONLY as the path's bit before it includes this
//   header: all that follows is compiled for that path. GCC lowers some vector expressions, above
//   all those that repeat a number, before it inlines a function into one of another target; then
//   they are built place by place. Nothing of the standard library but functions of C may be called
//   there: a copy of it for that path could be linked into others.
// Compilers without these extensions build a library that offers no path.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "core.hpp"

#if defined(__GNUC__)
#define FHASH_VECTORS 1
// All that is inlined here takes vectors: no call depends on how one passes them.
#pragma GCC diagnostic ignored "-Wpsabi"
#endif

// The bits of a machine's paths.
constexpr std::int64_t FHASH_PATH_BASELINE = 1;
constexpr std::int64_t FHASH_PATH_V3 = 2;
constexpr std::int64_t FHASH_PATH_V4 = 4;

// What an exported function returns for a path that the machine does not have.
constexpr std::int64_t FHASH_NO_PATH = -3;

#if defined(__x86_64__) && (defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 12))
#define FHASH_THREE_PATHS 1
#if defined(__clang__)  // zig takes away by name what "arch" would give
#define FHASH_TARGET_V3 "avx2,fma,bmi,bmi2,f16c,lzcnt,movbe"
#define FHASH_TARGET_V4 FHASH_TARGET_V3 ",avx512f,avx512bw,avx512cd,avx512dq,avx512vl"
#else
#define FHASH_TARGET_V3 "arch=x86-64-v3,tune=haswell"
#define FHASH_TARGET_V4 "arch=x86-64-v4,tune=icelake-server,prefer-vector-width=512"
#endif
#if defined(FHASH_ONLY) && defined(__clang__)  // FHASH_END takes it back
#if FHASH_ONLY == 4
#pragma clang attribute push(__attribute__((target(FHASH_TARGET_V4))), apply_to = function)
#define FHASH_END _Pragma("clang attribute pop")
#elif FHASH_ONLY == 2
#pragma clang attribute push(__attribute__((target(FHASH_TARGET_V3))), apply_to = function)
#define FHASH_END _Pragma("clang attribute pop")
#endif
#elif defined(FHASH_ONLY)
#if FHASH_ONLY == 4
#pragma GCC target("arch=x86-64-v4,tune=icelake-server,prefer-vector-width=512")
#elif FHASH_ONLY == 2
#pragma GCC target("arch=x86-64-v3,tune=haswell")
#endif
#endif
#endif

// The end of a source file for a path.
#if !defined(FHASH_END)
#define FHASH_END
#endif

#if defined(FHASH_VECTORS)

// A path: vectors of BYTES bytes, N numbers each, and the number of its registers.
template <int SIZE, int COUNT> struct Path {
    static constexpr int BYTES = SIZE, N = SIZE / 4, REGISTERS = COUNT;
    typedef float F __attribute__((vector_size(SIZE)));
    typedef std::int32_t I __attribute__((vector_size(SIZE)));
};
typedef Path<16, 16> Path1;
typedef Path<32, 16> Path2;
typedef Path<64, 32> Path4;

// Load and store at any address.
template <class P> FHASH_INLINE typename P::F loaded(const float* from) {
    typename P::F vector;
    std::memcpy(&vector, from, P::BYTES);
    return vector;
}
template <class P> FHASH_INLINE void store(float* to, typename P::F vector) {
    std::memcpy(to, &vector, P::BYTES);
}
// A vector with one number in all its places.
template <class P> FHASH_INLINE typename P::F all(float number) {
#if defined(FHASH_ONLY)
    return number - typename P::F{};
#else
    return typename P::F{} + number;  // an addition, but not lowered to places (see above)
#endif
}

#if defined(FHASH_THREE_PATHS)
#define FHASH_V4 __attribute__((target(FHASH_TARGET_V4)))
#define FHASH_V3 __attribute__((target(FHASH_TARGET_V3)))
// After a template `NAME_kernel<Path>`: its functions NAME_v4, NAME_v3 and NAME_v1, and NAME(path),
// which returns that of a path. PARAMETERS and ARGUMENTS stand in parentheses.
#define FHASH_PATHS(RESULT, NAME, PARAMETERS, ARGUMENTS)                                  \
    FHASH_V4 RESULT NAME##_v4 PARAMETERS { return NAME##_kernel<Path4> ARGUMENTS; }       \
    FHASH_V3 RESULT NAME##_v3 PARAMETERS { return NAME##_kernel<Path2> ARGUMENTS; }       \
    RESULT NAME##_v1 PARAMETERS { return NAME##_kernel<Path1> ARGUMENTS; }                \
    inline auto NAME(std::int64_t path) {                                                 \
        return path == FHASH_PATH_V4 ? NAME##_v4                                          \
                                     : path == FHASH_PATH_V3 ? NAME##_v3 : NAME##_v1;     \
    }
#else
#define FHASH_PATHS(RESULT, NAME, PARAMETERS, ARGUMENTS)                   \
    RESULT NAME##_v1 PARAMETERS { return NAME##_kernel<Path1> ARGUMENTS; } \
    inline auto NAME(std::int64_t) { return NAME##_v1; }
#endif

#endif  // FHASH_VECTORS

// The paths of this machine, as bits.
static inline std::int64_t machine_paths() {
#if defined(FHASH_THREE_PATHS)
    std::int64_t paths = FHASH_PATH_BASELINE;
    if (fhash_instructions() & FHASH_HAS_V3) paths |= FHASH_PATH_V3;
    if (fhash_instructions() & FHASH_HAS_V4) paths |= FHASH_PATH_V4;
    return paths;
#elif defined(FHASH_VECTORS)
    return FHASH_PATH_BASELINE;
#else
    return 0;
#endif
}

// Whether `path` is one path of this machine.
static inline bool has_path(std::int64_t path) {
    return path > 0 && (path & (path - 1)) == 0 && (machine_paths() & path) != 0;
}
