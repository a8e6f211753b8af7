// The planner: tiles, transform and step of a series by prices of some of its parts.
//
// Nothing is coded. A price is what the fast coder would take for the coefficients of a part, and
// their squared error (fast.cpp). Transforms are sorted out by what their coefficients are likely
// to take, whatever stands around each (fhash_price), on a quarter of the parts.
#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "basis.hpp"
#include "encode.hpp"
#include "kernels.hpp"
#include "planner.hpp"
#include "priors.hpp"

namespace fhash {
namespace {

constexpr double WEIGHT = 0.09;       // squared steps that a bit is worth
constexpr double ERROR_PRICE = 0.8;   // squared error in squared steps that is worth a byte
constexpr double BASIS_STEPS = 1.4;      // that a basis is as precise as
constexpr double BASIS_TEXT = 1.03;   // bytes in a file for each byte of a packed basis
constexpr double NEAR = 1.08;         // of the cheapest by its coefficients: the coder prices them
constexpr size_t MOST_NEAR = 3;       // that it prices
constexpr int64_t MAX_BASIS = 128;    // longest axis with a basis: longer ones cost too much
constexpr double OCTAVES = 0.67;      // of bytes for an octave of squared errors: 4.5 dB an octave
constexpr double SLOPE = 5.5;         // dB by which the PSNR falls for a step larger by e
constexpr double FALL = 1.2;          // octaves of bytes for a step larger by e
constexpr double SETTLED = 0.2;         // change of the logarithm of the step, about a decibel
constexpr int MOST_SETTLED = 5;        // prices by which a step is looked for
constexpr double COMPARABLE = 1.5;      // dB up to which bytes of a step are corrected for it
constexpr int MOST_STEPS = 2;          // that are tried to come so near
constexpr double LEAST_EXTRA = 0.002;  // share of extra bytes that a block corrects
constexpr double LEAST_TOLD = 0.5;    // bytes of cuts along an axis, as a multiple
constexpr double MOST_FACTOR = 8;     // of the extra bytes that thin parts foretell
constexpr size_t MOST_CHECKS = 4;     // tilings that the block is cut into
constexpr double TILE_BYTES = 100;    // of each further tile: its place, and its coder's beginning

// Parts of a series that have one shape.
struct Block {
    std::vector<float> values;
    std::vector<uint8_t> counted;  // empty where all count
    double weight;                 // vertices of the box that one of its vertices stands for
    double share = 1;              // of its vertices that count
};
struct Blocks {
    Shape shape;
    std::vector<Block> all;
};

struct Price {
    double bytes = 0, squares = 0, count = 0;

    double mean_square() const { return count > 0 ? squares / count : 0; }
};

int bit_length(int64_t n) {
    int bits = 0;
    for (; n; n >>= 1) bits++;
    return bits;
}

// The kind and the levels of a transform along an axis, whatever its length.
struct Kind {
    int kind = NONE_KIND, depth = 0;

    bool operator==(const Kind& other) const { return kind == other.kind && depth == other.depth; }
};
using Kinds = std::array<Kind, 4>;

AxisTransform wavelet(int kind, int depth, int64_t length) {
    AxisTransform axis;
    axis.depth = std::min(depth, length > 1 ? bit_length(length - 1) : 0);
    axis.kind = axis.depth ? kind : NONE_KIND;
    return axis;
}

// 9/7 along all axes, deepest in the plane.
Kinds usual(const int64_t* shape) {
    const int depth = std::min(4, std::max(1, bit_length(std::max(shape[2], shape[3])) - 2));
    const Kind line = {DAUBECHIES_KIND, 2}, plane = {DAUBECHIES_KIND, depth};
    return {line, line, plane, plane};
}

// Blocks of one shape on which trials are priced, and those few of them that tell most.
struct Set {
    Blocks blocks;
    std::vector<size_t> all, few;

    const Shape& shape() const { return blocks.shape; }
};

class Planner {
  public:
    Planner(fhash_context& context, const fhash_plan_task& task, fhash_error& error)
        : context_(context), task_(task), error_(error), step_(task.step) {
        std::copy_n(task.shape, 4, box_.begin());
    }

