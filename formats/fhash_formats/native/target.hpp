// The processor for which a source is compiled from here to FHASH_END_TARGET.
//
// Sources in which each instruction counts are compiled for the baseline of x86-64 and for AVX2: by
// a file that defines FHASH_TARGET as 3 (x86-64-v3) or 4 (x86-64-v4) and includes the source. GCC
// takes vectors apart before it inlines a function into one for another processor, so FHASH_CLONES
// of one function would work number by number. Both have the same bits; the baseline is at -O2.
//
// Include this last. What is included before is compiled for the baseline, and so must be: the
// headers of the standard library, of which a copy for AVX2 could be linked into code for any
// processor, and what runs when the library is loaded (mixing.hpp). tests/formats/native/
// test_library.py looks for such copies.
#pragma once

#include "core.hpp"

#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGETS 1
#define FHASH_FEATURES_3 "avx2,fma,bmi,bmi2,f16c,lzcnt,movbe"
#define FHASH_FEATURES_4 FHASH_FEATURES_3 ",avx512f,avx512bw,avx512cd,avx512dq,avx512vl"
#if FHASH_TARGET
#include <immintrin.h>
#endif
#if defined(__clang__)
#if FHASH_TARGET == 4
#pragma clang attribute push(__attribute__((target(FHASH_FEATURES_4))), apply_to = function)
#elif FHASH_TARGET == 3
#pragma clang attribute push(__attribute__((target(FHASH_FEATURES_3))), apply_to = function)
#endif
#elif FHASH_TARGET
#pragma GCC push_options
#pragma GCC optimize("O3")
#pragma GCC diagnostic ignored "-Wuninitialized"  // by <immintrin.h> of GCC 12 itself
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#if FHASH_TARGET == 4
#pragma GCC target("arch=x86-64-v4,tune=icelake-server,prefer-vector-width=512")
#else
#pragma GCC target("arch=x86-64-v3")
#if defined(FHASH_GATHERS)  // values from many places, which the usual tuning loads one by one
#pragma GCC target("tune=haswell")
#endif
#endif
#endif
#elif defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O3")  // the only target there
#endif

// FHASH_FOR_TARGETS(NAME, PARAMETERS, ARGUMENTS) { ... }: the exported function NAME, which returns
// an int64_t and exists for each target. The one of the baseline's source asks the processor.
#if FHASH_TARGET
#define FHASH_FOR_TARGETS(NAME, PARAMETERS, ARGUMENTS) std::int64_t NAME##_v3 PARAMETERS
#elif defined(FHASH_TARGETS)
#define FHASH_FOR_TARGETS(NAME, PARAMETERS, ARGUMENTS)                                      \
    std::int64_t NAME##_v3 PARAMETERS;                                                      \
    static std::int64_t NAME##_v1 PARAMETERS;                                               \
    FHASH_KERNEL std::int64_t NAME PARAMETERS {                                             \
        return (fhash_instructions() & FHASH_HAS_V3 ? NAME##_v3 : NAME##_v1) ARGUMENTS;     \
    }                                                                                       \
    static std::int64_t NAME##_v1 PARAMETERS
#else
#define FHASH_FOR_TARGETS(NAME, PARAMETERS, ARGUMENTS) FHASH_KERNEL std::int64_t NAME PARAMETERS
#endif

#if !FHASH_TARGET
#define FHASH_END_TARGET
#elif defined(__clang__)
#define FHASH_END_TARGET _Pragma("clang attribute pop")
#else
#define FHASH_END_TARGET _Pragma("GCC pop_options")
#endif
