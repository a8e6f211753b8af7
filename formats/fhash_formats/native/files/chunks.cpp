#include "chunks.hpp"

#include <algorithm>
#include <cstring>

#include "core.hpp"
#include "functions.h"
#include "inflate.hpp"

namespace fhash {

namespace {

constexpr uint64_t CHUNK_GAP = 16 << 10;   // bytes between two chunks that are read as well
constexpr uint64_t CHUNK_READ = 8 << 20;   // bytes of a read of several chunks
constexpr uint64_t FAR_READ = 2 << 20;     // the same where reads are announced, and made at once
constexpr uint64_t INDEX = 1000;           // in the place of a level of detail, in the cache
constexpr uint64_t UNCORRECTED = 1001;     // likewise: tiles before their head
constexpr uint64_t APART = 1002;           // likewise: how many parts of a tile were decoded
constexpr int64_t MOST_APART = 3;          // then all of it is decoded
constexpr int FLAGS = 4, KIND = 7, BLOCKS = 6;  // of a stream: place and bits of the kind

#if defined(FHASH_SMALL)
constexpr bool WHOLE = true;  // the page draws whole frames of tiles: it needs no parts of them
#else
constexpr bool WHOLE = false;
#endif

// An inner chunk that is to be read.
struct Wanted {
    Lengths place;
    uint64_t number;    // in the grid of inner chunks
    bool ahead;         // whether nobody asked for it yet
    Stored stored;
    uint64_t within;    // number in its member
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
    const bool own = array.tiles() && !array.settings.empty();
    const bool headed = own && (uint8_t(array.settings[0]) & 32);
    return headed && !array.masked() && array.usual && array.axes == 4;
}

// Whether a part of a tile may be had from some of its blocks.
bool is_boxed(const Array& array) {
    return array.tiles() && !array.masked() && array.usual && array.axes == 4;
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
    if (array.tiles()) return decode_tile(context, array, data, size, lod, chunk, error);
    if (lod) return fail(error, FHASH_ERROR_ARGUMENT, "the array has no levels of detail");
    const uint64_t bytes = array.inner_values() * fhash_type_size(array.type);
    chunk.shape = array.inner;
    return may_use(context, bytes + size, error) && check_crc(data, size, error) &&
           zstd_exact(data, size - 4, bytes, bytes, chunk.values, error);
}

// Where inner chunks lie in their members.
struct Indices {
    fhash_file& file;
    const Array& array;

    const Member& member_of(const Array& of, uint64_t number) const {
        return file.directory.members[of.members[size_t(number)]];
    }

    // Whether tile `within` of member `number` holds a vertex of the array.
    bool present(uint64_t number, uint64_t within) const {
        for (int a = array.axes - 1; a >= 0; a--) {
            const uint64_t along = uint64_t(array.per_chunk(a));
            const uint64_t members = uint64_t(array.count(array.chunk, a));
            const uint64_t at = number % members * along + within % along;
            if (at >= uint64_t(array.count(array.inner, a))) return false;
            number /= members;
            within /= along;
        }
        return true;
    }

    // Where each tile of a member begins in its data, of the bytes that the index says of each; the
    // tiles fill the member.
    bool add_up(uint64_t number, const Buffer& sizes, Buffer& starts, fhash_error& error) const {
        const size_t count = sizes.size() / 4;
        const uint64_t size = member_of(array, number).size;
        uint64_t position = 0;
        starts.resize(8 * (count + 1));
        for (size_t i = 0; i <= count; i++) {
            std::memcpy(starts.data() + 8 * i, &position, 8);
            const uint64_t next = i < count ? from_little(sizes.data() + 4 * i, 4) : 0;
            if (next > size - position || (i < count && (next != 0) != present(number, i)))
                return fail(error, FHASH_ERROR_DAMAGED, "the index of its tiles has other bytes");
            position += next;
        }
        return position == size ||
               fail(error, FHASH_ERROR_DAMAGED, "the index of its tiles leaves bytes out");
    }

