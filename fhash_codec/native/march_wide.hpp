// Samples of the rays of a packet by AVX-512.
#pragma once

#include "march_packet.hpp"

#if FHASH_TARGET == 4
#define FHASH_WIDE FHASH_INLINE

namespace {

// a + share * (b - a)
FHASH_WIDE __m512 between(__m512 a, __m512 b, __m512 share) {
    return _mm512_fmadd_ps(share, _mm512_sub_ps(b, a), a);
}

// A place along an axis, clamped to least..most; what is not a number becomes `least`.
FHASH_WIDE __m512 place(const float* origin, const float* step, __m512 sample, float least,
                        float most) {
    const __m512 way = _mm512_mul_ps(sample, _mm512_load_ps(step));
    const __m512 at = _mm512_add_ps(_mm512_load_ps(origin), way);
    return _mm512_min_ps(_mm512_max_ps(at, _mm512_set1_ps(least)), _mm512_set1_ps(most));
}

// The samples at which rays leave a span along an axis. It ends `across` behind `first`, for rays
// that ascend, or `back` from it, for those that do not.
FHASH_WIDE __m512 behind(__m512i first, __m512i across, __m512i back, const int* up,
                         const float* origin, const float* inverse, const float* far) {
    const __m512i rising = _mm512_load_si512(up);
    const __mmask16 ascending = _mm512_test_epi32_mask(rising, rising);
    const __m512i end = _mm512_add_epi32(first, _mm512_mask_mov_epi32(back, ascending, across));
    const __m512 away = _mm512_sub_ps(_mm512_cvtepi32_ps(end), _mm512_load_ps(origin));
    return _mm512_add_ps(_mm512_mul_ps(away, _mm512_load_ps(inverse)), _mm512_load_ps(far));
}

// The values of 16 vertices and of the vertices behind them along x. One load for both: the time of
// gathering depends on the number of loads, not of bytes.
FHASH_WIDE void pairs(const float* v, __m512i q, __m512& first, __m512& second) {
    const __m256i upper = _mm512_extracti64x4_epi64(q, 1);
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(q), v, 4));
    const __m512 high = _mm512_castpd_ps(_mm512_i32gather_pd(upper, v, 4));
    const __m512i even =
        _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    first = _mm512_permutex2var_ps(low, even, high);
    second = _mm512_permutex2var_ps(low, _mm512_add_epi32(even, _mm512_set1_epi32(1)), high);
}

// Entries of a table, four floats each, of 16 lanes as four vectors.
FHASH_WIDE void entries(const float* table, const int* t, __m512 (&out)[4]) {
    __m512 row[4];
    for (int n = 0; n < 4; n++) {
        row[n] = _mm512_castps128_ps512(_mm_loadu_ps(table + t[n]));
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 4]), 1);
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 8]), 2);
        row[n] = _mm512_insertf32x4(row[n], _mm_loadu_ps(table + t[n + 12]), 3);
    }
    const __m512 a = _mm512_unpacklo_ps(row[0], row[1]), b = _mm512_unpacklo_ps(row[2], row[3]);
    const __m512 c = _mm512_unpackhi_ps(row[0], row[1]), d = _mm512_unpackhi_ps(row[2], row[3]);
    out[0] = _mm512_shuffle_ps(a, b, 0x44);
    out[1] = _mm512_shuffle_ps(a, b, 0xee);
    out[2] = _mm512_shuffle_ps(c, d, 0x44);
    out[3] = _mm512_shuffle_ps(c, d, 0xee);
}

