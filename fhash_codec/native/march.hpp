// The input of the marcher, and values between vertices. Shared by march.cpp and its parts.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "core.hpp"
#include "target.hpp"

constexpr int FHASH_SURFACES = 64;  // surfaces of a picture, at most
constexpr int FHASH_POWERS = 1024;  // intervals of the table of highlights
constexpr int FHASH_BRICK = 4;      // cells along a brick's side
constexpr int FHASH_PLANES = 6;     // planes that clip a picture, at most
constexpr int FHASH_GRADES = 1024;  // intervals of the table of factors by gradient
constexpr int FHASH_POINTS = 64;    // points that a network is evaluated at together, at most

// `fhash_network_points` of the network's library (network/points.cpp).
using FhashNetwork = std::int64_t (*)(const std::int64_t* sizes, const std::int64_t* levels,
                                      const std::int64_t* layers, const std::int64_t* columns,
                                      std::int64_t count, std::int64_t path, float* values,
                                      float* slopes, float* by_inputs);

// Decodes what the samples in a brick read, and is nonzero where that fails.
using FhashFetch = std::int64_t (*)(std::int64_t brick);

// Mirrored field by field in fhash_codec/rendering/march.py. All places and directions
// are in vertices of the frame, x, y, z.
extern "C" struct FhashMarch {
    // The frame.
    const float* values;    // (z, y, x), NaN where there is none
    std::int64_t shape[3];  // z, y, x
    // What rays may leap over; null pointers where everything is looked at.
    const std::int32_t* distance;  // (z, y, x) of bricks: distance to the nearest that matters
    const std::uint32_t* cells;    // (z, y, x, 2) of bricks: bit x + 4 y + 16 z of a visible cell
    const float* highest;          // (z, y, x) of bricks: largest value, for FLAGS & MAXIMUM
    std::int64_t bricks[3];        // of FHASH_BRICK cells along a side; their number along z, y, x
    // The transfer function.
    const float* table;        // (entries + 1, 4): red, green, blue, opacity of one step
    const double* extinction;  // (entries + 1,): of one step
    std::int64_t entries;      // the last entry is in the tables twice
    double low, scale;         // the entry of a value is (value - low) * scale
    // The light grid.
    const float* light;  // (z, y, x, 2): shares from the lamp and from around; null for all light
    std::int64_t light_shape[3];  // z, y, x
    double light_offset[3], light_scale;  // a place is at place * scale + offset in the light grid
    // The rays.
    double eye[3], right[3], up[3], forward[3];
    double box[3][2];        // the drawn box as it is clipped, in which steps are counted
    double seen[3][2];       // the part of the box in which the frame has values
    double spacing[3];       // length of one vertex spacing; negative on a descending axis
    std::int64_t width, height, parallel;
    std::int64_t rays;       // rays along a pixel's side
    double step;             // length of a step
    double threshold;        // share of light behind at which a ray ends
    std::int64_t jitter;     // whether the first sample is shifted by a share of the ray's own
    // Phong's model.
    double lamp[3];          // unit vector towards the light; zero for a light at the camera
    double ambient, diffuse, specular;
    double steep;            // stretches the table of highlights over the cosines next to 1
    double gradient[3];      // for each axis, from differences to the gradients of shading
    double floor;            // gradient at which shading has faded by half
    const float* powers;     // (FHASH_POWERS + 2,): the highlight by (1 - cosine) * steep
    // The surfaces: value, red, green, blue, opacity.
    std::int64_t surfaces;
    double surface[FHASH_SURFACES][5];
    // The pictures.
    float* out;              // (height, width, 4), multiplied by the opacity
    float* depth;            // (height, width) or null
    float* normal;           // (height, width, 3) or null
    std::int64_t central;    // whether the gradients of shading are central differences
    std::int64_t path;       // instructions: 0 the processor's, 1 at most AVX2, 2 the baseline
    // Planes that clip the box: a place is kept where their first three numbers times the place
    // are at least the fourth.
    std::int64_t planes;
    double plane[FHASH_PLANES][4];
    // Opacity by gradient.
    const float* grading;    // (FHASH_GRADES + 2,): factors of the extinction by gradient; or null
    double grade_scale;      // entries of that table to a gradient of shading of 1
    std::int64_t unlit;      // whether gradients are for opacity alone, not for shading
    const float* smooth;     // (z, y, x): values whose central differences shade; or null
    // A network with values of its own, in place of those of the frame, which then say where there
    // is a value.
    FhashNetwork network;    // null for none
    const std::int64_t* network_sizes;
    const std::int64_t* network_levels;
    const std::int64_t* network_layers;
    std::int64_t network_path;
    std::int64_t network_whole;  // whether there is a value at all places of the frame
    double network_low, network_span;  // the value of its 0, and the change to that of its 1
    std::int64_t* network_status;      // takes what it returns where it fails
    // A frame that is decoded while it is marched.
    const std::int32_t* ready;  // (z, y, x) of bricks: whether what samples in it read is there; or
    FhashFetch fetch;           // null where all is there
};

// `fhash_march` for a target.
using FhashTiles = void(const FhashMarch& march, int flags, std::int64_t first, std::int64_t stop,
                        std::int64_t* counters);
FhashTiles fhash_march_v1, fhash_march_v3, fhash_march_v4;

namespace {

struct FhashCell {
    double value, gx, gy, gz;
};

// Places at which a network is evaluated together, and its values there, with NaN where it fails.
struct FhashPoints {
    int count = 0;
    double x[FHASH_POINTS], y[FHASH_POINTS], z[FHASH_POINTS];
    float values[FHASH_POINTS];
    float slopes[FHASH_POINTS][4];  // per key frame and vertex, t, z, y, x, if asked for

