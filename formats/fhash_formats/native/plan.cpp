// Bands and norms of a transform (FORMAT.md, Decoding), and plans of its inverse.
#include "plan.hpp"

#include <algorithm>
#include <cmath>
#include <map>

#include "kernels.hpp"

namespace fhash {
namespace {

using Key = std::array<int, 4>;  // of a band: its number along t and z, its levels along y and x
constexpr int LEVELS_APART = 4;  // finest levels that have kinds of their own
constexpr int KLT_PLANE = 13;    // kind of a plane that a basis spans

// A band along an axis: 0 for the low band or the whole axis, 1 for the finest high band, negative
// for the low half of a coupled level.
struct Span {
    int level;
    int64_t start, stop;
};
using Spans = std::vector<Span>;

Spans spans_of(const AxisTransform& axis, int64_t length) {
    Spans spans;
    const auto add = [&](int level, int64_t start, int64_t stop) {
        if (start < stop) spans.push_back({level, start, stop});
    };
    if (axis.basis) {
        add(0, 0, axis.basis->rank);
        return spans;
    }
    const auto lengths = band_lengths(length, axis.depth);
    add(0, 0, lengths.back());
    for (int level = axis.depth; level > 0; level--)
        add(level, lengths[(size_t)level], lengths[(size_t)level - 1]);
    return spans;
}

const Span* at_level(const Spans& spans, int level) {
    for (const Span& span : spans)
        if (span.level == level) return &span;
    return nullptr;
}

// The end of the low half of a level: where its high band begins, or where the axis ends there.
int64_t low_end(const Spans& spans, int level) {
    if (const Span* span = at_level(spans, level)) return span->start;
    int64_t end = 0;
    for (const Span& span : spans)
        if (span.level >= level || span.level == 0) end = std::max(end, span.stop);
    return end;
}

using Plane = std::vector<std::pair<Span, Span>>;

// The bands (y, x) of a coupled plane: low-low, then low-high, high-low and high-high of each level
// from the coarsest on.
std::vector<Plane> coupled_planes(const Spans& y, const Spans& x) {
    std::vector<Plane> planes = {{{*at_level(y, 0), *at_level(x, 0)}}};
    int most = 0;
    for (const Spans* spans : {&y, &x})
        for (const Span& span : *spans) most = std::max(most, span.level);
    for (int level = most; level > 0; level--) {
        const Span low_y = {-level, 0, low_end(y, level)}, low_x = {-level, 0, low_end(x, level)};
        const Span *high_y = at_level(y, level), *high_x = at_level(x, level);
        Plane plane;
        if (high_x) plane.push_back({low_y, *high_x});
        if (high_y) plane.push_back({*high_y, low_x});
        if (high_x && high_y) plane.push_back({*high_y, *high_x});
        planes.push_back(plane);
    }
    return planes;
}

// The table of bands while it grows.
struct Bands {
    const Spans &y, &x;
    bool coupled, klt;
    Table table;
    std::map<Key, int> rows;

    // 0 for low-low, 1 to 12 by level and orientation, 13 where a basis spans the plane.
    int plane_kind(const Key& key) const {
        if (klt) return KLT_PLANE;
        const int level = std::max(key[2], key[3]);
        if (level <= 0) return 0;
        const int orientation = key[2] > 0 && key[3] > 0 ? 2 : key[2] > 0 ? 1 : 0;
        return 1 + 3 * (std::min(level, LEVELS_APART) - 1) + orientation;
    }
    bool known(const Key& key) const { return rows.count(key) != 0; }
    // A reference to an earlier band, an index along an axis halved so often; or to none.
    void refer(const Key& key, std::array<int, 4> halvings) {
        const auto found = rows.find(key);
        if (found == rows.end()) return refer_to_none();
        table.push_back(found->second);
        table.insert(table.end(), halvings.begin(), halvings.end());
    }
    void refer_to_none() { table.insert(table.end(), {-1, 0, 0, 0, 0}); }

