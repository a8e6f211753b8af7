// Training of the head, with voxels and learning rates at the limits that the sampling sets
// (fhash_codec/compact/head_training.py).
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

const int64_t INPUTS = 28, BLOCK = 64;
const int MAX_INPUT = 4095;
const std::int32_t MAX_TARGET = 1 << 30;

// The state of a training: weights and biases, and Adam's means of them.
struct Training {
    std::vector<double> parameters, means, squares;
    bool operator==(const Training& other) const {
        return parameters == other.parameters && means == other.means && squares == other.squares;
    }
};

struct Voxels {
    int64_t sizes[6];  // batches, blocks, voxels of a block, voxels looked at, two widths
    std::vector<std::int16_t> inputs;
    std::vector<std::int32_t> targets, lowest, highest;
};

Voxels make_voxels(Reader& in) {
    Voxels voxels;
    const std::uint8_t widths = in.byte();
    const int64_t most = widths < 4 ? 64 : 6;  // large ones take long
    voxels.sizes[0] = in.within(1, 3);
    voxels.sizes[1] = in.within(1, widths % 64 ? 2 : 64);
    voxels.sizes[2] = BLOCK;
    voxels.sizes[3] = in.byte() & 1 ? 9 : 1;
    voxels.sizes[4] = in.within(1, most);
    voxels.sizes[5] = in.within(1, most);
    const int64_t blocks = voxels.sizes[0] * voxels.sizes[1];
    voxels.inputs = repeated<std::int16_t>(in, blocks * INPUTS * voxels.sizes[3] * BLOCK);
    for (std::int16_t& input : voxels.inputs)
        input = static_cast<std::int16_t>(std::clamp<int>(input, -MAX_INPUT, MAX_INPUT));
    const auto limited = [&](std::int32_t low, std::int32_t high) {
        std::vector<std::int32_t> numbers = repeated<std::int32_t>(in, blocks * BLOCK);
        for (std::int32_t& number : numbers) number = std::clamp(number, low, high);
        return numbers;
    };
    voxels.targets = limited(-MAX_TARGET, MAX_TARGET);
    voxels.lowest = limited(-MAX_TARGET, 0);
    voxels.highest = limited(0, MAX_TARGET);
    return voxels;
}

Training make_training(Reader& in, const int64_t* sizes) {
    const int64_t count = (INPUTS + 1) * sizes[4] + (sizes[4] * sizes[3] + 1) * sizes[5] +
                          (sizes[5] + 1);
    Training training;
    const int exponent = static_cast<int>(in.within(-40, 6));
    for (const std::int8_t number : repeated<std::int8_t>(in, count))
        training.parameters.push_back(
            std::clamp(std::ldexp(static_cast<double>(number) / 128, exponent), -64.0, 64.0));
    training.means.assign(training.parameters.size(), 0);
    training.squares = training.means;
    return training;
}

int64_t learn(const Voxels& voxels, Training& training, const double* rates, const double* roots,
              int64_t first, int64_t count, bool as_in_file) {
    return fhash_head_learn(voxels.inputs.data(), voxels.targets.data(), voxels.lowest.data(),
                            voxels.highest.data(), voxels.sizes, training.parameters.data(),
                            training.means.data(), training.squares.data(), rates, roots, first,
                            count, as_in_file);
}

}  // namespace

void train(Reader& in) {
    const bool as_in_file = in.byte() & 1;
    const int64_t first = in.byte(), count = in.within(0, 4), part = in.within(0, count);
    const Voxels voxels = make_voxels(in);
    Training training = make_training(in, voxels.sizes), again = training;
    std::vector<double> rates, roots;
    for (int64_t update = 0; update < count; update++) {
        rates.push_back(static_cast<double>(in.byte()) / 16);
        roots.push_back(1 + static_cast<double>(in.byte()) / 8);
    }
    require(learn(voxels, training, rates.data(), roots.data(), first, count, as_in_file) == 0,
            "a training that is refused");
    for (const double number : training.parameters)
        require(std::fabs(number) <= 64, "a weight beyond its limit");
    // In two calls the same updates give the same numbers.
    require(learn(voxels, again, rates.data(), roots.data(), first, part, as_in_file) == 0 &&
                learn(voxels, again, rates.data() + part, roots.data() + part, first + part,
                      count - part, as_in_file) == 0,
            "a training in two calls that is refused");
    require(training == again, "a training in two calls that gives other numbers");
    std::vector<int64_t> sums(static_cast<std::size_t>(voxels.sizes[0]), -1);
    require(fhash_head_errors(voxels.inputs.data(), voxels.targets.data(), voxels.lowest.data(),
                              voxels.highest.data(), voxels.sizes, training.parameters.data(),
                              as_in_file, sums.data()) == 0,
            "errors that are refused");
    for (const int64_t sum : sums) require(sum >= 0, "a negative sum of squares");
}
