// Samples of the rays of a packet in plain loops.
#pragma once

#include "march_packet.hpp"
#include "march_wide.hpp"

namespace {

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
        gx[l] = known_or_zero(here.gx * m.gradient[0]);
        gy[l] = known_or_zero(here.gy * m.gradient[1]);
        gz[l] = known_or_zero(here.gz * m.gradient[2]);
    }
}

// Trilinear at a place of the frame.
FHASH_INLINE float value_at(const FhashMarch& m, float x, float y, float z) {
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const int i = min((int)x, max(lx - 2, 0)), j = min((int)y, max(ly - 2, 0)), h = min((int)z, max(lz - 2, 0));
    return mixed(m.values, (h * ly + j) * lx + i, lx > 1, ly > 1 ? lx : 0, lz > 1 ? lx * ly : 0, x - i, y - j, z - h);
}

// The gradients by central differences, as fhash_central has them.
template <int WANTED> FHASH_INLINE void Packet<WANTED>::slopes() {
    int lost = 0;
#if defined(FHASH_AVX512)
    if constexpr (WANTED & WIDE) {
        lost = slopes_wide(*this);
    } else
#endif
    {
        const float mx = (float)(m.shape[2] - 1), my = (float)(m.shape[1] - 1), mz = (float)(m.shape[0] - 1);
        const float wx = 0.5f * (float)m.gradient[0], wy = 0.5f * (float)m.gradient[1], wz = 0.5f * (float)m.gradient[2];
        #pragma omp simd reduction(| : lost)
        for (int l = 0; l < N; l++) {
            const float x = px[l], y = py[l], z = pz[l];
            const float ex = (value_at(m, min(x + 1, mx), y, z) - value_at(m, max(x - 1, 0.f), y, z)) * wx;
            const float ey = (value_at(m, x, min(y + 1, my), z) - value_at(m, x, max(y - 1, 0.f), z)) * wy;
            const float ez = (value_at(m, x, y, min(z + 1, mz)) - value_at(m, x, y, max(z - 1, 0.f))) * wz;
            gx[l] = ex == ex ? ex : gx[l];
            gy[l] = ey == ey ? ey : gy[l];
            gz[l] = ez == ez ? ez : gz[l];
            lost |= (alpha[l] > 0) & !((ex == ex) & (ey == ey) & (ez == ez));
        }
    }
    if (lost) mend_slopes();
}

// As `mend`: places on faces of cells may have values though not all vertices have.
template <int WANTED> void Packet<WANTED>::mend_slopes() {
    for (int l = 0; l < N; l++) {
        if (!(alpha[l] > 0)) continue;
        FhashCell here = fhash_cell_at(m, px[l], py[l], pz[l]);
        fhash_central(m, px[l], py[l], pz[l], here);
        gx[l] = known_or_zero(here.gx * m.gradient[0]);
        gy[l] = known_or_zero(here.gy * m.gradient[1]);
        gz[l] = known_or_zero(here.gz * m.gradient[2]);
    }
}

}  // namespace
