// The coder of masks for AVX2.
#if defined(__x86_64__) && defined(__GNUC__)
#define FHASH_TARGET 3
#include "mask.cpp"
FHASH_END_TARGET
#endif