    bool run(fhash_plan_result& result) {
        Set columns = read(task_.columns), sheets;
        if (task_.sheets.count) sheets = read(task_.sheets);
        Shape tile = box_;
        result.price = 1;
        if (task_.tile_count == 1) {
            std::copy_n(task_.tiles, 4, tile.begin());
            cut_sets(columns, sheets, tile);
        }
        Kinds kinds = usual(tile.data());
        if (!order(columns, kinds) || !order(sheets, kinds)) return false;
        if (!settle(columns, kinds)) return false;
        if (!choose(columns, sheets, tile, 15, kinds) || !settle(columns, kinds)) return false;
        if (task_.tile_count > 1) {
            const Set block = read(task_.block);
            if (!check_plane(block, kinds)) return false;
            if (!choose_tile(columns, sheets, block, kinds, tile, result)) return false;
            cut_sets(columns, sheets, tile);
            int axes = 0;
            for (int a = 0; a < 4; a++) axes |= (tile[(size_t)a] != box_[(size_t)a]) << a;
            if (axes && (!order(columns, kinds) || !order(sheets, kinds) ||
                         !choose(columns, sheets, tile, axes, kinds)))
                return false;
        }
        Price found;
        if (!settle(columns, kinds) || !price(columns, columns.all, tile, {kinds}, &found))
            return false;
        for (size_t a = 0; a < 4; a++) {
            const Kind of = kinds[a];
            result.tile[a] = tile[a];
            result.kinds[a] = of.kind;
            result.depths[a] = of.depth;
        }
        result.step = step_;
        result.bytes = found.bytes;
        if (!sheets.all.empty()) {
            if (!price(sheets, sheets.all, tile, {kinds}, &found)) return false;
            result.bytes = std::min(result.bytes, found.bytes);
        }
        return true;
    }

    // The basis along an axis of tiles of a length, packed.
    const Buffer& packed(size_t axis, int64_t length) { return own(axis, length).packed; }

  private:
    fhash_context& context_;
    const fhash_plan_task& task_;
    fhash_error& error_;
    Shape box_;
    double step_;
    int64_t tried_ = 0;
    struct Own {
        std::shared_ptr<const Basis> basis;
        Buffer packed;
        double bytes = 0;
    };
    std::map<std::pair<size_t, int64_t>, Modes> modes_;
    std::map<std::pair<size_t, int64_t>, Own> bases_;
    double bases_step_ = 0;  // that the bases are for

    static std::vector<size_t> numbers(size_t count) {
        std::vector<size_t> all(count);
        for (size_t i = 0; i < count; i++) all[i] = i;
        return all;
    }

    static Shape within(const Shape& shape, const Shape& tile) {
        Shape inside;
        for (size_t a = 0; a < 4; a++) inside[a] = std::min(shape[a], tile[a]);
        return inside;
    }

    static Set read(const fhash_plan_parts& of) {
        Set set;
        std::copy_n(of.shape, 4, set.blocks.shape.begin());
        const int64_t n = vertices(set.blocks.shape);
        for (int64_t i = 0; i < of.count; i++) {
            Block block;
            block.values.assign(of.values + i * n, of.values + (i + 1) * n);
            block.weight = of.weights[i];
            if (of.counted) block.counted.assign(of.counted + i * n, of.counted + (i + 1) * n);
            if (share(block)) set.blocks.all.push_back(std::move(block));
        }
        set.all = set.few = numbers(set.blocks.all.size());
        return set;
    }

    // Sets the share of the vertices that count; whether any does.
    static bool share(Block& block) {
        if (block.counted.empty()) return true;
        const auto there = std::count(block.counted.begin(), block.counted.end(), 1);
        block.share = (double)there / (double)block.counted.size();
        if ((size_t)there == block.counted.size()) block.counted.clear();
        return there > 0;
    }

