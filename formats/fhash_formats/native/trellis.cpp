// Choice of the integers of dependent quantisation: the path through the trellis
// (coder_contexts.hpp) of least squared error and bits, by the algorithm of Viterbi. Encoders alone
// need it. choose.cpp searches by it. All costs are whole numbers.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "coder_contexts.hpp"
#include "functions.h"

namespace {

const int BUCKETS = 64;             // half octaves of the expected magnitude
const int RATES = 24;               // indices with a rate of their own; larger ones have the last
const int FIRST_BUCKET = 2 * (127 - 10);  // half octave that is bucket 1: 2^-10
const float COST = 32768;           // costs of a squared step
const int32_t UNREACHED = 1 << 29;  // cost of a state that no path has reached yet
const int RENEWED = 256;            // vertices after which the least cost is subtracted
const float NEAR_ZERO = 0.5f;       // magnitudes below it have no other candidate than zero

const float GUESSED_ZEROS[2] = {1.3f, 0.8f};  // magnitudes that are guessed to become zero
const float GUESS[2] = {0.45f, 0.95f};  // added to half of a magnitude before it is rounded down
const int STATES = 8;               // of the trellis; the quantiser is the lowest bit of a state

using Rates = int32_t[BUCKETS][RATES];  // of one quantiser

inline int64_t vertices_of(const std::vector<Band>& bands) {
    int64_t sum = 0;
    for (const Band& band : bands)
        sum += (int64_t)band.size[0] * band.size[1] * band.size[2] * band.size[3];
    return sum;
}

// Rows of all bands in the order of the coder.
struct Rows {
    const int64_t* shape;
    const std::vector<Band>& bands;

    // Call each(band, t, z, y, offset of the row in the tile, first number of its vertices).
    template <class Each> FHASH_INLINE void all(Each each) const {
        const int64_t S2 = shape[3], S1 = S2 * shape[2], S0 = S1 * shape[1];
        int64_t number = 0;
        for (const Band& band : bands)
            for (int t = 0; t < band.size[0]; t++)
                for (int z = 0; z < band.size[1]; z++)
                    for (int y = 0; y < band.size[2]; y++) {
                        const int64_t origin = (band.low[0] + t) * S0 + (band.low[1] + z) * S1 +
                                               (band.low[2] + y) * S2 + band.low[3];
                        each(band, t, z, y, origin, number);
                        number += band.size[3];
                    }
    }
};

// Integers of the path that was found before, by which the states go on.
struct Found {
    const int32_t* levels;
    int state;

