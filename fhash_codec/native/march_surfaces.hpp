// Isosurfaces along the rays of a packet.
#pragma once

#include "march_packet.hpp"

namespace {

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
        FhashCell slope = here;
        if (m.central) {
            const double at = roots[n].at;
            fhash_central(m, o[0][l] + at * d[0][l], o[1][l] + at * d[1][l], o[2][l] + at * d[2][l], slope);
        }
        const float x = known_or_zero(slope.gx * m.gradient[0]), y = known_or_zero(slope.gy * m.gradient[1]);
        const float z = known_or_zero(slope.gz * m.gradient[2]);
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

// Surfaces up to the samples of this pass, and behind the last ones.
template <int WANTED> void Packet<WANTED>::surfaces(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (!on[l]) continue;
        if (!(previous[l] == previous[l])) {  // the first, or the first after a gap: from the entry, or the sample before it
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

// What lies between last samples and the end of the path.
template <int WANTED> void Packet<WANTED>::finish(Counters& counted) {
    for (int l = 0; l < N; l++)
        if (on[l] && k[l] + 1 == count[l] && leaving[l] > k[l]) {
            counted.samples++;
            cross(l, leaving[l], border(l, leaving[l]).value, counted);
        }
}

}  // namespace