    // Blocks in smaller ones; the last one along an axis ends where the block ends.
    static Blocks cut(const Blocks& parts, const Shape& shape) {
        Blocks blocks;
        blocks.shape = shape;
        if (shape == parts.shape) return parts;
        Shape counts;
        double overlap = 1;
        for (size_t a = 0; a < 4; a++) {
            counts[a] = (parts.shape[a] + shape[a] - 1) / shape[a];
            overlap *= (double)parts.shape[a] / (double)(counts[a] * shape[a]);
        }
        for (const Block& part : parts.all)
            for (int64_t number = 0; number < vertices(counts); number++) {
                Shape first;
                int64_t rest = number;
                for (size_t a = 4; a-- > 0;) {
                    const int64_t place = rest % counts[a] * shape[a];
                    first[a] = std::min(place, parts.shape[a] - shape[a]);
                    rest /= counts[a];
                }
                Block block;
                block.weight = part.weight * overlap;
                copy_box(part.values, parts.shape, first, shape, block.values);
                if (!part.counted.empty())
                    copy_box(part.counted, parts.shape, first, shape, block.counted);
                if (share(block)) blocks.all.push_back(std::move(block));
            }
        return blocks;
    }
    template <class T>
    static void copy_box(const std::vector<T>& in, const Shape& of, const Shape& first,
                         const Shape& shape, std::vector<T>& out) {
        out.reserve((size_t)vertices(shape));
        for (int64_t t = 0; t < shape[0]; t++)
            for (int64_t z = 0; z < shape[1]; z++)
                for (int64_t y = 0; y < shape[2]; y++) {
                    const auto row = in.begin() + (((first[0] + t) * of[1] + first[1] + z) * of[2] +
                                                   first[2] + y) * of[3] + first[3];
                    out.insert(out.end(), row, row + shape[3]);
                }
    }

    // The basis along an axis for blocks of a length, as precise as the step needs, and its bytes
    // in the file; null where there can be none.
    const Own& own(size_t axis, int64_t length) {
        static const Own none;
        if (!task_.lines[axis] || length < 2 || length > MAX_BASIS) return none;
        if (bases_step_ != step_) bases_.clear();
        bases_step_ = step_;
        const auto key = std::make_pair(axis, length);
        const auto found = bases_.find(key);
        if (found != bases_.end()) return found->second;
        auto modes = modes_.find(key);
        if (modes == modes_.end()) modes = modes_.emplace(key, modes_along(axis, length)).first;
        Own& made = bases_[key];
        Buffer& packed = made.packed;
        if (!pack_basis(modes->second, BASIS_STEPS * step_, packed, error_)) return none;
        made.basis = read_basis({packed.data(), packed.data() + packed.size()}, error_);
        made.bytes = BASIS_TEXT * (double)packed.size();
        return made;
    }

    Modes modes_along(size_t axis, int64_t length) const {
        const int64_t whole = box_[axis], lines = task_.line_counts[axis];
        std::vector<double> gram((size_t)(length * length), 0.0), line((size_t)length);
        double added = 0;
        for (int64_t l = 0; l < lines; l++)
            for (int64_t first = 0; first + length <= whole; first += length) {
                const float* const from = task_.lines[axis] + l * whole + first;
                std::copy_n(from, length, line.begin());
                for (int64_t i = 0; i < length; i++) {
                    double* const row = &gram[(size_t)(i * length)];
                    const double value = line[(size_t)i];
                    for (int64_t k = 0; k <= i; k++) row[k] += value * line[(size_t)k];
                }
                added += (double)length;
            }
        const double share = added > 0 ? (double)vertices(box_) / added : 0;  // of all lines
        for (int64_t i = 0; i < length; i++)
            for (int64_t k = 0; k <= i; k++) {
                gram[(size_t)(i * length + k)] *= share;
                gram[(size_t)(k * length + i)] = gram[(size_t)(i * length + k)];
            }
        return modes_of(gram, length);
    }