    FHASH_INLINE int quantiser(int64_t) const { return state & 1; }
    FHASH_INLINE int32_t index(int64_t place, int quantiser) {
        const int32_t magnitude = (std::abs(levels[place]) + quantiser) / 2;
        state = TRELLIS_NEXT[state][magnitude & 1];
        return magnitude;
    }
};

// A guess where no path was found yet: quantisers in turn, and the index next to the coefficient or
// a smaller one.
template <class T> struct Guessed {
    const T* scaled;

    FHASH_INLINE int quantiser(int64_t number) const { return (int)(number & 1); }
    FHASH_INLINE int32_t index(int64_t place, int quantiser) const {
        const T magnitude = std::fabs(scaled[place]);
        if (magnitude < (quantiser ? (T)GUESSED_ZEROS[1] : (T)GUESSED_ZEROS[0])) return 0;
        return max((int32_t)(magnitude * (T)0.5 + (T)GUESS[quantiser]), 1);
    }
};

// Write the magnitudes of all indices into the bands, with flags of their rows.
// quantisers: receives the quantiser of each vertex.
template <class Source>
void fill_bands(Source source, const int64_t* shape, std::vector<Band>& bands,
                             uint8_t* quantisers) {
    for (Band& band : bands) {
        const int64_t rows = (int64_t)band.size[0] * band.size[1] * band.size[2];
        band.stride[2] = band.size[3] + 2 * PADDING;
        band.stride[1] = band.stride[2] * band.size[2];
        band.stride[0] = band.stride[1] * band.size[1];
        band.magnitudes.assign((size_t)(rows * band.stride[2]) + VECTOR, 0);
        band.filled.assign((size_t)rows, 0);
    }
    Rows{shape, bands}.all([&](const Band& of, int t, int z, int y, int64_t origin,
                               int64_t first) FHASH_LAMBDA {
        Band& band = const_cast<Band&>(of);
        const int64_t r = ((int64_t)t * band.size[1] + z) * band.size[2] + y;
        uint16_t* const out = band.magnitudes.data() + r * band.stride[2] + PADDING;
        int32_t any = 0;
        for (int x = 0; x < band.size[3]; x++) {
            const int quantiser = source.quantiser(first + x);
            const int32_t index = source.index(origin + x, quantiser);
            quantisers[first + x] = (uint8_t)quantiser;
            any |= index;
            out[x] = (uint16_t)min(index, MAX_MAGNITUDE);
        }
        band.filled[r] = any != 0;
        band.any |= any != 0;
    });
}

// The bucket of each vertex, by the weighted mean of the indices around it that a decoder knows.
void find_buckets(const int64_t* shape, const std::vector<Band>& bands,
                               uint8_t* buckets) {
    int widest = 0;
    for (const Band& band : bands) widest = max(widest, band.size[3]);
    std::vector<uint16_t> zeros((size_t)widest + 2 * PADDING + VECTOR, 0);
    const uint16_t* const nothing = zeros.data() + PADDING;
    Sums sums((size_t)widest + VECTOR);
    Rows{shape, bands}.all([&](const Band& band, int t, int z, int y, int64_t,
                               int64_t first) FHASH_LAMBDA {
        const int n = band.size[3];
        uint8_t* FHASH_RESTRICT const out = buckets + first;
        std::memset(out, 0, (size_t)n);
        if (!band.any) return;
        const int64_t r = ((int64_t)t * band.size[1] + z) * band.size[2] + y;
        const int64_t R1 = band.size[2], R0 = R1 * band.size[1];
        uint16_t* const M = const_cast<uint16_t*>(band.magnitudes.data()) + r * band.stride[2] +
                            PADDING;
        const uint8_t* const F = band.filled.data() + r;
        Row row = {t, z, y, M, F, {}, {}};
        const int parent_filled = find_references(bands, band, row);
        if (!(F[0] || (y > 0 && F[-1]) || (z > 0 && F[-R1]) || (t > 0 && F[-R0]) || parent_filled))
            return;
        const int lanes = (n + VECTOR - 1) / VECTOR * VECTOR;
        const Around around = rows_around(band, row, nothing);
        const int weight = around.weight + sum_references(bands, band, row, lanes, nothing, sums);
        sum_neighbours<false>(around, lanes, sums);
        const float scale = 1.0f / (float)weight;
        const int32_t* FHASH_RESTRICT const expected = sums.expected;
        FHASH_INDEPENDENT
        for (int x = 0; x < n; x++) {
            const int32_t sum = expected[x] + LEFT * M[x - 1] + LEFT2 * M[x - 2];
            const float mean = (float)sum * scale;
            int32_t bits;
            std::memcpy(&bits, &mean, 4);
            const int bucket = min(max((bits >> 22) - FIRST_BUCKET + 1, 1), BUCKETS - 1);
            out[x] = (uint8_t)(sum ? bucket : 0);
        }
    });
}

// Costs of the candidates of a vertex in one quantiser.
struct Candidates {
    int32_t even, odd;    // cost of the best index of even and of odd magnitude
    int32_t index[2];     // their magnitudes
};

// x: magnitude of the coefficient in steps. rates: of its bucket, RATES numbers.
template <class T>
FHASH_INLINE Candidates candidates(T x, int quantiser, const int32_t* rates) {
    const T shifted = x + (T)quantiser;
    const int32_t low = (int32_t)(shifted * (T)0.5), high = low + 1;
    const float above = (float)(shifted - (T)2 * (T)low), below = 2.0f - above;
    const float small = (float)x, error = low ? above : small;
    const int32_t at_low = (int32_t)(error * error * COST + 0.5f) + rates[min(low, RATES - 1)];
    const int32_t at_high = (int32_t)(below * below * COST + 0.5f) + rates[min(high, RATES - 1)];
    if (low & 1) {
        if (low == 1) {
            const int32_t zero = (int32_t)(small * small * COST + 0.5f) + rates[0];
            if (zero <= at_high) return {zero, at_low, {0, low}};
        }
        return {at_high, at_low, {high, low}};
    }
    return {at_low, at_high, {low, high}};
}

// Least costs of the paths to the eight states. `step` extends them by a vertex: even and odd are
// the costs of its indices in the two quantisers. It returns a bit for each state, 1 where the
// best path to it has an odd index here.
#if defined(FHASH_SSE2)
struct Paths {
    __m128i first, second;  // states 0 to 3, and 4 to 7

