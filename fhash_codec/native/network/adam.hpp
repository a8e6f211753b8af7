// Adam on numbers that may be behind. The loops are plain, so that the compiler turns their roots
// into those of vectors.
#pragma once

#include "gaps.hpp"

#if defined(FHASH_VECTORS)

namespace {

// Write numbers as they are after the missed steps. `to` may be `from`.
template <class P>
void catch_up(float* to, const float* from, const float* FHASH_RESTRICT mean,
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
void adam(float* FHASH_RESTRICT number, float* FHASH_RESTRICT mean,
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

}  // namespace

#endif  // FHASH_VECTORS
