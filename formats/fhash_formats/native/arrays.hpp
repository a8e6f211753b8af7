// Nodes and arrays of an open file for the Python package (arrays.cpp): functions that it finds by
// their names. An array is told by its number in the file, from 1.
#pragma once

#include "chunks.hpp"
#include "core.hpp"

// A node of the hierarchy. Texts live as long as the file.
struct fhash_node {
    const char* path;
    const char* text;    // its zarr.json
    uint64_t text_size;
    uint64_t document;   // bytes of the zarr.json in the file
    uint64_t stored;     // bytes of the data of its chunks
    uint64_t place;      // bytes of all of these with their places in the ZIP
    int64_t array;       // number of the array; 0 for a group
};

// A decoded chunk, which lives until fhash_chunk_free.
struct fhash_chunk {
    int64_t shape[8];
    const void* values;
    const uint8_t* mask;  // a byte for each value; null where all are occupied
    void* owner;
};

// fhash_open with a function that is told what will be read; null for none.
FHASH_KERNEL int32_t fhash_file_open(fhash_context* context, fhash_read_function read,
                                     fhash::Announce announce, void* user, uint64_t size,
                                     fhash_file** file, fhash_error* error);
// A further handle of an open file, which reads with another context. Each is closed on its own.
FHASH_KERNEL int32_t fhash_file_with(fhash_context* context, const fhash_file* file,
                                     fhash_file** made, fhash_error* error);
// Node `number`, from 0, in the order of the file; 1, or 0 where there is none.
FHASH_KERNEL int32_t fhash_file_node(const fhash_file* file, int64_t number, fhash_node* node);
// Array `number`, from 0, of a variable: its name there; 1, or 0 where there is none.
FHASH_KERNEL int32_t fhash_file_place(const fhash_file* file, int32_t variable, int64_t number,
                                      const char** name, int64_t* array);
// SHA-256 of the directory as 64 hexadecimal digits.
FHASH_KERNEL int32_t fhash_file_digest(const fhash_file* file, char digest[65]);
// Sets the bytes of decoded chunks that are kept.
FHASH_KERNEL int32_t fhash_file_cache(const fhash_file* file, uint64_t bytes);

// The values of a region, [first, last) along each axis, and which are occupied; either may be
// null. `keep`: whether the cache keeps the chunks.
FHASH_KERNEL int32_t fhash_array_read(fhash_file* file, int64_t array, const int64_t* bounds,
                                      int32_t keep, void* values, uint8_t* mask,
                                      fhash_error* error);
// A full chunk, padding included, at a level of detail.
FHASH_KERNEL int32_t fhash_array_chunk(fhash_file* file, int64_t array, const int64_t* place,
                                       int32_t lod, int32_t keep, fhash_chunk* chunk,
                                       fhash_error* error);
FHASH_KERNEL void fhash_chunk_free(void* owner);
// Where the bytes of a chunk lie, offset and length, and the member that holds them.
FHASH_KERNEL int32_t fhash_array_stored(fhash_file* file, int64_t array, const int64_t* place,
                                        uint64_t range[2], const char** member,
                                        fhash_error* error);
// Announces the bytes of the chunks of a region.
FHASH_KERNEL int32_t fhash_array_announce(fhash_file* file, int64_t array, const int64_t* bounds,
                                          fhash_error* error);
// Checks the members of an array by their checksums.
FHASH_KERNEL int32_t fhash_array_check(fhash_file* file, int64_t array, fhash_error* error);
