#include "zarr.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace fhash {

namespace {

constexpr int64_t MAX_AXIS = int64_t(1) << 62;
constexpr uint64_t MAX_CHUNK_BYTES = 1 << 30;     // of a decoded inner chunk
constexpr uint64_t MAX_TILE = 1 << 27;            // vertices
constexpr uint64_t MAX_TOGETHER = 1 << 20;        // tiles of a member
constexpr uint64_t MAX_DOCUMENT = 16 << 20;
constexpr uint64_t DOCUMENT_GAP = 16 << 10;   // bytes between documents that are read as well
constexpr uint64_t DOCUMENT_READ = 16 << 20;  // bytes of a read of several documents
const char* const TYPES[12] = {"",       "int8",   "int16",  "int32",   "int64",   "uint8",
                               "uint16", "uint32", "uint64", "float16", "float32", "float64"};
const char* const TILE_AXES[4] = {"t", "z", "y", "x"};

bool is(Json value, const char* text) {
    return yyjson_is_str(value) && yyjson_get_len(value) == std::strlen(text) &&
           std::strcmp(yyjson_get_str(value), text) == 0;
}

bool damaged(fhash_error& error, const char* what) {
    return fail(error, FHASH_ERROR_DAMAGED, "%s", what);
}
bool unsupported(fhash_error& error, const char* what) {
    return fail(error, FHASH_ERROR_UNSUPPORTED, "%s", what);
}

// Refuses unknown keys, unless their object says that they need not be understood.
bool check_keys(Json object, std::initializer_list<const char*> known, fhash_error& error) {
    yyjson_obj_iter iter = yyjson_obj_iter_with(object);
    while (Json key = yyjson_obj_iter_next(&iter)) {
        const auto same = [&](const char* name) { return is(key, name); };
        if (std::any_of(known.begin(), known.end(), same)) continue;
        if (yyjson_is_false(yyjson_obj_get(yyjson_obj_iter_get_val(key), "must_understand")))
            continue;
        return fail(error, FHASH_ERROR_UNSUPPORTED, "key %s is not known",
                    shown(yyjson_get_str(key)).c_str());
    }
    return true;
}

// A list of lengths along the axes of an array.
bool read_lengths(Json list, Lengths& lengths, int& axes, const char* what, fhash_error& error) {
    const size_t count = yyjson_is_arr(list) ? yyjson_arr_size(list) : 0;
    bool good = count >= 1 && count <= MAX_AXES;
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? list : nullptr);
    for (size_t i = 0; good && i < count; i++)
        good = is_whole(yyjson_arr_iter_next(&iter), 1, MAX_AXIS, lengths[i]);
    axes = int(count);
    return good || fail(error, FHASH_ERROR_DAMAGED, "%s has no 1 to 8 allowed lengths", what);
}

// The product of some lengths; 0 where it is beyond `most`.
uint64_t product_within(const Lengths& lengths, int axes, uint64_t most) {
    uint64_t product = 1;
    for (int a = 0; a < axes; a++) {
        if (uint64_t(lengths[a]) > most / product) return 0;
        product *= uint64_t(lengths[a]);
    }
    return product;
}

bool from_base64(const char* text, size_t size, std::string& bytes) {
    if (size % 4) return false;
    for (size_t i = 0; i < size; i += 4) {
        uint32_t group = 0;
        int pads = 0;
        for (size_t k = 0; k < 4; k++) {
            const char letter = text[i + k];
            const char* place = letter ? std::strchr(BASE64, letter) : nullptr;
            if (letter == '=' && i + 4 == size && k >= 2) pads++;
            if ((letter != '=' || !pads) && (!place || pads)) return false;
            group = group << 6 | uint32_t(place ? place - BASE64 : 0);
        }
        for (int k = 2; k >= pads; k--) bytes += char(group >> 8 * k);
    }
    return true;
}

