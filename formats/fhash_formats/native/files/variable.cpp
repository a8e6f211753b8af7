#include "variable.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "bytes.hpp"
#include "settings.hpp"

namespace fhash {

const char* const AXES[4] = {"time", "z", "y", "x"};

namespace {

constexpr int64_t MAX_RULED = 1 << 26;   // positions of a rule
constexpr int64_t MAX_LISTED = 1 << 20;  // numbers of a list
constexpr int64_t ULPS_LIMIT = (int64_t(1) << 52) - 1;
const char* const FEATURES[3] = {"transform", "plain", "sparse-tables"};

bool has_feature(const Record& top, const char* feature) {
    const Json list = top.find("required_features");
    yyjson_arr_iter iter = yyjson_arr_iter_with(list);
    while (Json each = yyjson_arr_iter_next(&iter))
        if (yyjson_equals_str(each, feature)) return true;
    return false;
}

// The least or greatest float64 within the range, from an end that may be a larger integer.
double inner_end(Json end, bool low) {
    const double value = yyjson_get_num(end);
    if (!yyjson_is_int(end) || std::fabs(value) <= 9007199254740992.0) return value;
    const bool negative = value < 0;
    const uint64_t exact = negative ? uint64_t(0) - uint64_t(yyjson_get_sint(end))
                                    : yyjson_get_uint(end);
    const double size = std::fabs(value);  // rounded from `exact`, at most 2^64
    const bool beyond = size >= 18446744073709551616.0 || uint64_t(size) > exact;
    const bool below = !beyond && uint64_t(size) < exact;
    const bool higher = negative ? below : beyond, lower = negative ? beyond : below;
    if (low && lower) return std::nextafter(value, HUGE_VAL);
    if (!low && higher) return std::nextafter(value, -HUGE_VAL);
    return value;
}

bool read_values(Variable& variable, fhash_error& error) {
    const Record& top = variable.header;
    Record source, domain;
    std::string type;
    if (!top.record("variable", source, error) || !source.text("units", variable.units, error) ||
        !source.text("dtype", type, error))
        return false;
    variable.type = type_of_name(type.c_str());
    if (!source.need(variable.type != 0, "dtype", "a data type", error)) return false;
    Record attributes;
    if (!source.record("attributes", attributes, error)) return false;
    if (!json_text(attributes.values, variable.attributes))
        return fail(error, FHASH_ERROR_MEMORY, "no memory for attributes");
    double fill = 0;
    variable.fill = source.find("fill");
    if (variable.fill && !source.number("fill", fill, error)) return false;
    if (!top.record("domain", domain, error) ||
        !domain.integers("shape", 4, 1, MAX_LENGTH, variable.shape, error) ||
        !top.numbers("value_range", 2, variable.range, error) ||
        !top.number("background", variable.background, error))
        return false;
    const double most = variable.in_float32() ? 3.4028234663852886e38 : HUGE_VAL;
    const double* const range = variable.range;
    if (!top.need(range[0] <= range[1] && std::fabs(range[0]) <= most &&
                      std::fabs(range[1]) <= most,
                  "value_range", "two allowed numbers, the lower first", error) ||
        !top.need(std::fabs(variable.background) <= most, "background", "allowed", error))
        return false;
    const Json list = top.find("value_range");
    for (int i = 0; i < 2; i++)
        variable.within[i] = inner_end(yyjson_arr_get(list, size_t(i)), i == 0);
    if (variable.within[0] > variable.within[1])
        std::copy(range, range + 2, variable.within);
    Record quality;
    return top.record("quality", quality, error) &&
           quality.number_or_null("psnr", variable.psnr, error) &&
           quality.number_or_null("max_abs_error", variable.max_error, error);
}

bool read_box(Variable& variable, fhash_error& error) {
    const Record& top = variable.header;
    const Json bounds = top.find("feature_bounding_box");
    bool good = yyjson_is_arr(bounds) && yyjson_arr_size(bounds) == 3;
    for (size_t a = 0; good && a < 3; a++) {
        const Json bound = yyjson_arr_get(bounds, a);
        int64_t* const ends = variable.box + 2 * a;
        const int64_t length = variable.shape[a + 1];
        good = yyjson_is_arr(bound) && yyjson_arr_size(bound) == 2 &&
               is_whole(yyjson_arr_get(bound, 0), 0, length, ends[0]) &&
               is_whole(yyjson_arr_get(bound, 1), 0, length, ends[1]) && ends[0] < ends[1];
    }
    return top.need(good, "feature_bounding_box", "within the domain", error);
}

bool read_levels(Variable& variable, fhash_error& error) {
    const Json list = variable.model.find("levels");
    const size_t count = yyjson_is_arr(list) ? yyjson_arr_size(list) : 0;
    bool good = count >= 1 && count <= MAX_LEVELS;
    std::array<int64_t, 4> most = {variable.shape[0], variable.length(0), variable.length(1),
                                   variable.length(2)};
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? list : nullptr);
    while (Json level = yyjson_arr_iter_next(&iter)) {
        std::array<int64_t, 4> lengths = {};
        good = good && yyjson_is_arr(level) && yyjson_arr_size(level) == 4;
        for (size_t a = 0; good && a < 4; a++)
            good = is_whole(yyjson_arr_get(level, a), 1, most[a], lengths[a]);
        variable.levels.push_back(lengths);
        most = lengths;
    }
    for (size_t a = 1; good && a < 4; a++)
        good = variable.levels[0][a] == variable.length(int(a) - 1);
    return variable.model.need(good, "levels", "[t, z, y, x] of the box, and coarser ones", error);
}

// The rule between steps, linear unless the header has another.
bool read_between(Variable& variable, fhash_error& error) {
    Record between;
    std::string rule;
    double gain = 0;
    if (!variable.model.find("between")) return true;
    if (!variable.model.record("between", between, error) || !between.text("rule", rule, error) ||
        !between.number_or_null("gain_db", gain, error))
        return false;
    variable.cubic = rule == "cubic";
    return between.need(variable.cubic || rule == "linear", "rule", "linear or cubic", error);
}

// The part of `model` that reading needs.
bool read_model(Variable& variable, fhash_error& error) {
    const Record& top = variable.header;
    Record& model = variable.model;
    std::string profile;
    if (!top.record("model", model, error) || !model.text("profile", profile, error) ||
        !model.text("tables", variable.tables, error))
        return false;
    variable.compact = profile == "compact";
    variable.plain = has_feature(variable.top, "plain");
    if (!variable.compact && profile != "paper")
        return fail(error, FHASH_ERROR_UNSUPPORTED, "header key model.profile is %s",
                    shown(profile.c_str()).c_str());
    const bool coded = variable.tables == "transform";
    const bool transform = has_feature(variable.top, "transform");
    const bool sound = variable.compact ? variable.plain || transform
                                        : !variable.plain && (!coded || transform);
    if (!variable.top.need(sound, "required_features", "those of its profile", error) ||
        !read_levels(variable, error))
        return false;
    if (!variable.compact) return true;
    if (!read_between(variable, error)) return false;
    std::string values = variable.tables;
    if (variable.plain && !model.text("values", values, error)) return false;
    variable.values = type_of_name(values.c_str());
    return model.need(variable.values != 0 &&
                          !(variable.in_float32() && variable.values == FHASH_FLOAT64),
                      variable.plain ? "values" : "tables", "a type for its source", error) &&
           model.need(variable.plain || variable.levels.size() == 1, "levels", "one level", error);
}

// A position of a list: a number, or the text of one that is not finite.
bool listed_position(Json value, double& position) {
    position = yyjson_get_num(value);
    if (yyjson_equals_str(value, "NaN")) position = NAN;
    else if (yyjson_equals_str(value, "Infinity")) position = HUGE_VAL;
    else if (yyjson_equals_str(value, "-Infinity")) position = -HUGE_VAL;
    else return yyjson_is_num(value) && std::isfinite(position);
    return true;
}

bool check_positions(const Record& record, int64_t length, fhash_error& error) {
    double number = 0;
    std::string text;
    if ((record.find("start") && !record.number("start", number, error)) ||
        (record.find("step") && !record.number("step", number, error)) ||
        (record.find("name") && !record.text("name", text, error)))
        return false;
    const Json dtype = record.find("dtype"), values = record.find("values"),
               ulps = record.find("ulps"), attributes = record.find("attributes");
    if (!record.need(!dtype || yyjson_equals_str(dtype, "float32") ||
                         yyjson_equals_str(dtype, "float64"),
                     "dtype", "float64 or float32", error) ||
        !record.need(!attributes || yyjson_is_obj(attributes), "attributes", "an object", error))
        return false;
    const int64_t count = int64_t(yyjson_arr_size(values ? values : ulps));
    bool good = count <= MAX_LISTED && (values ? count == length : length <= MAX_RULED);
    yyjson_arr_iter iter = yyjson_arr_iter_with(values);
    while (Json each = yyjson_arr_iter_next(&iter)) good = good && listed_position(each, number);
    if (!record.need(good, "values", "as many numbers as there are positions, or a rule", error))
        return false;
    good = !ulps || (count >= 1 && count <= length && !values);
    iter = yyjson_arr_iter_with(good ? ulps : nullptr);
    int64_t moves = 0;
    while (Json each = yyjson_arr_iter_next(&iter))
        good = good && is_whole(each, -ULPS_LIMIT, ULPS_LIMIT, moves);
    return record.need(good, "ulps", "whole numbers of a rule", error);
}

// Finds the objects of the axes of variable `number`, its own or those of another variable.
bool read_coordinates(std::vector<Variable>& all, size_t number, fhash_error& error) {
    Record own, other;
    if (!all[number].header.find("coordinates")) return true;
    if (!all[number].header.record("coordinates", own, error)) return false;
    for (int axis = 0; axis < 4; axis++) {
        Record record;
        int64_t from = 0;
        if (!own.find(AXES[axis])) continue;
        if (is_whole(own.find(AXES[axis]), 0, int64_t(all.size()) - 1, from)) {
            const Json theirs = all[size_t(from)].header.find("coordinates");
            other = {theirs, own.prefix};
            if (!own.need(yyjson_is_obj(yyjson_obj_get(theirs, AXES[axis])), AXES[axis],
                          "the number of a variable that has it", error))
                return false;
        } else other = own;
        if (!other.record(AXES[axis], record, error) ||
            !check_positions(record, all[number].shape[axis], error))
            return false;
        all[number].coordinates[axis] = record.values;
    }
    return true;
}

constexpr int MIDDLE = 31;  // letter of a weight of 0

void add_number(std::string& block, uint32_t bits, int bytes) {
    for (int i = 0; i < bytes; i++) block += char(bits >> 8 * i);
}

void add_float(std::string& block, double number) {
    const float value = float(number);
    uint32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    add_number(block, bits, 4);
}

// The MLP in the header, as the block that settings of tiles have of it.
bool read_mlp(Variable& variable, fhash_error& error) {
    Record mlp;
    int64_t widths[3], biases[193];
    double constants[3];
    if (!variable.compact) return true;
    if (!variable.header.find_value("mlp"))
        return variable.header.need(variable.header.find("mlp") != nullptr, "mlp",
                                    "null or an object", error);
    if (!variable.header.record("mlp", mlp, error)) return false;
    const size_t count = yyjson_arr_size(mlp.find("widths"));
    if (!mlp.need(count >= 1 && count <= 3, "widths", "1 to 3 widths", error) ||
        !mlp.integers("widths", count, 1, 64, widths, error) ||
        !mlp.number("sigma", constants[0], error) ||
        !mlp.numbers("range", 2, constants + 1, error))
        return false;
    std::string block(1, char(count)), weights;
    size_t all = 1;
    for (size_t i = 0; i < count; i++) {
        block += char(widths[i]);
        all += size_t(widths[i]);
    }
    for (const double each : constants) add_float(block, each);
    double scales[8];
    if (!mlp.numbers("scales", 2 * (count + 1), scales, error)) return false;
    for (size_t i = 0; i < 2 * (count + 1); i++) add_number(block, to_half(scales[i]), 2);
    if (!mlp.integers("biases", all, -127, 127, biases, error) ||
        !mlp.text("weights", weights, error))
        return false;
    for (size_t i = 0; i < all; i++) block += char(biases[i]);
    for (const char letter : weights) {
        const char* const place = std::strchr(BASE64, letter);
        if (!mlp.need(place && letter && letter != '/', "weights", "letters of base64", error))
            return false;
        block += char(int(place - BASE64) - MIDDLE);
    }
    const uint8_t* const begin = reinterpret_cast<const uint8_t*>(block.data());
    Head head;
    variable.mlp = block;
    return unpack_head({begin, begin + block.size()}, head, error) ||
           fail_in(error, "header key mlp");
}

// Checks the bits of blocks of vertices, beside tiles that have the exact masks.
bool check_blocks(const Variable& variable, fhash_error& error) {
    const Array* const array = variable.find("occupancy");
    if (!array) return true;
    const Record attributes = {array->attributes, "array occupancy attribute "};
    int64_t block = 1;
    if (attributes.find("block") &&
        !attributes.integer("block", 1, int64_t(1) << 40, block, error))
        return false;
    const std::vector<int64_t> bits = {1, variable.keys(), occupancy_bytes(variable, block)};
    return attributes.need((block & (block - 1)) == 0, "block", "a power of two", error) &&
           check_array(variable, "occupancy", bits, {FHASH_UINT8}, false, error);
}

// Checks the arrays that both profiles, and the profile compact, are read from.
bool check_arrays(const Variable& variable, fhash_error& error) {
    const auto& level = variable.levels[0];
    const int64_t* const shape = variable.shape;
    // The product of three lengths up to 2^40 is beyond int64; an array's shape is not.
    double vertices = double(shape[1]) * double(shape[2]) * double(shape[3]);
    const int64_t bytes = vertices < 1e18 ? (shape[1] * shape[2] * shape[3] + 7) / 8 : 0;
    if (!check_array(variable, "key_frames", {level[0]}, {FHASH_INT64}, level[0] < shape[0],
                     error) ||
        !check_array(variable, "missing", {shape[0], bytes}, {FHASH_UINT8}, false, error))
        return false;
    const std::vector<int64_t> lengths(level.begin(), level.end());
    if (variable.compact && !variable.plain) {
        if (!check_array(variable, "table_1", lengths, {variable.values}, true, error) ||
            !check_blocks(variable, error))
            return false;
    } else {
        const int64_t features = variable.compact ? 1 : variable.features;
        const std::vector<int64_t> bits = {features, level[0], occupancy_bytes(variable)};
        const bool masked = !variable.compact && variable.find("coreset");
        if (masked && (features > 8 || variable.model.find("sparse")))
            return fail(error, FHASH_ERROR_DAMAGED, "array coreset is there in a file of sparse "
                                                    "tables, or of more than 8 features");
        if (!check_array(variable, "coreset", lengths, {FHASH_UINT8}, masked, error) ||
            !(masked ? check_blocks(variable, error)
                     : check_array(variable, "occupancy", bits, {FHASH_UINT8}, true, error)) ||
            !(variable.compact ? check_plain(variable, error) : check_network(variable, error)))
            return false;
    }
    const bool transform = has_feature(variable.top, "transform");
    for (const auto& each : variable.arrays) {
        const bool beside = each.first.rfind("auxiliary/", 0) == 0 && !variable.plain;
        if (!transform && each.second->tiles() && !beside)
            return fail(error, FHASH_ERROR_DAMAGED, "array %s has codecs of the feature transform",
                        each.first.c_str());
    }
    return true;
}

bool read_header(Variable& variable, fhash_error& error) {
    const Json features = variable.header.find("features");
    variable.features = features ? int64_t(yyjson_arr_size(features)) : 1;
    if (!variable.header.need(!features || (yyjson_is_arr(features) && variable.features),
                              "features", "a list of texts", error))
        return false;
    return read_values(variable, error) && read_box(variable, error) &&
           read_model(variable, error) && read_mlp(variable, error);
}

const char* const TABLE = "table_1";

// Reads the beginning of the paths of a variable's arrays; of one of several this is a group.
bool read_group(std::vector<Variable>& all, size_t number, fhash_error& error) {
    std::string group;
    Variable& variable = all[number];
    if (all.size() == 1 && !variable.header.find("group")) return true;
    if (!variable.header.text("group", group, error) ||
        !variable.header.need(group == "v" + std::to_string(number), "group",
                              "v and the number of the variable", error))
        return false;
    variable.group = group + "/";
    return true;
}

// The arrays of a variable by their names.
std::map<std::string, const Array*> own_arrays(const Hierarchy& hierarchy,
                                               const Variable& variable) {
    std::map<std::string, const Array*> own;
    const std::string& group = variable.group;
    for (const auto& each : hierarchy.arrays)
        if (each.first.compare(0, group.size(), group) == 0)
            own[each.first.substr(group.size())] = &each.second;
    return own;
}

// Gives a variable the arrays that lie with others.
bool add_shared(Variable& variable, const std::vector<std::map<std::string, const Array*>>& own,
                fhash_error& error) {
    Record shares;
    if (!variable.header.find("shares")) return true;
    if (!variable.header.record("shares", shares, error)) return false;
    yyjson_obj_iter iter = yyjson_obj_iter_with(shares.values);
    while (Json key = yyjson_obj_iter_next(&iter)) {
        const std::string name = yyjson_get_str(key);
        const Json place = yyjson_obj_iter_get_val(key);
        const bool pair = yyjson_is_arr(place) && yyjson_arr_size(place) == 2;
        std::string other = name;
        if (pair && yyjson_is_str(yyjson_arr_get(place, 1)))
            other = yyjson_get_str(yyjson_arr_get(place, 1));
        const bool beside = name.rfind("auxiliary/", 0) == 0 && other.rfind("auxiliary/", 0) == 0;
        int64_t from = 0;
        if (!is_whole(pair ? yyjson_arr_get(place, 0) : place, 0, int64_t(own.size()) - 1, from) ||
            !(beside || (name == other && !pair)))
            return shares.refuse(name.c_str(), "the number of a variable", error);
        const auto found = own[size_t(from)].find(other);
        if (found == own[size_t(from)].end() ||
            !variable.arrays.emplace(name, found->second).second)
            return fail(error, FHASH_ERROR_DAMAGED, "shared array %s is missing, or is there",
                        shown(name.c_str()).c_str());
    }
    return true;
}

// Whole numbers in the order of floats, and back.
template <class Float, class Whole> Float moved(Float value, int64_t by) {
    if (by == 0) return value;
    const auto ordered = [](Float number) {
        Whole bits;
        std::memcpy(&bits, &number, sizeof bits);
        return bits < 0 ? int64_t(std::numeric_limits<Whole>::min()) - int64_t(bits)
                        : int64_t(bits);
    };
    const int64_t end = ordered(Float(HUGE_VAL));
    // Neither a float nor a move is beyond 2^63 in all, but for numbers that are none.
    const int64_t there = std::clamp(ordered(value) + by, -end, end);
    const Whole bits =
        Whole(there < 0 ? int64_t(std::numeric_limits<Whole>::min()) - there : there);
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

}  // namespace

// A shape as text: "(4, 3)", "(4,)".
static std::string shape_text(const std::vector<int64_t>& shape) {
    std::string text;
    for (const int64_t length : shape) text += (text.empty() ? "(" : ", ") + std::to_string(length);
    return text + (shape.size() == 1 ? ",)" : ")");
}

const Array* Variable::find(const std::string& array) const {
    const auto found = arrays.find(array);
    return found == arrays.end() ? nullptr : found->second;
}

bool check_array(const Variable& variable, const char* name, const std::vector<int64_t>& shape,
                 std::initializer_list<int32_t> types, bool required, fhash_error& error) {
    const Array* const array = variable.find(name);
    if (!array && required) return fail(error, FHASH_ERROR_DAMAGED, "array %s is missing", name);
    if (!array) return true;
    const bool fits = size_t(array->axes) == shape.size() &&
                      std::equal(shape.begin(), shape.end(), array->shape.begin()) &&
                      std::count(types.begin(), types.end(), array->type);
    if (fits) return true;
    std::string wanted;
    for (const int32_t type : types) wanted += (wanted.empty() ? "" : " or ") + name_of_type(type);
    const std::vector<int64_t> own(array->shape.begin(), array->shape.begin() + array->axes);
    return fail(error, FHASH_ERROR_DAMAGED, "array %s is %s %s; the header asks for %s %s", name,
                name_of_type(array->type).c_str(), shape_text(own).c_str(), wanted.c_str(),
                shape_text(shape).c_str());
}

bool check_format(Json header, fhash_error& error) {
    const Record top = {header, "header key "};
    std::string format;
    int64_t version[2];
    if (!top.text("format", format, error) ||
        !top.need(format == "fhash", "format", "fhash", error) ||
        !top.integers("format_version", 2, 0, 10000, version, error))
        return false;
    if (version[0] != MAJOR) return refuse_version(int(version[0]), error);
    const Json list = top.find("required_features");
    if (!top.need(yyjson_is_arr(list), "required_features", "a list of texts", error)) return false;
    std::vector<std::string> names;
    yyjson_arr_iter iter = yyjson_arr_iter_with(list);
    while (Json each = yyjson_arr_iter_next(&iter)) {
        const std::string name = yyjson_is_str(each) ? yyjson_get_str(each) : "";
        if (!top.need(!name.empty() && !std::count(names.begin(), names.end(), name),
                      "required_features", "a list of texts that stand once", error))
            return false;
        if (std::find(std::begin(FEATURES), std::end(FEATURES), name) == std::end(FEATURES))
            return fail(error, FHASH_ERROR_UNSUPPORTED,
                        "the file needs the feature %s, which this version does not know: "
                        "upgrade, or encode the source again",
                        shown(name.c_str()).c_str());
        names.push_back(name);
    }
    return true;
}

// Fails, with the name of a variable that is one of several.
static bool in_variable(const std::vector<Variable>& all, size_t number, fhash_error& error) {
    return all.size() > 1 && fail_in(error, "variable '" + shown(all[number].name.c_str()) + "'");
}

bool read_variables(Hierarchy& hierarchy, std::vector<Variable>& found, fhash_error& error) {
    const Record top = {yyjson_obj_get(hierarchy.root, "fhash"), "header key "};
    const Json list = top.find("variables");
    const size_t count = yyjson_is_arr(list) ? yyjson_arr_size(list) : 0;
    if (!top.need(count > 0, "variables", "a list of at least one object", error)) return false;
    found.resize(count);
    std::vector<std::map<std::string, const Array*>> own(count);
    std::map<const Array*, size_t> owners;  // of tables
    std::set<std::string> names;
    yyjson_arr_iter iter = yyjson_arr_iter_with(list);
    for (size_t i = 0; i < count; i++) {
        Variable& variable = found[i];
        Record source;
        variable.top = top;
        variable.header = {yyjson_arr_iter_next(&iter), top.prefix};
        if (!top.need(yyjson_is_obj(variable.header.values), "variables", "objects", error) ||
            !variable.header.record("variable", source, error) ||
            !source.text("name", variable.name, error) ||
            (variable.header.find("name") &&
             !variable.header.text("name", variable.name, error)) ||
            !top.need(names.insert(variable.name).second, "variables",
                      "of names that stand once", error))
            return false;
        if (!read_header(variable, error) || !read_group(found, i, error))
            return in_variable(found, i, error);
        own[i] = own_arrays(hierarchy, variable);
    }
    for (size_t i = 0; i < count; i++) {
        found[i].arrays = own[i];
        if (!read_coordinates(found, i, error) || !add_shared(found[i], own, error) ||
            !check_arrays(found[i], error))
            return in_variable(found, i, error);
        const auto table = hierarchy.arrays.find(found[i].group + TABLE);
        if (!found[i].compact || found[i].plain || table == hierarchy.arrays.end()) continue;
        std::string& settings = table->second.settings;
        const bool apart = settings.empty() && found[i].mlp.empty();  // each tile has its own
        if (!apart && !insert_head(settings, found[i].mlp, error))
            return in_variable(found, i, error);
        owners[&table->second] = i;
    }
    for (size_t i = 0; i < count; i++) {
        const auto owner = owners.find(found[i].find(TABLE));
        if (owner != owners.end() && found[owner->second].mlp != found[i].mlp) {
            fail(error, FHASH_ERROR_DAMAGED, "its mlp is not that of the table that it shares");
            return in_variable(found, i, error);
        }
    }
    return true;
}

void find_positions(const Variable& variable, int axis, double* positions) {
    const Json rule = variable.coordinates[axis];
    const int64_t length = variable.shape[axis];
    const Json values = yyjson_obj_get(rule, "values"), ulps = yyjson_obj_get(rule, "ulps");
    const Json start = yyjson_obj_get(rule, "start"), step = yyjson_obj_get(rule, "step");
    const bool narrow = yyjson_equals_str(yyjson_obj_get(rule, "dtype"), "float32");
    yyjson_arr_iter iter = yyjson_arr_iter_with(values ? values : ulps);
    const int64_t moves = ulps ? int64_t(yyjson_arr_size(ulps)) : 0;
    for (int64_t i = 0; i < length; i++) {
        double value = 0;
        if (values) {
            listed_position(yyjson_arr_iter_next(&iter), value);
        } else {
            value = double(i) * (step ? yyjson_get_num(step) : 1);
            value += start ? yyjson_get_num(start) : 0;
        }
        const int64_t by =
            i >= length - moves ? yyjson_get_sint(yyjson_arr_iter_next(&iter)) : 0;
        positions[i] = narrow ? double(moved<float, int32_t>(float(value), by))
                              : moved<double, int64_t>(value, by);
    }
}

int64_t occupancy_bytes(const Variable& variable, int64_t block) {
    int width = 0;
    for (int a = 0; a < 3; a++)
        for (int64_t rest = (variable.length(a) - 1) / block; rest > 0; rest >>= 1) width++;
    return width < 62 ? ((int64_t(1) << width) + 7) / 8 : 0;
}

}  // namespace fhash
