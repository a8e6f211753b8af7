// The rays of a packet: where they enter, and how many samples they take.
#pragma once

#include "march_packet.hpp"

namespace {

// Rays while they are aimed, before their samples are counted. Lengths are in the coordinates.
struct Lines {
    FHASH_LANES double eye[3][N];        // origins, in vertices of the frame
    FHASH_LANES double direction[3][N];  // of unit length in the coordinates
    FHASH_LANES double enter[N], leave[N];  // the drawn box
    FHASH_LANES double first[N], stop[N];   // the part of it in which the frame has values
    FHASH_LANES double share[N];            // of a step, from the entry to sample 0
};

// Narrow the part of a ray to that between two faces. Where the ray does not move along their axis
// it needs no division: it is inside or not.
FHASH_INLINE void slab(const double (&faces)[2], double eye, double direction, double& enter,
                       double& leave) {
    const double one = (faces[0] - eye) / direction, other = (faces[1] - eye) / direction;
    const bool still = direction == 0, inside = eye >= faces[0] && eye <= faces[1];
    const double near = still ? (inside ? -ENDLESS : ENDLESS) : min(one, other);
    const double far = still ? ENDLESS : max(one, other);
    enter = max(enter, near);
    leave = min(leave, far);
}

// Narrow the part of a ray to that on one side of a plane.
FHASH_INLINE void half_space(double distance, double approach, double& enter, double& leave) {
    // distance: from the eye to the plane, along its normal. approach: by a unit of the ray.
    const double at = distance / approach;
    const double behind = distance > 0 ? ENDLESS : -ENDLESS;  // where the ray does not approach
    enter = max(enter, approach > 0 ? at : approach < 0 ? -ENDLESS : behind);
    leave = min(leave, approach < 0 ? at : ENDLESS);
}

// Aim at the pixels x to x + SIDE, y to y + SIDE, by the ray of this number in each. Returns how
// many rays meet the part of the box in which the frame has values.
FHASH_INLINE int Packet::aim(int64_t x, int64_t y, int64_t ray) {
    Lines lines;
    point(lines, (int)x, (int)y, ray);
    cut(lines);
    int met = count_samples(lines, (int)x, (int)y, ray);
    if (!whole && met) met = keep_seen(lines);
    if (!of_any(met)) return 0;
    place(lines);
    reset();
    if ((flags & SHADED) || m.surfaces != 0) aim_light(lines);
    return met;
}

// Origins and directions of rays through pixels.
FHASH_INLINE void Packet::point(Lines& lines, int left_most, int top_most, int64_t ray) {
    FHASH_LANES double u[N], w[N], length[N];
    const int width = (int)m.width, height = (int)m.height;
    const double right_of = (ray % m.rays + 0.5) / m.rays, below = (ray / m.rays + 0.5) / m.rays;
    double columns[SIDE], rows[SIDE];
    #pragma omp simd
    for (int n = 0; n < SIDE; n++) {
        columns[n] = 2 * (min(left_most + n, width - 1) + right_of) / width - 1;
        rows[n] = 1 - 2 * (min(top_most + n, height - 1) + below) / height;
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        u[l] = columns[l % SIDE];
        w[l] = rows[l / SIDE];
        length[l] = 0;
    }
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const double side = u[l] * m.right[c] + w[l] * m.up[c];
            lines.eye[c][l] = m.eye[c] + (m.parallel ? side : 0);
            const double direction = m.forward[c] + (m.parallel ? 0 : side);
            lines.direction[c][l] = direction;
            length[l] += direction * m.spacing[c] * direction * m.spacing[c];
        }
    }
    #pragma omp simd
    for (int l = 0; l < N; l++) length[l] = sqrt(length[l]);
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) lines.direction[c][l] /= length[l];
    }
}

// Where rays enter and leave the drawn box and the part of it in which the frame has values.
FHASH_INLINE void Packet::cut(Lines& lines) {
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        lines.enter[l] = lines.first[l] = 0;
        lines.leave[l] = lines.stop[l] = ENDLESS;
    }
    for (int c = 0; c < 3; c++) {
        const double *const eye = lines.eye[c], *const direction = lines.direction[c];
        #pragma omp simd
        for (int l = 0; l < N; l++)
            slab(m.box[c], eye[l], direction[l], lines.enter[l], lines.leave[l]);
        if (whole) continue;
        #pragma omp simd
        for (int l = 0; l < N; l++)
            slab(m.seen[c], eye[l], direction[l], lines.first[l], lines.stop[l]);
    }
    for (int64_t p = 0; p < m.planes; p++) {
        const double(&plane)[4] = m.plane[p];
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            double distance = plane[3], approach = 0;
            for (int c = 0; c < 3; c++) {
                distance -= plane[c] * lines.eye[c][l];
                approach += plane[c] * lines.direction[c][l];
            }
            half_space(distance, approach, lines.enter[l], lines.leave[l]);
        }
    }
}

