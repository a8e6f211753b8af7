// Ray marching on a CPU: packets of 4 x 4 rays through a dense lattice of values.
//
// Sample k of a ray lies (k + 0.5) steps, or k steps and a share of its own, behind the place where the ray enters the drawn box; the last
// step is as long as what is left, so that the path through the box is exactly its length. Values are trilinear in a cell, the gradient is
// that of the cell, exact and nearly free. A cell with a vertex without a value (NaN) is not seen.
//
// Compositing is front to back. Within BLOCK samples opacity (not transparency: 1 - 1e-9 is 1 in float32) is summed in float32; blocks
// are joined in float64, so that thin fog does not vanish in rounding. Built for speed, not for the same bits everywhere: pictures agree
// with those of fhash_codec/render/portable_march.py within rounding.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-pre")  // which makes branches of the loops below, and those are not vectorised
#endif
#include "march.hpp"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define FHASH_AVX512 __attribute__((target("arch=x86-64-v4,tune=icelake-server,prefer-vector-width=512")))
#pragma GCC diagnostic ignored "-Wuninitialized"  // by the header of GCC 12 itself
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>
#endif

namespace {

using std::int32_t;
using std::int64_t;

// By value and always inlined: the standard ones are neither vectorised nor, between functions for different machines, inlined.
template <class T> FHASH_INLINE T min(T a, T b) { return b < a ? b : a; }
template <class T> FHASH_INLINE T max(T a, T b) { return a < b ? b : a; }
// What is not a number becomes the lower end.
template <class T> FHASH_INLINE T clamp(T x, T low, T high) { const T some = x > low ? x : low; return some < high ? some : high; }

constexpr int N = 16, SIDE = 4, TILE = 16, BLOCK = 32;
constexpr int SHADED = 1, LIT = 2, MAXIMUM = 4, WIDE = 8;  // WIDE: sampled by AVX-512, in frames of two columns or more
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
    double red[N], green[N], blue[N], clear[N], rest[N], begin[N], entered[N], leaving[N], from[N];
    double o[3][N], d[3][N], normal[3][N];

    const bool whole;  // whether the frame has values of all that is drawn

    explicit Packet(const FhashMarch& given) : m(given), phong(given), whole(std::equal(&m.box[0][0], &m.box[0][0] + 6, &m.seen[0][0])) {}

    FHASH_INLINE void aim(int l, double across, double down, int64_t number);
    void cross(int l, double to, double now, Counters& counted);
    void see(int l, double sample, const FhashCell* cell, Counters& counted);
    void shorten();
    void mend();
    void surfaces(Counters& counted);
    void finish(Counters& counted);
    FHASH_INLINE int skip(Counters& counted);
    FHASH_INLINE void sample(Counters& counted, int& seen, int& ending, int& lost);
    FHASH_INLINE void composite(Counters& counted);
    FHASH_INLINE void march(Counters& counted);
    FhashCell cell(int l, double sample) const {
        return fhash_cell_at(m, o[0][l] + sample * d[0][l], o[1][l] + sample * d[1][l], o[2][l] + sample * d[2][l]);
    }
    FHASH_INLINE void flush(int l) {
        red[l] += clear[l] * r[l];
        green[l] += clear[l] * g[l];
        blue[l] += clear[l] * b[l];
        clear[l] *= 1 - (double)a[l];
        left[l] = (float)clear[l];
        r[l] = g[l] = b[l] = a[l] = 0;
    }
};

// Where a ray is within a box. An axis along which it does not move needs no division: it is inside or not.
FHASH_INLINE bool slab(const double (&box)[3][2], const double* eye, const double* direction, double& enter, double& leave) {
    enter = 0;
    leave = ENDLESS;
    for (int c = 0; c < 3; c++) {
        if (direction[c] == 0) {
            if (!(eye[c] >= box[c][0] && eye[c] <= box[c][1])) return false;
            continue;
        }
        const double one = (box[c][0] - eye[c]) / direction[c], other = (box[c][1] - eye[c]) / direction[c];
        enter = max(enter, min(one, other));
        leave = min(leave, max(one, other));
    }
    return leave > enter;
}

