#include "chunks.hpp"

#include <algorithm>
#include <cstring>

#include "core.hpp"
#include "inflate.hpp"

FHASH_KERNEL std::int64_t fhash_crc32c(const void* in, std::int64_t n, std::int64_t crc,
                                       std::int64_t plain);

// Of part.cpp: a tile before its head, and a part of it with its head.
FHASH_KERNEL int32_t fhash_tile_uncorrected(fhash_context* context, const fhash_tile* tile,
                                            const void* stream, size_t size, const int64_t* part,
                                            float* values, int32_t* done, fhash_error* error);
FHASH_KERNEL int32_t fhash_tile_part(fhash_context* context, const fhash_tile* tile,
                                     const float* table, const int64_t* part, void* values,
                                     fhash_error* error);
// Of region.cpp: a part of a tile from the blocks that it needs.
FHASH_KERNEL int32_t fhash_tile_region(fhash_context* context, const fhash_tile* tile,
                                       const void* stream, size_t size, const int64_t* part,
                                       void* values, int32_t* done, fhash_error* error);

namespace fhash {

namespace {

constexpr uint64_t ABSENT = ~uint64_t(0);
constexpr uint64_t INDEX_ENTRY = 16;       // bytes of an inner chunk in the index of its shard
constexpr uint64_t CHUNK_GAP = 16 << 10;   // bytes between two chunks that are read as well
constexpr uint64_t CHUNK_READ = 8 << 20;   // bytes of a read of several chunks
constexpr uint64_t SMALL_INDEX = 64 << 10; // bytes up to which all of an index is read
constexpr uint64_t SHARE = 4;              // as is one of which that share is needed
constexpr uint64_t INDEX = 1000;           // in the place of a level of detail, in the cache
constexpr uint64_t UNCORRECTED = 1001;     // likewise: tiles before their head
constexpr uint64_t APART = 1002;           // likewise: how many parts of a tile were decoded
constexpr int64_t MOST_APART = 3;          // then all of it is decoded
constexpr int FLAGS = 4, KIND = 7, BLOCKS = 6;  // of a stream: place and bits of the kind

// An inner chunk that is to be read.
struct Wanted {
    Lengths place;
    uint64_t number;          // in the grid of inner chunks
    const Member* member;
    uint64_t in_shard;        // number in the shard
    uint64_t offset, length;  // in the file
    uint64_t skip;            // bytes before the data
};

bool check_crc(const uint8_t* data, size_t size, fhash_error& error) {
    if (size < 4 ||
        uint32_t(fhash_crc32c(data, int64_t(size) - 4, 0, 0)) != from_little(data + size - 4, 4))
        return fail(error, FHASH_ERROR_DAMAGED, "its CRC-32C differs, the data are damaged");
    return true;
}

// Copies values from the axis `a` on to another place; strides are in values.
void copy_region(const uint8_t* in, const Lengths& in_strides, uint8_t* out,
                 const Lengths& out_strides, const Lengths& counts, int axes, size_t size,
                 int a = 0) {
    if (a == axes - 1 && in_strides[a] == 1 && out_strides[a] == 1) {
        std::memcpy(out, in, size * size_t(counts[a]));
        return;
    }
    for (int64_t i = 0; i < counts[a]; i++) {
        const uint8_t* const from = in + size_t(i * in_strides[a]) * size;
        uint8_t* const to = out + size_t(i * out_strides[a]) * size;
        if (a == axes - 1) std::memcpy(to, from, size);
        else copy_region(from, in_strides, to, out_strides, counts, axes, size, a + 1);
    }
}

Lengths strides_of(const Lengths& shape, int axes) {
    Lengths strides = {};
    int64_t stride = 1;
    for (int a = axes - 1; a >= 0; a--) {
        strides[a] = stride;
        stride *= shape[a];
    }
    return strides;
}

// Values of a tile in the order of the array's axes, thinned where a level of detail is not the
// tile's own.
void reorder(const Array& array, const int64_t tile[4], int thinned, Chunk& chunk, Buffer& bytes,
             size_t size) {
    const int64_t strides[4] = {tile[1] * tile[2] * tile[3], tile[2] * tile[3], tile[3], 1};
    Lengths in = {};
    uint64_t count = 1;
    for (int a = 0; a < array.axes; a++) {
        const int64_t step = a >= array.axes - 3 ? int64_t(1) << thinned : 1;
        const int place = array.places[a];
        const int64_t length = place < 0 ? 1 : tile[place];
        chunk.shape[a] = (length + step - 1) / step;
        in[a] = place < 0 ? 0 : strides[place] * step;
        count *= uint64_t(chunk.shape[a]);
    }
    Buffer ordered;
    ordered.resize(size_t(count) * size);
    copy_region(bytes.data(), in, ordered.data(), strides_of(chunk.shape, array.axes), chunk.shape,
                array.axes, size);
    bytes = std::move(ordered);
}

fhash_tile tile_of(const Array& array) {
    fhash_tile tile = {{1, 1, 1, 1}, array.type, 0, nullptr, array.settings.size()};
    if (!array.settings.empty()) tile.settings = array.settings.data();
    for (int a = 0; a < array.axes; a++)
        if (array.places[a] >= 0) tile.shape[array.places[a]] = array.inner[a];
    return tile;
}

// Whether a part of a tile may be had sooner than all of it: the head need not see the rest.
bool is_parted(const Array& array) {
    const bool headed = array.tiles && !array.settings.empty() && (uint8_t(array.settings[0]) & 32);
    return headed && !array.masked() && array.usual && array.axes == 4;
}

// Whether a part of a tile may be had from some of its blocks.
bool is_boxed(const Array& array) {
    return array.tiles && !array.masked() && array.usual && array.axes == 4;
}

// Makes room for a part of a tile, first and last positions along t, z, y, x.
void make_part(const Array& array, const int64_t part[8], Chunk& chunk) {
    size_t count = 1;
    for (size_t a = 0; a < 4; a++) {
        chunk.first[a] = part[2 * a];
        chunk.shape[a] = part[2 * a + 1] - part[2 * a];
        count *= size_t(chunk.shape[a]);
    }
    chunk.values.resize(count * fhash_type_size(array.type));
}

// A part of a tile out of the tile before its head.
bool correct_part(fhash_context& context, const Array& array, const Chunk& table,
                  const int64_t part[8], Chunk& chunk, fhash_error& error) {
    const fhash_tile tile = tile_of(array);
    make_part(array, part, chunk);
    return fhash_tile_part(&context, &tile, reinterpret_cast<const float*>(table.values.data()),
                           part, chunk.values.data(), &error) == FHASH_OK;
}

bool decode_tile(fhash_context& context, const Array& array, const uint8_t* data, size_t size,
                 int lod, Chunk& chunk, fhash_error& error) {
    const fhash_tile tile = tile_of(array);
    const bool own = array.places[0] == 0 || array.usual;  // whether levels are those of the tile
    const int level = own ? lod : 0;
    int64_t shape[4] = {tile.shape[0]};
    for (int a = 1; a < 4; a++)
        shape[a] = (tile.shape[a] + (int64_t(1) << level) - 1) >> level;
    const size_t count = size_t(shape[0] * shape[1] * shape[2] * shape[3]);
    const size_t item = fhash_type_size(array.type);
    if (!may_use(context, count * (item + 1) + size, error)) return false;
    chunk.values.resize(count * item);
    const bool masked = array.masked() && !lod;
    if (masked) chunk.mask.resize(count);
    if (fhash_tile_decode(&context, &tile, data, size, level, chunk.values.data(),
                          masked ? chunk.mask.data() : nullptr, &error) != FHASH_OK)
        return false;
    if (array.usual) {
        std::copy(shape + 4 - array.axes, shape + 4, chunk.shape.begin());
        return true;
    }
    reorder(array, shape, own ? 0 : lod, chunk, chunk.values, item);
    if (masked) reorder(array, shape, 0, chunk, chunk.mask, 1);
    return true;
}

bool decode_chunk(fhash_context& context, const Array& array, const uint8_t* data, size_t size,
                  int lod, Chunk& chunk, fhash_error& error) {
    if (array.tiles) return decode_tile(context, array, data, size, lod, chunk, error);
    if (lod) return fail(error, FHASH_ERROR_ARGUMENT, "the array has no levels of detail");
    const uint64_t bytes = array.inner_values() * fhash_type_size(array.type);
    chunk.shape = array.inner;
    return may_use(context, bytes + size, error) && check_crc(data, size, error) &&
           zstd_exact(data, size - 4, bytes, bytes, chunk.values, error);
}

// Where inner chunks lie in their shards.
struct Indices {
    fhash_file& file;
    const Array& array;

