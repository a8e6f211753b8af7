// Training of the neighbourhood head: Adam on the squared errors of batches of voxels.
// compact/head_training.py states the arithmetic.
#include "loops.hpp"

#include <atomic>
#include <memory>
#include <system_error>
#include <thread>

#include "codec.h"
#include "guard.hpp"
#include "train_head.hpp"

namespace {

const int64_t BAD_ARGUMENT = -1;
const double BETA1 = 0.9, BETA2 = 0.999, EPSILON = 1e-8;
const double MAX_NORM = 1;        // of a gradient
const double MAX_PARAMETER = 64;  // magnitude of a weight or bias in training

// The float16 number nearest to a positive number below 65504, ties to even.
double nearest_half(double value) {
    int exponent;
    std::frexp(value, &exponent);
    const double quantum = std::ldexp(1.0, exponent < -13 ? -24 : exponent - 11);
    return rounded(value / quantum) * quantum;
}

// One layer: its integers, as the file or a finer unit has them, and the sums of its slopes.
struct Layer {
    int64_t inputs, outputs;
    const double *weights, *biases;             // the parameters that are trained
    Buffer integers, transposed;   // (outputs, inputs) and (inputs, outputs)
    Buffer used_biases;            // biases as they are used
    double scale = 0;                           // of the integers
    Buffer weight_sums, bias_sums;  // eight lanes each

    int64_t size() const { return outputs * (inputs + 1); }

    void prepare(bool as_in_file) {
        const int64_t count = outputs * inputs;
        scale = as_in_file ? file_scale(weights, count, MAX_INTEGERS[0]) : 1 / WEIGHT_UNIT;
        const double most = as_in_file ? MAX_INTEGERS[0] : WEIGHT_UNIT * MAX_PARAMETER;
        for (int64_t o = 0; o < outputs; ++o)
            for (int64_t k = 0; k < inputs; ++k) {
                const double integer = limited(rounded(weights[o * inputs + k] / scale), most);
                integers[o * inputs + k] = transposed[k * outputs + o] = integer;
            }
        const double unit = file_scale(biases, outputs, MAX_INTEGERS[1]);
        for (int64_t o = 0; o < outputs; ++o)
            used_biases[o] = as_in_file
                                 ? limited(rounded(biases[o] / unit), MAX_INTEGERS[1]) * unit
                                 : biases[o];
    }

    static double file_scale(const double* values, int64_t count, double most) {
        double largest = 0;
        for (int64_t i = 0; i < count; ++i) {
            const double magnitude = std::fabs(values[i]);
            largest = magnitude > largest ? magnitude : largest;
        }
        const double scale = largest / most;
        return nearest_half(scale > MIN_SCALE ? scale : MIN_SCALE);
    }
};

// Batches of voxels; their layout is that of `Batches` in head_samples.py.
struct Voxels {
    const int16_t* inputs;                      // (batches, blocks, INPUTS, BLOCK)
    const int32_t *targets, *lowest, *highest;  // (batches, blocks, BLOCK)
    const float* weights;                       // likewise, up to 1
    int64_t blocks;

    const int16_t* input(int64_t block, int64_t k) const {
        return inputs + (block * INPUTS + k) * BLOCK;
    }
};

class Network {
public:
    Network(double* parameters_, int64_t first, int64_t second)
        : parameters(parameters_),
          input(INPUTS * BLOCK),
          activations{Buffer(first * BLOCK), Buffer(second * BLOCK)},
          slopes{Buffer(first * BLOCK), Buffer(second * BLOCK)},
          error(BLOCK),
          weighted(BLOCK),
          error_slopes(BLOCK) {
        const int64_t inputs[LAYERS] = {INPUTS, first, second};
        const int64_t outputs[LAYERS] = {first, second, 1};
        const double* at = parameters;
        for (int l = 0; l < LAYERS; ++l) {
            Layer& layer = layers[l];
            layer.inputs = inputs[l];
            layer.outputs = outputs[l];
            layer.weights = at;
            layer.biases = at + outputs[l] * inputs[l];
            at += layer.size();
            layer.integers = Buffer(outputs[l] * inputs[l]);
            layer.transposed = Buffer(outputs[l] * inputs[l]);
            layer.used_biases = Buffer(outputs[l]);
            layer.weight_sums = Buffer(outputs[l] * inputs[l] * LANES);
            layer.bias_sums = Buffer(outputs[l] * LANES);
        }
        gradient = Buffer(at - parameters);
    }

