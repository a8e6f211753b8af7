// The kernels of the brick engine for AVX2 and FMA.
#define FHASH_ONLY 2
#include "brick_kernels.hpp"

#if defined(FHASH_THREE_PATHS)
FHASH_DEFINE_KERNELS(v3, Path2)
#endif
FHASH_END
