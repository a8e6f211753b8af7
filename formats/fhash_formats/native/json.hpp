// Metadata documents: strict JSON (FORMAT.md, Zarr), and checked access to their fields.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "context.hpp"
#include "third_party/yyjson/yyjson.h"

namespace fhash {

using Json = yyjson_val*;
using JsonDocument = std::shared_ptr<yyjson_doc>;

constexpr int64_t MAX_LENGTH = int64_t(1) << 40;  // of an axis in a header, and other counts

// Reads an object: UTF-8, at most 64 deep, no key twice, numbers within float64.
bool parse_json(const uint8_t* data, size_t size, const fhash_context& context, JsonDocument& found,
                fhash_error& error);

// JSON text of a value; false without memory.
bool json_text(Json value, std::string& text);

// Whether a value is that of a JSON text.
bool json_is(Json value, const char* text);

// Puts `what: ` before the text of an error; false.
bool fail_in(fhash_error& error, const std::string& what);

// A name as it is shown in errors: ASCII, at most 80 bytes.
std::string shown(const char* text);

// An object whose values are checked as they are taken; `prefix` stands before keys in errors.
// Functions return whether the value is there and is allowed; `error` says otherwise.
struct Record {
    Json values = nullptr;
    std::string prefix;

    Json find(const char* key) const { return yyjson_obj_get(values, key); }
    // The value of a key that is there and not null.
    Json find_value(const char* key) const {
        const Json value = find(key);
        return yyjson_is_null(value) ? nullptr : value;
    }
    bool refuse(const char* key, const char* needed, fhash_error& error) const;
    bool need(bool condition, const char* key, const char* needed, fhash_error& error) const {
        return condition || refuse(key, needed, error);
    }
    bool record(const char* key, Record& found, fhash_error& error) const;
    bool text(const char* key, std::string& found, fhash_error& error) const;
    bool integer(const char* key, int64_t low, int64_t high, int64_t& found,
                 fhash_error& error) const;
    bool integers(const char* key, size_t count, int64_t low, int64_t high, int64_t* found,
                  fhash_error& error) const;
    bool number(const char* key, double& found, fhash_error& error) const;
    bool number_or_null(const char* key, double& found, fhash_error& error) const;  // NaN for null
    bool numbers(const char* key, size_t count, double* found, fhash_error& error) const;
};

// Whether a value is a whole number (not 1.0) within a range.
bool is_whole(Json value, int64_t low, int64_t high, int64_t& found);

}  // namespace fhash
