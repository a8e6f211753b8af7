// Ray marching (march.cpp) for AVX2.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 3
#define FHASH_GATHERS
#define FHASH_MARCH fhash_march_v3
#include "march_draw.hpp"
FHASH_END_TARGET
#endif
