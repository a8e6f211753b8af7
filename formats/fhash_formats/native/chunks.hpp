// Chunks of the arrays of an open file: read with as few reads as they need, decoded, and kept.
#pragma once

#include <deque>
#include <functional>
#include <list>

#include "variable.hpp"

namespace fhash {

// A decoded inner chunk, in the order of the array's axes; or only a part of it, from `first` on.
struct Chunk : std::enable_shared_from_this<Chunk> {
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

// The reads of an array so far, as far as they tell the next one.
struct Course {
    Lengths first = {}, last = {};  // chunks of the last read
    int64_t moves = 0;  // how often reads in a row went on along the first axis, without a gap
};

// An open file, which its handles share.
struct Opened {
    Source source;
    Directory directory;
    Hierarchy hierarchy;
    std::vector<Variable> variables;
    std::string header;
    Cache cache;
    Mutex lock;
    std::deque<std::string> texts;      // attributes of coordinates that were asked for
    std::map<uint32_t, Course> courses;  // by number of the array
    std::vector<const Array*> numbered;  // arrays by their numbers, from 1
    void* stream = nullptr;             // FILE of a path
    Mutex stream_lock;
};

}  // namespace fhash

// A handle of a file: who reads it, with what memory and threads.
struct fhash_file {
    fhash_context* context;
    std::shared_ptr<fhash::Opened> opened;
    fhash::Source& source;
    fhash::Directory& directory;
    fhash::Hierarchy& hierarchy;
    std::vector<fhash::Variable>& variables;
    fhash::Cache& cache;

    fhash_file(fhash_context* reader, const std::shared_ptr<fhash::Opened>& of)
        : context(reader), opened(of), source(of->source), directory(of->directory),
          hierarchy(of->hierarchy), variables(of->variables), cache(of->cache) {}
};

namespace fhash {

// Where the bytes of an inner chunk lie in the file, from its local header on where it is alone in
// its member.
struct Stored {
    uint64_t offset = 0, length = 0;
    uint64_t skip = 0;  // bytes before the data
    uint32_t member = 0;
};

// What a visit does beside it.
struct Manner {
    int lod = 0;        // level of detail of tiles: chunks have every 2^lod-th vertex
    bool keep = true;   // whether the cache keeps what was decoded
    bool ahead = false; // whether idle threads may decode what a reader who goes on wants next
};

// Visits the inner chunks that a region touches, in any order, in this thread. Of tiles with a
// level of detail, chunks have every 2^lod-th vertex along z, y and x.
bool visit_chunks(fhash_file& file, const Array& array, const Region& region, const Manner& manner,
                  const Visit& visit, fhash_error& error);

// Where the inner chunks lie that a region touches.
bool find_stored(fhash_file& file, const Array& array, const Region& region,
                 std::vector<Stored>& found, fhash_error& error);

// The values of a region in C order, in the type of the array, and a byte for each value that says
// whether it is occupied; null where they are not wanted.
bool read_into(fhash_file& file, const Array& array, const Region& region, const Manner& manner,
               uint8_t* values, uint8_t* mask, fhash_error& error);
bool read_region(fhash_file& file, const Array& array, const Region& region, Buffer& values,
                 Buffer* mask, fhash_error& error);

}  // namespace fhash
