// Adam, and its steps without a gradient in closed form: fhash_codec/training/adam.py has the
// formulas. The loops are plain, so that the compiler turns their roots into those of vectors.
#pragma once

#include <cmath>

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

#if defined(FHASH_VECTORS)

// Write numbers as they are after the missed steps. `to` may be `from`.
template <class P>
FHASH_INLINE void catch_up(float* to, const float* from, const float* FHASH_RESTRICT mean,
                           const float* FHASH_RESTRICT square, std::int64_t count, const Gap& gap) {
    const float factor = gap.factor, epsilon = gap.epsilon;
    FHASH_INDEPENDENT for (std::int64_t i = 0; i < count; i++)
        to[i] = from[i] - factor * mean[i] / (__builtin_sqrtf(square[i]) + epsilon);
}

// A step of Adam at a learning rate.
struct Step {
    float rate, inverse;
    Step(const FhashBricks& b)
        : rate((float)(b.rate / (1 - std::pow(BETA1, (double)b.step)))),
          inverse((float)(1 / std::sqrt(1 - std::pow(BETA2, (double)b.step)))) {}
};

// Do a step on numbers that are caught up, and whose moments are not yet.
template <class P>
FHASH_INLINE void adam(float* FHASH_RESTRICT number, float* FHASH_RESTRICT mean,
                       float* FHASH_RESTRICT square, const float* FHASH_RESTRICT gradient,
                       std::int64_t count, const Gap& gap, const Step& step) {
    const float b1 = (float)(BETA1 * gap.mean_decay), b2 = (float)(BETA2 * gap.square_decay);
    const float a1 = (float)(1 - BETA1), a2 = (float)(1 - BETA2);
    const float rate = step.rate, inverse = step.inverse;
    FHASH_INDEPENDENT for (std::int64_t i = 0; i < count; i++) {
        const float g = gradient[i];
        const float m = b1 * mean[i] + a1 * g, s = b2 * square[i] + a2 * g * g;
        mean[i] = m;
        square[i] = s;
        number[i] -= rate * m / (__builtin_sqrtf(s) * inverse + (float)EPSILON);
    }
}

#endif

}  // namespace