// The ray through a place of the picture: where it enters, how many steps it takes.
template <int WANTED> FHASH_INLINE void Packet<WANTED>::aim(int l, double across, double down, int64_t number) {
    const double u = 2 * across / m.width - 1, w = 1 - 2 * down / m.height;
    double eye[3], direction[3], length = 0;
    for (int c = 0; c < 3; c++) {
        const double side = u * m.right[c] + w * m.up[c];
        eye[c] = m.eye[c] + (m.parallel ? side : 0);
        direction[c] = m.forward[c] + (m.parallel ? 0 : side);
        length += direction[c] * m.spacing[c] * direction[c] * m.spacing[c];
    }
    length = std::sqrt(length);
    for (int c = 0; c < 3; c++) direction[c] /= length;
    double enter = 0, leave = 0, first = 0, stop = ENDLESS;
    const bool hit = slab(m.box, eye, direction, enter, leave) && (whole || slab(m.seen, eye, direction, first, stop));
    const double steps = hit ? (leave - enter) / m.step : 0, share = m.jitter ? random_share((uint32_t)number) : 0.5;
    const double most = min(std::ceil(steps), 2147483000.0);
    last[l] = (int)most - 1;
    rest[l] = steps - (most - 1);
    // Of those of the box the samples that the frame has values of.
    k[l] = hit && first > enter ? (int)min(max(std::ceil((first - enter) / m.step - share), 0.0), most) : 0;
    count[l] = hit && stop < leave ? (int)min(max(std::floor((stop - enter) / m.step - share) + 1, 0.0), most) : (int)most;
    if (!hit) count[l] = 0;
    entered[l] = hit ? (max(first, enter) - enter) / m.step - share : 0;
    leaving[l] = hit ? (min(stop, leave) - enter) / m.step - share : 0;
    from[l] = entered[l];
    begin[l] = enter + share * m.step;
    clear[l] = 1;
    red[l] = green[l] = blue[l] = 0;
    r[l] = g[l] = b[l] = a[l] = 0;
    left[l] = 1;
    depth[l] = FAR;
    best[l] = -FAR;
    where[l] = 0;
    for (int c = 0; c < 3; c++) {
        o[c][l] = hit ? eye[c] + begin[l] * direction[c] : 0;
        d[c][l] = hit ? direction[c] * m.step : 0;
        normal[c][l] = 0;
    }
    ox[l] = (float)o[0][l]; oy[l] = (float)o[1][l]; oz[l] = (float)o[2][l];
    dx[l] = (float)d[0][l]; dy[l] = (float)d[1][l]; dz[l] = (float)d[2][l];
    // An axis along which a ray does not move, or hardly, never ends a brick.
    ix[l] = fabsf(dx[l]) < 1e-9f ? 0.f : 1 / dx[l]; iy[l] = fabsf(dy[l]) < 1e-9f ? 0.f : 1 / dy[l];
    iz[l] = fabsf(dz[l]) < 1e-9f ? 0.f : 1 / dz[l];
    farx[l] = ix[l] == 0 ? 1e9f : 0.f; fary[l] = iy[l] == 0 ? 1e9f : 0.f; farz[l] = iz[l] == 0 ? 1e9f : 0.f;
    upx[l] = dx[l] > 0; upy[l] = dy[l] > 0; upz[l] = dz[l] > 0;
    previous[l] = NONE;
    double towards[3], half[3], size = 0;
    const bool own = m.lamp[0] == 0 && m.lamp[1] == 0 && m.lamp[2] == 0;
    for (int c = 0; c < 3; c++) {
        const double back = -direction[c] * m.spacing[c];  // of unit length already
        towards[c] = own ? back : m.lamp[c];
        half[c] = back + towards[c];
        size += half[c] * half[c];
    }
    size = size > 1e-12 ? 1 / std::sqrt(size) : 0;  // light from straight behind has no highlight
    tox[l] = (float)towards[0]; toy[l] = (float)towards[1]; toz[l] = (float)towards[2];
    hx[l] = (float)(half[0] * size); hy[l] = (float)(half[1] * size); hz[l] = (float)(half[2] * size);
}

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

// The depth and normal of what is seen: where less than half of the light is left for the first time.
template <int WANTED> void Packet<WANTED>::see(int l, double sample, const FhashCell* given, Counters& counted) {
    if (depth[l] < FAR) return;
    depth[l] = (float)(begin[l] + sample * m.step);
    if (!m.normal) return;
    const FhashCell found = given ? *given : cell(l, sample);
    counted.gradients += !given;
    const double x = found.gx / m.spacing[0], y = found.gy / m.spacing[1], z = found.gz / m.spacing[2];
    double size = std::sqrt(x * x + y * y + z * z);
    if (!(size > 0) || !(size < std::numeric_limits<double>::infinity())) return;
    if (x * d[0][l] * m.spacing[0] + y * d[1][l] * m.spacing[1] + z * d[2][l] * m.spacing[2] > 0) size = -size;  // towards the eye
    normal[0][l] = x / size;
    normal[1][l] = y / size;
    normal[2][l] = z / size;
}

