// Filter of HDF5: chunks are streams of tiles. HDF5 finds it by H5PLget_plugin_info, in this
// library, and fhash_formats/hdf5.py registers it from there.
//
// Neither headers nor libraries of HDF5 are needed: its functions are looked up in the library that
// calls, so that one binary serves every HDF5 from 1.10 on.
//
// Client data are unsigned numbers. The user gives the first five, or three, and a pair for each
// value that stands for a missing one; the filter adds those of the dataset when it is made, so
// that a chunk is decoded by them alone:
//     0      1, the version of this list
//     1, 2   the bound, a float64: its lower 32 bits, its upper ones
//     3      kind of the bound: 0 max_error, 1 max_error_rel, 2 step (fhash_quality); usually 0
//     4      effort, 1 to 9; usually 2
//     from the user: the missing values, float64s, like the bound; in the dataset:
//     5      fhash_type of the dataset
//     6      1 where its numbers are big-endian, else 0
//     7-10   vertices of a chunk along t, z, y, x; of more axes, t has the leading ones
//     11     missing values: the fill value, if the dataset declares one, and those of the user
//     12 ... the bits of each, the lower 32 first
//     last   CRC-32C of those before, in little-endian bytes: HDF5 would take values of another
//            type, or of fewer bytes than it needs, without a word
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "core.hpp"
#include "kernels.hpp"
#include "numbers.hpp"
#include "status.hpp"

#if defined(_WIN32)
#include <windows.h>
#else
#include <dlfcn.h>
#endif

namespace {

using namespace fhash;

// Not registered: of the range that is free for private use. FHASH on the keys of a telephone.
const int FILTER = 34274;
const unsigned GIVEN = 5, MISSING_COUNT = 11, LEAST = 13;  // numbers without missing values
const unsigned MAX_MISSING = 8;
const unsigned REVERSE = 0x100;  // flag of HDF5: decode
const int64_t MOST_VALUES = 1 << 27;
const fhash_quality EXACT = {0, 0, 0, 2, 0};

typedef int64_t Id;  // of HDF5: a type, a list of properties, a space

// Functions that a new dataset needs. A program that HDF5 is linked into shows none or a few.
const char* const CALLED[] = {
    "H5Pfill_value_defined", "H5Pget_chunk",   "H5Pget_fill_value", "H5Pget_filter_by_id2",
    "H5Pmodify_filter",      "H5Tget_class",   "H5Tget_ebias",      "H5Tget_fields",
    "H5Tget_order",          "H5Tget_precision", "H5Tget_sign",     "H5Tget_size",
};

// The library of HDF5 that called a function of this one.
class Hdf5 {
   public:
#if defined(_WIN32)
    explicit Hdf5(void* caller) {
        GetModuleHandleExA(GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS |
                               GET_MODULE_HANDLE_EX_FLAG_UNCHANGED_REFCOUNT,
                           (const char*)caller, &library_);
    }
    void* find(const char* name) const { return (void*)GetProcAddress(library_, name); }
#else
    explicit Hdf5(void* caller) {
        Dl_info place;
        if (dladdr(caller, &place)) library_ = dlopen(place.dli_fname, RTLD_NOLOAD | RTLD_LAZY);
        if (!library_) library_ = dlopen(nullptr, RTLD_LAZY);  // it is a part of the program
    }
    ~Hdf5() {
        if (library_) dlclose(library_);
    }
    void* find(const char* name) const { return library_ ? dlsym(library_, name) : nullptr; }
#endif
    Hdf5(const Hdf5&) = delete;
    Hdf5& operator=(const Hdf5&) = delete;

    // Calls a function; `missing` where this HDF5 has no such one.
    template <class Result, class... Arguments>
    Result call(const char* name, Result missing, Arguments... arguments) const {
        const auto function = (Result(*)(Arguments...))find(name);
        return function ? function(arguments...) : missing;
    }

