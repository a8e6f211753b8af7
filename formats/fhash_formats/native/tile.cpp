// Decoding of a tile: its sections, then its values by kind, then what all kinds share.
#include "tile.hpp"

#include <cfloat>

#include "inflate.hpp"
#include "kernels.hpp"
#include "memory.hpp"
#include "numbers.hpp"

namespace fhash {
namespace {

constexpr int64_t MAX_VERTICES = 1 << 27;
constexpr uint64_t WORK_BYTES = 34;  // of a vertex, beside the caller's arrays
constexpr int MAX_LABELS = 65536;

bool cut_short(fhash_error& error) {
    return fail(error, FHASH_ERROR_DAMAGED, "a coded tile is cut short");
}

// Values whose bytes of equal weight lie together, lowest first, deflated.
bool unpack_planes(Bytes packed, int64_t n, size_t width, uint8_t* out, fhash_error& error) {
    std::vector<uint8_t> planes((size_t)n * width);
    if (!inflate_exact(packed.at, packed.left(), true, planes.data(), planes.size(), error)) {
        if (error.status == FHASH_ERROR_DAMAGED)
            fail(error, FHASH_ERROR_DAMAGED,
                 "a coded tile is damaged: it holds another number of values");
        return false;
    }
    for (size_t byte = 0; byte < width; byte++) {
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
        const size_t place = width - 1 - byte;
#else
        const size_t place = byte;
#endif
        const uint8_t* const plane = planes.data() + byte * (size_t)n;
        for (int64_t i = 0; i < n; i++) out[(size_t)i * width + place] = plane[i];
    }
    return true;
}

// The mask of a tile, from two levels of each vertex.
bool read_mask(const Job& job, const uint8_t* first, const uint8_t* second, uint8_t* occupied,
               fhash_error& error) {
    const Bytes& packed = job.stream.mask;
    if (packed.left() == 0) {
        std::fill_n(occupied, job.size(), (uint8_t)1);
        return true;
    }
    return decode_mask(packed.at, packed.left(), job.shape, first, second, occupied, error);
}

// The same by means of the decoded values before head and residual.
template <class T, class L>
bool read_mask_by(const Job& job, const L* linear, uint8_t* occupied, fhash_error& error) {
    if (!job.settings->mask)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "a coded tile has a mask, but its settings have no mask levels");
    std::vector<uint8_t> first((size_t)job.size()), second((size_t)job.size());
    if (job.stream.mask.left() &&
        !levels_of_mask<T>(*job.settings->mask, job.shape, linear, first.data(), second.data(),
                           error))
        return false;
    return read_mask(job, first.data(), second.data(), occupied, error);
}

template <class O>
bool decode_exact(const Job& job, O* values, uint8_t* occupied, fhash_error& error) {
    std::vector<O> all((size_t)(job.lod ? job.size() : 0));
    O* const out = job.lod ? all.data() : values;
    if (!unpack_planes(job.stream.body, job.size(), sizeof(O), (uint8_t*)out, error)) return false;
    if (job.lod) thin(out, job.shape, job.lod, values);
    if (job.lod || !occupied || !job.stream.mask.at) return true;
    const std::vector<uint8_t> nothing((size_t)job.size(), 0);
    return read_mask(job, nothing.data(), nothing.data(), occupied, error);
}

template <class O>
bool decode_labelled(const Job& job, O* values, uint8_t* occupied, fhash_error& error) {
    using Bits = typename Word<sizeof(O)>::Of;
    Bytes body = job.stream.body;
    uint64_t size, length;
    if (!body.leb(size) || !body.leb(length)) return cut_short(error);
    const bool masked = job.stream.masked;
    const uint64_t count = size + masked;
    if (count < 1 || count > MAX_LABELS)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "a coded tile has %llu labels; 1 to %d are possible",
                    (unsigned long long)count, MAX_LABELS);
    if (length > body.left()) return cut_short(error);
    std::vector<Bits> palette((size_t)size + 1, 0);  // the label of unoccupied vertices is the last
    if (!unpack_planes({body.at, body.at + length}, (int64_t)size, sizeof(O),
                       (uint8_t*)palette.data(), error))
        return false;
    for (size_t i = 1; i < size; i++) {
        palette[i] = (Bits)(palette[i] + palette[i - 1]);
        if (palette[i] <= palette[i - 1])
            return fail(error, FHASH_ERROR_DAMAGED, "the palette of a coded tile does not ascend");
    }
    const int64_t n = job.size();
    std::vector<uint16_t> labels((size_t)n);
    if (!decode_labels(body.at + length, body.left() - length, (int64_t)count, job.shape,
                       labels.data(), error))
        return false;
    std::vector<O> all((size_t)(job.lod ? n : 0));
    O* const out = job.lod ? all.data() : values;
    for (int64_t i = 0; i < n; i++) std::memcpy(out + i, &palette[labels[(size_t)i]], sizeof(O));
    std::vector<uint8_t> mask((size_t)(masked ? n : 0));
    for (size_t i = 0; i < mask.size(); i++) mask[i] = labels[i] < size;
    if (masked && job.settings) blank(out, n, mask.data(), job.settings->center);
    if (job.lod) thin(out, job.shape, job.lod, values);
    if (masked && occupied) std::copy(mask.begin(), mask.end(), occupied);
    return true;
}

