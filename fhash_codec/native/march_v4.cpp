// Ray marching (march.cpp) for AVX-512.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 4
#define FHASH_MARCH fhash_march_v4
#include "march_draw.hpp"
FHASH_END_TARGET
#endif
