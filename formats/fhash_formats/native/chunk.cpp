// Encoding of a tile to a stated quality. The planner finds its transform by prices (planner.cpp);
// trials on some of its parts find the step that takes the fewest bytes under a bound, and whether
// a predictor takes fewer.
#include <cstdlib>

#include "core.hpp"
#include "draft.hpp"
#include "parts.hpp"
#include "planner.hpp"
#include "survey.hpp"

namespace fhash {
namespace {

constexpr double WEIGHT = 0.09, TRELLIS_WEIGHT = 0.27;  // squared steps that a bit is worth
constexpr int MAX_EFFORT = 9, MAX_LABELS = 65536, FEW_LABELS = 256;
constexpr double REGION_SHARE = 0.5;  // of vertices with an equal neighbour: labels may be many
constexpr double FIRST_RATIO = 2.5;   // step under a bound, in units of half the quantum
constexpr double OTHER_RATIOS[] = {4.0, 1.6};
constexpr double FAR = 1.3;     // the same of the usual transform, that another one may save
constexpr double CLOSE = 1.15;  // bytes beside those of a predictor that other steps may save
// Orders in which a predictor refines the axes, the best predicted one last, and how often it does.
constexpr int ORDERS[2][4] = {{0, 1, 2, 3}, {3, 2, 1, 0}};
constexpr int64_t REFINED[2][4] = {{2, 3, 3, 3}, {0, 3, 3, 3}};
constexpr double MAX_FORETOLD = 1 << 26;  // half the range in steps: predicted integers are small
constexpr double MAX_WHOLE = 0x1p40;      // bound on integers whose steps are exact
constexpr int CLEARLY = 4;  // ratio of a deflated tile to its labels: nothing else is tried
constexpr int64_t TRIED = 1 << 16, PARTS = 4;  // values and parts for trials at effort 2
constexpr int LINE = 3, PLANE = 12;   // axes t and z, axes y and x, a bit each
constexpr int64_t ROWS = 4;           // distance in y of the rows that a part's cost is taken from
constexpr int64_t MAX_LINES = 2048;   // that a basis is fitted to
constexpr int64_t BASIS_WORK = 8;     // of finding a basis of n vectors: n^3 times this
constexpr int32_t MAX_MISSING = 16;  // that a caller names; with others, at most MAX_MARKED
constexpr double QUANTUM_SHARE = 1 - 1e-6;    // of twice the largest error, for its rounding
constexpr double MAX_STEPS = 2.5e8;           // largest coefficient, as estimated, in steps
constexpr double MAX_VALUE = 1e300, MIN_STEP = 1e-290;
constexpr double MAX_SINGLE = 1e30, MIN_SINGLE = 1e-30;  // for arithmetic in float32

// Every so many of the values less the origin, those that do not count as NaN.
std::vector<double> numbers_of(const Task& task, int64_t every) {
    std::vector<double> numbers((size_t)((task.size() + every - 1) / every));
    with_type(task.type, [&](auto value) {
        const auto* const all = (const decltype(value)*)(const void*)task.values;
        for (size_t i = 0; i < numbers.size(); i++) {
            const int64_t at = (int64_t)i * every;
            numbers[i] = task.counts(at) ? number_of(task, all[at]) : std::nan("");
        }
        return true;
    });
    return numbers;
}

// A value that is as often exceeded as not. It is that of a plateau, where there is one: of zeros,
// which are left of it, even a basis makes zeros.
double typical(const Task& task) {
    std::vector<double> some = numbers_of(task, 1 + task.size() / TRIED);
    const auto end = std::remove_if(some.begin(), some.end(), [](double x) { return x != x; });
    if (end == some.begin()) return task.center();
    const auto middle = some.begin() + (end - some.begin()) / 2;
    std::nth_element(some.begin(), middle, end);
    return *middle;
}

// The values of a tile about its centre in steps, and choices of its parts.
struct Scaled {
    const Task& task;
    const bool real64;
    std::vector<float> values;

