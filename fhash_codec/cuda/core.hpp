// What native/core.hpp gives the sources that a CUDA kernel shares with the processor's library.
#pragma once
#define FHASH_EXPORT extern "C"
#define FHASH_INLINE inline __attribute__((always_inline))
#if defined(__CUDACC_RTC__)
#define FHASH_UNROLL _Pragma("unroll")
#else
#define FHASH_UNROLL
#endif
