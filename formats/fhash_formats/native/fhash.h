/* libfhash: tiles of the codec `fhash.transform` and files `.fhz`, for C and every language that calls C.
 *
 * Functions return FHASH_OK or another fhash_status, and put a text into `error` where it is not NULL. Nothing is
 * printed, no exception leaves the library, and it has no global state that changes. A context, its files and all of
 * these functions may be used from several threads at once; closing is the business of one of them.
 *
 * Arrays are contiguous, their last axis varies fastest: (t, z, y, x) or (z, y, x). Numbers are in the byte order of
 * the machine. FORMAT.md of the package describes the bytes.
 */
#ifndef FHASH_H
#define FHASH_H

#include <stddef.h>
#include <stdint.h>

/* Version of this interface. A library serves a program that was compiled with the same major version, and a minor one
 * that is not higher than its own. */
#define FHASH_VERSION_MAJOR 1
#define FHASH_VERSION_MINOR 0

#if defined(FHASH_BUILDING)
#if defined(_WIN32)
#define FHASH_API __declspec(dllexport)
#else
#define FHASH_API __attribute__((visibility("default")))
#endif
#else
#define FHASH_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef enum fhash_status {
    FHASH_OK = 0,
    FHASH_ERROR_ARGUMENT = -1,    /* an argument that is not allowed */
    FHASH_ERROR_MEMORY = -2,      /* no memory, or more than the context allows */
    FHASH_ERROR_DAMAGED = -3,     /* bytes that no encoder writes */
    FHASH_ERROR_UNSUPPORTED = -4, /* a sound file of a kind or version that this library does not read */
    FHASH_ERROR_READ = -5,        /* the caller's function could not read */
    FHASH_ERROR_SIZE = -6         /* the room for the result is too small */
} fhash_status;

typedef struct fhash_error {
    int32_t status;
    char text[500]; /* UTF-8, ends with a zero byte */
} fhash_error;

typedef enum fhash_type {
    FHASH_INT8 = 1,
    FHASH_INT16 = 2,
    FHASH_INT32 = 3,
    FHASH_INT64 = 4,
    FHASH_UINT8 = 5,
    FHASH_UINT16 = 6,
    FHASH_UINT32 = 7,
    FHASH_UINT64 = 8,
    FHASH_FLOAT16 = 9,
    FHASH_FLOAT32 = 10,
    FHASH_FLOAT64 = 11
} fhash_type;

/* The version of the library: 1000 times the major one, plus the minor one. */
FHASH_API int32_t fhash_version(void);
/* Bytes of a value of a type; 0 for another number. */
FHASH_API size_t fhash_type_size(int32_t type);

/* What calls share: unpacked settings of tiles, and limits. */
typedef struct fhash_context fhash_context;

/* A context.
 *
 * memory: bytes that a call may use beside the caller's arrays; 0 for no limit.
 * threads: threads that a call may use, 1 or more.
 *
 * Returns NULL where there is no memory. */
FHASH_API fhash_context* fhash_context_create(uint64_t memory, int32_t threads);
FHASH_API void fhash_context_destroy(fhash_context* context);

/* ---- Tiles ---- */

/* Shape and type of a tile, and the settings that it shares with others. */
typedef struct fhash_tile {
    int64_t shape[4];     /* vertices along t, z, y, x; at most 2^27 in all */
    int32_t type;         /* fhash_type of the array */
    int32_t reserved;     /* 0 */
    const void* settings; /* packed settings; NULL where the stream has its own */
    size_t settings_size;
} fhash_tile;

/* Decode a tile.
 *
 * lod: level of detail, 0 to 10. n gives every 2^n-th vertex along z, y and x, low-passed, without head, residual,
 *     missing values and mask.
 * values: room for the values; their shape is that of the tile, at a level of detail ceil(n / 2^lod) along z, y, x.
 * occupied: NULL, or room for a byte for each vertex: 1 where the stream has a value. Only with lod 0. */
FHASH_API int32_t fhash_tile_decode(fhash_context* context, const fhash_tile* tile, const void* stream, size_t size,
                                    int32_t lod, void* values, uint8_t* occupied, fhash_error* error);

/* A promise for the values of a tile: exactly one of the three numbers is above 0, or max_error is 0 (every bit). */
typedef struct fhash_quality {
    double max_error;     /* bound on |decoded - value| in the units of the values; below 0 for none */
    double max_error_rel; /* the same as a share of the range of the tile's values without 0, missing ones; 0 for none */
    double step;          /* step of the quantiser, without a bound; 0 for none */
    int32_t effort;       /* 1, the fastest, to 9 */
    int32_t transform_given; /* 0: the transform that codes best in a trial; 1: `transform` */
    uint8_t transform[4]; /* along t, z, y, x: 0 for none, else 16 (Haar), 32 (5/3) or 48 (9/7) plus levels, 1 to 10 */
    int32_t missing;      /* values that the caller calls missing, at most 16; 0 counts as 1 */
} fhash_quality;

/* Encode a tile, with settings of its own in the stream. tile->settings is NULL.
 *
 * missing: NULL, or quality->missing values of the tile's type that stand where there is none, such as fill values of a
 *     store. They come back bit by bit, as NaN and infinities do, and take no part in range and bound; so do values
 *     farther from all others than these are from each other, and planes of zeros, which stores have where nothing was
 *     written.
 * stream: room of `room` bytes, or NULL.
 * size: gets the bytes of the stream, also where it does not fit (FHASH_ERROR_SIZE); fhash_tile_bound says how many
 *     are enough. */
FHASH_API int32_t fhash_tile_encode(fhash_context* context, const fhash_tile* tile, const void* values,
                                    const fhash_quality* quality, const void* missing, void* stream, size_t room,
                                    size_t* size, fhash_error* error);

