// Vectors of the network's kernels: one source for AVX-512, AVX2 with FMA, and the baseline.
//
// A kernel is a template on a path (`Path1`, `Path2`, `Path4`), written with the vector extensions
// of GCC and Clang; kernels_v1.cpp, kernels_v3.cpp and kernels_v4.cpp compile all of them for a
// path (target.hpp). Nothing of the standard library may be included after this header.
// Compilers without these extensions build a library that offers no path.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "core.hpp"
#include "target.hpp"

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
    return number - typename P::F{};
}

#endif  // FHASH_VECTORS

// The paths of this machine, as bits.
static inline std::int64_t machine_paths() {
#if defined(FHASH_TARGETS)
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
