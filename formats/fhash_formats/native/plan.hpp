// Transform of tiles of one shape: bands, the factors of the norms, and the runs of the kernels.
#pragma once

#include "coding.hpp"

namespace fhash {

constexpr int MAX_LOD = 10, FORWARD = -1;

// Lengths of the low band of an axis after 0 to `depth` levels.
std::vector<int64_t> band_lengths(int64_t n, int depth);

// Whether y and x are transformed together, each level the low half of both.
bool is_coupled(const AxisTransform& y, const AxisTransform& x);

// Norms along two axes together, as two factors: (t, z) and (y, x).
struct Norms {
    std::vector<double> tz, yx;
};
Norms norms_of(fhash_context& context, const AxisTransform* axes, const Shape& shape);

// Lengths of a tile at a level of detail.
inline Shape lod_shape(const Shape& shape, int lod) {
    Shape less = shape;
    for (int a = 1; a < 4; a++) less[(size_t)a] = (shape[(size_t)a] + (1 << lod) - 1) >> lod;
    return less;
}

template <class T> struct Plan {
    Shape shape, bands;  // of the tile, and of the coefficients that the level of detail needs
    int lod;  // FORWARD for a plan of the forward transform
    Table table;
    int64_t kinds[4], depths[4], ranks[4];
    std::vector<T> matrices[4];
    std::vector<T> tz, yx;
    int threads = 1;  // that share a run
    int halvings[4];  // by a filter, where an axis has not so many levels

    // Coefficients from values, only of a plan of the forward transform.
    int64_t transform(const T* values, T* out) const;
    // Values from coefficients (of `bands`, contiguous) by the kernel; `out` has the same shape.
    int64_t invert(const T* coefficients, T* out) const;
    // Values from integers in one run; numbers as in lifting.cpp. Only without a level of detail.
    int64_t rebuild(const int32_t* integers, T* out, const double* numbers) const;
};

// The plan of a level of detail; null where a basis has another length than its axis.
template <class T>
std::shared_ptr<const Plan<T>> plan_for(fhash_context& context, const Settings& settings,
                                        const Shape& shape, int lod, fhash_error& error);

// The plan of the forward transform; null where a basis does not fit, or cannot encode.
template <class T>
std::shared_ptr<const Plan<T>> forward_plan(fhash_context& context, const Settings& settings,
                                            const Shape& shape, fhash_error& error);

// Values of a tile before head and residual, in the working type and clipped to the range.
//
// integers: the coefficients, of the whole tile; they may be overwritten.
// out: room for the values at the level of detail; may be the integers where T is float and lod 0.
template <class T>
bool linear_values(const Settings& settings, const Plan<T>& plan, int32_t* integers, T* out,
                   fhash_error& error);

}  // namespace fhash