    Scaled(const Task& of, const Draft& draft) : task(of), real64(draft.real64) {
        const std::vector<double> numbers = numbers_of(task, 1);
        values.resize(numbers.size());
        for (size_t i = 0; i < numbers.size(); i++)
            values[i] = numbers[i] == numbers[i]
                            ? (float)((numbers[i] - draft.center) / draft.step)
                            : 0.0f;
    }

    // The approximate bits of a part, by the differences of neighbours along x.
    double cost(const Shape& first, const Shape& shape) const {
        double bits = 0;
        int64_t row = 0;
        each_row(task.shape, first, shape, [&](int64_t at) {
            if (row++ % ROWS) return;
            for (int64_t i = at + 1; i < at + shape[3]; i++)
                bits += std::log2(1 + std::fabs(values[(size_t)i] - values[(size_t)i - 1]));
        });
        return bits;
    }

    // Parts of a shape, of at most so many values together, but at least one.
    Parts parts(const Shape& shape, int64_t most) const {
        Parts parts = {shape, {}};
        Shape counts;
        for (size_t a = 0; a < 4; a++) counts[a] = (task.shape[a] + shape[a] - 1) / shape[a];
        const bool one = vertices(counts) == 1;
        for (int64_t number = 0; number < vertices(counts); number++) {
            Part part = {{}, 0, 1};
            int64_t rest = number;
            for (size_t a = 4; a-- > 0; rest /= counts[a])
                part.first[a] = std::min(rest % counts[a] * shape[a], task.shape[a] - shape[a]);
            if (!one) part.cost = cost(part.first, shape);
            parts.all.push_back(part);
        }
        const size_t few = (size_t)std::max<int64_t>(1, most / vertices(shape));
        parts.all = strata(std::move(parts.all), few);
        return parts;
    }

    // Lines along an axis, spread evenly.
    std::vector<float> lines(size_t axis, int64_t& count) const {
        const int64_t length = task.shape[axis], others = task.size() / length;
        int64_t stride = 1;
        for (size_t a = axis + 1; a < 4; a++) stride *= task.shape[a];
        count = std::min(MAX_LINES, others);
        std::vector<float> found;
        for (int64_t line = 0; line < count; line++) {
            const int64_t number = line * others / count;
            const int64_t at = number / stride * stride * length + number % stride;
            for (int64_t i = 0; i < length; i++) found.push_back(values[(size_t)(at + i * stride)]);
        }
        return found;
    }
};

// Parts as the planner takes them.
struct Given {
    std::vector<float> values;
    std::vector<uint8_t> counted;
    std::vector<double> weights;

    fhash_plan_parts of(const Scaled& scaled, const Parts& parts) {
        const Task& task = scaled.task;
        double total = 0;
        for (const Part& part : parts.all) total += part.weight * (double)vertices(parts.shape);
        for (const Part& part : parts.all) {
            each_row(task.shape, part.first, parts.shape, [&](int64_t at) {
                const auto from = scaled.values.begin() + at;
                values.insert(values.end(), from, from + parts.shape[3]);
                for (int64_t i = at; i < at + parts.shape[3] && !task.marks.of.empty(); i++)
                    counted.push_back(task.counts(i));
            });
            weights.push_back(part.weight * (double)task.size() / total);
        }
        fhash_plan_parts given = {};
        std::copy_n(parts.shape.begin(), 4, given.shape);
        given.count = (int64_t)parts.all.size();
        given.values = values.data();
        given.counted = counted.empty() ? nullptr : counted.data();
        given.weights = weights.data();
        return given;
    }
};

// The transform of the lowest price, or the usual one if no values may be priced. It has no bases
// of long axes, which take more time than the coding of the tile.
bool plan(const Scaled& scaled, int64_t most, bool bases, Form& form, fhash_error& error) {
    const Task& task = scaled.task;
    fhash_plan_task asked = {};
    Given columns, sheets;
    std::vector<float> lines[4];
    std::copy_n(task.shape.begin(), 4, asked.shape);
    std::copy_n(task.shape.begin(), 4, asked.columns.shape);
    if (task.size() <= most) {
        asked.columns = columns.of(scaled, scaled.parts(task.shape, most));
    } else if (most > 0) {
        const int64_t each = most / PARTS;
        const Shape column = shortened(shortened(task.shape, each, PLANE, 8), 2 * each, LINE, 8);
        const Shape sheet = shortened(shortened(task.shape, each, LINE, 2), each, PLANE, 8);
        asked.columns = columns.of(scaled, scaled.parts(column, most / 2));
        asked.sheets = sheets.of(scaled, scaled.parts(sheet, most / 2));
    }
    for (size_t a = 0; a < 4; a++) {
        const int64_t n = task.shape[a];
        if (!bases || scaled.real64 || n < 2 || BASIS_WORK * n * n * n > task.size()) continue;
        lines[a] = scaled.lines(a, asked.line_counts[a]);
        asked.lines[a] = lines[a].data();
    }
    asked.tiles = task.shape.data();
    asked.tile_count = 1;
    asked.step = 1;
    fhash_plan_result found = {};
    if (!plan_tile(task.context, asked, found, form.bases, error)) return false;
    for (size_t a = 0; a < 4; a++)
        form.axes[a] = task.shape[a] < 2 ? 0 : (uint8_t)(found.kinds[a] << 4 | found.depths[a]);
    return true;
}

// Parts of a tile to code.
struct Windows {
    Shape shape;
    std::vector<Buffer> values;
    std::vector<Marks> marks;
    std::vector<double> weights;