// The axes of tiles: for each axis of the array that of the tile.
bool read_places(Json list, Array& array, fhash_error& error) {
    bool taken[4] = {};
    bool good = yyjson_is_arr(list) && yyjson_arr_size(list) == size_t(array.axes);
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? list : nullptr);
    array.usual = true;
    for (int a = 0; good && a < array.axes; a++) {
        const Json name = yyjson_arr_iter_next(&iter);
        const auto found = std::find_if(TILE_AXES, TILE_AXES + 4,
                                        [&](const char* axis) { return is(name, axis); });
        const int place = int(found - TILE_AXES);
        array.places[a] = place < 4 ? place : -1;
        good = place < 4 ? !taken[place] : is(name, "") && array.inner[a] == 1;
        if (place < 4) taken[place] = true;
        array.usual = array.usual && place == a + 4 - array.axes;
    }
    return good || damaged(error, "attribute tiles: axes are not allowed");
}

// chunkless: the index of tiles that are members of their own, which has no chunks to code.
bool read_plain(Json codecs, const Array& array, bool chunkless, fhash_error& error) {
    const char* const little = R"({"name":"bytes","configuration":{"endian":"little"}})";
    const Json first = yyjson_arr_get(codecs, 0), zstd = yyjson_arr_get(codecs, 1);
    const Json settings = yyjson_obj_get(zstd, "configuration");
    const bool bare = yyjson_arr_size(codecs) == 1;
    bool good = bare || (yyjson_arr_size(codecs) == 3 && is(yyjson_obj_get(zstd, "name"), "zstd") &&
                yyjson_obj_size(zstd) == 2 && yyjson_obj_size(settings) == 2 &&
                yyjson_is_int(yyjson_obj_get(settings, "level")) &&
                yyjson_is_false(yyjson_obj_get(settings, "checksum")) &&
                json_is(yyjson_arr_get(codecs, 2), R"({"name":"crc32c"})"));
    const bool one = fhash_type_size(array.type) == 1 && json_is(first, R"({"name":"bytes"})");
    good = good && bare == chunkless && (one || json_is(first, little));
    return good || unsupported(error, "codecs other than bytes, zstd, crc32c");
}

// What `tiles` says of them; the array has been read as their index.
bool read_tiles(Json tiles, Array& array, fhash_error& error) {
    if (!yyjson_is_obj(tiles) || !is(yyjson_obj_get(tiles, "codec"), "fhash.transform"))
        return unsupported(error, "attribute tiles: of another codec than fhash.transform");
    if (!check_keys(tiles, {"shape", "data_type", "tile", "codec", "settings", "axes", "package"},
                    error))
        return fail_in(error, "attribute tiles");
    if (array.type != FHASH_UINT32)
        return damaged(error, "the index of tiles is no array of uint32");
    array.index = std::make_shared<Array>(array);
    const Array& index = *array.index;
    const Json type = yyjson_obj_get(tiles, "data_type"), axes = yyjson_obj_get(tiles, "axes"),
               settings = yyjson_obj_get(tiles, "settings");
    array.type = yyjson_is_str(type) ? type_of_name(yyjson_get_str(type)) : 0;
    if (!array.type) return unsupported(error, "attribute tiles: data_type is not allowed");
    int more[2] = {};
    if (!read_lengths(yyjson_obj_get(tiles, "shape"), array.shape, more[0], "tiles.shape", error) ||
        !read_lengths(yyjson_obj_get(tiles, "tile"), array.inner, more[1], "tiles.tile", error))
        return false;
    bool good = more[0] == array.axes && more[1] == array.axes;
    for (int a = 0; good && a < array.axes; a++) {
        good = array.inner[a] <= MAX_AXIS / index.chunk[a] &&
               array.count(array.inner, a) == index.shape[a];
        array.chunk[a] = good ? array.inner[a] * index.chunk[a] : 1;
        array.together = array.together || index.chunk[a] > 1;
    }
    if (!good || !product_within(index.chunk, array.axes, MAX_TOGETHER))
        return damaged(error, "attribute tiles: they do not fit to their index");
    if (!product_within(array.inner, array.axes, MAX_TILE))
        return damaged(error, "tiles of more than 2^27 vertices");
    if (settings && (!yyjson_is_str(settings) ||
                     !from_base64(yyjson_get_str(settings), yyjson_get_len(settings),
                                  array.settings) || array.settings.empty()))
        return damaged(error, "attribute tiles: settings are no base64");
    if (axes) return read_places(axes, array, error);
    if (array.axes > 4) return damaged(error, "fhash.transform codes arrays of at most 4 axes");
    for (int a = 0; a < array.axes; a++) array.places[a] = a + 4 - array.axes;
    return true;
}

