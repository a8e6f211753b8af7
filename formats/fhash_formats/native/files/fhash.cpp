// The public functions on tiles (fhash.h), and those that Python calls beside them.
#include "fhash.h"

#include <new>

#include "tile.hpp"

using namespace fhash;

int32_t fhash_version(void) { return 1000 * FHASH_VERSION_MAJOR + FHASH_VERSION_MINOR; }

size_t fhash_type_size(int32_t type) {
    static const size_t sizes[] = {0, 1, 2, 4, 8, 1, 2, 4, 8, 2, 4, 8};
    return type < 0 || type > FHASH_FLOAT64 ? 0 : sizes[type];
}

fhash_context* fhash_context_create(uint64_t memory, int32_t threads) {
    fhash_context* const context = new (std::nothrow) fhash_context();
    if (!context) return nullptr;
    context->memory = memory;
    context->threads = threads < 1 ? 1 : threads;
    return context;
}

void fhash_context_destroy(fhash_context* context) { delete context; }

int32_t fhash_tile_decode(fhash_context* context, const fhash_tile* tile, const void* stream,
                          size_t size, int32_t lod, void* values, uint8_t* occupied,
                          fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!context || !values || (occupied && lod))
            return fail(failed, FHASH_ERROR_ARGUMENT,
                        "a context and room for values are needed, and no mask with lod");
        Job job = {*context, {}, 0, lod, {}, nullptr};
        return make_job(job, tile, stream, size, failed) && decode(job, values, occupied, failed);
    });
}