    explicit Paths(int32_t unreached)
        : first(_mm_setr_epi32(0, unreached, unreached, unreached)),
          second(_mm_set1_epi32(unreached)) {}
    // The states before states 0 to 3 and before 4 to 7 where an even index lies between them;
    // halves exchanged, the states where an odd one does.
    FHASH_INLINE void before(__m128i& low, __m128i& high) const {
        const __m128 a = _mm_castsi128_ps(first), b = _mm_castsi128_ps(second);
        low = _mm_castps_si128(_mm_shuffle_ps(a, b, _MM_SHUFFLE(2, 0, 2, 0)));
        high = _mm_castps_si128(_mm_shuffle_ps(a, b, _MM_SHUFFLE(3, 1, 3, 1)));
        high = _mm_shuffle_epi32(high, _MM_SHUFFLE(3, 1, 0, 2));
    }
    FHASH_INLINE static __m128i best(__m128i states, int32_t even, int32_t odd, int& bits) {
        const __m128i swapped = _mm_shuffle_epi32(states, _MM_SHUFFLE(1, 0, 3, 2));
        const __m128i by_even = _mm_add_epi32(states, _mm_set1_epi32(even));
        const __m128i by_odd = _mm_add_epi32(swapped, _mm_set1_epi32(odd));
        const __m128i takes_odd = _mm_cmpgt_epi32(by_even, by_odd);
        bits = _mm_movemask_ps(_mm_castsi128_ps(takes_odd));
        return _mm_or_si128(_mm_and_si128(takes_odd, by_odd), _mm_andnot_si128(takes_odd, by_even));
    }
    FHASH_INLINE uint8_t step(const int32_t even[2], const int32_t odd[2]) {
        __m128i low, high;
        before(low, high);
        int bits, more;
        first = best(low, even[0], odd[0], bits);
        second = best(high, even[1], odd[1], more);
        return (uint8_t)(bits | more << 4);
    }
    FHASH_INLINE void zero(int32_t even, int32_t other) {
        __m128i low, high;
        before(low, high);
        first = _mm_add_epi32(low, _mm_set1_epi32(even));
        second = _mm_add_epi32(high, _mm_set1_epi32(other));
    }
    FHASH_INLINE void get(int32_t* to) const {
        _mm_storeu_si128((__m128i*)to, first);
        _mm_storeu_si128((__m128i*)(to + 4), second);
    }
    FHASH_INLINE void set(const int32_t* from) {
        first = _mm_loadu_si128((const __m128i*)from);
        second = _mm_loadu_si128((const __m128i*)(from + 4));
    }
};
#else
struct Paths {
    int32_t cost[STATES];