// Missing values in their places; the last step, after an origin.
bool restore_missing(const Job& job, void* values, fhash_error& error) {
    Bytes section = job.stream.missing;
    if (!section.at || job.lod) return true;
    Marks marks;
    const size_t width = fhash_type_size(job.type);
    const uint8_t *count, *bits;
    if (!section.take(1, count) || !section.take(*count * width, bits)) return cut_short(error);
    for (size_t i = 0; i < *count; i++) {
        uint64_t value = 0;
        for (size_t byte = width; byte-- > 0;) value = value << 8 | bits[i * width + byte];
        if (i && value <= marks.values.back())
            return fail(error, FHASH_ERROR_DAMAGED,
                        "the missing values of a coded tile do not ascend");
        marks.values.push_back(value);
    }
    marks.of.resize((size_t)job.size());
    if (!decode_labels(section.at, section.left(), *count + 1, job.shape, marks.of.data(), error))
        return false;
    return with_type(job.type, [&](auto type) {
        restore((decltype(type)*)values, marks);
        return true;
    });
}

bool decode_foretold(const Job& job, void* values, uint8_t* occupied, fhash_error& error) {
    const Settings& settings = *job.settings;
    if (!settings.predictor)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "a tile is coded by prediction, but its settings have no predictor");
    const int64_t n = job.size();
    const Predictor& predictor = *settings.predictor;
    std::vector<int32_t> integers((size_t)n);
    if (!decode_predicted(job.stream.body.at, job.stream.body.left(), job.shape, predictor,
                          integers.data(), error))
        return false;
    const std::vector<double> linear = foretold_values(settings, integers);
    integers = {};
    const int32_t type = job.coded_type();
    if (job.lod) {
        std::vector<double> some((size_t)vertices(job.out_shape()));
        thin(linear.data(), job.shape, job.lod, some.data());
        correct_within(settings, type, some.data(), {}, (int64_t)some.size(), values);
        return true;
    }
    const bool masked = job.stream.mask.at;
    if (masked && !(settings.real64 ? read_mask_by<double>(job, linear.data(), occupied, error)
                                    : read_mask_by<float>(job, linear.data(), occupied, error)))
        return false;
    correct_within(settings, type, linear.data(), {}, n, values);
    return true;
}

// The quantised coefficients of a transformed tile, of a level of detail at least those that it
// needs.
template <class T>
bool read_coefficients(const Job& job, const Plan<T>& plan, int32_t* out, fhash_error& error) {
    const Stream& stream = job.stream;
    if (is_cut(stream.cut))
        return decode_blocks(coding_of(job, false), job.lod, job.context.threads, stream.body, out,
                             error);
    Table some;
    if (job.lod)
        some.assign(plan.table.begin(),
                    plan.table.begin() + TABLE_COLUMNS * bands_within(plan.table, plan.bands));
    return decode_integers(stream.body.at, stream.body.left(), job.shape,
                           job.lod ? some : plan.table, job.settings->trellis, stream.fast, out,
                           error);
}

bool read_residual(const Job& job, int32_t* out, fhash_error& error) {
    const Stream& stream = job.stream;
    if (is_cut(stream.cut))
        return decode_blocks(coding_of(job, true), 0, job.context.threads, stream.residual, out,
                             error);
    return decode_integers(stream.residual.at, stream.residual.left(), job.shape,
                           single_band(job.shape), false, stream.fast, out, error);
}

