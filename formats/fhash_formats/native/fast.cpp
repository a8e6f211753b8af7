// The fast coder (fast.hpp).
#include "fast_decode.hpp"
#include "fast_encode.hpp"
#include "functions.h"

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
FHASH_FOR_TARGETS(fhash_fast_encode,
                  (int32_t* q, const float* values, int64_t trellis, double scale, double weight,
                   const int64_t* shape, const int32_t* table, int64_t count,
                   const uint16_t* slots, const uint8_t* defaults, uint8_t* data,
                   int64_t capacity, double* results),
                  (q, values, trellis, scale, weight, shape, table, count, slots, defaults, data,
                   capacity, results)) {
    return guarded([&]() -> int64_t {
        const Prior prior = {reinterpret_cast<const uint16_t(*)[TOKENS]>(slots), defaults, nullptr};
        const SymbolBits bits(prior);
        const Task task = {q,     values,        (float)scale, weight, shape,
                           table, (size_t)count, prior,        bits,   trellis != 0};
        std::vector<uint8_t> bytes;
        const int64_t code = !q        ? write(PRICE, task, bytes, results)
                             : !values ? write(ENCODE, task, bytes, results)
                             : trellis ? write_paths(task, bytes, results)
                                       : write(CHOOSE, task, bytes, results);
        if (code < 0) return code;
        if ((int64_t)bytes.size() <= capacity && !bytes.empty())
            std::memcpy(data, bytes.data(), bytes.size());
        return (int64_t)bytes.size();
    });
}

// Decode integers into q, which must be zeros. trellis: whether they are those of one. lookup:
// (CERTAIN + 1, SLOTS) of the prior.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_fast_decode,
                  (int32_t* q, int64_t trellis, const int64_t* shape, const int32_t* table,
                   int64_t count, const uint8_t* defaults, const uint32_t* lookup,
                   const uint8_t* data, int64_t size),
                  (q, trellis, shape, table, count, defaults, lookup, data, size)) {
    return guarded([&]() {
        const Prior prior = {nullptr, defaults, lookup};
        return read(q, trellis != 0, shape, table, count, prior, data, size);
    });
}
