// Rows of a pass of the predicted coder (predict.cpp): bases, taps and contexts, all in integers.
#pragma once

#include <cstdlib>

#include "predict_lattice.hpp"

namespace {

// The lattices of a pass, and what is known of the row that is coded.
struct Rows {
    Grid C, N, joined;
    int64_t largest = 0;  // magnitude of a known value

    // By vertex of a row: twice the base; how far the taps differ from it; how far the vertices of
    // the base differ; weighted sum of known differences; difference from twice the base one step
    // before; shares in the contexts of the differences above, below, before and in C, by their
    // sizes and by their signs.
    std::vector<int32_t> base, activity, slope, known, step, sizes, signs;
    // The predictions but for taps in the row itself, in 1/8192: in 32 bits where these suffice.
    std::vector<int32_t> narrow;
    std::vector<int64_t> wide;

    // Add a row of known differences, which begins at r in a lattice, moved along x, with weight w.
    void add_differences(Row& row, const Grid& G, int64_t r, int64_t offset, int w) {
        const int32_t* const p = G.errors.data() + r + offset;
        const int64_t first = max<int64_t>(0, -offset), last = min(N.n[3], G.n[3] - offset);
        int32_t* const to = known.data();
        for (int64_t x = first; x < last; x++) to[x] += w * clipped(p[x]);
        row.weight += w;
    }