    // The transform of a shape, and what its bases take for tiles of another one.
    double fit(const Kinds& kinds, const Shape& shape, const Shape& tile, AxisTransform* axes) {
        double bytes = 0;
        for (size_t a = 0; a < 4; a++) {
            const Own* made = nullptr;
            if (kinds[a].kind == KLT_KIND && (made = &own(a, shape[a]))->basis) {
                axes[a].kind = KLT_KIND;
                axes[a].basis = made->basis;
                bytes += own(a, tile[a]).bytes;
            } else if (kinds[a].kind != KLT_KIND) {
                axes[a] = wavelet(kinds[a].kind, kinds[a].depth, shape[a]);
            }
        }
        if (kinds[2] == kinds[3] && kinds[2].depth && std::min(shape[2], shape[3]) > 1) {
            const int most = bit_length(std::max(shape[2], shape[3]) - 1);
            axes[2].kind = axes[3].kind = kinds[2].kind;
            axes[2].depth = axes[3].depth = std::min(kinds[2].depth, most);
        }
        return bytes;
    }

    // The axes along which not all trials are alike, a bit each; y and x go together.
    static int varied(const std::vector<Kinds>& trials) {
        int axes = 0;
        for (const Kinds& trial : trials)
            for (int a = 0; a < 4; a++)
                if (!(trial[(size_t)a] == trials[0][(size_t)a])) axes |= a < 2 ? 1 << a : 12;
        return axes;
    }

    // Runs `work` for each number below `count`, by all threads, until it fails. Its second
    // argument is room that a thread keeps.
    template <class Work> bool in_threads(size_t count, const Work& work) {
        std::atomic<size_t> next{0};
        std::atomic<bool> failed{false};
        together((int)std::min((size_t)context_.threads, std::max<size_t>(count, 1)), [&](int) {
            std::vector<float> room;
            for (size_t number = next++; number < count && !failed; number = next++)
                if (!work(number, room)) failed = true;
        });
        return !failed;
    }

    // Prices of transforms on blocks; for all that these stand for. The costs are with the bytes of
    // bases for tiles of a shape. What all trials do alike is done once for each block.
    //
    // likely: by the coefficients alone, whatever stands around each.
    bool price(const Set& set, const std::vector<size_t>& which, const Shape& tile,
               const std::vector<Kinds>& trials, Price* prices, bool likely = false) {
        const Blocks& blocks = set.blocks;
        const size_t count = trials.size(), jobs = count * which.size();
        std::vector<Settings> settings(count);
        Settings common;
        const int axes = varied(trials);
        for (size_t i = 0; i < count; i++) {
            prices[i] = {};
            prices[i].bytes = fit(trials[i], blocks.shape, tile, settings[i].axes);
            for (int a = 0; a < 4 && axes; a++)
                if (!(axes >> a & 1)) common.axes[a] = std::exchange(settings[i].axes[a], {});
        }
        std::vector<double> results(2 * jobs);
        const int64_t n = vertices(blocks.shape);
        const FastPrior& prior = fast_prior();
        std::vector<std::vector<float>> held(axes ? which.size() : 0);
        const auto transform = [&](const Settings& of, const std::vector<float>& values,
                                   std::vector<float>& to) {
            fhash_error error;
            error.status = FHASH_OK;
            const auto plan = forward_plan<float>(context_, of, blocks.shape, error);
            to.resize(values.size());
            return plan && plan->transform(values.data(), to.data()) >= 0;
        };
        const bool done =
            in_threads(held.size(),
                       [&](size_t place, std::vector<float>&) {
                           return transform(common, blocks.all[which[place]].values, held[place]);
                       }) &&
            in_threads(jobs, [&](size_t job, std::vector<float>& coefficients) {
                const size_t i = job / which.size(), place = job % which.size();
                if (!transform(settings[i], axes ? held[place] : blocks.all[which[place]].values,
                               coefficients))
                    return false;
                double* const result = &results[2 * job];
                if (likely) {
                    fhash_price(coefficients.data(), n, 1 / step_, result);
                    return true;
                }
                const Table table = band_table(settings[i].axes, blocks.shape);
                return fhash_fast_encode(nullptr, coefficients.data(), 0, 1 / step_, WEIGHT,
                                         blocks.shape.data(), table.data(),
                                         (int64_t)table.size() / TABLE_COLUMNS,
                                         prior.slots.data(), prior.defaults.data(), nullptr, 0,
                                         result) >= 0;
            });
        if (!done) return fail(error_, FHASH_ERROR_MEMORY, "a price could not be computed");
        for (size_t job = 0; job < jobs; job++) {
            const Block& block = blocks.all[which[job % which.size()]];
            Price& of = prices[job / which.size()];
            const double squares = results[2 * job + 1] * step_ * step_;
            of.bytes += block.weight * results[2 * job];
            of.squares += block.weight * block.share * squares;
            of.count += block.weight * block.share * (double)n;
        }
        return true;
    }

