// Adam's steps without a gradient in closed form: paper/engines/parameters.py has the formulas.
#pragma once

#include "bricks.hpp"

namespace {

// Sum the missed steps after the last step with a gradient, for all that it may be, up to step
// `step`. With r = b1 / sqrt(b2) the sum over j = v + 1 .. step of r^(j - v) weight[j] is r times
// (weight[v + 1] + the same sum for v + 1). Sums over more than WINDOW steps stay as they were.
inline void sweep(const FhashGaps& g, std::int64_t step) {
    const double ratio = BETA1 / std::sqrt(BETA2);
    g.weight_sum[step] = g.inverse_sum[step] = 0;
    g.factor[step] = 0, g.epsilon[step] = (float)EPSILON;
    const std::int64_t last = step > WINDOW ? step - WINDOW : 1;
    for (std::int64_t v = step - 1; v >= last; v--) {
        g.weight_sum[v] = ratio * (g.weight[v + 1] + g.weight_sum[v + 1]);
        g.inverse_sum[v] = BETA1 * (g.inverse[v + 1] + g.inverse_sum[v + 1]);
        const double share = g.inverse_sum[v] > 0 ? g.weight_sum[v] / g.inverse_sum[v] : 1.0;
        g.factor[v] = (float)g.weight_sum[v];
        g.epsilon[v] = (float)(EPSILON * share);
    }
}

// Effect of missed steps on numbers.
struct Gap {
    float factor, epsilon, mean_decay, square_decay;
    // After step `visited`, the last with a gradient, up to step `step`.
    Gap(const FhashGaps& g, std::int64_t visited, std::int64_t step) {
        const bool missed = visited > 0 && visited < step;
        factor = missed ? g.factor[visited] : 0;
        epsilon = missed ? g.epsilon[visited] : (float)EPSILON;
        mean_decay = missed ? g.mean_decay[step - visited] : 1;
        square_decay = missed ? g.square_decay[step - visited] : 1;
    }
};

}  // namespace
