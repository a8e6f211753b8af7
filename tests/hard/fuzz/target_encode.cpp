// The output of each encoder must decode to its input; a difference ends the process.
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

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
    switch (in.byte() % 5) {
        case 0: of_integers(in); break;
        case 1: of_masks(in); break;
        case 2: of_predicted(in); break;
        case 3: of_path<float>(in); break;
        default: of_path<double>(in);
    }
}
