// Interpolation of the coarse levels at the vertices of a brick, axis by axis, and its transpose.
//
// Rows of corners along x become rows of vertices first; then y, then z. From then on whole planes
// lie in a row, whatever the shape of a brick. A last vector of a row or plane writes beyond its
// end, where the next one is written later, or into FHASH_PAD numbers of padding.
#pragma once

#include "bricks.hpp"

#if defined(FHASH_VECTORS)

namespace {

// Two vectors of pairs: apart, the first numbers and the second ones; and back.
template <class P> struct Pairs {
    typedef typename P::F F;
    template <int... I> struct Places {};
    template <int COUNT, int... I> struct First : First<COUNT - 1, COUNT - 1, I...> {};
    template <int... I> struct First<0, I...> {
        typedef Places<I...> All;
    };
    typedef typename First<P::N>::All All;
    template <int... I>
    static void apart(F a, F b, F& first, F& second, Places<I...>) {
        first = __builtin_shufflevector(a, b, 2 * I...);
        second = __builtin_shufflevector(a, b, (2 * I + 1)...);
    }
    template <int... I>
    static void together(F first, F second, F& a, F& b, Places<I...>) {
        a = __builtin_shufflevector(first, second, (I / 2 + I % 2 * P::N)...);
        b = __builtin_shufflevector(first, second, (I / 2 + P::N / 2 + I % 2 * P::N)...);
    }
};

// Memory of an interpolation at one level.
struct Planes {
    float* corners;  // (embedding, corners x and room for more)
    float* x;        // (embedding, corners z, corners y, vertices x in whole groups)
    float* y;        // (embedding, corners z, vertices y, vertices x)
};

// One level of one brick: what its tables say for the brick's coordinates.
struct Place {
    const FhashBricks& b;
    const FhashLevel& l;
    std::int64_t size, nt, nz, ny, nx, groups, wide, plane, room;
    const std::int64_t* rows;
    const float *time, *weight_z, *weight_y, *spread, *gathered;
    const std::int32_t *first_z, *first_y, *reach;
    Place(const FhashBricks& bricks, const FhashLevel& level, const std::int32_t* brick,
          const std::int64_t* level_rows)
        : b(bricks), l(level), size(b.embedding), nz(l.corners[1]), ny(l.corners[2]),
          nx(l.corners[3]), groups(groups_of(b)), wide(groups * FHASH_GROUP),
          plane(b.shape[1] * b.shape[2]), room(nx + FHASH_REACH), rows(level_rows) {
        time = l.time + 2 * brick[0];
        nt = corners_in_time(l, brick[0]);
        first_z = l.first[0] + brick[1] * b.shape[0];
        first_y = l.first[1] + brick[2] * b.shape[1];
        weight_z = l.weight[0] + 2 * brick[1] * b.shape[0];
        weight_y = l.weight[1] + 2 * brick[2] * b.shape[1];
        const std::int64_t along_x = brick[3] * groups;
        reach = l.reach + 2 * along_x;
        spread = l.spread + along_x * FHASH_REACH * FHASH_GROUP;
        gathered = l.gathered + along_x * FHASH_GROUP * FHASH_REACH;
    }
};

// Write the numbers of a row of corners between two key frames, embedding by embedding.
template <class P> void corners_of(const Place& p, std::int64_t row, const float* flat,
                                                float* FHASH_RESTRICT to) {
    typedef typename P::F F;
    const float* from = flat + p.rows[row];
    const float* next = p.nt > 1 ? flat + p.rows[row + p.nz * p.ny] : from;
    const float w0 = p.nt > 1 ? p.time[0] : 1, w1 = p.nt > 1 ? p.time[1] : 0;
    if (p.size == 2) {
        const F v0 = all<P>(w0), v1 = all<P>(w1);
        for (std::int64_t x = 0; x < p.nx; x += P::N) {
            const float *a = from + 2 * x, *b = next + 2 * x;
            F low = v0 * loaded<P>(a) + v1 * loaded<P>(b), first;
            F high = v0 * loaded<P>(a + P::N) + v1 * loaded<P>(b + P::N), second;
            Pairs<P>::apart(low, high, first, second, typename Pairs<P>::All());
            store<P>(to + x, first);
            store<P>(to + p.room + x, second);
        }
        return;
    }
    for (std::int64_t e = 0; e < p.size; e++)
        for (std::int64_t x = 0; x < p.nx; x++)
            to[e * p.room + x] = w0 * from[x * p.size + e] + w1 * next[x * p.size + e];
}

// to[i] = w0 * a[i] + w1 * b[i]
template <class P> void mix(float* to, const float* a, const float* b, float w0,
                                         float w1, std::int64_t count) {
    const typename P::F v0 = all<P>(w0), v1 = all<P>(w1);
    for (std::int64_t i = 0; i < count; i += P::N)
        store<P>(to + i, v0 * loaded<P>(a + i) + v1 * loaded<P>(b + i));
}

// Write the embeddings of a level at a brick's vertices, in rows `row` numbers apart.
template <class P> void interpolate(const Place& p, const float* flat,
                                                 const Planes& m, float* to, std::int64_t row) {
    const FhashBricks& b = p.b;
    const std::int64_t lines = p.nz * p.ny;
    for (std::int64_t line = 0; line < lines; line++) {
        corners_of<P>(p, line, flat, m.corners);
        for (std::int64_t e = 0; e < p.size; e++)
            for (std::int64_t g = 0; g < p.groups; g++) {
                const float* from = m.corners + e * p.room + p.reach[2 * g];
                const float* w = p.spread + g * FHASH_REACH * FHASH_GROUP;
                typename P::F sum[FHASH_GROUP / P::N] = {};
                for (std::int64_t c = 0; c < p.reach[2 * g + 1]; c++) {
                    const typename P::F corner = all<P>(from[c]);
                    FHASH_UNROLLED for (int i = 0; i < FHASH_GROUP / P::N; i++)
                        sum[i] += corner * loaded<P>(w + c * FHASH_GROUP + i * P::N);
                }
                FHASH_UNROLLED for (int i = 0; i < FHASH_GROUP / P::N; i++)
                    store<P>(m.x + (e * lines + line) * p.wide + g * FHASH_GROUP + i * P::N,
                             sum[i]);
            }
    }
    for (std::int64_t ez = 0; ez < p.size * p.nz; ez++)
        for (std::int64_t y = 0; y < b.shape[1]; y++) {
            const float* from = m.x + (ez * p.ny + p.first_y[y]) * p.wide;
            const float* next = p.first_y[y] + 1 < p.ny ? from + p.wide : from;
            mix<P>(m.y + ez * p.plane + y * b.shape[2], from, next, p.weight_y[2 * y],
                   p.weight_y[2 * y + 1], b.shape[2]);
        }
    for (std::int64_t e = 0; e < p.size; e++)
        for (std::int64_t z = 0; z < b.shape[0]; z++) {
            const float* from = m.y + (e * p.nz + p.first_z[z]) * p.plane;
            const float* next = p.first_z[z] + 1 < p.nz ? from + p.plane : from;
            mix<P>(to + e * row + z * p.plane, from, next, p.weight_z[2 * z],
                   p.weight_z[2 * z + 1], p.plane);
        }
}

// Sum `lines` of `length` numbers, `apart` numbers apart, into corners: the transpose of `mix`
// along one axis. first, weight: the two corners of each line. Corners come `out_apart` numbers
// apart.
template <class P> void collect(float* to, std::int64_t corners,
                                             std::int64_t out_apart, const float* from,
                                             std::int64_t lines, std::int64_t apart,
                                             const std::int32_t* first, const float* weight,
                                             std::int64_t length) {
    std::int64_t begin = 0;
    for (std::int64_t c = 0; c < corners; c++) {
        while (begin < lines && first[begin] < c - 1) begin++;
        std::int64_t end = begin;
        while (end < lines && first[end] <= c) end++;
        constexpr int MANY = 4;  // vectors at a time
        std::int64_t i = 0;
        for (; i + MANY * P::N <= length; i += MANY * P::N) {
            typename P::F sum[MANY] = {};
            for (std::int64_t n = begin; n < end; n++) {
                const typename P::F w = all<P>(weight[2 * n + (first[n] < c)]);
                FHASH_UNROLLED for (int q = 0; q < MANY; q++)
                    sum[q] += w * loaded<P>(from + n * apart + i + q * P::N);
            }
            FHASH_UNROLLED for (int q = 0; q < MANY; q++)
                store<P>(to + c * out_apart + i + q * P::N, sum[q]);
        }
        for (; i < length; i += P::N) {
            typename P::F sum = {};
            for (std::int64_t n = begin; n < end; n++)
                sum += all<P>(weight[2 * n + (first[n] < c)]) * loaded<P>(from + n * apart + i);
            store<P>(to + c * out_apart + i, sum);
        }
    }
}

// Add the gradients by the numbers of a row of corners, given those by its vertices, to `to`.
template <class P> void add_corners(const Place& p, std::int64_t row,
                                                 const float* vertices, std::int64_t apart,
                                                 float* corners, float* FHASH_RESTRICT to) {
    const std::int64_t length = p.b.shape[2];
    const bool direct = p.groups == 1 && p.reach[1] == p.nx;  // one group writes all corners
    for (std::int64_t e = 0; e < p.size; e++) {
        float* own = corners + e * p.room;
        if (!direct) std::memset(own, 0, p.room * sizeof(float));
        for (std::int64_t g = 0; g < p.groups; g++) {
            const float* from = vertices + e * apart + g * FHASH_GROUP;
            const float* w = p.gathered + g * FHASH_GROUP * FHASH_REACH;
            const std::int64_t left = length - g * FHASH_GROUP;
            const std::int64_t count = left < FHASH_GROUP ? left : FHASH_GROUP;
            for (std::int64_t c = 0; c < p.reach[2 * g + 1]; c += P::N) {
                typename P::F sum[2] = {};
                std::int64_t x = 0;
                for (; x + 1 < count; x += 2) {
                    sum[0] += all<P>(from[x]) * loaded<P>(w + x * FHASH_REACH + c);
                    sum[1] += all<P>(from[x + 1]) * loaded<P>(w + (x + 1) * FHASH_REACH + c);
                }
                if (x < count) sum[0] += all<P>(from[x]) * loaded<P>(w + x * FHASH_REACH + c);
                float* at = own + p.reach[2 * g] + c;
                sum[0] += sum[1];
                store<P>(at, direct ? sum[0] : loaded<P>(at) + sum[0]);
            }
        }
    }
    for (std::int64_t t = 0; t < p.nt; t++) {
        const float share = p.nt > 1 ? p.time[t] : 1;
        float* at = to + p.rows[row + t * p.nz * p.ny];
        if (p.size == 2) {
            const typename P::F v = all<P>(share);
            // Behind the last corner there are zeros.
            for (std::int64_t x = 0; x < p.nx; x += P::N) {
                typename P::F low, high;
                Pairs<P>::together(loaded<P>(corners + x), loaded<P>(corners + p.room + x), low,
                                   high, typename Pairs<P>::All());
                store<P>(at + 2 * x, loaded<P>(at + 2 * x) + v * low);
                store<P>(at + 2 * x + P::N, loaded<P>(at + 2 * x + P::N) + v * high);
            }
            continue;
        }
        for (std::int64_t e = 0; e < p.size; e++)
            for (std::int64_t x = 0; x < p.nx; x++)
                at[x * p.size + e] += share * corners[e * p.room + x];
    }
}

// Add the gradients by the numbers of a level to `to`, given those by the embeddings at a brick's
// vertices, in rows `row` numbers apart.
template <class P> void add_transposed(const Place& p, const float* from,
                                                    std::int64_t row, const Planes& m, float* to) {
    const FhashBricks& b = p.b;
    const std::int64_t lines = p.nz * p.ny;
    for (std::int64_t e = 0; e < p.size; e++)
        collect<P>(m.y + e * p.nz * p.plane, p.nz, p.plane, from + e * row, b.shape[0], p.plane,
                   p.first_z, p.weight_z, p.plane);
    for (std::int64_t ez = 0; ez < p.size * p.nz; ez++)
        collect<P>(m.x + ez * p.ny * p.wide, p.ny, p.wide, m.y + ez * p.plane, b.shape[1],
                   b.shape[2], p.first_y, p.weight_y, b.shape[2]);
    for (std::int64_t line = 0; line < lines; line++)
        add_corners<P>(p, line, m.x + line * p.wide, lines * p.wide, m.corners, to);
}

}  // namespace

#endif  // FHASH_VECTORS
