/* Functions of libfhash that its own sources, the Python package and its tests call. They are no
 * part of the interface (fhash.h): another version has others. Each is described where it is
 * defined.
 *
 * Python takes its declarations from this text (setup.py): plain C, no macros but numbers.
 */
#ifndef FHASH_FUNCTIONS_H
#define FHASH_FUNCTIONS_H

#include "fhash.h"

#ifndef __cplusplus /* of glibc, where that is the library of C */
int mallopt(int parameter, int value);
int malloc_trim(size_t pad);
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* The address of a function of those below, which are not exported; NULL for an unknown name. */
FHASH_API void* fhash_function(const char* name);

/* hdf5_filter.cpp: the filter, a H5Z_class2_t. */
FHASH_API const void* H5PLget_plugin_info(void);

/* Parts of a series, all of one shape. Arrays are the caller's. */
typedef struct fhash_plan_parts {
    int64_t shape[4];
    int64_t count;
    const float* values;    /* (count, shape), less the centre, finite */
    const uint8_t* counted; /* likewise: 1 where a vertex counts; NULL where all do */
    const double* weights;  /* of each part: vertices of the box that one of its own stands for */
} fhash_plan_parts;

/* A series and its promise. */
typedef struct fhash_plan_task {
    int64_t shape[4];           /* of the box over all steps, t, z, y, x */
    fhash_plan_parts columns;   /* as long as the box along t and z, where they can */
    fhash_plan_parts sheets;    /* as long along y and x; count 0 where the columns are, too */
    fhash_plan_parts block;     /* one, as long along all axes as may be */
    const float* lines[4];      /* along each axis (count, shape[axis]); NULL for no basis */
    int64_t line_counts[4];
    const int64_t* tiles;   /* candidates (count, 4) */
    const double* works;    /* of each: vertices that are decoded for a region */
    int64_t tile_count;
    double worth;           /* share of the bytes that half the work for a region is worth */
    double region_ns;       /* that a region may take */
    double vertex_ns, bit_ns; /* to decode a vertex, and each of its bits */
    double most;            /* bytes that a tile may take, as a multiple of the fewest */
    double step;            /* of the quantiser, a first guess */
    /* Without a promise the step stays as it is. */
    double mean_square;     /* promised mean squared error; 0 for none */
    double size;            /* promised bytes of all tiles; 0 for none */
} fhash_plan_task;

typedef struct fhash_plan_result {
    int64_t tile[4];
    int32_t kinds[4], depths[4]; /* of the transform; a basis is fitted by the caller */
    double step;                 /* of the plain quantiser */
    double bytes;                /* of all tiles, by price */
    double price;                /* of the tiling, as a multiple of the fewest bytes */
    int64_t tried;               /* tilings that were priced */
} fhash_plan_result;

/* Told ranges, pairs of offset and length, that will be read soon, each as it stands there. */
typedef void (*fhash_announce_function)(void* user, const uint64_t* ranges, uint64_t count);

/* A node of the hierarchy of a file. Texts live as long as the file. */
typedef struct fhash_node {
    const char* path;
    const char* text;  /* its zarr.json */
    uint64_t text_size;
    uint64_t document; /* bytes of the zarr.json in the file */
    uint64_t stored;   /* bytes of the data of its chunks */
    uint64_t place;    /* bytes of all of these with their places in the ZIP */
    int64_t array;     /* number of the array in the file, from 1; 0 for a group */
} fhash_node;

/* A decoded chunk, which lives until fhash_chunk_free. */
typedef struct fhash_chunk {
    int64_t shape[8];
    const void* values;
    const uint8_t* mask; /* a byte for each value; NULL where all are occupied */
    void* owner;
} fhash_chunk;

/* Nodes and arrays of an open file. An array is told by its number. */
/* arrays.cpp */
int32_t fhash_file_open(fhash_context* context, fhash_read_function read,
                        fhash_announce_function announce, void* user, uint64_t size,
                        fhash_file** file, fhash_error* error);
int32_t fhash_file_with(fhash_context* context, const fhash_file* file, fhash_file** made,
                        fhash_error* error);