// The cells of samples, and their bricks.
struct Spots {
    __m512i i, j, h;     // cells along x, y, z
    __m512i jx, jy, jz;  // bricks
    __m512i brick;       // numbers of the bricks
};
FHASH_WIDE Spots spots_of(const Packet& p, __m512i k) {
    const FhashInput& m = p.m;
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1];
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const __m512i cx = _mm512_set1_epi32(lx - 2), cy = _mm512_set1_epi32(max(ly - 2, 0));
    const __m512i cz = _mm512_set1_epi32(max(lz - 2, 0));
    const __m512 f = _mm512_min_ps(_mm512_cvtepi32_ps(k), _mm512_load_ps(p.farthest));
    const __m512 x = place(p.ox, p.dx, f, p.low[0], p.high[0]);
    const __m512 y = place(p.oy, p.dy, f, p.low[1], p.high[1]);
    const __m512 z = place(p.oz, p.dz, f, p.low[2], p.high[2]);
    Spots at;
    at.i = _mm512_min_epi32(_mm512_cvttps_epi32(x), cx);
    at.j = _mm512_min_epi32(_mm512_cvttps_epi32(y), cy);
    at.h = _mm512_min_epi32(_mm512_cvttps_epi32(z), cz);
    at.jx = _mm512_srai_epi32(at.i, 2);
    at.jy = _mm512_srai_epi32(at.j, 2);
    at.jz = _mm512_srai_epi32(at.h, 2);
    const __m512i row =
        _mm512_add_epi32(_mm512_mullo_epi32(at.jz, _mm512_set1_epi32(by)), at.jy);
    at.brick = _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(bx)), at.jx);
    return at;
}

// The rays whose sample lies in an invisible cell or brick.
template <Leaps BY>
FHASH_WIDE __mmask16 invisible(const Packet& p, const Spots& at) {
    const FhashInput& m = p.m;
    const __m512i one = _mm512_set1_epi32(1), three = _mm512_set1_epi32(3);
    if (BY == BY_LARGEST) {
        const __m512 highest = _mm512_i32gather_ps(at.brick, m.highest, 4);
        return ~_mm512_cmp_ps_mask(highest, _mm512_load_ps(p.best), _CMP_GT_OQ);
    }
    if (BY == BY_CELLS) {
        const __m512i half = _mm512_and_si512(_mm512_srai_epi32(at.h, 1), one);
        const __m512i word = _mm512_add_epi32(_mm512_slli_epi32(at.brick, 1), half);
        const __m512i bits = _mm512_i32gather_epi32(word, m.cells, 4);
        const __m512i z = _mm512_slli_epi32(_mm512_and_si512(at.h, one), 4);
        const __m512i y = _mm512_slli_epi32(_mm512_and_si512(at.j, three), 2);
        const __m512i bit =
            _mm512_or_si512(z, _mm512_or_si512(y, _mm512_and_si512(at.i, three)));
        return _mm512_testn_epi32_mask(_mm512_srlv_epi32(bits, bit), one);
    }
    const __m512i far = _mm512_i32gather_epi32(at.brick, m.distance, 4);
    return _mm512_test_epi32_mask(far, far);
}

// The first samples behind what is invisible around samples: the cell, or the bricks as far as none
// matters. away: the rays that it is needed for.
template <Leaps BY>
FHASH_WIDE __m512i behind_invisible(const Packet& p, const Spots& at, __mmask16 away,
                                    __m512i k) {
    const __m512i zero = _mm512_setzero_si512(), one = _mm512_set1_epi32(1);
    __m512i w = zero, side = _mm512_set1_epi32(FHASH_BRICK), x = _mm512_slli_epi32(at.jx, 2);
    __m512i y = _mm512_slli_epi32(at.jy, 2), z = _mm512_slli_epi32(at.jz, 2);
    if (BY != BY_LARGEST) {
        const __m512i far = _mm512_mask_i32gather_epi32(one, away, at.brick, p.m.distance, 4);
        w = _mm512_slli_epi32(_mm512_sub_epi32(far, one), 2);
        if (BY == BY_CELLS) {
            // A brick that matters: over one cell of it.
            const __mmask16 cell = _mm512_testn_epi32_mask(far, far);
            w = _mm512_mask_mov_epi32(w, cell, zero);
            side = _mm512_mask_mov_epi32(side, cell, one);
            x = _mm512_mask_mov_epi32(x, cell, at.i);
            y = _mm512_mask_mov_epi32(y, cell, at.j);
            z = _mm512_mask_mov_epi32(z, cell, at.h);
        }
    }
    const __m512i across = _mm512_add_epi32(side, w), back = _mm512_sub_epi32(zero, w);
    const __m512 tx = behind(x, across, back, p.upx, p.ox, p.ix, p.farx);
    const __m512 ty = behind(y, across, back, p.upy, p.oy, p.iy, p.fary);
    const __m512 tz = behind(z, across, back, p.upz, p.oz, p.iz, p.farz);
    const __m512 nearest =
        _mm512_min_ps(_mm512_min_ps(_mm512_min_ps(tx, ty), tz), _mm512_set1_ps(1e9f));
    // Rather a sample short of the end than one beyond it.
    const __m512i leave =
        _mm512_cvttps_epi32(_mm512_mul_ps(nearest, _mm512_set1_ps(1 - 2e-6f)));
    return _mm512_add_epi32(_mm512_max_epi32(leave, k), one);
}