// The quantised coefficients and the residual of a transformed tile, the two at once where there
// are threads. residual: of the size of the tile, or empty.
template <class T>
bool read_integers(const Job& job, const Plan<T>& plan, int32_t* coefficients,
                   std::vector<int32_t>& residual, fhash_error& error) {
    const size_t count = residual.empty() ? 1 : 2;
    // Blocks have threads of their own.
    const int threads = is_cut(job.stream.cut) ? 1 : job.context.threads;
    return each_of(threads, count, error, [&](size_t number, fhash_error& failed) {
        return number == 0 ? read_coefficients(job, plan, coefficients, failed)
                           : read_residual(job, residual.data(), failed);
    });
}

// Values with their head, from those before; in other room than `base` where there are threads.
bool correct_by_head(const Job& job, float*& base, std::vector<float>& room, fhash_error& error) {
    if (!job.settings->head) return true;
    // Threads read the rows of others around theirs, so that they need another array.
    if (job.context.threads > 1) room.resize((size_t)job.size());
    float* const out = job.context.threads > 1 ? room.data() : base;
    if (!apply_head(job.context, *job.settings->head, base, job.shape, out, error)) return false;
    base = out;
    return true;
}
bool correct_by_head(const Job&, double*&, std::vector<double>&, fhash_error&) { return true; }

// Whether a value of a floating type is infinite.
bool any_infinite(const void* values, int32_t type, int64_t n) {
    return with_type(type, [&](auto kind) {
        using O = decltype(kind);
        if constexpr (is_real<O>)
            return std::any_of((const O*)values, (const O*)values + n,
                               [](O value) { return std::isinf(real(value)); });
        else return false;
    });
}

template <class T>
bool decode_transformed(const Job& job, void* values, uint8_t* occupied, double largest,
                        fhash_error& error) {
    const Settings& settings = *job.settings;
    const auto plan = plan_for<T>(job.context, settings, job.shape, job.lod, error);
    if (!plan) return false;
    const int64_t n = job.size(), count = vertices(job.out_shape());
    std::vector<int32_t> residual;
    make_room(residual, (size_t)(job.stream.residual.at && !job.lod ? n : 0));
    // Where the sizes are the same, integers, values before the head, and values share the room.
    constexpr bool narrow = std::is_same<T, float>::value;
    const int32_t type = job.coded_type();
    const bool direct = narrow && type == FHASH_FLOAT32 && !job.lod;
    std::vector<int32_t> integers;
    make_room(integers, (size_t)(direct ? 0 : n));
    int32_t* const coefficients = direct ? (int32_t*)values : integers.data();
    if (!read_integers(job, *plan, coefficients, residual, error)) return false;
    const bool over = narrow && !job.lod;
    std::vector<T> room, corrected;
    make_room(room, (size_t)(over ? 0 : count));
    T* linear = over ? (T*)(void*)coefficients : room.data();
    if (!linear_values(settings, *plan, coefficients, linear, error)) return false;
    if (job.lod) {
        correct_within(settings, type, linear, {}, count, values);
        return true;
    }
    if (job.stream.mask.at && !read_mask_by<T>(job, linear, occupied, error)) return false;
    if (!correct_by_head(job, linear, corrected, error)) return false;
    return finish_within(settings, type, linear, residual, n, largest, values, error);
}

// The values of a tile with settings, but for labels.
bool decode_coded(const Job& job, void* values, uint8_t* occupied, fhash_error& error) {
    const Settings& settings = *job.settings;
    double largest;
    if (!check_numbers(settings, job.coded_type(), largest, error)) return false;
    const int kind = job.stream.kind;
    bool done = true;
    if (kind == EMPTY) {
        if (job.stream.masked && !job.lod) std::fill_n(occupied, job.size(), (uint8_t)0);
        with_type(job.coded_type(), [&](auto type) {
            using O = decltype(type);
            std::fill_n((O*)values, vertices(job.out_shape()), cast<O>(settings.center));
            return true;
        });
    } else if (kind == PREDICTED) {
        done = decode_foretold(job, values, occupied, error);
    } else {
        done = settings.real64 ? decode_transformed<double>(job, values, occupied, largest, error)
                               : decode_transformed<float>(job, values, occupied, largest, error);
    }
    if (!done || job.lod) return done;
    const bool masked = job.stream.mask.at || (kind == EMPTY && job.stream.masked);
    if (!masked) return true;
    return with_type(job.coded_type(), [&](auto type) {
        blank((decltype(type)*)values, job.size(), occupied, settings.center);
        return true;
    });
}

