// Encoding of a tile to its stream: by transform or prediction, as labels, or without loss.
#include "encode.hpp"

#include "inflate.hpp"
#include "kernels.hpp"
#include "memory.hpp"
#include "numbers.hpp"
#include "priors.hpp"

namespace fhash {
namespace {

constexpr int MAX_LABELS = 65536;
constexpr double END_MARGIN = 1e-4;  // share of the range from an end that counts as the end
constexpr double FEW = 0.03;  // share of values that must be free to change, to be worth the time
constexpr double MAX_PREDICTED = 1 << 27;

using Mask = std::vector<uint8_t>;  // a byte for each vertex; empty where all count

// Bytes of values: those of equal weight together, lowest first, deflated.
bool pack_planes(const void* values, int64_t n, size_t width, Buffer& out, fhash_error& error) {
    Buffer planes((size_t)n * width);
    const uint8_t* const bytes = (const uint8_t*)values;
    for (size_t byte = 0; byte < width; byte++) {
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
        const size_t place = width - 1 - byte;
#else
        const size_t place = byte;
#endif
        uint8_t* const plane = planes.data() + byte * (size_t)n;
        for (int64_t i = 0; i < n; i++) plane[i] = bytes[(size_t)i * width + place];
    }
    return deflate_level6(planes.data(), planes.size(), out) ||
           fail(error, FHASH_ERROR_MEMORY, "no memory to deflate a tile");
}

bool code_labels(std::vector<uint16_t>& labels, int64_t count, const Shape& shape, Buffer& out,
                 fhash_error& error) {
    return with_room((int64_t)labels.size() / 8, out, error, [&](uint8_t* data, int64_t capacity) {
        return fhash_encode_labels(labels.data(), count, shape.data(), data, capacity);
    });
}

// The section of a mask by two levels of each vertex; empty where all are occupied.
bool pack_mask(const Mask& occupied, const Shape& shape, const Mask& first, const Mask& second,
               Buffer& out, fhash_error& error) {
    out.clear();
    if (std::find(occupied.begin(), occupied.end(), 0) == occupied.end()) return true;
    const State& prior = mask_prior();
    const auto encode = [&](uint8_t* data, int64_t capacity) {
        return fhash_encode_mask(occupied.data(), first.data(), second.data(), shape.data(),
                                 const_cast<uint16_t*>(prior.slots.data()), prior.slot_count(),
                                 const_cast<int32_t*>(prior.weights.data()),
                                 (int64_t)prior.weights.size(),
                                 const_cast<uint16_t*>(prior.simples.data()), prior.simple_count(),
                                 0, data, capacity);
    };
    if (!with_room((int64_t)occupied.size() / 8, out, error, encode)) return false;
    // The decoder reads zeros past the end, so one zero stands for an empty code.
    if (out.empty()) out.push_back(0);
    return true;
}

// A tile to code, and what is known of it before.
struct Task {
    fhash_context& context;
    const Settings& settings;
    const Shape& shape;
    int32_t type;
    const uint8_t* values;
    const fhash_coding& coding;
    const Marks& marks;
    Mask finite, counted;  // finite: not marked
    Buffer missing;        // section of missing values

    int64_t size() const { return vertices(shape); }
    size_t bytes() const { return (size_t)size() * fhash_type_size(type); }
    const Settings* own() const { return coding.own_settings ? &settings : nullptr; }
    const uint8_t* counts() const { return counted.empty() ? nullptr : counted.data(); }
    // The mask of the stream; empty for a stream without one.
    Mask occupied() const {
        if (!settings.mask) return {};
        return counted.empty() ? Mask((size_t)size(), 1) : counted;
    }
    template <class Work> bool typed(Work work) const {
        return with_type(type, [&](auto value) {
            return work((const decltype(value)*)(const void*)values);
        });
    }
};

// Sections of a stream and their flags.
struct Sections {
    int flags;
    std::vector<Buffer> all;

