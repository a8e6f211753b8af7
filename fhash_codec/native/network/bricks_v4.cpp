// The kernels of the brick engine for AVX-512.
#define FHASH_ONLY 4
#include "brick_kernels.hpp"

#if defined(FHASH_THREE_PATHS)
FHASH_DEFINE_KERNELS(v4, Path4)
#endif
FHASH_END
