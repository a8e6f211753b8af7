// Entropy coding of quantised transform coefficients: an adaptive binary range coder whose
// probabilities are mixed from several contexts.
//
// A decoder computes with integers only, so encoder and decoder agree on every machine.
// tests/reference/integers.py explains it.
//
// A coefficient is coded as a zero flag, its sign, and its magnitude: in unary up to 13, beyond
// that by an Exp-Golomb code. Each binary decision k (0 is the zero flag, any other asks "more than
// k") is predicted by CONTEXTS adaptive estimates, each with a slow and a fast rate. They are mixed
// in the logistic domain by weights that learn as well, as in the PAQ family of compressors.
// Contexts come from magnitudes that are already known: to the left, above, one step and one layer
// before, and in the bands that come before.
//
// With TRELLIS the integers are those of two quantisers: the index of each is coded, and says how
// the state goes on that chooses the next quantiser (FORMAT.md, Two quantisers).
#include "coder_run.hpp"

namespace {

// One run. It works on a coder of its own, whose range can then stay in registers.
template <Mode MODE, Model MODEL, bool TRELLIS> FHASH_INLINE int64_t run(const Task& task) {
    return guarded([&]() FHASH_LAMBDA -> int64_t {
        Coder<MODE, MODEL, TRELLIS> coder = {range_of<MODE>(task), task};
        const int64_t code = coder.run();
        finish(coder.range);
        return code;
    });
}

// The plain functions, compiled for two machines but for those that nothing but tests calls.
FHASH_TWO_CLONES int64_t encode(const Task& task) { return run<ENCODE, BY_CONTEXTS, false>(task); }
int64_t encode_two(const Task& task) { return run<ENCODE, BY_CONTEXTS, true>(task); }
int64_t choose(const Task& task) { return run<CHOOSE, BY_CONTEXTS, false>(task); }
FHASH_TWO_CLONES int64_t decode(const Task& task) { return run<DECODE, BY_CONTEXTS, false>(task); }
int64_t decode_two(const Task& task) { return run<DECODE, BY_CONTEXTS, true>(task); }
FHASH_TWO_CLONES int64_t encode_signs(const Task& task) {
    return run<ENCODE, BY_SIGNS, false>(task);
}
FHASH_TWO_CLONES int64_t encode_signs_two(const Task& task) {
    return run<ENCODE, BY_SIGNS, true>(task);
}
FHASH_TWO_CLONES int64_t choose_signs(const Task& task) {
    return run<CHOOSE, BY_SIGNS, false>(task);
}
FHASH_TWO_CLONES int64_t decode_signs(const Task& task) {
    return run<DECODE, BY_SIGNS, false>(task);
}
FHASH_TWO_CLONES int64_t decode_signs_two(const Task& task) {
    return run<DECODE, BY_SIGNS, true>(task);
}
FHASH_TWO_CLONES int64_t encode_linear(const Task& task) {
    return run<ENCODE, BY_LINEAR, false>(task);
}
FHASH_TWO_CLONES int64_t encode_linear_two(const Task& task) {
    return run<ENCODE, BY_LINEAR, true>(task);
}
FHASH_TWO_CLONES int64_t choose_linear(const Task& task) {
    return run<CHOOSE, BY_LINEAR, false>(task);
}
FHASH_TWO_CLONES int64_t decode_linear(const Task& task) {
    return run<DECODE, BY_LINEAR, false>(task);
}
FHASH_TWO_CLONES int64_t decode_linear_two(const Task& task) {
    return run<DECODE, BY_LINEAR, true>(task);
}

int64_t encode_task(const Task& task, int64_t model, int64_t trellis) {
    if (model == BY_CONTEXTS)
        return task.scaled ? choose(task) : trellis ? encode_two(task) : encode(task);
    if (model == BY_LINEAR)
        return task.scaled ? choose_linear(task)
               : trellis   ? encode_linear_two(task)
                           : encode_linear(task);
    return task.scaled ? choose_signs(task) : trellis ? encode_signs_two(task) : encode_signs(task);
}

int64_t decode_task(const Task& task, int64_t model, int64_t trellis) {
    if (model == BY_CONTEXTS) return trellis ? decode_two(task) : decode(task);
    if (model == BY_LINEAR) return trellis ? decode_linear_two(task) : decode_linear(task);
    return trellis ? decode_signs_two(task) : decode_signs(task);
}

// The predictors that a model has, and a task with them.
struct Predictors {
    std::unique_ptr<Signs> signs;
    std::unique_ptr<Magnitudes> magnitudes;