int32_t fhash_file_node(const fhash_file* file, int64_t number, fhash_node* node);
int32_t fhash_file_place(const fhash_file* file, int32_t variable, int64_t number,
                         const char** name, int64_t* array);
int32_t fhash_file_digest(const fhash_file* file, char* digest);
int32_t fhash_file_cache(const fhash_file* file, uint64_t bytes);
int32_t fhash_array_read(fhash_file* file, int64_t array, const int64_t* bounds, int32_t keep,
                         void* values, uint8_t* mask, fhash_error* error);
int32_t fhash_array_chunk(fhash_file* file, int64_t array, const int64_t* place, int32_t lod,
                          int32_t keep, fhash_chunk* chunk, fhash_error* error);
void fhash_chunk_free(void* owner);
int32_t fhash_array_stored(fhash_file* file, int64_t array, const int64_t* place, uint64_t* range,
                           const char** member, fhash_error* error);
int32_t fhash_array_announce(fhash_file* file, int64_t array, const int64_t* bounds,
                             fhash_error* error);
int32_t fhash_array_check(fhash_file* file, int64_t array, fhash_error* error);

/* between.cpp */
int64_t fhash_between(const double* const* frames, const double* distances, int64_t n,
                      const double* shares, int64_t alone, double* values, double* slopes);

/* coder.cpp */
int64_t fhash_encode(int32_t* q, const float* scaled, double lambda, int64_t trellis,
                     const int64_t* shape, const int32_t* table, int64_t count, uint16_t* slots,
                     int64_t slot_count, int32_t* weights, int64_t weight_count, uint16_t* simples,
                     int64_t simple_count, int64_t keep, uint8_t* data, int64_t capacity);
int64_t fhash_decode(int32_t* q, int64_t trellis, const int64_t* shape, const int32_t* table,
                     int64_t count, const uint16_t* slots, int64_t slot_count,
                     const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                     int64_t simple_count, const uint8_t* data, int64_t size);

/* core.cpp */
int64_t fhash_abi_version(void);

/* crc32c.cpp */
int64_t fhash_crc32c(const void* in, int64_t n, int64_t crc, int64_t plain);

/* fast.cpp */
int64_t fhash_fast_encode(int32_t* q, const float* values, int64_t trellis, double scale,
                          double weight, const int64_t* shape, const int32_t* table, int64_t count,
                          const uint16_t* slots, const uint8_t* defaults, uint8_t* data,
                          int64_t capacity, double* results);
int64_t fhash_fast_decode(int32_t* q, int64_t trellis, const int64_t* shape, const int32_t* table,
                          int64_t count, const uint8_t* defaults, const uint32_t* lookup,
                          const uint8_t* data, int64_t size);

/* head.cpp */
int64_t fhash_head_apply(const float* decoded, const int64_t* shape, int64_t first, int64_t last,
                         int64_t layers, const int64_t* widths, const float* weights,
                         const float* biases, const float* scales, const float* constants,
                         int64_t lanes, float* out);

/* labels.cpp */
int64_t fhash_encode_labels(uint16_t* labels, int64_t count, const int64_t* shape, uint8_t* data,
                            int64_t capacity);
int64_t fhash_decode_labels(uint16_t* labels, int64_t count, const int64_t* shape,
                            const uint8_t* data, int64_t size);

/* lifting.cpp */
int64_t fhash_transform_forward_f32(const float* in, float* out, const int64_t* shape,
                                    const int64_t* kinds, const int64_t* depths,
                                    const int64_t* ranks, const float* const* matrices,
                                    const float* tz, const float* yx, int64_t threads);
int64_t fhash_transform_inverse_f32(const float* in, float* out, const int64_t* shape,
                                    const int64_t* kinds, const int64_t* depths,
                                    const int64_t* ranks, const float* const* matrices,
                                    const float* tz, const float* yx, int64_t threads);
int64_t fhash_transform_forward_f64(const double* in, double* out, const int64_t* shape,
                                    const int64_t* kinds, const int64_t* depths,
                                    const int64_t* ranks, const double* const* matrices,
                                    const double* tz, const double* yx, int64_t threads);
