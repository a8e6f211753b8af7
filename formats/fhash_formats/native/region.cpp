// A part of a tile in blocks, from the blocks that it needs (blocks.hpp).
#include "core.hpp"
#include "functions.h"
#include "kernels.hpp"
#include "memory.hpp"
#include "numbers.hpp"
#include "region.hpp"
#include "tile.hpp"

namespace fhash {

Box widened(const Box& part, const Shape& shape) {
    Box wide;
    for (size_t a = 0; a < 4; a++) {
        wide.first[a] = std::max<int64_t>(0, part.first[a] - HEAD_REACH);
        wide.last[a] = std::min(shape[a], part.last[a] + HEAD_REACH);
    }
    return wide;
}

Box relative(const Box& box, const Box& to) {
    Box moved;
    for (size_t a = 0; a < 4; a++) {
        moved.first[a] = box.first[a] - to.first[a];
        moved.last[a] = box.last[a] - to.first[a];
    }
    return moved;
}

bool is_part(const int64_t* numbers, const Shape& shape, Box& part) {
    for (size_t a = 0; a < 4; a++) {
        part.first[a] = numbers[2 * a];
        part.last[a] = numbers[2 * a + 1];
        if (part.first[a] < 0 || part.first[a] >= part.last[a] || part.last[a] > shape[a])
            return false;
    }
    return true;
}

namespace {

// A part is decoded apart that needs no more than one in MOST_NEEDED coefficients, and is not more
// than one in LEAST_PARTS of the vertices of its steps: whoever reads whole steps reads them one
// after the other, and is served sooner by all of the tile.
constexpr int64_t MOST_NEEDED = 2, LEAST_PARTS = 4;

bool is_small(const Job& job, const Box& part, const Box& seen) {
    const Shape size = part.shape(), &all = job.shape;
    if (LEAST_PARTS * size[1] * size[2] * size[3] > all[1] * all[2] * all[3]) return false;
    const Need need(job.settings->axes, all, job.stream.cut, seen);
    return MOST_NEEDED * count_needed(coding_of(job, false), need) <= job.size();
}

// The plan of a box of blocks, as of a tile of its shape; the norms are those of the tile.
template <class T> Plan<T> plan_of(const Plan<T>& all, const Settings& settings, const Box& box) {
    Plan<T> plan;
    plan.shape = plan.bands = box.shape();
    plan.lod = 0;
    plan.threads = all.threads;
    for (size_t a = 0; a < 4; a++) {
        plan.kinds[a] = all.kinds[a];
        plan.depths[a] = all.depths[a];
        plan.ranks[a] = all.ranks[a];
        plan.matrices[a] = all.matrices[a];
        plan.halvings[a] = 0;
    }
    const Shape own = plan.shape;
    const auto gather = [&](size_t one, size_t other, const std::vector<T>& norms) {
        Shape tile = {1, 1, 1, 1};
        Box part = {{}, tile};
        AxisTransform axes[4];
        for (const size_t a : {one, other}) {
            axes[a] = settings.axes[a];
            tile[a] = all.shape[a];
            part.first[a] = box.first[a];
            part.last[a] = box.last[a];
        }
        std::vector<T> some((size_t)(own[one] * own[other]));
        BlockPlaces(axes, tile, part).gather(norms.data(), some.data());
        return some;
    };
    plan.tz = gather(0, 1, all.tz);
    plan.yx = gather(2, 3, all.yx);
    return plan;
}

// The values of a part before head and residual.
template <class T>
bool linear_part(const Job& job, const Box& part, std::vector<T>& values, fhash_error& error) {
    const Settings& settings = *job.settings;
    const auto all = plan_for<T>(job.context, settings, job.shape, 0, error);
    if (!all) return false;
    const Need need(settings.axes, job.shape, job.stream.cut, part);
    const Plan<T> plan = plan_of(*all, settings, need.box);
    std::vector<int32_t> integers;
    std::vector<T> room;
    make_room(integers, (size_t)vertices(plan.shape));
    make_room(room, integers.size());
    if (!decode_needed(coding_of(job, false), need, job.context.threads, job.stream.body,
                       integers.data(), error) ||
        !linear_values(settings, plan, integers.data(), room.data(), error))
        return false;
    values = copied(room.data(), plan.shape, relative(part, need.box));
    return true;
}

bool residual_part(const Job& job, const Box& part, std::vector<int32_t>& residual,
                   fhash_error& error) {
    if (!job.stream.residual.at) return true;
    const BlockCoding coding = coding_of(job, true);
    const Need need(nullptr, job.shape, job.stream.cut, part);
    std::vector<int32_t> integers((size_t)vertices(need.box.shape()));
    if (!decode_needed(coding, need, job.context.threads, job.stream.residual, integers.data(),
                       error))
        return false;
    residual = copied(integers.data(), need.box.shape(), relative(part, need.box));
    return true;
}

template <class T>
bool region(const Job& job, const Box& part, const Box& seen, void* values, fhash_error& error) {
    const Settings& settings = *job.settings;
    double largest;
    std::vector<T> linear;
    std::vector<int32_t> residual;
    if (!check_numbers(settings, job.coded_type(), largest, error) ||
        !linear_part(job, seen, linear, error) || !residual_part(job, part, residual, error))
        return false;
    if constexpr (std::is_same<T, float>::value) {
        if (settings.head) {
            std::vector<float> headed(linear.size());
            if (!apply_head(job.context, *settings.head, linear.data(), seen.shape(),
                            headed.data(), error))
                return false;
            linear = copied(headed.data(), seen.shape(), relative(part, seen));
        }
    }
    const int64_t n = vertices(part.shape());
    if (!finish_within(settings, job.coded_type(), linear.data(), residual, n, largest, values,
                       error))
        return false;
    if (!settings.origin.zero()) add_origin((int64_t*)values, n, settings.origin, job.type);
    return true;
}

}  // namespace
}  // namespace fhash

using namespace fhash;

// A part of the values of a tile, as fhash_tile_decode gives them, where it is had from a few
// blocks.
//
// part: first and last vertex along t, z, y, x. values: room for the part. done: gets whether there
// are such blocks; else the tile is as well decoded whole.
FHASH_KERNEL int32_t fhash_tile_region(fhash_context* context, const fhash_tile* tile,
                                       const void* stream, size_t size, const int64_t* part,
                                       void* values, int32_t* done, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        Job job = {*context, {}, 0, 0, {}, nullptr};
        *done = 0;
        if (!make_job(job, tile, stream, size, failed)) return false;
        Box some;
        if (!is_part(part, job.shape, some))
            return fail(failed, FHASH_ERROR_ARGUMENT, "a part lies in its tile");
        const Stream& of = job.stream;
        if (!job.settings || !is_cut(of.cut) || of.masked || of.missing.at) return true;
        const Settings& settings = *job.settings;
        const Box seen = settings.head ? widened(some, job.shape) : some;
        if (!is_small(job, some, seen)) return true;
        *done = 1;
        return settings.real64 ? region<double>(job, some, seen, values, failed)
                               : region<float>(job, some, seen, values, failed);
    });
}
