// Plain files of the profile compact: tables of numbers, the head as layers, and corrections
// (FORMAT.md, Plain files).
#include <algorithm>
#include <cmath>
#include <cstring>

#include "numbers.hpp"
#include "tile.hpp"
#include "volume.hpp"

namespace fhash {

namespace {

std::string lattice_table(size_t level) { return "table_" + std::to_string(level); }

// Adds corrections to predicted values of one type.
template <class T> bool correct(T* values, const Buffer& corrections, int32_t type) {
    const bool narrow = type == FHASH_FLOAT32;
    const size_t count = corrections.size() / (narrow ? 4 : 8);
    for (size_t i = 0; i < count; i++) {
        const double by = narrow ? double(little<float>(corrections.data() + 4 * i))
                                 : little<double>(corrections.data() + 8 * i);
        if constexpr (is_real<T>) {
            if (!std::isfinite(by)) return false;
            values[i] = cast<T>(real(values[i]) + by);
        } else {
            if (!(std::fabs(by) <= 9223372036854775808.0)) return false;
            const uint64_t moved = by == 9223372036854775808.0 ? uint64_t(1) << 63
                                                               : uint64_t(int64_t(by));
            values[i] = T(uint64_t(values[i]) + moved);
        }
    }
    return true;
}

// The values of a region (t, z, y, x), which is a tile where there is a head.
bool read_part(fhash_file& file, const Variable& variable, const Head* head, const Region& region,
               Buffer& values, fhash_error& error) {
    const Array& table = *variable.find("table_1");
    Region part = region;
    part.last[4] = 1;
    Buffer numbers;
    if (!read_region(file, table, part, numbers, nullptr, error)) return false;
    const size_t count = size_t(region.size(4));
    if (head) {
        Buffer out(numbers.size());
        Shape shape;
        for (size_t a = 0; a < 4; a++) shape[a] = region.last[a] - region.first[a];
        if (!may_use(*file.context, 64 * uint64_t(count), error) ||
            !apply_head(*file.context, *head, reinterpret_cast<float*>(numbers.data()), shape,
                        reinterpret_cast<float*>(out.data()), error))
            return false;
        numbers = std::move(out);
    }
    const Array* const more = variable.find("corrections");
    Buffer corrections;
    if (more && !read_region(file, *more, region, corrections, nullptr, error)) return false;
    const bool narrow = table.type == FHASH_FLOAT32;
    values.resize(count * fhash_type_size(variable.values));
    return with_type(variable.values, [&](auto type) {
        using T = decltype(type);
        T* const out = reinterpret_cast<T*>(values.data());
        for (size_t i = 0; i < count; i++)
            out[i] = cast<T>(narrow ? double(little<float>(numbers.data() + 4 * i))
                                    : little<double>(numbers.data() + 8 * i));
        return !more || correct(out, corrections, more->type) ||
               fail(error, FHASH_ERROR_DAMAGED,
                    "array corrections has numbers beyond the type of the values");
    });
}

// Copies the part that a region of one step and the lattice share.
void take_part(const Lattice& lattice, const Region& region, int64_t key, size_t item,
               const Buffer& values, Buffer& out) {
    const int64_t* const first = region.first.data();
    int64_t lengths[4];
    for (int a = 0; a < 4; a++) lengths[a] = region.last[a] - first[a];
    for (int64_t k = 0; k < lattice.count[0]; k++)
        for (int64_t j = 0; j < lattice.count[1]; j++) {
            const int64_t z = lattice.first[0] + k - first[1], y = lattice.first[1] + j - first[2];
            if (z < 0 || z >= lengths[1] || y < 0 || y >= lengths[2]) continue;
            const int64_t x = std::max(lattice.first[2], first[3]);
            const int64_t end = std::min(lattice.first[2] + lattice.count[2], region.last[3]);
            const int64_t from =
                (((key - first[0]) * lengths[1] + z) * lengths[2] + y) * lengths[3] + x - first[3];
            const int64_t to = (k * lattice.count[1] + j) * lattice.count[2] + x - lattice.first[2];
            std::memcpy(out.data() + size_t(to) * item, values.data() + size_t(from) * item,
                        size_t(end - x) * item);
        }
}

// The table of a level of detail, in the type of the values.
bool read_coarse(fhash_file& file, const Variable& variable, int64_t key, const Lattice& lattice,
                 Frame& frame, fhash_error& error) {
    const Array& table = *variable.find(lattice_table(size_t(lattice.lod) + 1));
    const int64_t step = int64_t(1) << lattice.lod;
    const auto nearest = [&](int a, int64_t number) {
        const int64_t vertex = lattice.first[a] + number * step;
        return std::min((vertex + step / 2) / step, table.shape[size_t(a) + 1] - 1);
    };
    Region region;
    region.first[0] = key;
    region.last[0] = key + 1;
    region.last[4] = 1;
    for (int a = 0; a < 3; a++) {
        region.first[size_t(a) + 1] = nearest(a, 0);
        region.last[size_t(a) + 1] = nearest(a, lattice.count[a] - 1) + 1;
    }
    Buffer numbers;
    if (!read_region(file, table, region, numbers, nullptr, error)) return false;
    const int64_t rows = region.last[2] - region.first[2], row = region.last[3] - region.first[3];
    const bool narrow = table.type == FHASH_FLOAT32;
    return with_type(variable.values, [&](auto type) {
        using T = decltype(type);
        T* out = reinterpret_cast<T*>(frame.values.data());
        for (int64_t k = 0; k < lattice.count[0]; k++)
            for (int64_t j = 0; j < lattice.count[1]; j++)
                for (int64_t i = 0; i < lattice.count[2]; i++) {
                    const size_t at = size_t(((nearest(0, k) - region.first[1]) * rows +
                                              nearest(1, j) - region.first[2]) * row +
                                             nearest(2, i) - region.first[3]);
                    *out++ = cast<T>(narrow ? double(little<float>(numbers.data() + 4 * at))
                                            : little<double>(numbers.data() + 8 * at));
                }
        return true;
    });
}

}  // namespace

bool check_plain(const Variable& variable, fhash_error& error) {
    const Record& model = variable.model;
    int64_t tile[4];
    const bool narrow = variable.tables == "float32";
    if (!model.need(narrow || variable.tables == "float64", "tables", "float32 or float64",
                    error) ||
        !model.integers("tile", 4, 1, MAX_LENGTH, tile, error))
        return false;
    for (size_t level = 0; level < variable.levels.size(); level++) {
        std::vector<int64_t> shape(variable.levels[level].begin(), variable.levels[level].end());
        shape.push_back(1);
        if (!check_array(variable, lattice_table(level + 1).c_str(), shape,
                         {narrow ? int32_t(FHASH_FLOAT32) : int32_t(FHASH_FLOAT64)}, true, error))
            return false;
    }
    const std::vector<int64_t> finest(variable.levels[0].begin(), variable.levels[0].end());
    if (!check_array(variable, "corrections", finest, {FHASH_FLOAT32, FHASH_FLOAT64}, false,
                     error))
        return false;
    return model.need(narrow || variable.mlp.empty(), "tables", "float32 where there is an MLP",
                      error);
}

bool read_plain(fhash_file& file, const Variable& variable, int64_t key, const Lattice& lattice,
                Frame& frame, fhash_error& error) {
    const size_t item = fhash_type_size(variable.values);
    const uint64_t count = uint64_t(lattice.size());
    if (!may_use(*file.context, count * (item + 1), error)) return false;
    frame.type = variable.values;
    frame.values.resize(size_t(count * item));
    frame.mask.assign(size_t(count), 0);
    if (!add_occupancy(file, variable, key, lattice, frame.mask, error)) return false;
    if (lattice.lod) return read_coarse(file, variable, key, lattice, frame, error);
    if (variable.mlp.empty())  // no value depends on others of its tile
        return read_part(file, variable, nullptr, lattice.region(key, key + 1), frame.values,
                         error);
    Head head;
    int64_t tile[4];
    const uint8_t* const mlp = reinterpret_cast<const uint8_t*>(variable.mlp.data());
    if (!variable.model.integers("tile", 4, 1, MAX_LENGTH, tile, error) ||
        !unpack_head({mlp, mlp + variable.mlp.size()}, head, error))
        return false;
    const Region all = lattice.region(key, key + 1);
    int64_t place[4];
    for (int a = 0; a < 4; a++) place[a] = all.first[a] / tile[a];
    while (true) {
        Region region;
        for (int a = 0; a < 4; a++) {
            region.first[a] = place[a] * tile[a];
            region.last[a] = std::min(region.first[a] + tile[a], variable.levels[0][size_t(a)]);
        }
        Buffer values;
        if (!read_part(file, variable, &head, region, values, error)) return false;
        take_part(lattice, region, key, item, values, frame.values);
        int a = 3;
        while (a >= 0 && ++place[a] * tile[a] >= all.last[a]) {
            place[a] = all.first[a] / tile[a];
            a--;
        }
        if (a < 0) return true;
    }
}

}  // namespace fhash