int64_t fhash_transform_inverse_f64(const double* in, double* out, const int64_t* shape,
                                    const int64_t* kinds, const int64_t* depths,
                                    const int64_t* ranks, const double* const* matrices,
                                    const double* tz, const double* yx, int64_t threads);
int64_t fhash_reconstruct_f32(const int32_t* in, float* out, const int64_t* shape,
                              const int64_t* kinds, const int64_t* depths, const int64_t* ranks,
                              const float* const* matrices, const float* tz, const float* yx,
                              int64_t threads, const double* numbers);
int64_t fhash_reconstruct_f64(const int32_t* in, double* out, const int64_t* shape,
                              const int64_t* kinds, const int64_t* depths, const int64_t* ranks,
                              const double* const* matrices, const double* tz, const double* yx,
                              int64_t threads, const double* numbers);

/* mask.cpp */
int64_t fhash_encode_mask(const uint8_t* mask, const uint8_t* level, const uint8_t* other,
                          const int64_t* shape, uint16_t* slots, int64_t slot_count,
                          int32_t* weights, int64_t weight_count, uint16_t* simples,
                          int64_t simple_count, int64_t keep, uint8_t* data, int64_t capacity);
int64_t fhash_decode_mask(uint8_t* mask, const uint8_t* level, const uint8_t* other,
                          const int64_t* shape, const uint16_t* slots, int64_t slot_count,
                          const int32_t* weights, int64_t weight_count, const uint16_t* simples,
                          int64_t simple_count, const uint8_t* data, int64_t size);

/* mask_levels.cpp */
int64_t fhash_mask_levels_f32(const float* values, const int64_t* shape, const float* edges,
                              int64_t edge_count, const int32_t* scores, const int32_t* others,
                              int64_t reach, uint8_t* first, uint8_t* second);
int64_t fhash_mask_levels_f64(const double* values, const int64_t* shape, const double* edges,
                              int64_t edge_count, const int32_t* scores, const int32_t* others,
                              int64_t reach, uint8_t* first, uint8_t* second);

/* part.cpp */
int32_t fhash_tile_fill(fhash_context* context, const fhash_tile* tile, const uint8_t* counted,
                        const uint8_t* finite, int32_t density, void* values, fhash_error* error);
int32_t fhash_tile_forward(fhash_context* context, const fhash_tile* tile, const void* values,
                           void* out, fhash_error* error);
int32_t fhash_tile_table(fhash_context* context, const fhash_tile* tile, const void* stream,
                         size_t size, int32_t lod, void* values, int32_t* wide, uint64_t* origin,
                         fhash_error* error);
int32_t fhash_tile_uncorrected(fhash_context* context, const fhash_tile* tile, const void* stream,
                               size_t size, const int64_t* part, float* values, int32_t* done,
                               fhash_error* error);
int32_t fhash_tile_part(fhash_context* context, const fhash_tile* tile, const float* table,
                        const int64_t* part, void* values, fhash_error* error);
int32_t fhash_tile_foretold(fhash_context* context, const fhash_tile* tile, const int32_t* integers,
                            const uint8_t* counted, int64_t* size, fhash_error* error);
int64_t fhash_encode_block(const int32_t* integers, const int64_t* shape, uint8_t* data,
                           int64_t capacity);
int64_t fhash_decode_block(const uint8_t* data, int64_t size, const int64_t* shape,
                           int32_t* integers);

/* planner.cpp */
int32_t fhash_plan(fhash_context* context, const fhash_plan_task* task, fhash_plan_result* result,
                   fhash_error* error);

/* predict.cpp */
int64_t fhash_encode_predicted(int32_t* q, const uint8_t* counted, const int64_t* shape,
                               const int64_t* levels, const int32_t* passes, int64_t pass_count,
                               const int32_t* taps, const int16_t* tap_weights,
                               const uint16_t* slots, int64_t slot_count, const int32_t* weights,
                               int64_t weight_count, const uint16_t* simples, int64_t simple_count,
                               uint8_t* data, int64_t capacity);
