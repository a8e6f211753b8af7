// Ray marching on a CPU: packets of 4 x 4 rays through a dense lattice of values.
//
// Sample k of a ray lies (k + 0.5) steps, or k steps and a share of its own, behind the place where the ray enters the drawn box; the last
// step is as long as what is left, so that the path through the box is exactly its length. Values are trilinear in a cell, the gradient is
// that of the cell, exact and nearly free, or by central differences. A cell with a vertex without a value (NaN) is not seen.
//
// Compositing is front to back. Within BLOCK samples opacity (not transparency: 1 - 1e-9 is 1 in float32) is summed in float32; blocks
// are joined in float64, so that thin fog does not vanish in rounding. Built for speed, not for the same bits everywhere: pictures agree
// with those of fhash_codec/render/stream.py within rounding.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-pre")  // which makes branches of the loops below, and those are not vectorised
#endif
#include "march.hpp"
#include "march_packet.hpp"
#include "march_rays.hpp"
#include "march_sample.hpp"
#include "march_skip.hpp"
#include "march_surfaces.hpp"
#include "march_wide.hpp"

namespace {

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
    if (skipping && m.surfaces > 0) meet(counted);
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
        if (seen && (WANTED & CENTRAL)) slopes();
        if (seen) composite(counted);
        if (m.surfaces > 0) finish(counted);
        if (m.depth && (seen || m.surfaces > 0))
            for (int l = 0; l < N; l++)
                if (on[l] && clear[l] * (1 - (double)a[l]) < 0.5) see(l, k[l], nullptr, counted);
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] += on[l];
        if (++since == BLOCK) {
            since = 0;
            flush();
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
    flush();
    if (!(WANTED & MAXIMUM)) return;
    for (int l = 0; l < N; l++) {
        if (!(best[l] > -FAR)) continue;
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

// Add to the pictures, from this pixel on.
template <int WANTED> FHASH_INLINE void Packet<WANTED>::write(int64_t x, int64_t y) {
    const double share = 1.0 / (double)(m.rays * m.rays);
    alignas(64) float shares[N][4];
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        shares[l][0] = (float)(red[l] * share);
        shares[l][1] = (float)(green[l] * share);
        shares[l][2] = (float)(blue[l] * share);
        shares[l][3] = (float)((1 - clear[l]) * share);
    }
    const int64_t columns = min(m.width - x, (int64_t)SIDE), lines = min(m.height - y, (int64_t)SIDE);
    for (int64_t j = 0; j < lines; j++) {
        float* const out = m.out + 4 * ((y + j) * m.width + x);
        const float* const row = shares[j * SIDE];
        for (int64_t n = 0; n < 4 * columns; n++) out[n] += row[n];
    }
    if (!m.depth) return;
    for (int l = 0; l < N; l++) {
        const int64_t at = (y + l / SIDE) * m.width + x + l % SIDE;
        if (l % SIDE >= columns || l / SIDE >= lines || !(depth[l] < m.depth[at])) continue;
        m.depth[at] = depth[l];  // of several rays the nearest
        if (!m.normal) continue;
        for (int c = 0; c < 3; c++) m.normal[3 * at + c] = (float)normal[c][l];
    }
}

// Tiles of TILE x TILE pixels from first to stop, in rows.
template <int WANTED> FHASH_INLINE void tiles(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) {
    const int64_t across = (m.width + TILE - 1) / TILE, rays = m.rays;
    Packet<WANTED> packet(m);
    for (int64_t tile = first; tile < stop; tile++)
        for (int64_t y = tile / across * TILE; y < min(tile / across * TILE + TILE, m.height); y += SIDE)
            for (int64_t x = tile % across * TILE; x < min(tile % across * TILE + TILE, m.width); x += SIDE)
                for (int64_t ray = 0; ray < rays * rays; ray++) {
                    const int met = packet.aim(x, y, ray);
                    if (!met) continue;
                    counted.rays += met;
                    packet.march(counted);
                    packet.write(x, y);
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
        (m.path < 1 && __builtin_cpu_supports("x86-64-v4") && m.shape[2] > 1 ? NAME##_v4                                                 \
         : m.path < 2 && __builtin_cpu_supports("x86-64-v3")                 ? NAME##_v3                                                 \
                                                                             : NAME##_v1)(m, first, stop, counted);                      \
    }
#else
#define FHASH_KERNEL(NAME, WANTED) \
    FHASH_CLONES void NAME(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) { tiles<WANTED>(m, first, stop, counted); }
#endif
FHASH_KERNEL(plain, 0)
FHASH_KERNEL(shaded, SHADED)
FHASH_KERNEL(lit, LIT)
FHASH_KERNEL(shaded_lit, SHADED | LIT)
FHASH_KERNEL(central, SHADED | CENTRAL)
FHASH_KERNEL(central_lit, SHADED | CENTRAL | LIT)
FHASH_KERNEL(maximum, MAXIMUM)
#undef FHASH_KERNEL

}  // namespace

// Add the rays of tiles first to stop (of 16 x 16 pixels, in rows) to the pictures of `march`, which begin as zeros (depth: infinity).
// wanted: 1 shading of the volume, 2 its light grid, 4 the maximum instead of it. counters: rays, passes, samples, gradients, skips, added to.
FHASH_EXPORT int64_t fhash_march(const FhashMarch* march, int64_t wanted, int64_t first, int64_t stop, int64_t* counters) {
    const FhashMarch& m = *march;
    if (m.surfaces < 0 || m.surfaces > FHASH_SURFACES || m.entries < 2 || m.rays < 1 || !(m.step > 0)) return -1;
    if (m.cells && !m.distance) return -1;
    Counters counted;
    if (wanted & MAXIMUM) maximum(m, first, stop, counted);
    else if ((wanted & SHADED) && m.central && (wanted & LIT)) central_lit(m, first, stop, counted);
    else if ((wanted & SHADED) && m.central) central(m, first, stop, counted);
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
