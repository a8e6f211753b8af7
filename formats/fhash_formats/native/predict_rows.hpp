// Rows of a pass of the predicted coder (predict.cpp): bases, taps and contexts, all in integers.
#pragma once

#include <cstdlib>

#include "predict_lattice.hpp"

namespace {

// The lattices of a pass, and what is known of the row that is coded.
struct Rows {
    Grid C, N;

    // By vertex of a row: twice the base; how far the taps differ from it; how far the vertices of
    // the base differ; weighted sum of known differences; difference from twice the base one step
    // before; shares in the contexts of the differences above, below, before and in C, by their
    // sizes and by their signs.
    std::vector<int32_t> base, activity, slope, known, step, sizes, signs;
    std::vector<int64_t> sum;  // weighted sum of the taps

    // Add a row of known differences, which begins at r in a lattice, moved along x, with weight w.
    FHASH_INLINE void add_differences(Row& row, const Grid& G, int64_t r, int64_t offset, int w) {
        const int32_t* const p = G.errors.data() + r + offset;
        const int64_t first = max<int64_t>(0, -offset), last = min(N.n[3], G.n[3] - offset);
        int32_t* const to = known.data();
        for (int64_t x = first; x < last; x++) to[x] += w * clipped(p[x]);
        row.weight += w;
    }

    // The base of a row, its slope and its step.
    FHASH_INLINE void find_base(const PassPlan& plan, Row& row) {
        const int64_t n3 = N.n[3], t = row.t, z = row.z, y = row.y;
        const int axis = plan.axis;
        const int32_t* const V = row.values;
        int32_t *const B = base.data(), *const to_slope = slope.data();
        int32_t* const to_step = step.data();
        if (axis < 0) {
            // The nearest vertex before: above, in the layer below or in the step before. Where one
            // is to the left, `predict` takes that.
            const int32_t* p = nullptr;
            if (y > 0) p = V - N.stride[2];
            else if (z > 0) p = V - N.stride[1];
            else if (t > 0) p = V - N.stride[0];
            for (int64_t x = 0; x < n3; x++) B[x] = p ? 2 * p[x] : 0;
            return;
        }
        const int64_t along[4] = {axis == 0, axis == 1, axis == 2, axis == 3};
        const int64_t r = C.row(t, z, y);
        const bool far = C.has(t + along[0], z + along[1], y + along[2]);
        const int64_t beyond = r + along[0] * C.stride[0] + along[1] * C.stride[1] +
                               along[2] * C.stride[2] + along[3];
        const int64_t next = far ? beyond : r;
        const int32_t *const p = C.values.data() + r, *const o = C.values.data() + next;
        const int64_t both = axis == 3 ? min(n3, C.n[3] - 1) : n3;
        for (int64_t x = 0; x < both; x++) {
            B[x] = p[x] + o[x];
            to_slope[x] = std::abs(p[x] - o[x]);
        }
        for (int64_t x = both; x < n3; x++) B[x] = 2 * p[x];
        add_differences(row, C, r, 0, COARSE);
        if (far) add_differences(row, C, next - along[3], along[3], COARSE);
        if (axis != 0 && t > 0) {
            row.stepped = true;
            const int32_t* const v = V - N.stride[0];
            const int32_t *const a = p - C.stride[0], *const b = o - C.stride[0];
            for (int64_t x = 0; x < both; x++) to_step[x] = 2 * v[x] - a[x] - b[x];
            for (int64_t x = both; x < n3; x++) to_step[x] = 2 * (v[x] - a[x]);
        }
    }

    // The sum and the activity of the taps that are known before a row; those in the row itself are
    // only listed.
    FHASH_INLINE void sum_taps(const PassPlan& plan, Row& row) {
        const int64_t n3 = N.n[3], t = row.t, z = row.z, y = row.y;
        const int32_t* const B = base.data();
        int64_t* const to_sum = sum.data();
        int32_t* const to_activity = activity.data();
        for (int k = 0; k < plan.count; k++) {
            const int32_t* const tap = plan.taps + k * TAP_COLUMNS;
            const int64_t offset = tap[OFFSET_X];
            const int32_t w = plan.weights[k];
            if (tap[IN_N] && !tap[OFFSET_T] && !tap[OFFSET_Z] && !tap[OFFSET_Y]) {
                row.own[row.owned][0] = offset;
                row.own[row.owned++][1] = w;
                continue;
            }
            const Grid& G = tap[IN_N] ? N : C;
            const int64_t tap_t = t + tap[OFFSET_T], tap_z = z + tap[OFFSET_Z];
            const int64_t tap_y = y + tap[OFFSET_Y];
            if (plan.axis < 0 || !G.has(tap_t, tap_z, tap_y)) continue;
            const int32_t* const p = G.values.data() + G.row(tap_t, tap_z, tap_y) + offset;
            const int64_t first = max<int64_t>(0, -offset), last = min(n3, G.n[3] - offset);
            if (k < ACTIVE)
                for (int64_t x = first; x < last; x++) {
                    const int32_t d = 2 * p[x] - B[x];
                    to_sum[x] += (int64_t)w * d;
                    to_activity[x] += min(std::abs(d), MAX_ACTIVITY);
                }
            else
                for (int64_t x = first; x < last; x++) to_sum[x] += (int64_t)w * (2 * p[x] - B[x]);
        }
    }