template <class O>
bool decode_as(const Job& job, O* values, uint8_t* occupied, fhash_error& error) {
    const int kind = job.stream.kind;
    if (kind == EXACT) return decode_exact(job, values, occupied, error);
    if (kind == DIFFERENCES) {
#if defined(FHASH_SMALL)  // no page reads arrays beside the values
        return fail(error, FHASH_ERROR_UNSUPPORTED, "a tile of differences");
#else
        if (!job.lod) return decode_differences(job.stream.body, job.shape, values, error);
        std::vector<O> all((size_t)job.size());
        if (!decode_differences(job.stream.body, job.shape, all.data(), error)) return false;
        thin(all.data(), job.shape, job.lod, values);
        return true;
#endif
    }
    if (!job.settings && !(kind == LABELS && !job.stream.masked))
        return fail(error, FHASH_ERROR_DAMAGED, "a coded tile has no settings");
    if (kind == LABELS) return decode_labelled(job, values, occupied, error);
    return decode_coded(job, values, occupied, error);
}

}  // namespace

bool is_shape(const int64_t* shape) {
    int64_t product = 1;
    for (int a = 0; a < 4; a++) {
        if (shape[a] < 1 || shape[a] > MAX_VERTICES / product) return false;
        product *= shape[a];
    }
    return true;
}

bool check_numbers(const Settings& settings, int32_t type, double& largest, fhash_error& error) {
    largest = settings.real64 ? DBL_MAX : FLT_MAX;
    const bool floats = type >= FHASH_FLOAT16;
    if (type == FHASH_FLOAT32) largest = std::min<double>(largest, FLT_MAX);
    if (type == FHASH_FLOAT16) largest = 65504;
    const double reach =
        std::max({std::fabs(settings.low), std::fabs(settings.high), std::fabs(settings.center)});
    if (floats && reach > largest)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the range of a coded tile or its centre is beyond %.6g", largest);
    return true;
}

template <class T, class L>
bool levels_of_mask(const MaskScores& mask, const Shape& shape, const L* linear, uint8_t* first,
                    uint8_t* second, fhash_error& error) {
    const int64_t n = vertices(shape);
    std::fill_n(first, n, (uint8_t)0);
    std::fill_n(second, n, (uint8_t)0);
    const auto any = [](const auto& list) {
        return std::any_of(list.begin(), list.end(), [](int32_t score) { return score != 0; });
    };
    if (!any(mask.scores) && !any(mask.others)) return true;
    const std::vector<T> edges(mask.edges.begin(), mask.edges.end());
    std::vector<T> cast_values;
    const T* values;
    if constexpr (std::is_same<T, L>::value) {
        values = linear;
    } else {
        cast_values.assign(linear, linear + n);
        values = cast_values.data();
    }
    const int64_t code = mask_levels(values, shape.data(), edges.data(), (int64_t)edges.size(),
                                     mask.scores.data(),
                                     mask.others.empty() ? nullptr : mask.others.data(),
                                     mask.reach, first, second);
    return kernel_done(code, "the mask of a tile is damaged", error);
}
template bool levels_of_mask<float>(const MaskScores&, const Shape&, const float*, uint8_t*,
                                    uint8_t*, fhash_error&);
template bool levels_of_mask<float>(const MaskScores&, const Shape&, const double*, uint8_t*,
                                    uint8_t*, fhash_error&);
template bool levels_of_mask<double>(const MaskScores&, const Shape&, const double*, uint8_t*,
                                     uint8_t*, fhash_error&);

std::vector<double> foretold_values(const Settings& settings,
                                    const std::vector<int32_t>& integers) {
    const Predictor& predictor = *settings.predictor;
    std::vector<double> values;
    values.reserve(integers.size());
    for (const int32_t q : integers) {
        const double value = (double)q * predictor.step + predictor.origin;
        const double raised = value < settings.low ? settings.low : value;
        values.push_back(raised > settings.high ? settings.high : raised);
    }
    return values;
}

