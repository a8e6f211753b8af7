// What a decoder is called with besides hostile bytes: priors, tables of bands and passes, as Python makes them (seeds.py writes the file).
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

struct State {
    std::vector<std::uint16_t> slots;
    std::vector<std::int32_t> weights;
    std::vector<std::uint16_t> simples;
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
    State coder, mask, predictor;
    std::vector<Bands> bands;
    std::vector<Passes> passes;

    explicit Setups(const char* path) {
        std::FILE* const file = path ? std::fopen(path, "rb") : nullptr;
        if (!file) {
            std::fprintf(stderr, "FHASH_FUZZ_SETUPS names no file that can be read\n");
            std::exit(2);
        }
        for (State* state : {&coder, &mask, &predictor}) {
            get(file, state->slots);
            get(file, state->weights);
            get(file, state->simples);
        }
        bands.resize(count(file));
        for (Bands& one : bands) {
            get(file, one.shape);
            get(file, one.table);
        }
        passes.resize(count(file));
        for (Passes& one : passes) {
            get(file, one.shape);
            get(file, one.levels);
            get(file, one.passes);
            get(file, one.taps);
        }
        std::fclose(file);
    }

private:
    static std::size_t count(std::FILE* file) {
        std::int64_t n = 0;
        if (std::fread(&n, sizeof n, 1, file) != 1) std::exit(2);
        return static_cast<std::size_t>(n);
    }
    // A number of bytes, then these.
    template <class T> static void get(std::FILE* file, std::vector<T>& into) {
        into.resize(count(file) / sizeof(T));
        if (!into.empty() && std::fread(into.data(), sizeof(T), into.size(), file) != into.size()) std::exit(2);
    }
};
