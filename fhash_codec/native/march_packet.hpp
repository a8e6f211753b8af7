// A packet of 4 x 4 rays, and the light on what they meet. All march_*.hpp are parts of march.cpp alone.
#pragma once

#include "march.hpp"

namespace {

using std::int32_t;
using std::int64_t;

// By value and always inlined: the standard ones are neither vectorised nor, between functions for different machines, inlined.
template <class T> FHASH_INLINE T min(T a, T b) { return b < a ? b : a; }
template <class T> FHASH_INLINE T max(T a, T b) { return a < b ? b : a; }
// What is not a number becomes the lower end.
template <class T> FHASH_INLINE T clamp(T x, T low, T high) { const T some = x > low ? x : low; return some < high ? some : high; }

FHASH_INLINE float known_or_zero(double slope) { return slope == slope ? (float)slope : 0.f; }

constexpr int N = 16, SIDE = 4, TILE = 16, BLOCK = 32;
// CENTRAL: shaded by differences over two vertices. WIDE: sampled by AVX-512, in frames of two columns or more.
constexpr int SHADED = 1, LIT = 2, MAXIMUM = 4, CENTRAL = 8, WIDE = 16;
const double ENDLESS = std::numeric_limits<double>::infinity();
const float NONE = std::numeric_limits<float>::quiet_NaN(), FAR = std::numeric_limits<float>::infinity();

struct Counters {
    int64_t rays = 0, passes = 0, samples = 0, gradients = 0, skips = 0;
};

// A cheap integer hash (lowbias32 by C. Wellons, public domain) for the place of a ray's first sample.
FHASH_INLINE double random_share(uint32_t x) {
    x ^= x >> 16; x *= 0x7feb352dU; x ^= x >> 15; x *= 0x846ca68bU; x ^= x >> 16;
    return (x + 0.5) / 4294967296.0;
}

// 1 - (1 - opacity)^share of an opacity below 0.01 by the binomial series, to 1e-10 of it.
FHASH_INLINE double opacity_of_share(double opacity, double share) {
    return share * opacity * (1 + (1 - share) * opacity / 2 * (1 + (2 - share) * opacity / 3 * (1 + (3 - share) * opacity / 4)));
}

// What shading takes from a march, in single precision.
struct Phong {
    float ambient, diffuse, specular, steep, floor;
    const float* powers;
    explicit Phong(const FhashMarch& m)
        : ambient((float)m.ambient), diffuse((float)m.diffuse), specular((float)m.specular), steep((float)m.steep),
          floor((float)(m.floor * m.floor)), powers(m.powers) {}
};

// 16 rays, and how far they are. Single precision where vectors work on them, double where single rays do.
template <int WANTED> struct Packet {
    const FhashMarch& m;
    const Phong phong;
    alignas(64) float ox[N], oy[N], oz[N], dx[N], dy[N], dz[N], ix[N], iy[N], iz[N];  // the first sample, a step, steps per vertex
    alignas(64) float farx[N], fary[N], farz[N];  // much where it does not move along an axis
    alignas(64) int upx[N], upy[N], upz[N];      // whether it ascends
    alignas(64) float tox[N], toy[N], toz[N], hx[N], hy[N], hz[N];                    // towards the light; halfway between it and the eye
    alignas(64) float r[N], g[N], b[N], a[N], left[N], depth[N], previous[N];  // colours and opacity of the block; light behind those before
    alignas(64) float gx[N], gy[N], gz[N], at[N], value[N], alpha[N], px[N], py[N], pz[N], best[N];
    alignas(64) float cr[N], cg[N], cb[N];  // colours of the samples, where WIDE
    alignas(64) int k[N], count[N], last[N], on[N], where[N];  // sample, their number, the one of the shorter step, and of the maximum
    alignas(64) int quitting[N];                               // whether the sample is the last before a gap, for surfaces
    alignas(64) double red[N], green[N], blue[N], clear[N], rest[N], begin[N], entered[N], leaving[N], from[N];
    alignas(64) double o[3][N], d[3][N], normal[3][N];

    const bool whole;  // whether the frame has values of all that is drawn

    explicit Packet(const FhashMarch& given) : m(given), phong(given), whole(std::equal(&m.box[0][0], &m.box[0][0] + 6, &m.seen[0][0])) {}

    FHASH_INLINE int aim(int64_t x, int64_t y, int64_t ray);
    FHASH_INLINE int skip(Counters& counted);
    template <bool CELLS> FHASH_INLINE int leap(Counters& counted);
    bool visible(int l, double sample) const;
    void meet(Counters& counted);
    void part_ways(const int* leapt, Counters& counted);
    FHASH_INLINE void sample(Counters& counted, int& seen, int& ending, int& lost);
    void shorten();
    void mend();
    FHASH_INLINE void slopes();
    void mend_slopes();
    void see(int l, double sample, const FhashCell* cell, Counters& counted);
    void cross(int l, double to, double now, Counters& counted);
    void surfaces(Counters& counted);
    void finish(Counters& counted);
    FHASH_INLINE void composite(Counters& counted);
    FHASH_INLINE void march(Counters& counted);
    FHASH_INLINE void write(int64_t x, int64_t y);
    FhashCell cell(int l, double sample) const {
        return fhash_cell_at(m, o[0][l] + sample * d[0][l], o[1][l] + sample * d[1][l], o[2][l] + sample * d[2][l]);
    }
    // Where a ray enters or leaves. What rounding keeps off a face lies on it: of a surface with the value of a whole face that decides.
    FhashCell border(int l, double sample) const {
        double at[3];
        for (int c = 0; c < 3; c++) {
            at[c] = o[c][l] + sample * d[c][l];
            for (const double face : m.seen[c]) at[c] = std::fabs(at[c] - face) < 1e-7 ? face : at[c];
        }
        return fhash_cell_at(m, at[0], at[1], at[2]);
    }
    FHASH_INLINE void flush() {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            red[l] += clear[l] * r[l];
            green[l] += clear[l] * g[l];
            blue[l] += clear[l] * b[l];
            clear[l] *= 1 - (double)a[l];
            left[l] = (float)clear[l];
            r[l] = g[l] = b[l] = a[l] = 0;
        }
    }
};

