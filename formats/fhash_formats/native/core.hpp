// Macros of all native sources, and the ABI number.
//
// Rules for the sources: an exported function takes plain pointers, sizes as int64_t and plain
// numbers, and returns an int64_t: at least 0 for success, below 0 for an error. No exception
// leaves it. No global mutable state. Floating point in a stated order only; the build turns off
// the contraction into fused multiply-adds.
#pragma once

#include <cstdint>

// ABI number. Raise it whenever the signature or the meaning of a function of functions.h changes;
// native/__init__.py holds the same number.
constexpr std::int64_t FHASH_ABI = 28;

// FHASH_KERNEL before a function that fhash_function finds by its name; others do not see it.
#define FHASH_KERNEL extern "C"

#if defined(_MSC_VER)
#define FHASH_EXPORT extern "C" __declspec(dllexport)
#define FHASH_INLINE __forceinline
#define FHASH_RESTRICT __restrict
#else
#define FHASH_EXPORT extern "C" __attribute__((visibility("default")))
#if defined(FHASH_SMALL)  // a library that is loaded over a network (setup.py)
#define FHASH_INLINE inline
#else
#define FHASH_INLINE inline __attribute__((always_inline))
#endif
#define FHASH_RESTRICT __restrict__
#endif

// FHASH_LAMBDA after the parameters of a lambda: always inlined, so that it is compiled for the
// machine of the clone that contains it.
#if defined(_MSC_VER) || defined(FHASH_SMALL)
#define FHASH_LAMBDA
#else
#define FHASH_LAMBDA __attribute__((always_inline))
#endif

// FHASH_RARE around a condition: left to the branch predictor, and not computed as a value that the
// next step would wait for.
#if defined(_MSC_VER)
#define FHASH_RARE(condition) (condition)
#else
#define FHASH_RARE(condition) __builtin_expect(condition, 0)
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

// FHASH_CLONES before a function: compiled for AVX2 and the baseline; one is chosen when the
// library is loaded. It works on plain functions only, neither templates nor inlines: put the body
// into a FHASH_INLINE template and call that from a small cloned function per type. It is for loops
// that the compiler vectorises; target.hpp is for large sources. Elsewhere it is empty: ARM (where
// NEON is the baseline), musl, macOS, Windows, older compilers, and Clang, whose clones leave out a
// constructor that they inline, so that the library cannot be loaded.
// FHASH_CLONES_512: for AVX-512 too, for sums of products, which take half of the time by it.
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__) && !defined(__clang__) && \
    defined(__GNUC__) && __GNUC__ >= 12
#define FHASH_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#define FHASH_CLONES_512 \
    __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FHASH_CLONES
#define FHASH_CLONES_512
#endif

#if (defined(__x86_64__) || defined(__i386__)) && defined(__GNUC__)
#include <cpuid.h>

#include <cstdlib>
#include <cstring>

// Instructions that kernels ask for.
constexpr unsigned FHASH_HAS_CLMUL = 1;   // PCLMULQDQ and SSE4.1
constexpr unsigned FHASH_HAS_CRC32 = 2;   // SSE4.2
constexpr unsigned FHASH_HAS_V3 = 4;      // x86-64-v3: AVX2, FMA, BMI and more
constexpr unsigned FHASH_HAS_V4 = 8;      // x86-64-v4: AVX-512 F, BW, CD, DQ, VL
constexpr unsigned FHASH_HAS_VNNI = 16;   // these, and AVX-512 VNNI

// The instructions of this processor that the system lets be used, at most those that the
// environment variable FHASH_INSTRUCTIONS names, for tests: baseline or avx2.
// __builtin_cpu_supports says so, too, but for the compiler of ziglang, where it has no answer.
static inline unsigned fhash_instructions() {
    static const unsigned found = [] {
        unsigned a, b, c, d, wide = 0, extended = 0, saved = 0, has = 0;
        if (!__get_cpuid(1, &a, &b, &c, &d)) return has;
        const auto all = [](unsigned word, unsigned bits) { return (word & bits) == bits; };
        if (all(c, 1u << 1 | 1u << 19)) has |= FHASH_HAS_CLMUL;
        if (all(c, 1u << 20)) has |= FHASH_HAS_CRC32;
        const unsigned first = c;
        const char* const most = std::getenv("FHASH_INSTRUCTIONS");
        if (most && !std::strcmp(most, "baseline")) return has;
        if (!all(first, 1u << 27)) return has;  // the system does not say what it saves
        __asm__(".byte 0x0f, 0x01, 0xd0" : "=a"(saved), "=d"(d) : "c"(0));  // xgetbv
        if (!__get_cpuid_count(7, 0, &a, &wide, &extended, &d)) return has;
        if (!__get_cpuid(0x80000001u, &a, &b, &c, &d)) return has;
        // MOVBE, POPCNT, FMA, AVX, F16C; BMI, AVX2, BMI2; LZCNT; registers of 256 bits
        const bool v3 = all(first, 1u << 22 | 1u << 23 | 1u << 12 | 1u << 28 | 1u << 29) &&
                        all(wide, 1u << 3 | 1u << 5 | 1u << 8) && all(c, 1u << 5) && all(saved, 6);
        if (v3) has |= FHASH_HAS_V3;
        if (most && !std::strcmp(most, "avx2")) return has;
        // F, DQ, CD, BW, VL; registers of 512 bits
        if (v3 && all(wide, 1u << 16 | 1u << 17 | 1u << 28 | 1u << 30 | 1u << 31) &&
            all(saved, 0xe6)) {
            has |= FHASH_HAS_V4;
            if (all(extended, 1u << 11)) has |= FHASH_HAS_VNNI;
        }
        return has;
    }();
    return found;
}
#endif
