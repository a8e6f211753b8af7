// Samples of the rays of a packet by AVX-512.
#pragma once

#include "march_packet.hpp"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define FHASH_AVX512 __attribute__((target("arch=x86-64-v4,tune=icelake-server,prefer-vector-width=512")))
#pragma GCC diagnostic ignored "-Wuninitialized"  // by the header of GCC 12 itself
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>

namespace {

// a + share * (b - a)
FHASH_AVX512 inline __attribute__((always_inline)) __m512 between(__m512 a, __m512 b, __m512 share) {
    return _mm512_fmadd_ps(share, _mm512_sub_ps(b, a), a);
}

// A place along an axis, clamped to 0..most; what is not a number becomes 0.
FHASH_AVX512 inline __attribute__((always_inline)) __m512 place(const float* origin, const float* step, __m512 sample, __m512 most) {
    const __m512 at = _mm512_add_ps(_mm512_load_ps(origin), _mm512_mul_ps(sample, _mm512_load_ps(step)));
    return _mm512_min_ps(_mm512_max_ps(at, _mm512_setzero_ps()), most);
}

// The samples at which rays leave what begins at `first`, or `back` before it, and ends `across` behind.
FHASH_AVX512 inline __attribute__((always_inline)) __m512 behind(__m512i first, __m512i across, __m512i back, const int* up,
                                                                 const float* origin, const float* inverse, const float* far) {
    const __m512i rising = _mm512_load_si512(up);
    const __m512i end = _mm512_add_epi32(first, _mm512_mask_mov_epi32(back, _mm512_test_epi32_mask(rising, rising), across));
    const __m512 away = _mm512_sub_ps(_mm512_cvtepi32_ps(end), _mm512_load_ps(origin));
    return _mm512_add_ps(_mm512_mul_ps(away, _mm512_load_ps(inverse)), _mm512_load_ps(far));
}

// The values of 16 vertices and of those behind them along x. A load for both: gathering counts loads, not bytes.
FHASH_AVX512 inline __attribute__((always_inline)) void pairs(const float* v, __m512i q, __m512& first, __m512& second) {
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(q), v, 4));
    const __m512 high = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(q, 1), v, 4));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    first = _mm512_permutex2var_ps(low, even, high);
    second = _mm512_permutex2var_ps(low, _mm512_add_epi32(even, _mm512_set1_epi32(1)), high);
}