    void prepare(bool as_in_file) {
        for (Layer& layer : layers) layer.prepare(as_in_file);
    }

    // The errors of a block, into `error`.
    void forward(const Voxels& voxels, int64_t block) {
        Layer &one = layers[0], &two = layers[1], &three = layers[2];
        load(voxels, block);
        products(input.data(), INPUTS, one.integers.data(), one.outputs, activations[0].data(),
                 BLOCK);
        activate(activations[0].data(), two.inputs, one.scale * (ACTIVATION_UNIT / INPUT_UNIT),
                 one.used_biases.data());
        products(activations[0].data(), two.inputs, two.integers.data(), two.outputs,
                 activations[1].data(), BLOCK);
        activate(activations[1].data(), two.outputs, two.scale, two.used_biases.data());
        products(activations[1].data(), three.inputs, three.integers.data(), 1, error.data(),
                 BLOCK);
        const int64_t at = block * BLOCK;
        errors_of(error.data(), three.scale * (ERROR_UNIT / ACTIVATION_UNIT), three.used_biases[0],
                  voxels.targets + at, voxels.lowest + at, voxels.highest + at,
                  voxels.weights + at, weighted.data(), error_slopes.data());
    }

    // Add the slopes of a block, after `forward`, to the sums.
    void backward(const Voxels& voxels, int64_t block) {
        Layer &one = layers[0], &two = layers[1], &three = layers[2];
        gather(error_slopes.data(), BLOCK, 1, activations[1].data(), three.inputs,
               three.weight_sums.data());
        gather_biases(error_slopes.data(), 1, three.bias_sums.data());
        products(error_slopes.data(), 1, three.transposed.data(), two.outputs, slopes[1].data(),
                 BLOCK);
        descend(slopes[1].data(), two.outputs, three.scale, activations[1].data());
        gather(slopes[1].data(), BLOCK, two.outputs, activations[0].data(), two.inputs,
               two.weight_sums.data());
        gather_biases(slopes[1].data(), two.outputs, two.bias_sums.data());
        products(slopes[1].data(), two.outputs, two.transposed.data(), two.inputs,
                 slopes[0].data(), BLOCK);
        descend(slopes[0].data(), two.inputs, two.scale, activations[0].data());
        gather_biases(slopes[0].data(), one.outputs, one.bias_sums.data());
        // `input` is still that of `forward`.
        gather(slopes[0].data(), BLOCK, one.outputs, input.data(), INPUTS,
               one.weight_sums.data());
    }

    // Begin to add up slopes.
    void begin(bool as_in_file) {
        prepare(as_in_file);
        for (Layer& layer : layers) {
            layer.weight_sums.clear();
            layer.bias_sums.clear();
        }
    }

    // Add the sums that another network of the same parameters has found.
    void add(const Network& other) {
        for (int l = 0; l < LAYERS; ++l) {
            layers[l].weight_sums.add(other.layers[l].weight_sums);
            layers[l].bias_sums.add(other.layers[l].bias_sums);
        }
    }