    // The band of the same orientation one level up, or low-low where there is none.
    void refer_to_coupled_parent(const Key& key) {
        const int level = std::max(key[2], key[3]);
        if (level <= 0) return refer_to_none();
        const int up = level + 1;
        const Key coarser = {key[0], key[1], key[2] > 0 ? up : -up, key[3] > 0 ? up : -up};
        if (known(coarser)) return refer(coarser, {0, 0, 1, 1});
        refer({key[0], key[1], 0, 0}, {0, 0, 0, 0});
    }
    // The next coarser band along y, or along x where the band is the coarsest along y.
    void refer_to_parent(const Key& key) {
        const auto number = [](const Spans& spans, int level) {
            int i = 0;
            while (spans[(size_t)i].level != level) i++;
            return i;
        };
        const int along_y = number(y, key[2]), along_x = number(x, key[3]);
        if (along_y) {
            const Key coarser = {key[0], key[1], y[(size_t)along_y - 1].level, key[3]};
            return refer(coarser, {0, 0, along_y > 1, 0});
        }
        if (along_x) {
            const Key coarser = {key[0], key[1], key[2], x[(size_t)along_x - 1].level};
            return refer(coarser, {0, 0, 0, along_x > 1});
        }
        refer_to_none();
    }
    // High-low refers to low-high, and high-high to high-low.
    void refer_to_sibling(const Key& key) {
        if (!coupled || std::max(key[2], key[3]) <= 0 || key[2] < 0) return refer_to_none();
        if (key[3] > 0) return refer({key[0], key[1], key[2], -key[2]}, {0, 0, 0, 0});
        refer({key[0], key[1], key[3], -key[3]}, {0, 0, 0, 0});
    }

