// Samples of the rays of a packet from a network, which is evaluated ahead of the rays.
//
// The network takes FHASH_POINTS places at a time, of up to AHEAD samples of each ray: the fewer
// rays are left, the more samples of each (adaptive ray marching: paper, algorithm 1).
#pragma once

#include "march_packet.hpp"
#include "march_sample.hpp"
#include "march_skip.hpp"

namespace {

// Whether the network has a value at a place within the frame.
FHASH_INLINE bool known_at(const FhashInput& m, float x, float y, float z) {
    if (m.network_whole) return true;
    if (m.network_x || m.network_y || m.network_z) {
        double at[3] = {x, y, z}, rates[3];
        to_box(m, at, rates);
        x = (float)at[0]; y = (float)at[1]; z = (float)at[2];
    }
    const float there = value_at(m.network_shape, m.values, x, y, z);
    return there == there;
}

#if !defined(FHASH_CUDA)
// Evaluate the network at the next samples of all rays, the nearest first, where the frame says
// that there is a value.
void Packet::look_ahead(Counters& counted) {
    FhashPoints points;
    int ray[POINTS], sample[POINTS];
    for (int l = 0; l < N; l++) {
        const int gone = k[l] - begun[l];
        begun[l] = k[l];
        if (gone >= AHEAD) held[l] = 0;
        if (!held[l] || !gone) continue;
        held[l] >>= gone;
        for (int j = 0; j + gone < AHEAD; j++) ahead[l][j] = ahead[l][j + gone];
    }
    for (int j = 0; j < AHEAD && points.count < POINTS; j++)
        for (int l = 0; l < N && points.count < POINTS; l++) {
            if (k[l] + j >= count[l] || (held[l] >> j & 1) || (j == 0 && !on[l])) continue;
            if (j > 0 && m.distance && !visible(l, k[l] + j)) continue;
            const float f = min((float)(k[l] + j), farthest[l]);
            const float x = clamp(ox[l] + f * dx[l], low[0], high[0]);
            const float y = clamp(oy[l] + f * dy[l], low[1], high[1]);
            const float z = clamp(oz[l] + f * dz[l], low[2], high[2]);
            if (!known_at(m, x, y, z)) continue;
            ray[points.count] = l;
            sample[points.count] = j;
            points.add(x, y, z);
        }
    points.evaluate(m, false);
    counted.evaluations += points.count;
    for (int i = 0; i < points.count; i++) {
        ahead[ray[i]][sample[i]] = points.values[i];
        held[ray[i]] |= 1u << sample[i];
    }
}
#else
// The same by a warp: as many samples of each ray that lacks one as there are threads for.
void Packet::look_ahead(Counters& counted) {
    constexpr unsigned ALL = 0xffffffffu;
    const unsigned lane = threadIdx.x % 32;
    const bool lacks = on[0] && value[0] == value[0] &&
                       !(k[0] - begun[0] < AHEAD && held[0] >> (k[0] - begun[0]) & 1);
    const unsigned rays = __ballot_sync(ALL, lacks);
    const unsigned alive = __popc(rays), each = min(32 / alive, (unsigned)AHEAD);
    unsigned others = rays;
    for (unsigned n = 0; n < lane / each && n < alive - 1; n++) others &= others - 1;
    const int ray = __ffs(others) - 1, sample = (int)(lane % each);
    const auto of_ray = [&](auto number) { return __shfl_sync(ALL, number, ray); };
    const int at_sample = of_ray(k[0]) + sample, end = of_ray(count[0]);
    const float f = min((float)at_sample, of_ray(farthest[0]));
    const float x = clamp(of_ray(ox[0]) + f * of_ray(dx[0]), low[0], high[0]);
    const float y = clamp(of_ray(oy[0]) + f * of_ray(dy[0]), low[1], high[1]);
    const float z = clamp(of_ray(oz[0]) + f * of_ray(dz[0]), low[2], high[2]);
    FhashPoints points;
    if (lane / each < alive && at_sample < end && known_at(m, x, y, z)) points.add(x, y, z);
    points.evaluate(m, false);
    counted.evaluations += points.count;
    const unsigned found = __ballot_sync(ALL, points.count);
    const unsigned first = each * __popc(rays & ((1u << lane) - 1));
    for (unsigned j = 0; j < each; j++) {
        const float there = __shfl_sync(ALL, points.values[0], (first + j) % 32);
        if (lacks) ahead[0][j] = there;
    }
    if (lacks) begun[0] = k[0], held[0] = found >> first & ((2u << (each - 1)) - 1);
}
#endif

// `sample` for a network.
void Packet::sample_network(Counters& counted, Seen& seen) {
    const float top = (float)(m.entries - 1);
    const float least = (float)m.low, scale = (float)m.scale;
    int wanting = 0;
    for (int l = 0; l < N; l++) {
        const float f = min((float)k[l], farthest[l]);
        px[l] = clamp(ox[l] + f * dx[l], low[0], high[0]);
        py[l] = clamp(oy[l] + f * dy[l], low[1], high[1]);
        pz[l] = clamp(oz[l] + f * dz[l], low[2], high[2]);
        value[l] = known_at(m, px[l], py[l], pz[l]) ? 0.f : NONE;
        const int j = k[l] - begun[l];
        const bool there = j >= 0 && j < AHEAD && (held[l] >> j & 1);
        wanting |= on[l] && value[l] == value[l] && !there;
    }
    if (of_any(wanting)) look_ahead(counted);
    for (int l = 0; l < N; l++) {
        counted.samples += on[l];
        const int j = k[l] - begun[l];
        const bool known = on[l] && value[l] == value[l] && (held[l] >> j & 1);
        const float here = value[l] = known ? ahead[l][j] : NONE;
        seen.lost |= on[l] && !known;
        if (flags & MAXIMUM) {
            const float ranked = flags & MINIMUM ? -here : here;
            const bool better = on[l] && ranked > best[l];
            best[l] = better ? ranked : best[l];
            where[l] = better ? k[l] : where[l];
            continue;
        }
        seen.ending |= on[l] && k[l] == last[l];
        at[l] = clamp((here - least) * scale, 0.f, top);
        look_up(l);
        if (!known) alpha[l] = 0;
        seen.any |= alpha[l] > 0;
        gx[l] = gy[l] = gz[l] = 0;
    }
    if ((flags & SHADED) && seen.any && !m.central) slopes_of_network();
}

// The gradients of a pass where it has an opacity: those of the network itself.
void Packet::slopes_of_network() {
    FhashPoints points;
    int ray[N];
    for (int l = 0; l < N; l++) {
        if (!(alpha[l] > 0)) continue;
        ray[points.count] = l;
        points.add(px[l], py[l], pz[l]);
    }
    points.evaluate(m, true);
    for (int i = 0; i < points.count; i++) {
        gx[ray[i]] = points.slopes[i][3] * (float)m.gradient[0];
        gy[ray[i]] = points.slopes[i][2] * (float)m.gradient[1];
        gz[ray[i]] = points.slopes[i][1] * (float)m.gradient[2];
    }
}

// The same by central differences, as fhash_central does.
void Packet::central_slopes_of_network() {
    float* const to[3] = {gx, gy, gz};
    bool lost[N] = {};
    for (int c = 0; c < 3; c++) {
        FhashPoints points;
        int ray[2 * N];
        for (int l = 0; l < N; l++) {
            if (!(alpha[l] > 0)) continue;
            for (const float move : {1.f, -1.f}) {
                float place[3] = {px[l], py[l], pz[l]};
                place[c] = clamp(place[c] + move, 0.f, (float)(m.shape[2 - c] - 1));
                lost[l] |= !known_at(m, place[0], place[1], place[2]);
                ray[points.count] = l;
                points.add(place[0], place[1], place[2]);
            }
        }
        points.evaluate(m, false);
        for (int i = 0; i < points.count; i += 2)
            to[c][ray[i]] =
                0.5f * (points.values[i] - points.values[i + 1]) * (float)m.gradient[c];
    }
    for (int l = 0; l < N; l++)
        if (lost[l]) mend_slope(l, m.values);
}

}  // namespace
