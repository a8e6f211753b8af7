// What the targets share: setups and arrays from few bytes.
//
// A setup is what a decoder is called with besides hostile bytes: priors, tables of bands and of
// passes. Python makes them; seeds.py writes the file that is read here.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

#include "reader.hpp"

struct State {
    std::vector<std::uint16_t> slots;
    std::vector<std::int32_t> weights;
    std::vector<std::uint16_t> simples;
};

// Distributions of the fast coder.
struct FastPrior {
    std::vector<std::uint16_t> slots;
    std::vector<std::uint8_t> defaults;
    std::vector<std::uint32_t> lookup;
};

struct Bands {
    std::vector<std::int64_t> shape;
    std::vector<std::int32_t> table;
};

struct Passes {
    std::vector<std::int64_t> shape, levels;
    std::vector<std::int32_t> passes, taps;
};

class Setups {
public:
    State coders[2];  // of one quantiser and of two
    State mask, predictor;
    FastPrior fast;
    std::vector<Bands> bands;
    std::vector<Passes> passes;

    explicit Setups(const char* path) {
        std::FILE* const file = path ? std::fopen(path, "rb") : nullptr;
        if (!file) {
            std::fprintf(stderr, "FHASH_FUZZ_SETUPS names no file that can be read\n");
            std::exit(2);
        }
        for (State* state : {&coders[0], &coders[1], &mask, &predictor}) {
            get(file, state->slots);
            get(file, state->weights);
            get(file, state->simples);
        }
        get(file, fast.slots);
        get(file, fast.defaults);
        get(file, fast.lookup);
        bands.resize(count(file));
        for (Bands& setup : bands) {
            get(file, setup.shape);
            get(file, setup.table);
        }
        passes.resize(count(file));
        for (Passes& setup : passes) {
            get(file, setup.shape);
            get(file, setup.levels);
            get(file, setup.passes);
            get(file, setup.taps);
        }
        std::fclose(file);
    }

private:
    static std::size_t count(std::FILE* file) {
        std::int64_t n = 0;
        if (std::fread(&n, sizeof n, 1, file) != 1) std::exit(2);
        return static_cast<std::size_t>(n);
    }
    // Reads a number of bytes, then as many bytes.
    template <class T> static void get(std::FILE* file, std::vector<T>& into) {
        into.resize(count(file) / sizeof(T));
        if (!into.empty() && std::fread(into.data(), sizeof(T), into.size(), file) != into.size())
            std::exit(2);
    }
};

inline const Setups& setups() {
    static const Setups loaded(std::getenv("FHASH_FUZZ_SETUPS"));
    return loaded;
}

// Ends the process with a message if what always holds does not.
inline void require(bool holds, const char* what) {
    if (holds) return;
    std::fprintf(stderr, "%s\n", what);
    std::abort();
}

inline std::int64_t volume(const std::vector<std::int64_t>& shape) {
    return shape[0] * shape[1] * shape[2] * shape[3];
}

inline std::vector<std::int64_t> small_shape(Reader& in, std::int64_t most) {
    std::vector<std::int64_t> shape;
    for (int axis = 0; axis < 4; axis++) shape.push_back(in.within(1, axis == 3 ? 3 * most : most));
    return shape;
}

template <class T> std::vector<T> repeated(Reader& in, std::int64_t n) {
    const std::vector<T> seed = in.numbers<T>(12);
    std::vector<T> values(static_cast<std::size_t>(n));
    for (std::size_t i = 0; i < values.size(); i++) values[i] = seed[(i * 5 + i / 7) % seed.size()];
    return values;
}

// Integers without -2^31, which no coder gives.
inline std::vector<std::int32_t> integers(Reader& in, std::int64_t n) {
    std::vector<std::int32_t> values = repeated<std::int32_t>(in, n);
    for (std::int32_t& value : values)
        value = std::max(value, -std::numeric_limits<std::int32_t>::max());
    return values;
}

// Levels of a mask, below 32 and below 16; all 0 unless it is `informed`.
inline void mask_levels(Reader& in, bool informed, std::vector<std::uint8_t>& level,
                        std::vector<std::uint8_t>& other) {
    for (std::size_t i = 0; i < level.size() && informed; i++) {
        const std::uint8_t both = i % 4 ? static_cast<std::uint8_t>(level[i - 1] + 1) : in.byte();
        level[i] = both & 31;
        other[i] = both >> 4;
    }
}

inline std::vector<std::int16_t> tap_weights(Reader& in, const Passes& with) {
    std::vector<std::int16_t> weights =
        in.numbers<std::int16_t>(static_cast<std::int64_t>(with.taps.size() / 5));
    for (std::int16_t& weight : weights) weight = std::max<std::int16_t>(weight, -32767);
    return weights;
}
