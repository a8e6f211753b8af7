// A look at a tile before it is coded: what comes back bit by bit, its range and its bound.
#pragma once

#include <cfloat>

#include "encode.hpp"
#include "numbers.hpp"

namespace fhash {
namespace {

constexpr size_t FAR_VALUES = 4;  // _FillValue, missing_value and two flags, at either end

// A tile to code, of at least one value that is not marked.
struct Task {
    fhash_context& context;
    Shape shape;
    int32_t type;
    const uint8_t* values;
    const fhash_quality& quality;
    Marks marks;  // of what comes back bit by bit, and takes no part in range and bound
    Wide origin;
    double low, high;      // of the other values, less the origin
    int64_t whole_low, whole_high;  // the same, of integers
    double ends[2];        // likewise, of the range that a relative bound is of
    double error, reach;   // bound on decoded values, below 0 for none; and before they are rounded
    bool signed_zero;      // a zero has a sign, or a value is below 0

    int64_t size() const { return vertices(shape); }
    bool whole() const { return type < FHASH_FLOAT16; }
    size_t bytes() const { return (size_t)size() * fhash_type_size(type); }
    bool counts(int64_t vertex) const {
        return marks.of.empty() || marks.of[(size_t)vertex] == 0;
    }
    bool lossless() const {
        return error >= 0 && error < (whole() ? 1.0 : 4.9406564584124654e-324);
    }
    double half_range() const { return high / 2 - low / 2; }
    double center() const { return low + half_range(); }
    double largest() const { return std::max(std::fabs(low), std::fabs(high)); }
};

// Whether whole planes along an axis are zeros, by axis and place: where nothing was written yet,
// stores have zeros unless they have another fill value.
template <class O> std::array<std::vector<bool>, 4> zero_planes(const Task& task, const O* values) {
    std::array<std::vector<int64_t>, 4> others;
    for (size_t axis = 0; axis < 4; axis++) others[axis].assign((size_t)task.shape[axis], 0);
    int64_t i = 0;
    for (int64_t t = 0; t < task.shape[0]; t++)
        for (int64_t z = 0; z < task.shape[1]; z++)
            for (int64_t y = 0; y < task.shape[2]; y++)
                for (int64_t x = 0; x < task.shape[3]; x++, i++) {
                    const int64_t there = bits_of(values[i]) != 0;
                    const int64_t place[4] = {t, z, y, x};
                    for (size_t axis = 0; axis < 4; axis++)
                        others[axis][(size_t)place[axis]] += there;
                }
    std::array<std::vector<bool>, 4> zeros;
    for (size_t axis = 0; axis < 4; axis++)
        for (const int64_t count : others[axis]) zeros[axis].push_back(count == 0);
    return zeros;
}

// Values at the ends of the range that are farther from all others than these are from each other,
// such as -999 in a file that says so where no coder looks. They would cost bytes, and weaken a
// relative bound.
template <class O> std::vector<O> far_values(const Task& task, const O* values) {
    std::vector<O> ends[2];  // the least different values ascending, and the largest descending
    const auto take = [](std::vector<O>& of, const O& value, auto before) {
        if (of.size() > FAR_VALUES && !before(value, of.back())) return;
        const auto at = std::lower_bound(of.begin(), of.end(), value, before);
        if (at != of.end() && !before(value, *at)) return;
        of.insert(at, value);
        if (of.size() > FAR_VALUES + 1) of.pop_back();
    };
    const auto less = [](const O& a, const O& b) { return value_of(a) < value_of(b); };
    const auto more = [](const O& a, const O& b) { return value_of(a) > value_of(b); };
    for (int64_t i = 0; i < task.size(); i++) {
        if (!task.counts(i)) continue;
        take(ends[0], values[i], less);
        take(ends[1], values[i], more);
    }
    std::vector<O> far;
    size_t best[2] = {0, 0};  // values of either end that are far, of which as many as possible
    for (size_t i = 0; i < ends[0].size(); i++)
        for (size_t j = 0; j < ends[1].size(); j++) {
            const double low = real(ends[0][i]), high = real(ends[1][j]), range = high - low;
            const bool far_low = i == 0 || low - real(ends[0][i - 1]) > range;
            const bool far_high = j == 0 || real(ends[1][j - 1]) - high > range;
            if (range >= 0 && far_low && far_high && i + j > best[0] + best[1]) {
                best[0] = i;
                best[1] = j;
            }
        }
    for (int side = 0; side < 2; side++)
        far.insert(far.end(), ends[side].begin(), ends[side].begin() + (int64_t)best[side]);
    return far;
}

// Marks planes of zeros beside others; false where the bits of so many cannot be kept.
bool mark_planes(Task& task, const std::array<std::vector<bool>, 4>& zeros) {
    const int64_t n = task.size();
    const auto has = [&](bool kind) {
        return std::any_of(zeros.begin(), zeros.end(), [&](const std::vector<bool>& planes) {
            return std::find(planes.begin(), planes.end(), kind) != planes.end();
        });
    };
    if (has(true) && has(false)) {
        int64_t i = 0;
        for (int64_t t = 0; t < task.shape[0]; t++)
            for (int64_t z = 0; z < task.shape[1]; z++)
                for (int64_t y = 0; y < task.shape[2]; y++)
                    for (int64_t x = 0; x < task.shape[3]; x++, i++)
                        if ((zeros[0][(size_t)t] || zeros[1][(size_t)z] || zeros[2][(size_t)y] ||
                             zeros[3][(size_t)x]) &&
                            !mark(0, i, n, task.marks))
                            return false;
    }
    return true;
}

// Marks the values that are not finite, those that the caller calls missing, those that nobody
// wrote, and those far from all others. false where the bits of so many cannot be kept.
template <class O> bool mark_all(Task& task, const O* values, const void* missing, size_t count) {
    const int64_t n = task.size();
    const bool every_bit = task.quality.max_error == 0;
    if (!mark_not_finite(values, task.type, n, every_bit, task.marks)) return false;
    if (every_bit) return true;
    const auto mark_bits = [&](const std::vector<uint64_t>& wanted) {
        for (int64_t i = 0; i < n && !wanted.empty(); i++) {
            const uint64_t bits = bits_of(values[i]);
            if (std::find(wanted.begin(), wanted.end(), bits) != wanted.end() &&
                !mark(bits, i, n, task.marks))
                return false;
        }
        return true;
    };
    std::vector<uint64_t> wanted;
    for (size_t i = 0; i < count; i++) {
        O value;
        std::memcpy(&value, (const uint8_t*)missing + i * sizeof(O), sizeof(O));
        if (std::isfinite(real(value))) wanted.push_back(bits_of(value));
    }
    if (!mark_bits(wanted)) return false;
    if (!mark_planes(task, zero_planes(task, values))) return false;
    wanted.clear();
    for (const O& value : far_values(task, values)) wanted.push_back(bits_of(value));
    return mark_bits(wanted);
}

// The middle of a range of 64-bit integers of which some are beyond 2^53; 0 for others.
template <class O> void set_origin(Task& task, O low, O high) {
    const double most = std::max(std::fabs((double)low), std::fabs((double)high));
    const auto exact = [](O number) {
        constexpr uint64_t limit = 1ull << 53;
        const bool below = number < 0;
        return (below ? 0 - (uint64_t)number : (uint64_t)number) <= limit;
    };
    if (sizeof(O) == 8 && !(exact(low) && exact(high)) && most > 0) {
        // (low + high + 1) / 2, rounded down
        const uint64_t width = (uint64_t)high - (uint64_t)low;
        task.origin.bits = (uint64_t)low + width / 2 + (width & 1);
        task.origin.negative = low < 0 && (int64_t)task.origin.bits < 0;
    }
    task.whole_low = (int64_t)((uint64_t)low - task.origin.bits);
    task.whole_high = (int64_t)((uint64_t)high - task.origin.bits);
    task.low = (double)task.whole_low;
    task.high = (double)task.whole_high;
    if (task.origin.zero()) {
        task.low = (double)low;
        task.high = (double)high;
    }
}

// A value less the origin.
template <class O> double number_of(const Task& task, const O& value) {
    if constexpr (is_real<O>) return real(value);
    else return task.origin.zero() ? real(value)
                                   : (double)(int64_t)((uint64_t)value - task.origin.bits);
}

// The range that a relative bound is of: without 0, which stores put where nothing was written.
template <class O> void set_ends(Task& task, const O* values) {
    bool any = false;
    task.ends[0] = task.ends[1] = 0;
    for (int64_t i = 0; i < task.size(); i++) {
        if (value_of(values[i]) == 0 || !task.counts(i)) continue;
        const double value = number_of(task, values[i]);
        if (!any || value < task.ends[0]) task.ends[0] = value;
        if (!any || value > task.ends[1]) task.ends[1] = value;
        any = true;
    }
}

// Range of the values that are not marked; false where all are.
template <class O> bool survey(Task& task, const O* values) {
    bool any = false;
    O low{}, high{};
    task.signed_zero = false;
    for (int64_t i = 0; i < task.size(); i++) {
        if (!task.counts(i)) continue;
        if constexpr (is_real<O>) task.signed_zero |= std::signbit(real(values[i]));
        if (!any || value_of(values[i]) < value_of(low)) low = values[i];
        if (!any || value_of(values[i]) > value_of(high)) high = values[i];
        any = true;
    }
    if (!any) return false;
    if constexpr (is_real<O>) {
        task.low = real(low);
        task.high = real(high);
    } else {
        set_origin(task, low, high);
    }
    if (task.quality.max_error_rel > 0) set_ends(task, values);
    return true;
}

// The bound on decoded values, and the largest error before they are rounded to their type.
void set_bound(Task& task) {
    const fhash_quality& quality = task.quality;
    task.error = -1;
    task.reach = 0;
    if (quality.step > 0) return;
    task.error = std::max(quality.max_error, 0.0);
    if (quality.max_error_rel > 0) {
        const double fraction = quality.max_error_rel, span = task.ends[1] - task.ends[0];
        task.error = std::isfinite(span) ? fraction * span
                                         : fraction * task.ends[1] - fraction * task.ends[0];
    }
    if (task.whole()) {
        task.reach = std::floor(task.error) + 0.5;
        return;
    }
    const double epsilon = task.type == FHASH_FLOAT16   ? 0x1p-10
                           : task.type == FHASH_FLOAT32 ? FLT_EPSILON
                                                        : DBL_EPSILON;
    task.reach = task.error - task.largest() * epsilon;
}

}  // namespace
}  // namespace fhash
