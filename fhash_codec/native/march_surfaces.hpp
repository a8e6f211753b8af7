// Isosurfaces along the rays of a packet.
#pragma once

#include "march_packet.hpp"

namespace {

// Set depth and normal of a ray, where less than half of the light is left for the first time.
// given: the cell there, or null.
void Packet::see(int l, double sample, const FhashCell* given, Counters& counted) {
    if (depth[l] < FAR) return;
    depth[l] = (float)(begin[l] + sample * m.step);
    if (!m.normal) return;
    const FhashCell here = given ? *given : cell(l, sample);
    counted.gradients += !given;
    const double x = here.gx / m.spacing[0], y = here.gy / m.spacing[1], z = here.gz / m.spacing[2];
    double size = sqrt(x * x + y * y + z * z);
    if (!(size > 0) || !(size < ENDLESS)) return;
    const double away = x * d[0][l] * m.spacing[0] + y * d[1][l] * m.spacing[1] +
                        z * d[2][l] * m.spacing[2];
    if (away > 0) size = -size;  // towards the eye
    normal[0][l] = x / size;
    normal[1][l] = y / size;
    normal[2][l] = z / size;
}

// The place of a surface between `from` with the value `previous` and `to` with `now`: regula falsi
// by Illinois, until the root is within 1e-7 of a step or the value as near as rounding allows.
double Packet::root(int l, double level, double to, double now,
                                         Counters& counted) const {
    double low = from[l], high = to, f_low = previous[l] - level, f_high = now - level;
    double place = f_high == 0 ? high : low;
    for (int turn = 0; turn < 60 && f_low != 0 && f_high != 0 && fabs(high - low) > 1e-7; turn++) {
        place = high - f_high * (high - low) / (f_high - f_low);
        const double f = cell(l, place, false).value - level;
        counted.samples++;
        if (!(f == f)) break;
        if (f == 0) break;
        if ((f < 0) == (f_high < 0)) f_low *= 0.5;
        else low = high, f_low = f_high;
        if (fabs(place - high) < 1e-9) break;
        high = place;
        f_high = f;
    }
    return place;
}

// Add a surface at a place of a ray to the colours, lit. surface: value, red, green, blue, opacity.
void Packet::add_surface(int l, double sample, const double* surface,
                                              Counters& counted) {
    const FhashCell here = cell(l, sample);
    const double at[3] = {o[0][l] + sample * d[0][l], o[1][l] + sample * d[1][l],
                          o[2][l] + sample * d[2][l]};
    float lamp = 1, around = 1;
    if (m.light) {
        lamp = light_at(m, 0, (float)at[0], (float)at[1], (float)at[2]);
        around = light_at(m, 1, (float)at[0], (float)at[1], (float)at[2]);
    }
    FhashCell slope = here;
    if (m.smooth || m.central)
        fhash_central(m, m.smooth ? m.smooth : m.values, at[0], at[1], at[2], slope);
    const float x = known_or_zero(slope.gx * m.gradient[0]);
    const float y = known_or_zero(slope.gy * m.gradient[1]);
    const float z = known_or_zero(slope.gz * m.gradient[2]);
    const float inverse = inverse_length(phong, x, y, z);
    const float towards = x * tox[l] + y * toy[l] + z * toz[l];
    const float halfway = x * hx[l] + y * hy[l] + z * hz[l];
    const float factor = phong.ambient * around + lamp * scattered(phong, towards, inverse);
    const float shine = lamp * mirrored(phong, halfway, inverse);
    counted.gradients++;
    const float w = (1 - a[l]) * (float)surface[4];
    a[l] += w;
    r[l] += w * ((float)surface[1] * factor + shine);
    g[l] += w * ((float)surface[2] * factor + shine);
    b[l] += w * ((float)surface[3] * factor + shine);
    if (m.depth && clear[l] * (1 - (double)a[l]) < 0.5) see(l, sample, &here, counted);
}

// Add the surfaces between `from` with the value `previous` and `to` with `now`, in the order in
// which the ray meets them.
void Packet::cross(int l, double to, double now, Counters& counted) {
    const double before = previous[l];
    if (!(before == before) || !(now == now)) return;
    struct Root {
        double at;
        int64_t which;
    } roots[FHASH_SURFACES];
    int crossed = 0;
    for (int64_t s = 0; s < m.surfaces; s++) {
        const double level = m.surface[s][0];
        if ((before < level) == (now < level)) continue;
        const double place = root(l, level, to, now, counted);
        const double there = cell(l, place, false).value;
        if (!(there == there)) continue;
        int after = crossed++;
        for (; after > 0 && roots[after - 1].at > place; after--) roots[after] = roots[after - 1];
        roots[after] = {place, s};
    }
    for (int n = 0; n < crossed; n++)
        add_surface(l, roots[n].at, m.surface[roots[n].which], counted);
}

// Add the surfaces before the samples of this pass, and behind the samples beyond the path.
void Packet::surfaces(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (!on[l]) continue;
        if (!(previous[l] == previous[l])) {
            // The first sample, or the first after a gap: from the entry, or the sample before it.
            from[l] = max(k[l] - 1.0, entered[l]);
            previous[l] = (float)border(l, from[l]).value;
            counted.samples++;
        }
        const bool beyond = k[l] >= leaving[l];
        if (beyond) {
            cross(l, leaving[l], border(l, leaving[l]).value, counted);
            previous[l] = NONE;
            continue;
        }
        cross(l, k[l], value[l], counted);
        previous[l] = quitting[l] && k[l] + 1 < count[l] ? NONE : value[l];
        from[l] = k[l];
    }
}

// Add the surfaces between last samples and the ends of their paths.
void Packet::finish(Counters& counted) {
    for (int l = 0; l < N; l++)
        if (on[l] && k[l] + 1 == count[l] && leaving[l] > k[l]) {
            counted.samples++;
            cross(l, leaving[l], border(l, leaving[l]).value, counted);
        }
}

}  // namespace