    // Puts an error onto HDF5's stack, which tools print; onto stderr where HDF5 is out of reach.
    void say(const fhash_error& error) const {
        const auto push = (int (*)(Id, const char*, const char*, unsigned, Id, Id, Id, const char*,
                                   ...))find("H5Epush2");
        const auto* cls = (const Id*)find("H5E_ERR_CLS_g");
        const auto* major = (const Id*)find("H5E_PLINE_g");
        const auto* minor = (const Id*)find("H5E_CANTFILTER_g");
        if (!push || !cls || !major || !minor) {
            std::fprintf(stderr, "fhash: %s\n", error.text);
            return;
        }
        push(0, "hdf5_filter.cpp", "fhash", 1, *cls, *major, *minor, "fhash: %s", error.text);
    }

   private:
#if defined(_WIN32)
    HMODULE library_ = nullptr;
#else
    void* library_ = nullptr;
#endif
};

bool big_endian_machine() {
    const uint16_t one = 1;
    uint8_t first;
    std::memcpy(&first, &one, 1);
    return first == 0;
}

void swap_bytes(uint8_t* values, size_t bytes, size_t each) {
    for (uint8_t* value = values; value != values + bytes; value += each) {
        for (size_t i = 0; i < each / 2; i++) std::swap(value[i], value[each - 1 - i]);
    }
}

// The number that stands behind `count` ones of a dataset.
unsigned checksum(const unsigned* numbers, size_t count) {
    std::vector<uint8_t> bytes;
    for (size_t i = 0; i < 4 * count; i++)
        bytes.push_back((uint8_t)(numbers[i / 4] >> 8 * (i % 4)));
    return (unsigned)fhash_crc32c(bytes.data(), (int64_t)bytes.size(), 0, 0);
}

// Whether numbers are the whole list of a dataset.
bool is_complete(const unsigned* numbers, size_t count) {
    return count >= LEAST && numbers[MISSING_COUNT] <= MAX_MISSING + 1 &&
           count == LEAST + 2 * numbers[MISSING_COUNT] &&
           numbers[count - 1] == checksum(numbers, count - 1);
}

// A float64 by its lower and its upper half.
double float64_of(const unsigned* halves) {
    const uint64_t bits = (uint64_t)halves[1] << 32 | halves[0];
    double number;
    std::memcpy(&number, &bits, 8);
    return number;
}

// The promise in the numbers that the user gave.
bool read_quality(const unsigned* numbers, size_t count, fhash_quality& quality,
                  fhash_error& error) {
    if (count < 3) {
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "%zu numbers are given; 5 are needed: 1, the lower and the upper half of the "
                    "bound, its kind, the effort",
                    count);
    }
    if (numbers[0] != 1) {
        return fail(error, FHASH_ERROR_UNSUPPORTED, "version %u of the numbers; 1 is known",
                    numbers[0]);
    }
    const double bound = float64_of(numbers + 1);
    const unsigned kind = count > 3 ? numbers[3] : 0, effort = count > 4 ? numbers[4] : 2;
    if (kind > 2 || effort < 1 || effort > 9) {
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "kind %u and effort %u; allowed are 0 to 2, and 1 to 9", kind, effort);
    }
    if (!(bound >= 0) || std::isinf(bound) || (kind == 2 && bound == 0)) {
        return fail(error, FHASH_ERROR_ARGUMENT, "the bound is %g; a finite number, %s, is needed",
                    bound, kind == 2 ? "above 0" : "0 or more");
    }
    quality = EXACT;
    quality.effort = (int32_t)effort;
    if (bound > 0) {
        quality.max_error = kind == 0 ? bound : -1;
        (kind == 1 ? quality.max_error_rel : quality.step) = kind == 0 ? 0 : bound;
    }
    return true;
}

// The fhash_type of a type of HDF5; 0 for one that is not coded.
int32_t known_type(const Hdf5& hdf5, Id type) {
    const int cls = hdf5.call("H5Tget_class", -1, type);
    if (cls != 0 && cls != 1) return 0;  // neither integers nor floats
    const size_t size = hdf5.call<size_t>("H5Tget_size", 0, type);
    const int order = hdf5.call("H5Tget_order", -1, type);
    int32_t log = 0;
    while ((size_t)1 << log < size && log < 4) log++;
    if (size != (size_t)1 << log || log > 3 || (order != 0 && order != 1)) return 0;
    if (hdf5.call<size_t>("H5Tget_precision", 0, type) != 8 * size) return 0;
    if (cls == 0) {
        const int sign = hdf5.call("H5Tget_sign", -1, type);
        return sign < 0 ? 0 : (sign == 1 ? FHASH_INT8 : FHASH_UINT8) + log;
    }
    if (log == 0) return 0;
    const size_t exponents[] = {5, 8, 11}, exponent = exponents[log - 1];
    const size_t mantissa = 8 * size - 1 - exponent;
    size_t found[5] = {0, 0, 0, 0, 0};  // place of the sign; place and bits of exponent, mantissa
    hdf5.call("H5Tget_fields", -1, type, found, found + 1, found + 2, found + 3, found + 4);
    const bool ieee = found[0] == 8 * size - 1 && found[1] == mantissa && found[2] == exponent &&
                      found[3] == 0 && found[4] == mantissa &&
                      hdf5.call<size_t>("H5Tget_ebias", 0, type) ==
                          ((size_t)1 << (exponent - 1)) - 1;
    return ieee ? FHASH_FLOAT16 + log - 1 : 0;
}