    uint64_t chunks() const {
        uint64_t product = 1;
        for (int a = 0; a < array.axes; a++) product *= uint64_t(array.per_chunk(a));
        return product;
    }

    // Which inner chunks of a shard hold a vertex of the array.
    bool present(uint64_t shard, uint64_t number) const {
        for (int a = array.axes - 1; a >= 0; a--) {
            const uint64_t along = uint64_t(array.per_chunk(a));
            const uint64_t shards = uint64_t(array.count(array.chunk, a));
            const uint64_t at = shard % shards * along + number % along;
            if (at >= uint64_t(array.count(array.inner, a))) return false;
            shard /= shards;
            number /= along;
        }
        return true;
    }

    // Checks that the inner chunks of a shard fill it in order.
    bool check(uint64_t shard, const Buffer& entries, uint64_t data_bytes,
               fhash_error& error) const {
        uint64_t position = 0;
        for (uint64_t number = 0; number < entries.size() / INDEX_ENTRY; number++) {
            const uint64_t offset = from_little(entries.data() + INDEX_ENTRY * number, 8);
            const uint64_t length = from_little(entries.data() + INDEX_ENTRY * number + 8, 8);
            const bool there = present(shard, number);
            const bool good = there ? offset == position && length <= data_bytes - position
                                    : offset == ABSENT && length == ABSENT;
            if (!good)
                return fail(error, FHASH_ERROR_DAMAGED,
                            "the index of the shard has inner chunks that are missing, overlap, "
                            "leave gaps or are not in order");
            if (there) position += length;
        }
        return position == data_bytes ||
               fail(error, FHASH_ERROR_DAMAGED, "the index of the shard leaves bytes out");
    }