    Windows(const Task& task, const Parts& parts) : shape(parts.shape) {
        const size_t width = fhash_type_size(task.type);
        for (const Part& part : parts.all) {
            Buffer window;
            Marks there = {task.marks.values, {}};
            each_row(task.shape, part.first, shape, [&](int64_t at) {
                const uint8_t* const from = task.values + (size_t)at * width;
                window.insert(window.end(), from, from + (size_t)shape[3] * width);
                if (task.marks.of.empty()) return;
                const auto of = task.marks.of.begin() + at;
                there.of.insert(there.of.end(), of, of + shape[3]);
            });
            values.push_back(std::move(window));
            marks.push_back(std::move(there));
            weights.push_back(part.weight);
        }
    }
};

// Settings and options of the encoder, and what they made of a tile or its parts.
struct Trial {
    Draft draft;
    fhash_coding coding;
    double bytes = 0;
    Coded coded;         // of the tile
    bool whole = false;  // it is coded

    bool run(const Task& task, fhash_error& error) {
        whole = true;
        const auto settings = draft.settings(task.context, task.shape, error);
        return settings && encode_tile(task.context, settings, task.shape, task.type, task.values,
                                       nullptr, task.marks, coding, coded, error);
    }
    bool run(const Task& task, const Windows& windows, fhash_error& error) {
        if (windows.shape == task.shape) {
            if (!run(task, error)) return false;
            bytes = (double)coded.data.size();
            return true;
        }
        const auto settings = draft.settings(task.context, task.shape, error);
        if (!settings) return false;
        bytes = (double)settings->packed.size();
        fhash_coding others = coding;
        others.own_settings = 0;  // a part has the settings of its tile
        for (size_t i = 0; i < windows.values.size(); i++) {
            Coded window;
            if (!encode_tile(task.context, settings, windows.shape, task.type,
                             windows.values[i].data(), nullptr, windows.marks[i], others, window,
                             error))
                return false;
            bytes += windows.weights[i] * (double)window.data.size();
        }
        return true;
    }
};

// The draft of a predictor for the same bound.
Draft predicted(const Task& task, Draft draft, const int* order, const int64_t* levels) {
    draft.form = {};
    draft.form.order = order;
    draft.form.levels = levels;
    draft.clip = draft.trellis = false;
    draft.step = 2 * task.reach * QUANTUM_SHARE;
    if (task.whole() && task.reach < MAX_WHOLE) {  // integers at such a distance keep it exactly
        draft.step = 2 * task.reach;
        draft.center = std::nearbyint(draft.center);
    }
    return draft;
}

// Trials on parts of a tile under a bound.
struct Trials {
    const Scaled& scaled;
    const int64_t most;
    const Trial begin;
    fhash_error& error;
    Windows windows;