    // One step of Adam along the gradient of the mean squared error, shortened to MAX_NORM.
    void step(int64_t voxel_count, double* means, double* squares, double rate, double root) {
        const double units[LAYERS] = {INPUT_UNIT, ACTIVATION_UNIT, ACTIVATION_UNIT};
        int64_t number = 0;
        const double per_voxel = 2 / (ERROR_UNIT * (double)voxel_count);
        for (int l = 0; l < LAYERS; ++l) {
            const Layer& layer = layers[l];
            for (int64_t i = 0; i < layer.outputs * layer.inputs; ++i)
                gradient[number++] =
                    lane_sum(&layer.weight_sums[i * LANES]) * (per_voxel / units[l]);
            for (int64_t o = 0; o < layer.outputs; ++o)
                gradient[number++] = lane_sum(&layer.bias_sums[o * LANES]) * per_voxel;
        }
        double squared_norm = 0;
        for (int64_t i = 0; i < number; ++i) squared_norm += gradient[i] * gradient[i];
        const double norm = std::sqrt(squared_norm);
        const double shrink = norm > MAX_NORM ? MAX_NORM / norm : 1;
        for (int64_t i = 0; i < number; ++i) {
            const double slope = gradient[i] * shrink;
            means[i] = means[i] + (slope - means[i]) * (1 - BETA1);
            squares[i] = squares[i] + (slope * slope - squares[i]) * (1 - BETA2);
            const double move = rate * means[i] / (std::sqrt(squares[i]) * root + EPSILON);
            parameters[i] = limited(parameters[i] - move, MAX_PARAMETER);
        }
    }

    // The sum of the squared errors of a block by their weights, after `forward`.
    int64_t squared_errors() const {
        int64_t sum = 0;
        for (int64_t i = 0; i < BLOCK; ++i) sum += (int64_t)error[i] * (int64_t)weighted[i];
        return sum;
    }

private:
    static double lane_sum(const double* lanes) {
        double sum = 0;
        for (int64_t i = 0; i < LANES; ++i) sum += lanes[i];
        return sum;
    }

    void load(const Voxels& voxels, int64_t block) {
        for (int64_t k = 0; k < INPUTS; ++k) widened(voxels.input(block, k), &input[k * BLOCK]);
    }

    double* const parameters;
    Layer layers[LAYERS];
    Buffer input, activations[2], slopes[2], error, weighted, error_slopes, gradient;
};

// Threads that add up the slopes of a batch together: sums are exact in any order, so their number
// changes nothing. Each takes the next block, so that none waits for one that has no processor.
class Team {
public:
    Team(double* parameters, const int64_t* sizes, const Voxels& of, int64_t threads, bool round)
        : voxels(of), rounds(round), next(voxels.blocks) {
        for (int64_t i = 0; i < std::max<int64_t>(threads, 1); ++i) {
            auto network = std::make_unique<Network>(parameters, sizes[3], sizes[4]);
            members.push_back({std::move(network)});
        }
        helpers.reserve(members.size());
        try {
            for (size_t i = 1; i < members.size(); ++i)
                helpers.emplace_back([this, i] { help(members[i]); });
        } catch (const std::system_error&) {  // no more threads can be started
        }
    }
    ~Team() {
        ended = true;
        for (std::thread& helper : helpers) helper.join();
    }
    Team(const Team&) = delete;
    Team& operator=(const Team&) = delete;

    // The sums of all blocks of a batch.
    Network& learn(int64_t number) {
        batch = number;
        done = 0;
        next = ++turn << TURN_BITS;
        while (work(members[0])) {}
        while (done < voxels.blocks) std::this_thread::yield();
        Network& sums = *members[0].network;
        if (members[0].turn != turn) sums.begin(rounds);
        for (size_t i = 1; i < members.size(); ++i)
            if (members[i].turn == turn) sums.add(*members[i].network);
        return sums;
    }

private:
    static const int TURN_BITS = 16;  // of the number of a block
    struct Member {
        std::unique_ptr<Network> network;
        int64_t turn = 0;  // the last one in which it took a block
    };