// The surfaces between `from` with the value `previous` and `to` with `now`, in the order in which the ray meets them.
template <int WANTED> void Packet<WANTED>::cross(int l, double to, double now, Counters& counted) {
    const double before = previous[l];
    if (!(before == before) || !(now == now)) return;
    struct Root {
        double at;
        int64_t which;
    } roots[FHASH_SURFACES];
    int found = 0;
    for (int64_t s = 0; s < m.surfaces; s++) {
        const double level = m.surface[s][0];
        if ((before < level) == (now < level)) continue;
        // Regula falsi by Illinois, until the root is within 1e-7 of a step or the value as near as rounding lets it be.
        double low = from[l], high = to, f_low = before - level, f_high = now - level, place = f_high == 0 ? high : low;
        for (int turn = 0; turn < 60 && f_low != 0 && f_high != 0 && fabs(high - low) > 1e-7; turn++) {
            place = high - f_high * (high - low) / (f_high - f_low);
            const double f = cell(l, place).value - level;
            counted.samples++;
            if (!(f == f)) break;
            if (f == 0) break;
            if ((f < 0) == (f_high < 0)) f_low *= 0.5;
            else low = high, f_low = f_high;
            if (fabs(place - high) < 1e-9) break;
            high = place;
            f_high = f;
        }
        if (cell(l, place).value == cell(l, place).value) roots[found++] = {place, s};
    }
    std::sort(roots, roots + found, [](const Root& one, const Root& other) { return one.at < other.at; });
    for (int n = 0; n < found; n++) {
        const FhashCell here = cell(l, roots[n].at);
        const double* surface = m.surface[roots[n].which];
        float lamp = 1, around = 1;
        if (m.light) {
            const double at = roots[n].at;
            const float px = (float)(o[0][l] + at * d[0][l]), py = (float)(o[1][l] + at * d[1][l]), pz = (float)(o[2][l] + at * d[2][l]);
            lamp = light_at(m, 0, px, py, pz);
            around = light_at(m, 1, px, py, pz);
        }
        const bool known = here.gx == here.gx && here.gy == here.gy && here.gz == here.gz;
        const float x = known ? (float)(here.gx * m.gradient[0]) : 0.f, y = known ? (float)(here.gy * m.gradient[1]) : 0.f;
        const float z = known ? (float)(here.gz * m.gradient[2]) : 0.f;
        const float one = size_of(phong, x, y, z);
        const float factor = phong.ambient * around + lamp * scattered(phong, x * tox[l] + y * toy[l] + z * toz[l], one);
        const float shine = lamp * mirrored(phong, x * hx[l] + y * hy[l] + z * hz[l], one);
        counted.gradients++;
        const float w = (1 - a[l]) * (float)surface[4];
        a[l] += w;
        r[l] += w * ((float)surface[1] * factor + shine);
        g[l] += w * ((float)surface[2] * factor + shine);
        b[l] += w * ((float)surface[3] * factor + shine);
        if (m.depth && clear[l] * (1 - (double)a[l]) < 0.5) see(l, roots[n].at, &here, counted);
    }
}

// The opacity of last steps, which are as long as what is left of the path.
template <int WANTED> void Packet<WANTED>::shorten() {
    for (int l = 0; l < N; l++) {
        if (!on[l] || k[l] != last[l] || !(alpha[l] > 0)) continue;
        const int t = (int)at[l];
        const double* extinction = m.extinction + t;
        alpha[l] = (float)(alpha[l] < 0.01 ? opacity_of_share(alpha[l], rest[l])
                                           : -std::expm1(-rest[l] * (extinction[0] + (at[l] - t) * (extinction[1] - extinction[0]))));
    }
}

// Samples that lie on faces of cells, where vertices without a value may have no weight.
template <int WANTED> void Packet<WANTED>::mend() {
    for (int l = 0; l < N; l++) {
        if (!on[l] || value[l] == value[l]) continue;
        const FhashCell here = fhash_cell_at(m, px[l], py[l], pz[l]);
        if (!(here.value == here.value)) continue;
        value[l] = (float)here.value;
        at[l] = (float)clamp((here.value - m.low) * m.scale, 0.0, (double)(m.entries - 1));
        const int t = (int)at[l];
        const float* const entry = m.table + 4 * t;
        const float share = at[l] - t;
        alpha[l] = entry[3] + share * (entry[7] - entry[3]);
        cr[l] = entry[0] + share * (entry[4] - entry[0]);
        cg[l] = entry[1] + share * (entry[5] - entry[1]);
        cb[l] = entry[2] + share * (entry[6] - entry[2]);
        const bool known = here.gx == here.gx && here.gy == here.gy && here.gz == here.gz;
        gx[l] = known ? (float)(here.gx * m.gradient[0]) : 0.f;
        gy[l] = known ? (float)(here.gy * m.gradient[1]) : 0.f;
        gz[l] = known ? (float)(here.gz * m.gradient[2]) : 0.f;
    }
}

// Surfaces up to the samples of this pass, and behind the last ones.
template <int WANTED> void Packet<WANTED>::surfaces(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (!on[l]) continue;
        if (!(previous[l] == previous[l])) {  // the first, or the first after a gap: from the entry, or the sample before it
            from[l] = max(k[l] - 1.0, entered[l]);
            previous[l] = (float)cell(l, from[l]).value;
            counted.samples++;
        }
        const bool beyond = k[l] >= leaving[l];
        if (beyond) {
            cross(l, leaving[l], cell(l, leaving[l]).value, counted);
            previous[l] = NONE;
            continue;
        }
        cross(l, k[l], value[l], counted);
        previous[l] = value[l];
        from[l] = k[l];
    }
}

