// Values and derivatives of the network at scattered points for one path (FHASH_TARGET), a tile of
// TILE points at a time.
//
// The interpolation goes point by point, since neighbouring numbers of a table lie together: the
// two corners along x are one row of 2 E numbers. The layers go by vectors of points. Each number
// of a point is computed by operations that no other point of the tile changes, so a point has the
// same bits whatever points are given with it. Sums have the form (a - w a) + w b or s + w x, of
// which the compiler makes fused multiply-adds where the machine has them.
#pragma once

#include <memory>

#include "points.hpp"

#if defined(FHASH_VECTORS)
namespace fhash_points {
namespace {

constexpr int TILE = 64;
// Bytes of a table's part from which its rows are fetched ahead.
constexpr std::int64_t FAR_BYTES = 1 << 20;

// Numbers that nobody has set: zeros would cost a tile of a small network as much as its layers.
template <class T> struct Unset {
    explicit Unset(std::int64_t count) : numbers(new T[count]) {}
    T* data() { return numbers.get(); }
    std::unique_ptr<T[]> numbers;
};

// The numbers of one tile. Rows have TILE numbers.
struct Workspace {
    explicit Workspace(const Task& task)
        : offsets(task.level_count * TILE),
          after(task.level_count * AXES * TILE),
          inputs(task.inputs * TILE),
          changes(AXES * task.inputs * TILE),
          hidden(task.layer_count * task.width * TILE),
          slopes(2 * (task.width + task.inputs) * TILE) {}
    Unset<double> offsets;  // (levels, TILE): the first corner's place in the part
    Unset<float> after;     // (levels, AXES, TILE): weights of the corners after the points
    Unset<float> inputs;    // (inputs, TILE)
    Unset<float> changes;   // (AXES, inputs, TILE): derivatives of the inputs
    Unset<float> hidden;    // (layers, width, TILE): outputs of each layer
    Unset<float> slopes;    // two times (width or inputs, TILE)
};

// Find the cells around the points of a tile at one level. The quotient position (R - 1) / (S - 1)
// is rounded to the nearest cell by a product and a sum, and mended by the remainder, so that a
// point on a corner lies exactly in the cell that begins there. Rounding so is a loop that every
// machine has vectors for.
FHASH_INLINE void locate(const Level& level, const std::int64_t* sizes, const double* points,
                         double* FHASH_RESTRICT offsets, float* FHASH_RESTRICT after) {
    constexpr double WHOLE = 6755399441055744.0;  // 1.5 * 2^52: sums with it are whole numbers
    double weights[TILE];
    for (int i = 0; i < TILE; ++i) offsets[i] = 0;
    for (int a = 0; a < AXES; ++a) {
        const Axis& axis = level.axes[a];
        const double span = sizes[a] > 1 ? (double)(sizes[a] - 1) : 1.0, inverse = 1.0 / span;
        const double last = axis.vertices > 2 ? (double)(axis.vertices - 2) : 0.0;
        const double times = (double)(axis.vertices - 1);
        const double stride = (double)axis.stride, first = (double)axis.first;
        const double* FHASH_RESTRICT at = points + a * TILE;
        for (int i = 0; i < TILE; ++i) {
            const double position = at[i] * times;
            double cell = (position * inverse + WHOLE) - WHOLE;
            double rest = position - cell * span;
            const double above = rest < 0.0 ? 1.0 : 0.0;
            cell -= above, rest += above * span;
            const double behind = cell > last ? 1.0 : 0.0;
            cell -= behind, rest += behind * span;
            weights[i] = rest * inverse;
            offsets[i] += (cell - first) * stride;
        }
        for (int i = 0; i < TILE; ++i) after[a * TILE + i] = (float)weights[i];
    }
}

// Ask for the rows of numbers around the points of a tile.
FHASH_INLINE void fetch(const Level& level, const double* offsets, bool times) {
    const std::int64_t z = level.axes[1].stride, y = level.axes[2].stride;
    for (int i = 0; i < TILE; ++i)
        for (std::int64_t t = 0; t <= (times ? level.axes[0].stride : 0);
             t += times ? level.axes[0].stride : 1) {
            const float* row = level.table + (std::int64_t)offsets[i] + t;
            __builtin_prefetch(row);
            __builtin_prefetch(row + y);
            __builtin_prefetch(row + z);
            __builtin_prefetch(row + z + y);
        }
}

// Numbers C of the two corners along x, one after the other.
template <int C> struct Pair {
    typedef float Row __attribute__((vector_size(8 * C)));
};

// The row at a corner: 2 C numbers that lie together where E is C.
template <int C, bool TOGETHER>
typename Pair<C>::Row row_at(const float* from, std::int64_t embedding) {
    typename Pair<C>::Row row;
    if (TOGETHER) {
        std::memcpy(&row, from, sizeof row);
    } else {
        for (int c = 0; c < C; ++c) row[c] = from[c], row[C + c] = from[embedding + c];
    }
    return row;
}

// The number between two, w of the way from a to b: exactly a where w is 0, and b where it is 1,
// whatever the other one is. The ends of an axis have w = 1.
template <class V> V between(const V& a, const V& b, float w) {
    return (a - w * a) + w * b;
}

// The place of a vertex among those that a level holds: the rank of its bit.
std::int64_t place_of(const Held& held, std::int64_t bit) {
    // The bit moves to the top of its word, and all that come after it fall out.
    const std::uint64_t upto = held.words[bit >> 6] << (63 - (bit & 63));
    const std::int64_t rank = (std::int64_t)held.blocks[bit >> 8] + held.within[bit >> 6] +
                              __builtin_popcountll(upto);
    return (std::int64_t)upto < 0 ? rank - 1 : held.nothing;
}

// As row_at, of a level that holds some vertices only. `table` begins at the first number to take.
template <int C>
typename Pair<C>::Row held_row(const Level& level, const float* table,
                                            std::int64_t bit, std::int64_t embedding) {
    typename Pair<C>::Row row;
    const float* low = table + place_of(level.held, bit) * embedding;
    const float* high = table + place_of(level.held, bit + level.axes[3].stride) * embedding;
    for (int c = 0; c < C; ++c) row[c] = low[c], row[C + c] = high[c];
    return row;
}

// Write the embeddings of a level at the points of a tile, and with GRADIENT their derivatives per
// vertex of the box. `inputs` and `changes` begin at the first row of the level.
template <int C, bool TOGETHER, bool TIMES, bool GRADIENT, bool SPARSE>
FHASH_INLINE void interpolate(const Level& level, const Task& task, const double* offsets,
                              const float* FHASH_RESTRICT after, std::int64_t first,
                              float* FHASH_RESTRICT inputs, float* FHASH_RESTRICT changes) {
    typedef typename Pair<C>::Row Row;
    const std::int64_t embedding = task.embedding, axis = task.inputs * TILE;
    const std::int64_t t = level.axes[0].stride, z = level.axes[1].stride, y = level.axes[2].stride;
    float pace[AXES];
    for (int a = 0; a < AXES; ++a)
        pace[a] = (float)((double)(level.axes[a].vertices - 1) /
                          (task.sizes[a] > 1 ? (double)(task.sizes[a] - 1) : 1.0));
    const float* table = level.table + first;
    for (int i = 0; i < TILE; ++i) {
        const std::int64_t from = (std::int64_t)offsets[i];
        const float wt = after[i], wz = after[TILE + i], wy = after[2 * TILE + i],
                    wx = after[3 * TILE + i];
        Row corners[4], by_t[4];
        FHASH_UNROLLED
        for (int k = 0; k < 4; ++k) {
            const std::int64_t corner = from + (k & 2 ? z : 0) + (k & 1 ? y : 0);
            corners[k] = SPARSE ? held_row<C>(level, table, corner, embedding)
                                : row_at<C, TOGETHER>(table + corner, embedding);
            if (TIMES) {
                const Row next = row_at<C, TOGETHER>(table + corner + t, embedding);
                by_t[k] = next - corners[k];
                corners[k] = between(corners[k], next, wt);
            }
        }
        const Row y0 = between(corners[0], corners[2], wz);
        const Row y1 = between(corners[1], corners[3], wz);
        const Row line = between(y0, y1, wy);
        const auto along_x = [&](const Row& row, int c) FHASH_LAMBDA {
            return between((float)row[c], (float)row[C + c], wx);
        };
        for (int c = 0; c < C; ++c) inputs[(first + c) * TILE + i] = along_x(line, c);
        if (GRADIENT) {
            float* change = changes + first * TILE + i;
            const Row z0 = corners[2] - corners[0], z1 = corners[3] - corners[1];
            const Row by_z = between(z0, z1, wy), by_y = y1 - y0;
            for (int c = 0; c < C; ++c) {
                change[c * TILE + axis] = pace[1] * along_x(by_z, c);
                change[c * TILE + 2 * axis] = pace[2] * along_x(by_y, c);
                change[c * TILE + 3 * axis] = pace[3] * (line[C + c] - line[c]);
            }
            if (TIMES) {
                const Row low = between(by_t[0], by_t[2], wz);
                const Row high = between(by_t[1], by_t[3], wz);
                const Row both = between(low, high, wy);
                for (int c = 0; c < C; ++c) change[c * TILE] = pace[0] * along_x(both, c);
            }
        }
    }
}

// The same for a level that holds all vertices or some.
template <int C, bool TOGETHER, bool TIMES, bool GRADIENT>
void interpolate_any(const Level& level, const Task& task, const double* offsets,
                                  const float* after, std::int64_t first, float* inputs,
                                  float* changes) {
    if (!TIMES && level.held.words)
        interpolate<C, TOGETHER, false, GRADIENT, true>(level, task, offsets, after, first, inputs,
                                                        changes);
    else
        interpolate<C, TOGETHER, TIMES, GRADIENT, false>(level, task, offsets, after, first, inputs,
                                                         changes);
}

// All levels of a tile.
template <bool TIMES, bool GRADIENT>
void encode(const Task& task, const double* points, Workspace& work) {
    for (std::int64_t l = 0; l < task.level_count; ++l) {
        const Level& level = task.levels[l];
        double* offsets = work.offsets.data() + l * TILE;
        locate(level, task.sizes, points, offsets, work.after.data() + l * AXES * TILE);
        if (level.numbers * 4 >= FAR_BYTES && !level.held.words) fetch(level, offsets, TIMES);
    }
    for (std::int64_t l = 0; l < task.level_count; ++l) {
        const Level& level = task.levels[l];
        const double* offsets = work.offsets.data() + l * TILE;
        const float* after = work.after.data() + l * AXES * TILE;
        float* inputs = work.inputs.data() + l * task.embedding * TILE;
        float* changes = work.changes.data() + l * task.embedding * TILE;
        if (task.embedding == 2) {
            interpolate_any<2, true, TIMES, GRADIENT>(level, task, offsets, after, 0, inputs,
                                                      changes);
        } else if (task.embedding == 4) {
            interpolate_any<4, true, TIMES, GRADIENT>(level, task, offsets, after, 0, inputs,
                                                      changes);
        } else {
            for (std::int64_t e = 0; e < task.embedding; ++e)
                interpolate_any<1, false, TIMES, GRADIENT>(level, task, offsets, after, e, inputs,
                                                           changes);
        }
    }
}

// ROWS rows of a product for all points of a tile: to[r] = biases[r * row] + sum over k of
// weights[r * row + k * inner] from[k]. `biases` may be null for 0. RELU puts 0 for what is below
// it. A weight is a number and no vector here: GCC makes a vector of one number well where the
// expression stands in the kernel, and number by number where a function returns it.
template <class P, int ROWS, bool RELU>
FHASH_INLINE void rows(const float* weights, std::int64_t row, std::int64_t inner,
                       const float* biases, std::int64_t count, const float* from, float* to) {
    typedef typename P::F F;
    constexpr int VECTORS = P::REGISTERS > 16 ? 4 : 2;
    static_assert(TILE % (VECTORS * P::N) == 0, "a tile is whole blocks of vectors");
    for (int first = 0; first < TILE; first += VECTORS * P::N) {
        F sums[ROWS][VECTORS] = {};
        for (std::int64_t k = 0; k < count; ++k) {
            F x[VECTORS];
            FHASH_UNROLLED
            for (int v = 0; v < VECTORS; ++v) x[v] = loaded<P>(from + k * TILE + first + v * P::N);
            FHASH_UNROLLED
            for (int r = 0; r < ROWS; ++r) {
                const float weight = weights[r * row + k * inner];
                FHASH_UNROLLED
                for (int v = 0; v < VECTORS; ++v) sums[r][v] = sums[r][v] + weight * x[v];
            }
        }
        FHASH_UNROLLED
        for (int r = 0; r < ROWS; ++r) {
            const float bias = biases ? biases[r * row] : 0.0f;
            FHASH_UNROLLED
            for (int v = 0; v < VECTORS; ++v) {
                const F sum = sums[r][v] + bias;
                // What is not a number stays.
                store<P>(to + r * TILE + first + v * P::N, RELU ? (sum < 0.0f ? F{} : sum) : sum);
            }
        }
    }
}

template <class P, bool RELU>
void product(const float* weights, std::int64_t outputs, std::int64_t row,
                          std::int64_t inner, const float* biases, std::int64_t count,
                          const float* from, float* to) {
    std::int64_t r = 0;
    for (; r + 4 <= outputs; r += 4)
        rows<P, 4, RELU>(weights + r * row, row, inner, biases ? biases + r * row : biases, count,
                         from, to + r * TILE);
    for (; r < outputs; ++r)
        rows<P, 1, RELU>(weights + r * row, row, inner, biases ? biases + r * row : biases, count,
                         from, to + r * TILE);
}

// Outputs of all layers for the inputs of a tile; those of the last one are the values.
template <class P> const float* run_layers(const Task& task, Workspace& work) {
    const float* from = work.inputs.data();
    for (std::int64_t n = 0; n < task.layer_count; ++n) {
        const Layer& layer = task.layers[n];
        float* to = work.hidden.data() + n * task.width * TILE;
        const std::int64_t row = layer.inputs + 1;
        const float* bias = layer.matrix + layer.inputs;
        if (n + 1 < task.layer_count)
            product<P, true>(layer.matrix, layer.outputs, row, 1, bias, layer.inputs, from, to);
        else
            product<P, false>(layer.matrix, layer.outputs, row, 1, bias, layer.inputs, from, to);
        from = to;
    }
    return from;
}

// Derivatives (inputs, TILE) of the values by the inputs, backwards through the layers. On a kink
// the derivative is that of the flat side.
template <class P> const float* back(const Task& task, Workspace& work) {
    const std::int64_t half = (task.width + task.inputs) * TILE;
    float* slope = work.slopes.data();
    float* next = slope + half;
    const Layer& last = task.layers[task.layer_count - 1];
    for (std::int64_t k = 0; k < last.inputs; ++k)
        for (int i = 0; i < TILE; ++i) slope[k * TILE + i] = last.matrix[k];
    for (std::int64_t n = task.layer_count - 2; n >= 0; --n) {
        const Layer& layer = task.layers[n];
        const float* hidden = work.hidden.data() + n * task.width * TILE;
        for (std::int64_t i = 0; i < layer.outputs * TILE; ++i)
            slope[i] = hidden[i] > 0 ? slope[i] : 0.0f;
        product<P, false>(layer.matrix, layer.inputs, 1, layer.inputs + 1, nullptr, layer.outputs,
                          slope, next);
        float* spare = slope;
        slope = next, next = spare;
    }
    return slope;
}

// See points.hpp.
template <class P>
std::int64_t points_kernel(const Task& task, const Points& points, std::int64_t count,
                                        float* values, float* slopes, float* by_inputs) {
    Workspace work(task);
    double tile[AXES * TILE];
    float sums[AXES * TILE];
    for (std::int64_t begin = 0; begin < count; begin += TILE) {
        const int filled = count - begin < TILE ? (int)(count - begin) : TILE;
        for (int a = 0; a < AXES; ++a)
            for (int i = 0; i < TILE; ++i) {
                const std::int64_t point = begin + (i < filled ? i : 0);
                tile[a * TILE + i] = points.columns[a][point * points.steps[a]];
            }
        if (task.times && slopes)
            encode<true, true>(task, tile, work);
        else if (task.times)
            encode<true, false>(task, tile, work);
        else if (slopes)
            encode<false, true>(task, tile, work);
        else
            encode<false, false>(task, tile, work);
        std::memcpy(values + begin, run_layers<P>(task, work), filled * sizeof(float));
        if (!slopes && !by_inputs) continue;
        const float* by_input = back<P>(task, work);
        for (std::int64_t k = 0; by_inputs && k < task.inputs; ++k)
            std::memcpy(by_inputs + k * count + begin, by_input + k * TILE,
                        filled * sizeof(float));
        if (!slopes) continue;
        for (int a = 0; a < AXES; ++a) {
            float* FHASH_RESTRICT sum = sums + a * TILE;
            for (int i = 0; i < TILE; ++i) sum[i] = 0;
            if (a == 0 && !task.times) continue;
            const float* change = work.changes.data() + a * task.inputs * TILE;
            for (std::int64_t k = 0; k < task.inputs; ++k)
                for (int i = 0; i < TILE; ++i)
                    sum[i] = sum[i] + by_input[k * TILE + i] * change[k * TILE + i];
        }
        for (int i = 0; i < filled; ++i)
            for (int a = 0; a < AXES; ++a) slopes[(begin + i) * AXES + a] = sums[a * TILE + i];
    }
    return 0;
}

// The numbers of a part at one time, between its two time nodes around it: those that `interpolate`
// makes of the corners there, bit by bit.
inline std::int64_t still_kernel(const Level& level, const std::int64_t* sizes, double time,
                                       std::int64_t count, float* still) {
    double points[AXES * TILE], offsets[TILE];
    float after[AXES * TILE];
    for (int i = 0; i < AXES * TILE; ++i) points[i] = 0;
    for (int i = 0; i < TILE; ++i) points[i] = time;
    Level along_time = level;
    for (int a = 1; a < AXES; ++a) along_time.axes[a].first = 0;
    locate(along_time, sizes, points, offsets, after);
    const float* FHASH_RESTRICT from = level.table + (std::int64_t)offsets[0];
    const float* FHASH_RESTRICT next = from + level.axes[0].stride;
    const float weight = after[0];
    for (std::int64_t i = 0; i < count; ++i) still[i] = between(from[i], next[i], weight);
    return 0;
}

}  // namespace
}  // namespace fhash_points
#endif  // FHASH_VECTORS
