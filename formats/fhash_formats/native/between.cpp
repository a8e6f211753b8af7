// Values between two steps of many vertices (between.hpp).
#include "loops.hpp"

#include "between.hpp"

#include <limits>

#include "core.hpp"

// frames: `n` values of the step before the two, of both, and of the step behind them; the outer
// ones may be null. distances: as in Beside. shares: how far the points are from the first step to
// the second, `count` of them, which repeat along the values. values: room for the values there.
// slopes: null, or room for their derivatives by the share.
FHASH_KERNEL std::int64_t fhash_between(const double* const* frames, const double* distances,
                                        std::int64_t n, const double* shares, std::int64_t count,
                                        double* values, double* slopes) {
    if (n < 0 || count < 1 || n % count) return -1;
    const fhash::Beside beside = {distances[0], distances[1]};
    const double none = std::numeric_limits<double>::quiet_NaN();
    for (std::int64_t row = 0; row < n; row += count)
        for (std::int64_t i = row; i < row + count; i++) {
            double slope;
            values[i] = fhash::value_between(shares[i - row], beside,
                                             frames[0] ? frames[0][i] : none, frames[1][i],
                                             frames[2][i], frames[3] ? frames[3][i] : none, slope);
            if (slopes) slopes[i] = slope;
        }
    return 0;
}
