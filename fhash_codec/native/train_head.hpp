// The network of the neighbourhood head in training: its integers, and the sums over blocks of
// voxels. compact/head_training.py states the arithmetic.
//
// All sums are of integers held in doubles. Their limits keep every sum below 2^53, so it is exact
// in whatever order it is formed, fused or not. All other operations are rounded one by one, in the
// order written here.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core.hpp"

// Contraction is allowed again for sums of exact integers only.
#if defined(__GNUC__) && !defined(__clang__)
#define EXACT_SUMS __attribute__((optimize("fp-contract=fast")))
#else
#define EXACT_SUMS
#endif

namespace {

using std::int16_t;
using std::int32_t;
using std::int64_t;

constexpr int64_t BLOCK = 64;          // voxels that are evaluated together
constexpr int64_t INPUTS = 28;         // inputs of the first layer
constexpr int64_t MAX_BLOCKS = 64;     // of a batch
constexpr int64_t MAX_WIDTH = 64;      // outputs of a hidden layer
constexpr int LAYERS = 3;
constexpr double INPUT_UNIT = 512, ACTIVATION_UNIT = 128, ERROR_UNIT = 16384;
constexpr double WEIGHT_UNIT = 65536;            // of weights that are not rounded as in the file
constexpr double MAX_ACTIVATION = 4095;
constexpr double MAX_ERROR = 16777216;           // 2^24, of errors and of slopes
constexpr double MAX_INTEGERS[2] = {31, 127};    // of weights and biases in the file
constexpr double MIN_SCALE = 1e-6;
constexpr double ROUNDING = 6755399441055744.0;  // 1.5 * 2^52: adding and subtracting it rounds

// Eight doubles in a register, or in several. They are passed to inlined functions only.
#if defined(__GNUC__)
#if !defined(__clang__)
#pragma GCC diagnostic ignored "-Wpsabi"
#endif
typedef double Lanes __attribute__((vector_size(64)));
#else
struct Lanes {
    double lane[8];
};
inline Lanes operator*(Lanes a, const Lanes& b) {
    for (int i = 0; i < 8; ++i) a.lane[i] *= b.lane[i];
    return a;
}
inline Lanes operator*(double a, Lanes b) {
    for (int i = 0; i < 8; ++i) b.lane[i] *= a;
    return b;
}
inline Lanes& operator+=(Lanes& a, const Lanes& b) {
    for (int i = 0; i < 8; ++i) a.lane[i] += b.lane[i];
    return a;
}
#endif
constexpr int64_t LANES = 8;

// Numbers that begin at a cache line: a register that is loaded across two takes twice as long.
class Buffer {
public:
    explicit Buffer(int64_t size = 0) : count(size), lines((size + LANES - 1) / LANES) {}

    void clear() { std::fill(data(), data() + count, 0.0); }
    void add(const Buffer& other) {
        for (int64_t i = 0; i < count; ++i) data()[i] += other[i];
    }
    double* data() { return lines.empty() ? nullptr : lines[0].numbers; }
    const double* data() const { return lines.empty() ? nullptr : lines[0].numbers; }
    double& operator[](int64_t i) { return data()[i]; }
    const double& operator[](int64_t i) const { return data()[i]; }

private:
    struct alignas(64) Line {
        double numbers[LANES];
    };
    int64_t count;
    std::vector<Line> lines;
};

FHASH_INLINE Lanes loaded(const double* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof lanes);
    return lanes;
}

FHASH_INLINE void stored(const Lanes& lanes, double* to) { std::memcpy(to, &lanes, sizeof lanes); }

FHASH_INLINE double rounded(double value) { return (value + ROUNDING) - ROUNDING; }

FHASH_INLINE double limited(double value, double most) {
    const double raised = value > -most ? value : -most;
    return raised < most ? raised : most;
}

// sums[o] = sum over k of weights[o, k] * inputs[k], for a block; stride: from one o to the next.
template <int OUTPUTS>
FHASH_INLINE void products_of(const double* FHASH_RESTRICT inputs, int64_t n,
                              const double* FHASH_RESTRICT weights, double* FHASH_RESTRICT sums,
                              int64_t stride) {
    for (int64_t v = 0; v < BLOCK; v += LANES) {
        Lanes total[OUTPUTS];
        for (int o = 0; o < OUTPUTS; ++o) total[o] = weights[o * n] * loaded(inputs + v);
        for (int64_t k = 1; k < n; ++k) {
            const Lanes in = loaded(inputs + k * BLOCK + v);
            for (int o = 0; o < OUTPUTS; ++o) total[o] += weights[o * n + k] * in;
        }
        for (int o = 0; o < OUTPUTS; ++o) stored(total[o], sums + o * stride + v);
    }
}

FHASH_CLONES_512 EXACT_SUMS void products(const double* inputs, int64_t n, const double* weights,
                                      int64_t outputs, double* sums, int64_t stride) {
    int64_t o = 0;
    for (; o + 4 <= outputs; o += 4)
        products_of<4>(inputs, n, weights + o * n, sums + o * stride, stride);
    for (; o < outputs; ++o)
        products_of<1>(inputs, n, weights + o * n, sums + o * stride, stride);
}