    // The same from the file, or from the cache.
    ChunkPointer starts(uint64_t number, fhash_error& error) {
        const Cache::Key key = {array.number, number, INDEX};
        if (ChunkPointer found = file.cache.get(key)) return found;
        const Member& member = member_of(*array.index, number);
        const uint64_t header = member.data_offset() - member.offset;
        const std::shared_ptr<Chunk> made = std::make_shared<Chunk>();
        Buffer bytes;
        Chunk sizes;
        if (!file.source.read(member.offset, member.end() - member.offset, bytes, error))
            return nullptr;
        if (!check_member(member, bytes.data(), error) ||
            !decode_chunk(*file.context, *array.index, bytes.data() + header, size_t(member.size),
                          0, sizes, error)) {
            fail_in(error, "member " + member.name);
            return nullptr;
        }
        if (!add_up(number, sizes.values, made->values, error)) {
            fail_in(error, "member " + member_of(array, number).name);
            return nullptr;
        }
        file.cache.put(key, made);
        return made;
    }

    // The number of the member of an inner chunk, which gets that of itself there and the bytes of
    // the whole member.
    uint64_t find_member(Wanted& wanted) const {
        uint64_t number = 0;
        wanted.within = 0;
        for (int a = 0; a < array.axes; a++) {
            const int64_t along = array.per_chunk(a);
            number = number * uint64_t(array.count(array.chunk, a)) +
                     uint64_t(wanted.place[a] / along);
            wanted.within = wanted.within * uint64_t(along) + uint64_t(wanted.place[a] % along);
        }
        const Member& member = member_of(array, number);
        wanted.stored.member = array.members[size_t(number)];
        wanted.stored.offset = member.offset;
        wanted.stored.length = member.end() - member.offset;
        wanted.stored.skip = member.data_offset() - member.offset;
        return number;
    }

    bool locate_all(std::vector<Wanted>& wanted, fhash_error& error) {
        std::map<uint64_t, std::vector<Wanted*>> members;
        for (Wanted& each : wanted) {
            const uint64_t number = find_member(each);
            if (array.together) members[number].push_back(&each);
        }
        std::vector<uint64_t> ranges;
        for (const auto& each : members) {
            if (!file.source.announced || file.cache.get({array.number, each.first, INDEX}))
                continue;
            const Member& member = member_of(*array.index, each.first);
            ranges.insert(ranges.end(), {member.offset, member.end() - member.offset});
        }
        file.source.announce(ranges);
        for (const auto& each : members) {
            const ChunkPointer found = starts(each.first, error);
            if (!found) return false;
            for (Wanted* one : each.second) {
                uint64_t ends[2];
                std::memcpy(ends, found->values.data() + 8 * one->within, sizeof ends);
                one->stored.offset += one->stored.skip + ends[0];
                one->stored.length = ends[1] - ends[0];
                one->stored.skip = 0;
            }
        }
        return true;
    }
};

// A chunk for the caller, and what is kept instead of it where it is a part: the tile before its
// head, or a mark of how many parts were decoded.
struct Decoded {
    std::shared_ptr<Chunk> chunk, table, mark;
};

// Bytes that are read at once: of some inner chunks, one after the other.
struct Span {
    uint64_t start, stop;
    size_t count;  // inner chunks in it
    bool needed;   // whether somebody asked for one of them
    bool lost;     // whether they cannot be read, and are not needed
    Buffer bytes;
};

// Reads and decodes chunks, those that lie together with one read, several at once in threads.
struct Reading {
    fhash_file& file;
    const Array& array;
    const Region& region;
    const Manner& manner;
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
        } else decoded.chunk = std::make_shared<Chunk>();
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
        const Member& member = file.directory.members[wanted.stored.member];
        if (!array.together && !check_member(member, data, error)) return false;
        const uint8_t* const stream = data + wanted.stored.skip;
        const size_t size = size_t(wanted.stored.length - wanted.stored.skip);
        bool done = false, good = true;
        decoded.chunk = std::make_shared<Chunk>();
        if (!WHOLE && !manner.lod && manner.keep && is_boxed(array)) {
            good = decode_region(wanted, stream, size, decoded, error);
            done = decoded.mark != nullptr;
        }
        if (good && !done && !manner.lod && manner.keep && is_parted(array)) {
            decoded.table = std::make_shared<Chunk>();
            good = decode_part(wanted, stream, size, *decoded.table, *decoded.chunk, done, error);
        }
        if (!done) decoded.table = nullptr;
        if (good && !done)
            good = decode_chunk(*file.context, array, stream, size, manner.lod, *decoded.chunk,
                                error);
        if (good) return true;
        std::string name = "member " + member.name;
        if (array.together) name += ": tile " + std::to_string(wanted.within);
        return fail_in(error, name);
    }