    void add(const Key& key, const std::array<Span, 4>& spans) {
        for (const Span& span : spans) table.push_back((int32_t)span.start);
        for (const Span& span : spans) table.push_back((int32_t)span.stop);
        table.push_back(4 * plane_kind(key) + 2 * (spans[0].level > 0) + (spans[1].level > 0));
        coupled ? refer_to_coupled_parent(key) : refer_to_parent(key);
        refer({key[0] - 1, key[1], key[2], key[3]}, {key[0] > 1, 0, 0, 0});
        refer({key[0], key[1] - 1, key[2], key[3]}, {0, key[1] > 1, 0, 0});
        refer_to_sibling(key);
        rows[key] = (int)rows.size();
    }
};

// Norms of the columns, with sums from the first row on.
std::vector<double> column_norms(const double* matrix, int64_t rows, int64_t columns) {
    std::vector<double> total((size_t)columns, 0.0);
    for (int64_t r = 0; r < rows; r++)
        for (int64_t c = 0; c < columns; c++) {
            const double value = matrix[r * columns + c];
            total[(size_t)c] += value * value;
        }
    for (double& sum : total) sum = std::sqrt(sum);
    return total;
}

// The columns that the inverse of a wavelet makes of columns of bands (n, columns).
std::vector<double> inverse_columns(const std::vector<double>& bands, int64_t n, int64_t columns,
                                    int kind, int depth) {
    std::vector<double> values(bands.size()), ones((size_t)std::max(n, columns), 1.0);
    const int64_t shape[4] = {n, 1, 1, columns}, kinds[4] = {kind, 0, 0, 0};
    const int64_t depths[4] = {depth, 0, 0, 0}, ranks[4] = {0, 0, 0, 0};
    const double* matrices[4] = {nullptr, nullptr, nullptr, nullptr};
    // Where memory runs out, the zeros make norms of 0: the caller's run has none either.
    fhash_transform_inverse_f64(bands.data(), values.data(), shape, kinds, depths, ranks, matrices,
                                ones.data(), ones.data(), 1);
    return values;
}

// Norms of the synthesis vectors of a wavelet on an axis.
std::vector<double> fresh_norms(int kind, int depth, int64_t n) {
    constexpr int64_t MAX_EXACT = 512;  // longest axis whose norms are computed at each position
    if (n <= MAX_EXACT) {
        std::vector<double> unit((size_t)(n * n), 0.0);
        for (int64_t i = 0; i < n; i++) unit[(size_t)(i * n + i)] = 1.0;
        return column_norms(inverse_columns(unit, n, n, kind, depth).data(), n, n);
    }
    std::vector<double> norms((size_t)n);
    const auto ends = band_lengths(n, depth);
    for (int level = 1; level <= depth; level++) {
        // With 32 entries in the band, the vector of a middle entry does not reach the ends.
        const auto inner = band_lengths((int64_t)32 << level, level);
        std::vector<double> vectors((size_t)(2 * inner[0]), 0.0);
        vectors[2 * 16] = vectors[(size_t)(2 * (inner[(size_t)level] + 16) + 1)] = 1.0;
        const auto values = inverse_columns(vectors, inner[0], 2, kind, level);
        const auto two = column_norms(values.data(), inner[0], 2);
        std::fill_n(norms.begin(), ends[(size_t)level], two[0]);
        std::fill(norms.begin() + ends[(size_t)level], norms.begin() + ends[(size_t)level - 1],
                  two[1]);
    }
    return norms;
}

// The same, which the context keeps.
const std::vector<double>& wavelet_norms(fhash_context& context, int kind, int depth, int64_t n,
                                         std::shared_ptr<const std::vector<double>>& kept) {
    constexpr size_t REMEMBERED = 256;
    const std::array<int64_t, 3> key = {kind, depth, n};
    {
        const Guard guard(context.lock);
        const auto found = context.norms.find(key);
        if (found != context.norms.end()) return *(kept = found->second);
    }
    kept = std::make_shared<const std::vector<double>>(fresh_norms(kind, depth, n));
    const Guard guard(context.lock);
    if (context.norms.size() == REMEMBERED) context.norms.clear();
    context.norms[key] = kept;
    return *kept;
}

std::vector<double> axis_norms(fhash_context& context, const AxisTransform& axis, int64_t n) {
    std::shared_ptr<const std::vector<double>> kept;
    if (axis.wavelet()) return wavelet_norms(context, axis.kind, axis.depth, n, kept);
    std::vector<double> norms((size_t)n, 1.0);
    if (axis.basis && axis.basis->rank) {
        const Basis& basis = *axis.basis;
        const std::vector<double> wide(basis.synthesis.begin(), basis.synthesis.end());
        const auto columns = column_norms(wide.data(), basis.n, basis.rank);
        std::copy(columns.begin(), columns.end(), norms.begin());
    }
    return norms;
}

std::vector<double> outer(const std::vector<double>& a, const std::vector<double>& b) {
    std::vector<double> product;
    product.reserve(a.size() * b.size());
    for (const double one : a)
        for (const double other : b) product.push_back(one * other);
    return product;
}

std::vector<double> plane_norms(fhash_context& context, const AxisTransform& y,
                                const AxisTransform& x, int64_t rows, int64_t columns) {
    if (!is_coupled(y, x))
        return outer(axis_norms(context, y, rows), axis_norms(context, x, columns));
    const auto ys = band_lengths(rows, y.depth), xs = band_lengths(columns, x.depth);
    std::vector<double> norms((size_t)(rows * columns));
    for (int level = 1; level <= y.depth; level++) {  // each overwrites the low-low quarter before
        std::shared_ptr<const std::vector<double>> kept[2];
        const auto& along_y = wavelet_norms(context, y.kind, level, rows, kept[0]);
        const auto& along_x = wavelet_norms(context, y.kind, level, columns, kept[1]);
        for (int64_t i = 0; i < ys[(size_t)level - 1]; i++)
            for (int64_t k = 0; k < xs[(size_t)level - 1]; k++)
                norms[(size_t)(i * columns + k)] = along_y[(size_t)i] * along_x[(size_t)k];
    }
    return norms;
}

// The value of a constant 1 in the low band after some levels; other than 1 for 9/7 only.
double gain_of(int kind, int64_t n, int levels) {
    if (kind != DAUBECHIES_KIND) return 1.0;
    const double steps[4] = {-1.586134342059924, -0.052980118572961, 0.882911075530934,
                             0.443506852043971};
    double even = 1.0, odd = 1.0, gain = 1.0;
    for (int i = 0; i < 4; i += 2) {
        odd += steps[i] * (even + even);
        even += steps[i + 1] * (odd + odd);
    }
    const auto lengths = band_lengths(n, levels);
    for (int i = 0; i < levels; i++) gain *= lengths[(size_t)i] > 1 ? even : 1.0;
    return gain;
}

// (S^T S)^-1 S^T of a basis S, (rank, n), which gives the least-squares coefficients of a column;
// by elimination in a fixed order. False where S is nearly singular.
bool analysis_of(const Basis& basis, std::vector<double>& result) {
    const int64_t n = basis.n, rank = basis.rank;
    const auto vector = [&](int64_t i, int64_t r) {
        return (double)basis.synthesis[(size_t)(i * rank + r)];
    };
    std::vector<double> gram((size_t)(rank * rank), 0.0);
    for (int64_t i = 0; i < n; i++)
        for (int64_t r = 0; r < rank; r++)
            for (int64_t c = 0; c < rank; c++)
                gram[(size_t)(r * rank + c)] += vector(i, r) * vector(i, c);
    result.resize((size_t)(rank * n));
    for (int64_t r = 0; r < rank; r++)
        for (int64_t i = 0; i < n; i++) result[(size_t)(r * n + i)] = vector(i, r);
    std::vector<double> left = gram;
    const auto subtract = [](double* row, const double* other, double ratio, int64_t count) {
        for (int64_t i = 0; i < count; i++) row[i] -= ratio * other[i];
    };
    for (int64_t k = 0; k < rank; k++) {
        const double pivot = left[(size_t)(k * rank + k)];
        if (!(pivot > 1e-9 * gram[(size_t)(k * rank + k)])) return false;
        for (int64_t r = k + 1; r < rank; r++) {
            const double ratio = left[(size_t)(r * rank + k)] / pivot;
            subtract(&left[(size_t)(r * rank)], &left[(size_t)(k * rank)], ratio, rank);
            subtract(&result[(size_t)(r * n)], &result[(size_t)(k * n)], ratio, n);
        }
    }
    for (int64_t k = rank; k-- > 0;) {
        for (int64_t i = 0; i < n; i++)
            result[(size_t)(k * n + i)] /= left[(size_t)(k * rank + k)];
        for (int64_t r = 0; r < k; r++)
            subtract(&result[(size_t)(r * n)], &result[(size_t)(k * n)],
                     left[(size_t)(r * rank + k)], n);
    }
    return true;
}

// The matrix of an axis with a basis, as the kernel takes it: along x transposed, so that its rows
// lie along the results.
template <class T> bool add_matrix(const AxisTransform& axis, int number, Plan<T>& plan) {
    const Basis& basis = *axis.basis;
    int64_t rows = basis.n, columns = basis.rank;
    std::vector<double> wide(basis.synthesis.begin(), basis.synthesis.end());
    if (plan.lod == FORWARD) {
        if (!analysis_of(basis, wide)) return false;
        std::swap(rows, columns);
    }
    plan.ranks[number] = basis.rank;
    auto& matrix = plan.matrices[number];
    matrix.assign(wide.begin(), wide.end());
    if (matrix.empty()) matrix.push_back(0);  // the kernel asks for an address
    for (int64_t r = 0; number == 3 && r < rows; r++)
        for (int64_t c = 0; c < columns; c++)
            matrix[(size_t)(c * rows + r)] = (T)wide[(size_t)(r * columns + c)];
    return true;
}

template <class T>
std::shared_ptr<const Plan<T>> make_plan(fhash_context& context, const Settings& settings,
                                         const Shape& shape, int lod) {
    auto plan = std::make_shared<Plan<T>>();
    plan->table = band_table(settings.axes, shape);
    plan->shape = shape;
    plan->lod = lod;
    // A stripe of fewer vertices takes hardly longer than starting a thread for it.
    constexpr int64_t LEAST = 1 << 17;
    plan->threads = (int)std::clamp<int64_t>(vertices(shape) / LEAST, 1,
                                             std::max(context.threads, 1));
    const int less = std::max(lod, 0);
    double gains[4];
    for (int a = 0; a < 4; a++) {
        const AxisTransform& axis = settings.axes[a];
        const int64_t n = shape[(size_t)a];
        const int left_out = a ? std::min(less, axis.depth) : 0;
        plan->bands[(size_t)a] = band_lengths(n, left_out).back();
        plan->depths[a] = axis.depth - left_out;
        plan->kinds[a] = axis.wavelet() && !plan->depths[a] ? NONE_KIND : axis.kind;
        plan->ranks[a] = 0;
        plan->halvings[a] = a ? less - left_out : 0;
        gains[a] = gain_of(axis.kind, n, left_out);
        if (axis.basis && !add_matrix(axis, a, *plan)) return nullptr;
    }
    const Norms norms = norms_of(context, settings.axes, shape);
    const auto factor = [&](double norm) { return (T)(lod == FORWARD ? norm : 1.0 / norm); };
    for (int64_t t = 0; t < plan->bands[0]; t++)
        for (int64_t z = 0; z < plan->bands[1]; z++)
            plan->tz.push_back(factor(norms.tz[(size_t)(t * shape[1] + z)] * gains[1]));
    for (int64_t y = 0; y < plan->bands[2]; y++)
        for (int64_t x = 0; x < plan->bands[3]; x++)
            plan->yx.push_back(
                factor(norms.yx[(size_t)(y * shape[3] + x)] * (gains[2] * gains[3])));
    return plan;
}

auto& kept_plans(const Settings& settings, float) { return settings.plans32; }
auto& kept_plans(const Settings& settings, double) { return settings.plans64; }

// Every second value along an axis after the filter (1/4, 1/2, 1/4), clamped at the ends.
template <class T> std::vector<T> halved(const std::vector<T>& in, Shape& shape, int axis) {
    const int64_t n = shape[(size_t)axis], half = (n + 1) / 2;
    int64_t outer_count = 1, inner = 1;
    for (int a = 0; a < axis; a++) outer_count *= shape[(size_t)a];
    for (int a = axis + 1; a < 4; a++) inner *= shape[(size_t)a];
    std::vector<T> out((size_t)(outer_count * half * inner));
    for (int64_t o = 0; o < outer_count; o++)
        for (int64_t k = 0; k < half; k++) {
            const T* const rows = in.data() + o * n * inner;
            const T* const before = rows + std::max<int64_t>(2 * k - 1, 0) * inner;
            const T* const own = rows + 2 * k * inner;
            const T* const after = rows + std::min(2 * k + 1, n - 1) * inner;
            T* const target = out.data() + (o * half + k) * inner;
            for (int64_t i = 0; i < inner; i++)
                target[i] = (before[i] + after[i]) * (T)0.25 + own[i] * (T)0.5;
        }
    shape[(size_t)axis] = half;
    return out;
}

// The coefficients that a level of detail needs.
std::vector<int32_t> kept_corner(const int32_t* integers, const Shape& shape, const Shape& bands) {
    std::vector<int32_t> kept;
    kept.reserve((size_t)vertices(bands));
    for (int64_t t = 0; t < bands[0]; t++)
        for (int64_t z = 0; z < bands[1]; z++)
            for (int64_t y = 0; y < bands[2]; y++) {
                const int32_t* const row =
                    integers + ((t * shape[1] + z) * shape[2] + y) * shape[3];
                kept.insert(kept.end(), row, row + bands[3]);
            }
    return kept;
}

}  // namespace

bool is_coupled(const AxisTransform& y, const AxisTransform& x) {
    return y.wavelet() && y.kind == x.kind && y.depth == x.depth;
}

std::vector<int64_t> band_lengths(int64_t n, int depth) {
    std::vector<int64_t> lengths = {n};
    for (int i = 0; i < depth; i++) lengths.push_back((lengths.back() + 1) / 2);
    return lengths;
}

Table band_table(const AxisTransform* axes, const Shape& shape) {
    Spans spans[4];
    for (int a = 0; a < 4; a++) spans[a] = spans_of(axes[a], shape[(size_t)a]);
    const bool coupled = is_coupled(axes[2], axes[3]);
    const bool klt = axes[2].kind == KLT_KIND || axes[3].kind == KLT_KIND;
    Bands bands = {spans[2], spans[3], coupled, klt, {}, {}};
    std::vector<Plane> planes;
    if (coupled) {
        planes = coupled_planes(spans[2], spans[3]);
    } else {
        planes.emplace_back();
        for (const Span& y : spans[2])
            for (const Span& x : spans[3]) planes[0].push_back({y, x});
    }
    for (const Plane& plane : planes)
        for (size_t t = 0; t < spans[0].size(); t++)
            for (size_t z = 0; z < spans[1].size(); z++)
                for (const auto& [y, x] : plane)
                    bands.add({(int)t, (int)z, y.level, x.level}, {spans[0][t], spans[1][z], y, x});
    return bands.table;
}

Table single_band(const Shape& shape) {
    Table table(TABLE_COLUMNS, 0);
    for (size_t a = 0; a < 4; a++) table[4 + a] = (int32_t)shape[a];
    for (size_t reference = 0; reference < 4; reference++) table[9 + 5 * reference] = -1;
    return table;
}

Norms norms_of(fhash_context& context, const AxisTransform* axes, const Shape& shape) {
    return {outer(axis_norms(context, axes[0], shape[0]), axis_norms(context, axes[1], shape[1])),
            plane_norms(context, axes[2], axes[3], shape[2], shape[3])};
}

template <class T> int64_t Plan<T>::invert(const T* coefficients, T* out) const {
    const T* of[4];
    for (int a = 0; a < 4; a++) of[a] = matrices[a].empty() ? nullptr : matrices[a].data();
    return transform_inverse(coefficients, out, bands.data(), kinds, depths, ranks, of, tz.data(),
                             yx.data(), threads);
}

template <class T>
int64_t Plan<T>::rebuild(const int32_t* integers, T* out, const double* numbers) const {
    const T* of[4];
    for (int a = 0; a < 4; a++) of[a] = matrices[a].empty() ? nullptr : matrices[a].data();
    return reconstruct(integers, out, bands.data(), kinds, depths, ranks, of, tz.data(), yx.data(),
                       threads, numbers);
}

template <class T> int64_t Plan<T>::transform(const T* values, T* out) const {
    const T* of[4];
    for (int a = 0; a < 4; a++) of[a] = matrices[a].empty() ? nullptr : matrices[a].data();
    return transform_forward(values, out, shape.data(), kinds, depths, ranks, of, tz.data(),
                             yx.data(), threads);
}

template <class T>
std::shared_ptr<const Plan<T>> forward_plan(fhash_context& context, const Settings& settings,
                                            const Shape& shape, fhash_error& error) {
    const auto plan = plan_for<T>(context, settings, shape, FORWARD, error);
    if (!plan && error.status != FHASH_ERROR_DAMAGED)
        fail(error, FHASH_ERROR_ARGUMENT,
             "the vectors of a basis depend on each other, so nothing can be encoded with it");
    return plan;
}

template <class T>
std::shared_ptr<const Plan<T>> plan_for(fhash_context& context, const Settings& settings,
                                        const Shape& shape, int lod, fhash_error& error) {
    constexpr size_t REMEMBERED = 8;
    for (int a = 0; a < 4; a++) {
        const Basis* const basis = settings.axes[a].basis.get();
        if (!basis || basis->n == shape[(size_t)a]) continue;
        fail(error, FHASH_ERROR_DAMAGED,
             "the settings of a coded tile do not fit its shape: the basis along %c is for %lld "
             "vertices, the tile has %lld",
             "tzyx"[a], (long long)basis->n, (long long)shape[(size_t)a]);
        return nullptr;
    }
    auto& plans = kept_plans(settings, T());
    {
        const Guard guard(settings.lock);
        for (const auto& plan : plans)
            if (plan->shape == shape && plan->lod == lod) return plan;
    }
    const auto plan = make_plan<T>(context, settings, shape, lod);
    if (!plan) return nullptr;
    const Guard guard(settings.lock);
    if (plans.size() == REMEMBERED) plans.erase(plans.begin());
    plans.push_back(plan);
    return plan;
}

template <class T>
bool linear_values(const Settings& settings, const Plan<T>& plan, int32_t* integers, T* out,
                   fhash_error& error) {
    double numbers[10] = {settings.step};
    for (int i = 0; i < OFFSET_COUNT; i++) numbers[1 + i] = settings.offsets[i] / OFFSET_UNIT;
    numbers[7] = settings.center;
    numbers[8] = settings.low;
    numbers[9] = settings.high;
    // Zeros may have another sign until a centre is added that is not -0.
    const bool signed_zero = settings.center == 0 && std::signbit(settings.center);
    if (plan.lod == 0 && !signed_zero)
        return kernel_done(plan.rebuild(integers, out, numbers), "a transform", error);
    Shape shape = plan.bands;
    std::vector<int32_t> corner;
    if (plan.lod) corner = kept_corner(integers, plan.shape, shape);
    const int64_t n = vertices(shape);
    std::vector<T> coefficients((size_t)n), values((size_t)n);
    dequantise(plan.lod ? corner.data() : integers, n, settings.step, numbers + 1,
               coefficients.data());
    if (!kernel_done(plan.invert(coefficients.data(), values.data()), "a transform", error))
        return false;
    for (int axis = 1; axis < 4; axis++)
        for (int i = 0; i < plan.halvings[axis]; i++) values = halved(values, shape, axis);
    clip_shifted(values.data(), (int64_t)values.size(), settings.center, settings.low,
                 settings.high);
    std::copy(values.begin(), values.end(), out);
    return true;
}

template struct Plan<float>;
template struct Plan<double>;
template std::shared_ptr<const Plan<float>> plan_for(fhash_context&, const Settings&,
                                                     const Shape&, int, fhash_error&);
template std::shared_ptr<const Plan<double>> plan_for(fhash_context&, const Settings&,
                                                      const Shape&, int, fhash_error&);
template std::shared_ptr<const Plan<float>> forward_plan(fhash_context&, const Settings&,
                                                         const Shape&, fhash_error&);
template std::shared_ptr<const Plan<double>> forward_plan(fhash_context&, const Settings&,
                                                          const Shape&, fhash_error&);
template bool linear_values(const Settings&, const Plan<float>&, int32_t*, float*, fhash_error&);
template bool linear_values(const Settings&, const Plan<double>&, int32_t*, double*, fhash_error&);

}  // namespace fhash
