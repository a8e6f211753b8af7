// The ABI number that the loader checks.
#include "core.hpp"
#include "functions.h"

FHASH_KERNEL std::int64_t fhash_abi_version() { return FHASH_ABI; }