// What lies between last samples and the end of the path.
template <int WANTED> void Packet<WANTED>::finish(Counters& counted) {
    for (int l = 0; l < N; l++)
        if (on[l] && k[l] + 1 == count[l] && leaving[l] > k[l]) {
            counted.samples++;
            cross(l, leaving[l], cell(l, leaving[l]).value, counted);
        }
}

// Over bricks that do not matter; which rays have a sample to take here (1), or are alive at all (2).
template <int WANTED> FHASH_INLINE int Packet<WANTED>::skip(Counters& counted) {
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1], lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const float mx = (float)(lx - 1), my = (float)(ly - 1), mz = (float)(lz - 1), side = (float)m.brick, part = 1 / side;
    const int cx = max(lx - 2, 0), cy = max(ly - 2, 0), cz = max(lz - 2, 0), keeping = m.surfaces > 0;
    const int32_t* const distance = m.distance;
    const float* const highest = m.highest;
    int here = 0, alive = 0, skipped = 0, any = 0;
    // Most passes skip nothing: then no more is worked out, and what follows does not wait for the bricks.
    #pragma omp simd reduction(| : any, here)
    for (int l = 0; l < N; l++) {
        const float f = (float)k[l];
        const int going = k[l] < count[l];
        const float x = clamp(ox[l] + f * dx[l], 0.f, mx), y = clamp(oy[l] + f * dy[l], 0.f, my), z = clamp(oz[l] + f * dz[l], 0.f, mz);
        const int jx = (int)((float)min((int)x, cx) * part), jy = (int)((float)min((int)y, cy) * part);
        const int jz = (int)((float)min((int)z, cz) * part), q = (jz * by + jy) * bx + jx;
        const int away = WANTED & MAXIMUM ? !(highest[q] > best[l]) : distance[q] > 0;
        any |= going & away & !(keeping & (previous[l] == previous[l]));
        on[l] = going;
        here |= going;
    }
    if (!any) return here ? 3 : 0;
    here = 0;
    #pragma omp simd reduction(| : here, alive) reduction(+ : skipped)
    for (int l = 0; l < N; l++) {
        const float f = (float)k[l];
        const int going = k[l] < count[l];
        const float x = clamp(ox[l] + f * dx[l], 0.f, mx), y = clamp(oy[l] + f * dy[l], 0.f, my), z = clamp(oz[l] + f * dz[l], 0.f, mz);
        const int jx = (int)((float)min((int)x, cx) * part), jy = (int)((float)min((int)y, cy) * part);
        const int jz = (int)((float)min((int)z, cz) * part), q = (jz * by + jy) * bx + jx;
        int away, w = 0;
        if (WANTED & MAXIMUM) away = highest[q] > best[l] ? 0 : 1;
        else away = distance[q], w = away - 1;
        const float tx = ((float)(jx - w + upx[l] * (1 + 2 * w)) * side - ox[l]) * ix[l] + farx[l];
        const float ty = ((float)(jy - w + upy[l] * (1 + 2 * w)) * side - oy[l]) * iy[l] + fary[l];
        const float tz = ((float)(jz - w + upz[l] * (1 + 2 * w)) * side - oz[l]) * iz[l] + farz[l];
        // Rather a sample short of the brick's end than one beyond it.
        const float leave = min(min(min(tx, ty), tz), 1e9f) * (1 - 2e-6f);
        const int next = min(max((int)leave + 1, k[l] + 1), count[l]);
        const int over = going & (away > 0) & !(keeping & (previous[l] == previous[l]));
        k[l] = over ? next : k[l];
        on[l] = going & !over;
        skipped += over;
        alive |= k[l] < count[l];
        here |= on[l];
    }
    counted.skips += skipped;
    return (here ? 1 : 0) | (alive ? 2 : 0);
}