bool check_names(Json names, int axes, fhash_error& error) {
    if (!names || yyjson_is_null(names)) return true;
    bool good = yyjson_is_arr(names) && yyjson_arr_size(names) == size_t(axes);
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? names : nullptr);
    while (Json name = yyjson_arr_iter_next(&iter))
        good = good && (yyjson_is_null(name) || yyjson_is_str(name));
    return good || damaged(error, "dimension_names is no list of a name for each axis");
}

// The array that a document describes.
bool read_array(Json values, Array& array, fhash_error& error) {
    if (!check_keys(values,
                    {"zarr_format", "node_type", "shape", "data_type", "chunk_grid",
                     "chunk_key_encoding", "fill_value", "codecs", "attributes", "dimension_names",
                     "storage_transformers"},
                    error))
        return false;
    const Json type = yyjson_obj_get(values, "data_type");
    array.type = yyjson_is_str(type) ? type_of_name(yyjson_get_str(type)) : 0;
    if (!array.type) return unsupported(error, "data_type is not allowed");
    int axes = 0;
    if (!read_lengths(yyjson_obj_get(values, "shape"), array.shape, array.axes, "shape", error))
        return false;
    const Json grid = yyjson_obj_get(values, "chunk_grid");
    const Json configuration = yyjson_obj_get(grid, "configuration");
    if (!is(yyjson_obj_get(grid, "name"), "regular") || !yyjson_is_obj(configuration))
        return unsupported(error, "only regular grids of chunks are allowed");
    if (!read_lengths(yyjson_obj_get(configuration, "chunk_shape"), array.chunk, axes,
                      "chunk_shape", error))
        return false;
    if (axes != array.axes) return damaged(error, "chunks have other axes than their array");
    const Json encoding = yyjson_obj_get(values, "chunk_key_encoding");
    if (!json_is(encoding, R"({"name":"default"})") &&
        !json_is(encoding, R"({"name":"default","configuration":{"separator":"/"}})"))
        return unsupported(error, "only the default chunk_key_encoding with '/' is allowed");
    const Json fill = yyjson_obj_get(values, "fill_value");
    if (!yyjson_is_num(fill) || yyjson_get_num(fill) != 0)
        return unsupported(error, "only 0 is allowed as fill_value");
    const Json transformers = yyjson_obj_get(values, "storage_transformers");
    if (transformers && (!yyjson_is_arr(transformers) || yyjson_arr_size(transformers)))
        return unsupported(error, "storage_transformers are not allowed");
    if (!check_names(yyjson_obj_get(values, "dimension_names"), array.axes, error)) return false;
    const Json codecs = yyjson_obj_get(values, "codecs");
    if (!yyjson_is_arr(codecs)) return damaged(error, "codecs is not a list");
    array.attributes = yyjson_obj_get(values, "attributes");
    array.inner = array.chunk;
    const Json tiles = yyjson_obj_get(array.attributes, "tiles");
    if (!product_within(array.inner, array.axes, MAX_CHUNK_BYTES / fhash_type_size(array.type)))
        return damaged(error, "chunks of more than 2^30 bytes");
    const bool chunkless = tiles && product_within(array.chunk, array.axes, 1);
    return read_plain(codecs, array, chunkless, error) &&
           (!tiles || read_tiles(tiles, array, error));
}

// Splits the name of a chunk's member, "path/c/0/1", or of that of tiles, "path/t/0", into the path
// and the index; false for others.
bool split_chunk(const std::string& name, std::string& path, std::vector<int64_t>& index,
                 bool& tiles) {
    size_t stop = name.size();
    index.clear();
    while (true) {
        const size_t slash = name.rfind('/', stop - 1);
        if (slash == std::string::npos || slash == 0) return false;
        const std::string part = name.substr(slash + 1, stop - slash - 1);
        tiles = part == "t" && index.size() == 1;
        if (tiles || (part == "c" && !index.empty())) {
            path = name.substr(0, slash);
            std::reverse(index.begin(), index.end());
            return true;
        }
        // 18 digits are below 2^63.
        if (part.empty() || part.size() > 18 || (part.size() > 1 && part[0] == '0') ||
            part.find_first_not_of("0123456789") != std::string::npos || index.size() > MAX_AXES)
            return false;
        index.push_back(int64_t(std::strtoull(part.c_str(), nullptr, 10)));
        stop = slash;
    }
}