    // The base of a row, its slope and its step.
    void find_base(const PassPlan& plan, Row& row) {
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

    // The predictions of a row as far as they are known before it, and the activity of the taps
    // that are. Taps in the row itself are listed, and of their differences only the base counts.
    template <bool NARROW> void sum_taps(const PassPlan& plan, Row& row) {
        const int64_t n3 = N.n[3], t = row.t, z = row.z, y = row.y;
        const int32_t* FHASH_RESTRICT const B = base.data();
        RowTap taps[MAX_TAPS];
        int count = 0, active = 0;  // those that make up the activity come first
        uint32_t own = 0;           // weights of the taps in the row
        for (int k = 0; k < plan.count; k++) {
            const int32_t* const tap = plan.taps + k * TAP_COLUMNS;
            const int64_t offset = tap[OFFSET_X];
            const int32_t w = plan.weights[k];
            if (tap[IN_N] && !tap[OFFSET_T] && !tap[OFFSET_Z] && !tap[OFFSET_Y]) {
                row.own[row.owned][0] = offset;
                row.own[row.owned++][1] = 2 * w;
                own += (uint32_t)w;
                continue;
            }
            const Grid& G = tap[IN_N] ? N : C;
            const int64_t tap_t = t + tap[OFFSET_T], tap_z = z + tap[OFFSET_Z];
            const int64_t tap_y = y + tap[OFFSET_Y];
            if (!G.has(tap_t, tap_z, tap_y)) continue;
            const int32_t* const p = G.values.data() + G.row(tap_t, tap_z, tap_y) + offset;
            taps[count++] = {p, w, max<int64_t>(0, -offset), min(n3, G.n[3] - offset)};
            active += k < ACTIVE;
        }
        if (NARROW) sum_narrow(taps, count, active, own);
        else {
            const int64_t of_base = 4096 - (int64_t)(int32_t)own;
            for (int64_t x = 0; x < n3; x++) wide[x] = B[x] * of_base;
            for (int k = 0; k < count; k++)
                for (int64_t x = taps[k].first; x < taps[k].last; x++) {
                    const int32_t d = 2 * taps[k].values[x] - B[x];
                    wide[x] += (int64_t)taps[k].weight * d;
                    if (k < active) activity[x] += min(std::abs(d), MAX_ACTIVITY);
                }
        }
        // Where they do not exist, the base counts in full.
        for (int i = 0; i < row.owned; i++)
            for (int64_t x = 0; x < min(n3, -row.own[i][0]); x++) {
                if (NARROW) narrow[x] += (int32_t)(row.own[i][1] / 2) * B[x];
                else wide[x] += row.own[i][1] / 2 * B[x];
            }
    }

    // The same in 32 bits, TOGETHER vertices at a time: also where a tap does not exist, which is
    // taken back. What is read there does not matter, as numbers without a sign wrap around.
    void sum_narrow(const RowTap* taps, int count, int active, uint32_t own) {
        const int64_t n3 = N.n[3];
        uint32_t others = 0;  // weights of the taps that are not active
        for (int k = active; k < count; k++) others += (uint32_t)taps[k].weight;
        const uint32_t of_base = 4096 - own - others;
        for (int64_t x = 0; x < n3; x += TOGETHER) {
            Numbers B, near = {}, far = {}, acts = {}, p;
            std::memcpy(&B, base.data() + x, sizeof B);
            for (int k = 0; k < active; k++) {
                std::memcpy(&p, taps[k].values + x, sizeof p);
                const Numbers d = 2 * p - B;
                near += (uint32_t)taps[k].weight * d;
                acts += activity_of(d);
            }
            for (int k = active; k < count; k++) {
                std::memcpy(&p, taps[k].values + x, sizeof p);
                far += (uint32_t)taps[k].weight * p;
            }
            near += 2 * far + of_base * B;
            std::memcpy(narrow.data() + x, &near, sizeof near);
            std::memcpy(activity.data() + x, &acts, sizeof acts);
        }
        for (int k = 0; k < count; k++) {
            const RowTap& tap = taps[k];
            const auto take_back = [&](int64_t from, int64_t to) FHASH_LAMBDA {
                for (int64_t x = from; x < to; x++) {
                    const uint32_t d = 2 * (uint32_t)tap.values[x] - (uint32_t)base[x];
                    narrow[x] = (int32_t)((uint32_t)narrow[x] - (uint32_t)tap.weight * d);
                    if (k < active) activity[x] -= min(std::abs((int32_t)d), MAX_ACTIVITY);
                }
            };
            take_back(0, min(tap.first, n3));
            take_back(max(tap.last, min(tap.first, n3)), n3);
        }
    }

    FHASH_INLINE static Numbers activity_of(Numbers differences) {
        typedef int32_t Signed __attribute__((vector_size(4 * TOGETHER)));
        const Signed d = (Signed)differences, most = Signed{} + MAX_ACTIVITY;
        const Signed size = d < 0 ? -d : d;
        return (Numbers)(size < most ? size : most);
    }

    // All that is known of a row before its first vertex.
    void prepare(const PassPlan& plan, Row& row) {
        const int64_t n3 = N.n[3], t = row.t, z = row.z, y = row.y, r = N.row(t, z, y);
        for (std::vector<int32_t>* array : {&activity, &slope, &known})
            std::memset(array->data(), 0, 4 * (size_t)n3);
        find_base(plan, row);
        // Where all values are small, 32 bits hold the sums, and twice as many are added at a time.
        row.narrow = largest * plan.reach < INT32_MAX;
        if (plan.axis >= 0 && row.narrow) sum_taps<true>(plan, row);
        else if (plan.axis >= 0) sum_taps<false>(plan, row);
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
        const int32_t* const V = row.values;
        int64_t p;
        if (plan.axis < 0) p = predict_first(plan, row, x);
        else {
            p = row.narrow ? narrow[x] : wide[x];
            for (int i = 0; i < row.owned; i++)
                if (x + row.own[i][0] >= 0) p += row.own[i][1] * V[x + row.own[i][0]];
        }
        const int64_t end = (int64_t)MAX_VALUE << FRACTION_BITS;
        // Rare, and a vertex waits for the one before it: as a branch nothing waits for this.
        if (FHASH_RARE((uint64_t)(p + end) > (uint64_t)(2 * end))) return p < 0 ? -end : end;
        return p;
    }

    // The same in the first lattice.
    int64_t predict_first(const PassPlan& plan, const Row& row, int64_t x) {
        int32_t* const B = base.data();
        if (x > 0) B[x] = 2 * row.values[x - 1];
        int64_t p = (int64_t)B[x] * 4096;
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
        return p;
    }

    // Note the largest value of a row that is known now.
    void note_largest(const Row& row) {
        int32_t most = 0;
        for (int64_t x = 0; x < N.n[3]; x++) most = max(most, std::abs(row.values[x]));
        largest = max<int64_t>(largest, most);
    }

    // Shares in the contexts of the differences above, below, before and in C.
    void prepare_contexts(const PassPlan& plan, const Row& row) {
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