// Values, entries of the table and opacities of the samples, and the gradients if they are shaded.
template <int WANTED> FHASH_INLINE void Packet<WANTED>::sample(Counters& counted, int& seen, int& ending, int& lost) {
    const float* const v = m.values;
    const float* const table = m.table;
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const float mx = (float)(lx - 1), my = (float)(ly - 1), mz = (float)(lz - 1), top = (float)(m.entries - 1);
    const int cx = max(lx - 2, 0), cy = max(ly - 2, 0), cz = max(lz - 2, 0);
    const int sx = lx > 1, sy = ly > 1 ? lx : 0, sz = lz > 1 ? lx * ly : 0;
    const float low = (float)m.low, scale = (float)m.scale, wx = (float)m.gradient[0], wy = (float)m.gradient[1], wz = (float)m.gradient[2];
    int samples = 0, some = 0, end = 0, none = 0;
    #pragma omp simd reduction(+ : samples) reduction(| : some, end, none)
    for (int l = 0; l < N; l++) {
        const float f = (float)k[l];
        const float x = clamp(ox[l] + f * dx[l], 0.f, mx), y = clamp(oy[l] + f * dy[l], 0.f, my), z = clamp(oz[l] + f * dz[l], 0.f, mz);
        const int i = min((int)x, cx), j = min((int)y, cy), h = min((int)z, cz);
        const float fx = x - i, fy = y - j, fz = z - h;
        const int q = (h * ly + j) * lx + i;
        const float a0 = v[q], a1 = v[q + sx], a2 = v[q + sy], a3 = v[q + sy + sx];
        const float b0 = v[q + sz], b1 = v[q + sz + sx], b2 = v[q + sz + sy], b3 = v[q + sz + sy + sx];
        const float d0 = a1 - a0, d1 = a3 - a2, d2 = b1 - b0, d3 = b3 - b2;
        const float p0 = a0 + fx * d0, p1 = a2 + fx * d1, p2 = b0 + fx * d2, p3 = b2 + fx * d3;
        const float s0 = p0 + fy * (p1 - p0), s1 = p2 + fy * (p3 - p2), found = s0 + fz * (s1 - s0);
        const int known = found == found;
        value[l] = found;
        if (WANTED & MAXIMUM) {
            const int better = on[l] & (found > best[l]);
            best[l] = better ? found : best[l];
            where[l] = better ? k[l] : where[l];
        } else {
            const float e = clamp((found - low) * scale, 0.f, top);  // NaN becomes an entry, whose opacity is not taken
            const int t = (int)e;
            const float one = table[4 * t + 3], other = table[4 * t + 7], opacity = one + (e - t) * (other - one);
            at[l] = e;
            const float taken = opacity * (float)(on[l] & known);
            alpha[l] = taken;
            some |= taken > 0;
        }
        if (WANTED & SHADED) {
            const float e0 = d0 + fy * (d1 - d0), e1 = d2 + fy * (d3 - d2);
            const float ex = (e0 + fz * (e1 - e0)) * wx, ey = ((p1 - p0) + fz * ((p3 - p2) - (p1 - p0))) * wy, ez = (s1 - s0) * wz;
            gx[l] = known ? ex : 0.f;  // 0 times what a cell without values shades as would not be 0
            gy[l] = known ? ey : 0.f;
            gz[l] = known ? ez : 0.f;
        }
        px[l] = x; py[l] = y; pz[l] = z;
        samples += on[l];
        none |= on[l] & !known;
        end |= on[l] & (k[l] == last[l]);
    }
    counted.samples += samples;
    seen = some;
    ending = end;
    lost = none;
}

#if defined(FHASH_AVX512)
// a + share * (b - a)
FHASH_AVX512 inline __attribute__((always_inline)) __m512 between(__m512 a, __m512 b, __m512 share) {
    return _mm512_fmadd_ps(share, _mm512_sub_ps(b, a), a);
}

// A place along an axis, clamped to 0..most; what is not a number becomes 0.
FHASH_AVX512 inline __attribute__((always_inline)) __m512 place(const float* origin, const float* step, __m512 sample, __m512 most) {
    const __m512 at = _mm512_add_ps(_mm512_load_ps(origin), _mm512_mul_ps(sample, _mm512_load_ps(step)));
    return _mm512_min_ps(_mm512_max_ps(at, _mm512_setzero_ps()), most);
}

// The values of 16 vertices and of those behind them along x. A load for both: gathering counts loads, not bytes.
FHASH_AVX512 inline __attribute__((always_inline)) void pairs(const float* v, __m512i q, __m512& first, __m512& second) {
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(q), v, 4));
    const __m512 high = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(q, 1), v, 4));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    first = _mm512_permutex2var_ps(low, even, high);
    second = _mm512_permutex2var_ps(low, _mm512_add_epi32(even, _mm512_set1_epi32(1)), high);
}

// The entries of 16 lanes, four floats each, as four vectors.
FHASH_AVX512 inline __attribute__((always_inline)) void entries(const float* table, const int* t, __m512 (&out)[4]) {
    __m512 row[4];
    for (int n = 0; n < 4; n++) {
        row[n] = _mm512_castps128_ps512(_mm_loadu_ps(table + t[n]));
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 4]), 1);
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 8]), 2);
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 12]), 3);
    }
    const __m512 a = _mm512_unpacklo_ps(row[0], row[1]), b = _mm512_unpacklo_ps(row[2], row[3]);
    const __m512 c = _mm512_unpackhi_ps(row[0], row[1]), d = _mm512_unpackhi_ps(row[2], row[3]);
    out[0] = _mm512_shuffle_ps(a, b, 0x44);
    out[1] = _mm512_shuffle_ps(a, b, 0xee);
    out[2] = _mm512_shuffle_ps(c, d, 0x44);
    out[3] = _mm512_shuffle_ps(c, d, 0xee);
}

