// Over bricks and cells of which nothing can be seen.
#pragma once

#include "march_packet.hpp"
#include "march_wide.hpp"

namespace {

// Which rays have a sample to take here (1), and whether any is alive at all (2).
template <int WANTED> FHASH_INLINE int Packet<WANTED>::skip(Counters& counted) {
#if defined(FHASH_AVX512)
    if constexpr (WANTED & WIDE)
        return m.cells && !(WANTED & MAXIMUM) ? leap_wide<WANTED, true>(*this, counted) : leap_wide<WANTED, false>(*this, counted);
#endif
    return m.cells && !(WANTED & MAXIMUM) ? leap<true>(counted) : leap<false>(counted);
}

// The cell that a ray's next sample lies in, its brick, and that one's number.
struct Spot {
    int i, j, h, jx, jy, jz, brick;
};

template <int WANTED> FHASH_INLINE Spot spot_of(const Packet<WANTED>& p, int l, int lx, int ly, int lz, int bx, int by) {
    const float f = (float)p.k[l], part = 1.f / FHASH_BRICK;
    const int i = min((int)clamp(p.ox[l] + f * p.dx[l], 0.f, (float)(lx - 1)), max(lx - 2, 0));
    const int j = min((int)clamp(p.oy[l] + f * p.dy[l], 0.f, (float)(ly - 1)), max(ly - 2, 0));
    const int h = min((int)clamp(p.oz[l] + f * p.dz[l], 0.f, (float)(lz - 1)), max(lz - 2, 0));
    const int jx = (int)((float)i * part), jy = (int)((float)j * part), jz = (int)((float)h * part);
    return {i, j, h, jx, jy, jz, (jz * by + jy) * bx + jx};
}

// Whether nothing can be seen in a cell.
FHASH_INLINE int empty(const uint32_t* cells, int i, int j, int h, int brick) {
    return ~cells[2 * brick + (h >> 1 & 1)] >> ((h & 1) << 4 | (j & 3) << 2 | (i & 3)) & 1;
}

// CELLS: by cell within the bricks that matter.
template <int WANTED> template <bool CELLS> FHASH_INLINE int Packet<WANTED>::leap(Counters& counted) {
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1], lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const float side = (float)FHASH_BRICK;
    const int keeping = m.surfaces > 0;
    const int32_t* const distance = m.distance;
    const uint32_t* const cells = m.cells;
    const float* const highest = m.highest;
    int here = 0, alive = 0, skipped = 0, any = 0;
    // Most passes skip nothing: then no more is worked out, and what follows does not wait for the bricks.
    #pragma omp simd reduction(| : any, here)
    for (int l = 0; l < N; l++) {
        const int going = k[l] < count[l];
        const Spot at = spot_of(*this, l, lx, ly, lz, bx, by);
        int away;
        if (WANTED & MAXIMUM) away = !(highest[at.brick] > best[l]);
        else if (CELLS) away = empty(cells, at.i, at.j, at.h, at.brick);
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
        if (WANTED & MAXIMUM) away = highest[at.brick] > best[l] ? 0 : 1;
        else away = distance[at.brick], w = away - 1;
        if (CELLS) {  // within a brick that matters, over one cell
            cell = away == 0;
            w += cell;
            away = empty(cells, at.i, at.j, at.h, at.brick);
        }
        // The ends of what is passed over: the cell, or the bricks up to w around this one.
        const float near = (float)w * side, lone = (float)cell, across = side * (float)(1 + 2 * w) - lone * (side - 1);
        const float westmost = (float)at.jx * side, southmost = (float)at.jy * side, lowest = (float)at.jz * side;
        const float fromx = westmost + lone * ((float)at.i - westmost) - near, fromy = southmost + lone * ((float)at.j - southmost) - near;
        const float fromz = lowest + lone * ((float)at.h - lowest) - near;
        const float tx = (fromx + (float)upx[l] * across - ox[l]) * ix[l] + farx[l];
        const float ty = (fromy + (float)upy[l] * across - oy[l]) * iy[l] + fary[l];
        const float tz = (fromz + (float)upz[l] * across - oz[l]) * iz[l] + farz[l];
        // Rather a sample short of the brick's end than one beyond it.
        const float leave = min(min(min(tx, ty), tz), 1e9f) * (1 - 2e-6f);
        const int next = min(max((int)leave + 1, k[l] + 1), count[l]);
        // The first sample beyond a brick that matters is taken: a surface may lie between it and the one before.
        const int last_of_all = keeping & (previous[l] == previous[l]), over = going & (away > 0) & !last_of_all;
        quitting[l] = going & (away > 0) & last_of_all;
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
}

// Whether something can be seen in the cell that a place of a ray lies in.
template <int WANTED> bool Packet<WANTED>::visible(int l, double sample) const {
    int at[3];
    for (int c = 0; c < 3; c++) {
        const double most = (double)m.shape[2 - c] - 1, place = clamp(o[c][l] + sample * d[c][l], 0.0, most);
        at[c] = min((int)place, max((int)most - 1, 0));
    }
    const int64_t side = FHASH_BRICK, q = (at[2] / side * m.bricks[1] + at[1] / side) * m.bricks[2] + at[0] / side;
    if (m.distance[q] > 0) return false;
    return !m.cells || !empty(m.cells, at[0], at[1], at[2], (int)q);
}

// Where rays enter a cell that matters but have their first sample beyond it: a surface may lie between.
template <int WANTED> void Packet<WANTED>::meet(Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (k[l] >= count[l] || !visible(l, entered[l])) continue;
        previous[l] = (float)border(l, entered[l]).value;
        counted.samples++;
    }
}

// Where rays leave the box by a cell that matters but have their last sample, short of it: they take that, if one.
template <int WANTED> void Packet<WANTED>::part_ways(const int* leapt, Counters& counted) {
    for (int l = 0; l < N; l++) {
        if (!leapt[l] || k[l] < count[l] || !visible(l, leaving[l])) continue;
        from[l] = max(count[l] - 2.0, entered[l]);
        previous[l] = (float)border(l, from[l]).value;
        counted.samples++;
        k[l] = previous[l] == previous[l] ? count[l] - 1 : count[l];
    }
}

}  // namespace
