// Parts of a tile: boxes of its vertices, and what a head sees around them.
#pragma once

#include "blocks.hpp"

namespace fhash {

constexpr int64_t HEAD_REACH = 2;  // farthest vertex along an axis that a head's inputs come from

// A part and what its head sees around it.
Box widened(const Box& part, const Shape& shape);

// A box as seen from the corner of another one.
Box relative(const Box& box, const Box& to);

// The part of first and last vertices along t, z, y, x; false for one that is not in the tile.
bool is_part(const int64_t* numbers, const Shape& shape, Box& part);

// A part of an array as an array of its own.
template <class N> std::vector<N> copied(const N* in, const Shape& shape, const Box& part) {
    std::vector<N> out;
    out.reserve((size_t)vertices(part.shape()));
    for (int64_t t = part.first[0]; t < part.last[0]; t++)
        for (int64_t z = part.first[1]; z < part.last[1]; z++)
            for (int64_t y = part.first[2]; y < part.last[2]; y++) {
                const N* const row = in + ((t * shape[1] + z) * shape[2] + y) * shape[3];
                out.insert(out.end(), row + part.first[3], row + part.last[3]);
            }
    return out;
}

}  // namespace fhash
