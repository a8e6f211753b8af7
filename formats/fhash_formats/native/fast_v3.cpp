// The fast coder for AVX2.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 3
#include "fast.cpp"
FHASH_END_TARGET
#endif
