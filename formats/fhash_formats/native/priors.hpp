// What the entropy coders begin with; read once, then it never changes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace fhash {

// Estimates and weights that a coder adapts: slots (n, 4), weights, simple estimates (n, 2).
struct State {
    std::vector<uint16_t> slots;
    std::vector<int32_t> weights;
    std::vector<uint16_t> simples;

    int64_t slot_count() const { return (int64_t)slots.size() / 4; }
    int64_t simple_count() const { return (int64_t)simples.size() / 2; }
};

// Of the coder of integers, or of those of two quantisers.
const State& integer_prior(bool trellis);
const State& mask_prior();
// Of the coder of predicted integers: even odds.
const State& predictor_prior();

// Distributions of the fast coder (FORMAT.md, Fast coder).
struct FastPrior {
    std::vector<uint16_t> slots;     // (2 * 64 + 1, 16): slots of each symbol
    std::vector<uint8_t> defaults;   // (1744): the distribution of each context
    std::vector<uint32_t> lookup;    // (2 * 64 + 1, 2048): symbol, place, number
};
const FastPrior& fast_prior();

// The bytes of a file of a prior: 0 integers, 1 masks, 2 the fast coder (prior_bytes.cpp).
const uint8_t* prior_bytes(int number, size_t* size);

}  // namespace fhash