// Trilinear from eight neighbours.
FHASH_INLINE float mixed(const float* v, int q, int sx, int sy, int sz, float fx, float fy, float fz) {
    const float a0 = v[q], a1 = v[q + sx], a2 = v[q + sy], a3 = v[q + sy + sx];
    const float b0 = v[q + sz], b1 = v[q + sz + sx], b2 = v[q + sz + sy], b3 = v[q + sz + sy + sx];
    const float p0 = a0 + fx * (a1 - a0), p1 = a2 + fx * (a3 - a2), p2 = b0 + fx * (b1 - b0), p3 = b2 + fx * (b3 - b2);
    const float s0 = p0 + fy * (p1 - p0), s1 = p2 + fy * (p3 - p2);
    return s0 + fz * (s1 - s0);
}

// Light from the lamp (0) or from around (1) at a place, trilinear in the grid, clamped.
FHASH_INLINE float light_at(const FhashMarch& m, int which, float x, float y, float z) {
    const float scale = (float)m.light_scale;
    const int nx = (int)m.light_shape[2], ny = (int)m.light_shape[1], nz = (int)m.light_shape[0];
    x = clamp(x * scale + (float)m.light_offset[0], 0.f, (float)(nx - 1));
    y = clamp(y * scale + (float)m.light_offset[1], 0.f, (float)(ny - 1));
    z = clamp(z * scale + (float)m.light_offset[2], 0.f, (float)(nz - 1));
    const int i = min((int)x, max(nx - 2, 0)), j = min((int)y, max(ny - 2, 0)), h = min((int)z, max(nz - 2, 0));
    const int sx = nx > 1 ? 2 : 0, sy = ny > 1 ? 2 * nx : 0, sz = nz > 1 ? 2 * nx * ny : 0, q = 2 * ((h * ny + j) * nx + i);
    const float fx = x - i, fy = y - j, fz = z - h;
    return mixed(m.light, q + which, sx, sy, sz, fx, fy, fz);
}

// Two-sided Phong with the vector halfway between light and eye (Blinn): the shares of a gradient's light that is scattered and mirrored
// of that from the lamp. `one` is 1 / size of the gradient; where that vanishes both fade, so that noise has no direction.
FHASH_INLINE float size_of(const Phong& phong, float x, float y, float z) { return 1 / sqrtf(x * x + y * y + z * z + phong.floor); }
FHASH_INLINE float scattered(const Phong& phong, float towards, float one) { return phong.diffuse * min(fabsf(towards) * one, 1.f); }
FHASH_INLINE float mirrored(const Phong& phong, float halfway, float one) {
    const float at = clamp((1 - fabsf(halfway) * one) * phong.steep, 0.f, 1.f) * FHASH_POWERS;
    const int n = (int)at;
    const float low = phong.powers[n], high = phong.powers[n + 1];
    return phong.specular * (low + (at - (float)n) * (high - low));
}

}  // namespace