// The bits of the missing values of a dataset: its fill value, and those that the user gave.
bool missing_values(const Hdf5& hdf5, Id properties, Id type, int32_t known,
                    const std::vector<unsigned>& given, std::vector<uint64_t>& missing,
                    fhash_error& error) {
    const size_t size = fhash_type_size(known);
    uint8_t fill[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    const int user_defined = 2;  // H5D_FILL_VALUE_USER_DEFINED: others are the zeros of HDF5
    int defined = 0;
    if (hdf5.call("H5Pfill_value_defined", -1, properties, &defined) >= 0 &&
        defined == user_defined &&
        hdf5.call("H5Pget_fill_value", -1, properties, type, (void*)fill) >= 0) {
        if (hdf5.call("H5Tget_order", 0, type) != 1) swap_bytes(fill, size, size);
        uint64_t bits = 0;
        for (size_t i = 0; i < size; i++) bits = bits << 8 | fill[i];
        missing.push_back(bits);
    }
    if (is_complete(given.data(), given.size())) {  // of another dataset, whose numbers are copied
        const size_t end = known == (int32_t)given[5] ? given.size() - 1 : 0;
        for (size_t i = MISSING_COUNT + 1; i < end; i += 2) {
            const uint64_t bits = (uint64_t)given[i + 1] << 32 | given[i];
            if (std::find(missing.begin(), missing.end(), bits) == missing.end())
                missing.push_back(bits);
        }
        missing.resize(std::min<size_t>(missing.size(), MAX_MISSING + 1));
        return true;
    }
    for (size_t i = GIVEN; i + 1 < given.size(); i += 2) {
        const double number = float64_of(given.data() + i);
        const bool there = with_type(known, [&](auto kind) {
            const auto value = cast<decltype(kind)>(number);
            missing.push_back(bits_of(value));
            return is_real<decltype(kind)> || real(value) == number;
        });
        if (!there) {
            return fail(error, FHASH_ERROR_ARGUMENT,
                        "the missing value %g is no number of the dataset's type", number);
        }
    }
    return true;
}

// Adds the numbers of a dataset to those of the user.
bool complete(const Hdf5& hdf5, Id properties, Id type, std::vector<unsigned>& numbers,
              unsigned& flags, fhash_error& error) {
    for (const char* name : CALLED) {
        if (!hdf5.find(name)) {
            return fail(error, FHASH_ERROR_UNSUPPORTED,
                        "%s is not found: this program has HDF5 linked into it; to write with the "
                        "filter, link HDF5's shared library (h5cc -shlib)",
                        name);
        }
    }
    std::vector<unsigned> given(LEAST + 2 * (MAX_MISSING + 1));
    size_t count = given.size();
    char name[1];
    if (hdf5.call("H5Pget_filter_by_id2", -1, properties, FILTER, &flags, &count, given.data(),
                  (size_t)0, name, (unsigned*)nullptr) < 0) {
        return fail(error, FHASH_ERROR_UNSUPPORTED, "this HDF5 does not tell the filter's numbers");
    }
    fhash_quality quality;
    if (!read_quality(given.data(), count, quality, error)) return false;
    given.resize(std::min(count, given.size()));
    const bool copied = is_complete(given.data(), given.size());
    if (!copied && count > GIVEN && (count % 2 == 0 || count > GIVEN + 2 * MAX_MISSING)) {
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "%zu numbers are given; 5 are needed, and two for each of at most %u missing "
                    "values",
                    count, MAX_MISSING);
    }
    given.resize(std::max<size_t>(given.size(), GIVEN));
    given[4] = (unsigned)quality.effort;
    const int32_t known = known_type(hdf5, type);
    if (!known) {
        return fail(error, FHASH_ERROR_UNSUPPORTED,
                    "only integers and floating numbers of IEEE are coded, of 8 to 64 bits; not "
                    "text, compound types, enumerations, bool");
    }
    uint64_t chunk[32];
    const int axes = hdf5.call("H5Pget_chunk", -1, properties, 32, chunk);
    if (axes < 1) return fail(error, FHASH_ERROR_UNSUPPORTED, "the dataset has no chunks");
    uint64_t shape[4] = {1, 1, 1, 1}, values = 1;
    for (int axis = 0; axis < axes; axis++) {
        const int place = axis - axes + 4;
        shape[place < 0 ? 0 : place] *= chunk[axis];
        values *= chunk[axis];  // HDF5 allows chunks below 4 GiB
    }
    if (values > (uint64_t)MOST_VALUES) {
        return fail(error, FHASH_ERROR_UNSUPPORTED,
                    "a chunk has %llu values; at most 2^27 are coded", (unsigned long long)values);
    }
    std::vector<uint64_t> missing;
    if (!missing_values(hdf5, properties, type, known, given, missing, error)) return false;
    numbers.assign(given.begin(), given.begin() + GIVEN);
    numbers.push_back((unsigned)known);
    numbers.push_back(hdf5.call("H5Tget_order", 0, type) == 1);
    for (const uint64_t length : shape) numbers.push_back((unsigned)length);
    numbers.push_back((unsigned)missing.size());
    for (const uint64_t bits : missing) {
        numbers.push_back((unsigned)bits);
        numbers.push_back((unsigned)(bits >> 32));
    }
    numbers.push_back(checksum(numbers.data(), numbers.size()));
    return true;
}