// The entries of 16 lanes, four floats each, as four vectors.
FHASH_AVX512 inline __attribute__((always_inline)) void entries(const float* table, const int* t, __m512 (&out)[4]) {
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

// As `leap`. Rays with a sample to take wait a turn for those that pass over something, so that more are in a packet.
template <int WANTED, bool CELLS> FHASH_AVX512 __attribute__((noinline)) int leap_wide(Packet<WANTED>& p, Counters& counted) {
    const FhashMarch& m = p.m;
    const int bx = (int)m.bricks[2], by = (int)m.bricks[1], lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const __m512 mx = _mm512_set1_ps((float)(lx - 1)), my = _mm512_set1_ps((float)(ly - 1)), mz = _mm512_set1_ps((float)(lz - 1));
    const __m512i cx = _mm512_set1_epi32(lx - 2), cy = _mm512_set1_epi32(max(ly - 2, 0)), cz = _mm512_set1_epi32(max(lz - 2, 0));
    const __m512i zero = _mm512_setzero_si512(), one = _mm512_set1_epi32(1), side = _mm512_set1_epi32(FHASH_BRICK);
    const __m512i three = _mm512_set1_epi32(3), count = _mm512_load_si512(p.count);
    const __mmask16 kept = m.surfaces > 0 ? _mm512_cmp_ps_mask(_mm512_load_ps(p.previous), _mm512_load_ps(p.previous), _CMP_ORD_Q) : 0;
    __m512i k = _mm512_load_si512(p.k);
    __mmask16 on = 0, quitting = 0, leapt = 0;
    for (int turn = 0;; turn++) {
        const __mmask16 going = _mm512_cmplt_epi32_mask(k, count);
        if (!going) {
            on = quitting = 0;
            break;
        }
        const __m512 f = _mm512_cvtepi32_ps(k);
        const __m512i i = _mm512_min_epi32(_mm512_cvttps_epi32(place(p.ox, p.dx, f, mx)), cx);
        const __m512i j = _mm512_min_epi32(_mm512_cvttps_epi32(place(p.oy, p.dy, f, my)), cy);
        const __m512i h = _mm512_min_epi32(_mm512_cvttps_epi32(place(p.oz, p.dz, f, mz)), cz);
        const __m512i jx = _mm512_srai_epi32(i, 2), jy = _mm512_srai_epi32(j, 2), jz = _mm512_srai_epi32(h, 2);
        const __m512i row = _mm512_add_epi32(_mm512_mullo_epi32(jz, _mm512_set1_epi32(by)), jy);
        const __m512i q = _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(bx)), jx);
        __mmask16 away;
        if (WANTED & MAXIMUM) {
            away = ~_mm512_cmp_ps_mask(_mm512_i32gather_ps(q, m.highest, 4), _mm512_load_ps(p.best), _CMP_GT_OQ);
        } else if (CELLS) {
            const __m512i half = _mm512_and_si512(_mm512_srai_epi32(h, 1), one);
            const __m512i bits = _mm512_i32gather_epi32(_mm512_add_epi32(_mm512_slli_epi32(q, 1), half), m.cells, 4);
            const __m512i within = _mm512_or_si512(_mm512_slli_epi32(_mm512_and_si512(h, one), 4),
                _mm512_or_si512(_mm512_slli_epi32(_mm512_and_si512(j, three), 2), _mm512_and_si512(i, three)));
            away = _mm512_testn_epi32_mask(_mm512_srlv_epi32(bits, within), one);
        } else {
            const __m512i far = _mm512_i32gather_epi32(q, m.distance, 4);
            away = _mm512_test_epi32_mask(far, far);
        }
        away &= going;
        quitting = away & kept;
        away &= ~kept;
        on = going & ~away;
        if (!away || (on && turn > 0)) break;
        __m512i w = zero, low = side, x = _mm512_slli_epi32(jx, 2), y = _mm512_slli_epi32(jy, 2), z = _mm512_slli_epi32(jz, 2);
        if (!(WANTED & MAXIMUM)) {
            const __m512i far = _mm512_mask_i32gather_epi32(one, away, q, m.distance, 4);
            const __mmask16 cell = CELLS ? _mm512_testn_epi32_mask(far, far) : 0;  // within a brick that matters, over one cell
            w = _mm512_slli_epi32(_mm512_sub_epi32(far, one), 2);
            if (CELLS) {
                w = _mm512_mask_mov_epi32(w, cell, zero);
                low = _mm512_mask_mov_epi32(low, cell, one);
                x = _mm512_mask_mov_epi32(x, cell, i);
                y = _mm512_mask_mov_epi32(y, cell, j);
                z = _mm512_mask_mov_epi32(z, cell, h);
            }
        }
        // The ends of what is passed over: the cell, or the bricks up to w around this one.
        const __m512i across = _mm512_add_epi32(low, w), back = _mm512_sub_epi32(zero, w);
        const __m512 tx = behind(x, across, back, p.upx, p.ox, p.ix, p.farx), ty = behind(y, across, back, p.upy, p.oy, p.iy, p.fary);
        const __m512 tz = behind(z, across, back, p.upz, p.oz, p.iz, p.farz);
        const __m512 least = _mm512_min_ps(_mm512_min_ps(_mm512_min_ps(tx, ty), tz), _mm512_set1_ps(1e9f));
        // Rather a sample short of the end than one beyond it.
        const __m512i leave = _mm512_cvttps_epi32(_mm512_mul_ps(least, _mm512_set1_ps(1 - 2e-6f)));
        const __m512i next = _mm512_add_epi32(_mm512_max_epi32(leave, k), one);
        k = _mm512_mask_min_epi32(k, away, next, count);
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

// The eight vertices around places, and the shares of those behind them.
struct Corners {
    __m512 fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3;
};
FHASH_AVX512 inline __attribute__((always_inline)) Corners corners_at(const FhashMarch& m, __m512 x, __m512 y, __m512 z) {
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
    pairs(m.values, q, c.a0, c.a1);
    pairs(m.values + sy, q, c.a2, c.a3);
    pairs(m.values + sz, q, c.b0, c.b1);
    pairs(m.values + sz + sy, q, c.b2, c.b3);
    return c;
}

// As `sample`, and the colours.
template <int WANTED> FHASH_AVX512 __attribute__((noinline))
void sample_wide(Packet<WANTED>& p, Counters& counted, int& seen, int& ending, int& lost) {
    const FhashMarch& m = p.m;
    const int lx = (int)m.shape[2], ly = (int)m.shape[1], lz = (int)m.shape[0];
    const __m512 zero = _mm512_setzero_ps();
    const __m512i k = _mm512_load_si512(p.k);
    const __mmask16 on = _mm512_test_epi32_mask(_mm512_load_si512(p.on), _mm512_load_si512(p.on));
    const __m512 f = _mm512_cvtepi32_ps(k);
    const __m512 x = place(p.ox, p.dx, f, _mm512_set1_ps((float)(lx - 1))), y = place(p.oy, p.dy, f, _mm512_set1_ps((float)(ly - 1)));
    const __m512 z = place(p.oz, p.dz, f, _mm512_set1_ps((float)(lz - 1)));
    const auto [fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3] = corners_at(m, x, y, z);
    const __m512 d0 = _mm512_sub_ps(a1, a0), d1 = _mm512_sub_ps(a3, a2), d2 = _mm512_sub_ps(b1, b0), d3 = _mm512_sub_ps(b3, b2);
    const __m512 p0 = _mm512_fmadd_ps(fx, d0, a0), p1 = _mm512_fmadd_ps(fx, d1, a2);
    const __m512 p2 = _mm512_fmadd_ps(fx, d2, b0), p3 = _mm512_fmadd_ps(fx, d3, b2);
    const __m512 s0 = between(p0, p1, fy), s1 = between(p2, p3, fy), found = between(s0, s1, fz);
    const __mmask16 known = _mm512_cmp_ps_mask(found, found, _CMP_ORD_Q);
    _mm512_store_ps(p.value, found);
    if (WANTED & MAXIMUM) {
        const __mmask16 better = on & _mm512_cmp_ps_mask(found, _mm512_load_ps(p.best), _CMP_GT_OQ);
        _mm512_mask_store_ps(p.best, better, found);
        _mm512_mask_store_epi32(p.where, better, k);
    } else {
        __m512 e = _mm512_mul_ps(_mm512_sub_ps(found, _mm512_set1_ps((float)m.low)), _mm512_set1_ps((float)m.scale));
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
        seen = _mm512_cmp_ps_mask(alpha, zero, _CMP_GT_OQ) != 0;
    }
    if (WANTED & SHADED) {
        const __m512 e0 = between(d0, d1, fy), e1 = between(d2, d3, fy);
        const __m512 ey = between(_mm512_sub_ps(p1, p0), _mm512_sub_ps(p3, p2), fz);
        _mm512_store_ps(p.gx, _mm512_maskz_mul_ps(known, between(e0, e1, fz), _mm512_set1_ps((float)m.gradient[0])));
        _mm512_store_ps(p.gy, _mm512_maskz_mul_ps(known, ey, _mm512_set1_ps((float)m.gradient[1])));
        _mm512_store_ps(p.gz, _mm512_maskz_mul_ps(known, _mm512_sub_ps(s1, s0), _mm512_set1_ps((float)m.gradient[2])));
    }
    _mm512_store_ps(p.px, x);
    _mm512_store_ps(p.py, y);
    _mm512_store_ps(p.pz, z);
    counted.samples += __builtin_popcount(on);
    lost = (on & ~known) != 0;
    ending = (on & _mm512_cmpeq_epi32_mask(k, _mm512_load_si512(p.last))) != 0;
}

// Trilinear at places of the frame.
FHASH_AVX512 inline __attribute__((always_inline)) __m512 values_at(const FhashMarch& m, __m512 x, __m512 y, __m512 z) {
    const auto [fx, fy, fz, a0, a1, a2, a3, b0, b1, b2, b3] = corners_at(m, x, y, z);
    const __m512 near = between(between(a0, a1, fx), between(a2, a3, fx), fy);
    return between(near, between(between(b0, b1, fx), between(b2, b3, fx), fy), fz);
}

// Half a difference, where it is known: which are not.
FHASH_AVX512 inline __attribute__((always_inline)) __mmask16 slope(__m512 behind, __m512 before, double factor, float* to) {
    const __m512 found = _mm512_mul_ps(_mm512_sub_ps(behind, before), _mm512_set1_ps(0.5f * (float)factor));
    const __mmask16 known = _mm512_cmp_ps_mask(found, found, _CMP_ORD_Q);
    _mm512_mask_store_ps(to, known, found);
    return ~known;
}

// As `slopes`: whether any is not known.
template <int WANTED> FHASH_AVX512 __attribute__((noinline)) int slopes_wide(Packet<WANTED>& p) {
    const FhashMarch& m = p.m;
    const __m512 mx = _mm512_set1_ps((float)(m.shape[2] - 1)), my = _mm512_set1_ps((float)(m.shape[1] - 1));
    const __m512 mz = _mm512_set1_ps((float)(m.shape[0] - 1)), zero = _mm512_setzero_ps(), one = _mm512_set1_ps(1.f);
    const __m512 alpha = _mm512_load_ps(p.alpha), x = _mm512_load_ps(p.px), y = _mm512_load_ps(p.py), z = _mm512_load_ps(p.pz);
    const __m512 east = _mm512_min_ps(_mm512_add_ps(x, one), mx), west = _mm512_max_ps(_mm512_sub_ps(x, one), zero);
    const __m512 north = _mm512_min_ps(_mm512_add_ps(y, one), my), south = _mm512_max_ps(_mm512_sub_ps(y, one), zero);
    const __m512 above = _mm512_min_ps(_mm512_add_ps(z, one), mz), below = _mm512_max_ps(_mm512_sub_ps(z, one), zero);
    __mmask16 lost = slope(values_at(m, east, y, z), values_at(m, west, y, z), m.gradient[0], p.gx);
    lost |= slope(values_at(m, x, north, z), values_at(m, x, south, z), m.gradient[1], p.gy);
    lost |= slope(values_at(m, x, y, above), values_at(m, x, y, below), m.gradient[2], p.gz);
    return (lost & _mm512_cmp_ps_mask(alpha, zero, _CMP_GT_OQ)) != 0;
}

}  // namespace
#endif
