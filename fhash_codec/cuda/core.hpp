// What native/core.hpp gives the sources that a CUDA kernel shares with the processor's library.
#pragma once
#define FHASH_EXPORT extern "C"
#define FHASH_INLINE inline __attribute__((always_inline))
#if defined(__CUDACC_RTC__)
#define FHASH_UNROLL _Pragma("unroll")
#define FHASH_APART __noinline__  // what many places call, and takes long to compile in each
#else
#define FHASH_UNROLL
#define FHASH_APART
#endif
