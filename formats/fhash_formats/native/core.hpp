// Macros of all native sources, and the ABI number.
//
// Rules for the sources: an exported function takes plain pointers, sizes as int64_t and plain
// numbers, and returns an int64_t: at least 0 for success, below 0 for an error. No exception
// leaves it. No global mutable state, no threads. Floating point in a stated order only; the build
// turns off the contraction into fused multiply-adds.
#pragma once

#include <cstdint>

// ABI number. Raise it whenever the signature or the meaning of an exported function changes;
// native/__init__.py holds the same number and the table of prototypes.
constexpr std::int64_t FHASH_ABI = 11;

#if defined(_MSC_VER)
#define FHASH_EXPORT extern "C" __declspec(dllexport)
#define FHASH_INLINE __forceinline
#define FHASH_RESTRICT __restrict
#else
#define FHASH_EXPORT extern "C" __attribute__((visibility("default")))
#define FHASH_INLINE inline __attribute__((always_inline))
#define FHASH_RESTRICT __restrict__
#endif

// FHASH_LAMBDA after the parameters of a lambda: always inlined, so that it is compiled for the
// machine of the clone that contains it.
#if defined(_MSC_VER)
#define FHASH_LAMBDA
#else
#define FHASH_LAMBDA __attribute__((always_inline))
#endif

// FHASH_INDEPENDENT before a loop: no iteration reads what another one writes.
#if defined(__GNUC__) && !defined(__clang__)
#define FHASH_INDEPENDENT _Pragma("GCC ivdep")
#else
#define FHASH_INDEPENDENT
#endif

// FHASH_UNROLLED before a short loop of constant length: written out, so that tables of constants
// that it reads are folded.
#if defined(__GNUC__) && !defined(__clang__)
#define FHASH_UNROLLED _Pragma("GCC unroll 32")
#else
#define FHASH_UNROLLED
#endif

// FHASH_CLONES before a function: compiled for AVX-512, AVX2 and the baseline; one is chosen when
// the library is loaded. It works on plain functions only, neither templates nor inlines: put the
// body into a FHASH_INLINE template and call that from a small cloned function per type. Elsewhere
// it is empty: ARM (where NEON is the baseline), musl, macOS, Windows, older compilers.
// FHASH_TWO_CLONES: the same without AVX-512, for large functions that gain nothing by it.
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__) && \
    ((defined(__clang__) && __clang_major__ >= 18) ||                  \
     (!defined(__clang__) && defined(__GNUC__) && __GNUC__ >= 12))
#define FHASH_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#define FHASH_TWO_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define FHASH_CLONES
#define FHASH_TWO_CLONES
#endif
