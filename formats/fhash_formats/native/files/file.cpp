// Files (fhash.h): opening, header, variables and coordinates.
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <new>

#include "volume.hpp"

#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#endif

namespace fhash {

namespace {

constexpr uint64_t CACHE = 64 << 20;  // bytes of decoded chunks that are kept by default

bool open_file(fhash_file& file, fhash_error& error) {
    file.source.context = file.context;
    file.cache.limit = file.context->memory ? file.context->memory / 2 : CACHE;
    if (!read_directory(file.source, file.directory, error) ||
        !read_hierarchy(file.source, file.directory, file.hierarchy, error) ||
        !read_variables(file.hierarchy, file.variables, error))
        return false;
    file.opened->numbered.resize(file.hierarchy.arrays.size());
    for (const auto& each : file.hierarchy.arrays)
        file.opened->numbered[each.second.number - 1] = &each.second;
    return json_text(yyjson_obj_get(file.hierarchy.root, "fhash"), file.opened->header) ||
           fail(error, FHASH_ERROR_MEMORY, "no memory for the header");
}

// The file of a path, UTF-8.
std::FILE* open_stream(const char* path) {
#if defined(_WIN32)
    wchar_t wide[32768];
    if (!MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 32768)) return nullptr;
    return _wfopen(wide, L"rb");
#else
    return std::fopen(path, "rb");
#endif
}

bool seek(std::FILE* stream, uint64_t offset, int whence) {
#if defined(_WIN32)
    return _fseeki64(stream, int64_t(offset), whence) == 0;
#else
    return fseeko(stream, off_t(offset), whence) == 0;
#endif
}

int64_t tell(std::FILE* stream) {
#if defined(_WIN32)
    return _ftelli64(stream);
#else
    return int64_t(ftello(stream));
#endif
}

int32_t read_stream(void* user, uint64_t offset, uint64_t length, void* bytes) {
    Opened& opened = *static_cast<Opened*>(user);
    std::FILE* const stream = static_cast<std::FILE*>(opened.stream);
    Guard guard(opened.stream_lock);  // threads share the position
    return !seek(stream, offset, SEEK_SET) ||
           std::fread(bytes, 1, size_t(length), stream) != size_t(length);
}

// The JSON object of the name and the attributes of a coordinate.
bool describe(const Variable& variable, int axis, std::string& text, fhash_error& error) {
    const Json name = yyjson_obj_get(variable.coordinates[axis], "name");
    const Json kept = yyjson_obj_get(variable.coordinates[axis], "attributes");
    std::string shown = "\"" + std::string(AXES[axis]) + "\"", attributes = "{}";
    if ((name && !json_text(name, shown)) || (kept && !json_text(kept, attributes)))
        return fail(error, FHASH_ERROR_MEMORY, "no memory for attributes");
    text = "{\"name\":" + shown + ",\"attributes\":" + attributes + "}";
    return true;
}

}  // namespace
}  // namespace fhash

using namespace fhash;

// fhash_open with a function that is told what will be read; null for none.
int32_t fhash_file_open(fhash_context* context, fhash_read_function read,
                        fhash_announce_function announce, void* user, uint64_t size,
                        fhash_file** file, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!context || !read || !file)
            return fail(failed, FHASH_ERROR_ARGUMENT, "a context, a function and a place for the "
                                                      "file are needed");
        *file = nullptr;
        std::unique_ptr<fhash_file> made(new fhash_file(context, std::make_shared<Opened>()));
        made->source.function = read;
        made->source.announced = announce;
        made->source.user = user;
        made->source.size = size;
        if (!open_file(*made, failed)) return false;
        *file = made.release();
        return true;
    });
}

int32_t fhash_open(fhash_context* context, fhash_read_function read, void* user, uint64_t size,
                   fhash_file** file, fhash_error* error) {
    return fhash_file_open(context, read, nullptr, user, size, file, error);
}

int32_t fhash_open_path(fhash_context* context, const char* path, fhash_file** file,
                        fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!context || !path || !file)
            return fail(failed, FHASH_ERROR_ARGUMENT, "a context, a path and a place for the file "
                                                      "are needed");
        *file = nullptr;
        std::unique_ptr<fhash_file, void (*)(fhash_file*)> made(
            new fhash_file(context, std::make_shared<Opened>()), fhash_close);
        std::FILE* const stream = open_stream(path);
        made->opened->stream = stream;
        made->source.function = read_stream;
        made->source.user = made->opened.get();
        if (!stream || !seek(stream, 0, SEEK_END) || tell(stream) < 0)
            return fail(failed, FHASH_ERROR_READ, "the file cannot be opened");
        made->source.size = uint64_t(tell(stream));
        if (!open_file(*made, failed)) return false;
        *file = made.release();
        return true;
    });
}

void fhash_close(fhash_file* file) {
    if (file && file->opened->stream) std::fclose(static_cast<std::FILE*>(file->opened->stream));
    delete file;
}

const char* fhash_header(const fhash_file* file) {
    return file ? file->opened->header.c_str() : nullptr;
}

int32_t fhash_variables(const fhash_file* file) {
    return file ? int32_t(file->variables.size()) : 0;
}

int32_t fhash_variable_get(const fhash_file* file, int32_t number, fhash_variable* variable,
                           fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!file || !variable || number < 0 || number >= int32_t(file->variables.size()))
            return fail(failed, FHASH_ERROR_ARGUMENT, "the file has no variable %d", number);
        constexpr size_t least = sizeof(fhash_variable);  // of the first version
        const size_t room = variable->size;
        if (room < least || room > 64 * least)
            return fail(failed, FHASH_ERROR_ARGUMENT,
                        "variable->size is %zu; sizeof(fhash_variable) is needed", room);
        const Variable& found = file->variables[size_t(number)];
        std::memset((void*)variable, 0, room);
        variable->size = room;
        variable->name = found.name.c_str();
        variable->units = found.units.c_str();
        variable->attributes = found.attributes.c_str();
        variable->type = found.type;
        variable->levels = detail_levels(found);
        for (int a = 0; a < 4; a++) {
            variable->shape[a] = found.shape[a];
            variable->tile[a] = tile_length(found, a);
        }
        std::copy(found.box, found.box + 6, variable->box);
        variable->low = found.range[0];
        variable->high = found.range[1];
        variable->background = found.background;
        variable->max_error = found.max_error;
        variable->psnr = found.psnr;
        return true;
    });
}

int32_t fhash_coordinate(fhash_file* file, int32_t number, int32_t axis, double* positions,
                         const char** attributes, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!file || number < 0 || number >= int32_t(file->variables.size()) || axis < 0 ||
            axis > 3 || !positions)
            return fail(failed, FHASH_ERROR_ARGUMENT, "the file has no such axis");
        const Variable& variable = file->variables[size_t(number)];
        find_positions(variable, axis, positions);
        if (!attributes) return true;
        std::string text;
        if (!describe(variable, axis, text, failed)) return false;
        Opened& opened = *file->opened;
        Guard guard(opened.lock);
        for (const std::string& known : opened.texts)
            if (known == text) {
                *attributes = known.c_str();
                return true;
            }
        opened.texts.push_back(text);
        *attributes = opened.texts.back().c_str();
        return true;
    });
}
