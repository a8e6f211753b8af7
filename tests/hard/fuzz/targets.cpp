// A target for each kind of function of the native libraries: hostile bytes become the arguments
// that Python passes on unchecked.
//
// The first byte of an input chooses the target. Arrays lie in memory of their own and of exact
// length, so that the address sanitizer sees every access beyond them.
#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

void round_trip(Reader& in);          // target_encode.cpp
void light(Reader& in);               // target_light.cpp
void decode_label_bytes(Reader& in);  // target_labels.cpp
void label_round_trip(Reader& in);    // target_labels.cpp
void train(Reader& in);               // target_train.cpp
void figures(Reader& in);             // target_figures.cpp
void slopes(Reader& in);              // target_slopes.cpp
void samples(Reader& in);             // target_samples.cpp
void points(Reader& in);              // target_points.cpp
void tile(Reader& in);                // target_tile.cpp
void file(Reader& in);                // target_file.cpp
#if defined(FHASH_FUZZ_MARCH)
void march(Reader& in);  // target_march.cpp
#endif

namespace {

void decode_integers(Reader& in) {
    const Bands& with = setups().bands[in.word() % setups().bands.size()];
    const std::uint8_t how = in.byte();
    const int64_t trellis = how & 1;
    const State& prior = setups().coders[trellis];
    std::vector<std::int32_t> q(static_cast<std::size_t>(volume(with.shape)), 0);
    const std::vector<std::uint8_t> data = in.rest();
    if (how & 2) {
        fhash_fast_decode(q.data(), trellis, with.shape.data(), with.table.data(),
                          static_cast<int64_t>(with.table.size() / 29),
                          setups().fast.defaults.data(), setups().fast.lookup.data(), data.data(),
                          static_cast<int64_t>(data.size()));
        for (const std::int32_t number : q)
            require(std::abs(number) < 1 << 30, "an integer beyond 30 bits");
        return;
    }
    fhash_decode(q.data(), trellis, with.shape.data(), with.table.data(),
                 static_cast<int64_t>(with.table.size() / 29), prior.slots.data(),
                 static_cast<int64_t>(prior.slots.size() / 4), prior.weights.data(),
                 static_cast<int64_t>(prior.weights.size()), prior.simples.data(),
                 static_cast<int64_t>(prior.simples.size() / 2), data.data(),
                 static_cast<int64_t>(data.size()));
}

// Levels of a mask from any values, by sums of one or two kinds of scores.
template <class T, class F> void levels_of_values(Reader& in, F function) {
    const std::vector<int64_t> shape = small_shape(in, 8);
    const std::size_t n = static_cast<std::size_t>(volume(shape));
    const int64_t count = in.within(0, 15), reach = in.within(0, 64);
    std::vector<T> edges = in.numbers<T>(count);
    std::vector<std::int32_t> scores(static_cast<std::size_t>(count) + 1), others(scores);
    for (std::int32_t& score : scores) score = in.word() % 4096;
    for (std::int32_t& score : others) score = in.word() % 4096;
    std::vector<std::uint8_t> first(n), second(n);
    const bool two = in.byte() & 1;
    const std::vector<T> values = in.numbers<T>(static_cast<int64_t>(n));
    function(values.data(), shape.data(), edges.data(), count, scores.data(),
             two ? others.data() : nullptr, reach, first.data(), second.data());
    for (const std::uint8_t level : first) require(level < 32, "a level that does not exist");
    for (const std::uint8_t level : second) require(level < 16, "a level that does not exist");
}

void decode_mask(Reader& in) {
    const std::vector<int64_t> shape = small_shape(in, 8);
    const State& prior = setups().mask;
    const std::size_t n = static_cast<std::size_t>(volume(shape));
    std::vector<std::uint8_t> mask(n), level(n), other(n);
    const std::uint8_t how = in.byte();
    if (how & 2) return levels_of_values<float>(in, fhash_mask_levels_f32);
    if (how & 4) return levels_of_values<double>(in, fhash_mask_levels_f64);
    mask_levels(in, how & 1, level, other);
    const std::vector<std::uint8_t> data = in.rest();
    const int64_t bytes = static_cast<int64_t>(data.size());
    const int64_t crc = fhash_crc32c(data.data(), bytes, 0, 1);
    require(crc == fhash_crc32c(data.data(), bytes, 0, 0), "another CRC by the instruction");
    fhash_decode_mask(mask.data(), level.data(), other.data(), shape.data(), prior.slots.data(),
                      static_cast<int64_t>(prior.slots.size() / 4), prior.weights.data(),
                      static_cast<int64_t>(prior.weights.size()), prior.simples.data(),
                      static_cast<int64_t>(prior.simples.size() / 2), data.data(),
                      static_cast<int64_t>(data.size()));
}

void decode_predicted(Reader& in) {
    const Passes& with = setups().passes[in.word() % setups().passes.size()];
    const State& blank = setups().predictor;
    const std::vector<std::int16_t> weights = tap_weights(in, with);
    std::vector<std::int32_t> q(static_cast<std::size_t>(volume(with.shape)), 0);
    const std::vector<std::uint8_t> data = in.rest();
    fhash_decode_predicted(q.data(), with.shape.data(), with.levels.data(), with.passes.data(),
                           static_cast<int64_t>(with.passes.size() / 4), with.taps.data(),
                           weights.data(), blank.slots.data(),
                           static_cast<int64_t>(blank.slots.size() / 4), blank.weights.data(),
                           static_cast<int64_t>(blank.weights.size()), blank.simples.data(),
                           static_cast<int64_t>(blank.simples.size() / 2), data.data(),
                           static_cast<int64_t>(data.size()));
}

template <class T, class F, class R>
void transform(Reader& in, F function, R reconstruct, bool whole) {
    const std::vector<int64_t> shape = small_shape(in, 7);
    int64_t kinds[4], depths[4], ranks[4];
    std::vector<T> matrices[4];
    const T* pointers[4];
    for (int axis = 0; axis < 4; axis++) {
        kinds[axis] = in.within(0, 4);
        depths[axis] = kinds[axis] == 0 || kinds[axis] == 4 ? 0 : in.within(1, 10);
        ranks[axis] = kinds[axis] == 4 ? in.within(0, shape[axis]) : 0;
    }
    const std::vector<T> seed = in.numbers<T>(16);
    std::size_t next = 0;
    const auto some = [&](int64_t n) {
        std::vector<T> values(static_cast<std::size_t>(n));
        for (T& value : values) value = seed[next++ % seed.size()];
        next += 7;
        return values;
    };
    for (int axis = 0; axis < 4; axis++) {
        // At least one number, since an empty array has an address in Python, too.
        matrices[axis] = some(std::max<int64_t>(ranks[axis] * shape[axis], 1));
        pointers[axis] = kinds[axis] == 4 ? matrices[axis].data() : nullptr;
    }
    const std::vector<T> tz = some(shape[0] * shape[1]), yx = some(shape[2] * shape[3]),
                         values = some(volume(shape));
    std::vector<T> out(values.size());
    const int64_t threads = 1 + static_cast<int64_t>(values.size() % 2);
    if (whole) {
        const std::vector<double> numbers = in.numbers<double>(10);
        const std::vector<std::int32_t> from = integers(in, volume(shape));
        reconstruct(from.data(), out.data(), shape.data(), kinds, depths, ranks, pointers,
                    tz.data(), yx.data(), threads, numbers.data());
        return;
    }
    function(values.data(), out.data(), shape.data(), kinds, depths, ranks, pointers, tz.data(),
             yx.data(), threads);
}

void transform(Reader& in) {
    const std::uint8_t which = in.byte();
    const bool inverse = which & 2, whole = which & 4;
    if (which & 1)
        transform<float>(in, inverse ? fhash_transform_inverse_f32 : fhash_transform_forward_f32,
                         fhash_reconstruct_f32, whole);
    else
        transform<double>(in, inverse ? fhash_transform_inverse_f64 : fhash_transform_forward_f64,
                          fhash_reconstruct_f64, whole);
}

// A positive float16, as scales are stored.
float scale_of(Reader& in) {
    const int bits = 1 + in.word() % 0x7bff;
    const int exponent = bits >> 10, fraction = bits & 1023;
    return exponent ? std::ldexp(1024.0F + static_cast<float>(fraction), exponent - 25)
                    : std::ldexp(static_cast<float>(fraction), -24);
}

void head(Reader& in) {
    const int64_t hidden = in.within(1, 3);
    std::vector<int64_t> widths{28};
    for (int64_t layer = 0; layer < hidden; layer++) widths.push_back(in.within(1, 64));
    widths.push_back(1);
    const std::vector<int64_t> shape = {in.within(1, 5), in.within(1, 4), in.within(1, 4),
                                        in.within(1, 140)};
    const float sigma = std::ldexp(1.0F + static_cast<float>(in.byte()) / 256,
                                   static_cast<int>(in.within(-100, 99)));
    float low = in.finite<float>(), high = in.finite<float>();
    if (low > high) std::swap(low, high);
    std::vector<float> weights, biases, scales;
    const std::vector<std::uint8_t> seed = in.numbers<std::uint8_t>(64);
    for (int64_t layer = 0; layer <= hidden; layer++) {
        const int64_t inputs = widths[static_cast<std::size_t>(layer)];
        const int64_t outputs = widths[static_cast<std::size_t>(layer) + 1];
        const float unit = layer == hidden ? sigma : 128.0F, bias = scale_of(in);
        scales.push_back(scale_of(in) / (layer ? 128.0F : 512.0F) * unit);
        for (int64_t i = 0; i < inputs * outputs; i++)
            weights.push_back(
                static_cast<float>(seed[static_cast<std::size_t>(i * 7 + layer) % 64] % 63 - 31));
        for (int64_t i = 0; i < outputs; i++)
            biases.push_back(
                bias *
                static_cast<float>(seed[static_cast<std::size_t>(i + layer) % 64] % 255 - 127) *
                unit);
    }
    // The same computation as in NeighbourHead.
    const float span = high - low;
    float unit = span > 0 ? 1024.0F / span : 0.0F;
    if (!std::isfinite(unit)) unit = 0.0F;
    std::vector<float> values(static_cast<std::size_t>(volume(shape))), out(values.size());
    const std::vector<float> some = in.numbers<float>(32);
    for (std::size_t i = 0; i < values.size(); i++) values[i] = some[(i * i / 5) % some.size()];
    const float constants[] = {low, high, 0.5F / sigma, unit};
    const int64_t rows = shape[1] * shape[2], first = in.within(0, rows);
    const int64_t last = in.within(first, rows), lanes = in.within(0, 5);
    fhash_head_apply(values.data(), shape.data(), first, last, hidden + 1, widths.data(),
                     weights.data(), biases.data(), scales.data(), constants, lanes, out.data());
}

auto free_of(const float*) { return fhash_free_f32; }
auto free_of(const double*) { return fhash_free_f64; }

template <class T>
void free_values(std::vector<T>& target, const std::vector<T>& rebuilt,
                 const std::uint8_t* counted, double low, double high) {
    const int64_t n = static_cast<int64_t>(target.size());
    const int64_t count = free_of(rebuilt.data())(target.data(), rebuilt.data(), counted, n,
                                                  low, high);
    require(count >= 0 && count <= n, "more free values than there are");
}

void values(Reader& in) {
    const std::uint8_t which = in.byte();
    const int64_t n = in.word() % 3000;
    const std::size_t count = static_cast<std::size_t>(n);
    const double a = in.finite<double>(), b = in.finite<double>(), c = in.finite<double>();
    std::vector<float> one = repeated<float>(in, n), other = repeated<float>(in, n), narrow(count);
    std::vector<double> first = repeated<double>(in, n), second = repeated<double>(in, n),
                        wide(count);
    std::vector<std::int32_t> whole = integers(in, n), result(count);
    const std::vector<std::uint8_t> counts = repeated<std::uint8_t>(in, n);
    const std::uint8_t* const chosen = which & 64 ? counts.data() : nullptr;
    std::vector<double> shifts;  // in steps, as settings have them
    for (int i = 0; i < 6; i++)
        shifts.push_back(static_cast<double>(in.within(0, 255) - 128) / 128);
    switch (which % 12) {
        case 0:
            fhash_clip_f32(one.data(), n, a, std::min(b, c), std::max(b, c));
            fhash_clip_f64(first.data(), n, a, std::min(b, c), std::max(b, c));
            break;
        case 1:
            fhash_correct_f32_f32(one.data(), whole.data(), n, a, narrow.data());
            fhash_correct_f32_f64(one.data(), whole.data(), n, a, wide.data());
            break;
        case 2:
            fhash_correct_f64_f32(first.data(), whole.data(), n, a, narrow.data());
            fhash_correct_f64_f64(first.data(), whole.data(), n, a, wide.data());
            break;
        case 3:
            fhash_residual_f32_f32(one.data(), other.data(), chosen, n, a, 1073741823.0,
                                   result.data());
            std::fill(result.begin(), result.end(), 0);
            fhash_residual_f32_f64(one.data(), second.data(), chosen, n, a, 1073741823.0,
                                   result.data());
            break;
        case 4:
            fhash_residual_f64_f64(first.data(), second.data(), chosen, n, a, 1073741823.0,
                                   result.data());
            std::fill(result.begin(), result.end(), 0);
            fhash_residual_f64_f32(first.data(), other.data(), chosen, n, a, 1073741823.0,
                                   result.data());
            break;
        case 5: fhash_within_f32(one.data(), other.data(), chosen, n, a); break;
        case 6: fhash_within_f64(first.data(), second.data(), chosen, n, a); break;
        case 7: fhash_quantise_f32(one.data(), n, a, 0.5, 1e9, result.data(), narrow.data()); break;
        case 8:
            fhash_quantise_f64(first.data(), n, a, 0.5, 1e9, result.data(), narrow.data());
            break;
        case 9: free_values(one, other, chosen, std::min(b, c), std::max(b, c)); break;
        case 10: free_values(first, second, chosen, std::min(b, c), std::max(b, c)); break;
        default:
            fhash_dequantise_f32(whole.data(), n, a, shifts.data(), narrow.data());
            fhash_dequantise_f64(whole.data(), n, a, shifts.data(), wide.data());
    }
}

}  // namespace

// The number of the target that all inputs are for; -1 if their first byte chooses.
int only_target() {
    const char* const number = std::getenv("FHASH_FUZZ_TARGET");
    return number ? std::atoi(number) : -1;
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    static const int only = only_target();
    Reader in(data, size);
#if defined(FHASH_FUZZ_MARCH)
    const int targets = 18;
#else
    const int targets = 17;
#endif
    const int chosen = in.byte() % targets;
    switch (only < 0 ? chosen : only) {
        case 0: decode_integers(in); break;
        case 1: decode_mask(in); break;
        case 2: decode_predicted(in); break;
        case 3: transform(in); break;
        case 4: head(in); break;
        case 5: values(in); break;
        case 6: round_trip(in); break;
        case 7: light(in); break;
        case 8: decode_label_bytes(in); break;
        case 9: label_round_trip(in); break;
        case 10: train(in); break;
        case 11: figures(in); break;
        case 12: slopes(in); break;
        case 13: samples(in); break;
        case 14: points(in); break;
        case 15: tile(in); break;
        case 16: file(in); break;
#if defined(FHASH_FUZZ_MARCH)
        default: march(in);
#endif
    }
    return 0;
}