// `skip` by AVX-512. Rays with a sample to take wait a turn for those that leap over something, so
// that more rays are in a pass.
template <Leaps BY>
FHASH_WIDE int leap_wide(Packet& p, Counters& counted) {
    const FhashInput& m = p.m;
    const __m512i one = _mm512_set1_epi32(1), count = _mm512_load_si512(p.count);
    const __m512 previous = _mm512_load_ps(p.previous);
    const __mmask16 kept =
        m.surfaces > 0 ? _mm512_cmp_ps_mask(previous, previous, _CMP_ORD_Q) : 0;
    __m512i k = _mm512_load_si512(p.k);
    __mmask16 on = 0, quitting = 0, leapt = 0;
    for (int turn = 0;; turn++) {
        const __mmask16 going = _mm512_cmplt_epi32_mask(k, count);
        if (!going) {
            on = quitting = 0;
            break;
        }
        const Spots at = spots_of(p, k);
        __mmask16 away = invisible<BY>(p, at) & going;
        quitting = away & kept;
        away &= ~kept;
        on = going & ~away;
        if (!away || (on && turn > 0)) break;
        k = _mm512_mask_min_epi32(k, away, behind_invisible<BY>(p, at, away, k), count);
        leapt |= away;
        counted.skips += __builtin_popcount(away);
    }
    _mm512_store_si512(p.k, k);
    _mm512_store_si512(p.on, _mm512_maskz_mov_epi32(on, one));
    if (m.surfaces > 0) {
        _mm512_store_si512(p.quitting, _mm512_maskz_mov_epi32(quitting, one));
        if (leapt & ~_mm512_cmplt_epi32_mask(k, count)) {
            alignas(64) int passed[N];
            _mm512_store_si512(passed, _mm512_maskz_mov_epi32(leapt, one));
            p.part_ways(passed, counted);
            return (on ? 1 : 0) | 2;
        }
    }
    return on ? 3 : 0;
}

// The eight vertices around places, and the weights of those behind them.
struct Corners {
    __m512 fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3;
};
FHASH_WIDE Corners corners_at(const FhashInput& m, const float* values, __m512 x, __m512 y,
                              __m512 z) {
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const int sy = ly > 1 ? lx : 0, sz = lz > 1 ? lx * ly : 0;
    const __m512i i = _mm512_min_epi32(_mm512_cvttps_epi32(x), _mm512_set1_epi32(lx - 2));
    const __m512i j = _mm512_min_epi32(_mm512_cvttps_epi32(y), _mm512_set1_epi32(max(ly - 2, 0)));
    const __m512i h = _mm512_min_epi32(_mm512_cvttps_epi32(z), _mm512_set1_epi32(max(lz - 2, 0)));
    const __m512i row = _mm512_add_epi32(_mm512_mullo_epi32(h, _mm512_set1_epi32(ly)), j);
    const __m512i q = _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(lx)), i);
    Corners c;
    c.fx = _mm512_sub_ps(x, _mm512_cvtepi32_ps(i));
    c.fy = _mm512_sub_ps(y, _mm512_cvtepi32_ps(j));
    c.fz = _mm512_sub_ps(z, _mm512_cvtepi32_ps(h));
    pairs(values, q, c.a0, c.a1);
    pairs(values + sy, q, c.a2, c.a3);
    pairs(values + sz, q, c.b0, c.b1);
    pairs(values + sz + sy, q, c.b2, c.b3);
    return c;
}

