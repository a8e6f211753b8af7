// Priors from their files (FORMAT.md, Coded integers, Fast coder, Mask).
#include "priors.hpp"

#include <algorithm>
#include <cstdlib>
#include <new>

#include "inflate.hpp"

namespace fhash {
namespace {

constexpr int KINDS = 64, DECISIONS = 16, LANES = 8, LEVELS = 128;
constexpr int64_t SLOTS = (LEVELS + 729 + 12 * 12 * 12 + 7 * 7 * 7 * 7) * DECISIONS;
constexpr int64_t SIGN_SLOTS = KINDS * (27 + 108 + 81 + 25);
constexpr int SIGN_SET = 16, SIGN_INPUTS = 96;
constexpr int FIRST_SQUARE = 16;   // mean square of a gradient before anything is known
constexpr int SIMPLES = LEVELS * 64 + 8 + KINDS;
constexpr int TRUST = 12;          // count of an estimate of a prior
constexpr int WEIGHT_STEP = 512;   // unit of weights in a file
constexpr int MASK_SLOTS = 512 + 1024 + 4096 + 2048 + 2048 + 1920 + 2592 + 4096 + 4096 + 2048;
constexpr int MASK_LANES = 20, MASK_LEVELS = 32, MASK_NEAR = 16, MASK_SIMPLES = 30;

// Probability in 1/65536 of each number of a file: of logits from -11 to 10.5 by halves, rounded;
// even odds for 0.
const uint16_t PROBABILITIES[44] = {
    32768, 2,     3,     5,     8,     13,    22,    36,    60,    98,    162,
    267,   439,   720,   1179,  1921,  3108,  4971,  7812,  11955, 17625, 24743,
    32768, 40793, 47911, 53581, 57724, 60565, 62428, 63615, 64357, 64816, 65097,
    65269, 65374, 65438, 65476, 65500, 65514, 65523, 65528, 65531, 65533, 65534};

// A file of a prior is sound: only memory can be missing.
[[noreturn]] void no_memory() {
#if defined(__cpp_exceptions)
    throw std::bad_alloc();
#else
    std::abort();
#endif
}

struct Run {
    int64_t count;
    int32_t value;
};

State even(int64_t slots, const std::vector<Run>& weights, int64_t simples) {
    State state;
    state.slots.assign((size_t)(4 * slots), 0);
    state.simples.assign((size_t)(2 * simples), 0);
    for (int64_t i = 0; i < slots; i++)
        state.slots[(size_t)(4 * i)] = state.slots[(size_t)(4 * i + 1)] = 32768;
    for (int64_t i = 0; i < simples; i++) state.simples[(size_t)(2 * i)] = 32768;
    for (const Run& run : weights)
        state.weights.insert(state.weights.end(), (size_t)run.count, run.value);
    return state;
}

// A state from a file: a byte for each slot, simple estimate and weight.
void learn(State& state, int file) {
    size_t size;
    const uint8_t* const packed = prior_bytes(file, &size);
    const size_t slots = state.slots.size() / 4, simples = state.simples.size() / 2;
    std::vector<uint8_t> numbers(slots + simples + state.weights.size());
    fhash_error error;
    if (!inflate_exact(packed, size, true, numbers.data(), numbers.size(), error)) no_memory();
    const uint8_t* at = numbers.data();
    for (size_t i = 0; i < slots; i++, at++) {
        state.slots[4 * i] = state.slots[4 * i + 1] = PROBABILITIES[*at];
        state.slots[4 * i + 2] = *at ? TRUST : 0;
    }
    for (size_t i = 0; i < simples; i++, at++) {
        state.simples[2 * i] = PROBABILITIES[*at];
        state.simples[2 * i + 1] = *at ? TRUST : 0;
    }
    for (int32_t& weight : state.weights) weight += WEIGHT_STEP * (int8_t)*at++;
}

State plain_prior() {
    std::vector<Run> weights = {{KINDS * DECISIONS * LANES, 4423}, {64 * DECISIONS * LANES, 0}};
    for (int kind = 0; kind < KINDS; kind++)
        weights.insert(weights.end(), {{8, 2048}, {1, 8192}, {SIGN_SET - 9, 0}});
    for (int kind = 0; kind < KINDS; kind++)
        weights.insert(weights.end(), {{SIGN_INPUTS, 0}, {SIGN_INPUTS, FIRST_SQUARE}});
    State state = even(SLOTS + SIGN_SLOTS, weights, SIMPLES);
    learn(state, 0);
    // The file has the roots of mean squares.
    int32_t* const signs = state.weights.data() + state.weights.size() - 2 * KINDS * SIGN_INPUTS;
    for (int kind = 0; kind < KINDS; kind++)
        for (int i = 0; i < SIGN_INPUTS; i++) {
            int32_t& square = signs[(2 * kind + 1) * SIGN_INPUTS + i];
            // Rounded down, also below 0.
            const int32_t above = square - FIRST_SQUARE;
            const int32_t root = above >= 0 ? above / WEIGHT_STEP
                                            : -((WEIGHT_STEP - 1 - above) / WEIGHT_STEP);
            square = root * root;
        }
    return state;
}

// The decisions of class 1 of two quantisers, 14 and 15, begin as those of class 0.
State trellis_prior() {
    State state = integer_prior(false);
    for (int64_t slot = 0; slot < SLOTS; slot += DECISIONS)
        std::copy_n(&state.slots[(size_t)(4 * slot)], 8, &state.slots[(size_t)(4 * (slot + 14))]);
    const int64_t of_kinds = KINDS * DECISIONS * LANES, of_levels = 64 * DECISIONS * LANES;
    for (const Run& sets : {Run{0, (int32_t)of_kinds}, Run{of_kinds, (int32_t)of_levels}}) {
        int32_t* const begin = state.weights.data() + sets.count;
        const int64_t each = sets.value / DECISIONS;
        std::copy_n(begin, 2 * each, begin + 14 * each);
    }
    return state;
}

State even_masks() {
    State state = even(MASK_SLOTS, {{MASK_LEVELS * MASK_LANES, 3277}, {MASK_NEAR * MASK_LANES, 0}},
                       MASK_SIMPLES);
    learn(state, 1);
    return state;
}

constexpr int CHOICES = 64, TOKENS = 16, UNIT = 2048;

FastPrior make_fast() {
    size_t size;
    const uint8_t* const data = prior_bytes(2, &size);
    FastPrior prior;
    prior.slots.assign((2 * CHOICES + 1) * TOKENS, 0);
    for (int i = 0; i < CHOICES * TOKENS; i++)
        prior.slots[(size_t)i] = (uint16_t)(data[2 * i] | data[2 * i + 1] << 8);
    for (int i = 0; i <= CHOICES; i++) {
        // That a sign differs from what is foretold has a probability of (2 n + 1) / 256.
        const int differs = i < CHOICES ? UNIT / (4 * CHOICES) * (2 * i + 1) : 0;
        uint16_t* const row = &prior.slots[(size_t)((CHOICES + i) * TOKENS)];
        row[0] = (uint16_t)(UNIT - differs);
        row[1] = (uint16_t)differs;
    }
    prior.defaults.assign(data + 2 * CHOICES * TOKENS, data + size);
    for (int row = 0; row <= 2 * CHOICES; row++)
        for (uint32_t symbol = 0; symbol < TOKENS; symbol++) {
            const uint32_t count = prior.slots[(size_t)row * TOKENS + symbol];
            for (uint32_t place = 0; place < count; place++)
                prior.lookup.push_back(symbol | place << 4 | count << 16);
        }
    return prior;
}

}  // namespace

const State& integer_prior(bool trellis) {
    static const State plain = plain_prior();
    if (!trellis) return plain;
    static const State two = trellis_prior();
    return two;
}

const State& mask_prior() {
    static const State state = even_masks();
    return state;
}

const State& predictor_prior() {
    constexpr int CLASSES = 16, SETS = 48, WEIGHTS = 14;
    static const State state =
        even((SETS * 5 + 32 * 27 + CLASSES * 24 * 5 + 3125 + 81 * 5 * 8 + 81 * 24 + 32 * 24 * 5) *
                 DECISIONS,
             {{CLASSES * DECISIONS * WEIGHTS, 4096}, {SETS * DECISIONS * WEIGHTS, 0}}, 200);
    return state;
}

const FastPrior& fast_prior() {
    static const FastPrior prior = make_fast();
    return prior;
}

}  // namespace fhash
