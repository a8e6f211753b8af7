// Samples of the rays of a packet, in plain loops unless there is AVX-512.
#pragma once

#include "march_packet.hpp"
#include "march_wide.hpp"

namespace {

// Take the values of a pass, their entries in the table and opacities, and the gradients if they
// are shaded by.
template <Taken KIND> void Packet::sample(Counters& counted, Seen& seen) {
#if defined(FHASH_WIDE)
    sample_wide<KIND>(*this, counted, seen);
#else
    const float sign = flags & MINIMUM ? -1.f : 1.f;
    const float* const v = m.values;
    const float* const table = m.table;
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const float mx = high[0], my = high[1], mz = high[2];
    const float nx = low[0], ny = low[1], nz = low[2];
    const float top = (float)(m.entries - 1);
    const int cx = max(lx - 2, 0), cy = max(ly - 2, 0), cz = max(lz - 2, 0);
    const int sx = lx > 1, sy = ly > 1 ? lx : 0, sz = lz > 1 ? lx * ly : 0;
    const float least = (float)m.low, scale = (float)m.scale;
    const float wx = (float)m.gradient[0], wy = (float)m.gradient[1], wz = (float)m.gradient[2];
    int samples = 0, some = 0, end = 0, none = 0;
    #pragma omp simd reduction(+ : samples) reduction(| : some, end, none)
    for (int l = 0; l < N; l++) {
        const float f = min((float)k[l], farthest[l]);
        const float x = clamp(ox[l] + f * dx[l], nx, mx);
        const float y = clamp(oy[l] + f * dy[l], ny, my);
        const float z = clamp(oz[l] + f * dz[l], nz, mz);
        const int i = min((int)x, cx), j = min((int)y, cy), h = min((int)z, cz);
        const float fx = x - i, fy = y - j, fz = z - h;
        const int q = (h * ly + j) * lx + i;
        const float a0 = v[q], a1 = v[q + sx], a2 = v[q + sy], a3 = v[q + sy + sx];
        const float b0 = v[q + sz], b1 = v[q + sz + sx];
        const float b2 = v[q + sz + sy], b3 = v[q + sz + sy + sx];
        const float d0 = a1 - a0, d1 = a3 - a2, d2 = b1 - b0, d3 = b3 - b2;
        const float p0 = a0 + fx * d0, p1 = a2 + fx * d1, p2 = b0 + fx * d2, p3 = b2 + fx * d3;
        const float s0 = p0 + fy * (p1 - p0), s1 = p2 + fy * (p3 - p2);
        const float here = s0 + fz * (s1 - s0);
        const int known = here == here;
        value[l] = here;
        if (KIND == LARGEST) {
            const float ranked = sign * here;
            const int better = on[l] & (ranked > best[l]);
            best[l] = better ? ranked : best[l];
            where[l] = better ? k[l] : where[l];
        } else {
            // NaN becomes an entry whose opacity is not taken.
            const float e = clamp((here - least) * scale, 0.f, top);
            const int t = (int)e;
            const float one = table[4 * t + 3], other = table[4 * t + 7];
            const float opacity = one + (e - t) * (other - one);
            at[l] = e;
            const float taken = opacity * (float)(on[l] & known);
            alpha[l] = taken;
            some |= taken > 0;
        }
        if (KIND == GRADIENTS) {
            const float e0 = d0 + fy * (d1 - d0), e1 = d2 + fy * (d3 - d2);
            const float ex = (e0 + fz * (e1 - e0)) * wx;
            const float ey = ((p1 - p0) + fz * ((p3 - p2) - (p1 - p0))) * wy;
            const float ez = (s1 - s0) * wz;
            // 0 for a missing value: its opacity of 0 times a colour of NaN would be NaN.
            gx[l] = known ? ex : 0.f;
            gy[l] = known ? ey : 0.f;
            gz[l] = known ? ez : 0.f;
        }
        px[l] = x; py[l] = y; pz[l] = z;
        samples += on[l];
        none |= on[l] & !known;
        end |= on[l] & (k[l] == last[l]);
    }
    counted.samples += samples;
    seen.any = some;
    seen.ending = end;
    seen.lost = none;
#endif
}

// The opacity of last steps, which are as long as the rest of the path.
void Packet::shorten() {
    for (int l = 0; l < N; l++) {
        if (!on[l] || k[l] != last[l] || !(alpha[l] > 0)) continue;
        const int t = (int)at[l];
        const double* extinction = m.extinction + t;
        const double here = extinction[0] + (at[l] - t) * (extinction[1] - extinction[0]);
        alpha[l] = (float)(alpha[l] < 0.01 ? opacity_of_share(alpha[l], rest[l])
                                           : -expm1(-rest[l] * here));
    }
}

// The opacity and the colours of one ray at its entry of the table.
FHASH_INLINE void Packet::look_up(int l) {
    const int t = (int)at[l];
    const float* const entry = m.table + 4 * t;
    const float share = at[l] - t;
    alpha[l] = entry[3] + share * (entry[7] - entry[3]);
    cr[l] = entry[0] + share * (entry[4] - entry[0]);
    cg[l] = entry[1] + share * (entry[5] - entry[1]);
    cb[l] = entry[2] + share * (entry[6] - entry[2]);
}

// Look again at samples without a value: on faces of cells a vertex without one may have no weight.
void Packet::mend() {
    for (int l = 0; l < N; l++) {
        if (!on[l] || value[l] == value[l]) continue;
        const FhashCell here = fhash_cell_at(m, px[l], py[l], pz[l]);
        if (!(here.value == here.value)) continue;
        value[l] = (float)here.value;
        at[l] = (float)clamp((here.value - m.low) * m.scale, 0.0, (double)(m.entries - 1));
        look_up(l);
        gx[l] = known_or_zero(here.gx * m.gradient[0]);
        gy[l] = known_or_zero(here.gy * m.gradient[1]);
        gz[l] = known_or_zero(here.gz * m.gradient[2]);
    }
}

// The trilinear value at a place within the vertices; values: (z, y, x) of a shape.
FHASH_INLINE float value_at(const int64_t* shape, const float* values, float x, float y, float z) {
    const int lx = (int)shape[2], ly = (int)shape[1], lz = (int)shape[0];
    const int i = min((int)x, max(lx - 2, 0)), j = min((int)y, max(ly - 2, 0));
    const int h = min((int)z, max(lz - 2, 0)), q = (h * ly + j) * lx + i;
    return mixed(values, q, lx > 1, ly > 1 ? lx : 0, lz > 1 ? lx * ly : 0, x - i, y - j, z - h);
}

// Replace the gradients by central differences of values, as fhash_central does.
void Packet::slopes(const float* values) {
    if (m.network && values == m.values) return central_slopes_of_network();
    int lost = 0;
#if defined(FHASH_WIDE)
    lost = slopes_wide(*this, values);
#else
    const float mx = (float)(m.shape[2] - 1), my = (float)(m.shape[1] - 1);
    const float mz = (float)(m.shape[0] - 1);
    const float wx = 0.5f * (float)m.gradient[0], wy = 0.5f * (float)m.gradient[1];
    const float wz = 0.5f * (float)m.gradient[2];
    #pragma omp simd reduction(| : lost)
    for (int l = 0; l < N; l++) {
        const float x = px[l], y = py[l], z = pz[l];
        const float east = value_at(m.shape, values, min(x + 1, mx), y, z);
        const float ex = (east - value_at(m.shape, values, max(x - 1, 0.f), y, z)) * wx;
        const float north = value_at(m.shape, values, x, min(y + 1, my), z);
        const float ey = (north - value_at(m.shape, values, x, max(y - 1, 0.f), z)) * wy;
        const float above = value_at(m.shape, values, x, y, min(z + 1, mz));
        const float ez = (above - value_at(m.shape, values, x, y, max(z - 1, 0.f))) * wz;
        gx[l] = ex == ex ? ex : gx[l];
        gy[l] = ey == ey ? ey : gy[l];
        gz[l] = ez == ez ? ez : gz[l];
        lost |= (alpha[l] > 0) & !((ex == ex) & (ey == ey) & (ez == ez));
    }
#endif
    if (lost) mend_slopes(values);
}

// Look again at the central differences of a pass, as `mend` does.
void Packet::mend_slopes(const float* values) {
    for (int l = 0; l < N; l++)
        if (alpha[l] > 0) mend_slope(l, values);
}

// The same for one ray.
void Packet::mend_slope(int l, const float* values) {
    FhashCell here = fhash_cell_at(m, px[l], py[l], pz[l]);
    fhash_central(m, values, px[l], py[l], pz[l], here);
    gx[l] = known_or_zero(here.gx * m.gradient[0]);
    gy[l] = known_or_zero(here.gy * m.gradient[1]);
    gz[l] = known_or_zero(here.gz * m.gradient[2]);
}

}  // namespace
