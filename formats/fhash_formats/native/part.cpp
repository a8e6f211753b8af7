// What Python asks of a tile beside its stream and its values: its table, parts of it, and what a
// search for settings tries (transform/tile.py).
#include <cmath>

#include "core.hpp"
#include "functions.h"
#include "encode.hpp"
#include "priors.hpp"
#include "region.hpp"

namespace fhash {
namespace {

constexpr int64_t SHARE = 4;  // a part is corrected alone where its head sees a SHARE-th of frames

// The values of a tile in float32 or float64: those before the head where it is transformed, else
// the values, of which the centre stands for those that are not finite.
template <class T> bool table_of(Job& job, T* values, fhash_error& error) {
    if (job.settings && job.stream.kind == TRANSFORMED) return decode_linear(job, values, error);
    const int64_t n = vertices(job.out_shape());
    const double center = job.settings ? job.settings->center : 0.0;
    std::vector<uint8_t> coded((size_t)n * 8);
    if (!decode_about_origin(job, coded.data(), nullptr, error)) return false;
    return with_type(job.coded_type(), [&](auto type) {
        const auto* const of = (const decltype(type)*)(const void*)coded.data();
        for (int64_t i = 0; i < n; i++) {
            const T value = (T)real(of[i]);
            values[i] = std::isfinite(value) ? value : (T)center;
        }
        return true;
    });
}

// Calls `work` with the settings and the shape of a tile.
template <class Work>
bool with_settings(fhash_context* context, const fhash_tile* tile, fhash_error& error, Work work) {
    const auto settings =
        unpack_settings(*context, (const uint8_t*)tile->settings, tile->settings_size, error);
    if (!settings) return false;
    if (!is_shape(tile->shape))
        return fail(error, FHASH_ERROR_ARGUMENT, "a tile has four lengths");
    Shape shape;
    std::copy_n(tile->shape, 4, shape.begin());
    return work(settings, shape);
}

template <class T>
bool fill(fhash_context& context, const Settings& settings, const Shape& shape,
          const uint8_t* counted, const uint8_t* finite, int density, T* values,
          fhash_error& error) {
    std::shared_ptr<Search<T>> search;
    std::vector<T> target(values, values + vertices(shape));
    if (!make_search(context, settings, shape, search, error) ||
        !fill_uncounted(*search, counted, finite, density, target, error))
        return false;
    std::copy(target.begin(), target.end(), values);
    return true;
}

template <class T>
bool forward(fhash_context& context, const Settings& settings, const Shape& shape, const T* values,
             T* out, fhash_error& error) {
    const auto plan = forward_plan<T>(context, settings, shape, error);
    return plan && kernel_done(plan->transform(values, out), "a transform", error);
}

}  // namespace
}  // namespace fhash

using namespace fhash;

// Fill values of a tile in the working type, where it is not counted, in place (fill_uncounted).
FHASH_KERNEL int32_t fhash_tile_fill(fhash_context* context, const fhash_tile* tile,
                                     const uint8_t* counted, const uint8_t* finite,
                                     int32_t density, void* values, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        return with_settings(context, tile, failed, [&](const auto& settings, const Shape& shape) {
            return settings->real64 ? fill(*context, *settings, shape, counted, finite, density,
                                           (double*)values, failed)
                                    : fill(*context, *settings, shape, counted, finite, density,
                                           (float*)values, failed);
        });
    });
}

// Coefficients of a tile in the working type, low bands first.
FHASH_KERNEL int32_t fhash_tile_forward(fhash_context* context, const fhash_tile* tile,
                                        const void* values, void* out, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        return with_settings(context, tile, failed, [&](const auto& settings, const Shape& shape) {
            return settings->real64 ? forward(*context, *settings, shape, (const double*)values,
                                              (double*)out, failed)
                                    : forward(*context, *settings, shape, (const float*)values,
                                              (float*)out, failed);
        });
    });
}

// The bytes that the fast coder would take for coefficients, and the sum of squared errors in
// The table of a tile less its origin: see decode_tile_table.
//
// values: room for float64 numbers. wide: gets whether they are float64; else they are float32.
// origin: gets the origin's bits, and whether it is negative.
FHASH_KERNEL int32_t fhash_tile_table(fhash_context* context, const fhash_tile* tile,
                                      const void* stream, size_t size, int32_t lod, void* values,
                                      int32_t* wide, uint64_t* origin, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        Job job = {*context, {}, 0, lod, {}, nullptr};
        if (!make_job(job, tile, stream, size, failed)) return false;
        *wide = !job.settings || job.settings->real64;
        origin[0] = job.settings ? job.settings->origin.bits : 0;
        origin[1] = job.settings && job.settings->origin.negative;
        return *wide ? table_of(job, (double*)values, failed)
                     : table_of(job, (float*)values, failed);
    });
}