    double cost(const Price& price) const {
        return price.bytes + price.squares / (ERROR_PRICE * step_ * step_);
    }

    // Bytes at equal quality as a multiple of those of another price of the same values.
    double relative(const Price& one, const Price& other) const {
        const double bytes = one.bytes / std::max(other.bytes, 1.0);
        if (one.squares <= 0 || other.squares <= 0) return bytes;
        return bytes * std::pow(one.squares / other.squares, OCTAVES);
    }

    // Chooses the blocks of the most bytes, on which all trials are priced first.
    bool order(Set& set, const Kinds& kinds) {
        set.few = set.all;
        if (set.all.size() < 4) return true;
        std::vector<std::pair<double, size_t>> costs;
        for (const size_t number : set.all) {
            Price one;
            if (!price(set, {number}, set.shape(), {kinds}, &one, true)) return false;
            costs.emplace_back(-one.bytes, number);
        }
        std::sort(costs.begin(), costs.end());
        set.few.clear();
        for (size_t i = 0; i < (costs.size() + 3) / 4; i++) set.few.push_back(costs[i].second);
        std::sort(set.few.begin(), set.few.end());
        return true;
    }

    // Takes the cheapest of some transforms, among which the present one is.
    bool improve(const Set& set, const Shape& tile, const std::vector<Kinds>& changes,
                 Kinds& kinds) {
        std::vector<Kinds> trials = {kinds};
        for (const Kinds& other : changes)
            if (std::find(trials.begin(), trials.end(), other) == trials.end())
                trials.push_back(other);
        if (trials.size() == 1) return true;
        std::vector<Price> prices(trials.size());
        const auto cheapest = [&](size_t first) {
            size_t best = first;
            for (size_t i = first; i < trials.size(); i++)
                if (cost(prices[i]) < cost(prices[best])) best = i;
            return best;
        };
        if (!price(set, set.few, tile, trials, prices.data(), true)) return false;
        size_t near = 0;  // the cheapest first
        for (double limit = 1e300; near < std::min(MOST_NEAR, trials.size()); near++) {
            const size_t best = cheapest(near);
            if (cost(prices[best]) > limit) break;
            if (near == 0) limit = NEAR * cost(prices[best]);
            std::swap(trials[near], trials[best]);
            std::swap(prices[near], prices[best]);
        }
        trials.resize(near);
        if (near > 1 && !price(set, set.all, tile, trials, prices.data())) return false;
        kinds = trials[cheapest(0)];
        return true;
    }

    // The transform of the lowest price for tiles of a shape. First kinds are tried, and then other
    // depths of the best one.
    //
    // axes: along which a choice is made, a bit each; y and x go together.
    bool choose(const Set& columns, const Set& sheets, const Shape& tile, int axes, Kinds& kinds) {
        const Set& of_plane = sheets.all.empty() ? columns : sheets;
        const Kind plane = {DAUBECHIES_KIND, usual(tile.data())[2].depth};
        const Kind line = {DAUBECHIES_KIND, 2};
        if (axes & 12 && !choose_along(of_plane, tile, 2, {plane, {HAAR_KIND, 3}, {LEGALL_KIND, 2}},
                                       kinds))
            return false;
        const Kind along_z = kinds[1];
        const std::vector<Kind> of_lines = {
            {}, line, {DAUBECHIES_KIND, 1}, {HAAR_KIND, 2}, {LEGALL_KIND, 1}};
        for (size_t axis = 0; axis < 2; axis++)
            if (axes >> axis & 1 && tile[axis] > 1 &&
                !choose_along(columns, tile, axis, of_lines, kinds))
                return false;
        if (kinds[1] == along_z || tile[0] == 1) return true;
        std::vector<Kinds> changes(1, kinds);
        changes[0][0] = {};
        return improve(columns, tile, changes, kinds);
    }

