// The kernels of the brick engine for one path (FHASH_TARGET): training and
// evaluation of the paper's network, a brick at a time. Upsampling, MLP forward and backward, the
// transpose, and Adam of the finest embeddings follow each other while a brick lies in the cache.
//
// A step has three parts, of which each thread does its own share: catching up the blocks of the
// largest coarse table that the step touches, the bricks, and Adam of the flat numbers. Threads add
// gradients to memory of their own, which is summed in their order: the same bricks, path and
// number of threads give the same bits.
#include "adam.hpp"
#include "mlp.hpp"
#include "upsample.hpp"

#if defined(FHASH_VECTORS)

namespace {

// Inputs of the MLP.
inline std::int64_t input_rows(const FhashBricks& b) { return b.own + b.levels * b.embedding; }

// Memory of a thread.
struct Work {
    std::int64_t row;      // numbers from one row of inputs to the next
    float* inputs;         // (inputs + 1, row): at all vertices; the last row is 1
    float* picked;         // the same of the samples alone, where not all vertices are
    Planes planes;
    float* mlp;
    std::int32_t* runs;    // (vertices + 1,): first vertex and end of each run of samples
    std::int64_t* rows;    // places of the rows of corners, level by level
    std::int64_t size;     // numbers of all memory

    // Lay out memory that begins at `memory`; null for the size alone.
    template <class P> static Work of(const FhashBricks& b, float* memory) {
        Work w = {};
        const auto take = [&](std::int64_t numbers) {
            float* const taken = memory ? memory + w.size : nullptr;
            w.size += (numbers + FHASH_PAD + 15) / 16 * 16;
            return taken;
        };
        const std::int64_t count = input_rows(b) + 1;
        const std::int64_t plane = b.shape[1] * b.shape[2];
        std::int64_t nx = 0, lines = 0, planes = 0, rows = 0;
        for (std::int64_t l = 0; l < b.levels; l++) {
            const std::int64_t* corners = b.level[l].corners;
            nx = larger(nx, corners[3]);
            lines = larger(lines, corners[1] * corners[2]);
            planes = larger(planes, corners[1]);
            rows += corners[0] * corners[1] * corners[2];
        }
        w.row = row_of(b);
        w.inputs = take(count * w.row);
        w.picked = take(count * w.row);
        w.planes.corners = take(b.embedding * (nx + FHASH_REACH));
        w.planes.x = take(b.embedding * lines * groups_of(b) * FHASH_GROUP);
        w.planes.y = take(b.embedding * planes * plane);
        w.mlp = take(Mlp::memory(count - 1, b.hidden, b.width, P::N, Tiles<P>::CHUNK));
        w.runs = reinterpret_cast<std::int32_t*>(take(vertices_of(b) + 1));
        w.rows = reinterpret_cast<std::int64_t*>(take(2 * rows));
        return w;
    }
};

// What is the same for all bricks of a thread.
template <class P> struct Thread {
    const FhashBricks& b;
    Work w;
    Mlp mlp;
    std::int64_t inputs, vertices;
};

template <class P>
Thread<P> thread_of(const FhashBricks& b, std::int64_t thread, const float* flat) {
    const std::int64_t inputs = input_rows(b);
    Thread<P> t{b, Work::of<P>(b, b.work + thread * b.work_size),
                Mlp{inputs, b.hidden, b.width, {}, {}, {}, {}, nullptr}, inputs, vertices_of(b)};
    t.mlp.template lay_out<P>(flat + b.coarse, t.w.mlp);
    t.mlp.template begin<P>();
    float* const both[] = {t.w.inputs, t.w.picked};
    for (float* rows : both)
        for (std::int64_t i = 0; i < t.w.row; i++) rows[inputs * t.w.row + i] = 1;
    return t;
}

// Write where the runs of a brick's samples begin and end; return the number of runs.
template <class P> std::int64_t runs_of(const Thread<P>& t, std::int64_t brick) {
    const std::uint8_t* bits = t.b.mask + brick * t.b.mask_bytes;
    std::int64_t edges = 0;
    std::uint64_t last = 0;  // whether the vertex before is a sample
    for (std::int64_t first = 0; first < t.b.mask_bytes; first += 8) {
        std::uint64_t word = 0;
        const std::int64_t bytes = smaller(8, t.b.mask_bytes - first);
        for (std::int64_t i = 0; i < bytes; i++)
            word |= (std::uint64_t)bits[first + i] << (56 - 8 * i);
        std::uint64_t changes = word ^ (word >> 1 | last << 63);
        last = word & 1;
        while (changes) {
            const int place = __builtin_clzll(changes);
            t.w.runs[edges++] = (std::int32_t)(8 * first + place);
            changes &= ~(1ull << 63 >> place);
        }
    }
    if (edges % 2) t.w.runs[edges++] = (std::int32_t)t.vertices;
    return edges / 2;
}

// Write zeros behind some numbers to the end of a vector.
template <class P> void fill_vector(float* row, std::int64_t count) {
    for (; count % P::N; count++) row[count] = 0;
}

// Copy runs of the numbers of a row side by side, and zeros behind them to the end of a vector.
template <class P> void pick(const Thread<P>& t, std::int64_t runs, const float* from,
                                          float* to) {
    std::int64_t at = 0;
    for (std::int64_t n = 0; n < runs; n++) {
        const std::int64_t first = t.w.runs[2 * n], length = t.w.runs[2 * n + 1] - first;
        for (std::int64_t i = 0; i < length; i += P::N)
            store<P>(to + at + i, loaded<P>(from + first + i));
        at += length;
    }
    fill_vector<P>(to, at);
}

// Copy them back, with zeros between them. What a vector writes too much is written again.
template <class P> void put_back(const Thread<P>& t, std::int64_t runs,
                                              const float* from, float* to) {
    const typename P::F zero = {};
    std::int64_t at = 0, end = 0;
    for (std::int64_t n = 0; n <= runs; n++) {
        const std::int64_t first = n < runs ? t.w.runs[2 * n] : t.vertices;
        for (std::int64_t i = end; i < first; i += P::N) store<P>(to + i, zero);
        end = n < runs ? t.w.runs[2 * n + 1] : first;
        for (std::int64_t i = first; i < end; i += P::N)
            store<P>(to + i, loaded<P>(from + at + i - first));
        at += end - first;
    }
}

// Where the finest embeddings of a brick's samples begin, for number e of an embedding.
inline std::int64_t fine_at(const FhashBricks& b, std::int64_t brick, std::int64_t e) {
    return e * b.samples + b.offsets[brick];
}

// Write the inputs at the samples of a brick, and return their rows: those of all vertices where
// all are samples. `flat` holds the coarse tables, caught up.
template <class P>
float* inputs_of(const Thread<P>& t, std::int64_t brick, const Gap& gap,
                              const float* flat, std::int64_t samples, std::int64_t* run_count) {
    const FhashBricks& b = t.b;
    const std::int64_t row = t.w.row;
    const bool whole = samples == t.vertices;
    float* const rows = whole ? t.w.inputs : t.w.picked;
    for (std::int64_t e = 0; e < b.own; e++) {
        const std::int64_t at = fine_at(b, brick, e);
        float* const to = rows + e * row;
        if (gap.factor != 0)
            catch_up<P>(to, b.fine + at, b.fine_mean + at, b.fine_square + at, samples, gap);
        else
            std::memcpy(to, b.fine + at, samples * sizeof(float));
        fill_vector<P>(to, samples);
    }
    const std::int32_t* place = b.bricks + 4 * brick;
    std::int64_t* corner_rows = t.w.rows;
    for (std::int64_t l = 0; l < b.levels; l++) {
        const FhashLevel& level = b.level[l];
        std::int64_t* row_of_corners = corner_rows;
        for_rows(b, level, place, [&](std::int64_t at) { *row_of_corners++ = at; });
        interpolate<P>(Place(b, level, place, corner_rows), flat, t.w.planes,
                       t.w.inputs + (b.own + l * b.embedding) * row, row);
        corner_rows += level.corners[0] * level.corners[1] * level.corners[2];
    }
    if (whole) return rows;
    *run_count = runs_of(t, brick);
    for (std::int64_t n = b.own; n < t.inputs; n++)
        pick(t, *run_count, t.w.inputs + n * row, rows + n * row);
    return rows;
}

// Chunks of nearly equal length: some vectors of samples each.
template <class P, class Work> void in_chunks(std::int64_t samples, Work work) {
    const std::int64_t vectors = (samples + P::N - 1) / P::N;
    const std::int64_t chunks = (vectors + Tiles<P>::CHUNK - 1) / Tiles<P>::CHUNK;
    for (std::int64_t c = 0; c < chunks; c++) {
        const std::int64_t first = vectors * c / chunks, stop = vectors * (c + 1) / chunks;
        work(first * P::N, stop - first);
    }
}

// Replace the inputs of samples by the gradients by them; return the sum of squared errors.
template <class P>
double backpropagate(Thread<P>& t, float* rows, const float* target,
                                  std::int64_t samples) {
    double error = 0;
    const float scale = (float)t.b.scale;
    in_chunks<P>(samples, [&](std::int64_t at, std::int64_t vectors) FHASH_LAMBDA {
        t.mlp.template forward<P>(rows + at, t.w.row, vectors, true);
        typename P::F squares = {};
        const std::int64_t left = smaller(samples - at, vectors * P::N);
        float* value = t.mlp.value;
        std::int64_t i = 0;
        for (; i + P::N <= left; i += P::N) {
            const typename P::F d = loaded<P>(value + i) - loaded<P>(target + at + i);
            squares += d * d;
            store<P>(value + i, d * all<P>(scale));
        }
        for (; i < vectors * P::N; i++) {
            const float d = i < left ? value[i] - target[at + i] : 0;
            error += (double)d * d;
            value[i] = d * scale;
        }
        for (int n = 0; n < P::N; n++) error += squares[n];
        t.mlp.template backward<P>(rows + at, t.w.row, vectors);
    });
    return error;
}

// The share of a thread in the bricks of a training step.
template <class P> void train(const FhashBricks& b, std::int64_t thread) {
    Thread<P> t = thread_of<P>(b, thread, b.flat);
    const Part part(b.count, thread, b.threads);
    const Step step(b);
    float* const gradient = b.gradient + thread * b.numbers;
    double error = 0;
    for (std::int64_t i = part.first; i < part.stop; i++) {
        const std::int64_t brick = b.chosen[i], row = t.w.row;
        const std::int64_t samples = b.offsets[brick + 1] - b.offsets[brick];
        const Gap gap(b.gaps, b.visited[brick], b.step - 1);
        std::int64_t runs = 0;
        float* rows = inputs_of(t, brick, gap, b.flat, samples, &runs);
        if (gap.factor != 0)
            for (std::int64_t e = 0; e < b.own; e++)
                std::memcpy(b.fine + fine_at(b, brick, e), rows + e * row,
                            samples * sizeof(float));
        error += backpropagate(t, rows, b.values + b.offsets[brick], samples);
        if (rows == t.w.picked)
            for (std::int64_t k = b.own; k < t.inputs; k++)
                put_back(t, runs, t.w.picked + k * row, t.w.inputs + k * row);
        const std::int64_t* level_rows = t.w.rows;
        for (std::int64_t l = 0; l < b.levels; l++) {
            const FhashLevel& level = b.level[l];
            const float* const by_level = t.w.inputs + (b.own + l * b.embedding) * row;
            add_transposed<P>(Place(b, level, b.bricks + 4 * brick, level_rows), by_level, row,
                              t.w.planes, gradient);
            level_rows += level.corners[0] * level.corners[1] * level.corners[2];
        }
        for (std::int64_t e = 0; e < b.own; e++) {
            const std::int64_t at = fine_at(b, brick, e);
            adam<P>(b.fine + at, b.fine_mean + at, b.fine_square + at, rows + e * row, samples,
                    gap, step);
        }
        b.visited[brick] = b.step;
    }
    t.mlp.template gradient<P>(gradient + b.coarse);
    b.error[thread] = error;
}

// The share of a thread in the bricks to be evaluated.
template <class P> void infer(const FhashBricks& b, std::int64_t thread) {
    Thread<P> t = thread_of<P>(b, thread, b.current);
    const Part part(b.count, thread, b.threads);
    for (std::int64_t i = part.first; i < part.stop; i++) {
        const std::int64_t brick = b.chosen[i];
        const std::int64_t samples = b.offsets[brick + 1] - b.offsets[brick];
        const Gap gap(b.gaps, b.visited[brick], b.step);
        std::int64_t runs = 0;
        float* rows = inputs_of(t, brick, gap, b.current, samples, &runs);
        in_chunks<P>(samples, [&](std::int64_t at, std::int64_t vectors) FHASH_LAMBDA {
            t.mlp.template forward<P>(rows + at, t.w.row, vectors, false);
            std::memcpy(b.out + b.places[i] + at, t.mlp.value,
                        smaller(samples - at, vectors * P::N) * sizeof(float));
        });
    }
}

// The numbers of a block.
inline std::int64_t length_of(const FhashBricks& b, std::int64_t block) {
    return smaller(FHASH_BLOCK, b.lazy - block * FHASH_BLOCK);
}

// The share of a thread in the touched blocks, which catch up to the step before.
template <class P>
void catch_up_blocks(const FhashBricks& b, std::int64_t thread) {
    const Part part(b.touches, thread, b.threads);
    for (std::int64_t i = part.first; i < part.stop; i++) {
        const std::int64_t block = b.touched[i], at = block * FHASH_BLOCK;
        const Gap gap(b.gaps, b.blocks[block], b.step - 1);
        if (gap.factor != 0)
            catch_up<P>(b.flat + at, b.flat + at, b.flat_mean + at, b.flat_square + at,
                        length_of(b, block), gap);
    }
}

// Do a step on some flat numbers, whose gradients are summed over the threads.
template <class P, int MOST>
void move(const FhashBricks& b, std::int64_t at, std::int64_t count, const Gap& gap,
                       const Step& step) {
    float sum[MOST] = {};
    for (std::int64_t t = 0; t < b.threads; t++) {
        float* const from = b.gradient + t * b.numbers + at;
        for (std::int64_t i = 0; i < count; i++) sum[i] += from[i];
        std::memset(from, 0, count * sizeof(float));
    }
    adam<P>(b.flat + at, b.flat_mean + at, b.flat_square + at, sum, count, gap, step);
}

// The share of a thread in Adam of the flat numbers: the touched blocks, and all behind the blocks.
template <class P> void adam_of_flat(const FhashBricks& b, std::int64_t thread) {
    const Step step(b);
    const Part part(b.touches, thread, b.threads);
    for (std::int64_t i = part.first; i < part.stop; i++) {
        const std::int64_t block = b.touched[i], length = length_of(b, block);
        const Gap gap(b.gaps, b.blocks[block], b.step - 1);
        if (length == FHASH_BLOCK)
            move<P, FHASH_BLOCK>(b, block * FHASH_BLOCK, FHASH_BLOCK, gap, step);
        else
            move<P, FHASH_BLOCK>(b, block * FHASH_BLOCK, length, gap, step);
        b.blocks[block] = b.step;
    }
    constexpr int MOST = 1024;
    const std::int64_t rest = b.numbers - b.lazy;
    const Part dense((rest + MOST - 1) / MOST, thread, b.threads);
    const Gap none(b.gaps, 0, 0);
    for (std::int64_t i = dense.first; i < dense.stop; i++)
        move<P, MOST>(b, b.lazy + i * MOST, smaller(MOST, rest - i * MOST), none,
                      step);
}

// The share of a thread in a part of a step.
template <class P>
std::int64_t run(const FhashBricks& b, std::int64_t part, std::int64_t thread) {
    switch (part) {
        case CATCH_UP: catch_up_blocks<P>(b, thread); return 0;
        case TRAIN: train<P>(b, thread); return 0;
        case ADAM: adam_of_flat<P>(b, thread); return 0;
        case INFER: infer<P>(b, thread); return 0;
    }
    return -1;
}

}  // namespace

#endif  // FHASH_VECTORS

// What a source file for a path defines.
#define FHASH_DEFINE_KERNELS(NAME, PATH)                                                       \
    std::int64_t fhash_bricks_run_##NAME(const FhashBricks& b, std::int64_t part,              \
                                         std::int64_t thread) {                                \
        return run<PATH>(b, part, thread);                                                     \
    }                                                                                          \
    std::int64_t fhash_bricks_work_##NAME(const FhashBricks& b) {                              \
        return Work::of<PATH>(b, nullptr).size;                                                \
    } \
    namespace fhash_points {                                                                   \
    std::int64_t run_##NAME(const Task& task, const Points& points, std::int64_t count,        \
                            float* values, float* slopes, float* by_inputs) {                  \
        return points_kernel<PATH>(task, points, count, values, slopes, by_inputs);            \
    }                                                                                          \
    std::int64_t still_##NAME(const Level& level, const std::int64_t* sizes, double time,      \
                              std::int64_t count, float* still) {                              \
        return still_kernel(level, sizes, time, count, still);                                 \
    }                                                                                          \
    }
