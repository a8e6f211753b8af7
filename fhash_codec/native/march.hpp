// Values between vertices. Shared by march.cpp and its parts.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "codec.h"
#include "target.hpp"

#if !defined(FHASH_CUDA)
#include <algorithm>
#include <atomic>

// FHASH_APART before a function that many places call, and seldom: compiled once.
#if defined(_MSC_VER)
#define FHASH_APART __declspec(noinline)
#else
#define FHASH_APART __attribute__((noinline))
#endif

// What is marched; march.cu has a structure in its place whose absent parts are constants.
using FhashInput = FhashMarch;

// `fhash_march` for a target.
using FhashTiles = void(const FhashInput& march, int flags, std::int64_t first, std::int64_t stop,
                        std::int64_t* counters);
FhashTiles fhash_march_v1, fhash_march_v3, fhash_march_v4;
#endif

namespace {

// By value and always inlined. The functions of the standard library are not vectorised, and not
// inlined into functions for other machines.
template <class T> FHASH_INLINE T min(T a, T b) { return b < a ? b : a; }
template <class T> FHASH_INLINE T max(T a, T b) { return a < b ? b : a; }
// What is not a number becomes the lower end.
template <class T> FHASH_INLINE T clamp(T x, T low, T high) {
    const T least = x > low ? x : low;
    return least < high ? least : high;
}

struct FhashCell {
    double value, gx, gy, gz;
};

#if defined(FHASH_CUDA)
constexpr int POINTS = 2;
// The normalised value of the network at a place, and its slopes, if they are asked for (march.cu).
float network_at(const FhashInput& m, double x, double y, double z, float* slopes);
#else
constexpr int POINTS = FHASH_POINTS;
#endif

// Move a place along an axis from vertices of the frame to those of a network's box. Returns how
// many of these one of the frame is there.
inline double to_box(const double* places, std::int64_t frame, std::int64_t box, double& at) {
    if (!places) return 1;
    const int before = max(0, min((int)at, (int)frame - 2));
    const double here = places[before], step = frame > 1 ? places[before + 1] - here : 1;
    at = max(0.0, min(here + (at - before) * step, box - 1.0));
    return step;
}

// The same along x, y and z.
inline void to_box(const FhashInput& m, double (&at)[3], double (&rates)[3]) {
    const double* const places[3] = {m.network_x, m.network_y, m.network_z};
    for (int c = 0; c < 3; c++)
        rates[c] = to_box(places[c], m.shape[2 - c], m.network_shape[2 - c], at[c]);
}

// Places at which a network is evaluated together, and its values there, with NaN where it fails.
struct FhashPoints {
    int count = 0;
    double x[POINTS], y[POINTS], z[POINTS];
    float values[POINTS];
    float slopes[POINTS][4];  // per key frame and vertex, t, z, y, x, if asked for

    void add(double at_x, double at_y, double at_z) {
        x[count] = at_x; y[count] = at_y; z[count++] = at_z;
    }

    void evaluate(const FhashInput& m, bool sloped) {
        double rates[POINTS][3];
        for (int i = 0; i < count; i++) {
            double at[3] = {x[i], y[i], z[i]};
            to_box(m, at, rates[i]);
            x[i] = at[0]; y[i] = at[1]; z[i] = at[2];
        }
#if defined(FHASH_CUDA)
        constexpr int status = 0;
        for (int i = 0; i < count; i++)
            values[i] = network_at(m, x[i], y[i], z[i], sloped ? slopes[i] : nullptr);
#else
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
#endif
        const float low = (float)m.network_low, span = (float)m.network_span;
        for (int i = 0; i < count; i++) {
            const float unit = values[i] < 0 ? 0.f : values[i] > 1 ? 1.f : values[i];
            values[i] = status ? std::numeric_limits<float>::quiet_NaN() : low + unit * span;
            for (int a = 1; sloped && a < 4; a++) {
                const float slope = slopes[i][a] * span * (float)rates[i][3 - a];
                slopes[i][a] = slope - slope == 0 ? slope : 0.f;
            }
        }
    }
};

// The trilinear value at a place, clamped to the vertices, and its gradient per vertex. A vertex of
// no weight need not have a value; where it has none, the gradient has none (NaN). values: z, y, x
// of a shape.
inline FhashCell trilinear(const float* values, const std::int64_t* shape, double x, double y,
                           double z) {
    const int nx = (int)shape[2], ny = (int)shape[1], nz = (int)shape[0];
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
    const double gx = (1 - fz) * ((1 - fy) * (c[1] - c[0]) + fy * (c[3] - c[2])) +
                      fz * ((1 - fy) * (c[5] - c[4]) + fy * (c[7] - c[6]));
    const double gy = (1 - fz) * ((1 - fx) * (c[2] - c[0]) + fx * (c[3] - c[1])) +
                      fz * ((1 - fx) * (c[6] - c[4]) + fx * (c[7] - c[5]));
    const double gz = (1 - fy) * ((1 - fx) * (c[4] - c[0]) + fx * (c[5] - c[1])) +
                      fy * ((1 - fx) * (c[6] - c[2]) + fx * (c[7] - c[3]));
    return {value, gx, gy, gz};
}

// The same of a network, where it has a value.
FHASH_APART FhashCell cell_of_network(const FhashInput& m, double x, double y, double z,
                                      bool sloped) {
    double at[3] = {x, y, z}, rates[3];
    for (int c = 0; c < 3; c++) at[c] = max(0.0, min(at[c], m.shape[2 - c] - 1.0));
    x = at[0]; y = at[1]; z = at[2];
    to_box(m, at, rates);
    const double there = trilinear(m.values, m.network_shape, at[0], at[1], at[2]).value;
    if (!(there == there)) return {there, there, there, there};
    FhashPoints point;
    point.add(x, y, z);
    point.evaluate(m, sloped);
    const float(&slopes)[4] = point.slopes[0];
    if (!sloped) return {point.values[0], 0, 0, 0};
    return {point.values[0], slopes[3], slopes[2], slopes[1]};
}

// The same of the frame's values, or of smoother ones.
inline FhashCell fhash_cell_in(const FhashInput& m, const float* values, double x, double y,
                               double z, bool sloped = true) {
    if (m.network && values == m.values) return cell_of_network(m, x, y, z, sloped);
    return trilinear(values, m.shape, x, y, z);
}

// The same for the values of the frame.
inline FhashCell fhash_cell_at(const FhashInput& m, double x, double y, double z,
                               bool sloped = true) {
    return fhash_cell_in(m, m.values, x, y, z, sloped);
}

// Replace the gradient of a cell by central differences: half of the difference between the values
// one vertex on and one vertex back, clamped to the frame. Where one of them is missing, the cell's
// gradient along that axis stays. values: those of the frame, or smoother ones.
inline void fhash_central(const FhashInput& m, const float* values, double x, double y, double z,
                          FhashCell& cell) {
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