    Predictors(int64_t model, State& state, int32_t* weights) {
        if (model != BY_CONTEXTS) signs.reset(new Signs(state, weights));
        if (model == BY_LINEAR) magnitudes.reset(new Magnitudes(weights));
    }
    void keep(int32_t* weights) const {
        if (signs) signs->keep(weights);
        if (magnitudes) magnitudes->keep(weights);
    }
};

}  // namespace

// Encode integers q (t, z, y, x), |q| < 2^30, in the bands of a table (axes/bands.py). Integers
// outside the bands count as 0.
//
// scaled: null, or coefficients / step: then the magnitudes are chosen anew and written to q.
// lambda: squared steps that a bit is worth.
// model: a Model, with the state of which the arrays are.
// trellis: whether the integers are those of two quantisers; not together with `scaled`.
// table: (count, COLUMNS).
// slots, weights, simples: the state (transform/entropy/prior.py). It is left adapted if `keep` and
// if the bytes fit.
// data: receives the bytes if they fit the capacity. If they do not, call again with the same q and
// more room.
//
// Returns the number of bytes, NO_MEMORY, or NO_TRELLIS for an integer that its quantiser lacks.
FHASH_EXPORT int64_t fhash_encode(int32_t* q, const float* scaled, double lambda, int64_t model,
                                  int64_t trellis, const int64_t* shape, const int32_t* table,
                                  int64_t count, uint16_t* slots, int64_t slot_count,
                                  int32_t* weights, int64_t weight_count, uint16_t* simples,
                                  int64_t simple_count, int64_t keep, uint8_t* data,
                                  int64_t capacity) {
    return guarded([&]() -> int64_t {
        State state = make_state(slots, slot_count, weights, min(weight_count, BASE_WEIGHTS),
                                 simples, simple_count, LANES);
        const Predictors with(model, state, weights);
        Flags flags(state);
        std::vector<uint8_t> out;
        const Task task = {&state, &flags, with.signs.get(), with.magnitudes.get(), q, scaled,
                           lambda / 2048, shape, table, count, &out, nullptr, 0};
        const int64_t code = encode_task(task, model, trellis);
        if (code < 0) return code;
        const int64_t size = put(out, data, capacity);
        if (keep && size <= capacity) {
            flags.keep(state);
            keep_state(state, slots, weights, simples, LANES);
            with.keep(weights);
        }
        return size;
    });
}

// Decode integers into q, which must be zeros; the other arguments are those of fhash_encode.
//
// Returns 0, or -1 for bytes that no encoder writes and for a band beyond q, or NO_MEMORY.
FHASH_EXPORT int64_t fhash_decode(int32_t* q, int64_t model, int64_t trellis, const int64_t* shape,
                                  const int32_t* table, int64_t count, const uint16_t* slots,
                                  int64_t slot_count, const int32_t* weights, int64_t weight_count,
                                  const uint16_t* simples, int64_t simple_count,
                                  const uint8_t* data, int64_t size) {
    return guarded([&] {
        State state = make_state(slots, slot_count, weights, min(weight_count, BASE_WEIGHTS),
                                 simples, simple_count, LANES);
        const Predictors with(model, state, const_cast<int32_t*>(weights));
        Flags flags(state);
        const Task task = {&state, &flags, with.signs.get(), with.magnitudes.get(), q, nullptr, 0,
                           shape, table, count, nullptr, data, size};
        return decode_task(task, model, trellis);
    });
}
