// Encoders: what they write must decode to their input; labels, and training of the head. A
// difference ends the process.
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

// The output of each encoder must decode to its input; a difference ends the process.
namespace {

// Calls an encoder with little room and, if that is not enough, with as much as it asked for. The
// memory has exactly the length of the data.
template <class F> std::vector<std::uint8_t> coded(std::size_t room, F encode) {
    std::vector<std::uint8_t> data(room);
    const int64_t size = encode(data);
    require(size >= 0, "an encoder refuses what it is for");
    if (static_cast<std::size_t>(size) > room) {
        data.assign(static_cast<std::size_t>(size), 0);
        require(encode(data) == size, "another size the second time");
    }
    data.resize(static_cast<std::size_t>(size));
    data.shrink_to_fit();
    return data;
}

int64_t length(const std::vector<std::uint8_t>& data) { return static_cast<int64_t>(data.size()); }

// Integers within +-most; mostly small ones, as coders get them.
std::vector<std::int32_t> bounded(Reader& in, int64_t n, std::int32_t most) {
    const std::uint8_t shift = in.byte() % 32;
    std::vector<std::int32_t> values = integers(in, n);
    for (std::int32_t& value : values)
        value =
            std::max(-most, std::min(most, value / (std::int32_t{1} << std::min<int>(shift, 30))));
    return values;
}

int64_t bands_of(const Bands& with) { return static_cast<int64_t>(with.table.size() / 29); }

// How integers are coded: whether as those of two quantisers, and whether the encoder leaves its
// state adapted.
struct How {
    bool trellis, keep;
};

// Codes integers and decodes them. With `scaled`, the encoder chooses the integers; without, it
// must not change them.
std::vector<std::int32_t> there_and_back(const Bands& with, std::vector<std::int32_t>& q,
                                         const std::vector<float>& scaled, double lambda,
                                         std::size_t room, How how) {
    const State& prior = setups().coders[how.trellis];
    State state = prior;
    const std::vector<std::int32_t> given = q;
    const int64_t bands = bands_of(with);
    const std::vector<std::uint8_t> data = coded(room, [&](std::vector<std::uint8_t>& into) {
        q = given;
        return fhash_encode(q.data(), scaled.empty() ? nullptr : scaled.data(), lambda, how.trellis,
                            with.shape.data(), with.table.data(), bands,
                            state.slots.data(), static_cast<int64_t>(state.slots.size() / 4),
                            state.weights.data(), static_cast<int64_t>(state.weights.size()),
                            state.simples.data(), static_cast<int64_t>(state.simples.size() / 2),
                            how.keep, into.data(), length(into));
    });
    require(!scaled.empty() || q == given, "integers that the encoder changed");
    std::vector<std::int32_t> decoded(q.size(), 0);
    const int64_t code = fhash_decode(
        decoded.data(), how.trellis, with.shape.data(), with.table.data(), bands,
        prior.slots.data(), static_cast<int64_t>(prior.slots.size() / 4), prior.weights.data(),
        static_cast<int64_t>(prior.weights.size()), prior.simples.data(),
        static_cast<int64_t>(prior.simples.size() / 2), data.data(), length(data));
    require(code == 0, "bytes of the encoder are refused");
    return decoded;
}

// 1 for each vertex that a band of the table covers; integers elsewhere are coded as 0.
const std::vector<std::int32_t>& inside(std::size_t number) {
    static std::vector<std::vector<std::int32_t>> covered(setups().bands.size());
    if (covered[number].empty()) {
        const Bands& with = setups().bands[number];
        std::vector<std::int32_t> ones(static_cast<std::size_t>(volume(with.shape)), 1);
        covered[number] = there_and_back(with, ones, {}, 0, 0, {false, false});
    }
    return covered[number];
}

void of_integers(Reader& in) {
    const std::size_t number = in.word() % setups().bands.size();
    const Bands& with = setups().bands[number];
    const std::size_t room = 4U * in.byte();
    const std::uint8_t how = in.byte();
    const bool choose = how & 1;
    const double lambda = choose ? std::ldexp(1.0, static_cast<int>(in.within(-20, 10))) : 0;
    // Magnitudes to choose are exact in float32.
    std::vector<std::int32_t> q =
        bounded(in, volume(with.shape), choose ? (1 << 23) - 1 : (1 << 30) - 1);
    std::vector<float> scaled(choose ? q.size() : 0);
    for (std::size_t i = 0; i < scaled.size(); i++)
        scaled[i] =
            static_cast<float>(q[i]) + static_cast<float>(static_cast<int>(i % 15) - 7) / 16;
    const std::vector<std::int32_t> decoded =
        there_and_back(with, q, scaled, lambda, room, {false, how >= 128});
    for (std::size_t i = 0; i < q.size(); i++)
        require(decoded[i] == (inside(number)[i] ? q[i] : 0), "other integers");
}

// The functions that choose integers of two quantisers, by the type of the coefficients.
auto guess(const float*) { return fhash_trellis_guess_f32; }
auto guess(const double*) { return fhash_trellis_guess_f64; }
auto choose(const float*) { return fhash_trellis_choose_f32; }
auto choose(const double*) { return fhash_trellis_choose_f64; }

// Vertices of all bands.
std::size_t vertices_of(const Bands& with) {
    std::size_t sum = 0;
    for (std::size_t row = 0; row < with.table.size(); row += 29) {
        std::size_t size = 1;
        for (std::size_t a = 0; a < 4; a++)
            size *= static_cast<std::size_t>(with.table[row + 4 + a] - with.table[row + a]);
        sum += size;
    }
    return sum;
}

// The integers of the path that is cheapest by hostile rates.
template <class T>
std::vector<std::int32_t> path_of(Reader& in, const Bands& with, const std::vector<T>& scaled) {
    const int64_t buckets = 64, rates = 24, most = 1 << 19;  // as in trellis.cpp
    std::vector<std::uint8_t> bucket(vertices_of(with));
    std::vector<int64_t> counts(2 * buckets * rates);
    std::vector<std::int32_t> costs = repeated<std::int32_t>(in, 2 * buckets * rates);
    for (std::int32_t& cost : costs)
        cost = static_cast<std::int32_t>((cost & 0xfffff) % (most + 1));
    const int64_t *const shape = with.shape.data(), bands = bands_of(with);
    const std::int32_t* const table = with.table.data();
    std::vector<std::int32_t> levels(scaled.size(), 0);
    const auto all_counted = [&] {
        int64_t sum = 0;
        for (const int64_t count : counts) sum += count;
        require(sum == static_cast<int64_t>(bucket.size()), "another number of indices");
    };
    require(guess(scaled.data())(scaled.data(), shape, table, bands, bucket.data(),
                                 counts.data()) == 0,
            "coefficients of which no path is guessed");
    all_counted();
    for (int turn = in.byte() & 1; turn >= 0; turn--) {
        std::fill(levels.begin(), levels.end(), 0);
        require(choose(scaled.data())(scaled.data(), shape, table, bands, bucket.data(),
                                      costs.data(), levels.data()) == 0,
                "coefficients for which there is no path");
        std::fill(counts.begin(), counts.end(), 0);
        require(fhash_trellis_count(levels.data(), shape, table, bands, bucket.data(),
                                    counts.data()) == 0,
                "levels that are not counted");
        all_counted();
    }
    return levels;
}

// What the fast coder makes of numbers: null for what is not given.
int64_t fast(const Bands& with, std::int32_t* q, const float* values, bool trellis, double scale,
             double weight, std::vector<std::uint8_t>& into) {
    double results[2];
    const FastPrior& prior = setups().fast;
    const int64_t size = fhash_fast_encode(
        q, values, trellis, scale, weight, with.shape.data(), with.table.data(), bands_of(with),
        prior.slots.data(), prior.defaults.data(), into.data(), length(into), results);
    require(results[0] >= 0 && !(results[1] < 0), "a price below 0");
    return size;
}

// Integers come back from the fast coder, given ones or those chosen of hostile coefficients, which
// have a price, too.
void of_fast(Reader& in) {
    const std::size_t number = in.word() % setups().bands.size();
    const Bands& with = setups().bands[number];
    const std::size_t room = 4U * in.byte();
    const std::uint8_t how = in.byte();
    const bool choose = how & 1, trellis = choose && how & 2;
    std::vector<std::int32_t> q = bounded(in, volume(with.shape), (1 << 30) - 1);
    const std::vector<float> values = repeated<float>(in, choose ? volume(with.shape) : 0);
    const double scale = std::ldexp(1.0, static_cast<int>(in.within(-60, 60)));
    const double weight = in.byte() / 64.0;
    std::vector<std::uint8_t> none;
    if (choose)
        require(fast(with, nullptr, values.data(), false, scale, weight, none) == 0, "no price");
    const std::vector<std::uint8_t> data = coded(room, [&](std::vector<std::uint8_t>& into) {
        if (choose) std::fill(q.begin(), q.end(), 0);
        const float* const of = choose ? values.data() : nullptr;
        return fast(with, q.data(), of, trellis, scale, weight, into);
    });
    std::vector<std::int32_t> decoded(q.size(), 0);
    require(fhash_fast_decode(decoded.data(), trellis, with.shape.data(), with.table.data(),
                              bands_of(with), setups().fast.defaults.data(),
                              setups().fast.lookup.data(), data.data(), length(data)) == 0,
            "bytes of the fast coder are refused");
    for (std::size_t i = 0; i < q.size(); i++)
        require(decoded[i] == (inside(number)[i] ? q[i] : 0), "other integers of the fast coder");
}

// Integers of two quantisers: those of a path come back.
template <class T> void of_path(Reader& in) {
    const Bands& with = setups().bands[in.word() % setups().bands.size()];
    const std::size_t room = 4U * in.byte();
    const std::vector<std::int32_t> whole = bounded(in, volume(with.shape), 999999999);
    std::vector<T> scaled;
    for (std::size_t i = 0; i < whole.size(); i++)
        scaled.push_back(static_cast<T>(whole[i]) * static_cast<T>(0.999) +
                         static_cast<T>(i % 15) / 16);
    std::vector<std::int32_t> levels = path_of(in, with, scaled);
    require(there_and_back(with, levels, {}, 0, room, {true, false}) == levels,
            "other integers of two quantisers");
}

void of_masks(Reader& in) {
    const std::vector<int64_t> shape = small_shape(in, 8);
    State state = setups().mask;
    const std::size_t n = static_cast<std::size_t>(volume(shape)), room = in.byte();
    std::vector<std::uint8_t> level(n), other(n), mask = repeated<std::uint8_t>(in, volume(shape)),
                                                  decoded(n);
    mask_levels(in, in.byte() & 1, level, other);
    for (std::uint8_t& bit : mask) bit &= 1;
    const std::vector<std::uint8_t> data = coded(room, [&](std::vector<std::uint8_t>& into) {
        return fhash_encode_mask(
            mask.data(), level.data(), other.data(), shape.data(), state.slots.data(),
            static_cast<int64_t>(state.slots.size() / 4), state.weights.data(),
            static_cast<int64_t>(state.weights.size()), state.simples.data(),
            static_cast<int64_t>(state.simples.size() / 2), 0, into.data(), length(into));
    });
    const int64_t code = fhash_decode_mask(
        decoded.data(), level.data(), other.data(), shape.data(), state.slots.data(),
        static_cast<int64_t>(state.slots.size() / 4), state.weights.data(),
        static_cast<int64_t>(state.weights.size()), state.simples.data(),
        static_cast<int64_t>(state.simples.size() / 2), data.data(), length(data));
    require(code == 0 && decoded == mask, "another mask");
}

void of_predicted(Reader& in) {
    const Passes& with = setups().passes[in.word() % setups().passes.size()];
    const State& blank = setups().predictor;
    const std::vector<std::int16_t> weights = tap_weights(in, with);
    const bool all = in.byte() & 1;
    std::vector<std::int32_t> q = bounded(in, volume(with.shape), 1 << 27);
    std::vector<std::uint8_t> counted = repeated<std::uint8_t>(in, volume(with.shape));
    for (std::uint8_t& bit : counted) bit &= 1;
    const std::vector<std::int32_t> given = q;
    std::vector<std::uint8_t> data(static_cast<std::size_t>(40 * volume(with.shape) + 64));
    const int64_t passes = static_cast<int64_t>(with.passes.size() / 4);
    const int64_t size = fhash_encode_predicted(
        q.data(), all ? nullptr : counted.data(), with.shape.data(), with.levels.data(),
        with.passes.data(), passes, with.taps.data(), weights.data(), blank.slots.data(),
        static_cast<int64_t>(blank.slots.size() / 4), blank.weights.data(),
        static_cast<int64_t>(blank.weights.size()), blank.simples.data(),
        static_cast<int64_t>(blank.simples.size() / 2), data.data(), length(data));
    if (size == -1) return;  // a prediction out of bounds, for which Python takes other settings
    require(size >= 0 && size <= length(data), "more bytes than integers can take");
    data.resize(static_cast<std::size_t>(size));
    data.shrink_to_fit();
    for (std::size_t i = 0; i < q.size(); i++)
        require(q[i] == given[i] || !(all || counted[i]), "integers that matter were changed");
    std::vector<std::int32_t> decoded(q.size(), 0);
    const int64_t code = fhash_decode_predicted(
        decoded.data(), with.shape.data(), with.levels.data(), with.passes.data(), passes,
        with.taps.data(), weights.data(), blank.slots.data(),
        static_cast<int64_t>(blank.slots.size() / 4), blank.weights.data(),
        static_cast<int64_t>(blank.weights.size()), blank.simples.data(),
        static_cast<int64_t>(blank.simples.size() / 2), data.data(), length(data));
    require(code == 0 && decoded == q, "other predicted integers");
}

}  // namespace