    // The entries of a shard from number `first` to `last`, or all of them: their first number is
    // shape[0] of the chunk.
    ChunkPointer entries(uint64_t shard, uint64_t first, uint64_t last, fhash_error& error) {
        const Cache::Key key = {array.number, shard, INDEX};
        ChunkPointer found = file.cache.get(key);
        if (found && uint64_t(found->shape[0]) <= first &&
            last < uint64_t(found->shape[0]) + found->values.size() / INDEX_ENTRY)
            return found;
        const Member& member = file.directory.members[array.members[size_t(shard)]];
        const uint64_t count = chunks(), index_bytes = count * INDEX_ENTRY + 4;
        if (member.size < index_bytes) {
            fail(error, FHASH_ERROR_DAMAGED, "member %s: too few bytes for the index of a shard",
                 member.name.c_str());
            return nullptr;
        }
        const uint64_t data_bytes = member.size - index_bytes;
        const bool whole = index_bytes <= SMALL_INDEX || (last - first + 1) * SHARE >= count;
        const std::shared_ptr<Chunk> made = std::make_shared<Chunk>();
        made->shape[0] = whole ? 0 : int64_t(first);
        const uint64_t start =
            member.data_offset() + data_bytes + uint64_t(made->shape[0]) * INDEX_ENTRY;
        const uint64_t length = whole ? index_bytes : (last - first + 1) * INDEX_ENTRY;
        Buffer& bytes = made->values;
        if (!file.source.read(start, length, bytes, error)) return nullptr;
        if (whole) {
            const bool good = check_crc(bytes.data(), bytes.size(), error);
            bytes.resize(bytes.size() - 4);
            if (!good || !check(shard, bytes, data_bytes, error)) {
                fail_in(error, "member " + member.name);
                return nullptr;
            }
        }
        file.cache.put(key, made);
        return made;
    }

    bool locate(const Chunk& entries, Wanted& wanted, fhash_error& error) const {
        const uint64_t at = wanted.in_shard - uint64_t(entries.shape[0]);
        const uint64_t offset = from_little(entries.values.data() + INDEX_ENTRY * at, 8);
        const uint64_t length = from_little(entries.values.data() + INDEX_ENTRY * at + 8, 8);
        const uint64_t data_bytes = wanted.member->size - (chunks() * INDEX_ENTRY + 4);
        if (length > data_bytes || offset > data_bytes - length)
            return fail(error, FHASH_ERROR_DAMAGED,
                        "member %s: an inner chunk is missing or reaches beyond the shard",
                        wanted.member->name.c_str());
        wanted.offset = wanted.member->data_offset() + offset;
        wanted.length = length;
        return true;
    }

