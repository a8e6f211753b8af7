// Leaping over invisible bricks and cells.
#pragma once

#include "march_packet.hpp"
#include "march_wide.hpp"

namespace {

// Move rays on over what is invisible, and let those take part in the pass that have a sample to
// take. Returns 1 if there is one, plus 2 if any ray is not at its end.
FHASH_INLINE int Packet::skip(Counters& counted) {
    if (flags & MAXIMUM) return leap<BY_LARGEST>(counted);
    return m.cells ? leap<BY_CELLS>(counted) : leap<BY_BRICKS>(counted);
}

// The cell of a ray's next sample, the cell's brick, and the number of that brick.
struct Spot {
    int i, j, h, jx, jy, jz, brick;
};

FHASH_INLINE Spot spot_of(const Packet& p, int l, int lx, int ly, int lz, int bx, int by) {
    const float f = min((float)p.k[l], p.farthest[l]), bricks = 1.f / FHASH_BRICK;
    const int i = min((int)clamp(p.ox[l] + f * p.dx[l], p.low[0], p.high[0]), max(lx - 2, 0));
    const int j = min((int)clamp(p.oy[l] + f * p.dy[l], p.low[1], p.high[1]), max(ly - 2, 0));
    const int h = min((int)clamp(p.oz[l] + f * p.dz[l], p.low[2], p.high[2]), max(lz - 2, 0));
    const int jx = (int)((float)i * bricks), jy = (int)((float)j * bricks);
    const int jz = (int)((float)h * bricks);
    return {i, j, h, jx, jy, jz, (jz * by + jy) * bx + jx};
}

// Whether a cell is invisible.
FHASH_INLINE int empty(const uint32_t* cells, int i, int j, int h, int brick) {
    const int bit = (h & 1) << 4 | (j & 3) << 2 | (i & 3);
    return ~cells[2 * brick + (h >> 1 & 1)] >> bit & 1;
}

// The place, in samples, at which a ray leaves what it leaps over: one cell, if `cell` is 1, or the
// bricks up to w around the one at its sample. Rather a sample short of the end than one beyond it.
FHASH_INLINE float reach(const Packet& p, int l, const Spot& at, int w, int cell) {
    const float side = (float)FHASH_BRICK, near = (float)w * side, lone = (float)cell;
    const float across = side * (float)(1 + 2 * w) - lone * (side - 1);
    const float west = (float)at.jx * side, south = (float)at.jy * side;
    const float bottom = (float)at.jz * side;
    const float fromx = west + lone * ((float)at.i - west) - near;
    const float fromy = south + lone * ((float)at.j - south) - near;
    const float fromz = bottom + lone * ((float)at.h - bottom) - near;
    const float tx = (fromx + (float)p.upx[l] * across - p.ox[l]) * p.ix[l] + p.farx[l];
    const float ty = (fromy + (float)p.upy[l] * across - p.oy[l]) * p.iy[l] + p.fary[l];
    const float tz = (fromz + (float)p.upz[l] * across - p.oz[l]) * p.iz[l] + p.farz[l];
    return min(min(min(tx, ty), tz), 1e9f) * (1 - 2e-6f);
}

// `skip` in plain loops, unless there is AVX-512.
template <Leaps BY> int Packet::leap(Counters& counted) {
#if defined(FHASH_WIDE)
    return leap_wide<BY>(*this, counted);
#else
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1];
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const int keeping = m.surfaces > 0;
    const int32_t* const distance = m.distance;
    const uint32_t* const cells = m.cells;
    const float* const highest = m.highest;
    int here = 0, alive = 0, skipped = 0, any = 0;
    // Most passes skip nothing. Then no more is computed, and the sampling does not wait for
    // bricks.
    #pragma omp simd reduction(| : any, here)
    for (int l = 0; l < N; l++) {
        const int going = k[l] < count[l];
        const Spot at = spot_of(*this, l, lx, ly, lz, bx, by);
        int away;
        if (BY == BY_LARGEST) away = !(highest[at.brick] > best[l]);
        else if (BY == BY_CELLS) away = empty(cells, at.i, at.j, at.h, at.brick);
        else away = distance[at.brick] > 0;
        any |= going & away;
        on[l] = going;
        here |= going;
        quitting[l] = 0;
    }
    if (!any) return here ? 3 : 0;
    int leapt[N], ended = 0;
    here = 0;
    #pragma omp simd reduction(| : here, alive, ended) reduction(+ : skipped)
    for (int l = 0; l < N; l++) {
        const int going = k[l] < count[l];
        const Spot at = spot_of(*this, l, lx, ly, lz, bx, by);
        int away, w = 0, cell = 0;
        if (BY == BY_LARGEST) away = highest[at.brick] > best[l] ? 0 : 1;
        else away = distance[at.brick], w = away - 1;
        if (BY == BY_CELLS) {  // a brick that matters: over one cell of it
            cell = away == 0;
            w += cell;
            away = empty(cells, at.i, at.j, at.h, at.brick);
        }
        const float leave = reach(*this, l, at, w, cell);
        const int next = min(max((int)leave + 1, k[l] + 1), count[l]);
        // The first sample behind a brick that matters is taken: a surface may lie before it.
        const int first_behind = keeping & (previous[l] == previous[l]);
        const int over = going & (away > 0) & !first_behind;
        quitting[l] = going & (away > 0) & first_behind;
        leapt[l] = over;
        k[l] = over ? next : k[l];
        on[l] = going & !over;
        skipped += over;
        alive |= k[l] < count[l];
        here |= on[l];
        ended |= over & (next == count[l]);
    }
    counted.skips += skipped;
    if (keeping && ended) {
        part_ways(leapt, counted);
        alive = 0;
        for (int l = 0; l < N; l++) alive |= k[l] < count[l];
    }
    return (here ? 1 : 0) | (alive ? 2 : 0);
#endif
}