/* Bytes that are enough for any stream of a tile of this shape and type. */
FHASH_API size_t fhash_tile_bound(const fhash_tile* tile);

/* Options of an encoder whose settings are given. */
typedef struct fhash_coding {
    double weight;        /* squared steps that a bit is worth in rate-distortion optimisation; 0 for none */
    double error;         /* bound on |decoded - value|; below 0 for none. A tile that cannot keep it is exact */
    double aim;           /* squared error that the choice of integers aims at, as a multiple of what the coefficients
                           * predict (choose.cpp); 0 for that of the weight */
    double joint;         /* part of a head's correction that values are coded less by; 0 for none */
    int32_t rounds;       /* how often values that are free to change are replaced by their decoded ones */
    int32_t passes;       /* 1, or 2: what was chosen is coded or searched once more */
    int32_t filled;       /* 1: values that do not count are a good filling already */
    int32_t density;      /* how thoroughly a filling is searched: 0, 1 or 8 thresholds per factor of two */
    int32_t keep_missing; /* 1: values that are not finite come back as they were */
    int32_t own_settings; /* 1: the stream holds the settings */
    int32_t fast;         /* 1: the fast coder, for more bytes */
    int32_t cut;          /* logarithms of the lengths of blocks to the base 2, four bits each for t, z, y, x from the
                           * lowest on; 0: as pays for small regions */
} fhash_coding;

/* Encode a tile with the settings of tile->settings: any transform, basis, head, predictor, mask or labels that they
 * ask for. Without settings it is stored without loss.
 *
 * counts: NULL, or a byte for each value: 0 where it does not count. Without settings it is the mask of the stream.
 * decoded: NULL, or room for the values that the stream decodes to.
 * stream, size: get the stream, which fhash_tile_free releases. nonzero: gets the coded integers other than 0. */
FHASH_API int32_t fhash_tile_code(fhash_context* context, const fhash_tile* tile, const void* values,
                                  const uint8_t* counts, const fhash_coding* coding, void* decoded, uint8_t** stream,
                                  size_t* size, int64_t* nonzero, fhash_error* error);
FHASH_API int32_t fhash_tile_free(uint8_t* stream);

/* ---- Files ---- */

/* Reads `length` bytes from `offset` on. Returns 0, or another number where it cannot. */
typedef int32_t (*fhash_read_function)(void* user, uint64_t offset, uint64_t length, void* bytes);

typedef struct fhash_file fhash_file;

/* Open a file of `size` bytes. The function is called by fhash_open, fhash_read and fhash_coordinate, from the thread
 * that calls them. */
FHASH_API int32_t fhash_open(fhash_context* context, fhash_read_function read, void* user, uint64_t size,
                             fhash_file** file, fhash_error* error);
/* The same of a path, UTF-8. */
FHASH_API int32_t fhash_open_path(fhash_context* context, const char* path, fhash_file** file, fhash_error* error);
FHASH_API void fhash_close(fhash_file* file);

/* The attribute `fhash` of the root as JSON text: the format's version and the header of each variable (FORMAT.md). It
 * lives as long as the file. */
FHASH_API const char* fhash_header(const fhash_file* file);

/* Facts about a variable; later versions add some at the end. */
typedef struct fhash_variable {
    size_t size;            /* sizeof(fhash_variable), set by the caller: no more bytes are written */
    const char* name;       /* texts live as long as the file */
    const char* units;      /* "" where unknown */
    const char* attributes; /* JSON object: those of the variable */
    int32_t type;           /* fhash_type of the source */
    int32_t levels;         /* levels of detail beside the full one that fhash_read gives, at most 10 */
    int64_t shape[4];       /* steps, and vertices along z, y, x */
    int64_t tile[4];        /* vertices of a tile along t, z, y, x; 0 where values are not stored in tiles */
    int64_t box[6];         /* z0, z1, y0, y1, x0, x1: vertices that have values lie in it */
    double low, high;       /* range of the values */
    double background;      /* mean of the values outside the features */
    double max_error;       /* measured; NaN where the file does not say */
    double psnr;            /* measured, in dB; NaN where the file does not say or the values are exact */
} fhash_variable;

/* Number of variables. */
FHASH_API int32_t fhash_variables(const fhash_file* file);
/* Facts about variable number `number`, from 0; variable->size = sizeof(fhash_variable) comes first. */
FHASH_API int32_t fhash_variable_get(const fhash_file* file, int32_t number, fhash_variable* variable,
                                     fhash_error* error);

/* Positions along an axis (0 to 3 for t, z, y, x), shape[axis] numbers. attributes: NULL, or gets a JSON object of
 * `name` (text) and `attributes` (object), which lives as long as the file. */
FHASH_API int32_t fhash_coordinate(fhash_file* file, int32_t number, int32_t axis, double* positions,
                                   const char** attributes, fhash_error* error);

/* Read a region at a step, or between two steps.
 *
 * step: 0 to shape[0] - 1; between steps by the rule of the file, linear or monotone cubic (FORMAT.md).
 * region: z0, z1, y0, y1, x0, x1: half-open ranges of vertices; NULL for all.
 * lod: level of detail; n gives the vertices of the region whose indices are multiples of 2^n.
 * type: FHASH_FLOAT32, FHASH_FLOAT64, or the source's type at a whole step with lod 0.
 * values: room for them, (z, y, x). Vertices outside the features, and missing values, are NaN; in integers they are
 *     the file's fill value, and FHASH_ERROR_ARGUMENT where it has none. */
FHASH_API int32_t fhash_read(fhash_file* file, int32_t number, double step, const int64_t* region, int32_t lod,
                             int32_t type, void* values, fhash_error* error);

#ifdef __cplusplus
}
#endif
#endif