    // Thin sheets may not tell what own bases are worth in a plane whose steps have
    // much in common: a block does. Where they tell it, they know better: a block may be shorter.
    bool check_plane(const Set& block, Kinds& kinds) {
        const auto may = [&](size_t a) {
            return own(a, block.shape()[a]).basis && own(a, box_[a]).basis;
        };
        if (block.all.empty() || kinds[2].kind == KLT_KIND || !may(2) || !may(3)) return true;
        Kinds other = kinds;
        other[2] = other[3] = {KLT_KIND, 0};
        return improve(block, box_, {other}, kinds);
    }

    bool choose_along(const Set& set, const Shape& tile, size_t axis,
                      const std::vector<Kind>& options, Kinds& kinds) {
        std::vector<Kinds> changes;
        const size_t last = axis == 2 ? 3 : axis;
        const auto add = [&](Kind kind) {
            for (size_t a = axis; a <= last; a++)
                if (kind.depth > 0 && 1 << (kind.depth - 1) >= std::max(tile[a], tile[last]))
                    return;
            changes.push_back(kinds);
            for (size_t a = axis; a <= last; a++) changes.back()[a] = kind;
        };
        for (const Kind& kind : options) add(kind);
        bool may = true;
        for (size_t a = axis; a <= last; a++)
            may = may && own(a, set.shape()[a]).basis && own(a, tile[a]).basis;
        if (may) add({KLT_KIND, 0});
        if (!improve(set, tile, changes, kinds)) return false;
        const Kind found = kinds[axis];
        if (found.kind == NONE_KIND || found.kind == KLT_KIND) return true;
        changes.clear();
        if (found.depth > 1) add({found.kind, found.depth - 1});
        add({found.kind, found.depth + 1});
        return improve(set, tile, changes, kinds);
    }

    // Looks for the step that keeps the promise, within what was too fine and too coarse before:
    // where few coefficients hold nearly everything, the error jumps at their step.
    bool settle(const Set& set, const Kinds& kinds) {
        if (task_.size <= 0 && task_.mean_square <= 0) return true;
        double fine = -1e9, coarse = 1e9;
        for (int i = 0; i < MOST_SETTLED; i++) {
            Price found;
            if (!price(set, set.all, set.shape(), {kinds}, &found, true)) return false;
            double wanted;  // change of the logarithm of the step
            if (task_.size > 0) {
                wanted = std::log2(std::max(found.bytes, 1.0) / task_.size) / FALL;
            } else {
                if (found.mean_square() <= 0) return true;
                wanted = -10 * std::log10(found.mean_square() / task_.mean_square) / SLOPE;
            }
            const double at = std::log(step_);
            (wanted > 0 ? fine : coarse) = at;
            double next = at + std::min(std::max(wanted, -2.0), 2.0);
            if (next <= fine || next >= coarse) next = (fine + coarse) / 2;
            step_ = std::exp(next);
            if (std::fabs(wanted) < SETTLED) return true;
        }
        return true;
    }

    // What cuts cost.
    struct Cuts {
        double extra[4] = {0, 0, 0, 0};  // share of bytes along each axis, times the length
        // Bytes of tiles of fewer steps than the columns have, as a multiple, and their transform.
        std::map<int64_t, std::pair<double, Kind>> steps;
        int64_t columns = 1;               // steps of these
        double factors[4] = {1, 1, 1, 1};  // of the extra bytes, by the block

        // Bytes of tiles of a shape as a multiple of those of one tile.
        double told(const Shape& shape, const Shape& box) const {
            double product = 1;
            for (size_t a = 0; a < 4; a++) {
                const auto known = a == 0 ? steps.find(shape[0]) : steps.end();
                const double n = (double)(known == steps.end() ? shape[a] : columns);
                double along = 1 + extra[a] * (1 / n - 1 / (double)box[a]);
                if (known != steps.end()) along *= known->second.first;
                product *= std::max(1 + factors[a] * (along - 1), LEAST_TOLD);
            }
            return product;
        }
    };

