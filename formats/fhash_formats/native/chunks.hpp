// Chunks of the arrays of an open file: read with as few reads as they need, decoded, and kept.
#pragma once

#include <deque>
#include <functional>
#include <list>

#include "variable.hpp"

namespace fhash {

// A decoded inner chunk, in the order of the array's axes; or only a part of it, from `first` on.
struct Chunk {
    Lengths shape = {}, first = {};
    Buffer values;
    Buffer mask;  // a byte for each value, of tiles that have a mask; else empty

    uint64_t bytes() const { return values.size() + mask.size() + 256; }
};
using ChunkPointer = std::shared_ptr<const Chunk>;

// Chunks that were used last, as many as fit; the last one in any case.
struct Cache {
    using Key = std::array<uint64_t, 3>;  // array, inner chunk, level of detail
    using Entry = std::pair<Key, ChunkPointer>;

    uint64_t limit = 0, bytes = 0;
    Mutex lock;
    std::list<Entry> entries;  // those used last in front
    std::map<Key, std::list<Entry>::iterator> places;

    ChunkPointer get(const Key& key);
    void put(const Key& key, const ChunkPointer& chunk);
};

// A part of an array: first positions along its axes, and those after the last; visit_chunks takes
// every step-th position.
struct Region {
    Lengths first = {}, last = {}, step = {1, 1, 1, 1, 1, 1, 1, 1};

    // Values of it, at most 2^60, which no memory holds.
    uint64_t size(int axes) const {
        constexpr uint64_t most = uint64_t(1) << 60;
        uint64_t product = 1;
        for (int a = 0; a < axes; a++) {
            const uint64_t length = uint64_t(last[a] - first[a]);
            product = length && product > most / length ? most : product * length;
        }
        return product;
    }
};

// Takes an inner chunk and its place in the grid of inner chunks.
using Visit = std::function<bool(const Lengths& place, const Chunk& chunk)>;

}  // namespace fhash

struct fhash_file {
    fhash_context* context = nullptr;
    fhash::Source source;
    fhash::Directory directory;
    fhash::Hierarchy hierarchy;
    std::vector<fhash::Variable> variables;
    std::string header;
    fhash::Cache cache;
    fhash::Mutex lock;
    std::deque<std::string> texts;  // attributes of coordinates that were asked for
    void* stream = nullptr;         // FILE of a path
    fhash::Mutex stream_lock;
};

namespace fhash {

// Visits the inner chunks that a region touches, in any order, in this thread. `lod`: level of
// detail of tiles, of which chunks have every 2^lod-th vertex along z, y and x.
bool visit_chunks(fhash_file& file, const Array& array, const Region& region, int lod,
                  const Visit& visit, fhash_error& error);

// The values of a region in C order, in the type of the array. `mask`: null, or gets a byte for
// each value.
bool read_region(fhash_file& file, const Array& array, const Region& region, Buffer& values,
                 Buffer* mask, fhash_error& error);

}  // namespace fhash
