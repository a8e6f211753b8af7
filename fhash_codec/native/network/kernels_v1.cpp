// The kernels of the network for the baseline of the architecture.
#include "point_kernels.hpp"
#include "brick_kernels.hpp"

#if defined(FHASH_VECTORS)
FHASH_DEFINE_KERNELS(v1, Path1)
#endif
