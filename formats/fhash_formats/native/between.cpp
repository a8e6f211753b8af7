#include "loops.hpp"

#include "between.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core.hpp"
#include "functions.h"

namespace fhash {

namespace {

constexpr int64_t BLOCK = 256;  // values that are worked on together

// A block of values, each of the arrays `n` long; `before`, `behind` and `slopes` may be null.
struct Block {
    const double *before, *first, *second, *behind, *shares;
    double *values, *slopes;
    int64_t n;
};

FHASH_INLINE bool finite(double value) {
    return std::fabs(value) <= std::numeric_limits<double>::max();
}

// By how much the slope at a step is above that of the secant between the two steps, from `first`
// to `second`. On the other side of the step the change is from `one` to `two`, `distance` long.
void bends_at(const Block& block, const double* one, const double* two, double distance,
              double* FHASH_RESTRICT out) {
    const double *first = block.first, *second = block.second;
    const double own = 1 + 2 * distance, others = 2 + distance;
    for (int64_t i = 0; i < block.n; i++) {
        const double rise = second[i] - first[i], beside = (two[i] - one[i]) / distance;
        const double mean = (3 + 3 * distance) / (others / beside + own / rise);
        const double slope = beside * rise > 0 ? mean : 0.0;
        out[i] = finite(beside) ? slope - rise : 0.0;  // no value there: the slope is the secant's
    }
}

void work(const Block& block, const Beside& beside) {
    double left[BLOCK] = {}, right[BLOCK] = {};
    for (int side = 0; side < 2; side++) {
        const double* const one = side ? block.second : block.before;
        const double* const two = side ? block.behind : block.first;
        const double distance = side ? beside.behind : beside.before;
        if (one && two) bends_at(block, one, two, distance, side ? right : left);
    }
    const double *first = block.first, *second = block.second, *shares = block.shares;
    double* const slopes = block.slopes;
    const int64_t sloped = slopes ? block.n : 0;
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < sloped; i++) {
        const double at = shares[i], rest = 1 - at, rise = second[i] - first[i];
        const double bend = left[i] * rest - right[i] * at;
        const double slope = rise + (rest - at) * bend - at * rest * (left[i] + right[i]);
        slopes[i] = finite(slope) ? slope : rise;
    }
    double* const values = block.values;
    FHASH_INDEPENDENT
    for (int64_t i = 0; i < block.n; i++) {
        const double at = shares[i], rest = 1 - at;
        const double even = first[i] * rest + second[i] * at;
        const double value = even + at * rest * (left[i] * rest - right[i] * at);
        const double low = std::min(first[i], second[i]), high = std::max(first[i], second[i]);
        const double clipped = std::min(std::max(value, low), high);
        const double between = finite(value) ? clipped : even;  // a difference may overflow
        const double upper = at >= 1 ? second[i] : between;
        values[i] = at <= 0 ? first[i] : upper;
    }
}

}  // namespace

void values_between(const double* const* frames, const Beside& beside, int64_t n,
                    const double* shares, bool alone, double* values, double* slopes) {
    double own[BLOCK];
    // Two times may be equal in float64, once they are near 1.
    const bool held[2] = {frames[0] && beside.before > 0 && finite(beside.before),
                          frames[3] && beside.behind > 0 && finite(beside.behind)};
    if (alone) std::fill_n(own, BLOCK, *shares);
    for (int64_t start = 0; start < n; start += BLOCK) {
        const int64_t size = std::min(BLOCK, n - start);
        work({held[0] ? frames[0] + start : nullptr, frames[1] + start, frames[2] + start,
              held[1] ? frames[3] + start : nullptr, alone ? own : shares + start,
              values + start, slopes ? slopes + start : nullptr, size}, beside);
    }
}

}  // namespace fhash

// values_between for Python.
FHASH_KERNEL std::int64_t fhash_between(const double* const* frames, const double* distances,
                                        std::int64_t n, const double* shares, std::int64_t alone,
                                        double* values, double* slopes) {
    fhash::values_between(frames, {distances[0], distances[1]}, n, shares, alone, values, slopes);
    return 0;
}
