// The ABI number that the loader checks.
#include "core.hpp"

FHASH_EXPORT std::int64_t fhash_abi_version() { return FHASH_ABI; }
