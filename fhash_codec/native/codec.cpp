// The ABI number that the loader checks.
//
// The rules of fhash_formats/native/core.hpp hold for all sources of this folder, too.
#include "codec.h"
#include "core.hpp"

// Raise it whenever an exported signature or its meaning changes; native/__init__.py holds the same
// number.
constexpr std::int64_t FHASH_CODEC_ABI = 9;

FHASH_EXPORT std::int64_t fhash_codec_abi_version() { return FHASH_CODEC_ABI; }
