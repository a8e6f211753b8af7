// A packet of 4 x 4 rays, and the light on what they meet. All march_*.hpp are parts of
// march_draw.hpp, which is compiled once for each target.
//
// What is drawn is decided by flags at run time, between the loops over rays. A loop over rays that
// would compute more than is drawn is a template on what it is for.
#pragma once

#include "march.hpp"

namespace {

using std::int32_t;
using std::int64_t;

FHASH_INLINE float known_or_zero(double slope) { return slope == slope ? (float)slope : 0.f; }

#if defined(FHASH_CUDA)
constexpr int SIDE = 1;  // a packet of one ray for each thread
#define FHASH_LANES
// Whether something holds for any ray of a warp, which marches in step: packets that end, and
// networks that are evaluated together.
FHASH_INLINE int of_any(int holds) { return __any_sync(0xffffffffu, holds); }
#else
constexpr int SIDE = 4;   // rays along a packet's side
#define FHASH_LANES alignas(64)
FHASH_INLINE int of_any(int holds) { return holds; }
#endif
constexpr int N = SIDE * SIDE;  // rays of a packet
constexpr int TILE = 16;  // pixels along a tile's side
constexpr int BLOCK = 32; // samples whose opacity is summed in single precision
constexpr int AHEAD = 16; // samples of a ray at which a network may be evaluated ahead

// Flags of what is drawn.
constexpr int SHADED = 1;    // the volume is lit by its gradients
constexpr int LIT = 2;       // by what a light grid leaves of the light
constexpr int MAXIMUM = 4;   // the largest value along each ray, instead of the volume
constexpr int MINIMUM = 32;  // with MAXIMUM: of the values times -1
constexpr int AVERAGE = 64;  // the mean along each ray, instead of the volume
constexpr int ATTENUATED = 128;  // the largest value along each ray after what lies before it
constexpr int GRADED = 256;      // with SHADED: the gradients decide on the opacity, too
constexpr int PROJECTED = MAXIMUM | AVERAGE | ATTENUATED;

// What a pass takes from its samples: values and opacities, these and the gradients, or the largest
// value.
enum Taken { OPACITIES, GRADIENTS, LARGEST };
// By what rays leap: bricks that do not matter, these and cells, or bricks below the largest value.
enum Leaps { BY_BRICKS, BY_CELLS, BY_LARGEST };

#if defined(FHASH_CUDA)  // NVRTC has none of these as constants
#define ENDLESS __longlong_as_double(0x7ff0000000000000LL)
#define NONE __int_as_float(0x7fffffff)
#define FAR __int_as_float(0x7f800000)
#else
constexpr double ENDLESS = std::numeric_limits<double>::infinity();
constexpr float NONE = std::numeric_limits<float>::quiet_NaN();
constexpr float FAR = std::numeric_limits<float>::infinity();
#endif

struct Counters {
    int64_t rays = 0, passes = 0, samples = 0, gradients = 0, skips = 0, evaluations = 0;
    void add_to(int64_t* counters) const {
        const int64_t all[] = {rays, passes, samples, gradients, skips, evaluations};
        for (int n = 0; n < 6; n++) counters[n] += all[n];
    }
};

// What the samples of a pass show.
struct Seen {
    int any = 0;     // whether one has an opacity
    int ending = 0;  // whether one is the last of its ray, whose step is shorter
    int lost = 0;    // whether one has no value
};

// A cheap integer hash (lowbias32 by C. Wellons, public domain) for the place of a ray's first
// sample.
FHASH_INLINE double random_share(uint32_t x) {
    x ^= x >> 16; x *= 0x7feb352dU; x ^= x >> 15; x *= 0x846ca68bU; x ^= x >> 16;
    return (x + 0.5) / 4294967296.0;
}

// 1 - (1 - opacity)^share for an opacity below 0.01, by the binomial series; off by 1e-10 of it.
FHASH_INLINE double opacity_of_share(double opacity, double share) {
    const double fourth = 1 + (3 - share) * opacity / 4;
    const double third = 1 + (2 - share) * opacity / 3 * fourth;
    return share * opacity * (1 + (1 - share) * opacity / 2 * third);
}

// What shading takes from a march, in single precision.
struct Phong {
    float ambient, diffuse, specular, steep;
    float floor;  // the square of that of the march
    const float* powers;
    explicit Phong(const FhashInput& m)
        : ambient((float)m.ambient), diffuse((float)m.diffuse), specular((float)m.specular),
          steep((float)m.steep), floor((float)(m.floor * m.floor)),
          powers(m.powers) {}
};

struct Lines;

// Whether the frame has values in all of the drawn box.
inline bool is_whole(const FhashInput& m) {
    bool same = true;
    for (int c = 0; c < 3; c++)
        for (int end = 0; end < 2; end++) same &= m.box[c][end] == m.seen[c][end];
    return same;
}

// 16 rays, and how far they are. In single precision what vectors work on, in double precision what
// is worked on for single rays.
struct Packet {
    const FhashInput& m;
#if defined(FHASH_CUDA)
    static constexpr int flags = FHASH_FLAGS;
#else
    const int flags;
#endif
    const Phong phong;
    // The lines of the rays.
    FHASH_LANES float ox[N], oy[N], oz[N];        // place of sample 0
    FHASH_LANES float dx[N], dy[N], dz[N];        // from a sample to the next
    FHASH_LANES float ix[N], iy[N], iz[N];        // samples per vertex
    FHASH_LANES float farx[N], fary[N], farz[N];  // much, where it does not move along an axis
    FHASH_LANES int upx[N], upy[N], upz[N];       // whether it ascends
    FHASH_LANES float tox[N], toy[N], toz[N];     // towards the light
    FHASH_LANES float hx[N], hy[N], hz[N];        // halfway between the light and the eye
    // What was seen.
    FHASH_LANES float r[N], g[N], b[N], a[N];  // colours and opacity of this block of samples
    FHASH_LANES float left[N];                 // light behind the blocks before
    FHASH_LANES float depth[N];
    FHASH_LANES float previous[N];  // value of the place before the sample, for surfaces; or NONE
    // The samples of this pass.
    FHASH_LANES float gx[N], gy[N], gz[N];  // gradients
    FHASH_LANES float at[N];                // entries of the table
    FHASH_LANES float value[N], alpha[N];
    FHASH_LANES float px[N], py[N], pz[N];  // places
    FHASH_LANES float farthest[N];          // sample behind which none is taken, with planes
    FHASH_LANES float best[N];              // largest value so far
    FHASH_LANES float cr[N], cg[N], cb[N];  // colours, where sampled by AVX-512
    // Numbers of samples.
    FHASH_LANES int k[N];         // the next one
    FHASH_LANES int count[N];     // of all
    FHASH_LANES int last[N];      // the one of the shorter step
    FHASH_LANES int on[N];        // whether the ray takes part in this pass
    FHASH_LANES int where[N];     // of the largest value
    FHASH_LANES int quitting[N];  // whether the sample is the last before a gap, for surfaces
    // Values of a network at the samples from `begun` on; bits of `held` say at which of them.
    float ahead[N][AHEAD];
    int begun[N];
    unsigned held[N];
    // The same in double precision.
    FHASH_LANES double red[N], green[N], blue[N], clear[N];  // colours and light behind the blocks
    FHASH_LANES double rest[N];                // length of the shorter step, in steps
    FHASH_LANES double begin[N];               // depth of sample 0
    FHASH_LANES double entered[N], leaving[N];  // the path, in samples
    FHASH_LANES double from[N];                // place of `previous`, in samples
    FHASH_LANES double o[3][N], d[3][N], normal[3][N];