// `sample` by AVX-512, and the colours.
template <Taken KIND> FHASH_WIDE void sample_wide(Packet& p, Counters& counted, Seen& seen) {
    const FhashInput& m = p.m;
    const __m512 zero = _mm512_setzero_ps();
    const __m512i k = _mm512_load_si512(p.k);
    const __m512i taking = _mm512_load_si512(p.on);
    const __mmask16 on = _mm512_test_epi32_mask(taking, taking);
    const __m512 f = _mm512_min_ps(_mm512_cvtepi32_ps(k), _mm512_load_ps(p.farthest));
    const __m512 x = place(p.ox, p.dx, f, p.low[0], p.high[0]);
    const __m512 y = place(p.oy, p.dy, f, p.low[1], p.high[1]);
    const __m512 z = place(p.oz, p.dz, f, p.low[2], p.high[2]);
    const auto [fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3] = corners_at(m, m.values, x, y, z);
    const __m512 d0 = _mm512_sub_ps(a1, a0), d1 = _mm512_sub_ps(a3, a2);
    const __m512 d2 = _mm512_sub_ps(b1, b0), d3 = _mm512_sub_ps(b3, b2);
    const __m512 p0 = _mm512_fmadd_ps(fx, d0, a0), p1 = _mm512_fmadd_ps(fx, d1, a2);
    const __m512 p2 = _mm512_fmadd_ps(fx, d2, b0), p3 = _mm512_fmadd_ps(fx, d3, b2);
    const __m512 s0 = between(p0, p1, fy), s1 = between(p2, p3, fy), here = between(s0, s1, fz);
    const __mmask16 known = _mm512_cmp_ps_mask(here, here, _CMP_ORD_Q);
    _mm512_store_ps(p.value, here);
    if (KIND == LARGEST) {
        const __m512 ranked = p.flags & MINIMUM ? _mm512_sub_ps(zero, here) : here;
        const __m512 best = _mm512_load_ps(p.best);
        const __mmask16 better = on & _mm512_cmp_ps_mask(ranked, best, _CMP_GT_OQ);
        _mm512_mask_store_ps(p.best, better, ranked);
        _mm512_mask_store_epi32(p.where, better, k);
    } else {
        __m512 e = _mm512_sub_ps(here, _mm512_set1_ps((float)m.low));
        e = _mm512_mul_ps(e, _mm512_set1_ps((float)m.scale));
        e = _mm512_min_ps(_mm512_max_ps(e, zero), _mm512_set1_ps((float)(m.entries - 1)));
        const __m512i t = _mm512_cvttps_epi32(e);
        const __m512 share = _mm512_sub_ps(e, _mm512_cvtepi32_ps(t));
        alignas(64) int places[N];
        _mm512_store_si512(places, _mm512_slli_epi32(t, 2));
        __m512 one[4], other[4];
        entries(m.table, places, one);
        entries(m.table + 4, places, other);
        const __m512 alpha = _mm512_maskz_mov_ps(on & known, between(one[3], other[3], share));
        _mm512_store_ps(p.at, e);
        _mm512_store_ps(p.alpha, alpha);
        _mm512_store_ps(p.cr, between(one[0], other[0], share));
        _mm512_store_ps(p.cg, between(one[1], other[1], share));
        _mm512_store_ps(p.cb, between(one[2], other[2], share));
        seen.any = _mm512_cmp_ps_mask(alpha, zero, _CMP_GT_OQ) != 0;
    }
    if (KIND == GRADIENTS) {
        const __m512 e0 = between(d0, d1, fy), e1 = between(d2, d3, fy);
        const __m512 ex = between(e0, e1, fz), ez = _mm512_sub_ps(s1, s0);
        const __m512 ey = between(_mm512_sub_ps(p1, p0), _mm512_sub_ps(p3, p2), fz);
        const __m512 wx = _mm512_set1_ps((float)m.gradient[0]);
        const __m512 wy = _mm512_set1_ps((float)m.gradient[1]);
        const __m512 wz = _mm512_set1_ps((float)m.gradient[2]);
        _mm512_store_ps(p.gx, _mm512_maskz_mul_ps(known, ex, wx));
        _mm512_store_ps(p.gy, _mm512_maskz_mul_ps(known, ey, wy));
        _mm512_store_ps(p.gz, _mm512_maskz_mul_ps(known, ez, wz));
    }
    _mm512_store_ps(p.px, x);
    _mm512_store_ps(p.py, y);
    _mm512_store_ps(p.pz, z);
    counted.samples += __builtin_popcount(on);
    seen.lost = (on & ~known) != 0;
    seen.ending = (on & _mm512_cmpeq_epi32_mask(k, _mm512_load_si512(p.last))) != 0;
}