    explicit Paths(int32_t unreached) {
        for (int i = 0; i < STATES; i++) cost[i] = i ? unreached : 0;
    }
    FHASH_INLINE uint8_t step(const int32_t even[2], const int32_t odd[2]) {
        int32_t by_even[STATES], by_odd[STATES];
        int bits = 0;
        for (int i = 0; i < STATES; i++) {
            by_even[TRELLIS_NEXT[i][0]] = cost[i] + even[i & 1];
            by_odd[TRELLIS_NEXT[i][1]] = cost[i] + odd[i & 1];
        }
        for (int i = 0; i < STATES; i++) {
            bits |= (by_even[i] > by_odd[i]) << i;
            cost[i] = min(by_even[i], by_odd[i]);
        }
        return (uint8_t)bits;
    }
    FHASH_INLINE void zero(int32_t even, int32_t other) {
        int32_t next[STATES];
        for (int i = 0; i < STATES; i++)
            next[TRELLIS_NEXT[i][0]] = cost[i] + (i & 1 ? other : even);
        set(next);
    }
    FHASH_INLINE void get(int32_t* to) const { std::memcpy(to, cost, sizeof cost); }
    FHASH_INLINE void set(const int32_t* from) { std::memcpy(cost, from, sizeof cost); }
};
#endif

// Subtract the least cost, so that costs stay in 32 bits.
void renew(Paths& paths) {
    int32_t cost[STATES], least = UNREACHED;
    paths.get(cost);
    for (int32_t c : cost) least = min(least, c);
    for (int32_t& c : cost) c = c - least > UNREACHED / 2 ? UNREACHED : c - least;
    paths.set(cost);
}

// Extend the paths by a row of n coefficients. choices: receives what `Paths::step` returns.
template <class T>
void extend(Paths& paths, const T* scaled, int n, const uint8_t* buckets,
                         const Rates* rates, uint8_t* choices) {
    for (int begin = 0; begin < n; begin += RENEWED) {
        const int end = min(begin + RENEWED, n);
        for (int x = begin; x < end; x++) {
            const int32_t *const r0 = rates[0][buckets[x]], *const r1 = rates[1][buckets[x]];
            const T magnitude = std::fabs(scaled[x]);
            if (magnitude < (T)NEAR_ZERO) {
                paths.zero(r0[0], r1[0]);
                choices[x] = 0;
                continue;
            }
            const Candidates a = candidates(magnitude, 0, r0), b = candidates(magnitude, 1, r1);
            const int32_t even[2] = {a.even, b.even}, odd[2] = {a.odd, b.odd};
            choices[x] = paths.step(even, odd);
        }
        renew(paths);
    }
}

// The state before a state, where an index of this parity lies between them.
struct Backwards {
    uint8_t state[STATES][2];
    Backwards() {
        for (int i = 0; i < STATES; i++)
            for (int odd = 0; odd < 2; odd++) state[TRELLIS_NEXT[i][odd]][odd] = (uint8_t)i;
    }
};
const Backwards backwards;

// The levels of the best path. choices: of all vertices, as `extend` wrote them.
template <class T>
void trace(const Paths& paths, const T* scaled, const int64_t* shape,
                        const std::vector<Band>& bands, const uint8_t* buckets,
                        const Rates* rates, const uint8_t* choices, int32_t* levels) {
    int32_t cost[STATES];
    paths.get(cost);
    int state = 0;
    for (int i = 1; i < STATES; i++)
        if (cost[i] < cost[state]) state = i;
    struct Start {
        int64_t origin, first;
        int length;
    };
    std::vector<Start> rows;
    Rows{shape, bands}.all([&](const Band& band, int, int, int, int64_t origin, int64_t first) {
        rows.push_back({origin, first, band.size[3]});
    });
    for (auto row = rows.rbegin(); row != rows.rend(); ++row)
        for (int x = row->length - 1; x >= 0; x--) {
            const int64_t number = row->first + x, place = row->origin + x;
            const int odd = choices[number] >> state & 1;
            state = backwards.state[state][odd];
            const T value = scaled[place], magnitude = std::fabs(value);
            if (magnitude < (T)NEAR_ZERO) continue;
            const int quantiser = state & 1;
            const int32_t* const of = rates[quantiser][buckets[number]];
            const int32_t index = candidates(magnitude, quantiser, of).index[odd];
            const int32_t level = index ? 2 * index - quantiser : 0;
            levels[place] = value < 0 ? -level : level;
        }
}

template <class T>
int64_t choose(const T* scaled, const int64_t* shape, const int32_t* table,
                            int64_t count, const uint8_t* buckets, const int32_t* numbers,
                            int32_t* levels) {
    std::vector<Band> bands((size_t)count);
    if (!read_bands(table, shape, bands)) return -1;
    const Rates* const rates = reinterpret_cast<const Rates*>(numbers);
    std::vector<uint8_t> choices((size_t)vertices_of(bands));
    Paths paths(UNREACHED);
    Rows{shape, bands}.all([&](const Band& band, int, int, int, int64_t origin,
                               int64_t first) FHASH_LAMBDA {
        extend(paths, scaled + origin, band.size[3], buckets + first, rates,
               choices.data() + first);
    });
    trace(paths, scaled, shape, bands, buckets, rates, choices.data(), levels);
    return 0;
}

// Find the buckets and count the indices of a source.
template <class Source>
int64_t tally(Source source, const int64_t* shape, const int32_t* table, int64_t count,
                           uint8_t* buckets, int64_t* counts) {
    std::vector<Band> bands((size_t)count);
    if (!read_bands(table, shape, bands)) return -1;
    std::vector<uint8_t> quantisers((size_t)vertices_of(bands));
    fill_bands(source, shape, bands, quantisers.data());
    find_buckets(shape, bands, buckets);
    Rows{shape, bands}.all([&](const Band& band, int t, int z, int y, int64_t,
                               int64_t first) FHASH_LAMBDA {
        const int64_t r = ((int64_t)t * band.size[1] + z) * band.size[2] + y;
        const uint16_t* const M = band.magnitudes.data() + r * band.stride[2] + PADDING;
        for (int x = 0; x < band.size[3]; x++) {
            const int64_t number = first + x;
            const int index = min<int>(M[x], RATES - 1);
            counts[(quantisers[number] * BUCKETS + buckets[number]) * RATES + index]++;
        }
    });
    return 0;
}

}  // namespace

