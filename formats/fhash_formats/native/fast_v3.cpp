// The fast coder for processors with AVX2 (fast.hpp).
#if defined(__x86_64__)
#define FHASH_FAST_V3
#include "fast_decode.hpp"
#include "fast_encode.hpp"
FHASH_END_FAST
#endif
