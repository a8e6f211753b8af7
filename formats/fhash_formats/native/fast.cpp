// The fast coder (fast.hpp) for the baseline, and the choice between that and AVX2.
#include "fast_decode.hpp"
#include "fast_encode.hpp"

using Encode = decltype(fhash_fast_encode_baseline);
using Decode = decltype(fhash_fast_decode_baseline);
Encode fhash_fast_encode_v3;  // fast_v3.cpp
Decode fhash_fast_decode_v3;

namespace {

#if defined(__x86_64__)
bool has_v3() { return (fhash_instructions() & FHASH_HAS_V3) != 0; }
Encode* encoder() { return has_v3() ? fhash_fast_encode_v3 : fhash_fast_encode_baseline; }
Decode* decoder() { return has_v3() ? fhash_fast_decode_v3 : fhash_fast_decode_baseline; }
#else
Encode* encoder() { return fhash_fast_encode_baseline; }
Decode* decoder() { return fhash_fast_decode_baseline; }
#endif

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (plan.cpp), or
// foretell what that takes. Integers outside the bands count as 0.
//
// values, scale, weight: null, or what integers are chosen of: values times scale, in steps, where
// a bit is worth so many squared steps. q receives them, and must be zeros; without q they are
// priced.
// trellis: whether integers are chosen on a trellis of two quantisers.
// table: (count, COLUMNS). slots, defaults: the prior (priors.hpp).
// data: receives the bytes if they fit the capacity. If they do not, call again with more room.
// results: receives the bytes that are foretold, and where integers are chosen the sum of the
// squared errors, in squared steps.
//
// Returns the number of bytes (0 for a price), -1 for a band beyond the shape, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_fast_encode(int32_t* q, const float* values, int64_t trellis,
                                       double scale, double weight, const int64_t* shape,
                                       const int32_t* table, int64_t count, const uint16_t* slots,
                                       const uint8_t* defaults, uint8_t* data, int64_t capacity,
                                       double* results) {
    return encoder()(q, values, trellis, scale, weight, shape, table, count, slots, defaults, data,
                     capacity, results);
}

// Decode integers into q, which must be zeros. trellis: whether they are those of one. lookup:
// (CERTAIN + 1, SLOTS) of the prior.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_fast_decode(int32_t* q, int64_t trellis, const int64_t* shape,
                                       const int32_t* table, int64_t count, const uint8_t* defaults,
                                       const uint32_t* lookup, const uint8_t* data, int64_t size) {
    return decoder()(q, trellis, shape, table, count, defaults, lookup, data, size);
}