constexpr uint32_t NO_MEMBER = 0xFFFFFFFF;

// Gives an array room for its members, of which the file has `count`.
bool make_room(Array& array, uint64_t count, fhash_error& error) {
    uint64_t chunks = 1;
    for (int a = 0; a < array.axes && chunks; a++) {
        const uint64_t along = uint64_t(array.count(array.chunk, a));
        chunks = along > count / chunks ? 0 : chunks * along;
    }
    if (chunks != count || !count)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "array %s has %llu chunks; another number is declared", array.path.c_str(),
                    (unsigned long long)count);
    array.members.assign(size_t(count), NO_MEMBER);
    return true;
}

bool place_member(Array& array, const std::vector<int64_t>& index, bool linear, uint32_t number) {
    uint64_t place = uint64_t(index[0]);
    if (!linear) {
        if (index.size() != size_t(array.axes)) return false;
        place = 0;
        for (int a = 0; a < array.axes; a++) {
            const int64_t along = array.count(array.chunk, a);
            if (index[size_t(a)] >= along) return false;
            place = place * uint64_t(along) + uint64_t(index[size_t(a)]);
        }
    }
    if (place >= array.members.size()) return false;
    array.members[size_t(place)] = number;  // names are unique, so no place is taken twice
    return true;
}

bool place_chunks(const Directory& directory, Hierarchy& found, fhash_error& error) {
    std::map<const Array*, uint64_t> counts;
    std::string path;
    std::vector<int64_t> index;
    bool linear = false;
    // The array, or the index of one of tiles, of which a member is a chunk; null for none.
    const auto array_of = [&](const Member& member) -> Array* {
        if (!split_chunk(member.name, path, index, linear)) return nullptr;
        const auto at = found.arrays.find(path);
        if (at == found.arrays.end() || (linear && !at->second.tiles())) return nullptr;
        if (linear || !at->second.tiles()) return &at->second;
        return at->second.together ? at->second.index.get() : nullptr;
    };
    for (const Member& member : directory.members)
        if (const Array* const array = array_of(member)) counts[array]++;
    for (auto& each : found.arrays) {
        Array& array = each.second;
        if (!make_room(array, counts[&array], error) ||
            (array.together && !make_room(*array.index, counts[array.index.get()], error)))
            return false;
    }
    for (uint32_t number = 0; number < directory.members.size(); number++) {
        const Member& member = directory.members[number];
        if (is_document(member.name)) continue;
        Array* const array = array_of(member);
        if (!array || !place_member(*array, index, linear, number))
            return fail(error, FHASH_ERROR_DAMAGED, "member %s belongs to no array",
                        member.name.c_str());
    }
    return true;
}

// Reads the documents of all nodes, those that lie together at once.
struct Documents {
    const Source& source;
    const Directory& directory;
    std::map<std::string, Json> nodes;  // by path
    std::map<std::string, std::string> texts;
    std::vector<JsonDocument>& kept;

    static std::string path_of(const Member& member) {
        const size_t slash = member.name.rfind('/');
        return slash == std::string::npos ? "" : member.name.substr(0, slash);
    }

    bool add(const Member& member, Json values, fhash_error& error) {
        const Json type = yyjson_obj_get(values, "node_type");
        int64_t three = 0;
        bool good = is_whole(yyjson_obj_get(values, "zarr_format"), 3, 3, three) &&
                    (is(type, "array") || is(type, "group"));
        if (!good) unsupported(error, "not the metadata of a Zarr v3 array or group");
        if (good && is(type, "group"))
            good = check_keys(values, {"zarr_format", "node_type", "attributes"}, error);
        const Json attributes = yyjson_obj_get(values, "attributes");
        if (good && attributes && !yyjson_is_obj(attributes))
            good = damaged(error, "attributes is not an object");
        nodes[path_of(member)] = values;
        return good || fail_in(error, "member " + member.name);
    }

    // Parses a document from its local header, name and data.
    bool parse(const Member& member, const uint8_t* stored, fhash_error& error) {
        Buffer bytes;
        if (!open_member(member, stored, bytes, error)) return false;
        JsonDocument document;
        if (!parse_json(bytes.data(), bytes.size(), *source.context, document, error))
            return fail_in(error, "member " + member.name);
        texts[path_of(member)].assign(bytes.begin(), bytes.end());
        kept.push_back(document);
        return add(member, yyjson_doc_get_root(document.get()), error);
    }

