// The page of `fhash view`: files that JavaScript reads.
#if defined(__wasm__) && defined(NOT_YET)
#include "fhash.h"

// Reads `length` bytes from `offset` on of file number `file` of the page; not 0 where it cannot.
extern "C" __attribute__((import_module("fhash"), import_name("read"))) int32_t
fhash_page_read(double file, double offset, double length, void* bytes);

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
