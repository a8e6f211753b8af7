// The network at scattered points: the functions that Python and the marcher call.
#include "network.h"
#include "points.hpp"

#include <vector>

#include "guard.hpp"

#if defined(FHASH_VECTORS)
namespace {

using namespace fhash_points;

// Numbers that describe a level.
constexpr std::int64_t LEVEL = 2 + 3 * AXES + 4;

// The kernels of a path.
decltype(&run_v1) points(std::int64_t path) {
#if defined(FHASH_TARGETS)
    if (path == FHASH_PATH_V4) return run_v4;
    if (path == FHASH_PATH_V3) return run_v3;
#endif
    return run_v1;
}
decltype(&still_v1) still(std::int64_t path) {
#if defined(FHASH_TARGETS)
    if (path == FHASH_PATH_V4) return still_v4;
    if (path == FHASH_PATH_V3) return still_v3;
#endif
    return still_v1;
}

// A level of an array: address, numbers, three numbers for each axis, and the bitmap.
Level level_at(const int64_t* given) {
    Level level;
    level.table = reinterpret_cast<const float*>(given[0]);
    level.numbers = given[1];
    for (int a = 0; a < AXES; ++a)
        level.axes[a] = {given[2 + 3 * a], given[3 + 3 * a], given[4 + 3 * a]};
    const int64_t* held = given + 2 + 3 * AXES;
    level.held = {reinterpret_cast<const std::uint64_t*>(held[0]),
                  reinterpret_cast<const std::uint32_t*>(held[1]),
                  reinterpret_cast<const std::uint8_t*>(held[2]), held[3]};
    return level;
}

}  // namespace
#endif

// Values (count,) and derivatives (count, 4) by t, z, y and x at points in the box.
//
// sizes: key frames and box (t, z, y, x), levels, layers, numbers at a vertex, whether tables hold
//     several time nodes.
// levels: for each level the address of a part of its table (t, z, y, x, E), its numbers, and for
//     each axis the vertices of the level, the first in the part, and the numbers to the next;
//     then words, blocks and counts of the bitmap of the vertices that it holds, and how many they
//     are, or four times 0 for all vertices. With a bitmap axes count its bits.
// layers: for each layer the address of its matrix, its outputs and its inputs.
// columns: for each coordinate its address, and its numbers from one point to the next.
// slopes: null for values alone.
// by_inputs: derivatives (inputs, count) by the inputs of the first layer; null for none.
// Returns FHASH_NO_PATH for a path that this machine does not have.
FHASH_EXPORT int64_t fhash_network_points(const int64_t* sizes, const int64_t* levels,
                                          const int64_t* layers, const int64_t* columns,
                                          int64_t count, int64_t path, float* values,
                                          float* slopes, float* by_inputs) {
#if defined(FHASH_VECTORS)
    if (!has_path(path)) return FHASH_NO_PATH;
    return guarded([&]() -> std::int64_t {
        std::vector<Level> parts(sizes[4]);
        for (std::int64_t l = 0; l < sizes[4]; ++l) parts[l] = level_at(levels + l * LEVEL);
        std::vector<Layer> matrices(sizes[5]);
        std::int64_t width = 1;
        for (std::int64_t n = 0; n < sizes[5]; ++n) {
            const int64_t* given = layers + 3 * n;
            matrices[n] = {reinterpret_cast<const float*>(given[0]), given[1], given[2]};
            width = given[1] > width ? given[1] : width;
        }
        Points places = {};
        for (int a = 0; a < AXES; ++a) {
            places.columns[a] = reinterpret_cast<const double*>(columns[2 * a]);
            places.steps[a] = columns[2 * a + 1];
        }
        const Task task = {parts.data(), sizes[4],      matrices.data(), sizes[5], sizes,
                           sizes[6],     sizes[7] != 0, width,           matrices[0].inputs};
        return points(path)(task, places, count, values, slopes, by_inputs);
    });
#else
    return FHASH_NO_PATH;
#endif
}

// The numbers of one level's part at one time, as many as one time node of it has.
FHASH_EXPORT int64_t fhash_network_still(const int64_t* sizes, const int64_t* level, double time,
                                         int64_t path, float* numbers) {
#if defined(FHASH_VECTORS)
    if (!has_path(path)) return FHASH_NO_PATH;
    const Level part = level_at(level);
    const int64_t nodes = part.axes[0].stride > 0 ? part.numbers / part.axes[0].stride : 1;
    return still(path)(part, sizes, time, part.numbers / nodes, numbers);
#else
    return FHASH_NO_PATH;
#endif
}
