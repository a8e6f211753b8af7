// Parts of reading a variable: key frames, tables, occupancy.
#include "volume.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>

#include "numbers.hpp"

namespace fhash {

namespace {

// numpy.interp of 0, 1, ... at ascending positions.
double interpolated(const std::vector<double>& positions, double at) {
    const size_t count = positions.size();
    if (at > positions[count - 1]) return double(count - 1);
    if (at < positions[0]) return 0;
    const size_t j = size_t(std::upper_bound(positions.begin(), positions.end(), at) -
                            positions.begin()) - 1;
    if (j + 1 >= count || positions[j] == at) return double(j);
    const double slope = (double(j + 1) - double(j)) / (positions[j + 1] - positions[j]);
    double result = slope * (at - positions[j]) + double(j);
    if (result != result) result = slope * (at - positions[j + 1]) + double(j + 1);
    return result;
}

// The times of all steps in ascending order near 1, or the numbers of the steps.
void order_times(std::vector<double>& times) {
    bool up = true, down = true;
    double peak = 0;
    for (size_t i = 0; i < times.size(); i++) {
        if (!std::isfinite(times[i])) up = down = false;
        peak = std::max(peak, std::fabs(times[i]));
        if (i && !(times[i] > times[i - 1])) up = false;
        if (i && !(times[i] < times[i - 1])) down = false;
    }
    if (!up && !down) {
        for (size_t i = 0; i < times.size(); i++) times[i] = double(i);
        peak = double(times.size() - 1);
    }
    int exponent = 0;
    std::frexp(peak, &exponent);
    const double scale = std::ldexp(1.0, -std::clamp(exponent, -1000, 1000));
    const double sign = times.back() < times[0] ? -1.0 : 1.0;
    for (double& time : times) time = sign * time * scale;
}

bool read_key_frames(fhash_file& file, const Variable& variable, std::vector<int64_t>& keys,
                     fhash_error& error) {
    const Array* const array = variable.find("key_frames");
    if (!array) return fail(error, FHASH_ERROR_DAMAGED, "array key_frames is missing");
    Region all;
    all.last = array->shape;
    Buffer bytes;
    if (!read_region(file, *array, all, bytes, nullptr, error)) return false;
    keys.resize(bytes.size() / 8);
    std::memcpy(keys.data(), bytes.data(), bytes.size());
    for (size_t i = 0; i < keys.size(); i++)
        if (keys[i] < (i ? keys[i - 1] + 1 : 0) || keys[i] >= variable.shape[0])
            return fail(error, FHASH_ERROR_DAMAGED,
                        "array key_frames does not increase within the steps");
    return true;
}

// The key frames and the times of a variable.
struct KeyTimes {
    std::vector<int64_t> keys;
    std::vector<double> steps, at;  // times of all steps, and of the key frames; see order_times

    bool read(fhash_file& file, const Variable& variable, fhash_error& error) {
        const size_t count = size_t(variable.shape[0]);
        if (!may_use(*file.context, uint64_t(count) * 24, error)) return false;
        if (variable.keys() == variable.shape[0]) {
            keys.resize(count);
            std::iota(keys.begin(), keys.end(), 0);
        } else if (!read_key_frames(file, variable, keys, error)) {
            return false;
        }
        steps.resize(count);
        find_positions(variable, 0, steps.data());
        order_times(steps);
        for (const int64_t frame : keys) at.push_back(steps[size_t(frame)]);
        return true;
    }
};

// Where a bit of the occupancy of a vertex is, for each position along an axis.
std::vector<uint64_t> morton_part(const Variable& variable, int axis, const Lattice& lattice) {
    int widths[3] = {};
    for (int a = 0; a < 3; a++)
        for (int64_t rest = variable.length(a) - 1; rest > 0; rest >>= 1) widths[a]++;
    std::vector<uint64_t> parts(size_t(lattice.count[axis]), 0);
    int place = 0;
    for (int bit = 0; bit < 40; bit++)
        for (int a = 2; a >= 0; a--) {
            if (bit >= widths[a]) continue;
            for (int64_t i = 0; a == axis && i < lattice.count[axis]; i++) {
                const int64_t vertex = lattice.first[axis] + (i << lattice.lod);
                parts[size_t(i)] |= (uint64_t(vertex) >> bit & 1) << place;
            }
            place++;
        }
    return parts;
}

bool add_bits(fhash_file& file, const Variable& variable, const Array& array, int64_t key,
              const Lattice& lattice, Buffer& mask, fhash_error& error) {
    std::vector<uint64_t> parts[3];
    for (int a = 0; a < 3; a++) parts[a] = morton_part(variable, a, lattice);
    Region row;
    row.last = array.shape;
    row.first[1] = key;
    row.last[1] = key + 1;
    for (int64_t feature = 0; feature < array.shape[0]; feature++) {
        row.first[0] = feature;
        row.last[0] = feature + 1;
        Buffer bits;
        if (!read_region(file, array, row, bits, nullptr, error)) return false;
        size_t at = 0;
        for (const uint64_t z : parts[0])
            for (const uint64_t y : parts[1])
                for (const uint64_t x : parts[2]) {
                    const uint64_t number = z | y | x;
                    mask[at++] |= bits[size_t(number >> 3)] >> (7 - (number & 7)) & 1;
                }
    }
    return true;
}

// The part of a lattice along one axis that lies in a chunk.
struct Along {
    int64_t begin, end;  // numbers in the lattice
    int64_t start;       // first vertex of the chunk