template <class T>
void correct_within(const Settings& settings, int32_t type, const T* base,
                    const std::vector<int32_t>& residual, int64_t n, void* out) {
    with_type(type, [&](auto kind) {
        using O = decltype(kind);
        O* const values = (O*)out;
        if (residual.empty()) {
            if ((const void*)base != out) cast_all(base, values, n);
        } else if constexpr (std::is_floating_point<O>::value) {
            correct(base, residual.data(), n, settings.quantum, values);
        } else {
            std::vector<double> sums((size_t)n);
            correct(base, residual.data(), n, settings.quantum, sums.data());
            cast_all(sums.data(), values, n);
        }
        clip_range(values, n, settings);
        return true;
    });
}
template void correct_within(const Settings&, int32_t, const float*, const std::vector<int32_t>&,
                             int64_t, void*);
template void correct_within(const Settings&, int32_t, const double*, const std::vector<int32_t>&,
                             int64_t, void*);

template <class T>
bool finish_within(const Settings& settings, int32_t type, const T* base,
                   const std::vector<int32_t>& residual, int64_t n, double largest, void* out,
                   fhash_error& error) {
    correct_within(settings, type, base, residual, n, out);
    // Without a residual the values are within the range, and finite; clipped ones are in the end.
    const bool may_exceed = !settings.clip && settings.quantum * 0x1p31 > largest / 2;
    if (residual.empty() || !may_exceed || !any_infinite(out, type, n)) return true;
    return fail(error, FHASH_ERROR_DAMAGED, "a residual of a coded tile is beyond %.6g", largest);
}
template bool finish_within(const Settings&, int32_t, const float*, const std::vector<int32_t>&,
                            int64_t, double, void*, fhash_error&);
template bool finish_within(const Settings&, int32_t, const double*, const std::vector<int32_t>&,
                            int64_t, double, void*, fhash_error&);

bool apply_head(const fhash_context& context, const Head& head, const float* in, const Shape& shape,
                float* out, fhash_error& error) {
    const int64_t rows = shape[1] * shape[2];
    // Values of a part; with fewer a further thread does not pay.
    constexpr int64_t LEAST = 1 << 19;
    const int64_t parts = std::clamp<int64_t>(
        std::min<int64_t>(context.threads, vertices(shape) / LEAST), 1, rows);
    std::vector<int64_t> codes((size_t)parts, 0);
    const auto run = [&](int part) {
        codes[(size_t)part] = fhash_head_apply(
            in, shape.data(), rows * part / parts, rows * (part + 1) / parts, head.layers(),
            head.widths.data(), head.weights.data(), head.biases.data(), head.scales.data(),
            head.constants, 0, out);
    };
    together((int)parts, run);
    for (const int64_t code : codes)
        if (!kernel_done(code, "the head of a tile", error)) return false;
    return true;
}

namespace {

// The cut at the start of the body of a tile in blocks.
bool take_cut(Stream& stream, fhash_error& error) {
    const uint8_t* logs;
    if (!stream.body.take(CUT_BYTES, logs)) return cut_short(error);
    for (size_t a = 0; a < 4; a++) stream.cut[a] = logs[a / 2] >> 4 * (a % 2) & 15;
    stream.kind = TRANSFORMED;
    return is_cut(stream.cut) ||
           fail(error, FHASH_ERROR_DAMAGED, "a coded tile has blocks that are not cut");
}

}  // namespace

bool parse_stream(const uint8_t* data, size_t size, Stream& stream, fhash_error& error) {
    constexpr size_t CHECKSUM = 4;
    constexpr int ALLOWED[7] = {OWN | MISSING | RESIDUAL | MASKED | FAST,
                                OWN | MISSING | MASKED,
                                OWN | MASKED,
                                OWN | MASKED,
                                OWN | MISSING | MASKED,
                                0,
                                OWN | MISSING | RESIDUAL | MASKED | FAST};
    if (size <= CHECKSUM)
        return fail(error, FHASH_ERROR_DAMAGED, "a coded tile has %zu bytes, which are too few",
                    size);
    const uint32_t sum = (uint32_t)fhash_crc32c(data + CHECKSUM, (int64_t)(size - CHECKSUM), 0, 0);
    if (sum != little<uint32_t>(data))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the CRC-32C of a coded tile differs, it is damaged");
    const int flags = data[CHECKSUM];
    stream = {};
    stream.kind = flags & 7;
    if (stream.kind > BLOCKS || flags & ~7 & ~ALLOWED[stream.kind])
        return fail(error, FHASH_ERROR_DAMAGED,
                    "a coded tile has the flags 0x%02x, which no encoder writes", flags);
    stream.masked = flags & MASKED;
    stream.fast = flags & FAST;
    const struct {
        bool there;
        Bytes& section;
    } sections[] = {
        {(flags & OWN) != 0, stream.settings},
        {(flags & MISSING) != 0, stream.missing},
        {stream.kind != EMPTY, stream.body},
        {(flags & RESIDUAL) != 0, stream.residual},
        {stream.masked && stream.kind != EMPTY && stream.kind != LABELS, stream.mask},
    };
    int count = 0;
    for (const auto& each : sections) count += each.there;
    Bytes rest = {data + CHECKSUM + 1, data + size};
    if (!count && rest.left())
        return fail(error, FHASH_ERROR_DAMAGED, "an empty tile has bytes after its end");
    for (const auto& each : sections) {
        if (!each.there) continue;
        uint64_t length = rest.left();
        const uint8_t* start;
        if (--count && !rest.leb(length)) return cut_short(error);
        if (!rest.take(length, start)) return cut_short(error);
        each.section = {start, start + length};
    }
    return stream.kind != BLOCKS || take_cut(stream, error);
}