#if defined(_MSC_VER) && !defined(__clang__)
#include <intrin.h>
#define FHASH_CALLER _ReturnAddress()
#else
#define FHASH_CALLER __builtin_extract_return_addr(__builtin_return_address(0))
#endif

// Called by HDF5 when a dataset is made.
int set_local(Id properties, Id type, Id) {
    const Hdf5 hdf5(FHASH_CALLER);
    fhash_error error;
    std::vector<unsigned> numbers;
    unsigned flags = 0;
    const int32_t status = reported(&error, [&](fhash_error& failure) {
        return complete(hdf5, properties, type, numbers, flags, failure);
    });
    if (status != FHASH_OK) {
        hdf5.say(error);
        return -1;
    }
    return hdf5.call("H5Pmodify_filter", -1, properties, FILTER, flags, numbers.size(),
                     (const unsigned*)numbers.data());
}

// A chunk, and what to make of it.
struct Chunk {
    fhash_tile tile;
    size_t bytes;  // of its values
    size_t each;   // of a value
    bool swapped;  // its numbers are not in the order of the machine
};

bool read_chunk(const unsigned* numbers, size_t count, Chunk& chunk, fhash_error& error) {
    if (!is_complete(numbers, count) || !fhash_type_size((int32_t)numbers[5])) {
        return fail(error, FHASH_ERROR_DAMAGED, "the numbers of the dataset are damaged");
    }
    chunk.tile = {};
    chunk.tile.type = (int32_t)numbers[5];
    chunk.each = fhash_type_size(chunk.tile.type);
    chunk.swapped = (numbers[6] != 0) != big_endian_machine();
    int64_t values = 1;
    for (int axis = 0; axis < 4; axis++) {
        chunk.tile.shape[axis] = numbers[7 + axis];
        if (numbers[7 + axis] < 1 || numbers[7 + axis] > MOST_VALUES / values) {
            return fail(error, FHASH_ERROR_DAMAGED, "the chunks of the dataset are damaged");
        }
        values *= numbers[7 + axis];
    }
    chunk.bytes = (size_t)values * chunk.each;
    return true;
}

