// Nodes and arrays of an open file, as the Python package reads them. They are no part of the
// interface (fhash.h).
#include <algorithm>
#include <cstring>

#include "chunks.hpp"
#include "functions.h"

using namespace fhash;

namespace {

// Array number `number` of the file, from 1; null for none.
const Array* array_of(const fhash_file* file, int64_t number, fhash_error& error) {
    if (file && number >= 1 && number <= int64_t(file->opened->numbered.size()))
        return file->opened->numbered[size_t(number - 1)];
    fail(error, FHASH_ERROR_ARGUMENT, "the file has no array %lld", (long long)number);
    return nullptr;
}

// A region from pairs of ends along the axes of an array.
bool read_bounds(const Array& array, const int64_t* bounds, bool padded, Region& region,
                 fhash_error& error) {
    for (int a = 0; a < array.axes; a++) {
        region.first[a] = bounds[2 * a];
        region.last[a] = bounds[2 * a + 1];
        const int64_t most = padded ? array.count(array.inner, a) * array.inner[a]
                                    : array.shape[a];
        if (region.first[a] < 0 || region.first[a] >= region.last[a] || region.last[a] > most)
            return fail(error, FHASH_ERROR_ARGUMENT, "a region outside of the array");
    }
    return true;
}

// The members of an array, those of the index of tiles among them; none of no array.
std::vector<uint32_t> members_of(const Array* array) {
    std::vector<uint32_t> found;
    if (array) found = array->members;
    if (array && array->together)
        found.insert(found.end(), array->index->members.begin(), array->index->members.end());
    return found;
}

// The region of a chunk, with its padding.
Region region_of(const Array& array, const int64_t* place) {
    Region region;
    for (int a = 0; a < array.axes; a++) {
        region.first[a] = place[a] * array.inner[a];
        region.last[a] = region.first[a] + array.inner[a];
    }
    return region;
}

constexpr uint64_t PIECE = 1 << 20;  // bytes of a member that are checked at a time

// Checks a member that is stored as it is, piece by piece.
bool check_pieces(const fhash_file& file, const Member& member, fhash_error& error) {
    Buffer bytes;
    const uint64_t header = member.data_offset() - member.offset;
    std::vector<uint64_t> ranges = {member.offset, header};
    for (uint64_t at = 0; at < member.size; at += PIECE)
        ranges.insert(ranges.end(), {member.data_offset() + at, std::min(PIECE, member.size - at)});
    file.source.announce(ranges);
    if (!file.source.read(member.offset, header, bytes, error) ||
        !check_header(member, bytes.data(), error))
        return false;
    uint32_t crc = 0;
    for (size_t i = 2; i < ranges.size(); i += 2) {
        if (!file.source.read(ranges[i], ranges[i + 1], bytes, error)) return false;
        crc = crc_32(bytes.data(), bytes.size(), crc);
    }
    return crc == member.crc ||
           fail(error, FHASH_ERROR_DAMAGED, "member %s: its CRC-32 differs, the data are damaged",
                member.name.c_str());
}

}  // namespace

// A further handle of an open file, which reads with another context. Each is closed on its own.
int32_t fhash_file_with(fhash_context* context, const fhash_file* file, fhash_file** made,
                        fhash_error* error) {
    return reported(error, [&](fhash_error&) {
        *made = new fhash_file(context, file->opened);
        return true;
    });
}

// Node `number`, from 0, in the order of the file; 1, or 0 where there is none.
int32_t fhash_file_node(const fhash_file* file, int64_t number, fhash_node* node) {
    const Opened& opened = *file->opened;
    if (number < 0 || number >= int64_t(opened.hierarchy.nodes.size())) return 0;
    const Node& found = opened.hierarchy.nodes[size_t(number)];
    const Member& document = opened.directory.members[found.member];
    node->path = found.path.c_str();
    node->text = found.text.data();
    node->text_size = found.text.size();
    node->document = document.size;
    node->place = document.end() - document.offset + entry_size(document);
    const Array* const array = opened.hierarchy.find(found.path);
    node->array = array ? array->number : 0;
    node->stored = 0;
    for (const uint32_t number : members_of(array)) {
        const Member& member = opened.directory.members[number];
        node->stored += member.size;
        node->place += member.end() - member.offset + entry_size(member);
    }
    return 1;
}