int64_t fhash_decode_predicted(int32_t* q, const int64_t* shape, const int64_t* levels,
                               const int32_t* passes, int64_t pass_count, const int32_t* taps,
                               const int16_t* tap_weights, const uint16_t* slots,
                               int64_t slot_count, const int32_t* weights, int64_t weight_count,
                               const uint16_t* simples, int64_t simple_count, const uint8_t* data,
                               int64_t size);

/* quantise.cpp */
void fhash_price(const float* in, int64_t n, double scale, double* price);
int64_t fhash_quantise_f32(const float* in, int64_t n, double scale, double rounding,
                           double largest, int32_t* out, float* scaled);
int64_t fhash_quantise_f64(const double* in, int64_t n, double scale, double rounding,
                           double largest, int32_t* out, float* scaled);
int64_t fhash_dequantise_f32(const int32_t* in, int64_t n, double step, const double* shifts,
                             float* out);
int64_t fhash_dequantise_f64(const int32_t* in, int64_t n, double step, const double* shifts,
                             double* out);

/* region.cpp */
int32_t fhash_tile_region(fhash_context* context, const fhash_tile* tile, const void* stream,
                          size_t size, const int64_t* part, void* values, int32_t* done,
                          fhash_error* error);

/* trellis.cpp */
int64_t fhash_trellis_count(const int32_t* levels, const int64_t* shape, const int32_t* table,
                            int64_t count, uint8_t* buckets, int64_t* counts);
int64_t fhash_trellis_guess_f32(const float* scaled, const int64_t* shape, const int32_t* table,
                                int64_t count, uint8_t* buckets, int64_t* counts);
int64_t fhash_trellis_guess_f64(const double* scaled, const int64_t* shape, const int32_t* table,
                                int64_t count, uint8_t* buckets, int64_t* counts);
int64_t fhash_trellis_choose_f32(const float* scaled, const int64_t* shape, const int32_t* table,
                                 int64_t count, const uint8_t* buckets, const int32_t* rates,
                                 int32_t* levels);
int64_t fhash_trellis_choose_f64(const double* scaled, const int64_t* shape, const int32_t* table,
                                 int64_t count, const uint8_t* buckets, const int32_t* rates,
                                 int32_t* levels);

/* values.cpp */
int64_t fhash_within_f32(const float* values, const float* decoded, const uint8_t* counted,
                         int64_t n, double error);
int64_t fhash_clip_f32(float* values, int64_t n, double center, double low, double high);
int64_t fhash_free_f32(float* target, const float* rebuilt, const uint8_t* counted, int64_t n,
                       double low, double high);
int64_t fhash_within_f64(const double* values, const double* decoded, const uint8_t* counted,
                         int64_t n, double error);
int64_t fhash_clip_f64(double* values, int64_t n, double center, double low, double high);
int64_t fhash_free_f64(double* target, const double* rebuilt, const uint8_t* counted, int64_t n,
                       double low, double high);
int64_t fhash_residual_f32_f32(const float* values, const float* base, const uint8_t* counted,
                               int64_t n, double quantum, double largest, int32_t* out);
int64_t fhash_correct_f32_f32(const float* base, const int32_t* residual, int64_t n, double quantum,
                              float* out);
int64_t fhash_residual_f32_f64(const float* values, const double* base, const uint8_t* counted,
                               int64_t n, double quantum, double largest, int32_t* out);
int64_t fhash_correct_f32_f64(const float* base, const int32_t* residual, int64_t n, double quantum,
                              double* out);
int64_t fhash_residual_f64_f32(const double* values, const float* base, const uint8_t* counted,
                               int64_t n, double quantum, double largest, int32_t* out);
int64_t fhash_correct_f64_f32(const double* base, const int32_t* residual, int64_t n,
                              double quantum, float* out);
int64_t fhash_residual_f64_f64(const double* values, const double* base, const uint8_t* counted,
                               int64_t n, double quantum, double largest, int32_t* out);
int64_t fhash_correct_f64_f64(const double* base, const int32_t* residual, int64_t n,
                              double quantum, double* out);

#ifdef __cplusplus
}
#endif
#endif