    // Keeps what was decoded, and lets the caller see it.
    bool take(const Wanted& wanted, const Decoded& decoded) {
        uint64_t kind = uint64_t(manner.lod);
        std::shared_ptr<Chunk> kept = decoded.chunk;
        if (decoded.mark) kind = APART, kept = decoded.mark;
        else if (decoded.table) kind = UNCORRECTED, kept = decoded.table;
        if (manner.keep) file.cache.put({array.number, wanted.number, kind}, kept);
        return wanted.ahead || visit(wanted.place, *decoded.chunk);
    }

    size_t usual_threads() const {
        const uint64_t each = array.inner_values() * (fhash_type_size(array.type) + 1);
        const uint64_t threads = uint64_t(file.context->threads);
        if (!file.context->memory) return size_t(threads);
        // No more at once than the memory allows.
        return size_t(std::min(threads, std::max<uint64_t>(1, file.context->memory / 32 / each)));
    }

    // Decodes chunks whose bytes were read, as many at once as there are threads.
    bool decode_all(const Wanted* wanted, const std::vector<Span>& spans, fhash_error& error) {
        std::vector<const uint8_t*> places;
        std::vector<uint8_t> lost;
        for (const Span& span : spans) lost.insert(lost.end(), span.count, span.lost);
        for (const Span& span : spans)
            for (size_t i = 0; i < span.count; i++)
                places.push_back(span.bytes.data() +
                                 (wanted[places.size()].stored.offset - span.start));
        const size_t threads = usual_threads();
        for (size_t first = 0; first < places.size(); first += threads) {
            const size_t now = std::min(threads, places.size() - first);
            std::vector<Decoded> chunks(now);
            std::vector<fhash_error> errors(now);
            std::vector<uint8_t> done(now, 0);
            const auto work = [&](int i) {
                const size_t at = first + size_t(i);
                done[size_t(i)] = !lost[at] && decode(wanted[at], places[at], chunks[size_t(i)],
                                                      errors[size_t(i)]);
            };
            if (now == 1) work(0);
            else together(int(now), work);
            for (size_t i = 0; i < now; i++) {
                if (!done[i] && wanted[first + i].ahead) continue;  // it fails again once wanted
                if (!done[i]) error = errors[i];
                if (!done[i] || !take(wanted[first + i], chunks[i])) return false;
            }
        }
        return true;
    }

    // The reads of some chunks, which are in the order of the file.
    std::vector<Span> spans_of(const std::vector<Wanted>& wanted) const {
        const uint64_t memory = file.context->memory;
        const uint64_t usual = file.source.announced ? FAR_READ : CHUNK_READ;
        const uint64_t most = memory ? std::min(usual, memory / 8) : usual;
        std::vector<Span> spans;
        for (const Wanted& each : wanted) {
            const uint64_t start = each.stored.offset, end = start + each.stored.length;
            const bool near = !spans.empty() && start <= spans.back().stop + CHUNK_GAP &&
                              std::max(end, spans.back().stop) - spans.back().start <= most;
            if (!near) spans.push_back({start, end, 0, false, false, {}});
            spans.back().stop = std::max(spans.back().stop, end);
            spans.back().count++;
            spans.back().needed = spans.back().needed || !each.ahead;
        }
        return spans;
    }