// Array `number`, from 0, of a variable: its name there; 1, or 0 where there is none.
int32_t fhash_file_place(const fhash_file* file, int32_t variable, int64_t number,
                         const char** name, int64_t* array) {
    if (variable < 0 || size_t(variable) >= file->variables.size()) return 0;
    const auto& arrays = file->variables[size_t(variable)].arrays;
    if (number < 0 || number >= int64_t(arrays.size())) return 0;
    const auto& found = *std::next(arrays.begin(), std::ptrdiff_t(number));
    *name = found.first.c_str();
    *array = found.second->number;
    return 1;
}

// SHA-256 of the directory as 64 hexadecimal digits and a zero byte.
int32_t fhash_file_digest(const fhash_file* file, char* digest) {
    std::memcpy(digest, file->opened->directory.digest, 65);
    return 0;
}

// Sets the bytes of decoded chunks that are kept.
int32_t fhash_file_cache(const fhash_file* file, uint64_t bytes) {
    Guard guard(file->cache.lock);
    file->cache.limit = bytes;
    return 0;
}

// The values of a region, [first, last) along each axis, and which are occupied; either may be
// null. `keep`: whether the cache keeps the chunks.
int32_t fhash_array_read(fhash_file* file, int64_t number, const int64_t* bounds, int32_t keep,
                         void* values, uint8_t* mask, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        const Array* const array = array_of(file, number, failed);
        Region region;
        if (!array || !read_bounds(*array, bounds, false, region, failed)) return false;
        if (mask) std::memset(mask, 1, size_t(region.size(array->axes)));
        return read_into(*file, *array, region, {0, keep != 0, keep != 0},
                         static_cast<uint8_t*>(values), mask, failed);
    });
}

// A full chunk, padding included, at a level of detail.
int32_t fhash_array_chunk(fhash_file* file, int64_t number, const int64_t* place, int32_t lod,
                          int32_t keep, fhash_chunk* chunk, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        const Array* const array = array_of(file, number, failed);
        if (!array) return false;
        const Region region = region_of(*array, place);
        const auto visit = [&](const Lengths&, const Chunk& found) {
            std::copy(found.shape.begin(), found.shape.end(), chunk->shape);
            const ChunkPointer kept = found.shared_from_this();
            chunk->values = found.values.data();
            chunk->mask = found.mask.empty() ? nullptr : found.mask.data();
            chunk->owner = new ChunkPointer(kept);
            return true;
        };
        return visit_chunks(*file, *array, region, {lod, keep != 0, false}, visit, failed);
    });
}

void fhash_chunk_free(void* owner) { delete static_cast<ChunkPointer*>(owner); }

// Where the bytes of a chunk lie, offset and length, and the member that holds them.
int32_t fhash_array_stored(fhash_file* file, int64_t number, const int64_t* place,
                           uint64_t* range, const char** member, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        const Array* const array = array_of(file, number, failed);
        std::vector<Stored> found;
        if (!array || !find_stored(*file, *array, region_of(*array, place), found, failed))
            return false;
        range[0] = found[0].offset + found[0].skip;
        range[1] = found[0].length - found[0].skip;
        *member = file->directory.members[found[0].member].name.c_str();
        return true;
    });
}

// Announces the bytes of the chunks of a region.
int32_t fhash_array_announce(fhash_file* file, int64_t number, const int64_t* bounds,
                             fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        const Array* const array = array_of(file, number, failed);
        Region region;
        std::vector<Stored> found;
        if (!array || !read_bounds(*array, bounds, true, region, failed)) return false;
        if (!file->source.announced) return true;
        if (!find_stored(*file, *array, region, found, failed)) return false;
        std::vector<uint64_t> ranges;
        for (const Stored& each : found) ranges.insert(ranges.end(), {each.offset, each.length});
        file->source.announce(ranges);
        return true;
    });
}

// Checks the members of an array by their checksums.
int32_t fhash_array_check(fhash_file* file, int64_t number, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        const Array* const array = array_of(file, number, failed);
        if (!array) return false;
        for (const uint32_t member : members_of(array))
            if (!check_pieces(*file, file->directory.members[member], failed)) return false;
        return true;
    });
}