    Trials(const Scaled& of, int64_t values, const Trial& first, fhash_error& failed)
        : scaled(of), most(values), begin(first), error(failed), windows(cut(first.draft.form)) {}

    // Windows that are as long as the tile where a form has a basis, which is for all of an axis.
    Windows cut(const Form& form) const {
        const Task& task = scaled.task;
        int axes = 0;
        for (size_t a = 0; a < 4; a++) axes |= form.bases[a].empty() << a;
        const int64_t each = task.size() <= most ? most : most / PARTS;
        return {task, scaled.parts(shortened(task.shape, each, axes, 1), most)};
    }

    bool take(const Draft& draft, double weight, Trial& best) const {
        Trial trial = begin;
        trial.draft = draft;
        trial.coding.weight = weight;
        if (!trial.run(scaled.task, windows, error)) return false;
        if (best.bytes == 0 || trial.bytes < best.bytes) best = std::move(trial);
        return true;
    }

    // The best of some predictors, or the first one if a transform takes far fewer bytes.
    bool predict(const Trial& rival, Trial& best) const {
        const Task& task = scaled.task;
        const Draft& draft = begin.draft;
        for (const int* order : ORDERS) {
            if (!take(predicted(task, draft, order, REFINED[0]), WEIGHT, best)) return false;
            if (best.bytes > FAR * rival.bytes) return true;
        }
        const int* const order = best.draft.form.order;
        return task.shape[0] < 2 ||
               take(predicted(task, draft, order, REFINED[1]), WEIGHT, best);
    }

    // The transform that is planned, beside the usual one. Prices know the mean error: a basis may
    // leave a thin front to the residual. Where it is not better, one without bases is planned.
    bool transform(Trial& best, Trial& foretold) {
        for (const bool bases : {true, false}) {
            Draft draft = begin.draft;
            draft.form = {};
            if (!plan(scaled, most, bases, draft.form, error)) return false;
            const Shape before = windows.shape;
            windows = cut(draft.form);
            if (windows.shape != before) {
                if (!best.run(scaled.task, windows, error)) return false;
                if (foretold.bytes > 0 && !foretold.run(scaled.task, windows, error)) return false;
            }
            const double usual = best.bytes;
            const auto& of = draft.form.bases;
            if (!take(draft, WEIGHT, best)) return false;
            if (best.bytes < usual ||
                std::all_of(of.begin(), of.end(), [](const Buffer& one) { return one.empty(); }))
                break;
        }
        return true;
    }

