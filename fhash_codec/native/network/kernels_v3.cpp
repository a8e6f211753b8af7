// The kernels of the network for AVX2 and FMA.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 3
#define FHASH_GATHERS
#include "point_kernels.hpp"
#include "brick_kernels.hpp"

FHASH_DEFINE_KERNELS(v3, Path2)
FHASH_END_TARGET
#endif