// As `sample`, and the colours.
template <int WANTED> FHASH_AVX512 __attribute__((noinline))
void sample_wide(Packet<WANTED>& p, Counters& counted, int& seen, int& ending, int& lost) {
    const FhashMarch& m = p.m;
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const int sy = ly > 1 ? lx : 0, sz = lz > 1 ? lx * ly : 0;
    const __m512 zero = _mm512_setzero_ps();
    const __m512i k = _mm512_load_si512(p.k);
    const __mmask16 on = _mm512_test_epi32_mask(_mm512_load_si512(p.on), _mm512_load_si512(p.on));
    const __m512 f = _mm512_cvtepi32_ps(k);
    const __m512 x = place(p.ox, p.dx, f, _mm512_set1_ps((float)(lx - 1))), y = place(p.oy, p.dy, f, _mm512_set1_ps((float)(ly - 1)));
    const __m512 z = place(p.oz, p.dz, f, _mm512_set1_ps((float)(lz - 1)));
    const __m512i i = _mm512_min_epi32(_mm512_cvttps_epi32(x), _mm512_set1_epi32(lx - 2));
    const __m512i j = _mm512_min_epi32(_mm512_cvttps_epi32(y), _mm512_set1_epi32(max(ly - 2, 0)));
    const __m512i h = _mm512_min_epi32(_mm512_cvttps_epi32(z), _mm512_set1_epi32(max(lz - 2, 0)));
    const __m512 fx = _mm512_sub_ps(x, _mm512_cvtepi32_ps(i)), fy = _mm512_sub_ps(y, _mm512_cvtepi32_ps(j));
    const __m512 fz = _mm512_sub_ps(z, _mm512_cvtepi32_ps(h));
    const __m512i row = _mm512_add_epi32(_mm512_mullo_epi32(h, _mm512_set1_epi32(ly)), j);
    const __m512i q = _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(lx)), i);
    __m512 a0, a1, a2, a3, b0, b1, b2, b3;
    pairs(m.values, q, a0, a1);
    pairs(m.values + sy, q, a2, a3);
    pairs(m.values + sz, q, b0, b1);
    pairs(m.values + sz + sy, q, b2, b3);
    const __m512 d0 = _mm512_sub_ps(a1, a0), d1 = _mm512_sub_ps(a3, a2), d2 = _mm512_sub_ps(b1, b0), d3 = _mm512_sub_ps(b3, b2);
    const __m512 p0 = _mm512_fmadd_ps(fx, d0, a0), p1 = _mm512_fmadd_ps(fx, d1, a2);
    const __m512 p2 = _mm512_fmadd_ps(fx, d2, b0), p3 = _mm512_fmadd_ps(fx, d3, b2);
    const __m512 s0 = between(p0, p1, fy), s1 = between(p2, p3, fy), found = between(s0, s1, fz);
    const __mmask16 known = _mm512_cmp_ps_mask(found, found, _CMP_ORD_Q);
    _mm512_store_ps(p.value, found);
    if (WANTED & MAXIMUM) {
        const __mmask16 better = on & _mm512_cmp_ps_mask(found, _mm512_load_ps(p.best), _CMP_GT_OQ);
        _mm512_mask_store_ps(p.best, better, found);
        _mm512_mask_store_epi32(p.where, better, k);
    } else {
        __m512 e = _mm512_mul_ps(_mm512_sub_ps(found, _mm512_set1_ps((float)m.low)), _mm512_set1_ps((float)m.scale));
        e = _mm512_min_ps(_mm512_max_ps(e, zero), _mm512_set1_ps((float)(m.entries - 1)));
        const __m512i t = _mm512_cvttps_epi32(e);
        const __m512 share = _mm512_sub_ps(e, _mm512_cvtepi32_ps(t));
        alignas(64) int places[N];
        _mm512_store_si512(places, _mm512_slli_epi32(t, 2));
        __m512 one[4], other[4];
        entries(m.table, places, one);
        entries(m.table + 4, places, other);
        const __m512 alpha = _mm512_maskz_mov_ps(on & known, between(one[3], other[3], share));
        _mm512_store_ps(p.at, e);
        _mm512_store_ps(p.alpha, alpha);
        _mm512_store_ps(p.cr, between(one[0], other[0], share));
        _mm512_store_ps(p.cg, between(one[1], other[1], share));
        _mm512_store_ps(p.cb, between(one[2], other[2], share));
        seen = _mm512_cmp_ps_mask(alpha, zero, _CMP_GT_OQ) != 0;
    }
    if (WANTED & SHADED) {
        const __m512 e0 = between(d0, d1, fy), e1 = between(d2, d3, fy);
        const __m512 ey = between(_mm512_sub_ps(p1, p0), _mm512_sub_ps(p3, p2), fz);
        _mm512_store_ps(p.gx, _mm512_maskz_mul_ps(known, between(e0, e1, fz), _mm512_set1_ps((float)m.gradient[0])));
        _mm512_store_ps(p.gy, _mm512_maskz_mul_ps(known, ey, _mm512_set1_ps((float)m.gradient[1])));
        _mm512_store_ps(p.gz, _mm512_maskz_mul_ps(known, _mm512_sub_ps(s1, s0), _mm512_set1_ps((float)m.gradient[2])));
    }
    _mm512_store_ps(p.px, x);
    _mm512_store_ps(p.py, y);
    _mm512_store_ps(p.pz, z);
    counted.samples += __builtin_popcount(on);
    lost = (on & ~known) != 0;
    ending = (on & _mm512_cmpeq_epi32_mask(k, _mm512_load_si512(p.last))) != 0;
}
#endif

