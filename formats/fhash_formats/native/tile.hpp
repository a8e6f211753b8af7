// Decoding of a tile (FORMAT.md, Streams and Decoding).
#pragma once

#include "blocks.hpp"

namespace fhash {

enum Kind { TRANSFORMED, PREDICTED, LABELS, EXACT, EMPTY, DIFFERENCES, BLOCKS };
constexpr int OWN = 8, MISSING = 16, RESIDUAL = 32, MASKED = 64, FAST = 128;

// The flags and sections of a stream; a section that is not there has no start. Of BLOCKS the kind
// is TRANSFORMED, and the body begins behind the cut.
struct Stream {
    int kind;
    bool masked, fast;
    Cut cut;
    Bytes settings, missing, body, residual, mask;
};
bool parse_stream(const uint8_t* data, size_t size, Stream& stream, fhash_error& error);

// A tile to decode.
struct Job {
    fhash_context& context;
    Shape shape;
    int32_t type;  // of the array
    int lod;
    Stream stream;
    std::shared_ptr<const Settings> settings;  // null for none

    int64_t size() const { return vertices(shape); }
    Shape out_shape() const { return lod_shape(shape, lod); }
    // Type of what is coded: differences from an origin are int64.
    int32_t coded_type() const {
        return settings && !settings->origin.zero() ? (int32_t)FHASH_INT64 : type;
    }
};
// The job of a call; false with an error.
bool make_job(Job& job, const fhash_tile* tile, const void* stream, size_t size,
              fhash_error& error);
bool is_shape(const int64_t* shape);

// Whether settings turn no finite value into an infinity, in the working type or in that of the
// array; `largest` gets the largest number of both.
bool check_numbers(const Settings& settings, int32_t type, double& largest, fhash_error& error);

// The values of a job in the type of the array, and which are occupied; `occupied` may be null.
bool decode(const Job& job, void* values, uint8_t* occupied, fhash_error& error);
// The same less the origin of the settings, in the type of what is coded.
bool decode_about_origin(const Job& job, void* values, uint8_t* occupied, fhash_error& error);

// The values before head, residual, mask and rounding, in the working type and less the origin; of
// a job whose stream is transformed.
template <class T> bool decode_linear(const Job& job, T* values, fhash_error& error);

// The values of a tile of differences (differences.cpp).
template <class O>
bool decode_differences(Bytes body, const Shape& shape, O* values, fhash_error& error);

// Two levels of each vertex from the values before head and residual, which are compared in T.
template <class T, class L>
bool levels_of_mask(const MaskScores& mask, const Shape& shape, const L* linear, uint8_t* first,
                    uint8_t* second, fhash_error& error);

// Values of predicted integers, within the range.
std::vector<double> foretold_values(const Settings& settings, const std::vector<int32_t>& integers);

// How the coefficients of a job are coded, or its residual.
inline BlockCoding coding_of(const Job& job, bool residual) {
    const Settings& settings = *job.settings;
    return {residual ? nullptr : settings.axes, job.shape, job.stream.cut,
            !residual && settings.trellis, job.stream.fast};
}

// Corrected values of a tile or a part of it as `correct_within` makes them; false with an error
// where a residual makes an infinite one. largest: of `check_numbers`.
template <class T>
bool finish_within(const Settings& settings, int32_t type, const T* base,
                   const std::vector<int32_t>& residual, int64_t n, double largest, void* out,
                   fhash_error& error);

// Values with their residual in a type, within the range of the settings. residual: empty for none.
// out: room for them; may be `base`.
template <class T>
void correct_within(const Settings& settings, int32_t type, const T* base,
                    const std::vector<int32_t>& residual, int64_t n, void* out);

// Values of vertices of a level of detail out of those of all vertices.
template <class O> void thin(const O* in, const Shape& shape, int lod, O* out) {
    const Shape less = lod_shape(shape, lod);
    for (int64_t t = 0; t < less[0]; t++)
        for (int64_t z = 0; z < less[1]; z++)
            for (int64_t y = 0; y < less[2]; y++) {
                const O* const row =
                    in + ((t * shape[1] + (z << lod)) * shape[2] + (y << lod)) * shape[3];
                for (int64_t x = 0; x < less[3]; x++) *out++ = row[x << lod];
            }
}

// Corrects a tile by its head; rows in as many threads as the context has. `out` is not `in`
// unless there is one thread.
bool apply_head(const fhash_context& context, const Head& head, const float* in, const Shape& shape,
                float* out, fhash_error& error);

}  // namespace fhash
