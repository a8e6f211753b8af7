// fhash_read: values of a region at a step, or between two steps.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "numbers.hpp"
#include "volume.hpp"

namespace fhash {

namespace {

constexpr double TWO_63 = 9223372036854775808.0;

// A call of fhash_read. The lattice is that of the region, in vertices of the domain; `common` is
// its part within the box, in vertices of the box, and `at` where that part begins in it.
struct Call {
    fhash_file& file;
    const Variable& variable;
    double step;
    int32_t type;
    uint8_t* values;
    Lattice lattice, common;
    int64_t at[3] = {};

    bool integers() const { return type < FHASH_FLOAT16; }
};

bool set_lattice(Call& call, const int64_t* region, int lod, fhash_error& error) {
    const int64_t every = int64_t(1) << lod;
    call.lattice.lod = call.common.lod = lod;
    for (int a = 0; a < 3; a++) {
        const int64_t length = call.variable.shape[a + 1];
        const int64_t low = region ? region[2 * a] : 0, high = region ? region[2 * a + 1] : length;
        const int64_t* const box = call.variable.box + 2 * a;
        if (low < 0 || low >= high || high > length)
            return fail(error, FHASH_ERROR_ARGUMENT,
                        "region %lld:%lld of axis %c is empty or outside 0:%lld", (long long)low,
                        (long long)high, "zyx"[a], (long long)length);
        const int64_t first = (low + every - 1) / every * every;
        const int64_t count = (high - first + every - 1) / every;
        if (count < 1)
            return fail(error, FHASH_ERROR_ARGUMENT,
                        "region %lld:%lld of axis %c holds no multiple of %lld", (long long)low,
                        (long long)high, "zyx"[a], (long long)every);
        const auto number = [&](int64_t vertex) {
            return vertex <= first ? 0 : std::min(count, (vertex - first + every - 1) / every);
        };
        const int64_t begin = number(box[0]), end = number(box[1]);
        call.lattice.first[a] = first;
        call.lattice.count[a] = count;
        call.at[a] = begin;
        call.common.first[a] = first + begin * every - box[0];
        call.common.count[a] = end - begin;
    }
    for (int a = 0; a < 3; a++)
        if (call.common.count[a] < 1) call.common.count[0] = 0;
    Region all;
    std::copy(call.lattice.count, call.lattice.count + 3, all.last.begin());
    return all.size(3) <= SIZE_MAX / 16 || fail(error, FHASH_ERROR_MEMORY, "no memory");
}

// The steps that a value is of: one, or the two that it lies between and those beside them.
struct Frames {
    Frame first, second, before, behind;  // the last two without values where there are none
    double share = 0;
    Beside beside;
};

// Takes out of a mask the vertices that had no finite value at a step or one beside it.
bool take_missing(const Call& call, double step, Buffer& mask, fhash_error& error) {
    const Array* const array = call.variable.find("missing");
    if (!array) return true;
    const int64_t* const shape = call.variable.shape;
    const int64_t* const box = call.variable.box;
    const Lattice& common = call.common;
    Region row;
    row.first[0] = int64_t(std::floor(step));
    row.last[0] = row.first[0] + 1;
    const int64_t layer = shape[2] * shape[3];
    row.first[1] = (box[0] + common.first[0]) * layer / 8;
    row.last[1] = ((box[0] + common.last(0)) * layer + 7) / 8;
    for (; row.first[0] <= int64_t(std::ceil(step)); row.first[0]++, row.last[0]++) {
        Buffer bits;
        if (!read_region(call.file, *array, row, bits, nullptr, error)) return false;
        size_t to = 0;
        for (int64_t k = 0; k < common.count[0]; k++)
            for (int64_t j = 0; j < common.count[1]; j++) {
                const int64_t z = box[0] + common.first[0] + (k << common.lod);
                const int64_t y = box[2] + common.first[1] + (j << common.lod);
                int64_t bit = z * layer + y * shape[3] + box[4] + common.first[2];
                bit -= row.first[1] * 8;
                for (int64_t i = 0; i < common.count[2]; i++, bit += int64_t(1) << common.lod)
                    if (bits[size_t(bit >> 3)] >> (7 - (bit & 7)) & 1) mask[to++] = 0;
                    else to++;
            }
    }
    return true;
}

bool check_finite(const Frame& frame, fhash_error& error) {
    return with_type(frame.type, [&](auto type) {
        using T = decltype(type);
        if constexpr (is_real<T>) {
            const T* const values = reinterpret_cast<const T*>(frame.values.data());
            const auto infinite = [](T value) { return std::isinf(real(value)); };
            if (std::any_of(values, values + frame.values.size() / sizeof(T), infinite))
                return fail(error, FHASH_ERROR_DAMAGED,
                            "the table holds infinities; the file is damaged");
        }
        return true;
    });
}

constexpr size_t BLOCK = 256;  // values between steps that are found together

// Some values of a frame from vertex `start` on; NaN where it has none. `masked`: its mask counts.
void take_values(const Frame& frame, size_t start, size_t count, bool masked, double* out) {
    std::fill_n(out, count, not_a_number<double>());
    if (frame.values.empty()) return;
    with_type(frame.type, [&](auto type) {
        const auto* const values =
            reinterpret_cast<const decltype(type)*>(frame.values.data()) + start;
        for (size_t i = 0; i < count; i++)
            if (!masked || frame.mask[start + i]) out[i] = real(values[i]);
        return true;
    });
}

// The values of one frame, or between two, in a type of floats.
template <class F>
void to_floats(const Call& call, const Frames& frames, bool clipped, std::vector<F>& out) {
    const F low = F(call.variable.within[0]), high = F(call.variable.within[1]);
    out.resize(frames.first.mask.size());
    double held[4][BLOCK], between[BLOCK];
    const double* const each[4] = {held[0], held[1], held[2], held[3]};
    for (size_t start = 0; start < out.size(); start += BLOCK) {
        const size_t count = std::min(BLOCK, out.size() - start);
        take_values(frames.first, start, count, false, held[1]);
        if (frames.share > 0) {
            take_values(frames.before, start, count, true, held[0]);
            take_values(frames.second, start, count, false, held[2]);
            take_values(frames.behind, start, count, true, held[3]);
            values_between(each, frames.beside, int64_t(count), &frames.share, true, between,
                           nullptr);
        }
        for (size_t i = 0; i < count; i++) {
            F value = F(frames.share > 0 ? between[i] : held[1][i]);
            if (clipped && value < low) value = low;
            if (clipped && value > high) value = high;
            out[start + i] =
                frames.first.mask[start + i] ? value : std::numeric_limits<F>::quiet_NaN();
        }
    }
}

// Rows of the part within the box: where they begin in the result.
template <class Row> void for_rows(const Call& call, Row row) {
    const int64_t* const count = call.common.count;
    for (int64_t k = 0; k < count[0]; k++)
        for (int64_t j = 0; j < count[1]; j++) {
            const int64_t to = ((call.at[0] + k) * call.lattice.count[1] + call.at[1] + j) *
                                   call.lattice.count[2] + call.at[2];
            row(size_t((k * count[1] + j) * count[2]), size_t(to), size_t(count[2]));
        }
}

template <class Out, class F> void put_floats(const Call& call, const std::vector<F>& values) {
    Out* const out = reinterpret_cast<Out*>(call.values);
    for_rows(call, [&](size_t from, size_t to, size_t count) {
        for (size_t i = 0; i < count; i++) out[to + i] = cast<Out>(double(values[from + i]));
    });
}

// NaN everywhere.
void blank_floats(const Call& call) {
    with_type(call.type, [&](auto type) {
        using T = decltype(type);
        if constexpr (is_real<T>)
            std::fill_n(reinterpret_cast<T*>(call.values), call.lattice.size(), not_a_number<T>());
        return true;
    });
}

template <class F>
bool give_floats(const Call& call, const Frames& frames, bool clipped, fhash_error& error) {
    if (!may_use(*call.file.context, sizeof(F) * uint64_t(call.common.size()), error)) return false;
    std::vector<F> values;
    to_floats<F>(call, frames, clipped, values);
    if (call.type == FHASH_FLOAT16) put_floats<Half>(call, values);
    if (call.type == FHASH_FLOAT32) put_floats<float>(call, values);
    if (call.type == FHASH_FLOAT64) put_floats<double>(call, values);
    return true;
}

// The fill value of the file in a type of integers; false where it has none.
template <class T> bool find_fill(Json fill, T& found) {
    if (!fill) return false;
    using Limits = std::numeric_limits<T>;
    if (yyjson_is_int(fill) && yyjson_is_uint(fill)) {
        found = T(yyjson_get_uint(fill));
        return yyjson_get_uint(fill) <= uint64_t(Limits::max());
    }
    if (yyjson_is_int(fill)) {
        found = T(yyjson_get_sint(fill));
        return yyjson_get_sint(fill) >= int64_t(Limits::min());
    }
    const double value = yyjson_get_num(fill);
    const double high = sizeof(T) < 8 ? double(Limits::max()) + 1
                        : Limits::min() == 0 ? 2 * TWO_63 : TWO_63;
    if (value != std::floor(value) || value < double(Limits::min()) || value >= high) return false;
    found = T(value);
    return true;
}

// The integers of the file, and its fill value at the other vertices of the region. `frame`: null
// for none within the box.
bool give_integers(const Call& call, const Frame* frame, fhash_error& error) {
    return with_type(call.type, [&](auto type) {
        using T = decltype(type);
        if constexpr (is_real<T>) {
            return false;
        } else {
            T* const out = reinterpret_cast<T*>(call.values);
            T fill = 0;
            const bool whole = frame && call.common.size() == call.lattice.size() &&
                               std::count(frame->mask.begin(), frame->mask.end(), 0) == 0;
            if (!whole && !find_fill(call.variable.fill, fill))
                return fail(error, FHASH_ERROR_ARGUMENT,
                            "some vertices have no value, and the file has no fill value of its "
                            "type; read floats");
            std::fill_n(out, call.lattice.size(), fill);
            if (!frame) return true;
            const T* const values = reinterpret_cast<const T*>(frame->values.data());
            for_rows(call, [&](size_t from, size_t to, size_t count) {
                for (size_t i = 0; i < count; i++)
                    if (frame->mask[from + i]) out[to + i] = values[from + i];
            });
            return true;
        }
    });
}

// A frame of the profile compact with its mask.
bool read_compact(const Call& call, int64_t key, Frame& frame, fhash_error& error) {
    const Variable& variable = call.variable;
    const bool read =
        variable.plain
            ? read_plain(call.file, variable, key, call.common, frame, error)
            : read_table(call.file, *variable.find("table_1"), key, call.common, frame,
                         error);
    return read && check_finite(frame, error);
}

// Values of the profile paper, float64.
bool read_paper(const Call& call, double key, Frame& frame, fhash_error& error) {
    const Variable& variable = call.variable;
    const size_t count = size_t(call.common.size());
    frame.type = FHASH_FLOAT64;
    if (!may_use(*call.file.context, 9 * uint64_t(count), error)) return false;
    frame.mask.assign(count, 0);
    frame.values.resize(8 * count);
    double* const values = reinterpret_cast<double*>(frame.values.data());
    for (int64_t each : {int64_t(std::floor(key)), int64_t(std::ceil(key))})
        if (!add_occupancy(call.file, variable, each, call.common, frame.mask, error)) return false;
    return read_network(call.file, variable, key, call.common, frame.mask, values, error);
}

// The values at a key index of the profile compact, or those that it lies between.
bool read_compact_at(const Call& call, double key, Frames& frames, fhash_error& error) {
    const int64_t before = int64_t(std::floor(key));
    frames.share = key - double(before);
    if (!read_compact(call, before, frames.first, error)) return false;
    if (frames.share == 0) return true;
    if (!read_compact(call, before + 1, frames.second, error)) return false;
    // A value is no better than the two that it lies between.
    Buffer& mask = frames.first.mask;
    for (size_t i = 0; i < mask.size(); i++) mask[i] &= frames.second.mask[i];
    if (!call.variable.cubic) return true;
    int64_t steps[2];
    if (!find_beside(call.file, call.variable, before, frames.beside, steps, error)) return false;
    return (steps[0] < 0 || (read_compact(call, before - 1, frames.before, error) &&
                             take_missing(call, double(steps[0]), frames.before.mask, error))) &&
           (steps[1] < 0 || (read_compact(call, before + 2, frames.behind, error) &&
                             take_missing(call, double(steps[1]), frames.behind.mask, error)));
}

bool read_values(Call& call, fhash_error& error) {
    const Variable& variable = call.variable;
    if (!call.integers()) blank_floats(call);
    if (call.common.count[0] < 1)
        return !call.integers() || give_integers(call, nullptr, error);
    double key = 0;
    if (!find_key(call.file, variable, call.step, key, error)) return false;
    Frames frames;
    if (!(variable.compact ? read_compact_at(call, key, frames, error)
                           : read_paper(call, key, frames.first, error)) ||
        !take_missing(call, call.step, frames.first.mask, error))
        return false;
    if (call.integers()) return give_integers(call, &frames.first, error);
    const bool clipped = key != std::floor(key);
    return variable.in_float32() ? give_floats<float>(call, frames, clipped, error)
                                 : give_floats<double>(call, frames, clipped, error);
}

bool check_type(const Call& call, fhash_error& error) {
    if (call.type == FHASH_FLOAT32 || call.type == FHASH_FLOAT64) return true;
    const Variable& variable = call.variable;
    if (call.type != variable.type || call.step != std::floor(call.step) || call.lattice.lod)
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "type is float32, float64, or at a whole step with lod 0 that of the source");
    const bool held = variable.compact && variable.values == variable.type &&
                      variable.keys() == variable.shape[0];
    return held || !call.integers() ||
           fail(error, FHASH_ERROR_UNSUPPORTED,
                "the file does not hold the integers of its source; read floats");
}

}  // namespace

}  // namespace fhash

using namespace fhash;

int32_t fhash_read(fhash_file* file, int32_t number, double step, const int64_t* region,
                   int32_t lod, int32_t type, void* values, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!file || number < 0 || number >= fhash_variables(file) || !values)
            return fail(failed, FHASH_ERROR_ARGUMENT,
                        "a file, a variable of it and room for values are needed");
        const Variable& variable = file->variables[size_t(number)];
        if (!(step >= 0 && step <= double(variable.shape[0] - 1)))
            return fail(failed, FHASH_ERROR_ARGUMENT, "step %g is outside 0 to %lld", step,
                        (long long)(variable.shape[0] - 1));
        const int levels = detail_levels(variable);
        if (lod < 0 || lod > levels)
            return fail(failed, FHASH_ERROR_ARGUMENT, "lod %d; the variable has 0 to %d", lod,
                        levels);
        Call call = {*file, variable, step, type, static_cast<uint8_t*>(values), {}, {}, {}};
        return set_lattice(call, region, lod, failed) && check_type(call, failed) &&
               read_values(call, failed);
    });
}