    // Prices cuts of parts along each axis. Tiles of fewer steps are priced each with the transform
    // along time that is best for them: what few steps have in common tells nothing of more.
    bool price_cuts(const Set& columns, const Set& sheets, const Kinds& kinds, Cuts& cuts,
                    double& bytes) {
        cuts.columns = columns.shape()[0];
        bytes = 1e300;
        for (int of_plane = 0; of_plane < 2; of_plane++) {
            const Set& set = of_plane && !sheets.all.empty() ? sheets : columns;
            Price whole;
            if (!price(set, set.all, box_, {kinds}, &whole)) return false;
            bytes = std::min(bytes, std::max(whole.bytes, 1.0));
            for (size_t a = of_plane ? 2 : 0; a < (of_plane ? 4 : 2); a++) {
                const int64_t n = set.shape()[a];
                if (n < 2) continue;
                Shape half = set.shape();
                half[a] = (n + 1) / 2;
                double ratio;
                if (!price_ratio(set, half, kinds, whole, ratio)) return false;
                const double length = (double)box_[a], before = 1 / (double)n - 1 / length;
                const double there = 1 / (double)half[a] - 1 / length;
                cuts.extra[a] =
                    std::max((ratio - 1) / std::max(there - ratio * before, 0.1 / (double)n), 0.0);
            }
            for (int64_t i = 0; i < task_.tile_count && !of_plane; i++) {
                const int64_t length = task_.tiles[4 * i];
                if (length >= cuts.columns || cuts.steps.count(length)) continue;
                Shape shape = columns.shape();
                shape[0] = length;
                Kinds best = kinds;
                const std::vector<Kind> options = {{}, {DAUBECHIES_KIND, 2}, {HAAR_KIND, 2}};
                if (length > 1) {
                    Set few;
                    few.blocks.shape = columns.shape();
                    for (const size_t number : columns.few)
                        few.blocks.all.push_back(columns.blocks.all[number]);
                    const Set parts = cut_set(few, shape);
                    if (!choose_along(parts, shape, 0, options, best)) return false;
                }
                double ratio;
                if (!compare(cut_set(columns, shape), best, whole, ratio)) return false;
                cuts.steps[length] = {ratio, best[0]};
            }
        }
        return true;
    }

    static Set cut_set(const Set& set, const Shape& shape) {
        Set parts;
        parts.blocks = cut(set.blocks, shape);
        parts.all = parts.few = numbers(parts.blocks.all.size());
        return parts;
    }

    static void cut_sets(Set& columns, Set& sheets, const Shape& tile) {
        for (Set* const set : {&columns, &sheets}) {
            const Shape inside = within(set->shape(), tile);
            if (!set->all.empty() && inside != set->shape()) *set = cut_set(*set, inside);
        }
    }

    // The cost of parts in blocks of a shape as a multiple of another one.
    bool price_ratio(const Set& set, const Shape& shape, const Kinds& kinds, const Price& uncut,
                     double& ratio) {
        tried_++;
        return compare(cut_set(set, shape), kinds, uncut, ratio);
    }

    // Bytes at equal quality as a multiple of those of another price. Where cuts make all
    // coefficients so small that none is kept, a finer step tells what they cost.
    bool compare(const Set& set, const Kinds& kinds, const Price& other, double& ratio) {
        const double step = step_;
        Price found;
        for (int i = 0;; i++) {
            if (!price(set, set.all, set.shape(), {kinds}, &found)) return false;
            if (found.mean_square() <= 0 || other.mean_square() <= 0 || i == MOST_STEPS) break;
            const double worse = 10 * std::log10(found.mean_square() / other.mean_square());
            if (std::fabs(worse) < COMPARABLE) break;
            step_ *= std::exp(std::min(std::max(-worse / SLOPE, -2.0), 2.0));
        }
        step_ = step;
        ratio = relative(found, other);
        return true;
    }

