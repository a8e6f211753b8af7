// Bytes that zlib and zstd packed (third_party), for tiles and files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "status.hpp"

namespace fhash {

// Inflates data (RFC 1951, with `zlib_header` RFC 1950) that hold exactly `count` bytes, and end
// where their stream ends.
bool inflate_exact(const uint8_t* data, size_t size, bool zlib_header, uint8_t* out, size_t count,
                   fhash_error& error);

// What Python's zlib.compress(data, 6) returns; false without memory.
bool deflate_level6(const uint8_t* data, size_t size, std::vector<uint8_t>& out);

// The bytes in one zstd frame that declares from `least` to `most` of them (`from_zstd` in
// transform/values.py).
bool zstd_exact(const uint8_t* data, size_t size, uint64_t least, uint64_t most,
                std::vector<uint8_t>& out, fhash_error& error);

}  // namespace fhash