// The samples of rays in the drawn box. Returns how many rays have one.
FHASH_INLINE int Packet::count_samples(Lines& lines, int left_most, int top_most,
                                              int64_t ray) {
    const int width = (int)m.width, height = (int)m.height;
    const uint32_t rays_of_pixel = (uint32_t)(m.rays * m.rays);
    int met = 0;
    #pragma omp simd reduction(+ : met)
    for (int l = 0; l < N; l++) {
        const int column = left_most + l % SIDE, row = top_most + l / SIDE;
        const double enter = lines.enter[l], leave = lines.leave[l];
        // Without a direction a ray never leaves.
        const bool hit = leave > enter && leave < ENDLESS && lines.stop[l] > lines.first[l];
        const double steps = hit ? (leave - enter) / m.step : 0;
        const double most = min(ceil(steps), 2147483000.0);
        const uint32_t pixel = (uint32_t)min(row, height - 1) * width + min(column, width - 1);
        const double share = m.jitter ? random_share(pixel * rays_of_pixel + (uint32_t)ray) : 0.5;
        last[l] = (int)most - 1;
        rest[l] = steps - (most - 1);
        k[l] = 0;
        count[l] = hit && column < width && row < height ? (int)most : 0;
        entered[l] = from[l] = hit ? -share : 0;
        leaving[l] = hit ? steps - share : 0;
        // The last sample may lie behind a plane: then it is where the ray leaves.
        farthest[l] = m.planes > 0 && hit ? (float)(steps - share) : FAR;
        lines.share[l] = share;
        begin[l] = enter + share * m.step;
        met += count[l] > 0;
    }
    return met;
}

// Keep those samples at which the frame has values. Returns how many rays have one.
int Packet::keep_seen(const Lines& lines) {
    int met = 0;
    #pragma omp simd reduction(+ : met)
    for (int l = 0; l < N; l++) {
        const double enter = lines.enter[l], leave = lines.leave[l];
        const double first = lines.first[l], stop = lines.stop[l];
        const double begins = (max(first, enter) - enter) / m.step - lines.share[l];
        const double ends = (min(stop, leave) - enter) / m.step - lines.share[l];
        const double most = count[l];
        const int behind = (int)min(max(floor(ends) + 1, 0.0), most);
        k[l] = first > enter ? (int)min(max(ceil(begins), 0.0), most) : 0;
        count[l] = stop < leave ? behind : count[l];
        entered[l] = from[l] = count[l] ? begins : 0;
        leaving[l] = count[l] ? ends : 0;
        met += count[l] > k[l];
    }
    return met;
}

// The places of the samples 0, and the way from a sample to the next.
FHASH_INLINE void Packet::place(const Lines& lines) {
    float *const at[3] = {ox, oy, oz}, *const pace[3] = {dx, dy, dz};
    float *const inverse[3] = {ix, iy, iz}, *const far[3] = {farx, fary, farz};
    int* const rising[3] = {upx, upy, upz};
    #pragma GCC unroll 3
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const bool hit = count[l] > 0;
            o[c][l] = hit ? lines.eye[c][l] + begin[l] * lines.direction[c][l] : 0;
            d[c][l] = hit ? lines.direction[c][l] * m.step : 0;
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
}

// Nothing is seen yet.
FHASH_INLINE void Packet::reset() {
    #pragma omp simd
    for (int l = 0; l < N; l++) {
        clear[l] = 1;
        red[l] = green[l] = blue[l] = 0;
        r[l] = g[l] = b[l] = a[l] = 0;
        left[l] = 1;
        depth[l] = FAR;
        best[l] = flags & ATTENUATED ? 0.f : -FAR;
        where[l] = quitting[l] = 0;
        previous[l] = NONE;
    }
    for (int l = 0; m.network && l < N; l++) held[l] = 0, begun[l] = 0;
}

// The directions towards the light, and halfway between the light and the eye.
void Packet::aim_light(const Lines& lines) {
    FHASH_LANES double half[3][N], size[N];
    const bool at_eye = m.lamp[0] == 0 && m.lamp[1] == 0 && m.lamp[2] == 0;
    float* const towards[3][2] = {{tox, hx}, {toy, hy}, {toz, hz}};
    #pragma omp simd
    for (int l = 0; l < N; l++) size[l] = 0;
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) {
            const double back = -lines.direction[c][l] * m.spacing[c];  // of unit length already
            half[c][l] = at_eye ? back + back : back + m.lamp[c];
            size[l] += half[c][l] * half[c][l];
            towards[c][0][l] = (float)(at_eye ? back : m.lamp[c]);
        }
    }
    // Light from straight behind has no highlight.
    #pragma omp simd
    for (int l = 0; l < N; l++) size[l] = size[l] > 1e-12 ? 1 / sqrt(size[l]) : 0;
    for (int c = 0; c < 3; c++) {
        #pragma omp simd
        for (int l = 0; l < N; l++) towards[c][1][l] = (float)(half[c][l] * size[l]);
    }
}

}  // namespace
