// What every native source shares: the export macro, the per-machine clones and the ABI number.
//
// Rules for the sources: plain pointers and int64_t sizes in, int64_t out (>= 0 is fine, < 0 an error code), no exception across the
// border, no global mutable state, no threads. Floating point in a stated order only; the build turns contraction into fused multiply-adds
// off.
#pragma once

#include <cstdint>

// Raise it whenever an exported signature or its meaning changes; native/__init__.py holds the same number.
constexpr std::int64_t FHASH_ABI = 6;

#if defined(_MSC_VER)
#define FHASH_EXPORT extern "C" __declspec(dllexport)
#define FHASH_INLINE __forceinline
#define FHASH_RESTRICT __restrict
#else
#define FHASH_EXPORT extern "C" __attribute__((visibility("default")))
#define FHASH_INLINE inline __attribute__((always_inline))
#define FHASH_RESTRICT __restrict__
#endif

// After the parameters of a lambda: always inlined, so that it is compiled for the machine of the clone it is in.
#if defined(_MSC_VER)
#define FHASH_LAMBDA
#else
#define FHASH_LAMBDA __attribute__((always_inline))
#endif

// Before a loop: what it writes is never what another turn of it reads.
#if defined(__GNUC__) && !defined(__clang__)
#define FHASH_INDEPENDENT _Pragma("GCC ivdep")
#else
#define FHASH_INDEPENDENT
#endif

// FHASH_CLONES before a function: compiled for AVX-512, AVX2 and the baseline, chosen when the library is loaded. It works on plain
// functions only, neither templates nor inlines: put the body into a FHASH_INLINE template and call that from a small cloned function per
// type. Elsewhere (ARM, where NEON is the baseline, musl, macOS, Windows, older compilers) it is nothing.
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__) && \
    ((defined(__clang__) && __clang_major__ >= 18) || (!defined(__clang__) && defined(__GNUC__) && __GNUC__ >= 12))
#define FHASH_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FHASH_CLONES
#endif
