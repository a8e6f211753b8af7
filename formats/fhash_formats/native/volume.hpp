// Values of a variable of an open file.
#pragma once

#include "between.hpp"
#include "chunks.hpp"

namespace fhash {

// Vertices of the box along z, y and x: `count` from `first` on, every 2^lod-th.
struct Lattice {
    int64_t first[3] = {}, count[3] = {};
    int lod = 0;

    int64_t size() const { return count[0] * count[1] * count[2]; }
    int64_t last(int axis) const { return first[axis] + ((count[axis] - 1) << lod) + 1; }
    // The same as a region of an array (t, z, y, x), from time `t` to before `end`.
    Region region(int64_t t, int64_t end) const;
};

// Values of a lattice and which of them count, in the type of the model.
struct Frame {
    int32_t type = 0;
    Buffer values, mask;
};

int32_t detail_levels(const Variable& variable);
int64_t tile_length(const Variable& variable, int axis);

// The key index of a step: a whole number at each key frame.
bool find_key(fhash_file& file, const Variable& variable, double step, double& key,
              fhash_error& error);

// The key frames beside `key` and the next one: their distances, and their steps, -1 for none.
bool find_beside(fhash_file& file, const Variable& variable, int64_t key, Beside& beside,
                 int64_t* steps, fhash_error& error);

// Values of the profile compact at a key frame.
bool read_table(fhash_file& file, const Array& table, int64_t key, const Lattice& lattice,
                Frame& frame, fhash_error& error);
// The same of a plain file (plain.cpp).
bool read_plain(fhash_file& file, const Variable& variable, int64_t key, const Lattice& lattice,
                Frame& frame, fhash_error& error);

// Adds to a mask where the occupancy of the box at a key frame is 1 (coreset, or occupancy).
bool add_occupancy(fhash_file& file, const Variable& variable, int64_t key, const Lattice& lattice,
                   Buffer& mask, fhash_error& error);

// Values of the profile paper, float64, between key frames (paper.cpp).
bool read_network(fhash_file& file, const Variable& variable, double key, const Lattice& lattice,
                  const Buffer& requested, double* values, fhash_error& error);

}  // namespace fhash