    Along(const Lattice& lattice, int axis, int64_t place, int64_t length) {
        start = place * length;
        const int64_t step = int64_t(1) << lattice.lod;
        const auto number = [&](int64_t vertex) {
            return std::clamp<int64_t>((vertex - lattice.first[axis] + step - 1) / step, 0,
                                       lattice.count[axis]);
        };
        begin = start <= lattice.first[axis] ? 0 : number(start);
        end = start + length <= lattice.first[axis] ? 0 : number(start + length);
    }
    // The vertex of the chunk that is nearest to one of the lattice, where the chunk has every
    // 2^lod-th.
    int64_t nearest(const Lattice& lattice, int axis, int64_t number, int lod,
                    const Chunk& chunk) const {
        const size_t a = size_t(axis) + 1;
        const int64_t step = int64_t(1) << lod;
        const int64_t vertex = lattice.first[axis] + (number << lattice.lod) - start;
        return std::min((vertex + step / 2) / step - chunk.first[a], chunk.shape[a] - 1);
    }
};

// Copies what a chunk has of a lattice at a key frame. `lod`: level of detail of the chunk.
template <class Take>
void take_chunk(const Array& table, int64_t key, const Lattice& lattice, int lod,
                const Lengths& place, const Chunk& chunk, Take take) {
    const Along z(lattice, 0, place[1], table.inner[1]), y(lattice, 1, place[2], table.inner[2]),
        x(lattice, 2, place[3], table.inner[3]);
    std::vector<int64_t> columns;
    for (int64_t i = x.begin; i < x.end; i++)
        columns.push_back(x.nearest(lattice, 2, i, lod, chunk));
    const int64_t t = key % table.inner[0] - chunk.first[0];
    for (int64_t k = z.begin; k < z.end; k++)
        for (int64_t j = y.begin; j < y.end; j++) {
            const int64_t plane = t * chunk.shape[1] + z.nearest(lattice, 0, k, lod, chunk);
            const int64_t row = plane * chunk.shape[2] + y.nearest(lattice, 1, j, lod, chunk);
            const int64_t to = (k * lattice.count[1] + j) * lattice.count[2] + x.begin;
            take(size_t(to), size_t(row * chunk.shape[3]), columns);
        }
}

template <class T> void copy_row(const Buffer& in, size_t from, const std::vector<int64_t>& columns,
                                 Buffer& out, size_t to) {
    const T* const source = reinterpret_cast<const T*>(in.data()) + from;
    T* target = reinterpret_cast<T*>(out.data()) + to;
    for (const int64_t column : columns) *target++ = source[column];
}

void copy_row(size_t item, const Buffer& in, size_t from, const std::vector<int64_t>& columns,
              Buffer& out, size_t to) {
    switch (item) {
        case 1: return copy_row<uint8_t>(in, from, columns, out, to);
        case 2: return copy_row<uint16_t>(in, from, columns, out, to);
        case 4: return copy_row<uint32_t>(in, from, columns, out, to);
        default: return copy_row<uint64_t>(in, from, columns, out, to);
    }
}

// Whether a frame of floats has NaN.
bool has_nan(const Frame& frame) {
    return with_type(frame.type, [&](auto type) {
        using T = decltype(type);
        if constexpr (!is_real<T>) {
            return false;
        } else {
            const T* const values = reinterpret_cast<const T*>(frame.values.data());
            const size_t count = frame.values.size() / sizeof(T);
            return std::any_of(values, values + count,
                               [](T value) { return std::isnan(real(value)); });
        }
    });
}

}  // namespace

Region Lattice::region(int64_t t, int64_t end) const {
    Region region;
    region.first[0] = t;
    region.last[0] = end;
    for (int a = 0; a < 3; a++) {
        region.first[a + 1] = first[a];
        region.last[a + 1] = last(a);
        region.step[a + 1] = int64_t(1) << lod;
    }
    return region;
}

int detail_levels(const Variable& variable) {
    if (variable.plain) return int(std::min<size_t>(variable.levels.size() - 1, 10));
    int levels = 0;
    for (int a = 0; a < 3 && variable.compact; a++) {
        int bits = 0;
        for (int64_t rest = variable.length(a) - 1; rest > 0; rest >>= 1) bits++;
        levels = std::max(levels, std::min(bits, 11) - 1);
    }
    return levels;
}

int64_t tile_length(const Variable& variable, int axis) {
    int64_t lengths[4] = {};
    fhash_error ignored;
    if (variable.plain) variable.model.integers("tile", 4, 1, MAX_LENGTH, lengths, ignored);
    else if (variable.compact) return variable.find("table_1")->inner[size_t(axis)];
    return lengths[axis];
}

bool find_key(fhash_file& file, const Variable& variable, double step, double& key,
              fhash_error& error) {
    const int64_t steps = variable.shape[0];
    key = step;
    if (variable.keys() == steps) return true;
    KeyTimes times;
    if (!times.read(file, variable, error)) return false;
    const auto index = [&](int64_t number) {
        const auto known = std::lower_bound(times.keys.begin(), times.keys.end(), number);
        if (known != times.keys.end() && *known == number)
            return double(known - times.keys.begin());
        return interpolated(times.at, times.steps[size_t(number)]);
    };
    const int64_t before = int64_t(std::floor(step));
    const double low = index(before), high = index(std::min(before + 1, steps - 1));
    const double last = double(variable.keys() - 1);
    key = std::clamp(low + (high - low) * (step - double(before)), 0.0, last);
    return true;
}

bool find_beside(fhash_file& file, const Variable& variable, int64_t key, Beside& beside,
                 int64_t* steps, fhash_error& error) {
    KeyTimes times;
    if (!times.read(file, variable, error)) return false;
    const auto distance = [&](int64_t from) {
        const bool there = from >= 0 && from + 1 < variable.keys();
        return there ? times.at[size_t(from + 1)] - times.at[size_t(from)] : 0;
    };
    const double between = distance(key);
    beside = {distance(key - 1) / between, distance(key + 1) / between};
    steps[0] = key > 0 ? times.keys[size_t(key - 1)] : -1;
    steps[1] = key + 2 < variable.keys() ? times.keys[size_t(key + 2)] : -1;
    return true;
}

bool read_table(fhash_file& file, const Array& table, int64_t key, const Lattice& lattice,
                Frame& frame, fhash_error& error) {
    const size_t item = fhash_type_size(table.type);
    const uint64_t count = uint64_t(lattice.size());
    if (!may_use(*file.context, count * (item + 1), error)) return false;
    frame.type = table.type;
    frame.values.resize(size_t(count * item));
    frame.mask.assign(size_t(count), 1);
    const Region region = lattice.region(key, key + 1);
    const bool masked = table.masked();
    const auto visit = [&](const Lengths& place, const Chunk& chunk) {
        take_chunk(table, key, lattice, lattice.lod, place, chunk,
                   [&](size_t to, size_t from, const std::vector<int64_t>& columns) {
                       copy_row(item, chunk.values, from, columns, frame.values, to);
                       if (!chunk.mask.empty())
                           copy_row<uint8_t>(chunk.mask, from, columns, frame.mask, to);
                   });
        return true;
    };
    if (!visit_chunks(file, table, region, {lattice.lod}, visit, error)) return false;
    const bool lost = lattice.lod && has_nan(frame);
    if (!lattice.lod || !(masked || lost)) return true;
    // A tile of labels that begins between coarse vertices gives a vertex beside each of them,
    // which may be outside of the coreset where the vertex itself is not.
    const auto restore = [&](const Lengths& place, const Chunk& chunk) {
        take_chunk(table, key, lattice, 0, place, chunk,
                   [&](size_t to, size_t from, const std::vector<int64_t>& columns) {
                       if (masked) copy_row<uint8_t>(chunk.mask, from, columns, frame.mask, to);
                       Frame row = {table.type, Buffer(item), {}};
                       for (size_t i = 0; lost && i < columns.size(); i++) {
                           uint8_t* const own = frame.values.data() + (to + i) * item;
                           std::memcpy(row.values.data(), own, item);
                           if (has_nan(row))
                               std::memcpy(own,
                                           chunk.values.data() +
                                               (from + size_t(columns[i])) * item,
                                           item);
                       }
                   });
        return true;
    };
    return visit_chunks(file, table, region, {}, restore, error);
}

bool add_occupancy(fhash_file& file, const Variable& variable, int64_t key, const Lattice& lattice,
                   Buffer& mask, fhash_error& error) {
    if (const Array* const array = variable.find("coreset")) {
        Frame frame;
        if (!read_table(file, *array, key, lattice, frame, error)) return false;
        const uint8_t all = uint8_t((1u << variable.features) - 1);
        for (size_t i = 0; i < mask.size(); i++) mask[i] |= (frame.values[i] & all) != 0;
        return true;
    }
    const Array* const array = variable.find("occupancy");
    if (!array) return fail(error, FHASH_ERROR_DAMAGED, "array occupancy is missing");
    return add_bits(file, variable, *array, key, lattice, mask, error);
}

}  // namespace fhash
