// Projections: one value along each ray, drawn opaque, instead of the volume.
#pragma once

#include "march_packet.hpp"

namespace {

// Look again at samples without a value, which may lie on faces of cells.
void Packet::keep_lost_maximum() {
    for (int l = 0; l < N; l++) {
        if (!on[l] || value[l] == value[l]) continue;
        const float here = (float)fhash_cell_at(m, px[l], py[l], pz[l], false).value;
        const float ranked = flags & MINIMUM ? -here : here;
        if (ranked > best[l]) best[l] = ranked, where[l] = k[l];
    }
}

// Add the samples of a pass to the mean: r is the sum of the values above m.low, g that of the
// lengths, in steps. `best` is -FAR before the first value, which `where` is the sample of. A
// sample counts where its opacity is above 0: the table has one for every value.
void Packet::average() {
    const float least = (float)m.low;
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        const int counts = alpha[l] > 0;
        const float length = k[l] == last[l] ? (float)rest[l] : 1.f;
        const float weight = counts ? length : 0.f;
        const float above = counts ? value[l] - least : 0.f;
        where[l] = (counts & (best[l] < 0)) ? k[l] : where[l];
        best[l] = counts ? 0.f : best[l];
        r[l] += weight * above;
        g[l] += weight;
    }
}

// Add the samples of a pass to the attenuated maximum: `a` is the light that the samples took,
// `best` the largest share of the colours that was left of a value. A sample counts where its value
// is above the lower end of the colours.
void Packet::attenuate() {
    const float top = (float)(m.entries - 1);
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        const float light = left[l] * (1 - a[l]), left_of_it = at[l] / top * light;
        const int better = (alpha[l] > 0) & (left_of_it > best[l]);
        best[l] = better ? left_of_it : best[l];
        where[l] = better ? k[l] : where[l];
        a[l] += (1 - a[l]) * alpha[l];
    }
}

// End the rays along which no later value can be larger: not even the largest one.
FHASH_INLINE void Packet::end_attenuated() {
    #pragma omp simd
    for (int l = 0; l < N; l++) k[l] = left[l] * (1 - a[l]) <= best[l] ? count[l] : k[l];
}

// Draw the colour at an entry of the table, opaque.
void Packet::show_value(int l, double place, Counters& counted) {
    const double e = clamp(place, 0.0, (double)(m.entries - 1));
    const float* entry = m.table + 4 * (int)e;
    const double share = e - (int)e;
    red[l] = entry[0] + share * (entry[4] - entry[0]);
    green[l] = entry[1] + share * (entry[5] - entry[1]);
    blue[l] = entry[2] + share * (entry[6] - entry[2]);
    clear[l] = 0;
    if (m.depth) see(l, where[l], nullptr, counted);
}

// Draw the projected values.
void Packet::show_projection(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (flags & MAXIMUM) {
            const float value_there = flags & MINIMUM ? -best[l] : best[l];
            if (best[l] > -FAR) show_value(l, (value_there - m.low) * m.scale, counted);
        } else if (flags & AVERAGE) {
            if (green[l] > 0) show_value(l, red[l] / green[l] * m.scale, counted);
        } else if (flags & ATTENUATED) {
            if (best[l] > 0) show_value(l, best[l] * (double)(m.entries - 1), counted);
            else clear[l] = 1;
        }
    }
}

}  // namespace