    bool locate_all(std::vector<Wanted>& wanted, fhash_error& error) {
        std::map<uint64_t, std::vector<Wanted*>> shards;
        for (Wanted& each : wanted) {
            uint64_t shard = 0, number = 0;
            for (int a = 0; a < array.axes; a++) {
                const int64_t along = array.per_chunk(a);
                shard = shard * uint64_t(array.count(array.chunk, a)) +
                        uint64_t(each.place[a] / along);
                number = number * uint64_t(along) + uint64_t(each.place[a] % along);
            }
            each.member = &file.directory.members[array.members[size_t(shard)]];
            each.in_shard = number;
            if (array.sharded) {
                shards[shard].push_back(&each);
                continue;
            }
            each.offset = each.member->offset;
            each.length = each.member->end() - each.offset;
            each.skip = each.member->data_offset() - each.offset;
        }
        for (const auto& shard : shards) {
            const auto order = [](const Wanted* a, const Wanted* b) {
                return a->in_shard < b->in_shard;
            };
            const auto ends =
                std::minmax_element(shard.second.begin(), shard.second.end(), order);
            const ChunkPointer found = entries(shard.first, (*ends.first)->in_shard,
                                               (*ends.second)->in_shard, error);
            if (!found) return false;
            for (Wanted* each : shard.second)
                if (!locate(*found, *each, error)) return false;
        }
        return true;
    }
};

// A chunk for the caller, and what is kept instead of it where it is a part: the tile before its
// head, or a mark of how many parts were decoded.
struct Decoded {
    std::shared_ptr<Chunk> chunk, table, mark;
};

// Reads and decodes chunks, those that lie together with one read, several at once in threads.
struct Reading {
    fhash_file& file;
    const Array& array;
    const Region& region;
    int lod;
    const Visit& visit;

    // The part of a tile that the region asks for.
    void find_part(const Wanted& wanted, int64_t part[8]) const {
        for (size_t a = 0; a < 4; a++) {
            const int64_t start = wanted.place[a] * array.inner[a];
            part[2 * a] = std::max(region.first[a] - start, int64_t(0));
            part[2 * a + 1] = std::min(region.last[a] - start, array.inner[a]);
        }
    }

    // That part from the blocks that it needs; without `mark` there is no such thing, or so many
    // parts were decoded already that all of the tile is worth its time.
    bool decode_region(const Wanted& wanted, const uint8_t* data, size_t size, Decoded& decoded,
                       fhash_error& error) {
        const ChunkPointer before = file.cache.get({array.number, wanted.number, APART});
        const int64_t parts = before ? before->shape[0] : 0;
        if (parts == MOST_APART || size <= FLAGS || (data[FLAGS] & KIND) != BLOCKS) return true;
        const fhash_tile tile = tile_of(array);
        int64_t part[8];
        find_part(wanted, part);
        int32_t apart = 0;
        make_part(array, part, *decoded.chunk);
        if (fhash_tile_region(file.context, &tile, data, size, part, decoded.chunk->values.data(),
                              &apart, &error) != FHASH_OK)
            return false;
        if (apart) {
            decoded.mark = std::make_shared<Chunk>();
            decoded.mark->shape[0] = parts + 1;
        } else *decoded.chunk = {};
        return true;
    }

    // A tile before its head, and the part of it that the region asks for; `done` says whether
    // there is such a thing.
    bool decode_part(const Wanted& wanted, const uint8_t* data, size_t size, Chunk& table,
                     Chunk& chunk, bool& done, fhash_error& error) {
        const fhash_tile tile = tile_of(array);
        int64_t part[8];
        find_part(wanted, part);
        int32_t apart = 0;
        table.shape = array.inner;
        if (!may_use(*file.context, 8 * array.inner_values(), error)) return false;
        table.values.resize(size_t(4 * array.inner_values()));
        if (fhash_tile_uncorrected(file.context, &tile, data, size, part,
                                   reinterpret_cast<float*>(table.values.data()), &apart,
                                   &error) != FHASH_OK)
            return false;
        done = apart != 0;
        return !done || correct_part(*file.context, array, table, part, chunk, error);
    }

