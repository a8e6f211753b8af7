// Figures of errors, light, slopes and samples that an encoder learns from, of any values.
#include <algorithm>
#include <cmath>
#include <limits>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

// The figures of how far decoded values are from the original. Scales and bins are those of
// fhash_codec/measure: numbers times the scale are finite, and so is the number of bins per unit.
namespace {

template <class T> struct Functions {
    int64_t (*scan)(const T*, int64_t, int64_t, double, double*);
    int64_t (*errors)(const T*, const T*, const std::uint8_t*, int64_t, int64_t, double, double,
                      double, double*);
    int64_t (*histogram)(const T*, int64_t, double, double, double, int64_t, int64_t*);
    int64_t (*ssim)(const T*, const T*, const std::uint8_t*, const int64_t*, const int64_t*,
                    const double*, double*);
};

const Functions<float> SINGLE{fhash_scan_f32, fhash_errors_f32, fhash_histogram_f32,
                              fhash_ssim_f32};
const Functions<double> DOUBLE{fhash_scan_f64, fhash_errors_f64, fhash_histogram_f64,
                               fhash_ssim_f64};

// Count values in bins between their least and their greatest. The counts add up to their number.
template <class T>
void count_values(Reader& in, const Functions<T>& functions, const std::vector<T>& values,
                  double low, double high, int64_t finite) {
    const int64_t n = static_cast<int64_t>(values.size()), bins = in.within(1, 200);
    const double scale = std::ldexp(1.0, sizeof(T) == 8 ? -200 : 0), start = low * scale;
    const double factor = static_cast<double>(bins) / (high * scale - start);
    if (!(factor > 0) || !std::isfinite(factor)) return;  // refused by Python
    std::vector<int64_t> counts(static_cast<std::size_t>(bins), 0);
    const int64_t counted =
        functions.histogram(values.data(), n, scale, start, factor, bins, counts.data());
    int64_t sum = 0;
    for (const int64_t count : counts) sum += count;
    require(counted == finite && sum == finite, "a histogram of another number of values");
}

// The number of the values that count in a row is the same for all figures.
template <class T> void compare_values(Reader& in, const Functions<T>& functions) {
    const int64_t rows = in.within(1, 3), n = in.word() % 1000, all = rows * n;
    const std::vector<T> one = repeated<T>(in, all), other = repeated<T>(in, all);
    const std::vector<std::uint8_t> mask = repeated<std::uint8_t>(in, all);
    const std::uint8_t* const chosen = in.byte() & 1 ? mask.data() : nullptr;
    const double factor = in.finite<double>(), scale = std::ldexp(1.0, -1 - in.byte());
    const double first = in.finite<double>(), second = in.finite<double>();
    std::vector<double> found(4 * static_cast<std::size_t>(rows));
    std::vector<double> errors(5 * static_cast<std::size_t>(rows)), bulk(errors);
    functions.scan(one.data(), rows, n, factor, found.data());
    functions.errors(one.data(), other.data(), chosen, rows, n, scale, 1, 0, errors.data());
    functions.errors(one.data(), other.data(), chosen, rows, n, scale, std::min(first, second),
                     std::max(first, second), bulk.data());
    for (std::size_t row = 0; row < static_cast<std::size_t>(rows); row++) {
        const double* const whole = &errors[5 * row];
        const double* const part = &bulk[5 * row];
        require(whole[0] == part[0] && whole[0] <= found[4 * row], "another number of values");
        if (whole[0] >= 0) require(part[1] == whole[1] && part[3] <= whole[0], "other sums");
    }
    const int64_t finite = static_cast<int64_t>(found[0]);
    const std::vector<T> row(one.begin(), one.begin() + static_cast<std::ptrdiff_t>(n));
    if (finite > 0) count_values(in, functions, row, found[1], found[2], finite);
}

template <class T> void compare_frames(Reader& in, const Functions<T>& functions) {
    int64_t shape[3], tile[6];
    for (int axis = 0; axis < 3; axis++) {
        shape[axis] = in.within(1, axis == 2 ? 30 : 14);
        tile[2 * axis] = in.within(0, shape[axis] - 1);
        tile[2 * axis + 1] = in.within(tile[2 * axis] + 1, shape[axis]);
    }
    const int64_t n = shape[0] * shape[1] * shape[2];
    const std::vector<T> one = repeated<T>(in, n), other = repeated<T>(in, n);
    const std::vector<std::uint8_t> mask = repeated<std::uint8_t>(in, n);
    std::vector<double> numbers = in.numbers<double>(10);
    double sum = 0;
    const int64_t counted =
        functions.ssim(one.data(), other.data(), in.byte() & 1 ? mask.data() : nullptr, shape, tile,
                       numbers.data(), &sum);
    const int64_t size = (tile[1] - tile[0]) * (tile[3] - tile[2]) * (tile[5] - tile[4]);
    require(counted >= -1 && counted <= size, "more vertices than the tile has");
}

void magnitudes(Reader& in) {
    const int64_t n = in.word() % 2000, shift = in.within(18, 30);
    const std::vector<float> values = repeated<float>(in, n);
    std::vector<int64_t> counts(std::size_t{1} << (31 - shift));
    std::vector<double> squares(counts.size());
    fhash_magnitudes(values.data(), n, shift, counts.data(), squares.data());
}

}  // namespace

