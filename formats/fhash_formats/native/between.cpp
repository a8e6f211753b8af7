// Values between two steps, of one vertex and of many.
#include "between.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core.hpp"

namespace fhash {

namespace {

// The change from the first step to the second that the slope at one of them stands for. `rise` is
// the change itself, `other` that on the other side of the step, `distance` away. At an end of the
// series, and where the value on the other side is missing, the slope is that of the secant.
double slope_at(double rise, double other, double distance) {
    const double beside = other / distance;
    if (!(std::isfinite(beside) && std::isfinite(distance) && distance > 0)) return rise;
    if ((beside > 0) != (rise > 0) || beside == 0 || rise == 0) return 0;
    return (3 + 3 * distance) / ((2 + distance) / beside + (1 + 2 * distance) / rise);
}

}  // namespace

double value_between(double at, const Beside& beside, double before, double first, double second,
                     double behind, double& slope) {
    const double rise = second - first;
    const double left = slope_at(rise, first - before, beside.before) - rise;
    const double right = slope_at(rise, behind - second, beside.behind) - rise;
    const double rest = 1 - at, bend = left * rest - right * at;
    slope = rise + (rest - at) * bend - at * rest * (left + right);
    if (!std::isfinite(slope)) slope = rise;  // a difference overflows, or there is no value
    if (at <= 0) return first;
    if (at >= 1) return second;
    const double even = first * rest + second * at, value = even + at * rest * bend;
    // Without a bend: a sum with 0 has another sign of 0.
    if ((left == 0 && right == 0) || !std::isfinite(value)) return even;
    return std::clamp(value, std::min(first, second), std::max(first, second));
}

}  // namespace fhash

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