// Let the frame fetch what the samples of this pass read. Returns whether anything was missing:
// then bricks may be invisible that were not known. Where it fails, the rays end.
bool Packet::fetch() {
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1];
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const int32_t* const ready = m.ready;
    int missing = 0;
    #pragma omp simd reduction(| : missing)
    for (int l = 0; l < N; l++)
        missing |= on[l] & !ready[spot_of(*this, l, lx, ly, lz, bx, by).brick];
#if !defined(FHASH_CUDA)
    std::atomic_thread_fence(std::memory_order_acquire);  // another thread may have fetched it
#endif
    if (!missing) return false;
    for (int l = 0; l < N; l++) {
        const int brick = spot_of(*this, l, lx, ly, lz, bx, by).brick;
        if (!on[l] || ready[brick] || !m.fetch(brick)) continue;
        for (int ray = 0; ray < N; ray++) k[ray] = count[ray];
        break;
    }
    return true;
}

// Whether the cell at a place of a ray is visible.
bool Packet::visible(int l, double sample) const {
    int at[3];
    for (int c = 0; c < 3; c++) {
        const double most = (double)m.shape[2 - c] - 1;
        const double place = place_of(l, c, sample);
        at[c] = min((int)place, max((int)most - 1, 0));
    }
    const int64_t side = FHASH_BRICK, row = at[2] / side * m.bricks[1] + at[1] / side;
    const int64_t q = row * m.bricks[2] + at[0] / side;
    if (m.ready && !m.ready[q] && m.fetch(q)) return false;
    if (m.distance[q] > 0) return false;
    return !m.cells || !empty(m.cells, at[0], at[1], at[2], (int)q);
}

// Look at where rays enter, if that is in a visible cell: a surface may lie before the first
// sample.
void Packet::meet(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (k[l] >= count[l] || !visible(l, entered[l])) continue;
        previous[l] = (float)border(l, entered[l]).value;
        counted.samples++;
    }
}

// Let rays that leapt to their ends take their last sample, if they leave the box by a visible
// cell: a surface may lie behind it. leapt: whether each ray leapt in this pass.
void Packet::part_ways(const int* leapt, Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (!leapt[l] || k[l] < count[l] || !visible(l, leaving[l])) continue;
        from[l] = max(count[l] - 2.0, entered[l]);
        previous[l] = (float)border(l, from[l]).value;
        counted.samples++;
        k[l] = previous[l] == previous[l] ? count[l] - 1 : count[l];
    }
}

}  // namespace