    // Other steps and the trellis: a residual that no price knows competes with the step.
    bool refine(Trial& best) const {
        for (const double ratio : OTHER_RATIOS) {
            Draft draft = best.draft;
            const double before = best.bytes;
            draft.step = ratio * scaled.task.reach;
            if (!take(draft, WEIGHT, best)) return false;
            if (best.bytes < before) break;  // then a finer step is not better, too
        }
        Draft draft = best.draft;
        draft.trellis = true;
        draft.step *= TRELLIS_SHARE;
        // Steps so fine come near the finest one of the trellis.
        return draft.real64 || take(draft, TRELLIS_WEIGHT, best);
    }
};

// The trial that takes the fewest bytes under a bound. `best` has the usual transform, or a given
// one, which no other may replace.
bool best_trial(const Scaled& scaled, int64_t most, Trial& best, fhash_error& error) {
    const Task& task = scaled.task;
    const bool given = task.quality.transform_given;
    Trials trials(scaled, most, best, error);
    Trial foretold = best;
    if (!trials.take(trials.begin.draft, WEIGHT, best)) return false;
    if (!given && task.half_range() / (2 * task.reach) < MAX_FORETOLD &&
        !trials.predict(best, foretold))
        return false;
    const auto beats = [&](double factor) {
        return foretold.bytes > 0 && factor * foretold.bytes <= best.bytes;
    };
    if (!beats(FAR)) {
        if (!given && !trials.transform(best, foretold)) return false;
        if (!beats(CLOSE) && !trials.refine(best)) return false;
    }
    if (beats(1)) best = std::move(foretold);
    return true;
}

// Whether float32 would lose what the step keeps.
bool needs_real64(const Task& task, double step) {
    const double largest = task.largest(), span = 2 * task.half_range();
    if (std::max(largest, step) > MAX_SINGLE || step < MIN_SINGLE) return true;
    return fhash_type_size(task.type) >= 4 &&
           (span / step > 1 << 18 || (task.type != FHASH_FLOAT32 && largest / step > 1 << 20));
}

// The tile coded by transform or predictor; false without an error where that cannot be.
bool transformed(const Task& task, Coded& coded, fhash_error& error) {
    const int effort = task.quality.effort;
    const double given = task.quality.step;
    const double step = given > 0 ? given : FIRST_RATIO * task.reach;
    const bool too_fine = task.error >= 0 && task.reach < task.error / 2;
    const bool in_range = step >= MIN_STEP && task.largest() <= MAX_VALUE &&
                          task.half_range() / step < MAX_STEPS;
    if (too_fine || !in_range) return false;
    Trial trial;
    trial.draft = {{}, step, typical(task), task.low, task.high,
                   task.error < 0 ? 0.0 : 2 * task.reach * QUANTUM_SHARE, needs_real64(task, step),
                   true, false, task.origin, task.whole_low, task.whole_high};
    trial.coding = {WEIGHT, task.error, 0, 0, 0, effort < 3 ? 1 : 2, 0, 1, 1, 1, 0};
    const Scaled scaled(task, trial.draft);
    const int64_t most = effort > 1 ? TRIED << 2 * (effort - 2) : 0;
    Form& form = trial.draft.form;
    const bool bounded = task.error >= 0, priced = !bounded && !task.quality.transform_given;
    if (task.quality.transform_given) std::copy_n(task.quality.transform, 4, form.axes);
    else if (!plan(scaled, priced ? most : 0, priced, form, error)) return false;
    if (bounded && effort > 1 && !best_trial(scaled, most, trial, error)) return false;
    const auto settings = trial.draft.settings(task.context, task.shape, error);
    if (!settings) return false;
    const Norms norms = norms_of(task.context, settings->axes, task.shape);
    const double gain = *std::max_element(norms.tz.begin(), norms.tz.end()) *
                        *std::max_element(norms.yx.begin(), norms.yx.end());
    if (2 * task.half_range() / trial.draft.step * gain > MAX_STEPS) return false;
    if (!trial.whole && !trial.run(task, error)) return false;
    coded = std::move(trial.coded);
    return true;
}

// A tile whose values all decode to one value, but for marked ones.
bool constant(const Task& task, double center, const Wide& origin, Coded& coded,
              fhash_error& error) {
    const int64_t whole = origin.zero() ? 0 : (int64_t)center;
    const Draft draft = {{}, 1.0, center, center, center, 0, true, false, false, origin,
                         whole, whole};
    const auto settings = draft.settings(task.context, task.shape, error);
    const fhash_coding coding = {0, -1, 0, 0, 0, 1, 0, 1, 1, 1, 0};
    const std::vector<uint8_t> nothing((size_t)task.size(), 0);
    return settings && encode_tile(task.context, settings, task.shape, task.type, task.values,
                                   nothing.data(), task.marks, coding, coded, error);
}

bool exactly(const Task& task, Coded& coded, fhash_error& error) {
    return encode_exact(nullptr, task.shape, task.type, task.values, nullptr, coded, error);
}

// The tile as a constant, if all values are equal or the bound allows it. done: whether it is
// coded.
bool encode_constant(const Task& task, Coded& coded, bool& done, fhash_error& error) {
    done = false;
    const bool equal = task.high == task.low;
    if (!equal && (task.error < 0 || task.half_range() > task.reach)) return true;
    if (!constant(task, task.center(), task.origin, coded, error)) return false;
    // A lossless zero keeps its sign, and a constant has one sign only.
    const bool sign = task.error == 0 && task.low == 0 && task.signed_zero;
    done = !sign && with_type(task.type, [&](auto value) {
        using O = decltype(value);
        std::vector<uint8_t> counted;
        for (const uint16_t mark : task.marks.of) counted.push_back(mark == 0);
        return is_within((const O*)(const void*)task.values,
                         (const O*)(const void*)coded.decoded.data(),
                         counted.empty() ? nullptr : counted.data(), task.size(),
                         std::max(task.error, 0.0));
    });
    if (done || !equal) return true;
    done = true;
    return exactly(task, coded, error);
}

// Whether many values equal the one before along one of the axes.
template <class O> bool has_regions(const O* values, const Shape& shape) {
    const int64_t n = vertices(shape);
    const int64_t strides[4] = {shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3], 1};
    int64_t equal = 0;
    for (int64_t i = 0; i < n; i++)
        for (int a = 0; a < 4; a++)
            if (i / strides[a] % shape[(size_t)a] &&
                real(values[i]) == real(values[i - strides[a]])) {
                equal++;
                break;
            }
    return (double)equal / (double)n >= REGION_SHARE;
}

bool encode_task(const Task& task, Coded& coded, fhash_error& error) {
    bool done;
    if (!encode_constant(task, coded, done, error)) return false;
    if (done) return true;
    Coded exact, labelled, other;
    bool has_labels = false;
    if (task.lossless()) {
        const bool regions = with_type(task.type, [&](auto value) {
            return has_regions((const decltype(value)*)(const void*)task.values, task.shape);
        });
        has_labels = encode_labelled(nullptr, task.shape, task.type, task.values, nullptr,
                                     regions ? MAX_LABELS : FEW_LABELS, labelled, error);
        if (!has_labels && error.status != FHASH_OK) return false;
        if (has_labels) {
            if (!exactly(task, exact, error)) return false;
            if (CLEARLY * labelled.data.size() < exact.data.size()) {
                coded = std::move(labelled);
                return true;
            }
        }
    }
    const bool has_other = transformed(task, other, error);
    if (!has_other && error.status != FHASH_OK) return false;
    const auto small = [&](bool there, const Coded& one) {
        return there && 2 * one.data.size() < task.bytes();
    };
    coded.data.clear();
    if (!small(has_other, other) && !small(has_labels, labelled) &&
        !exactly(task, coded, error))
        return false;
    const auto take = [&](bool there, Coded& one) {
        if (there && (coded.data.empty() || one.data.size() < coded.data.size()))
            coded = std::move(one);
    };
    take(has_other, other);
    take(has_labels, labelled);
    return true;
}

bool check_quality(const fhash_quality* quality, fhash_error& error) {
    if (!quality) return fail(error, FHASH_ERROR_ARGUMENT, "no quality is given");
    const int given =
        (quality->max_error >= 0) + (quality->max_error_rel > 0) + (quality->step > 0);
    const bool finite = std::isfinite(quality->max_error) && std::isfinite(quality->step) &&
                        std::isfinite(quality->max_error_rel);
    if (given != 1 || !finite || quality->max_error_rel < 0 || quality->step < 0)
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "one of max_error (from 0 on), max_error_rel and step (above 0) is needed");
    if (quality->effort < 1 || quality->effort > MAX_EFFORT)
        return fail(error, FHASH_ERROR_ARGUMENT, "effort is 1 to %d, not %d", MAX_EFFORT,
                    quality->effort);
    for (int a = 0; quality->transform_given && a < 4; a++) {
        const int kind = quality->transform[a] >> 4, depth = quality->transform[a] & 15;
        if (kind > DAUBECHIES_KIND || depth > 10 || (kind == 0) != (depth == 0))
            return fail(error, FHASH_ERROR_ARGUMENT, "a transform is none, or a wavelet's levels");
    }
    return true;
}

}  // namespace