    float low[3], high[3];  // the part of the frame that is seen, in which all samples lie
    const bool whole;       // whether the frame has values in all of the drawn box

#if defined(FHASH_CUDA)
    explicit Packet(const FhashInput& given)
        : m(given), phong(given), whole(is_whole(given)) {
#else
    Packet(const FhashInput& given, int drawn)
        : m(given), flags(drawn), phong(given), whole(is_whole(given)) {
#endif
        for (int c = 0; c < 3; c++) {
            const double most = (double)m.shape[2 - c] - 1;
            low[c] = (float)clamp(m.seen[c][0], 0.0, most);
            high[c] = (float)clamp(m.seen[c][1], (double)low[c], most);
            // Behind a clipped face lies a cell that is not seen: no sample takes its gradient.
            if (high[c] > low[c] && high[c] < (float)most) high[c] = nextafterf(high[c], -1.f);
        }
    }

    // march_rays.hpp
    FHASH_INLINE int aim(int64_t x, int64_t y, int64_t ray);
    FHASH_INLINE void point(Lines& lines, int left_most, int top_most, int64_t ray);
    FHASH_INLINE void cut(Lines& lines);
    FHASH_INLINE int count_samples(Lines& lines, int left_most, int top_most, int64_t ray);
    int keep_seen(const Lines& lines);
    FHASH_INLINE void place(const Lines& lines);
    FHASH_INLINE void reset();
    void aim_light(const Lines& lines);
    // march_skip.hpp
    FHASH_INLINE int skip(Counters& counted);
    template <Leaps BY> int leap(Counters& counted);
    bool fetch();
    bool visible(int l, double sample) const;
    void meet(Counters& counted);
    void part_ways(const int* leapt, Counters& counted);
    // march_sample.hpp
    template <Taken KIND> void sample(Counters& counted, Seen& seen);
    void shorten();
    void mend();
    void slopes(const float* values);
    void mend_slopes(const float* values);
    void mend_slope(int l, const float* values);
    FHASH_INLINE void look_up(int l);
    // march_network.hpp
    void sample_network(Counters& counted, Seen& seen);
    void look_ahead(Counters& counted);
    void slopes_of_network();
    void central_slopes_of_network();
    // march_surfaces.hpp
    void see(int l, double sample, const FhashCell* cell, Counters& counted);
    double root(int l, double level, double to, double now, Counters& counted) const;
    void add_surface(int l, double sample, const double* surface, Counters& counted);
    void cross(int l, double to, double now, Counters& counted);
    void surfaces(Counters& counted);
    void finish(Counters& counted);
    // march_projections.hpp
    void keep_lost_maximum();
    void average();
    void attenuate();
    FHASH_INLINE void end_attenuated();
    void show_value(int l, double entry, Counters& counted);
    void show_projection(Counters& counted);
    // march_grading.hpp
    void grade(Counters& counted);
    // march_draw.hpp
    FHASH_INLINE int alive();
    FHASH_INLINE void take(Counters& counted, Seen& seen);
    FHASH_INLINE void show(Seen seen, Counters& counted);
    template <bool SHADED_TOO, bool LIT_TOO> void composite(Counters& counted);
    FHASH_INLINE void end_rays(float stop);
    FHASH_INLINE void march(Counters& counted);
    FHASH_INLINE void write(int64_t x, int64_t y);

    // The place of a sample along an axis, in the part that is seen.
    double place_of(int l, int c, double sample) const {
        const double nearest = min(sample, (double)farthest[l]);
        return clamp(o[c][l] + nearest * d[c][l], (double)low[c], (double)high[c]);
    }
    FhashCell cell(int l, double sample, bool sloped = true) const {
        return fhash_cell_at(m, place_of(l, 0, sample), place_of(l, 1, sample),
                             place_of(l, 2, sample), sloped);
    }
    // The cell in which a ray enters or leaves, its place snapped onto the faces. Otherwise
    // rounding decides whether a ray meets a surface that coincides with a face.
    FhashCell border(int l, double sample) const {
        double place[3];
        for (int c = 0; c < 3; c++) {
            place[c] = o[c][l] + sample * d[c][l];
            for (const double face : m.seen[c])
                place[c] = fabs(place[c] - face) < 1e-7 ? face : place[c];
        }
        return fhash_cell_at(m, place[0], place[1], place[2], false);
    }
    // Join the block of samples to what was seen before.
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

// The trilinear value of eight neighbours.
FHASH_INLINE float mixed(const float* v, int q, int sx, int sy, int sz, float fx, float fy,
                         float fz) {
    const float a0 = v[q], a1 = v[q + sx], a2 = v[q + sy], a3 = v[q + sy + sx];
    const float b0 = v[q + sz], b1 = v[q + sz + sx], b2 = v[q + sz + sy], b3 = v[q + sz + sy + sx];
    const float p0 = a0 + fx * (a1 - a0), p1 = a2 + fx * (a3 - a2);
    const float p2 = b0 + fx * (b1 - b0), p3 = b2 + fx * (b3 - b2);
    const float s0 = p0 + fy * (p1 - p0), s1 = p2 + fy * (p3 - p2);
    return s0 + fz * (s1 - s0);
}

// The share of light from the lamp (0) or from around (1) at a place, trilinear, clamped to the
// grid.
FHASH_INLINE float light_at(const FhashInput& m, int which, float x, float y, float z) {
    const float scale = (float)m.light_scale;
    const int nx = (int)m.light_shape[2], ny = (int)m.light_shape[1], nz = (int)m.light_shape[0];
    x = clamp(x * scale + (float)m.light_offset[0], 0.f, (float)(nx - 1));
    y = clamp(y * scale + (float)m.light_offset[1], 0.f, (float)(ny - 1));
    z = clamp(z * scale + (float)m.light_offset[2], 0.f, (float)(nz - 1));
    const int i = min((int)x, max(nx - 2, 0)), j = min((int)y, max(ny - 2, 0));
    const int h = min((int)z, max(nz - 2, 0));
    const int sx = nx > 1 ? 2 : 0, sy = ny > 1 ? 2 * nx : 0, sz = nz > 1 ? 2 * nx * ny : 0;
    const int q = 2 * ((h * ny + j) * nx + i);
    return mixed(m.light, q + which, sx, sy, sz, x - i, y - j, z - h);
}

// Phong's model, two-sided, with the vector halfway between light and eye (Blinn).

// 1 / length of a gradient. Where that vanishes, both kinds of light fade, so that noise has no
// direction.
FHASH_INLINE float inverse_length(const Phong& phong, float x, float y, float z) {
    return 1 / sqrtf(x * x + y * y + z * z + phong.floor);
}
// The light that is scattered of that from the lamp. towards: the gradient times the direction
// towards the light. inverse: of its length.
FHASH_INLINE float scattered(const Phong& phong, float towards, float inverse) {
    return phong.diffuse * min(fabsf(towards) * inverse, 1.f);
}
// The light that is mirrored. halfway: the gradient times the direction halfway to the eye.
FHASH_INLINE float mirrored(const Phong& phong, float halfway, float inverse) {
    const float at =
        clamp((1 - fabsf(halfway) * inverse) * phong.steep, 0.f, 1.f) * FHASH_POWERS;
    const int n = (int)at;
    const float low = phong.powers[n], high = phong.powers[n + 1];
    return phong.specular * (low + (at - (float)n) * (high - low));
}

}  // namespace
