// The trellis of dependent quantisation: two quantisers, and eight states that choose between them
// (FORMAT.md). The coder and the search for the best path (trellis.cpp) share it.
#pragma once

#include <cstdint>

#include "core.hpp"

namespace {

const int TRELLIS_STATES = 8;

// State after an index of even and of odd magnitude. The quantiser of a state is its lowest bit.
const std::uint8_t TRELLIS[TRELLIS_STATES][2] = {{0, 2}, {5, 7}, {1, 3}, {6, 4},
                                                 {2, 0}, {4, 6}, {3, 1}, {7, 5}};

// State after `run` zeros: those of period 4 repeat.
FHASH_INLINE int after_zeros(int state, std::int64_t run) {
    for (int left = (int)(run & 3); left > 0; left--) state = TRELLIS[state][0];
    return state;
}

// Magnitude of the index of a level |v| in a quantiser, and the level of an index.
FHASH_INLINE std::int32_t index_of(std::int32_t level, int quantiser) {
    return (level + quantiser) / 2;
}
FHASH_INLINE std::int32_t level_of(std::int32_t index, int quantiser) {
    return index ? 2 * index - quantiser : 0;
}

}  // namespace