    // The tile of the least burden.
    //
    // checked: bytes of the block in blocks of a shape, as a multiple.
    // only: whether no other tile may be taken.
    void least_burden(const Cuts& cuts, const Shape& block, const std::map<Shape, double>& checked,
                      bool only, double bytes, Shape& tile, double& price) const {
        const double ns = task_.vertex_ns + task_.bit_ns * 8 * bytes / (double)vertices(box_);
        std::vector<double> prices;
        for (int64_t i = 0; i < task_.tile_count; i++) {
            Shape shape;
            std::copy_n(task_.tiles + 4 * i, 4, shape.begin());
            double count = 1, told = cuts.told(shape, box_);
            for (size_t a = 0; a < 4; a++) count *= std::ceil((double)box_[a] / (double)shape[a]);
            const auto known = checked.find(within(block, shape));
            if (known != checked.end())
                told *= known->second * cuts.told(block, box_) / cuts.told(known->first, box_);
            else if (only) told = 1e9;
            prices.push_back(told + TILE_BYTES * (count - 1) / bytes);
        }
        const double lowest = *std::min_element(prices.begin(), prices.end());
        double least = 1e300;
        for (int64_t i = 0; i < task_.tile_count; i++) {
            const double told = prices[(size_t)i] / lowest;
            const double work = task_.works[i], late = work * ns / task_.region_ns;
            const double burden = std::log(told) + task_.worth * std::log2(work) +
                                  std::log2(std::max(late, 1.0));
            if (told > task_.most || burden >= least) continue;
            least = burden;
            std::copy_n(task_.tiles + 4 * i, 4, tile.begin());
            price = told;
        }
    }

    // The tile of the least burden by what cuts cost. Thin parts tell too little of that, since
    // other axes are cut already: what they foretell of a tile is checked on a large block.
    bool choose_tile(const Set& columns, const Set& sheets, const Set& block, const Kinds& kinds,
                     Shape& tile, fhash_plan_result& result) {
        Cuts cuts;
        double bytes;
        if (!price_cuts(columns, sheets, kinds, cuts, bytes)) return false;
        Price whole;
        std::map<Shape, double> checked;
        if (!block.all.empty()) checked[block.shape()] = 1;
        for (bool only = false;; only = checked.size() > MOST_CHECKS) {
            least_burden(cuts, block.shape(), checked, only, bytes, tile, result.price);
            const Shape inside = within(block.shape(), tile);
            if (block.all.empty() || checked.count(inside)) break;
            if (whole.count == 0 && !price(block, block.all, box_, {kinds}, &whole)) return false;
            Kinds of = kinds;
            const auto steps = cuts.steps.find(inside[0]);
            if (steps != cuts.steps.end()) of[0] = steps->second.second;
            double ratio;
            if (!price_ratio(block, inside, of, whole, ratio)) return false;
            checked[inside] = ratio;
            const double told = cuts.told(inside, box_) / cuts.told(block.shape(), box_);
            if (told < 1 + LEAST_EXTRA || ratio < told) continue;
            for (size_t a = 0; a < 4; a++)
                if (inside[a] < block.shape()[a])
                    cuts.factors[a] *= std::min((ratio - 1) / (told - 1), MOST_FACTOR);
        }
        result.tried = tried_;
        return true;
    }
};

}  // namespace

bool plan_tile(fhash_context& context, const fhash_plan_task& task, fhash_plan_result& result,
               std::array<Buffer, 4>& bases, fhash_error& error) {
    Planner planner(context, task, error);
    if (!planner.run(result)) return false;
    for (size_t a = 0; a < 4; a++)
        if (result.kinds[a] == KLT_KIND) bases[a] = planner.packed(a, result.tile[a]);
    return error.status == FHASH_OK;
}

}  // namespace fhash

using namespace fhash;

// Plans a series. The result has no bases: the caller fits them to all lines of the series.
FHASH_KERNEL int32_t fhash_plan(fhash_context* context, const fhash_plan_task* task,
                                fhash_plan_result* result, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        std::array<Buffer, 4> bases;
        return plan_tile(*context, *task, *result, bases, failed);
    });
}
