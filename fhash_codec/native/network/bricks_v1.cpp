// The kernels of the brick engine for the baseline of the architecture.
#define FHASH_ONLY 1
#include "brick_kernels.hpp"

#if defined(FHASH_VECTORS)
FHASH_DEFINE_KERNELS(v1, Path1)
#endif
