// The functions of functions.h by their names.
#include <cstring>

#include "core.hpp"
#include "functions.h"

#define FHASH_FUNCTIONS(FIND) \
    FIND(abi_version) FIND(array_announce) FIND(array_check) FIND(array_chunk) \
    FIND(array_read) FIND(array_stored) FIND(chunk_free) FIND(file_cache) \
    FIND(file_digest) FIND(file_node) FIND(file_open) FIND(file_place) FIND(file_with) \
    FIND(between) FIND(clip_f32) FIND(clip_f64) FIND(correct_f32_f32) FIND(correct_f32_f64) \
    FIND(correct_f64_f32) FIND(correct_f64_f64) FIND(crc32c) FIND(decode) FIND(decode_block) \
    FIND(decode_labels) FIND(decode_mask) FIND(decode_predicted) FIND(dequantise_f32) \
    FIND(dequantise_f64) FIND(encode) FIND(encode_block) FIND(encode_labels) FIND(encode_mask) \
    FIND(encode_predicted) FIND(fast_decode) FIND(fast_encode) FIND(free_f32) FIND(free_f64) \
    FIND(head_apply) FIND(mask_levels_f32) FIND(mask_levels_f64) FIND(plan) FIND(price) \
    FIND(quantise_f32) FIND(quantise_f64) FIND(reconstruct_f32) FIND(reconstruct_f64) \
    FIND(residual_f32_f32) FIND(residual_f32_f64) FIND(residual_f64_f32) \
    FIND(residual_f64_f64) FIND(tile_fill) FIND(tile_foretold) FIND(tile_forward) \
    FIND(tile_part) FIND(tile_region) FIND(tile_table) FIND(tile_uncorrected) \
    FIND(transform_forward_f32) FIND(transform_forward_f64) FIND(transform_inverse_f32) \
    FIND(transform_inverse_f64) FIND(trellis_choose_f32) FIND(trellis_choose_f64) \
    FIND(trellis_count) FIND(trellis_guess_f32) FIND(trellis_guess_f64) FIND(within_f32) \
    FIND(within_f64)

// The address of a function; null for an unknown name.
FHASH_EXPORT void* fhash_function(const char* name) {
#define FHASH_FOUND(NAME) \
    if (std::strcmp(name, "fhash_" #NAME) == 0) return (void*)&fhash_##NAME;
    FHASH_FUNCTIONS(FHASH_FOUND)
    return nullptr;
}