void round_trip(Reader& in) {
    switch (in.byte() % 6) {
        case 0: of_integers(in); break;
        case 1: of_masks(in); break;
        case 2: of_predicted(in); break;
        case 3: of_path<float>(in); break;
        case 4: of_fast(in); break;
        default: of_path<double>(in);
    }
}

// The coder of labels: any bytes decode to labels below the count, and what it encodes comes back.
namespace {

using Bytes = std::vector<std::uint8_t>;

using Labels = std::vector<std::uint16_t>;

struct Tile {
    std::vector<int64_t> shape;
    int64_t count;  // of different labels
};

Labels decoded(const Tile& tile, const Bytes& data) {
    Labels labels(static_cast<std::size_t>(volume(tile.shape)), 255);
    const int64_t code = fhash_decode_labels(labels.data(), tile.count, tile.shape.data(),
                                             data.data(), static_cast<int64_t>(data.size()));
    require(code == 0, "bytes that are refused");
    for (const int64_t label : labels) require(label < tile.count, "a label that does not exist");
    return labels;
}

// The bytes of labels, by a first call with little room and a second one with as much as it asked
// for. The coder may write to its labels.
Bytes encoded(const Tile& tile, const Labels& labels, std::size_t room) {
    Bytes data(room);
    Labels work;
    const auto encode = [&] {
        work = labels;
        return fhash_encode_labels(work.data(), tile.count, tile.shape.data(), data.data(),
                                   static_cast<int64_t>(data.size()));
    };
    const int64_t size = encode();
    require(size >= 0, "labels that are refused");
    require(work == labels, "labels that the encoder changed");
    if (static_cast<std::size_t>(size) > room) {
        data.assign(static_cast<std::size_t>(size), 0);
        require(encode() == size, "another size the second time");
    }
    data.resize(static_cast<std::size_t>(size));
    data.shrink_to_fit();
    return data;
}

// Labels below a count in regions, of which the input says how long they are along x, y, z and t,
// and which vertices have a label of their own.
Labels drawn(Reader& in, const Tile& tile) {
    int64_t lengths[4];
    for (int64_t& length : lengths) length = in.within(1, 40);
    using Label = std::uint16_t;
    const Labels palette = in.numbers<Label>(16), others = in.numbers<Label>(8);
    const std::uint8_t noise = in.byte();
    Labels labels;
    std::size_t at = 0;
    for (int64_t t = 0; t < tile.shape[0]; t++)
        for (int64_t z = 0; z < tile.shape[1]; z++)
            for (int64_t y = 0; y < tile.shape[2]; y++)
                for (int64_t x = 0; x < tile.shape[3]; x++, at++) {
                    const int64_t region = x / lengths[0] + 3 * (y / lengths[1]) +
                                           5 * (z / lengths[2]) + 7 * (t / lengths[3]);
                    const bool alone = (at * 167 + at / 13) % 256 < noise;
                    const Label label =
                        alone ? static_cast<Label>(others[at % 8] + at / 8)
                              : palette[static_cast<std::size_t>(region) % palette.size()];
                    labels.push_back(static_cast<Label>(label % tile.count));
                }
    return labels;
}

Tile tile_of(Reader& in) {
    Tile tile;
    // Rows of up to three segments.
    for (const int64_t most : {4, 4, 6, 40}) tile.shape.push_back(in.within(1, most));
    // A byte, and another one that counts where it is odd: as many tiles of few labels as of many.
    const int64_t low = in.byte(), high = in.byte();
    tile.count = 1 + low + (high % 2 ? 256 * high : 0);
    return tile;
}

}  // namespace