bool make_job(Job& job, const fhash_tile* tile, const void* stream, size_t size,
              fhash_error& error) {
    if (!tile || !stream || !is_shape(tile->shape) || !fhash_type_size(tile->type))
        return fail(error, FHASH_ERROR_ARGUMENT, "a tile has a stream, a type, and four lengths");
    if (job.lod < 0 || job.lod > MAX_LOD)
        return fail(error, FHASH_ERROR_ARGUMENT, "lod is 0 to %d, not %d", MAX_LOD, job.lod);
    std::copy_n(tile->shape, 4, job.shape.begin());
    job.type = tile->type;
    if (!may_use(job.context, WORK_BYTES * (uint64_t)job.size(), error)) return false;
    if (!parse_stream((const uint8_t*)stream, size, job.stream, error)) return false;
    const Bytes own = job.stream.settings;
    if (own.at || tile->settings) {
        const uint8_t* const packed = own.at ? own.at : (const uint8_t*)tile->settings;
        const size_t length = own.at ? own.left() : tile->settings_size;
        job.settings = unpack_settings(job.context, packed, length, error);
        if (!job.settings) return false;
        const Wide& origin = job.settings->origin;
        if (!origin.zero() && !has_origin(origin, job.type))
            return fail(error, FHASH_ERROR_DAMAGED,
                        "the settings of a coded tile do not fit: an array of its type has no "
                        "values about the origin %s%llu",
                        origin.negative ? "-" : "",
                        (unsigned long long)(origin.negative ? 0 - origin.bits : origin.bits));
    }
    const Cut& cut = job.stream.cut;
    if (job.settings &&
        (!fits(cut, job.settings->axes) || count_blocks(job.shape, cut) > MAX_BLOCKS))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "a coded tile has blocks that its transform has not, or more than %zu",
                    MAX_BLOCKS);
    return true;
}

bool decode_about_origin(const Job& job, void* values, uint8_t* occupied, fhash_error& error) {
    std::vector<uint8_t> mask;
    if (!occupied && job.stream.masked && !job.lod) {
        mask.resize((size_t)job.size());
        occupied = mask.data();
    }
    if (occupied && !job.lod) std::fill_n(occupied, job.size(), (uint8_t)1);
    return with_type(job.coded_type(), [&](auto type) {
        return decode_as(job, (decltype(type)*)values, occupied, error);
    });
}

bool decode(const Job& job, void* values, uint8_t* occupied, fhash_error& error) {
    if (!decode_about_origin(job, values, occupied, error)) return false;
    if (job.settings && !job.settings->origin.zero())
        add_origin((int64_t*)values, vertices(job.out_shape()), job.settings->origin, job.type);
    return restore_missing(job, values, error);
}

template <class T> bool decode_linear(const Job& job, T* values, fhash_error& error) {
    double largest;
    if (!check_numbers(*job.settings, job.coded_type(), largest, error)) return false;
    const auto plan = plan_for<T>(job.context, *job.settings, job.shape, job.lod, error);
    if (!plan) return false;
    std::vector<int32_t> integers((size_t)job.size()), nothing;
    return read_integers(job, *plan, integers.data(), nothing, error) &&
           linear_values(*job.settings, *plan, integers.data(), values, error);
}
template bool decode_linear(const Job&, float*, fhash_error&);
template bool decode_linear(const Job&, double*, fhash_error&);

}  // namespace fhash
