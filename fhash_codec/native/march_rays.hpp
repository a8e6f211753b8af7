// The rays of a packet: where they enter, how many steps they take.
#pragma once

#include "march_packet.hpp"

namespace {

// What of a ray lies between two faces. Where it does not move along their axis it needs no division: it is inside or not.
FHASH_INLINE void slab(const double (&faces)[2], double eye, double direction, double& enter, double& leave) {
    const double one = (faces[0] - eye) / direction, other = (faces[1] - eye) / direction;
    const bool still = direction == 0, inside = eye >= faces[0] && eye <= faces[1];
    const double near = still ? (inside ? -ENDLESS : ENDLESS) : min(one, other), far = still ? ENDLESS : max(one, other);
    enter = max(enter, near);
    leave = min(leave, far);
}

// The rays through pixels x to x + SIDE, y to y + SIDE, the one of this number in each. How many of them meet what the frame has values of.
template <int WANTED> FHASH_INLINE int Packet<WANTED>::aim(int64_t x, int64_t y, int64_t ray) {
    alignas(64) double u[N], w[N], eye[3][N], direction[3][N], length[N], enter[N], leave[N], first[N], stop[N], share_of[N];
    const int width = (int)m.width, height = (int)m.height, left_most = (int)x, top_most = (int)y;
    const double right_of = (ray % m.rays + 0.5) / m.rays, below = (ray / m.rays + 0.5) / m.rays;
    double columns[SIDE], lines[SIDE];
    #pragma omp simd
    for (int n = 0; n < SIDE; n++) {
        columns[n] = 2 * (min(left_most + n, width - 1) + right_of) / width - 1;
        lines[n] = 1 - 2 * (min(top_most + n, height - 1) + below) / height;
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        u[l] = columns[l % SIDE];
        w[l] = lines[l / SIDE];
        length[l] = enter[l] = first[l] = 0;
        leave[l] = stop[l] = ENDLESS;
    }
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const double side = u[l] * m.right[c] + w[l] * m.up[c];
            eye[c][l] = m.eye[c] + (m.parallel ? side : 0);
            direction[c][l] = m.forward[c] + (m.parallel ? 0 : side);
            length[l] += direction[c][l] * m.spacing[c] * direction[c][l] * m.spacing[c];
        }
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) length[l] = std::sqrt(length[l]);
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            direction[c][l] /= length[l];
            slab(m.box[c], eye[c][l], direction[c][l], enter[l], leave[l]);
        }
        if (whole) continue;
        #pragma omp simd
        for (int l = 0; l < N; l++) slab(m.seen[c], eye[c][l], direction[c][l], first[l], stop[l]);
    }
    int met = 0;
    #pragma omp simd reduction(+ : met)
    for (int l = 0; l < N; l++) {
        const int column = left_most + l % SIDE, line = top_most + l / SIDE;
        const bool hit = leave[l] > enter[l] && leave[l] < ENDLESS && stop[l] > first[l];  // without a direction a ray never leaves
        const double steps = hit ? (leave[l] - enter[l]) / m.step : 0, most = min(std::ceil(steps), 2147483000.0);
        const uint32_t number = ((uint32_t)min(line, height - 1) * width + min(column, width - 1)) * (uint32_t)(m.rays * m.rays) + (uint32_t)ray;
        const double share = m.jitter ? random_share(number) : 0.5;
        last[l] = (int)most - 1;
        rest[l] = steps - (most - 1);
        k[l] = 0;
        count[l] = hit && column < width && line < height ? (int)most : 0;
        entered[l] = from[l] = hit ? -share : 0;
        leaving[l] = hit ? steps - share : 0;
        share_of[l] = share;
        begin[l] = enter[l] + share * m.step;
        met += count[l] > 0;
    }
    if (!whole && met) {  // of the samples of the box those that the frame has values of
        met = 0;
        #pragma omp simd reduction(+ : met)
        for (int l = 0; l < N; l++) {
            const double begins = (max(first[l], enter[l]) - enter[l]) / m.step - share_of[l];
            const double ends = (min(stop[l], leave[l]) - enter[l]) / m.step - share_of[l], most = count[l];
            const int behind = (int)min(max(std::floor(ends) + 1, 0.0), most);
            k[l] = first[l] > enter[l] ? (int)min(max(std::ceil(begins), 0.0), most) : 0;
            count[l] = stop[l] < leave[l] ? behind : count[l];
            entered[l] = from[l] = count[l] ? begins : 0;
            leaving[l] = count[l] ? ends : 0;
            met += count[l] > k[l];
        }
    }
    if (!met) return 0;
    float *const at[3] = {ox, oy, oz}, *const pace[3] = {dx, dy, dz}, *const inverse[3] = {ix, iy, iz}, *const far[3] = {farx, fary, farz};
    int* const rising[3] = {upx, upy, upz};
    #pragma GCC unroll 3
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const bool hit = count[l] > 0;
            o[c][l] = hit ? eye[c][l] + begin[l] * direction[c][l] : 0;
            d[c][l] = hit ? direction[c][l] * m.step : 0;
            normal[c][l] = 0;
        }
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const float step = (float)d[c][l];
            at[c][l] = (float)o[c][l];
            pace[c][l] = step;
            // An axis along which a ray does not move, or hardly, never ends a brick.
            const bool still = fabsf(step) < 1e-9f;
            inverse[c][l] = still ? 0.f : 1 / step;
            far[c][l] = still ? 1e9f : 0.f;
            rising[c][l] = step > 0;
        }
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        clear[l] = 1;
        red[l] = green[l] = blue[l] = 0;
        r[l] = g[l] = b[l] = a[l] = 0;
        left[l] = 1;
        depth[l] = FAR;
        best[l] = -FAR;
        where[l] = quitting[l] = 0;
        previous[l] = NONE;
    }
    if (!(WANTED & SHADED) && m.surfaces == 0) return met;
    const bool own = m.lamp[0] == 0 && m.lamp[1] == 0 && m.lamp[2] == 0;
    float* const towards[3][2] = {{tox, hx}, {toy, hy}, {toz, hz}};
    double(&half)[3][N] = eye;
    double(&size)[N] = length;
    #pragma omp simd
    for (int l = 0; l < N; l++) size[l] = 0;
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const double back = -direction[c][l] * m.spacing[c];  // of unit length already
            half[c][l] = own ? back + back : back + m.lamp[c];
            size[l] += half[c][l] * half[c][l];
            towards[c][0][l] = (float)(own ? back : m.lamp[c]);
        }
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) size[l] = size[l] > 1e-12 ? 1 / std::sqrt(size[l]) : 0;  // light from straight behind has no highlight
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) towards[c][1][l] = (float)(half[c][l] * size[l]);
    }
    return met;
}

}  // namespace