// The values of a tile before its head, where nothing but fhash_tile_part is left to do.
//
// part: first and last vertex along t, z, y, x. values: room for float32 numbers of the tile.
// done: gets whether there are such values; else the tile is as well decoded whole.
FHASH_KERNEL int32_t fhash_tile_uncorrected(fhash_context* context, const fhash_tile* tile,
                                            const void* stream, size_t size, const int64_t* part,
                                            float* values, int32_t* done, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        Job job = {*context, {}, 0, 0, {}, nullptr};
        *done = 0;
        if (!make_job(job, tile, stream, size, failed)) return false;
        Box some;
        if (!is_part(part, job.shape, some))
            return fail(failed, FHASH_ERROR_ARGUMENT, "a part lies in its tile");
        if (!job.settings || !job.settings->head) return true;
        const Shape seen = widened(some, job.shape).shape();
        const Shape& all = job.shape;
        if (SHARE * seen[1] * seen[2] * seen[3] > all[1] * all[2] * all[3]) return true;
        const Stream& of = job.stream;
        if (of.kind != TRANSFORMED || of.masked || of.settings.at || of.missing.at ||
            of.residual.at)
            return true;
        *done = 1;
        return decode_linear(job, values, failed);
    });
}

// A part of the values of a tile, as fhash_tile_decode gives them.
//
// table: what fhash_tile_uncorrected gave. values: room for the part, in the type of the tile.
FHASH_KERNEL int32_t fhash_tile_part(fhash_context* context, const fhash_tile* tile,
                                     const float* table, const int64_t* part, void* values,
                                     fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        return with_settings(context, tile, failed, [&](const auto& settings, const Shape& shape) {
            Box some;
            if (!is_part(part, shape, some) || !settings->head)
                return fail(failed, FHASH_ERROR_ARGUMENT,
                            "a part lies in its tile, which has a head");
            // At the ends of the tile the head sees its edge either way; farther in, what it sees
            // instead of what was cut off is cut off again.
            const Box wide = widened(some, shape);
            const std::vector<float> base = copied(table, shape, wide);
            std::vector<float> head(base.size());
            if (!apply_head(*context, *settings->head, base.data(), wide.shape(), head.data(),
                            failed))
                return false;
            const Box inner = relative(some, wide);
            const std::vector<float> kept = copied(head.data(), wide.shape(), inner);
            const int64_t n = (int64_t)kept.size();
            const bool about = !settings->origin.zero();
            correct_within(*settings, about ? (int32_t)FHASH_INT64 : tile->type, kept.data(), {}, n,
                           values);
            if (about) add_origin((int64_t*)values, n, settings->origin, tile->type);
            return true;
        });
    });
}

// The bytes that coded integers of a tile take by its predictor. counted: null for all.
FHASH_KERNEL int32_t fhash_tile_foretold(fhash_context* context, const fhash_tile* tile,
                                         const int32_t* integers, const uint8_t* counted,
                                         int64_t* size, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        return with_settings(context, tile, failed, [&](const auto& settings, const Shape& shape) {
            if (!settings->predictor)
                return fail(failed, FHASH_ERROR_ARGUMENT, "the settings have no predictor");
            std::vector<int32_t> given(integers, integers + vertices(shape));
            Buffer data;
            if (!encode_predicted(*settings->predictor, shape, counted, given, data, failed))
                return false;
            *size = (int64_t)data.size();
            return true;
        });
    });
}

// A block of integers that stands alone; as the kernels, which return sizes and errors.
FHASH_KERNEL int64_t fhash_encode_block(const int32_t* integers, const int64_t* shape,
                                        uint8_t* data, int64_t capacity) {
    fhash_error error;
    Shape of;
    std::copy_n(shape, 4, of.begin());
    std::vector<int32_t> given(integers, integers + vertices(of));
    Buffer out;
    if (!encode_integers(given, of, single_band(of), {}, out, error)) return -2;
    if ((int64_t)out.size() <= capacity) std::copy(out.begin(), out.end(), data);
    return (int64_t)out.size();
}

FHASH_KERNEL int64_t fhash_decode_block(const uint8_t* data, int64_t size, const int64_t* shape,
                                        int32_t* integers) {
    fhash_error error;
    Shape of;
    std::copy_n(shape, 4, of.begin());
    if (decode_block(data, (size_t)size, of, integers, error)) return 0;
    return error.status == FHASH_ERROR_MEMORY ? -2 : -1;
}