    Sections(int kind, const Settings* own, bool masked) : flags(kind | (masked ? MASKED : 0)) {
        if (!own) return;
        flags |= OWN;
        all.push_back(own->packed);
    }
    void add(int flag, Buffer section) {
        flags |= flag;
        all.push_back(std::move(section));
    }
};

// What a decoder puts where no vertex is occupied.
void finish(const Task& task, Coded& coded) {
    const Mask occupied = task.occupied();
    if (occupied.empty()) return;
    with_type(task.type, [&](auto value) {
        blank((decltype(value)*)(void*)coded.decoded.data(), task.size(), occupied.data(),
              task.settings.center);
        return true;
    });
}

bool keeps_bound(const Task& task, const Coded& coded) {
    return task.typed([&](auto* values) {
        const auto* const decoded = (decltype(values))(const void*)coded.decoded.data();
        return is_within(values, decoded, task.counts(), task.size(), task.coding.error);
    });
}

bool encode_empty(const Task& task, Coded& coded) {
    const bool masked = task.settings.mask != nullptr;
    Sections sections(EMPTY, task.own(), masked);
    if (!task.missing.empty()) sections.add(MISSING, task.missing);
    coded.data = sealed(sections.flags, sections.all);
    make_room(coded.decoded, task.bytes());
    with_type(task.type, [&](auto value) {
        using O = decltype(value);
        std::fill_n((O*)(void*)coded.decoded.data(), task.size(), cast<O>(task.settings.center));
        return true;
    });
    finish(task, coded);
    return true;
}

bool encode_task_exactly(const Task& task, Coded& coded, fhash_error& error) {
    const Mask occupied = task.occupied();
    coded.nonzero = 0;
    return encode_exact(task.own(), task.shape, task.type, task.values,
                        occupied.empty() ? nullptr : occupied.data(), coded, error);
}

// The section of the mask, from decoded values before head and residual.
template <class T, class L>
bool mask_section(const Task& task, const L* linear, Buffer& out, fhash_error& error) {
    Mask first((size_t)task.size()), second((size_t)task.size());
    if (!levels_of_mask<T>(*task.settings.mask, task.shape, linear, first.data(), second.data(),
                           error))
        return false;
    return pack_mask(task.occupied(), task.shape, first, second, out, error);
}

// Integers nearest to values; false where one would be too large.
bool foretold_integers(const Task& task, const Predictor& predictor,
                       std::vector<int32_t>& integers) {
    integers.resize((size_t)task.size());
    return task.typed([&](auto* values) {
        for (int64_t i = 0; i < task.size(); i++) {
            double nearest =
                std::nearbyint((real(values[i]) - predictor.origin) / predictor.step);
            if (task.counts() && !task.counts()[i]) nearest = 0;
            if (!(std::fabs(nearest) <= MAX_PREDICTED)) return false;
            integers[(size_t)i] = (int32_t)nearest;
        }
        return true;
    });
}

bool encode_foretold(const Task& task, Coded& coded, fhash_error& error) {
    const Settings& settings = task.settings;
    const Predictor& predictor = *settings.predictor;
    std::vector<int32_t> integers;
    if (!foretold_integers(task, predictor, integers))
        return encode_task_exactly(task, coded, error);
    Buffer body;
    if (!encode_predicted(predictor, task.shape, task.counts(), integers, body, error))
        return false;
    const std::vector<double> linear = foretold_values(settings, integers);
    make_room(coded.decoded, task.bytes());
    correct_within(settings, task.type, linear.data(), {}, task.size(), coded.decoded.data());
    if (!keeps_bound(task, coded)) return encode_task_exactly(task, coded, error);
    Sections sections(PREDICTED, task.own(), settings.mask != nullptr);
    if (!task.missing.empty()) sections.add(MISSING, task.missing);
    sections.add(0, std::move(body));
    Buffer mask;
    if (settings.mask) {
        if (!(settings.real64 ? mask_section<double>(task, linear.data(), mask, error)
                              : mask_section<float>(task, linear.data(), mask, error)))
            return false;
        sections.add(0, std::move(mask));
    }
    coded.nonzero = (int64_t)integers.size() - std::count(integers.begin(), integers.end(), 0);
    coded.data = sealed(sections.flags, sections.all);
    finish(task, coded);
    return true;
}

// The values to transform: about the centre, in the working type, filled where not counted.
template <class T>
bool make_target(const Task& task, const Search<T>& search, std::vector<T>& target,
                 fhash_error& error) {
    const Settings& settings = task.settings;
    make_room(target, (size_t)task.size());
    task.typed([&](auto* values) {
        for (int64_t i = 0; i < task.size(); i++) {
            const bool there = task.finite.empty() || task.finite[(size_t)i];
            target[(size_t)i] = (there ? (T)real(values[i]) : (T)0) - (T)settings.center;
        }
        return true;
    });
    if (task.counted.empty()) return true;
    if (!(task.coding.filled && task.finite.empty())) {
        const Mask all((size_t)(task.finite.empty() ? task.size() : 0), 1);
        const uint8_t* const present = task.finite.empty() ? all.data() : task.finite.data();
        if (!fill_uncounted(search, task.counts(), present, task.coding.density, target, error))
            return false;
    }
    if (settings.axes[0].kind == NONE_KIND) {
        // No step helps another: those beyond the end of a series take the fewest bytes as zeros.
        const int64_t frame = task.size() / task.shape[0];
        int64_t end = task.size();
        while (end > 0 && !task.counted[(size_t)end - 1]) end--;
        const int64_t steps = (end + frame - 1) / frame;
        std::fill(target.begin() + steps * frame, target.end(), (T)0);
    }
    return true;
}

// How far the ends of the range are apart.
double width_of(const Settings& settings) {
    if (!settings.whole) return settings.high - settings.low;
    return (double)((uint64_t)settings.whole_high - (uint64_t)settings.whole_low);
}

// The coefficients after replacements of values that are free: those that do not count, and those
// at an end of the range that decode to values beyond it, since the decoder clips them.
//
// aim: receives the squared error that is aimed at, if any is, by the coefficients as they were.
template <class T>
bool free_coefficients(const Task& task, const Search<T>& search, std::vector<T>& target,
                       std::vector<T>& coefficients, double& aim, fhash_error& error) {
    const Settings& settings = task.settings;
    const fhash_coding& coding = task.coding;
    const double margin = width_of(settings) * END_MARGIN;
    const double low = settings.low - settings.center + margin;
    const double high = settings.high - settings.center - margin;
    const int64_t n = task.size();
    make_room(coefficients, (size_t)n);
    const auto transform = [&] {
        return kernel_done(search.forward->transform(target.data(), coefficients.data()),
                           "a transform", error);
    };
    if (!transform()) return false;
    if (coding.aim > 0) aim = coding.aim * predicted_error(coefficients, settings.step);
    if (coding.rounds == 0) return true;
    int64_t free = 0;
    for (int64_t i = 0; i < n; i++)
        free += target[(size_t)i] <= (T)low || target[(size_t)i] >= (T)high ||
                (task.counts() && !task.counts()[i]);
    const double few = FEW * (double)n;
    if ((double)free <= few) return true;
    double shifts[OFFSET_COUNT];
    for (int i = 0; i < OFFSET_COUNT; i++)
        shifts[i] = settings.offsets[i] / OFFSET_UNIT;
    const double step = settings.step;
    std::vector<int32_t> integers;
    std::vector<T> rebuilt, dequantised;
    make_room(integers, (size_t)n);
    make_room(rebuilt, (size_t)n);
    make_room(dequantised, (size_t)n);
    for (int round = 0; round < coding.rounds; round++) {
        std::vector<T> chosen = coefficients;
        if (!choose_integers(search, chosen, coding, 1, nullptr, integers, error))
            return error.status == FHASH_OK;
        chosen = {};
        dequantise(integers.data(), n, step, shifts, dequantised.data());
        if (!kernel_done(search.inverse->invert(dequantised.data(), rebuilt.data()), "a transform",
                         error))
            return false;
        const int64_t freed =
            free_values(target.data(), rebuilt.data(), task.counts(), n, low, high);
        if (!freed) break;
        if (!transform()) return false;
        if ((double)freed < few) break;
    }
    return true;
}

// Leaves to the head what it adds to the values as they would decode: the target becomes the values
// less its correction, and takes fewer bits.
bool leave_to_head(const Task& task, const Search<float>& search, std::vector<float>& target,
                   std::vector<float>& coefficients, fhash_error& error) {
    const Settings& settings = task.settings;
    Buffer unused;
    std::vector<int32_t> integers;
    // The fast coder chooses integers as it codes them, faster than the trellis of the other one.
    const bool chosen =
        task.coding.fast
            ? code_coefficients(search, coefficients, task.coding, nullptr, unused, integers, error)
            : choose_integers(search, coefficients, task.coding, 1, nullptr, integers, error);
    if (!chosen) return false;
    std::vector<float>& table = coefficients;  // which are not needed any more
    if (!linear_values(settings, *search.inverse, integers.data(), table.data(), error))
        return false;
    integers = {};
    std::vector<float> corrected(target.size());
    if (!apply_head(task.context, *settings.head, table.data(), task.shape, corrected.data(),
                    error))
        return false;
    const float part = (float)task.coding.joint;
    for (size_t i = 0; i < target.size(); i++)
        if (task.counted.empty() || task.counted[i]) target[i] -= part * (corrected[i] - table[i]);
    corrected = {};
    return kernel_done(search.forward->transform(target.data(), coefficients.data()),
                       "a transform", error);
}

// The residual, in quanta; false without an error where an integer would be too large. Empty where
// it is 0 everywhere.
template <class T>
bool make_residual(const Task& task, const T* base, std::vector<int32_t>& residual) {
    const int64_t n = task.size();
    make_room(residual, (size_t)n);
    int64_t nonzero = 0;
    task.typed([&](auto* values) {
        using V = std::remove_cv_t<std::remove_pointer_t<decltype(values)>>;
        const auto find = [&](const auto* of) {
            nonzero = residual_of(of, base, task.counts(), n, task.settings.quantum, MAX_INTEGER,
                                  residual.data());
        };
        if constexpr (std::is_floating_point<V>::value) {
            find(values);
        } else {
            std::vector<double> wide((size_t)n);
            for (int64_t i = 0; i < n; i++) wide[(size_t)i] = real(values[i]);
            find(wide.data());
        }
        return true;
    });
    if (!nonzero) residual.clear();
    return nonzero >= 0;
}

// The squared error of the values that count.
template <class T> double squared_error(const Task& task, const T* decoded) {
    double sum = 0;
    task.typed([&](auto* values) {
        double lanes[8] = {0, 0, 0, 0, 0, 0, 0, 0};
        const uint8_t* const counts = task.counts();
        for (int64_t i = 0; i < task.size(); i++) {
            const double off = counts && !counts[i] ? 0 : real(values[i]) - (double)decoded[i];
            lanes[i % 8] += off * off;
        }
        for (const double lane : lanes) sum += lane;
        return true;
    });
    return sum;
}

// The cut that is asked for, or one that pays; none where it makes one block.
template <class T>
bool find_cut(const Task& task, const std::vector<T>& coefficients, Cut& cut, fhash_error& error) {
    const Settings& settings = task.settings;
    const int32_t given = task.coding.cut;
    if (given) for (size_t a = 0; a < 4; a++) cut[a] = given >> 4 * a & 15;
    else cut = choose_cut(settings, task.shape, task.coding.fast != 0, coefficients);
    const size_t count = count_blocks(task.shape, cut);
    if (count < 2) cut = {};
    return (fits(cut, settings.axes) && count <= MAX_BLOCKS) ||
           fail(error, FHASH_ERROR_ARGUMENT,
                "blocks are cut where the transform is not, or are more than %zu", MAX_BLOCKS);
}

bool code_residual(const Task& task, const Cut& cut, std::vector<int32_t>& residual, Buffer& rest,
                   fhash_error& error) {
    const bool fast = task.coding.fast != 0;
    if (is_cut(cut))
        return encode_in_blocks(residual, task.shape, cut, fast, task.context.threads, rest, error);
    return encode_integers(residual, task.shape, single_band(task.shape), {false, fast, nullptr, 0},
                           rest, error);
}

// The stream of a transformed tile; false without an error where it has to be stored exactly.
template <class T>
bool transformed(const Task& task, Coded& coded, fhash_error& error) {
    const Settings& settings = task.settings;
    std::shared_ptr<Search<T>> search;
    std::vector<T> target, coefficients;
    Aim aim = {0, {}};
    if (!make_search(task.context, settings, task.shape, search, error) ||
        !make_target(task, *search, target, error) ||
        !free_coefficients(task, *search, target, coefficients, aim.squares, error))
        return false;
    if constexpr (std::is_same<T, float>::value) {
        if (settings.head && task.coding.joint > 0 &&
            !leave_to_head(task, *search, target, coefficients, error))
            return false;
    }
    Buffer body, rest, mask;
    std::vector<int32_t> integers, residual;
    std::vector<T>& linear = target;
    aim.measure = [&](std::vector<int32_t>& of) {
        return linear_values(settings, *search->inverse, of.data(), linear.data(), error)
                   ? squared_error(task, linear.data())
                   : -1;
    };
    Cut cut;
    if (!find_cut(task, coefficients, cut, error)) return false;
    const Aim* const aims = aim.squares > 0 ? &aim : nullptr;
    if (!(is_cut(cut) ? code_blocks(*search, cut, coefficients, task.coding, aims, body, integers,
                                    error)
                      : code_coefficients(*search, coefficients, task.coding, aims, body, integers,
                                          error)))
        return false;
    coded.nonzero = (int64_t)integers.size() - std::count(integers.begin(), integers.end(), 0);
    coefficients = {};
    if (!linear_values(settings, *search->inverse, integers.data(), linear.data(), error))
        return false;
    integers = {};
    if (settings.mask && !mask_section<T>(task, linear.data(), mask, error)) return false;
    if constexpr (std::is_same<T, float>::value) {
        if (settings.head) {
            coefficients = linear;
            if (!apply_head(task.context, *settings.head, coefficients.data(), task.shape,
                            linear.data(), error))
                return false;
        }
    }
    const bool bound = task.coding.error >= 0;
    if (bound && !make_residual(task, linear.data(), residual)) return false;
    make_room(coded.decoded, task.bytes());
    correct_within(settings, task.type, linear.data(), residual, task.size(),
                   coded.decoded.data());
    if (bound && !keeps_bound(task, coded)) return false;
    Sections sections(is_cut(cut) ? BLOCKS : TRANSFORMED, task.own(), settings.mask != nullptr);
    if (task.coding.fast) sections.flags |= FAST;
    if (!task.missing.empty()) sections.add(MISSING, task.missing);
    sections.add(0, std::move(body));
    if (!residual.empty()) {
        if (!code_residual(task, cut, residual, rest, error)) return false;
        sections.add(RESIDUAL, std::move(rest));
    }
    if (settings.mask) sections.add(0, std::move(mask));
    coded.data = sealed(sections.flags, sections.all);
    finish(task, coded);
    return true;
}

bool encode_transformed(const Task& task, Coded& coded, fhash_error& error) {
    const bool done = task.settings.real64 ? transformed<double>(task, coded, error)
                                           : transformed<float>(task, coded, error);
    if (done || error.status != FHASH_OK) return done;
    return encode_task_exactly(task, coded, error);
}

// Which values are not marked, which of them count, and the section of those that are.
bool survey(Task& task, const uint8_t* in_coreset, fhash_error& error) {
    const int64_t n = task.size();
    for (const uint16_t mark : task.marks.of) task.finite.push_back(mark == 0);
    task.counted = task.finite;
    if (in_coreset) {
        if (task.counted.empty()) task.counted.assign((size_t)n, 1);
        for (int64_t i = 0; i < n; i++) task.counted[(size_t)i] &= in_coreset[i] != 0;
    }
    if (std::find(task.counted.begin(), task.counted.end(), 0) == task.counted.end())
        task.counted.clear();
    if (task.marks.of.empty() || !task.coding.keep_missing) return true;
    const size_t width = fhash_type_size(task.type);
    std::vector<uint16_t> labels = task.marks.of;
    Buffer coded;
    if (!code_labels(labels, (int64_t)task.marks.values.size() + 1, task.shape, coded, error))
        return false;
    task.missing.push_back((uint8_t)task.marks.values.size());
    for (const uint64_t value : task.marks.values)
        for (size_t byte = 0; byte < width; byte++)
            task.missing.push_back((uint8_t)(value >> 8 * byte));
    task.missing.insert(task.missing.end(), coded.begin(), coded.end());
    return true;
}

bool encode_about_origin(Task& task, const uint8_t* in_coreset, Coded& coded, fhash_error& error) {
    if (!survey(task, in_coreset, error)) return false;
    const auto& counted = task.counted;
    if (!counted.empty() && std::find(counted.begin(), counted.end(), 1) == counted.end())
        return encode_empty(task, coded);
    std::vector<Coded> others;
    if (task.settings.labels) {
        const Mask occupied = task.occupied();
        Coded labelled, exact;
        const bool few = encode_labelled(task.own(), task.shape, task.type, task.values,
                                         occupied.empty() ? nullptr : occupied.data(), MAX_LABELS,
                                         labelled, error);
        if (!few && error.status != FHASH_OK) return false;
        if (few) {
            with_type(task.type, [&](auto value) {
                auto* const decoded = (decltype(value)*)(void*)labelled.decoded.data();
                if (!occupied.empty())
                    blank(decoded, task.size(), occupied.data(), task.settings.center);
                return true;
            });
            if (!encode_task_exactly(task, exact, error)) return false;
            const bool clear = 4 * labelled.data.size() < exact.data.size();
            others.push_back(std::move(labelled));
            if (clear) {  // nothing else is that small
                coded = std::move(others[0]);
                return true;
            }
            others.push_back(std::move(exact));
        }
    }
    const bool foretold = task.settings.predictor && task.coding.error >= 0;
    if (!(foretold ? encode_foretold(task, coded, error) : encode_transformed(task, coded, error)))
        return false;
    for (Coded& other : others)
        if (other.data.size() < coded.data.size()) coded = std::move(other);
    return true;
}

}  // namespace

bool encode_predicted(const Predictor& predictor, const Shape& shape, const uint8_t* counted,
                      std::vector<int32_t>& integers, Buffer& out, fhash_error& error) {
    const State& prior = predictor_prior();
    const std::vector<int32_t> given = integers;
    const auto encode = [&](uint8_t* data, int64_t capacity) {
        integers = given;
        return fhash_encode_predicted(
            integers.data(), counted, shape.data(), predictor.levels.data(),
            predictor.passes.data(), (int64_t)predictor.passes.size() / 4, predictor.taps.data(),
            predictor.weights.data(), prior.slots.data(), prior.slot_count(), prior.weights.data(),
            (int64_t)prior.weights.size(), prior.simples.data(), prior.simple_count(), data,
            capacity);
    };
    return with_room(vertices(shape), out, error, encode);
}

Buffer sealed(int flags, const std::vector<Buffer>& sections) {
    Buffer data(4);
    data.push_back((uint8_t)flags);
    for (size_t i = 0; i < sections.size(); i++) {
        if (i + 1 < sections.size()) put_leb(data, sections[i].size());
        data.insert(data.end(), sections[i].begin(), sections[i].end());
    }
    const auto sum = (uint32_t)fhash_crc32c(data.data() + 4, (int64_t)data.size() - 4, 0, 0);
    for (int byte = 0; byte < 4; byte++) data[(size_t)byte] = (uint8_t)(sum >> 8 * byte);
    return data;
}

bool encode_exact(const Settings* settings, const Shape& shape, int32_t type, const void* values,
                  const uint8_t* occupied, Coded& coded, fhash_error& error) {
    const int64_t n = vertices(shape);
    const size_t width = fhash_type_size(type);
    const uint8_t* const bytes = (const uint8_t*)values;
    coded.decoded.assign(bytes, bytes + (size_t)n * width);
    if (occupied)
        with_type(type, [&](auto value) {
            blank((decltype(value)*)(void*)coded.decoded.data(), n, occupied, 0);
            return true;
        });
    Sections sections(EXACT, settings, occupied != nullptr);
    Buffer body, mask;
    if (!pack_planes(coded.decoded.data(), n, width, body, error)) return false;
    sections.add(0, std::move(body));
    if (occupied) {
        const Mask nothing((size_t)n, 0), of(occupied, occupied + n);
        if (!pack_mask(of, shape, nothing, nothing, mask, error)) return false;
        sections.add(0, std::move(mask));
    }
    coded.data = sealed(sections.flags, sections.all);
    return true;
}

namespace {

// Whether a look at some of the values finds more than `most` different ones.
template <class W> bool surely_exceeds(const std::vector<W>& kept, int64_t most) {
    constexpr size_t LOOK = 4096;
    std::vector<W> some;
    for (size_t i = 0; i < kept.size(); i += std::max<size_t>(1, kept.size() / LOOK))
        some.push_back(kept[i]);
    std::sort(some.begin(), some.end());
    return std::unique(some.begin(), some.end()) - some.begin() > most;
}

template <class W>
bool labelled_as(const Settings* settings, const Shape& shape, const W* values,
                 const uint8_t* occupied, int64_t most, Coded& coded, fhash_error& error) {
    const int64_t n = vertices(shape);
    std::vector<W> palette;
    for (int64_t i = 0; i < n; i++)
        if (!occupied || occupied[i]) palette.push_back(values[i]);
    if (surely_exceeds(palette, most)) return false;
    std::sort(palette.begin(), palette.end());
    palette.erase(std::unique(palette.begin(), palette.end()), palette.end());
    const int64_t count = (int64_t)palette.size() + (occupied != nullptr);
    if (count > most) return false;
    std::vector<uint16_t> labels((size_t)n);
    for (int64_t i = 0; i < n; i++) {
        const auto at = std::lower_bound(palette.begin(), palette.end(), values[i]);
        const bool there = !occupied || occupied[i];
        labels[(size_t)i] = (uint16_t)(there ? at - palette.begin() : (int64_t)palette.size());
    }
    std::vector<W> steps = palette;
    for (size_t i = steps.size(); i-- > 1;) steps[i] = (W)(steps[i] - steps[i - 1]);
    Buffer packed, body, coded_labels;
    if (!pack_planes(steps.data(), (int64_t)steps.size(), sizeof(W), packed, error) ||
        !code_labels(labels, count, shape, coded_labels, error))
        return false;
    put_leb(body, palette.size());
    put_leb(body, packed.size());
    body.insert(body.end(), packed.begin(), packed.end());
    body.insert(body.end(), coded_labels.begin(), coded_labels.end());
    Sections sections(LABELS, settings, occupied != nullptr);
    sections.add(0, std::move(body));
    coded.data = sealed(sections.flags, sections.all);
    const uint8_t* const bytes = (const uint8_t*)values;
    coded.decoded.assign(bytes, bytes + (size_t)n * sizeof(W));
    coded.nonzero = 0;
    return true;
}

}  // namespace

bool encode_labelled(const Settings* settings, const Shape& shape, int32_t type, const void* values,
                     const uint8_t* occupied, int64_t most, Coded& coded, fhash_error& error) {
    switch (fhash_type_size(type)) {
        case 1:
            return labelled_as(settings, shape, (const uint8_t*)values, occupied, most, coded,
                               error);
        case 2:
            return labelled_as(settings, shape, (const uint16_t*)values, occupied, most, coded,
                               error);
        case 4:
            return labelled_as(settings, shape, (const uint32_t*)values, occupied, most, coded,
                               error);
        default:
            return labelled_as(settings, shape, (const uint64_t*)values, occupied, most, coded,
                               error);
    }
}

bool mark_not_finite(const void* values, int32_t type, int64_t n, bool every_nan, Marks& marks) {
    return with_type(type, [&](auto kind) {
        using O = decltype(kind);
        if constexpr (is_real<O>) {
            const O* const all = (const O*)values;
            const auto bits = [&](O value) {
                return bits_of(every_nan || std::isinf(real(value)) ? value : not_a_number<O>());
            };
            for (int64_t i = 0; i < n; i++)
                if (!std::isfinite(real(all[i])) && !mark(bits(all[i]), i, n, marks)) return false;
        }
        return true;
    });
}

bool mark(uint64_t bits, int64_t vertex, int64_t n, Marks& marks) {
    const auto at = std::lower_bound(marks.values.begin(), marks.values.end(), bits);
    const size_t number = (size_t)(at - marks.values.begin());
    if (at == marks.values.end() || *at != bits) {
        if (marks.values.size() == MAX_MARKED) return false;
        marks.values.insert(at, bits);
        for (uint16_t& other : marks.of) other = (uint16_t)(other + (other > number));
    }
    if (marks.of.empty()) marks.of.assign((size_t)n, 0);
    marks.of[(size_t)vertex] = (uint16_t)(number + 1);
    return true;
}

bool encode_tile(fhash_context& context, const std::shared_ptr<const Settings>& settings,
                 const Shape& shape, int32_t type, const void* values, const uint8_t* in_coreset,
                 const Marks& marks, const fhash_coding& coding, Coded& coded,
                 fhash_error& error) {
    const Wide& origin = settings->origin;
    double largest;  // a decoder would refuse the stream
    if (!check_numbers(*settings, origin.zero() ? type : (int32_t)FHASH_INT64, largest, error))
        return false;
    Task task = {context, *settings, shape, type, (const uint8_t*)values, coding, marks,
                 {}, {}, {}};
    const auto restored = [&] {
        if (coded.data[4] & MISSING)
            with_type(type, [&](auto kind) {
                restore((decltype(kind)*)(void*)coded.decoded.data(), marks);
                return true;
            });
        return true;
    };
    if (origin.zero())
        return encode_about_origin(task, in_coreset, coded, error) && restored();
    if (!has_origin(origin, type))
        return fail(error, FHASH_ERROR_ARGUMENT, "an array of this type has no origin");
    std::vector<int64_t> differences((size_t)vertices(shape));
    for (size_t i = 0; i < differences.size(); i++) {
        const uint64_t value = ((const uint64_t*)values)[i];
        differences[i] = (int64_t)(value - origin.bits);
        // The difference is right if its sign is that of the comparison.
        const bool above = type == FHASH_INT64 ? (int64_t)value >= (int64_t)origin.bits
                                               : value >= origin.bits;
        if (above != (differences[i] >= 0) && (marks.of.empty() || !marks.of[i]))
            return fail(error, FHASH_ERROR_ARGUMENT,
                        "a value is too far from the origin of the settings: the difference must "
                        "be an int64");
    }
    task.type = FHASH_INT64;
    task.values = (const uint8_t*)differences.data();
    if (!encode_about_origin(task, in_coreset, coded, error)) return false;
    add_origin((int64_t*)(void*)coded.decoded.data(), vertices(shape), origin, type);
    return restored();
}

}  // namespace fhash
