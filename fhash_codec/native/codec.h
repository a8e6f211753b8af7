/* What Python calls of the codec's library: each function is described where it is defined.
 *
 * Python takes its declarations from this text (setup.py): plain C, no macros but numbers.
 */
#ifndef FHASH_CODEC_H
#define FHASH_CODEC_H

#include <stdint.h>

#include "core.hpp"

#ifdef __cplusplus
extern "C" {
#endif

#define FHASH_SURFACES 64   // surfaces of a picture, at most
#define FHASH_POWERS 1024   // intervals of the table of highlights
#define FHASH_BRICK 4       // cells along a brick's side
#define FHASH_PLANES 6      // planes that clip a picture, at most
#define FHASH_GRADES 1024   // intervals of the table of factors by gradient
#define FHASH_POINTS 64     // points that a network is evaluated at together, at most

// `fhash_network_points` of the network's library (network/points.cpp).
typedef int64_t (*FhashNetwork)(const int64_t* sizes, const int64_t* levels,
                                const int64_t* layers, const int64_t* columns,
                                int64_t count, int64_t path, float* values,
                                float* slopes, float* by_inputs);

// Decodes what the samples in a brick read, and is nonzero where that fails.
typedef int64_t (*FhashFetch)(int64_t brick);

// The input of the marcher (fhash_codec/rendering/march.py). All places and directions are in
// vertices of the frame, x, y, z.
typedef struct FhashMarch {
    // The frame.
    const float* values;    // (z, y, x), NaN where there is none
    int64_t shape[3];       // z, y, x
    // What rays may leap over; null pointers where everything is looked at.
    const int32_t* distance;       // (z, y, x) of bricks: distance to the nearest that matters
    const uint32_t* cells;         // (z, y, x, 2) of bricks: bit x + 4 y + 16 z of a visible cell
    const float* highest;          // (z, y, x) of bricks: largest value, for FLAGS & MAXIMUM
    int64_t bricks[3];             // of FHASH_BRICK cells along a side; their number along z, y, x
    // The transfer function.
    const float* table;        // (entries + 1, 4): red, green, blue, opacity of one step
    const double* extinction;  // (entries + 1,): of one step
    int64_t entries;           // the last entry is in the tables twice
    double low, scale;         // the entry of a value is (value - low) * scale
    // The light grid.
    const float* light;  // (z, y, x, 2): shares from the lamp and from around; null for all light
    int64_t light_shape[3];       // z, y, x
    double light_offset[3], light_scale;  // a place is at place * scale + offset in the light grid
    // The rays.
    double eye[3], right[3], up[3], forward[3];
    double box[3][2];        // the drawn box as it is clipped, in which steps are counted
    double seen[3][2];       // the part of the box in which the frame has values
    double spacing[3];       // length of one vertex spacing; negative on a descending axis
    int64_t width, height, parallel;
    int64_t rays;            // rays along a pixel's side
    double step;             // length of a step
    double threshold;        // share of light behind at which a ray ends
    int64_t jitter;          // whether the first sample is shifted by a share of the ray's own
    // Phong's model.
    double lamp[3];          // unit vector towards the light; zero for a light at the camera
    double ambient, diffuse, specular;
    double steep;            // stretches the table of highlights over the cosines next to 1
    double gradient[3];      // for each axis, from differences to the gradients of shading
    double floor;            // gradient at which shading has faded by half
    const float* powers;     // (FHASH_POWERS + 2,): the highlight by (1 - cosine) * steep
    // The surfaces: value, red, green, blue, opacity.
    int64_t surfaces;
    double surface[FHASH_SURFACES][5];
    // The pictures.
    float* out;              // (height, width, 4), multiplied by the opacity
    float* depth;            // (height, width) or null
    float* normal;           // (height, width, 3) or null
    int64_t central;         // whether the gradients of shading are central differences
    int64_t path;            // instructions: 0 the processor's, 1 at most AVX2, 2 the baseline
    // Planes that clip the box: a place is kept where their first three numbers times the place
    // are at least the fourth.
    int64_t planes;
    double plane[FHASH_PLANES][4];
    // Opacity by gradient.
    const float* grading;    // (FHASH_GRADES + 2,): factors of the extinction by gradient; or null
    double grade_scale;      // entries of that table to a gradient of shading of 1
    int64_t unlit;           // whether gradients are for opacity alone, not for shading
    const float* smooth;     // (z, y, x): values whose central differences shade; or null
    // A network with values of its own, in place of those of the frame, which then say where there
    // is a value.
    FhashNetwork network;    // null for none
    const int64_t* network_sizes;
    const int64_t* network_levels;
    const int64_t* network_layers;
    int64_t network_path;
    int64_t network_shape[3];    // z, y, x: of `values`, which have the vertices of its box
    const double* network_x;     // place of each vertex of the frame along an axis among those of
    const double* network_y;     // its box; null where they are the same
    const double* network_z;
    int64_t network_whole;       // whether there is a value at all places of the frame
    double network_low, network_span;  // the value of its 0, and the change to that of its 1
    int64_t* network_status;           // takes what it returns where it fails
    // A frame that is decoded while it is marched.
    const int32_t* ready;       // (z, y, x) of bricks: whether what samples in it read is there; or
    FhashFetch fetch;           // null where all is there
} FhashMarch;

/* codec.cpp */
FHASH_EXPORT int64_t fhash_codec_abi_version(void);
/* gram.cpp */
FHASH_EXPORT int64_t fhash_gram_f32(const float* values, int64_t before, int64_t length,
                                    int64_t after, double center, double* out);
FHASH_EXPORT int64_t fhash_gram_f64(const double* values, int64_t before, int64_t length,
                                    int64_t after, double center, double* out);
/* head_inputs.cpp */
FHASH_EXPORT int64_t fhash_head_inputs(const float* decoded, const int64_t* shape,
                                       const int64_t* places, const int64_t* slots, int64_t count,
                                       const int64_t* neighbours, double low, double high,
                                       double inverse, double unit, int16_t* out);
/* march.cpp */
FHASH_EXPORT int64_t fhash_march(const FhashMarch* march, int64_t flags, int64_t first,
                                 int64_t stop, int64_t* counters);
/* march_bricks.cpp */
FHASH_EXPORT int64_t fhash_march_bricks(const float* values, const int64_t* shape,
                                        const int64_t* strides, const int64_t* bricks, int64_t side,
                                        int64_t first, int64_t stop, float* low, float* high,
                                        float* scratch);
FHASH_EXPORT int64_t fhash_march_distance_layers(const int64_t* shape, int32_t* distance,
                                                 int64_t first, int64_t stop, int32_t* lines);
FHASH_EXPORT int64_t fhash_march_distance_rows(const int64_t* shape, int32_t* distance,
                                               int64_t first, int64_t stop, int32_t* lines);
FHASH_EXPORT int64_t fhash_march_cells(const float* values, const int64_t* shape,
                                       const int64_t* bricks, const float* limits, int64_t count,
                                       const int64_t* numbers, int64_t first, int64_t stop,
                                       uint32_t* cells);
/* march_light.cpp */
FHASH_EXPORT int64_t fhash_march_extinction(const float* values, const int64_t* shape,
                                            const float* table, int64_t entries, double low,
                                            double scale, int64_t cell, const int64_t* points,
                                            int64_t first, int64_t stop, const float* factors,
                                            float* out, float* scratch);
FHASH_EXPORT int64_t fhash_march_sum(const float* extinction, const int64_t* points,
                                     const double* step, int64_t count, int64_t first, int64_t stop,
                                     float* out);
/* march_slopes.cpp */
FHASH_EXPORT int64_t fhash_march_smooth_layers(const float* values, const int64_t* shape,
                                               const float* weights, int64_t radius, int64_t first,
                                               int64_t stop, float* out, float* scratch);
FHASH_EXPORT int64_t fhash_march_smooth_rows(const float* values, const int64_t* shape,
                                             const float* weights, int64_t radius, int64_t first,
                                             int64_t stop, float* out);
FHASH_EXPORT int64_t fhash_march_factors(const float* values, const int64_t* shape,
                                         const double* scale, const float* table, int64_t entries,
                                         int64_t first, int64_t stop, float* out);
/* quality.cpp */
FHASH_EXPORT int64_t fhash_scan_f32(const float* values, int64_t rows, int64_t n, double factor,
                                    double* result);
FHASH_EXPORT int64_t fhash_scan_f64(const double* values, int64_t rows, int64_t n, double factor,
                                    double* result);
FHASH_EXPORT int64_t fhash_errors_f32(const float* original, const float* decoded,
                                      const uint8_t* mask, int64_t rows, int64_t n, double scale,
                                      double low, double high, double* result);
FHASH_EXPORT int64_t fhash_errors_f64(const double* original, const double* decoded,
                                      const uint8_t* mask, int64_t rows, int64_t n, double scale,
                                      double low, double high, double* result);
FHASH_EXPORT int64_t fhash_histogram_f32(const float* values, int64_t n, double scale, double low,
                                         double factor, int64_t bins, int64_t* counts);
FHASH_EXPORT int64_t fhash_histogram_f64(const double* values, int64_t n, double scale, double low,
                                         double factor, int64_t bins, int64_t* counts);
FHASH_EXPORT int64_t fhash_ssim_f32(const float* original, const float* decoded,
                                    const uint8_t* mask, const int64_t* shape, const int64_t* tile,
                                    const double* numbers, double* result);
FHASH_EXPORT int64_t fhash_ssim_f64(const double* original, const double* decoded,
                                    const uint8_t* mask, const int64_t* shape, const int64_t* tile,
                                    const double* numbers, double* result);
FHASH_EXPORT int64_t fhash_magnitudes(const float* values, int64_t n, int64_t shift,
                                      int64_t* counts, double* squares);
/* train_head.cpp */
FHASH_EXPORT int64_t fhash_head_learn(const int16_t* inputs, const int32_t* targets,
                                      const int32_t* lowest, const int32_t* highest,
                                      const float* weights, const int64_t* sizes,
                                      double* parameters, double* means, double* squares,
                                      const double* rates, const double* roots, int64_t first,
                                      int64_t count, int64_t as_in_file, int64_t threads);
FHASH_EXPORT int64_t fhash_head_errors(const int16_t* inputs, const int32_t* targets,
                                       const int32_t* lowest, const int32_t* highest,
                                       const float* weights, const int64_t* sizes,
                                       double* parameters, int64_t as_in_file, int64_t* sums);

#ifdef __cplusplus
}
#endif
#endif