bool encode_quality(fhash_context& context, const fhash_tile* tile, const void* values,
                    const fhash_quality* quality, const void* missing, Coded& coded,
                    fhash_error& error) {
    if (!tile || !values || !is_shape(tile->shape) || !fhash_type_size(tile->type) ||
        tile->settings)
        return fail(error, FHASH_ERROR_ARGUMENT,
                    "a tile to encode has values, a type, four lengths, and no settings");
    if (!check_quality(quality, error)) return false;
    const int32_t count = missing ? std::max(quality->missing, 1) : 0;
    if (quality->missing < 0 || count > MAX_MISSING)
        return fail(error, FHASH_ERROR_ARGUMENT, "%d missing values; at most %d are possible",
                    quality->missing, MAX_MISSING);
    Task task = {context, {}, tile->type, (const uint8_t*)values, *quality, {}, {}, 0, 0, 0, 0,
                 {0, 0}, -1, 0, false};
    std::copy_n(tile->shape, 4, task.shape.begin());
    if (!may_use(context, 96 * (uint64_t)task.size(), error)) return false;
    bool kept = true;
    const bool any = with_type(tile->type, [&](auto value) {
        const auto* const all = (const decltype(value)*)values;
        kept = mark_all(task, all, missing, (size_t)count);
        return kept && survey(task, all);
    });
    if (!kept) return exactly(task, coded, error);
    if (!any) return constant(task, 0.0, {}, coded, error);
    set_bound(task);
    return encode_task(task, coded, error);
}

}  // namespace fhash

