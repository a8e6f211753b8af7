// The files of the priors (priors.hpp).
#if !defined(__wasm__)  // there wasm.cpp fetches them
#include "priors.hpp"

namespace fhash {
namespace {

#include "prior_bytes.inc"

}  // namespace

const uint8_t* prior_bytes(int number, size_t* size) {
    const uint8_t* const files[] = {PRIOR, MASK_PRIOR, FAST_PRIOR};
    const size_t sizes[] = {sizeof PRIOR, sizeof MASK_PRIOR, sizeof FAST_PRIOR};
    *size = sizes[number];
    return files[number];
}

}  // namespace fhash
#endif
