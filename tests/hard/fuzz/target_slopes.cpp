// Values smoothed for shading, and factors of opacity by gradient, as
// fhash_codec/rendering/bricks.py and slopes.py ask for them: values are finite or NaN,
// weights add up to 1, and factors are from 0 to 1.
#include <algorithm>
#include <cmath>
#include <limits>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

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
