// Values between two steps (FORMAT.md, Between steps): linear, or monotone cubic by the slopes of
// Fritsch and Butland, a harmonic mean of the slopes at both sides of a step.
#pragma once

namespace fhash {

// Distances from the step before the two to the first, and from the second to the step behind, in
// distances of the two; 0 where there is no such step.
struct Beside {
    double before = 0, behind = 0;
};

// The value at a share `at` of the way from `first` to `second`, and by `slope` its derivative by
// that share. `before` and `behind`: values of the steps beside them, NaN for none.
double value_between(double at, const Beside& beside, double before, double first, double second,
                     double behind, double& slope);

}  // namespace fhash
