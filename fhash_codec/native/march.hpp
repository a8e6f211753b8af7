// What a marcher is given, and values between vertices; shared by march.cpp and its parts.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "core.hpp"

constexpr int FHASH_SURFACES = 64, FHASH_POWERS = 1024, FHASH_BRICK = 4;

// Mirrored field by field in fhash_codec/render/native_march.py. All places and directions are in vertices of the frame, x, y, z.
extern "C" struct FhashMarch {
    const float* values;          // (z, y, x), NaN where there is none
    std::int64_t shape[3];        // z, y, x
    const std::int32_t* distance; // (z, y, x) of bricks: chessboard distance to the nearest that matters, 0 for such a one; null: all matter
    const std::uint32_t* cells;   // (z, y, x, 2) of bricks: bit x + 4 y + 16 z for each cell where something can be seen; or null
    const float* highest;         // (z, y, x) of bricks: largest value, for the maximum along a ray; null: all may hold it
    std::int64_t bricks[3];       // of FHASH_BRICK cells along a side, along z, y, x
    const float* table;           // (entries + 1, 4): red, green, blue, opacity of one step; the last entry twice
    const double* extinction;     // (entries + 1,): of one step
    std::int64_t entries;
    double low, scale;            // the entry of a value is (value - low) * scale
    const float* light;           // (z, y, x, 2): light from the lamp and from around that reaches a place; null for all of it
    std::int64_t light_shape[3];
    double light_offset[3], light_scale;  // the point of the light grid at a place is place * scale + offset
    double eye[3], right[3], up[3], forward[3];
    double box[3][2], seen[3][2];  // the drawn box, in which steps are counted, and what of it the frame has values of
    double spacing[3];            // length of one vertex spacing; negative on a descending axis
    std::int64_t width, height, parallel, rays;  // rays along a pixel's side
    double step, threshold;       // length of a step; share of light at which a ray ends
    std::int64_t jitter;
    double lamp[3];               // direction towards the light, unit length; zero for the camera's
    double ambient, diffuse, specular, steep;  // steep: stretches the table of highlights over the cosines next to 1
    double gradient[3], floor;    // per axis: from values to what is shaded by; below `floor` there is no direction
    const float* powers;          // (FHASH_POWERS + 2,): the highlight by (1 - cosine) * steep
    std::int64_t surfaces;
    double surface[FHASH_SURFACES][5];  // value, red, green, blue, opacity
    float* out;                   // (height, width, 4), multiplied by the opacity
    float* depth;                 // (height, width) or null
    float* normal;                // (height, width, 3) or null
    std::int64_t central;         // whether gradients that are shaded by are differences over two vertices
    std::int64_t path;            // of the processor: 0 the quickest that there is, 1 at most AVX2, 2 neither
};

struct FhashCell {
    double value, gx, gy, gz;
};

// The trilinear value and its gradient per vertex, clamped. A vertex of no weight need not have a value; where it has none, neither has
// the gradient (NaN).
inline FhashCell fhash_cell_at(const FhashMarch& m, double x, double y, double z) {
    using std::max;
    using std::min;
    const int nx = (int)m.shape[2], ny = (int)m.shape[1], nz = (int)m.shape[0];
    x = max(0.0, min(x, nx - 1.0));  // in this order: what is not a number becomes 0
    y = max(0.0, min(y, ny - 1.0));
    z = max(0.0, min(z, nz - 1.0));
    const int i = min((int)x, max(nx - 2, 0)), j = min((int)y, max(ny - 2, 0)), h = min((int)z, max(nz - 2, 0));
    const int sx = nx > 1, sy = ny > 1 ? nx : 0;
    const std::int64_t sz = nz > 1 ? (std::int64_t)nx * ny : 0;
    const double fx = x - i, fy = y - j, fz = z - h;
    const float* v = m.values + ((std::int64_t)h * ny + j) * nx + i;
    const double c[8] = {v[0], v[sx], v[sy], v[sy + sx], v[sz], v[sz + sx], v[sz + sy], v[sz + sy + sx]};
    // Exactly the value of a face whose vertices all have the same.
    const auto mix = [](double a, double b, double share) { return share == 0 ? a : share == 1 ? b : a + share * (b - a); };
    const double near = mix(mix(c[0], c[1], fx), mix(c[2], c[3], fx), fy), far = mix(mix(c[4], c[5], fx), mix(c[6], c[7], fx), fy);
    const double value = mix(near, far, fz);
    const double gx = (1 - fz) * ((1 - fy) * (c[1] - c[0]) + fy * (c[3] - c[2])) + fz * ((1 - fy) * (c[5] - c[4]) + fy * (c[7] - c[6]));
    const double gy = (1 - fz) * ((1 - fx) * (c[2] - c[0]) + fx * (c[3] - c[1])) + fz * ((1 - fx) * (c[6] - c[4]) + fx * (c[7] - c[5]));
    const double gz = (1 - fy) * ((1 - fx) * (c[4] - c[0]) + fx * (c[5] - c[1])) + fy * ((1 - fx) * (c[6] - c[2]) + fx * (c[7] - c[3]));
    return {value, gx, gy, gz};
}

// The gradient by central differences: half of that between the values a vertex behind and before, clamped. Where one of them is missing
// that of the cell, along that axis.
inline void fhash_central(const FhashMarch& m, double x, double y, double z, FhashCell& cell) {
    using std::max;
    using std::min;
    double at[3] = {min(max(x, 0.0), m.shape[2] - 1.0), min(max(y, 0.0), m.shape[1] - 1.0), min(max(z, 0.0), m.shape[0] - 1.0)};
    double* const slopes[3] = {&cell.gx, &cell.gy, &cell.gz};
    for (int c = 0; c < 3; c++) {
        const double here = at[c];
        at[c] = here + 1;
        const double behind = fhash_cell_at(m, at[0], at[1], at[2]).value;
        at[c] = here - 1;
        const double difference = (behind - fhash_cell_at(m, at[0], at[1], at[2]).value) / 2;
        at[c] = here;
        if (difference == difference) *slopes[c] = difference;
    }
}