template <int WANTED> FHASH_INLINE void Packet<WANTED>::composite(Counters& counted) {
    const float* const table = m.table;
    int gradients = 0;
    #pragma omp simd reduction(+ : gradients)
    for (int l = 0; l < N; l++) {
        float red, green, blue;
        if (WANTED & WIDE) {
            red = cr[l]; green = cg[l]; blue = cb[l];
        } else {
            const int t = 4 * (int)at[l];
            const float share = at[l] - (int)at[l];
            red = table[t] + share * (table[t + 4] - table[t]);
            green = table[t + 1] + share * (table[t + 5] - table[t + 1]);
            blue = table[t + 2] + share * (table[t + 6] - table[t + 2]);
        }
        float lamp = 1, around = 1;
        if (WANTED & LIT) lamp = light_at(m, 0, px[l], py[l], pz[l]), around = light_at(m, 1, px[l], py[l], pz[l]);
        if (WANTED & SHADED) {
            const float x = gx[l], y = gy[l], z = gz[l], one = size_of(phong, x, y, z);
            const float factor = phong.ambient * around + lamp * scattered(phong, x * tox[l] + y * toy[l] + z * toz[l], one);
            const float shine = lamp * mirrored(phong, x * hx[l] + y * hy[l] + z * hz[l], one);
            red = red * factor + shine; green = green * factor + shine; blue = blue * factor + shine;
            gradients += alpha[l] > 0;
        } else if (WANTED & LIT) {
            const float factor = lamp * around;
            red *= factor; green *= factor; blue *= factor;
        }
        const float w = (1 - a[l]) * alpha[l];
        a[l] += w;
        r[l] += w * red;
        g[l] += w * green;
        b[l] += w * blue;
    }
    counted.gradients += gradients;
}

template <int WANTED> FHASH_INLINE void Packet<WANTED>::march(Counters& counted) {
    const bool skipping = WANTED & MAXIMUM ? m.highest != nullptr : m.distance != nullptr;
    const float stop = max((float)m.threshold, 1e-37f);
    for (int since = 0;;) {
        int here = 0;
        if (skipping) {
            const int state = skip(counted);
            if (!(state & 1)) {
                if (!state) break;
                continue;
            }
        } else {
            #pragma omp simd reduction(| : here)
            for (int l = 0; l < N; l++) {
                on[l] = k[l] < count[l];
                here |= on[l];
            }
            if (!here) break;
        }
        counted.passes++;
        int seen = 0, ending = 0, lost = 0;
#if defined(FHASH_AVX512)
        if constexpr (WANTED & WIDE) sample_wide(*this, counted, seen, ending, lost);
        else
#endif
            sample(counted, seen, ending, lost);
        if (WANTED & MAXIMUM) {
            if (lost)
                for (int l = 0; l < N; l++) {
                    const float found = on[l] && !(value[l] == value[l]) ? (float)fhash_cell_at(m, px[l], py[l], pz[l]).value : NONE;
                    if (found > best[l]) best[l] = found, where[l] = k[l];
                }
            #pragma omp simd
            for (int l = 0; l < N; l++) k[l] += on[l];
            continue;
        }
        if (lost) {
            mend();
            seen = 1;
        }
        if (ending && seen) shorten();
        if (m.surfaces > 0) surfaces(counted);
        if (seen) composite(counted);
        if (m.surfaces > 0) finish(counted);
        if (m.depth && (seen || m.surfaces > 0))
            for (int l = 0; l < N; l++)
                if (on[l] && clear[l] * (1 - (double)a[l]) < 0.5) see(l, k[l], nullptr, counted);
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] += on[l];
        if (++since == BLOCK) {
            since = 0;
            for (int l = 0; l < N; l++) flush(l);
        }
        // Branches, so that processors begin the next pass before this one's opacity is known.
        int ended = 0;
        #pragma omp simd reduction(| : ended)
        for (int l = 0; l < N; l++) ended |= (left[l] * (1 - a[l]) < stop) & (k[l] < count[l]);
        if (ended) {
            #pragma omp simd
            for (int l = 0; l < N; l++) k[l] = left[l] * (1 - a[l]) < stop ? count[l] : k[l];
        }
    }
    for (int l = 0; l < N; l++) {
        flush(l);
        if (!(WANTED & MAXIMUM) || !(best[l] > -FAR)) continue;
        const double e = clamp((best[l] - m.low) * m.scale, 0.0, (double)(m.entries - 1));
        const float* entry = m.table + 4 * (int)e;
        const double share = e - (int)e;
        red[l] = entry[0] + share * (entry[4] - entry[0]);
        green[l] = entry[1] + share * (entry[5] - entry[1]);
        blue[l] = entry[2] + share * (entry[6] - entry[2]);
        clear[l] = 0;
        if (m.depth) see(l, where[l], nullptr, counted);
    }
}

