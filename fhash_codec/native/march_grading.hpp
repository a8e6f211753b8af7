// Opacity by gradient.
#pragma once

#include "march_packet.hpp"

namespace {

// 1 - exp(-x) for x from 0 on, off by some 1e-7 of it. The function of the standard library is not
// vectorised.
FHASH_INLINE float opacity_of(float x) {
    const float most = x < 80.f ? x : 80.f;
    const int n = (int)(most * 1.442695041f + 0.5f);
    const float f = (most - (float)n * 0.693359375f) + (float)n * 2.12194440e-4f;
    // 1 - exp(-f) for f from -0.35 to 0.35, by its series.
    const float fifth = 1 - f / 5 * (1 - f / 6 * (1 - f / 7));
    const float series = f * (1 - f / 2 * (1 - f / 3 * (1 - f / 4 * fifth)));
    const int32_t bits = (127 - n) << 23;  // of 2^-n
    float power;
    std::memcpy(&power, &bits, sizeof power);
    return (1 - power) + power * series;
}

// Multiply the extinctions of a pass by the factors of their gradients.
void Packet::grade(Counters& counted) {
    const float* const factors = m.grading;
    const double* const extinctions = m.extinction;
    const float scale = (float)m.grade_scale, most = (float)FHASH_GRADES;
    int gradients = 0;
    #pragma omp simd reduction(+ : gradients)
    for (int l = 0; l < N; l++) {
        const float x = gx[l], y = gy[l], z = gz[l];
        const float grade = clamp(sqrtf(x * x + y * y + z * z) * scale, 0.f, most);
        const int n = (int)grade;
        const float factor = factors[n] + (grade - (float)n) * (factors[n + 1] - factors[n]);
        const int t = (int)at[l];
        const float here = (float)extinctions[t], next = (float)extinctions[t + 1];
        const float length = k[l] == last[l] ? (float)rest[l] : 1.f;
        const float depth_of = (here + (at[l] - (float)t) * (next - here)) * length * factor;
        gradients += alpha[l] > 0;
        alpha[l] = alpha[l] > 0 ? opacity_of(depth_of) : 0.f;
    }
    counted.gradients += gradients;
}

}  // namespace