    // Take a block of the turn, and add its slopes; false where none is left.
    bool work(Member& member) {
        int64_t place = next;
        do {
            if ((place & ((1 << TURN_BITS) - 1)) >= voxels.blocks) return false;
        } while (!next.compare_exchange_weak(place, place + 1));
        // Nothing of the turn changes until this block is done.
        if (member.turn != place >> TURN_BITS) member.network->begin(rounds);
        member.turn = place >> TURN_BITS;
        const int64_t block = batch * voxels.blocks + (place & ((1 << TURN_BITS) - 1));
        member.network->forward(voxels, block);
        member.network->backward(voxels, block);
        ++done;
        return true;
    }

    // A turn takes a tenth of a millisecond: too little to sleep in between.
    void help(Member& member) {
        while (!ended)
            if (!work(member)) std::this_thread::yield();
    }

    const Voxels voxels;
    const bool rounds;  // weights and biases as in the file
    std::vector<Member> members;
    int64_t turn = 0, batch = 0;
    std::atomic<int64_t> next, done{0};  // next: the turn, and the block that is taken next
    std::atomic<bool> ended{false};
    std::vector<std::thread> helpers;
};

bool fits(const int64_t* sizes) {
    return sizes[0] > 0 && sizes[1] > 0 && sizes[1] <= MAX_BLOCKS && sizes[2] == BLOCK &&
           sizes[3] > 0 && sizes[3] <= MAX_WIDTH && sizes[4] > 0 && sizes[4] <= MAX_WIDTH;
}

}  // namespace

// Do the updates first .. first + count - 1 of a training. Update u learns from batch u % batches.
//
// weights: of the squared errors, up to 1 (batches, blocks, voxels).
// sizes: batches, blocks of a batch, voxels of a block, widths of the two hidden layers.
// parameters, means, squares: weights and biases of each layer in turn, and Adam's means of them.
// rates, roots: of each update, the learning rate and the factor of the root of the mean square,
// both corrected for Adam's start.
// as_in_file: whether weights and biases are rounded as in the file.
// threads: that may work on a batch together.
FHASH_EXPORT int64_t fhash_head_learn(const int16_t* inputs, const int32_t* targets,
                                      const int32_t* lowest, const int32_t* highest,
                                      const float* weights, const int64_t* sizes,
                                      double* parameters, double* means,
                                      double* squares, const double* rates, const double* roots,
                                      int64_t first, int64_t count, int64_t as_in_file,
                                      int64_t threads) {
    if (!fits(sizes)) return BAD_ARGUMENT;
    return guarded([&]() -> int64_t {
        const Voxels voxels = {inputs, targets, lowest, highest, weights, sizes[1]};
        Team team(parameters, sizes, voxels, std::min(threads, sizes[1]), as_in_file != 0);
        for (int64_t update = 0; update < count; ++update) {
            Network& network = team.learn((first + update) % sizes[0]);
            network.step(voxels.blocks * BLOCK, means, squares, rates[update], roots[update]);
        }
        return 0;
    });
}

// sums: of the weighted squared errors of each batch, in squares of the unit of errors.
FHASH_EXPORT int64_t fhash_head_errors(const int16_t* inputs, const int32_t* targets,
                                       const int32_t* lowest, const int32_t* highest,
                                       const float* weights, const int64_t* sizes,
                                       double* parameters,
                                       int64_t as_in_file, int64_t* sums) {
    if (!fits(sizes)) return BAD_ARGUMENT;
    return guarded([&]() -> int64_t {
        const Voxels voxels = {inputs, targets, lowest, highest, weights, sizes[1]};
        Network network(parameters, sizes[3], sizes[4]);
        network.prepare(as_in_file != 0);
        for (int64_t batch = 0; batch < sizes[0]; ++batch) {
            sums[batch] = 0;
            for (int64_t block = 0; block < voxels.blocks; ++block) {
                network.forward(voxels, batch * voxels.blocks + block);
                sums[batch] += network.squared_errors();
            }
        }
        return 0;
    });
}
