// The page of `fhash view`: files that JavaScript reads, and priors that it fetches when needed.
#if defined(__wasm__)
#include "fhash.h"
#include "priors.hpp"

#define OF_PAGE(name) extern "C" __attribute__((import_module("fhash"), import_name(name)))

// Reads `length` bytes from `offset` on of file number `file` of the page; not 0 where it cannot.
OF_PAGE("read") int32_t fhash_page_read(double file, double offset, double length, void* bytes);
// The file of a prior, which stays where it is; `size` gets its bytes. Does not return without it.
OF_PAGE("prior") const uint8_t* fhash_page_prior(int32_t number, size_t* size);

const uint8_t* fhash::prior_bytes(int number, size_t* size) {
    return fhash_page_prior(number, size);
}

namespace {

int32_t read_of_page(void* user, uint64_t offset, uint64_t length, void* bytes) {
    return fhash_page_read((double)(uintptr_t)user, (double)offset, (double)length, bytes);
}

}  // namespace

// `fhash_open` of file number `file` of the page.
extern "C" int32_t fhash_open_page(fhash_context* context, int32_t file, double size,
                                   fhash_file** opened, fhash_error* error) {
    return fhash_open(context, read_of_page, (void*)(uintptr_t)file, (uint64_t)size, opened, error);
}
#endif
