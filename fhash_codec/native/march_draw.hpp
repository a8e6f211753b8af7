// What rays make of their samples, and the kernels that march tiles. Shared by march.cpp and
// march_effects.cpp.
#pragma once

#include "march.hpp"
#include "march_grading.hpp"
#include "march_network.hpp"
#include "march_packet.hpp"
#include "march_projections.hpp"
#include "march_rays.hpp"
#include "march_sample.hpp"
#include "march_skip.hpp"
#include "march_surfaces.hpp"
#include "march_wide.hpp"

// march_effects.cpp: `fhash_march` for the flags MINIMUM, AVERAGE, ATTENUATED and GRADED.
std::int64_t fhash_march_effect(const FhashMarch& march, std::int64_t flags, std::int64_t first,
                                std::int64_t stop, std::int64_t* counters);

namespace {

// Add the samples of a pass to the colours.
template <int FLAGS> FHASH_INLINE void Packet<FLAGS>::composite(Counters& counted) {
    const float* const table = m.table;
    int gradients = 0;
    #pragma omp simd reduction(+ : gradients)
    for (int l = 0; l < N; l++) {
        float red, green, blue;
        if (FLAGS & WIDE) {
            red = cr[l]; green = cg[l]; blue = cb[l];
        } else {
            const int t = 4 * (int)at[l];
            const float share = at[l] - (int)at[l];
            red = table[t] + share * (table[t + 4] - table[t]);
            green = table[t + 1] + share * (table[t + 5] - table[t + 1]);
            blue = table[t + 2] + share * (table[t + 6] - table[t + 2]);
        }
        float lamp = 1, around = 1;
        if (FLAGS & LIT) {
            lamp = light_at(m, 0, px[l], py[l], pz[l]);
            around = light_at(m, 1, px[l], py[l], pz[l]);
        }
        if (FLAGS & SHADED) {
            const float x = gx[l], y = gy[l], z = gz[l], inverse = inverse_length(phong, x, y, z);
            const float towards = x * tox[l] + y * toy[l] + z * toz[l];
            const float halfway = x * hx[l] + y * hy[l] + z * hz[l];
            float factor = phong.ambient * around + lamp * scattered(phong, towards, inverse);
            float shine = lamp * mirrored(phong, halfway, inverse);
            if (FLAGS & GRADED) {
                factor = phong.unlit ? lamp * around : factor;
                shine = phong.unlit ? 0.f : shine;
            }
            red = red * factor + shine;
            green = green * factor + shine;
            blue = blue * factor + shine;
            if (!(FLAGS & GRADED)) gradients += alpha[l] > 0;
        } else if (FLAGS & LIT) {
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

// Let every ray that is not at its end take part in the pass. Returns 3 if there is one, else 0.
template <int FLAGS> FHASH_INLINE int Packet<FLAGS>::alive() {
    int here = 0;
    #pragma omp simd reduction(| : here)
    for (int l = 0; l < N; l++) {
        on[l] = k[l] < count[l];
        here |= on[l];
    }
    return here ? 3 : 0;
}

// Draw the samples of a pass, and the surfaces before them.
template <int FLAGS> FHASH_INLINE void Packet<FLAGS>::show(Seen seen, Counters& counted) {
    if (seen.lost) {
        mend();
        seen.any = 1;
    }
    if (FLAGS & (AVERAGE | ATTENUATED)) {
        if (seen.any) project();
        return;
    }
    if (seen.ending && seen.any) shorten();
    if (m.surfaces > 0) surfaces(counted);
    const float* const lit = m.smooth ? m.smooth : m.values;
    if (seen.any && (FLAGS & GRADED)) {
        // Opacity by the gradients of the values themselves.
        if (m.central) slopes(m.values);
        grade(counted);
        if (m.smooth && !m.unlit) slopes(m.smooth);
    } else if (seen.any && (FLAGS & CENTRAL)) {
        slopes(lit);
    }
    if (seen.any) composite(counted);
    if (m.surfaces > 0) finish(counted);
    if (m.depth && (seen.any || m.surfaces > 0))
        for (int l = 0; l < N; l++)
            if (on[l] && clear[l] * (1 - (double)a[l]) < 0.5) see(l, k[l], nullptr, counted);
}

// End the rays behind which less than a share of the light is left. In two steps with a branch, so
// that processors begin the next pass before this one's opacity is known.
template <int FLAGS> FHASH_INLINE void Packet<FLAGS>::end_rays(float stop) {
    int ended = 0;
    #pragma omp simd reduction(| : ended)
    for (int l = 0; l < N; l++) ended |= (left[l] * (1 - a[l]) < stop) & (k[l] < count[l]);
    if (ended) {
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] = left[l] * (1 - a[l]) < stop ? count[l] : k[l];
    }
}

// March the rays of the packet to their ends, pass by pass.
template <int FLAGS> FHASH_INLINE void Packet<FLAGS>::march(Counters& counted) {
    const bool skipping = FLAGS & MAXIMUM ? m.highest != nullptr : m.distance != nullptr;
    const float stop = max((float)m.threshold, 1e-37f);
    if (skipping && m.surfaces > 0) meet(counted);
    for (int since = 0;;) {
        const int state = skipping ? skip(counted) : alive();
        if (!state) break;
        if (!(state & 1)) continue;
        counted.passes++;
        Seen seen;
        if (m.network) sample_network(counted, seen);
        else
#if defined(FHASH_AVX512)
        if constexpr (FLAGS & WIDE) sample_wide(*this, counted, seen);
        else
#endif
            sample(counted, seen);
        if (FLAGS & MAXIMUM) {
            if (seen.lost) keep_lost_maximum();
        } else {
            show(seen, counted);
        }
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] += on[l];
        if (FLAGS & MAXIMUM) continue;
        if (++since == BLOCK) {
            since = 0;
            flush();
        }
        if (FLAGS & ATTENUATED) end_attenuated();
        else if (!(FLAGS & AVERAGE)) end_rays(stop);
    }
    flush();
    if (FLAGS & PROJECTED) show_projection(counted);
}

// Add the rays to the pictures, from this pixel on.
template <int FLAGS> FHASH_INLINE void Packet<FLAGS>::write(int64_t x, int64_t y) {
    const double share = 1.0 / (double)(m.rays * m.rays);
    alignas(64) float shares[N][4];
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        shares[l][0] = (float)(red[l] * share);
        shares[l][1] = (float)(green[l] * share);
        shares[l][2] = (float)(blue[l] * share);
        shares[l][3] = (float)((1 - clear[l]) * share);
    }
    const int64_t columns = min(m.width - x, (int64_t)SIDE);
    const int64_t rows = min(m.height - y, (int64_t)SIDE);
    for (int64_t j = 0; j < rows; j++) {
        float* const out = m.out + 4 * ((y + j) * m.width + x);
        const float* const row = shares[j * SIDE];
        for (int64_t n = 0; n < 4 * columns; n++) out[n] += row[n];
    }
    if (!m.depth) return;
    for (int l = 0; l < N; l++) {
        const int64_t pixel = (y + l / SIDE) * m.width + x + l % SIDE;
        if (l % SIDE >= columns || l / SIDE >= rows || !(depth[l] < m.depth[pixel])) continue;
        m.depth[pixel] = depth[l];  // that of the nearest ray
        if (!m.normal) continue;
        for (int c = 0; c < 3; c++) m.normal[3 * pixel + c] = (float)normal[c][l];
    }
}

// March the packets of a tile.
template <int FLAGS>
FHASH_INLINE void march_tile(Packet<FLAGS>& packet, int64_t left, int64_t top, Counters& counted) {
    const FhashMarch& m = packet.m;
    for (int64_t y = top; y < min(top + TILE, m.height); y += SIDE)
        for (int64_t x = left; x < min(left + TILE, m.width); x += SIDE)
            for (int64_t ray = 0; ray < m.rays * m.rays; ray++) {
                const int met = packet.aim(x, y, ray);
                if (!met) continue;
                counted.rays += met;
                packet.march(counted);
                packet.write(x, y);
            }
}

// March the tiles from first to stop, in rows of the picture.
template <int FLAGS>
FHASH_INLINE void tiles(const FhashMarch& m, int64_t first, int64_t stop, Counters& counted) {
    const int64_t across = (m.width + TILE - 1) / TILE;
    Packet<FLAGS> packet(m);
    for (int64_t tile = first; tile < stop; tile++)
        march_tile(packet, tile % across * TILE, tile / across * TILE, counted);
}

// A function for each set of flags, compiled for several machines; m.path says which of them.
// FHASH_CLONES cannot be used: clones cannot be told that gathering from memory is quick on a
// machine that has all of AVX-512.
#define FHASH_PARAMETERS const FhashMarch &m, int64_t first, int64_t stop, Counters &counted
#if defined(FHASH_AVX512)
#define FHASH_KERNEL(NAME, FLAGS)                                                                  \
    FHASH_AVX512 void NAME##_v4(FHASH_PARAMETERS) {                                                \
        tiles<(FLAGS) | WIDE>(m, first, stop, counted);                                            \
    }                                                                                              \
    __attribute__((target("arch=x86-64-v3,tune=haswell"))) void NAME##_v3(FHASH_PARAMETERS) {      \
        tiles<FLAGS>(m, first, stop, counted);                                                     \
    }                                                                                              \
    void NAME##_v1(FHASH_PARAMETERS) { tiles<FLAGS>(m, first, stop, counted); }                    \
    void NAME(FHASH_PARAMETERS) {                                                                  \
        const unsigned has = fhash_instructions();                                                 \
        const bool v4 = m.path < 1 && (has & FHASH_HAS_V4) && m.shape[2] > 1;                      \
        const bool v3 = m.path < 2 && (has & FHASH_HAS_V3);                                        \
        (v4 ? NAME##_v4 : v3 ? NAME##_v3 : NAME##_v1)(m, first, stop, counted);                    \
    }
#else
#define FHASH_KERNEL(NAME, FLAGS) \
    FHASH_CLONES void NAME(FHASH_PARAMETERS) { tiles<FLAGS>(m, first, stop, counted); }
#endif

}  // namespace