// The trilinear values at places within the frame.
FHASH_WIDE __m512 values_at(const FhashInput& m, const float* values, __m512 x, __m512 y,
                            __m512 z) {
    const auto [fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3] = corners_at(m, values, x, y, z);
    const __m512 near = between(between(a0, a1, fx), between(a2, a3, fx), fy);
    return between(near, between(between(b0, b1, fx), between(b2, b3, fx), fy), fz);
}

// Store half of a difference, times a factor, where it is a number. Returns where it is none.
FHASH_WIDE __mmask16 slope(__m512 behind, __m512 before, double factor, float* to) {
    const __m512 half = _mm512_set1_ps(0.5f * (float)factor);
    const __m512 result = _mm512_mul_ps(_mm512_sub_ps(behind, before), half);
    const __mmask16 known = _mm512_cmp_ps_mask(result, result, _CMP_ORD_Q);
    _mm512_mask_store_ps(to, known, result);
    return ~known;
}

// `slopes` by AVX-512. Returns whether a difference that is needed is missing.
FHASH_WIDE int slopes_wide(Packet& p, const float* values) {
    const FhashInput& m = p.m;
    const __m512 zero = _mm512_setzero_ps(), one = _mm512_set1_ps(1.f);
    const __m512 mx = _mm512_set1_ps((float)(m.shape[2] - 1));
    const __m512 my = _mm512_set1_ps((float)(m.shape[1] - 1));
    const __m512 mz = _mm512_set1_ps((float)(m.shape[0] - 1));
    const __m512 alpha = _mm512_load_ps(p.alpha);
    const __m512 x = _mm512_load_ps(p.px), y = _mm512_load_ps(p.py), z = _mm512_load_ps(p.pz);
    const __m512 east = _mm512_min_ps(_mm512_add_ps(x, one), mx);
    const __m512 west = _mm512_max_ps(_mm512_sub_ps(x, one), zero);
    const __m512 north = _mm512_min_ps(_mm512_add_ps(y, one), my);
    const __m512 south = _mm512_max_ps(_mm512_sub_ps(y, one), zero);
    const __m512 above = _mm512_min_ps(_mm512_add_ps(z, one), mz);
    const __m512 below = _mm512_max_ps(_mm512_sub_ps(z, one), zero);
    const float* const v = values;
    __mmask16 lost =
        slope(values_at(m, v, east, y, z), values_at(m, v, west, y, z), m.gradient[0], p.gx);
    lost |= slope(values_at(m, v, x, north, z), values_at(m, v, x, south, z), m.gradient[1], p.gy);
    lost |= slope(values_at(m, v, x, y, above), values_at(m, v, x, y, below), m.gradient[2], p.gz);
    return (lost & _mm512_cmp_ps_mask(alpha, zero, _CMP_GT_OQ)) != 0;
}

}  // namespace
#endif