using namespace fhash;

size_t fhash_tile_bound(const fhash_tile* tile) {
    if (!tile || !is_shape(tile->shape)) return 0;
    const size_t bytes = (size_t)(tile->shape[0] * tile->shape[1] * tile->shape[2] *
                                  tile->shape[3]) * fhash_type_size(tile->type);
    return bytes + bytes / 64 + 4096;  // that of an exact stream is the largest
}

int32_t fhash_tile_encode(fhash_context* context, const fhash_tile* tile, const void* values,
                          const fhash_quality* quality, const void* missing, void* stream,
                          size_t room, size_t* size, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        Coded coded;
        if (!context || !size)
            return fail(failed, FHASH_ERROR_ARGUMENT, "a context and a size are needed");
        if (!encode_quality(*context, tile, values, quality, missing, coded, failed)) return false;
        *size = coded.data.size();
        if (*size > room || !stream)
            return fail(failed, FHASH_ERROR_SIZE, "the stream has %zu bytes, the room %zu", *size,
                        room);
        std::memcpy(stream, coded.data.data(), *size);
        return true;
    });
}

int32_t fhash_tile_code(fhash_context* context, const fhash_tile* tile, const void* values,
                        const uint8_t* in_coreset, const fhash_coding* coding, void* decoded,
                        uint8_t** data, size_t* size, int64_t* nonzero, fhash_error* error) {
    return reported(error, [&](fhash_error& failed) {
        if (!context || !tile || !values || !coding || !data || !size || !nonzero)
            return fail(failed, FHASH_ERROR_ARGUMENT, "a context, a tile, its values, options and "
                                                      "room for the results are needed");
        const bool sound = coding->weight >= 0 && std::isfinite(coding->weight);
        if (!is_shape(tile->shape) || !fhash_type_size(tile->type) || !sound)
            return fail(failed, FHASH_ERROR_ARGUMENT,
                        "a tile has four lengths and a type, and a bit a weight from 0 on");
        Shape shape;
        std::copy_n(tile->shape, 4, shape.begin());
        if (!may_use(*context, 96 * (uint64_t)vertices(shape), failed)) return false;
        Coded coded;
        if (tile->settings) {
            const auto settings = unpack_settings(*context, (const uint8_t*)tile->settings,
                                                  tile->settings_size, failed);
            Marks marks;
            mark_not_finite(values, tile->type, vertices(shape), false, marks);
            if (!settings || !encode_tile(*context, settings, shape, tile->type, values,
                                          in_coreset, marks, *coding, coded, failed))
                return false;
        } else if (!encode_exact(nullptr, shape, tile->type, values, in_coreset, coded, failed)) {
            return false;
        }
        *data = (uint8_t*)std::malloc(coded.data.size());
        if (!*data) return fail(failed, FHASH_ERROR_MEMORY, "no memory for a stream");
        std::memcpy(*data, coded.data.data(), coded.data.size());
        *size = coded.data.size();
        *nonzero = coded.nonzero;
        if (decoded) std::memcpy(decoded, coded.decoded.data(), coded.decoded.size());
        return true;
    });
}

int32_t fhash_tile_free(uint8_t* data) {
    std::free(data);
    return 0;
}
