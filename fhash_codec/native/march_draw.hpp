// What rays make of their samples, and the march through tiles. Compiled once for each target:
// march.cpp, march_avx2.cpp, march_avx512.cpp.
#pragma once

#if defined(__GNUC__) && !defined(__clang__)
// It makes branches of loops over rays, and loops with branches are not vectorised.
#pragma GCC optimize("no-tree-pre")
#endif
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

namespace {

// Add the samples of a pass to the colours.
template <bool SHADED_TOO, bool LIT_TOO> void Packet::composite(Counters& counted) {
    [[maybe_unused]] const float* const table = m.table;
    int gradients = 0;
    #pragma omp simd reduction(+ : gradients)
    for (int l = 0; l < N; l++) {
        float red, green, blue;
#if defined(FHASH_WIDE)
        red = cr[l]; green = cg[l]; blue = cb[l];
#else
        const int t = 4 * (int)at[l];
        const float share = at[l] - (int)at[l];
        red = table[t] + share * (table[t + 4] - table[t]);
        green = table[t + 1] + share * (table[t + 5] - table[t + 1]);
        blue = table[t + 2] + share * (table[t + 6] - table[t + 2]);
#endif
        float lamp = 1, around = 1;
        if (LIT_TOO) {
            lamp = light_at(m, 0, px[l], py[l], pz[l]);
            around = light_at(m, 1, px[l], py[l], pz[l]);
        }
        if (SHADED_TOO) {
            const float x = gx[l], y = gy[l], z = gz[l], inverse = inverse_length(phong, x, y, z);
            const float towards = x * tox[l] + y * toy[l] + z * toz[l];
            const float halfway = x * hx[l] + y * hy[l] + z * hz[l];
            const float factor = phong.ambient * around + lamp * scattered(phong, towards, inverse);
            const float shine = lamp * mirrored(phong, halfway, inverse);
            red = red * factor + shine;
            green = green * factor + shine;
            blue = blue * factor + shine;
            gradients += alpha[l] > 0;
        } else if (LIT_TOO) {
            const float factor = lamp * around;
            red *= factor; green *= factor; blue *= factor;
        }
        const float w = (1 - a[l]) * alpha[l];
        a[l] += w;
        r[l] += w * red;
        g[l] += w * green;
        b[l] += w * blue;
    }
    if (!(flags & GRADED)) counted.gradients += gradients;  // `grade` has counted them
}

// Let every ray that is not at its end take part in the pass. Returns 3 if there is one, else 0.
FHASH_INLINE int Packet::alive() {
    int here = 0;
    #pragma omp simd reduction(| : here)
    for (int l = 0; l < N; l++) {
        on[l] = k[l] < count[l];
        here |= on[l];
    }
    return here ? 3 : 0;
}

// Take the samples of a pass.
FHASH_INLINE void Packet::take(Counters& counted, Seen& seen) {
    if (m.network) sample_network(counted, seen);
    else if (flags & MAXIMUM) sample<LARGEST>(counted, seen);
    else if (flags & SHADED) sample<GRADIENTS>(counted, seen);
    else sample<OPACITIES>(counted, seen);
}

// Draw the samples of a pass, and the surfaces before them.
FHASH_INLINE void Packet::show(Seen seen, Counters& counted) {
    if (seen.lost) {
        mend();
        seen.any = 1;
    }
    if (flags & (AVERAGE | ATTENUATED)) {
        if (seen.any) flags & AVERAGE ? average() : attenuate();
        return;
    }
    if (seen.ending && seen.any) shorten();
    if (m.surfaces > 0) surfaces(counted);
    const float* const lit = m.smooth ? m.smooth : m.values;
    if (seen.any && (flags & GRADED)) {
        // Opacity by the gradients of the values themselves.
        if (m.central) slopes(m.values);
        grade(counted);
        if (m.smooth && !m.unlit) slopes(m.smooth);
    } else if (seen.any && (flags & SHADED) && (m.central || m.smooth)) {
        slopes(lit);
    }
    if (!seen.any) {
    } else if ((flags & SHADED) && !m.unlit) {
        flags & LIT ? composite<true, true>(counted) : composite<true, false>(counted);
    } else {
        flags & LIT ? composite<false, true>(counted) : composite<false, false>(counted);
    }
    if (m.surfaces > 0) finish(counted);
    if (m.depth && (seen.any || m.surfaces > 0))
        for (int l = 0; l < N; l++)
            if (on[l] && clear[l] * (1 - (double)a[l]) < 0.5) see(l, k[l], nullptr, counted);
}

// End the rays behind which less than a share of the light is left. In two steps with a branch, so
// that processors begin the next pass before this one's opacity is known.
FHASH_INLINE void Packet::end_rays(float stop) {
    int ended = 0;
    #pragma omp simd reduction(| : ended)
    for (int l = 0; l < N; l++) ended |= (left[l] * (1 - a[l]) < stop) & (k[l] < count[l]);
    if (ended) {
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] = left[l] * (1 - a[l]) < stop ? count[l] : k[l];
    }
}

// March the rays of the packet to their ends, pass by pass.
FHASH_INLINE void Packet::march(Counters& counted) {
    const bool skipping = flags & MAXIMUM ? m.highest != nullptr : m.distance != nullptr;
    const float stop = max((float)m.threshold, 1e-37f);
    if (skipping && m.surfaces > 0) meet(counted);
    for (int since = 0;;) {
        int state = skipping ? skip(counted) : alive();
        while (m.ready && fetch()) state = skipping ? skip(counted) : alive();
        if (!of_any(state)) break;
        if (!of_any(state & 1)) continue;
        counted.passes++;
        Seen seen;
        take(counted, seen);
        if (flags & MAXIMUM) {
            if (seen.lost) keep_lost_maximum();
        } else {
            show(seen, counted);
        }
        #pragma omp simd
        for (int l = 0; l < N; l++) k[l] += on[l];
        if (flags & MAXIMUM) continue;
        if (++since == BLOCK) {
            since = 0;
            flush();
        }
        if (flags & ATTENUATED) end_attenuated();
        else if (!(flags & AVERAGE)) end_rays(stop);
    }
    flush();
    if (flags & PROJECTED) show_projection(counted);
}

// Add the rays to the pictures, from this pixel on.
FHASH_INLINE void Packet::write(int64_t x, int64_t y) {
    const double share = 1.0 / (double)(m.rays * m.rays);
    FHASH_LANES float shares[N][4];
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

}  // namespace

#if !defined(FHASH_CUDA)
// March the tiles from first to stop, in rows of the picture.
void FHASH_MARCH(const FhashInput& m, int flags, std::int64_t first, std::int64_t stop,
                 std::int64_t* counters) {
    const std::int64_t across = (m.width + TILE - 1) / TILE;
    Counters counted;
    Packet packet(m, flags);
    for (std::int64_t tile = first; tile < stop; tile++) {
        const std::int64_t left = tile % across * TILE, top = tile / across * TILE;
        for (std::int64_t y = top; y < min(top + TILE, m.height); y += SIDE)
            for (std::int64_t x = left; x < min(left + TILE, m.width); x += SIDE)
                for (std::int64_t ray = 0; ray < m.rays * m.rays; ray++) {
                    const int met = packet.aim(x, y, ray);
                    if (!met) continue;
                    counted.rays += met;
                    packet.march(counted);
                    packet.write(x, y);
                }
    }
    counted.add_to(counters);
}
#endif