// Memory that HDF5 may free.
struct Buffer {
    explicit Buffer(size_t bytes) : data(std::malloc(bytes ? bytes : 1)) {}
    ~Buffer() { std::free(data); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    void* data;
};

struct Context {
    Context() : context(fhash_context_create(0, 1)) {}
    ~Context() { fhash_context_destroy(context); }
    Context(const Context&) = delete;
    Context& operator=(const Context&) = delete;
    fhash_context* context;
};

// Decodes a chunk in place; the bytes of its values, or 0.
size_t decode(const Chunk& chunk, size_t given, size_t* size, void** buffer, fhash_error& error) {
    Buffer values(chunk.bytes);
    Context own;
    if (!values.data || !own.context) return fail(error, FHASH_ERROR_MEMORY, "no memory");
    if (fhash_tile_decode(own.context, &chunk.tile, *buffer, given, 0, values.data, nullptr,
                          &error)) {
        return 0;
    }
    if (chunk.swapped) swap_bytes((uint8_t*)values.data, chunk.bytes, chunk.each);
    std::swap(values.data, *buffer);
    return *size = chunk.bytes;
}

// Encodes a chunk in place; the bytes of the stream, or 0.
size_t encode(const Chunk& chunk, const unsigned* numbers, size_t given, size_t* size,
              void** buffer, fhash_error& error) {
    fhash_quality quality;
    if (!read_quality(numbers, GIVEN, quality, error)) return 0;
    if (given != chunk.bytes) {
        return fail(error, FHASH_ERROR_ARGUMENT, "a chunk of %zu bytes; %zu were expected", given,
                    chunk.bytes);
    }
    const size_t room = fhash_tile_bound(&chunk.tile);
    Buffer stream(room), copy(chunk.swapped ? given : 0);
    Context own;
    if (!stream.data || !copy.data || !own.context) {
        return fail(error, FHASH_ERROR_MEMORY, "no memory");
    }
    const void* values = *buffer;
    if (chunk.swapped) {
        values = std::memcpy(copy.data, *buffer, given);
        swap_bytes((uint8_t*)copy.data, given, chunk.each);
    }
    const unsigned count = numbers[MISSING_COUNT];
    std::vector<uint8_t> missing(count * chunk.each + 1);
    for (unsigned number = 0; number < count; number++) {
        const unsigned* const halves = numbers + MISSING_COUNT + 1 + 2 * number;
        const uint64_t bits = (uint64_t)halves[1] << 32 | halves[0];
        uint8_t* const value = missing.data() + number * chunk.each;
        for (size_t i = 0; i < chunk.each; i++)
            value[big_endian_machine() ? chunk.each - 1 - i : i] = (uint8_t)(bits >> 8 * i);
    }
    size_t coded = 0;
    quality.missing = (int32_t)count;
    if (fhash_tile_encode(own.context, &chunk.tile, values, &quality,
                          count ? missing.data() : nullptr, stream.data, room, &coded, &error)) {
        return 0;
    }
    std::swap(stream.data, *buffer);
    *size = room;
    return coded;
}

// Called by HDF5 for each chunk; 0 for an error.
size_t filter(unsigned flags, size_t count, const unsigned* numbers, size_t given, size_t* size,
              void** buffer) {
    const Hdf5 hdf5(FHASH_CALLER);
    Chunk chunk;
    fhash_error error;
    const int32_t status = reported(&error, [&](fhash_error& failure) {
        if (!read_chunk(numbers, count, chunk, failure)) return;
        given = flags & REVERSE ? decode(chunk, given, size, buffer, failure)
                                : encode(chunk, numbers, given, size, buffer, failure);
    });
    if (status == FHASH_OK) return given;
    hdf5.say(error);
    return 0;
}

// H5Z_class2_t of HDF5.
struct Filter {
    int version;
    int number;
    unsigned encodes, decodes;
    const char* name;
    int (*can_apply)(Id, Id, Id);
    int (*set_local)(Id, Id, Id);
    size_t (*filter)(unsigned, size_t, const unsigned*, size_t, size_t*, void**);
};
// Without can_apply: a filter that may be left out would be, silently, where that refuses.
const Filter FHASH = {1, FILTER, 1, 1, "fhash.transform", nullptr, set_local, filter};

}  // namespace

FHASH_EXPORT int H5PLget_plugin_type() { return 0; }  // a filter

FHASH_EXPORT const void* H5PLget_plugin_info() { return &FHASH; }
