// The figures of how far decoded values are from the original. Scales and bins are those of
// fhash_codec/measure: numbers times the scale are finite, and so is the number of bins per unit.
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

template <class T> struct Functions {
    int64_t (*scan)(const T*, int64_t, double, double*);
    int64_t (*errors)(const T*, const T*, const std::uint8_t*, int64_t, double, double*);
    int64_t (*bulk_errors)(const T*, const T*, const std::uint8_t*, int64_t, double, double, double,
                           double*);
    int64_t (*histogram)(const T*, int64_t, double, double, double, int64_t, int64_t*);
    int64_t (*ssim)(const T*, const T*, const std::uint8_t*, const int64_t*, const int64_t*,
                    const double*, double*);
};

const Functions<float> SINGLE{fhash_scan_f32, fhash_errors_f32, fhash_bulk_errors_f32,
                              fhash_histogram_f32, fhash_ssim_f32};
const Functions<double> DOUBLE{fhash_scan_f64, fhash_errors_f64, fhash_bulk_errors_f64,
                               fhash_histogram_f64, fhash_ssim_f64};

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

// The number of the values that count is the same for all figures.
template <class T> void compare_values(Reader& in, const Functions<T>& functions) {
    const int64_t n = in.word() % 3000;
    const std::vector<T> one = repeated<T>(in, n), other = repeated<T>(in, n);
    const std::vector<std::uint8_t> mask = repeated<std::uint8_t>(in, n);
    const std::uint8_t* const chosen = in.byte() & 1 ? mask.data() : nullptr;
    const double factor = in.finite<double>(), scale = std::ldexp(1.0, -1 - in.byte());
    double found[4] = {};
    const int64_t finite = functions.scan(one.data(), n, factor, found);
    const double low = found[0], high = found[1];
    const int64_t all =
        functions.errors(one.data(), other.data(), chosen, n, scale, found);
    const double first = in.finite<double>(), second = in.finite<double>();
    double bulk[4] = {};
    const int64_t same = functions.bulk_errors(one.data(), other.data(), chosen, n, scale,
                                               std::min(first, second), std::max(first, second),
                                               bulk);
    require(all == same && all <= finite, "another number of values");
    if (all >= 0) require(bulk[0] == found[0] && bulk[3] <= static_cast<double>(all), "other sums");
    if (finite > 0) count_values(in, functions, one, low, high, finite);
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
