// Entropy decoding of a tile's parts (coding.hpp), and the passes of a predictor.
#include "coding.hpp"

#include <algorithm>

#include "kernels.hpp"
#include "priors.hpp"

namespace fhash {

bool kernel_done(int64_t code, const char* what, fhash_error& error) {
    if (code >= 0) return true;
    if (code == -2) return fail(error, FHASH_ERROR_MEMORY, "no memory for the work of a kernel");
    return fail(error, FHASH_ERROR_DAMAGED, "%s", what);
}

bool decode_integers(const uint8_t* data, size_t size, const Shape& shape, const Table& table,
                     bool trellis, bool fast, int32_t* out, fhash_error& error) {
    std::fill_n(out, vertices(shape), 0);
    const int64_t bands = (int64_t)table.size() / TABLE_COLUMNS;
    int64_t code;
    if (fast) {
        const FastPrior& prior = fast_prior();
        code = fhash_fast_decode(out, trellis, shape.data(), table.data(), bands,
                                 prior.defaults.data(), prior.lookup.data(), data, (int64_t)size);
    } else {
        const State& prior = integer_prior(trellis);
        code = fhash_decode(out, trellis, shape.data(), table.data(), bands, prior.slots.data(),
                            prior.slot_count(), prior.weights.data(),
                            (int64_t)prior.weights.size(), prior.simples.data(),
                            prior.simple_count(), data, (int64_t)size);
    }
    return kernel_done(code, "the coded integers are damaged", error);
}

bool decode_block(const uint8_t* data, size_t size, const Shape& shape, int32_t* out,
                  fhash_error& error) {
    if (vertices(shape) == 0)
        return size == 0 || fail(error, FHASH_ERROR_DAMAGED, "bytes where nothing is coded");
    return decode_integers(data, size, shape, single_band(shape), false, false, out, error);
}

bool decode_labels(const uint8_t* data, size_t size, int64_t count, const Shape& shape,
                   uint16_t* out, fhash_error& error) {
    std::fill_n(out, vertices(shape), (uint16_t)0);
    return kernel_done(fhash_decode_labels(out, count, shape.data(), data, (int64_t)size),
                       "the labels of a tile are damaged", error);
}

bool decode_predicted(const uint8_t* data, size_t size, const Shape& shape,
                      const Predictor& predictor, int32_t* out, fhash_error& error) {
    std::fill_n(out, vertices(shape), 0);
    const State& prior = predictor_prior();
    const int64_t code = fhash_decode_predicted(
        out, shape.data(), predictor.levels.data(), predictor.passes.data(),
        (int64_t)predictor.passes.size() / 4, predictor.taps.data(), predictor.weights.data(),
        prior.slots.data(), prior.slot_count(), prior.weights.data(),
        (int64_t)prior.weights.size(), prior.simples.data(), prior.simple_count(), data,
        (int64_t)size);
    return kernel_done(code, "the predicted integers of a tile are damaged", error);
}

bool decode_mask(const uint8_t* data, size_t size, const Shape& shape, const uint8_t* first,
                 const uint8_t* second, uint8_t* out, fhash_error& error) {
    const State& prior = mask_prior();
    const int64_t code = fhash_decode_mask(
        out, first, second, shape.data(), prior.slots.data(), prior.slot_count(),
        prior.weights.data(), (int64_t)prior.weights.size(), prior.simples.data(),
        prior.simple_count(), data, (int64_t)size);
    return kernel_done(code, "the mask of a tile is damaged", error);
}

namespace {

// The taps of a predictor: the lattice, then offsets along t, z, y, x (transform/predict.py).
struct Taps {
    std::vector<int32_t>& all;

    void add(int lattice, int a, int by) { add(lattice, a, by, a, by); }
    void add(int lattice, int a, int by, int b, int other) {
        add(lattice, a, by, b, other, b, other);
    }
    void add(int lattice, int a, int by, int b, int other, int c, int third) {
        int32_t tap[5] = {lattice, 0, 0, 0, 0};
        tap[1 + a] = by;
        tap[1 + b] = other;
        tap[1 + c] = third;
        all.insert(all.end(), tap, tap + 5);
    }
    int count() const { return (int)all.size() / 5; }
};

// Of the first lattice, whose vertices before this one are known.
void add_first(Taps taps) {
    for (int axis = 0; axis < 4; axis++) taps.add(1, axis, -1);
    for (int a = 0; a < 4; a++)
        for (int b = a + 1; b < 4; b++) taps.add(1, a, -1, b, -1);
    for (int axis = 0; axis < 4; axis++) taps.add(1, axis, -2);
    for (int a = 0; a < 4; a++)
        for (int b = a + 1; b < 4; b++) taps.add(1, a, -1, b, 1);
}

// Of a pass along an axis. Vertices 0 and 1 of the known lattice (0) lie beside the vertex; those
// of the pass itself (1) are known if they come before it in C order.
void add_pass(Taps taps, int axis, int reach) {
    int others[3], n = 0;
    for (int other = 0; other < 4; other++)
        if (other != axis) others[n++] = other;
    for (const int by : {1, -1, 2}) taps.add(0, axis, by);
    for (const int other : others)
        for (const int near : {0, 1})
            for (const int side : {-1, 1}) taps.add(0, axis, near, other, side);
    taps.add(1, axis, -1);
    for (const int other : others) taps.add(1, other, -1);
    if (reach > 0) {
        for (const int other : others) taps.add(1, other, -2);
        for (int a = 0; a < 3; a++)
            for (int b = a + 1; b < 3; b++)
                for (const int side : {-1, 1}) taps.add(1, others[a], -1, others[b], side);
        for (const int other : others)
            for (const int side : {-1, 1})
                taps.add(1, std::min(axis, other), -1, std::max(axis, other), side);
    }
    if (reach > 1)
        for (int a = 0; a < 3; a++)
            for (int b = a + 1; b < 3; b++)
                for (const int near : {0, 1})
                    for (const int side : {-1, 1})
                        for (const int side_of_b : {-1, 1})
                            taps.add(0, axis, near, others[a], side, others[b], side_of_b);
}

}  // namespace

void make_passes(Predictor& predictor, const int* order, int reach) {
    constexpr int CLASSES = 16;
    std::vector<int> axes;
    const int64_t most = *std::max_element(predictor.levels.begin(), predictor.levels.end());
    for (int64_t level = most; level > 0; level--)
        for (int i = 0; i < 4; i++)
            if (predictor.levels[(size_t)order[i]] >= level) axes.push_back(order[i]);
    Taps taps{predictor.taps};
    add_first(taps);
    predictor.passes = {-1, CLASSES - 1, 0, taps.count()};
    for (size_t i = 0; i < axes.size(); i++) {
        const int first = taps.count();
        const int kind = std::min((int)(axes.size() - 1 - i), CLASSES - 2);
        add_pass(taps, axes[i], reach);
        predictor.passes.insert(predictor.passes.end(),
                                {axes[i], kind, first, taps.count() - first});
    }
}

}  // namespace fhash