    // All that is known of a row before its first vertex.
    FHASH_INLINE void prepare(const PassPlan& plan, Row& row) {
        const int64_t n3 = N.n[3], t = row.t, z = row.z, y = row.y, r = N.row(t, z, y);
        for (std::vector<int32_t>* array : {&activity, &slope, &known})
            std::memset(array->data(), 0, 4 * (size_t)n3);
        std::memset(sum.data(), 0, 8 * (size_t)n3);
        find_base(plan, row);
        sum_taps(plan, row);
        if (y > 0) {
            add_differences(row, N, r - N.stride[2], 0, SIDE);
            add_differences(row, N, r - N.stride[2], -1, DIAGONAL);
            add_differences(row, N, r - N.stride[2], 1, DIAGONAL);
        }
        if (z > 0) add_differences(row, N, r - N.stride[1], 0, BEFORE);
        if (t > 0) {
            add_differences(row, N, r - N.stride[0], 0, BEFORE);
            add_differences(row, N, r - N.stride[0], 1, DIAGONAL);
            if (y + 1 < N.n[2])
                add_differences(row, N, r - N.stride[0] + N.stride[2], 0, DIAGONAL);
        }
    }

    // The prediction of vertex x, in 1/8192, from the row and the vertices to the left.
    FHASH_INLINE int64_t predict(const PassPlan& plan, const Row& row, int64_t x) {
        int32_t* const B = base.data();
        const int32_t* const V = row.values;
        int64_t p = sum[x];
        if (plan.axis < 0) {
            if (x > 0) B[x] = 2 * V[x - 1];
            for (int k = 0; k < plan.count; k++) {
                const int32_t* const tap = plan.taps + k * TAP_COLUMNS;
                const int64_t tap_t = row.t + tap[OFFSET_T], tap_z = row.z + tap[OFFSET_Z];
                const int64_t tap_y = row.y + tap[OFFSET_Y], tap_x = x + tap[OFFSET_X];
                if (tap_x < 0 || tap_x >= N.n[3] || !N.has(tap_t, tap_z, tap_y)) continue;
                const int64_t place = N.row(tap_t, tap_z, tap_y) + tap_x;
                const int32_t d = 2 * N.values[(size_t)place] - B[x];
                p += (int64_t)plan.weights[k] * d;
                if (k < ACTIVE) activity[x] += min(std::abs(d), MAX_ACTIVITY);
            }
        } else {
            for (int i = 0; i < row.owned; i++)
                if (x + row.own[i][0] >= 0) p += row.own[i][1] * (2 * V[x + row.own[i][0]] - B[x]);
        }
        const int64_t end = (int64_t)MAX_VALUE << FRACTION_BITS;
        return min(max((int64_t)B[x] * 4096 + p, -end), end);
    }

    // Shares in the contexts of the differences above, below, before and in C.
    FHASH_INLINE void prepare_contexts(const PassPlan& plan, const Row& row) {
        const int64_t n3 = N.n[3];
        std::memset(sizes.data(), 0, 4 * (size_t)n3);
        std::memset(signs.data(), 0, 4 * (size_t)n3);
        auto add = [&](const int32_t* FHASH_RESTRICT errors, int size, int sign) FHASH_LAMBDA {
            int32_t* FHASH_RESTRICT const to_sizes = sizes.data();
            int32_t* FHASH_RESTRICT const to_signs = signs.data();
            for (int64_t x = 0; x < n3; x++) {
                to_sizes[x] += few(clipped(errors[x])) * size;
                to_signs[x] += sign_of(errors[x]) * sign;
            }
        };
        if (row.y > 0) add(row.errors - N.stride[2], 125, 9);
        if (row.z > 0) add(row.errors - N.stride[1], 25, 3);
        if (row.t > 0) add(row.errors - N.stride[0], 5, 1);
        if (plan.axis >= 0) add(C.errors.data() + C.row(row.t, row.z, row.y), 1, 0);
    }
};

}  // namespace