// Find the bucket of each vertex in the bands of a table, in coded order, and count the indices.
//
// levels: integers of the path that was found before (t, z, y, x).
// buckets: receives one byte for each vertex of the bands.
// counts: zeros (2, BUCKETS, RATES); receives the numbers by quantiser, bucket and index.
//
// Returns 0, or -1 for a band beyond the shape, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_trellis_count,
                  (const int32_t* levels, const int64_t* shape, const int32_t* table,
                   int64_t count, uint8_t* buckets, int64_t* counts),
                  (levels, shape, table, count, buckets, counts)) {
    return guarded([&] { return tally(Found{levels, 0}, shape, table, count, buckets, counts); });
}

// The same for a guess of the indices. scaled: coefficients / step, magnitudes below 2^30.
FHASH_FOR_TARGETS(fhash_trellis_guess_f32,
                  (const float* scaled, const int64_t* shape, const int32_t* table, int64_t count,
                   uint8_t* buckets, int64_t* counts),
                  (scaled, shape, table, count, buckets, counts)) {
    return guarded([&] {
        return tally(Guessed<float>{scaled}, shape, table, count, buckets, counts);
    });
}
FHASH_FOR_TARGETS(fhash_trellis_guess_f64,
                  (const double* scaled, const int64_t* shape, const int32_t* table,
                   int64_t count, uint8_t* buckets, int64_t* counts),
                  (scaled, shape, table, count, buckets, counts)) {
    return guarded([&] {
        return tally(Guessed<double>{scaled}, shape, table, count, buckets, counts);
    });
}

// Choose the levels of the cheapest path.
//
// scaled: coefficients / step (t, z, y, x), magnitudes below 2^30.
// buckets: of fhash_trellis_count.
// rates: (2, BUCKETS, RATES), cost of an index by quantiser, bucket and index, up to 2^19.
// levels: zeros (t, z, y, x); receives the levels.
//
// Returns 0, or -1 for a band beyond the shape, or NO_MEMORY.
FHASH_FOR_TARGETS(fhash_trellis_choose_f32,
                  (const float* scaled, const int64_t* shape, const int32_t* table, int64_t count,
                   const uint8_t* buckets, const int32_t* rates, int32_t* levels),
                  (scaled, shape, table, count, buckets, rates, levels)) {
    return guarded([&] { return choose(scaled, shape, table, count, buckets, rates, levels); });
}
FHASH_FOR_TARGETS(fhash_trellis_choose_f64,
                  (const double* scaled, const int64_t* shape, const int32_t* table,
                   int64_t count, const uint8_t* buckets, const int32_t* rates, int32_t* levels),
                  (scaled, shape, table, count, buckets, rates, levels)) {
    return guarded([&] { return choose(scaled, shape, table, count, buckets, rates, levels); });
}
