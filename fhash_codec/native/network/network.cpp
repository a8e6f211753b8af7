// The ABI number that the loader checks.
//
// This library computes with the paper's network: training, evaluation, points. The rules of
// fhash_formats/native/core.hpp hold, but for one: the build allows contraction into fused
// multiply-adds here, which makes the products faster by a quarter. No stream of bits depends on
// these sources, so machines may differ in the last bits.
#include "core.hpp"
#include "network.h"

// Raise it whenever an exported signature or its meaning changes; __init__.py holds the same
// number.
constexpr std::int64_t FHASH_NETWORK_ABI = 5;

FHASH_EXPORT std::int64_t fhash_network_abi_version() { return FHASH_NETWORK_ABI; }