void figures(Reader& in) {
    switch (in.byte() % 5) {
        case 0: compare_values(in, SINGLE); break;
        case 1: compare_values(in, DOUBLE); break;
        case 2: compare_frames(in, SINGLE); break;
        case 3: compare_frames(in, DOUBLE); break;
        default: magnitudes(in);
    }
}

// The light that passes the volume, with hostile values. The numbers of a table are finite, and the
// steps are those of fhash_codec/rendering/light.py.
void light(Reader& in) {
    int64_t shape[3], points[3];
    const int64_t cell = in.within(1, 64);
    for (int axis = 0; axis < 3; axis++) {
        shape[axis] = in.within(1, axis == 2 ? 40 : 9);
        points[axis] = (shape[axis] - 1 + cell - 1) / cell + 1;
    }
    const std::vector<float> values = repeated<float>(in, shape[0] * shape[1] * shape[2]);
    const int64_t entries = in.within(2, 40);
    std::vector<float> table = repeated<float>(in, entries + 1);
    for (float& entry : table)
        entry = std::isfinite(entry) ? std::min(std::fabs(entry), 1e30F) : 0.0F;
    const double low = in.finite<double>(), scale = std::fabs(in.finite<double>());
    // Factors by which extinctions count: a share from 0 to 1 for each vertex, or none.
    std::vector<float> factors;
    if (in.within(0, 1)) factors = repeated<float>(in, shape[0] * shape[1] * shape[2]);
    for (float& factor : factors)
        factor = std::isfinite(factor) ? std::min(std::fabs(factor), 1.0F) : 0.0F;
    std::vector<float> extinction(static_cast<std::size_t>(points[0] * points[1] * points[2])),
        scratch(static_cast<std::size_t>(shape[2]));
    fhash_march_extinction(values.data(), shape, table.data(), entries, low, scale, cell, points, 0,
                           points[0], factors.empty() ? nullptr : factors.data(),
                           extinction.data(), scratch.data());
    double step[3];
    for (double& length : step) length = std::remainder(in.finite<double>(), 16.0);
    std::vector<float> sum(extinction.size());
    fhash_march_sum(extinction.data(), points, step, in.within(1, 60), 0, points[0], sum.data());
    for (std::size_t i = 0; i < sum.size(); i++) {
        if (extinction[i] >= 0 && sum[i] >= 0) continue;
        std::fprintf(stderr, "extinctions of %g and a sum of %g\n",
                     static_cast<double>(extinction[i]), static_cast<double>(sum[i]));
        std::abort();
    }
}

// Values smoothed for shading, and factors of opacity by gradient, as
// fhash_codec/rendering/bricks.py and slopes.py ask for them: values are finite or NaN,
// weights add up to 1, and factors are from 0 to 1.
namespace {

std::vector<float> frame_of(Reader& in, const int64_t* shape) {
    std::vector<float> values = repeated<float>(in, shape[0] * shape[1] * shape[2]);
    for (float& value : values)
        if (std::isinf(value)) value = std::numeric_limits<float>::quiet_NaN();
    return values;
}

// Weights of a value itself and of those 1, 2 and so on vertices away, on both sides.
std::vector<float> weights_of(Reader& in) {
    const int64_t radius = in.within(0, 12);
    std::vector<double> weights;
    double sum = 0;
    for (int64_t away = 0; away <= radius; away++) {
        weights.push_back(1 + in.byte());
        sum += (away ? 2 : 1) * weights.back();
    }
    std::vector<float> result;
    for (const double weight : weights) result.push_back(static_cast<float>(weight / sum));
    return result;
}

void smooth(Reader& in, const int64_t* shape, const std::vector<float>& values) {
    const std::vector<float> weights = weights_of(in);
    const int64_t radius = static_cast<int64_t>(weights.size()) - 1;
    std::vector<float> flat(values.size()), out(values.size());
    for (int64_t z = 0; z < shape[0]; z++) {
        std::vector<float> scratch(static_cast<std::size_t>(shape[1] * shape[2]));
        fhash_march_smooth_layers(values.data(), shape, weights.data(), radius, z, z + 1,
                                  flat.data(), scratch.data());
    }
    for (int64_t y = 0; y < shape[1]; y++)
        fhash_march_smooth_rows(flat.data(), shape, weights.data(), radius, y, y + 1, out.data());
    for (std::size_t i = 0; i < values.size(); i++)
        require(!std::isnan(values[i]) || std::isnan(out[i]), "a missing value that is there");
}

void factors(Reader& in, const int64_t* shape, const std::vector<float>& values) {
    const int64_t entries = in.within(2, 200);
    std::vector<float> table;
    for (const std::uint8_t factor : repeated<std::uint8_t>(in, entries))
        table.push_back(static_cast<float>(factor) / 255);
    table.push_back(table.back());
    double scale[3];
    for (double& along : scale) along = std::fabs(in.finite<double>());
    std::vector<float> out(values.size());
    fhash_march_factors(values.data(), shape, scale, table.data(), entries, 0, shape[0],
                        out.data());
    for (const float factor : out) require(factor >= 0 && factor <= 1, "a factor beyond 0 to 1");
}

}  // namespace