    bool read_span(const std::vector<const Member*>& together, fhash_error& error) {
        const uint64_t start = together.front()->offset;
        Buffer bytes;
        if (!source.read(start, together.back()->end() - start, bytes, error)) return false;
        for (const Member* member : together)
            if (!parse(*member, bytes.data() + (member->offset - start), error))
                return false;
        return true;
    }

    bool read_root(fhash_error& error) {
        const Member* const member = directory.find("zarr.json");
        if (!member) return damaged(error, "member zarr.json is missing");
        Buffer bytes;
        return source.read(member->offset, member->end() - member->offset, bytes, error) &&
               parse(*member, bytes.data(), error);
    }

    bool read(fhash_error& error) {
        if (!read_root(error)) return false;
        std::vector<std::vector<const Member*>> spans;
        uint64_t total = 0;
        for (const Member& member : directory.members) {
            if (!is_document(member.name) || nodes.count(path_of(member))) continue;
            total += member.full_size < 0 ? member.size : uint64_t(member.full_size);
            if (member.size > MAX_DOCUMENT)
                return fail(error, FHASH_ERROR_DAMAGED, "member %s: metadata of over 2^24 bytes",
                            member.name.c_str());
            if (!may_use(*source.context, total, error)) return false;
            if (spans.empty() || member.offset - spans.back().back()->end() > DOCUMENT_GAP ||
                member.end() - spans.back().front()->offset > DOCUMENT_READ)
                spans.emplace_back();
            spans.back().push_back(&member);
        }
        std::vector<uint64_t> ranges;
        for (const auto& span : spans)
            ranges.insert(ranges.end(),
                          {span.front()->offset, span.back()->end() - span.front()->offset});
        source.announce(ranges);
        return std::all_of(spans.begin(), spans.end(),
                           [&](const auto& span) { return read_span(span, error); });
    }
};

}  // namespace

int32_t type_of_name(const char* name) {
    for (int32_t type = 1; type < 12; type++)
        if (std::strcmp(TYPES[type], name) == 0) return type;
    return 0;
}

std::string name_of_type(int32_t type) { return TYPES[type]; }

const Array* Hierarchy::find(const std::string& path) const {
    const auto found = arrays.find(path);
    return found == arrays.end() ? nullptr : &found->second;
}

bool read_hierarchy(const Source& source, const Directory& directory, Hierarchy& found,
                    fhash_error& error) {
    Documents documents{source, directory, {}, {}, found.documents};
    if (!documents.read(error)) return false;
    for (uint32_t number = 0; number < directory.members.size(); number++) {
        const Member& member = directory.members[number];
        if (!is_document(member.name)) continue;
        const std::string path = Documents::path_of(member);
        found.nodes.push_back({path, std::move(documents.texts[path]), number});
    }
    const auto is_group = [&](const std::string& path) {
        const auto node = documents.nodes.find(path);
        return node != documents.nodes.end() &&
               is(yyjson_obj_get(node->second, "node_type"), "group");
    };
    found.root = yyjson_obj_get(documents.nodes.at(""), "attributes");
    if (!is_group("") || !yyjson_is_obj(yyjson_obj_get(found.root, "fhash")))
        return damaged(error, "member zarr.json is not the group of an fhash container");
    if (!check_format(yyjson_obj_get(found.root, "fhash"), error)) return false;
    for (const auto& node : documents.nodes) {
        const size_t slash = node.first.rfind('/');
        const std::string parent = slash == std::string::npos ? "" : node.first.substr(0, slash);
        if (!node.first.empty() && !is_group(parent))
            return fail(error, FHASH_ERROR_DAMAGED, "member %s/zarr.json lies in no group",
                        node.first.c_str());
    }
    for (const auto& node : documents.nodes) {
        if (is_group(node.first)) continue;
        Array& array = found.arrays[node.first];
        array.path = node.first;
        array.number = uint32_t(found.arrays.size());
        if (!read_array(node.second, array, error))
            return fail_in(error, "member " + node.first + "/zarr.json");
    }
    return place_chunks(directory, found, error);
}

}  // namespace fhash