// sums[o, k] += sum over the voxels of a block of slopes[o] * inputs[k], each in eight lanes;
// stride: from one o of the slopes to the next.
template <int OUTPUTS, int COUNT>
FHASH_INLINE void gather_of(const double* FHASH_RESTRICT slopes, int64_t stride,
                            const double* FHASH_RESTRICT inputs, int64_t n,
                            double* FHASH_RESTRICT sums) {
    Lanes total[OUTPUTS][COUNT];
    for (int o = 0; o < OUTPUTS; ++o)
        for (int k = 0; k < COUNT; ++k) total[o][k] = loaded(sums + (o * n + k) * LANES);
    for (int64_t v = 0; v < BLOCK; v += LANES) {
        Lanes in[COUNT];
        for (int k = 0; k < COUNT; ++k) in[k] = loaded(inputs + k * BLOCK + v);
        for (int o = 0; o < OUTPUTS; ++o) {
            const Lanes slope = loaded(slopes + o * stride + v);
            for (int k = 0; k < COUNT; ++k) total[o][k] += slope * in[k];
        }
    }
    for (int o = 0; o < OUTPUTS; ++o)
        for (int k = 0; k < COUNT; ++k) stored(total[o][k], sums + (o * n + k) * LANES);
}

template <int OUTPUTS>
FHASH_INLINE void gather_rows(const double* slopes, int64_t stride, const double* inputs,
                              int64_t n, double* sums) {
    int64_t k = 0;
    for (; k + 2 <= n; k += 2)
        gather_of<OUTPUTS, 2>(slopes, stride, inputs + k * BLOCK, n, sums + k * LANES);
    for (; k < n; ++k)
        gather_of<OUTPUTS, 1>(slopes, stride, inputs + k * BLOCK, n, sums + k * LANES);
}

FHASH_CLONES_512 EXACT_SUMS void gather(const double* slopes, int64_t stride, int64_t outputs,
                                    const double* inputs, int64_t n, double* sums) {
    int64_t o = 0;
    for (; o + 2 <= outputs; o += 2)
        gather_rows<2>(slopes + o * stride, stride, inputs, n, sums + o * n * LANES);
    for (; o < outputs; ++o)
        gather_rows<1>(slopes + o * stride, stride, inputs, n, sums + o * n * LANES);
}

// sums[o] += sum over the voxels of a block of slopes[o], each in eight lanes.
FHASH_CLONES_512 void gather_biases(const double* FHASH_RESTRICT slopes, int64_t outputs,
                                    double* FHASH_RESTRICT sums) {
    for (int64_t o = 0; o < outputs; ++o)
        for (int64_t v = 0; v < BLOCK; v += LANES)
            for (int64_t i = 0; i < LANES; ++i) sums[o * LANES + i] += slopes[o * BLOCK + v + i];
}

FHASH_CLONES_512 void widened(const int16_t* FHASH_RESTRICT in, double* FHASH_RESTRICT out) {
    for (int64_t i = 0; i < BLOCK; ++i) out[i] = in[i];
}

// Sums to activations: leaky, clipped, rounded half to even.
FHASH_CLONES_512 void activate(double* FHASH_RESTRICT values, int64_t outputs, double scale,
                               const double* FHASH_RESTRICT biases) {
    for (int64_t o = 0; o < outputs; ++o) {
        const double bias = biases[o] * ACTIVATION_UNIT;
        for (int64_t i = 0; i < BLOCK; ++i) {
            const double p = values[o * BLOCK + i] * scale + bias;
            const double less = 0.125 * p;
            values[o * BLOCK + i] = rounded(limited(less > p ? less : p, MAX_ACTIVATION));
        }
    }
}

// Outputs of the last layer, in place, to errors, and these times their weights. An output beyond
// the clip range is clipped, and its slope is 0.
FHASH_CLONES_512 void errors_of(double* FHASH_RESTRICT values, double scale, double bias,
                            const int32_t* FHASH_RESTRICT targets,
                            const int32_t* FHASH_RESTRICT lowest,
                            const int32_t* FHASH_RESTRICT highest,
                            const float* FHASH_RESTRICT weights, double* FHASH_RESTRICT weighted,
                            double* FHASH_RESTRICT slopes) {
    const double shift = bias * ERROR_UNIT;
    for (int64_t i = 0; i < BLOCK; ++i) {
        const double low = lowest[i], high = highest[i];
        const double out = rounded(values[i] * scale + shift);
        const double raised = out > low ? out : low;
        const double clipped = raised < high ? raised : high;
        const double error = limited(clipped - (double)targets[i], MAX_ERROR);
        values[i] = error;
        weighted[i] = rounded(error * (double)weights[i]);
        slopes[i] = clipped == out ? weighted[i] : 0.0;
    }
}

// Slopes of sums from those of activations: times the slope of the leaky unit; limited, rounded.
FHASH_CLONES_512 void descend(double* FHASH_RESTRICT slopes, int64_t outputs, double scale,
                          const double* FHASH_RESTRICT activations) {
    for (int64_t i = 0; i < outputs * BLOCK; ++i) {
        const double leaky = activations[i] > 0 ? 1.0 : 0.125;
        slopes[i] = rounded(limited(slopes[i] * scale * leaky, MAX_ERROR));
    }
}

}  // namespace
