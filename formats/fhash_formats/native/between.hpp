// Values between two steps (FORMAT.md, Between steps): linear, or monotone cubic by the slopes of
// Fritsch and Butland, a harmonic mean of the slopes at both sides of a step.
#pragma once

#include <algorithm>
#include <cmath>

namespace fhash {

// Distances from the step before the two to the first, and from the second to the step behind, in
// distances of the two; 0 where there is no such step.
struct Beside {
    double before = 0, behind = 0;
};

// The change from the first step to the second that the slope at one of them stands for. `rise` is
// the change itself, `other` that on the other side of the step, `distance` away. At an end of the
// series, and where the value on the other side is missing, the slope is that of the secant.
inline double slope_at(double rise, double other, double distance) {
    const double beside = other / distance;
    if (!(std::isfinite(beside) && std::isfinite(distance) && distance > 0)) return rise;
    if ((beside > 0) != (rise > 0) || beside == 0 || rise == 0) return 0;
    return (3 + 3 * distance) / ((2 + distance) / beside + (1 + 2 * distance) / rise);
}

// The value at a share `at` of the way from `first` to `second`, and by `slope` its derivative by
// that share. `before` and `behind`: values of the steps beside them, NaN for none.
inline double value_between(double at, const Beside& beside, double before, double first,
                            double second, double behind, double& slope) {
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
