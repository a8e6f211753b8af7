// Values between two steps (FORMAT.md, Between steps): linear, or monotone cubic by the slopes of
// Fritsch and Butland, a harmonic mean of the slopes at both sides of a step.
#pragma once

#include <cstdint>

namespace fhash {

// Distances from the step before the two to the first, and from the second to the step behind, in
// distances of the two; 0 where there is no such step.
struct Beside {
    double before = 0, behind = 0;
};

// frames: `n` values of the step before the two, of both, and of the step behind them. The outer
// ones may be null, or NaN; without both the values are linear.
// shares: how far each point is from the first step to the second, 0 to 1; `alone`: one for all.
// values, slopes: room for the values there, and null or room for their derivatives by the share.
void values_between(const double* const* frames, const Beside& beside, int64_t n,
                    const double* shares, bool alone, double* values, double* slopes);

}  // namespace fhash