    bool read(std::vector<Wanted>& wanted, fhash_error& error) {
        std::sort(wanted.begin(), wanted.end(), [](const Wanted& a, const Wanted& b) {
            return a.stored.offset < b.stored.offset;
        });
        std::vector<Span> spans = spans_of(wanted);
        std::vector<uint64_t> ranges;
        for (const Span& span : spans)
            ranges.insert(ranges.end(), {span.start, span.stop - span.start});
        file.source.announce(ranges);
        size_t begun = 0;
        for (size_t next = 0; next < spans.size();) {
            // Several reads together, where one has too few chunks for the threads.
            std::vector<Span> some;
            size_t count = 0;
            while (next < spans.size() && (some.empty() || count < usual_threads())) {
                Span& span = spans[next++];
                if (!file.source.read(span.start, span.stop - span.start, span.bytes, error)) {
                    if (span.needed) return false;
                    span.lost = true;
                }
                count += span.count;
                some.push_back(std::move(span));
            }
            if (!decode_all(wanted.data() + begun, some, error)) return false;
            begun += count;
        }
        return true;
    }
};

// How many layers of chunks after those of a read are worth decoding with them: the number of times
// that reads in a row went on along the first axis, without a gap and with the same chunks of the
// other axes; 0 for a read that does not go on.
int64_t layers_after(fhash_file& file, const Array& array, const Lengths& first,
                     const Lengths& last) {
    Opened& opened = *file.opened;
    Guard guard(opened.lock);
    const bool known = opened.courses.count(array.number) != 0;
    Course& course = opened.courses[array.number];
    const Lengths begun = course.first, ended = course.last;
    course.first = first;
    course.last = last;
    const auto same = [&](int from) {
        return std::equal(first.begin() + from, first.begin() + array.axes, begun.begin() + from) &&
               std::equal(last.begin() + from, last.begin() + array.axes, ended.begin() + from);
    };
    if (!known || !same(1)) course.moves = 0;
    else if (first[0] <= ended[0] && ended[0] < last[0]) return ++course.moves;
    else if (!same(0)) course.moves = 0;
    return 0;
}

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

// The chunks of a region.
struct Grid {
    const Array& array;
    const Region& region;
    Lengths first = {}, last = {};  // along each axis
    uint64_t count = 1;

    Grid(const Array& of, const Region& within) : array(of), region(within) {
        for (int a = 0; a < array.axes; a++) {
            first[a] = region.first[a] / array.inner[a];
            last[a] = (region.last[a] - 1) / array.inner[a] + 1;
            count *= uint64_t(last[a] - first[a]);
        }
    }
    // Whether the region has a position in a chunk.
    bool touches(const Lengths& place) const {
        for (int a = 0; a < array.axes; a++) {
            const int64_t start = std::max(place[a] * array.inner[a], region.first[a]);
            const int64_t stop = std::min((place[a] + 1) * array.inner[a], region.last[a]);
            const int64_t step = region.step[a];
            if (region.first[a] + (start - region.first[a] + step - 1) / step * step >= stop)
                return false;
        }
        return true;
    }
    uint64_t number(const Lengths& place) const {
        uint64_t found = 0;
        for (int a = 0; a < array.axes; a++)
            found = found * uint64_t(array.count(array.inner, a)) + uint64_t(place[a]);
        return found;
    }
    // Calls `work` for each place between two ends, until it fails.
    template <class Work> bool each(const Lengths& from, const Lengths& to, Work work) const {
        Lengths place = from;
        while (place[0] < to[0]) {
            if (!work(place)) return false;
            int a = array.axes - 1;
            for (place[a]++; a > 0 && place[a] == to[a]; place[a]++) {
                place[a] = from[a];
                a--;
            }
        }
        return true;
    }
};

