#include "json.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

namespace fhash {

namespace {

constexpr size_t MAX_BYTES = size_t(16) << 20;
constexpr int MAX_DEPTH = 64;

bool check_keys(Json object, fhash_error& error) {
    std::vector<std::pair<const char*, size_t>> names;
    names.reserve(yyjson_obj_size(object));
    yyjson_obj_iter iter = yyjson_obj_iter_with(object);
    while (Json key = yyjson_obj_iter_next(&iter))
        names.emplace_back(yyjson_get_str(key), yyjson_get_len(key));
    std::sort(names.begin(), names.end(), [](const auto& a, const auto& b) {
        const int order = std::memcmp(a.first, b.first, std::min(a.second, b.second));
        return order ? order < 0 : a.second < b.second;
    });
    for (size_t i = 1; i < names.size(); i++)
        if (names[i].second == names[i - 1].second &&
            std::memcmp(names[i].first, names[i - 1].first, names[i].second) == 0)
            return fail(error, FHASH_ERROR_DAMAGED, "JSON has the key '%s' twice",
                        shown(names[i].first).c_str());
    return true;
}

JsonDocument kept(yyjson_doc* document) {
    return JsonDocument(document, [](yyjson_doc* each) { yyjson_doc_free(each); });
}

// Refuses what is nested too deep (yyjson does not recurse, and has no limit), and keys twice.
bool check_value(Json value, int depth, fhash_error& error) {
    if (!yyjson_is_ctn(value)) return true;
    if (depth > MAX_DEPTH)
        return fail(error, FHASH_ERROR_DAMAGED, "JSON is nested more than %d deep", MAX_DEPTH);
    if (yyjson_is_arr(value)) {
        yyjson_arr_iter iter = yyjson_arr_iter_with(value);
        while (Json each = yyjson_arr_iter_next(&iter))
            if (!check_value(each, depth + 1, error)) return false;
        return true;
    }
    if (!check_keys(value, error)) return false;
    yyjson_obj_iter iter = yyjson_obj_iter_with(value);
    while (Json key = yyjson_obj_iter_next(&iter))
        if (!check_value(yyjson_obj_iter_get_val(key), depth + 1, error)) return false;
    return true;
}

bool is_finite(Json value, double& found) {
    if (!yyjson_is_num(value)) return false;
    found = yyjson_get_num(value);
    return std::isfinite(found);
}

}  // namespace

bool parse_json(const uint8_t* data, size_t size, const fhash_context& context, JsonDocument& found,
                fhash_error& error) {
    if (size > MAX_BYTES)
        return fail(error, FHASH_ERROR_DAMAGED, "JSON of %zu bytes; the limit is %zu", size,
                    MAX_BYTES);
    if (!may_use(context, yyjson_read_max_memory_usage(size, 0), error)) return false;
    yyjson_read_err why = {};
    char* text = reinterpret_cast<char*>(const_cast<uint8_t*>(data));  // which stays as it is
    found = kept(yyjson_read_opts(text, size, 0, nullptr, &why));
    if (!found && why.code == YYJSON_READ_ERROR_MEMORY_ALLOCATION)
        return fail(error, FHASH_ERROR_MEMORY, "no memory for JSON of %zu bytes", size);
    if (!found)
        return fail(error, FHASH_ERROR_DAMAGED, "JSON is damaged: %s at byte %zu",
                    why.msg ? why.msg : "", why.pos);
    const Json root = yyjson_doc_get_root(found.get());
    if (!yyjson_is_obj(root))
        return fail(error, FHASH_ERROR_DAMAGED, "JSON is no object");
    return check_value(root, 1, error);
}

bool json_text(Json value, std::string& text) {
    size_t size = 0;
    char* made = yyjson_val_write(value, 0, &size);
    if (!made) return false;
    text.assign(made, size);
    std::free(made);
    return true;
}

bool json_is(Json value, const char* text) {
    const JsonDocument other = kept(yyjson_read(text, std::strlen(text), 0));
    return value && other && yyjson_equals(value, yyjson_doc_get_root(other.get()));
}

bool fail_in(fhash_error& error, const std::string& what) {
    const std::string text = what + ": " + error.text;
    std::snprintf(error.text, sizeof error.text, "%s", text.c_str());
    return false;
}

std::string shown(const char* text) {
    std::string result;
    for (; *text && result.size() < 80; text++)
        result += *text >= ' ' && *text <= '~' ? *text : '?';
    return result;
}

bool Record::refuse(const char* key, const char* needed, fhash_error& error) const {
    if (!find(key))
        return fail(error, FHASH_ERROR_DAMAGED, "%s%s is missing", prefix.c_str(), key);
    return fail(error, FHASH_ERROR_DAMAGED, "%s%s is not %s", prefix.c_str(), key, needed);
}

bool Record::record(const char* key, Record& found, fhash_error& error) const {
    found = {find(key), prefix + key + "."};
    return need(yyjson_is_obj(found.values), key, "an object", error);
}

bool Record::text(const char* key, std::string& found, fhash_error& error) const {
    const Json value = find(key);
    if (!yyjson_is_str(value)) return refuse(key, "a text", error);
    found.assign(yyjson_get_str(value), yyjson_get_len(value));
    return true;
}

bool is_whole(Json value, int64_t low, int64_t high, int64_t& found) {
    if (!yyjson_is_int(value)) return false;
    if (yyjson_is_uint(value) && yyjson_get_uint(value) > uint64_t(INT64_MAX)) return false;
    found = yyjson_get_sint(value);
    return low <= found && found <= high;
}

bool Record::integer(const char* key, int64_t low, int64_t high, int64_t& found,
                     fhash_error& error) const {
    return need(is_whole(find(key), low, high, found), key, "an allowed whole number", error);
}

bool Record::integers(const char* key, size_t count, int64_t low, int64_t high, int64_t* found,
                      fhash_error& error) const {
    const Json list = find(key);
    bool good = yyjson_is_arr(list) && yyjson_arr_size(list) == count;
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? list : nullptr);
    for (size_t i = 0; good && i < count; i++)
        good = is_whole(yyjson_arr_iter_next(&iter), low, high, found[i]);
    return need(good, key, "a list of allowed whole numbers", error);
}

bool Record::number(const char* key, double& found, fhash_error& error) const {
    return need(is_finite(find(key), found), key, "a finite number", error);
}

bool Record::number_or_null(const char* key, double& found, fhash_error& error) const {
    found = std::nan("");
    return !find_value(key) || number(key, found, error);
}

bool Record::numbers(const char* key, size_t count, double* found, fhash_error& error) const {
    const Json list = find(key);
    bool good = yyjson_is_arr(list) && yyjson_arr_size(list) == count;
    yyjson_arr_iter iter = yyjson_arr_iter_with(good ? list : nullptr);
    for (size_t i = 0; good && i < count; i++)
        good = is_finite(yyjson_arr_iter_next(&iter), found[i]);
    return need(good, key, "a list of finite numbers", error);
}

}  // namespace fhash
