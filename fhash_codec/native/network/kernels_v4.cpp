// The kernels of the network for AVX-512.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 4
#include "point_kernels.hpp"
#include "brick_kernels.hpp"

FHASH_DEFINE_KERNELS(v4, Path4)
FHASH_END_TARGET
#endif