    void add(double at_x, double at_y, double at_z) {
        x[count] = at_x; y[count] = at_y; z[count++] = at_z;
    }

    void evaluate(const FhashMarch& m, bool sloped) {
        const double time = 0;
        const double* const places[4] = {&time, z, y, x};
        std::int64_t columns[8];
        for (int a = 0; a < 4; a++) {
            columns[2 * a] = reinterpret_cast<std::int64_t>(places[a]);
            columns[2 * a + 1] = a > 0;
        }
        const std::int64_t status =
            m.network(m.network_sizes, m.network_levels, m.network_layers, columns, count,
                      m.network_path, values, sloped ? slopes[0] : nullptr, nullptr);
        if (status) *m.network_status = status;
        const float low = (float)m.network_low, span = (float)m.network_span;
        for (int i = 0; i < count; i++) {
            const float unit = values[i] < 0 ? 0.f : values[i] > 1 ? 1.f : values[i];
            values[i] = status ? std::numeric_limits<float>::quiet_NaN() : low + unit * span;
            for (int a = 1; sloped && a < 4; a++) {
                const float slope = slopes[i][a] * span;
                slopes[i][a] = slope - slope == 0 ? slope : 0.f;
            }
        }
    }
};

// The trilinear value at a place, clamped to the frame, and its gradient per vertex. A vertex of no
// weight need not have a value; where it has none, the gradient has none (NaN). values: (z, y, x)
// of the frame's shape.
inline FhashCell fhash_cell_in(const FhashMarch& m, const float* values, double x, double y,
                               double z, bool sloped = true) {
    using std::max;
    using std::min;
    const int nx = (int)m.shape[2], ny = (int)m.shape[1], nz = (int)m.shape[0];
    x = max(0.0, min(x, nx - 1.0));  // in this order: what is not a number becomes 0
    y = max(0.0, min(y, ny - 1.0));
    z = max(0.0, min(z, nz - 1.0));
    const int i = min((int)x, max(nx - 2, 0)), j = min((int)y, max(ny - 2, 0));
    const int h = min((int)z, max(nz - 2, 0));
    const int sx = nx > 1, sy = ny > 1 ? nx : 0;
    const std::int64_t sz = nz > 1 ? (std::int64_t)nx * ny : 0;
    const double fx = x - i, fy = y - j, fz = z - h;
    const float* v = values + ((std::int64_t)h * ny + j) * nx + i;
    const double c[8] = {v[0],  v[sx],      v[sy],      v[sy + sx],
                         v[sz], v[sz + sx], v[sz + sy], v[sz + sy + sx]};
    // On a face whose vertices all have one value, exactly that value.
    const auto mix = [](double a, double b, double share) {
        return share == 0 ? a : share == 1 ? b : a + share * (b - a);
    };
    const double near = mix(mix(c[0], c[1], fx), mix(c[2], c[3], fx), fy);
    const double far = mix(mix(c[4], c[5], fx), mix(c[6], c[7], fx), fy);
    const double value = mix(near, far, fz);
    if (m.network && values == m.values) {
        if (!(value == value)) return {value, value, value, value};
        FhashPoints point;
        point.add(x, y, z);
        point.evaluate(m, sloped);
        const float(&slopes)[4] = point.slopes[0];
        if (!sloped) return {point.values[0], 0, 0, 0};
        return {point.values[0], slopes[3], slopes[2], slopes[1]};
    }
    const double gx = (1 - fz) * ((1 - fy) * (c[1] - c[0]) + fy * (c[3] - c[2])) +
                      fz * ((1 - fy) * (c[5] - c[4]) + fy * (c[7] - c[6]));
    const double gy = (1 - fz) * ((1 - fx) * (c[2] - c[0]) + fx * (c[3] - c[1])) +
                      fz * ((1 - fx) * (c[6] - c[4]) + fx * (c[7] - c[5]));
    const double gz = (1 - fy) * ((1 - fx) * (c[4] - c[0]) + fx * (c[5] - c[1])) +
                      fy * ((1 - fx) * (c[6] - c[2]) + fx * (c[7] - c[3]));
    return {value, gx, gy, gz};
}

// The same for the values of the frame.
inline FhashCell fhash_cell_at(const FhashMarch& m, double x, double y, double z,
                               bool sloped = true) {
    return fhash_cell_in(m, m.values, x, y, z, sloped);
}

// Replace the gradient of a cell by central differences: half of the difference between the values
// one vertex on and one vertex back, clamped to the frame. Where one of them is missing, the cell's
// gradient along that axis stays. values: those of the frame, or smoother ones.
inline void fhash_central(const FhashMarch& m, const float* values, double x, double y, double z,
                          FhashCell& cell) {
    using std::max;
    using std::min;
    double at[3] = {min(max(x, 0.0), m.shape[2] - 1.0), min(max(y, 0.0), m.shape[1] - 1.0),
                    min(max(z, 0.0), m.shape[0] - 1.0)};
    double* const slopes[3] = {&cell.gx, &cell.gy, &cell.gz};
    for (int c = 0; c < 3; c++) {
        const double here = at[c];
        at[c] = here + 1;
        const double behind = fhash_cell_in(m, values, at[0], at[1], at[2], false).value;
        at[c] = here - 1;
        const double before = fhash_cell_in(m, values, at[0], at[1], at[2], false).value;
        const double difference = (behind - before) / 2;
        at[c] = here;
        if (difference == difference) *slopes[c] = difference;
    }
}

}  // namespace