void decode_label_bytes(Reader& in) {
    const Tile tile = tile_of(in);
    decoded(tile, in.rest());
}

void label_round_trip(Reader& in) {
    const Tile tile = tile_of(in);
    const std::size_t room = in.byte();
    const auto labels = drawn(in, tile);
    require(decoded(tile, encoded(tile, labels, room)) == labels, "other labels");
}

// Training of the head, with voxels and learning rates at the limits that the sampling sets
// (fhash_codec/compact/head_training.py).
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
    int64_t sizes[5];  // batches, blocks, voxels of a block, two widths
    std::vector<std::int16_t> inputs;
    std::vector<std::int32_t> targets, lowest, highest;
    std::vector<float> weights;
};

Voxels make_voxels(Reader& in) {
    Voxels voxels;
    const std::uint8_t widths = in.byte();
    const int64_t most = widths < 4 ? 64 : 6;  // large ones take long
    voxels.sizes[0] = in.within(1, 3);
    voxels.sizes[1] = in.within(1, widths % 64 ? 2 : 64);
    voxels.sizes[2] = BLOCK;
    voxels.sizes[3] = in.within(1, most);
    voxels.sizes[4] = in.within(1, most);
    const int64_t blocks = voxels.sizes[0] * voxels.sizes[1];
    voxels.inputs = repeated<std::int16_t>(in, blocks * INPUTS * BLOCK);
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
    for (const std::uint8_t weight : repeated<std::uint8_t>(in, blocks * BLOCK))
        voxels.weights.push_back(static_cast<float>(weight) / 255);
    return voxels;
}

Training make_training(Reader& in, const int64_t* sizes) {
    const int64_t count = (INPUTS + 1) * sizes[3] + (sizes[3] + 1) * sizes[4] + (sizes[4] + 1);
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
                            voxels.highest.data(), voxels.weights.data(), voxels.sizes,
                            training.parameters.data(), training.means.data(),
                            training.squares.data(), rates, roots, first, count, as_in_file, 2);
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
                              voxels.highest.data(), voxels.weights.data(), voxels.sizes,
                              training.parameters.data(), as_in_file, sums.data()) == 0,
            "errors that are refused");
    for (const int64_t sum : sums) require(sum >= 0, "a negative sum of squares");
}