// Adds chunks that a reader who goes on wants next, one for each thread without work.
static void add_ahead(fhash_file& file, const Grid& grid, Indices& indices,
                      std::vector<Wanted>& wanted) {
    const Array& array = grid.array;
    const int64_t layers = layers_after(file, array, grid.first, grid.last);
    const uint64_t each = array.inner_values() * fhash_type_size(array.type);
    // They and those of the read take half of the cache at most.
    const uint64_t most = std::min(uint64_t(file.context->threads), file.cache.limit / each / 2);
    if (!layers || wanted.empty() || !array.together) return;
    Lengths from = grid.first, to = grid.last;
    from[0] = grid.last[0];
    to[0] = std::min(from[0] + layers, array.count(array.inner, 0));
    if (from[0] >= to[0]) return;
    std::vector<Wanted> after;
    grid.each(from, to, [&](const Lengths& place) {
        const uint64_t number = grid.number(place);
        if (wanted.size() + after.size() >= most) return false;
        if (!file.cache.get({array.number, number, 0}) &&
            !file.cache.get({array.number, number, UNCORRECTED}))
            after.push_back({place, number, true, {}, 0});
        return true;
    });
    fhash_error ignored;  // what fails now fails again once it is wanted
    if (indices.locate_all(after, ignored))
        wanted.insert(wanted.end(), after.begin(), after.end());
}

bool visit_chunks(fhash_file& file, const Array& array, const Region& region, const Manner& manner,
                  const Visit& visit, fhash_error& error) {
    const Grid grid(array, region);
    if (!may_use(*file.context, grid.count * sizeof(Wanted), error)) return false;
    std::vector<Wanted> wanted;
    const auto look = [&](const Lengths& place) {
        if (!grid.touches(place)) return true;
        const Cache::Key key = {array.number, grid.number(place), uint64_t(manner.lod)};
        ChunkPointer kept = file.cache.get(key);
        const bool apart = !kept && !manner.lod && is_parted(array);
        if (apart && !find_whole(file, array, key, kept, error)) return false;
        if (!kept) wanted.push_back({place, key[1], false, {}, 0});
        return !kept || visit(place, *kept);
    };
    if (!grid.each(grid.first, grid.last, look)) return false;
    Indices indices{file, array};
    if (!wanted.empty() && !indices.locate_all(wanted, error)) return false;
    if (!WHOLE && manner.ahead) add_ahead(file, grid, indices, wanted);
    return wanted.empty() || Reading{file, array, region, manner, visit}.read(wanted, error);
}

bool find_stored(fhash_file& file, const Array& array, const Region& region,
                 std::vector<Stored>& found, fhash_error& error) {
    const Grid grid(array, region);
    if (!may_use(*file.context, grid.count * sizeof(Wanted), error)) return false;
    std::vector<Wanted> wanted;
    grid.each(grid.first, grid.last, [&](const Lengths& place) {
        wanted.push_back({place, grid.number(place), false, {}, 0});
        return true;
    });
    Indices indices{file, array};
    if (!indices.locate_all(wanted, error)) return false;
    for (const Wanted& each : wanted) found.push_back(each.stored);
    return true;
}

bool read_into(fhash_file& file, const Array& array, const Region& region, const Manner& manner,
               uint8_t* values, uint8_t* mask, fhash_error& error) {
    const size_t item = fhash_type_size(array.type);
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
        if (values)
            copy_region(chunk.values.data() + from * item, own, values + to * item, strides,
                        counts, array.axes, item);
        if (mask && !chunk.mask.empty())
            copy_region(chunk.mask.data() + from, own, mask + to, strides, counts, array.axes, 1);
        return true;
    };
    return visit_chunks(file, array, region, manner, visit, error);
}

bool read_region(fhash_file& file, const Array& array, const Region& region, Buffer& values,
                 Buffer* mask, fhash_error& error) {
    const size_t item = fhash_type_size(array.type);
    const uint64_t count = region.size(array.axes);
    if (!may_use(*file.context, count * (item + 1), error)) return false;
    values.resize(size_t(count * item));
    if (mask) mask->assign(size_t(count), 1);
    return read_into(file, array, region, {}, values.data(), mask ? mask->data() : nullptr, error);
}

}  // namespace fhash
