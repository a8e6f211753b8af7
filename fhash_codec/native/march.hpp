// Values between vertices. Shared by march.cpp and its parts.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "codec.h"
#include "target.hpp"

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