void slopes(Reader& in) {
    const bool by_gradient = in.byte() & 1;
    int64_t shape[3];
    for (int64_t& length : shape) length = in.within(1, 20);
    const std::vector<float> values = frame_of(in, shape);
    if (by_gradient) factors(in, shape, values);
    else smooth(in, shape, values);
}

// What an encoder learns from a tile: products of its lines, and inputs of the head for drawn
// voxels. Values may be anything; places and numbers are those of fhash_codec/compact/choices.
namespace {

const int64_t INPUTS = 28, NEIGHBOURS = 26, BLOCK = 64;
const std::int16_t MAX_INPUT = 4095;

auto gram_of(const float*) { return fhash_gram_f32; }
auto gram_of(const double*) { return fhash_gram_f64; }

// The products are symmetric.
template <class T> void products(Reader& in) {
    const int64_t before = in.within(1, 5), length = in.within(1, 40), after = in.within(1, 150);
    const std::vector<T> values = repeated<T>(in, before * length * after);
    const double center = in.finite<double>();
    std::vector<double> out(static_cast<std::size_t>(length * length));
    require(gram_of(values.data())(values.data(), before, length, after, center, out.data()) == 0,
            "products that are refused");
    for (int64_t i = 0; i < length; i++)
        for (int64_t j = 0; j < i; j++) {
            const double one = out[static_cast<std::size_t>(i * length + j)];
            const double other = out[static_cast<std::size_t>(j * length + i)];
            require(one == other || (std::isnan(one) && std::isnan(other)), "other products");
        }
}

// Offsets (n, 4) of up to `reach` vertices along each axis.
std::vector<int64_t> offsets_of(Reader& in, int64_t n, int64_t reach) {
    std::vector<int64_t> offsets;
    for (int64_t i = 0; i < 4 * n; i++) offsets.push_back(in.within(0, 2 * reach) - reach);
    return offsets;
}

void inputs(Reader& in) {
    const std::uint8_t how = in.byte();
    const std::vector<int64_t> shape = small_shape(in, 9);
    const std::vector<float> decoded = repeated<float>(in, volume(shape));
    const int64_t blocks = in.within(1, 3), count = in.within(0, 255) % (blocks * BLOCK + 1);
    const std::vector<int64_t> neighbours = offsets_of(in, NEIGHBOURS, how & 2 ? 3 : 2);
    std::vector<int64_t> places, slots;
    for (std::size_t axis = 0; axis < 4; axis++) {
        const std::vector<std::uint8_t> some = repeated<std::uint8_t>(in, count);
        for (const std::uint8_t place : some) places.push_back(place % shape[axis]);
    }
    for (int64_t i = 0; i < count; i++) slots.push_back((i * 67 + 5) % (blocks * BLOCK));
    float low = in.finite<float>(), high = in.finite<float>();
    if (low > high) std::swap(low, high);
    const float sigma = std::ldexp(1.0F + static_cast<float>(in.byte()) / 256,
                                   static_cast<int>(in.within(-100, 99)));
    const float span = high - low;
    const double unit = span > 0 ? 1024.0F / span : 0.0F;
    std::vector<std::int16_t> out(static_cast<std::size_t>(blocks * INPUTS * BLOCK));
    const int64_t code = fhash_head_inputs(
        decoded.data(), shape.data(), places.data(), slots.data(), count, neighbours.data(), low,
        high, 0.5F / sigma, unit, out.data());
    bool near = true;
    for (const int64_t step : neighbours) near &= std::abs(step) <= 2;
    require(code == (near ? 0 : -1), "offsets that are refused, or are not");
    for (const std::int16_t input : out)
        require(std::abs(input) <= MAX_INPUT, "an input beyond its limit");
}

}  // namespace

void samples(Reader& in) {
    switch (in.byte() % 3) {
        case 0: products<float>(in); break;
        case 1: products<double>(in); break;
        default: inputs(in);
    }
}