// Tiles of TILE x TILE pixels from first to stop, in rows.
template <int WANTED> FHASH_INLINE void tiles(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) {
    const int64_t across = (m.width + TILE - 1) / TILE, rays = m.rays;
    const double share = 1.0 / (double)(rays * rays);
    Packet<WANTED> packet(m);
    for (int64_t tile = first; tile < stop; tile++)
        for (int64_t y = tile / across * TILE; y < min(tile / across * TILE + TILE, m.height); y += SIDE)
            for (int64_t x = tile % across * TILE; x < min(tile % across * TILE + TILE, m.width); x += SIDE)
                for (int64_t ray = 0; ray < rays * rays; ray++) {
                    int met = 0;
                    for (int l = 0; l < N; l++) {
                        const int64_t i = min(x + l % SIDE, m.width - 1), j = min(y + l / SIDE, m.height - 1);
                        packet.aim(l, i + (ray % rays + 0.5) / rays, j + (ray / rays + 0.5) / rays, (j * m.width + i) * rays * rays + ray);
                        if (x + l % SIDE >= m.width || y + l / SIDE >= m.height) packet.count[l] = 0;
                        met += packet.count[l] > packet.k[l];
                    }
                    if (!met) continue;
                    counted.rays += met;
                    packet.march(counted);
                    for (int l = 0; l < N; l++) {
                        const int64_t i = x + l % SIDE, j = y + l / SIDE, at = j * m.width + i;
                        if (i >= m.width || j >= m.height) continue;
                        float* out = m.out + 4 * at;
                        out[0] += (float)(packet.red[l] * share);
                        out[1] += (float)(packet.green[l] * share);
                        out[2] += (float)(packet.blue[l] * share);
                        out[3] += (float)((1 - packet.clear[l]) * share);
                        if (!m.depth || !(packet.depth[l] < m.depth[at])) continue;
                        m.depth[at] = packet.depth[l];  // of several rays the nearest
                        if (!m.normal) continue;
                        for (int c = 0; c < 3; c++) m.normal[3 * at + c] = (float)packet.normal[c][l];
                    }
                }
}

// Not FHASH_CLONES: clones cannot be told that gathering from memory is quick on a machine that has all of AVX-512.
#if defined(FHASH_AVX512)
#define FHASH_KERNEL(NAME, WANTED)                                                                                                       \
    FHASH_AVX512 void NAME##_v4(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) {                                   \
        tiles<(WANTED) | WIDE>(m, first, stop, counted);                                                                                 \
    }                                                                                                                                    \
    __attribute__((target("arch=x86-64-v3,tune=haswell"))) void NAME##_v3(                                                               \
        const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) { tiles<WANTED>(m, first, stop, counted); }                \
    void NAME##_v1(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) { tiles<WANTED>(m, first, stop, counted); }      \
    void NAME(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) {                                                    \
        (__builtin_cpu_supports("x86-64-v4") && m.shape[2] > 1 ? NAME##_v4                                                               \
         : __builtin_cpu_supports("x86-64-v3")                 ? NAME##_v3                                                               \
                                                               : NAME##_v1)(m, first, stop, counted);                                    \
    }
#else
#define FHASH_KERNEL(NAME, WANTED) \
    FHASH_CLONES void NAME(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) { tiles<WANTED>(m, first, stop, counted); }
#endif
FHASH_KERNEL(plain, 0)
FHASH_KERNEL(shaded, SHADED)
FHASH_KERNEL(lit, LIT)
FHASH_KERNEL(shaded_lit, SHADED | LIT)
FHASH_KERNEL(maximum, MAXIMUM)
#undef FHASH_KERNEL

}  // namespace

// Add the rays of tiles first to stop (of 16 x 16 pixels, in rows) to the pictures of `march`, which begin as zeros (depth: infinity).
// wanted: 1 shading of the volume, 2 its light grid, 4 the maximum instead of it. counters: rays, passes, samples, gradients, skips, added to.
FHASH_EXPORT int64_t fhash_march(const FhashMarch* march, int64_t wanted, int64_t first, int64_t stop, int64_t* counters) {
    const FhashMarch& m = *march;
    if (m.surfaces < 0 || m.surfaces > FHASH_SURFACES || m.entries < 2 || m.rays < 1 || !(m.step > 0)) return -1;
    Counters counted;
    if (wanted & MAXIMUM) maximum(m, first, stop, counted);
    else if ((wanted & SHADED) && (wanted & LIT)) shaded_lit(m, first, stop, counted);
    else if (wanted & LIT) lit(m, first, stop, counted);
    else if (wanted & SHADED) shaded(m, first, stop, counted);
    else plain(m, first, stop, counted);
    counters[0] += counted.rays;
    counters[1] += counted.passes;
    counters[2] += counted.samples;
    counters[3] += counted.gradients;
    counters[4] += counted.skips;
    return 0;
}
