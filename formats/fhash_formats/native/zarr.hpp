// The Zarr hierarchy of a file: documents, and arrays with the members that hold their chunks
// (FORMAT.md, Zarr).
#pragma once

#include <map>
#include <memory>
#include <set>

#include "json.hpp"
#include "zip.hpp"

namespace fhash {

constexpr int MAX_AXES = 8;
using Lengths = std::array<int64_t, MAX_AXES>;  // one number for each axis of an array

// An array. An inner chunk is what is decoded at once: a chunk, or a tile, of which a member of the
// file may hold several.
struct Array {
    std::string path;
    uint32_t number = 0;  // of the array in the file
    int axes = 0;
    Lengths shape = {}, chunk = {}, inner = {};
    int32_t type = 0;
    std::shared_ptr<Array> index;  // of tiles: how many bytes each has; null for an ordinary array
    bool together = false;         // whether members have several tiles
    std::string settings;  // packed, of tiles; empty where each stream has its own
    int places[MAX_AXES] = {};  // axis of the tile (0 to 3 for t, z, y, x) of each axis, or -1
    bool usual = true;  // whether the axes are the last of t, z, y, x
    Json attributes = nullptr;  // an object, or null for none
    std::vector<uint32_t> members;  // of the chunks, in C order

    // Whether it is coded by fhash.transform, else bytes, zstd and crc32c.
    bool tiles() const { return index != nullptr; }
    // Whether tiles say which of their values are occupied.
    bool masked() const { return !settings.empty() && (uint8_t(settings[0]) & 64); }
    int64_t count(const Lengths& lengths, int axis) const {
        return (shape[axis] + lengths[axis] - 1) / lengths[axis];
    }
    // Inner chunks of a chunk along an axis.
    int64_t per_chunk(int axis) const { return chunk[axis] / inner[axis]; }
    uint64_t inner_values() const {
        uint64_t product = 1;
        for (int a = 0; a < axes; a++) product *= uint64_t(inner[a]);
        return product;
    }
};

// A group or an array.
struct Node {
    std::string path, text;  // the text is that of its zarr.json
    uint32_t member;         // which is the document
};

constexpr char BASE64[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

struct Hierarchy {
    std::vector<JsonDocument> documents;
    std::vector<Node> nodes;  // in the order of the file
    std::map<std::string, Array> arrays;  // by path
    Json root = nullptr;  // attributes of the root

    const Array* find(const std::string& path) const;
};

// The type of a name; 0 for none.
int32_t type_of_name(const char* name);
std::string name_of_type(int32_t type);

// Checks the version and the required features in the attribute `fhash` of the root
// (variable.cpp).
bool check_format(Json header, fhash_error& error);

bool read_hierarchy(const Source& source, const Directory& directory, Hierarchy& found,
                    fhash_error& error);

}  // namespace fhash