    bool decode(const Wanted& wanted, const uint8_t* data, Decoded& decoded, fhash_error& error) {
        const Member& member = *wanted.member;
        if (!array.sharded && !check_member(member, data, error)) return false;
        const uint8_t* const stream = data + wanted.skip;
        const size_t size = size_t(wanted.length - wanted.skip);
        bool done = false, good = true;
        decoded.chunk = std::make_shared<Chunk>();
        if (!lod && is_boxed(array)) {
            good = decode_region(wanted, stream, size, decoded, error);
            done = decoded.mark != nullptr;
        }
        if (good && !done && !lod && is_parted(array)) {
            decoded.table = std::make_shared<Chunk>();
            good = decode_part(wanted, stream, size, *decoded.table, *decoded.chunk, done, error);
        }
        if (!done) decoded.table = nullptr;
        if (good && !done)
            good = decode_chunk(*file.context, array, stream, size, lod, *decoded.chunk, error);
        if (good) return true;
        std::string name = "member " + member.name;
        if (array.sharded) name += ": inner chunk " + std::to_string(wanted.in_shard);
        return fail_in(error, name);
    }

    // Decodes chunks whose bytes lie in `bytes`, which begin at `start`.
    bool decode_all(const Wanted* wanted, size_t count, const Buffer& bytes, uint64_t start,
                    fhash_error& error) {
        const uint64_t each = array.inner_values() * (fhash_type_size(array.type) + 1);
        size_t threads = std::min(size_t(file.context->threads), count);
        if (file.context->memory)  // no more at once than the memory allows
            threads = std::min<uint64_t>(threads, std::max<uint64_t>(
                                                      1, file.context->memory / 32 / each));
        for (size_t first = 0; first < count; first += threads) {
            const size_t now = std::min(threads, count - first);
            std::vector<Decoded> chunks(now);
            std::vector<fhash_error> errors(now);
            std::vector<uint8_t> done(now, 0);
            const auto work = [&](int i) {
                const Wanted& one = wanted[first + size_t(i)];
                done[size_t(i)] = decode(one, bytes.data() + (one.offset - start),
                                         chunks[size_t(i)], errors[size_t(i)]);
            };
            if (now == 1) work(0);
            else together(int(now), work);
            for (size_t i = 0; i < now; i++) {
                if (!done[i]) {
                    error = errors[i];
                    return false;
                }
                const Wanted& one = wanted[first + i];
                const Decoded& found = chunks[i];
                const uint64_t kind =
                    found.mark ? APART : found.table ? UNCORRECTED : uint64_t(lod);
                file.cache.put({array.number, one.number, kind},
                               found.mark ? found.mark : found.table ? found.table : found.chunk);
                if (!visit(one.place, *chunks[i].chunk)) return false;
            }
        }
        return true;
    }

    bool read(std::vector<Wanted>& wanted, fhash_error& error) {
        std::sort(wanted.begin(), wanted.end(),
                  [](const Wanted& a, const Wanted& b) { return a.offset < b.offset; });
        const uint64_t memory = file.context->memory;
        const uint64_t most = memory ? std::min(CHUNK_READ, memory / 8) : CHUNK_READ;
        for (size_t first = 0, last; first < wanted.size(); first = last) {
            const uint64_t start = wanted[first].offset;
            uint64_t stop = start + wanted[first].length;
            for (last = first + 1; last < wanted.size(); last++) {
                const uint64_t end = wanted[last].offset + wanted[last].length;
                if (wanted[last].offset > stop + CHUNK_GAP) break;
                if (std::max(stop, end) - start > most) break;
                stop = std::max(stop, end);
            }
            Buffer bytes;
            if (!file.source.read(start, stop - start, bytes, error) ||
                !decode_all(wanted.data() + first, last - first, bytes, start, error))
                return false;
        }
        return true;
    }
};

}  // namespace

ChunkPointer Cache::get(const Key& key) {
    Guard guard(lock);
    const auto found = places.find(key);
    if (found == places.end()) return nullptr;
    entries.splice(entries.begin(), entries, found->second);
    return found->second->second;
}

void Cache::put(const Key& key, const ChunkPointer& chunk) {
    Guard guard(lock);
    const auto found = places.find(key);
    if (found != places.end()) {
        bytes -= found->second->second->bytes();
        entries.erase(found->second);
    }
    entries.emplace_front(key, chunk);
    places[key] = entries.begin();
    bytes += chunk->bytes();
    while (bytes > limit && entries.size() > 1) {
        bytes -= entries.back().second->bytes();
        places.erase(entries.back().first);
        entries.pop_back();
    }
}

// All of a tile that is kept before its head, which is then kept as well; null for none.
static bool find_whole(fhash_file& file, const Array& array, const Cache::Key& key,
                       ChunkPointer& found, fhash_error& error) {
    const ChunkPointer table = file.cache.get({key[0], key[1], UNCORRECTED});
    if (!table) return true;
    const std::shared_ptr<Chunk> whole = std::make_shared<Chunk>();
    int64_t part[8] = {};
    for (size_t a = 0; a < 4; a++) part[2 * a + 1] = array.inner[a];
    if (!may_use(*file.context, 16 * array.inner_values(), error) ||
        !correct_part(*file.context, array, *table, part, *whole, error))
        return false;
    file.cache.put(key, whole);
    found = whole;
    return true;
}

bool visit_chunks(fhash_file& file, const Array& array, const Region& region, int lod,
                  const Visit& visit, fhash_error& error) {
    Lengths first = {}, last = {}, place = {};
    uint64_t count = 1;
    // Whether the region has a position in the chunk along an axis.
    const auto touched = [&](int a) {
        const int64_t start = std::max(place[a] * array.inner[a], region.first[a]);
        const int64_t stop = std::min((place[a] + 1) * array.inner[a], region.last[a]);
        const int64_t step = region.step[a];
        return region.first[a] + (start - region.first[a] + step - 1) / step * step < stop;
    };
    for (int a = 0; a < array.axes; a++) {
        first[a] = place[a] = region.first[a] / array.inner[a];
        last[a] = (region.last[a] - 1) / array.inner[a] + 1;
        count *= uint64_t(last[a] - first[a]);
    }
    if (!may_use(*file.context, count * sizeof(Wanted), error)) return false;
    std::vector<Wanted> wanted;
    for (uint64_t i = 0; i < count; i++) {
        uint64_t number = 0;
        bool needed = true;
        for (int a = 0; a < array.axes; a++) {
            number = number * uint64_t(array.count(array.inner, a)) + uint64_t(place[a]);
            needed = needed && touched(a);
        }
        const Cache::Key key = {array.number, number, uint64_t(lod)};
        ChunkPointer kept = needed ? file.cache.get(key) : nullptr;
        const bool apart = needed && !kept && !lod && is_parted(array);
        if (apart && !find_whole(file, array, key, kept, error)) return false;
        if (needed && !kept) wanted.push_back({place, number, nullptr, 0, 0, 0, 0});
        if (kept && !visit(place, *kept)) return false;
        for (int a = array.axes - 1; a >= 0 && ++place[a] == last[a]; a--) place[a] = first[a];
    }
    if (wanted.empty()) return true;
    Indices indices{file, array};
    Reading reading{file, array, region, lod, visit};
    return indices.locate_all(wanted, error) && reading.read(wanted, error);
}

bool read_region(fhash_file& file, const Array& array, const Region& region, Buffer& values,
                 Buffer* mask, fhash_error& error) {
    const size_t item = fhash_type_size(array.type);
    const uint64_t count = region.size(array.axes);
    if (!may_use(*file.context, count * (item + 1), error)) return false;
    values.resize(size_t(count * item));
    if (mask) mask->assign(size_t(count), 1);
    Lengths shape = {};
    for (int a = 0; a < array.axes; a++) shape[a] = region.last[a] - region.first[a];
    const Lengths strides = strides_of(shape, array.axes);
    const auto visit = [&](const Lengths& place, const Chunk& chunk) {
        const Lengths own = strides_of(chunk.shape, array.axes);
        Lengths counts = {};
        uint64_t from = 0, to = 0;
        for (int a = 0; a < array.axes; a++) {
            const int64_t start = place[a] * array.inner[a];
            const int64_t low = std::max(start, region.first[a]);
            counts[a] = std::min(start + array.inner[a], region.last[a]) - low;
            from += uint64_t((low - start - chunk.first[a]) * own[a]);
            to += uint64_t((low - region.first[a]) * strides[a]);
        }
        copy_region(chunk.values.data() + from * item, own, values.data() + to * item, strides,
                    counts, array.axes, item);
        if (mask && !chunk.mask.empty())
            copy_region(chunk.mask.data() + from, own, mask->data() + to, strides, counts,
                        array.axes, 1);
        return true;
    };
    return visit_chunks(file, array, region, 0, visit, error);
}

}  // namespace fhash
