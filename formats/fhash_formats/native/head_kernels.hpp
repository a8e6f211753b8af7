// The head's arithmetic over a block of voxels, for the lanes FHASH_LANES with the function
// attribute FHASH_TARGET. head.cpp includes this file once for each set of lanes, in a namespace.
//
// Numbers lie in pairs (head_lanes.hpp), BLOCK pairs after each other.

template <class Lanes>
FHASH_TARGET FHASH_INLINE typename Lanes::Ints centre_pairs(const float* centre,
                                                            const Range& range) {
    std::int32_t pairs[Lanes::COUNT];
    for (int i = 0; i < Lanes::COUNT; ++i)
        pairs[i] = paired(position(centre[i], range),
                          compressed((centre[i] - range.low) * range.inverse));
    return Lanes::load(pairs);
}

// The inputs of the first layer. rows: the first voxel of the block moved by each of the OFFSETS.
FHASH_TARGET inline void first_inputs(const float* const* rows, const float* centre,
                                      const Range& range, std::int64_t groups, std::int32_t* out) {
    using Lanes = FHASH_LANES;
    const auto inverse = Lanes::all(range.inverse);
    for (std::int64_t i = 0; i < groups * GROUP; i += Lanes::COUNT) {
        const auto here = Lanes::load(centre + i);
        for (std::int64_t k = 0; k < NEIGHBOURS; k += 2)
            Lanes::store(out + k / 2 * BLOCK + i,
                         Lanes::differences(Lanes::load(rows[k] + i), Lanes::load(rows[k + 1] + i),
                                            here, inverse));
        Lanes::store(out + NEIGHBOURS / 2 * BLOCK + i, centre_pairs<Lanes>(centre + i, range));
    }
}

// OUTPUTS sums for VECTORS vectors of voxels. inputs: a row of pairs for each of `count` inputs.
// weights: OUTPUTS pairs for each input.
template <class Lanes, int VECTORS, int OUTPUTS>
FHASH_TARGET FHASH_INLINE void sum_products(const std::int32_t* const* inputs, std::int64_t count,
                                            const std::int32_t* weights, std::int64_t at,
                                            typename Lanes::Ints (&sums)[OUTPUTS][VECTORS]) {
    for (int o = 0; o < OUTPUTS; ++o)
        for (int v = 0; v < VECTORS; ++v) sums[o][v] = Lanes::all(std::int32_t(0));
    for (std::int64_t k = 0; k < count; ++k) {
        typename Lanes::Ints in[VECTORS];
        for (int v = 0; v < VECTORS; ++v) in[v] = Lanes::load(inputs[k] + at + v * Lanes::COUNT);
        for (int o = 0; o < OUTPUTS; ++o) {
            const auto weight = Lanes::all(weights[k * OUTPUTS + o]);
            for (int v = 0; v < VECTORS; ++v)
                sums[o][v] = Lanes::dot(sums[o][v], in[v], weight);
        }
    }
}

template <class Lanes, int VECTORS, int OUTPUTS>
FHASH_TARGET FHASH_INLINE void hidden_part(const std::int32_t* const* inputs, const Stage& stage,
                                           std::int64_t first, std::int64_t at,
                                           std::int32_t* out) {
    typename Lanes::Ints sums[OUTPUTS][VECTORS];
    sum_products<Lanes, VECTORS, OUTPUTS>(inputs, stage.inputs,
                                          stage.weights + first * stage.inputs, at, sums);
    const auto scale = Lanes::all(stage.scale);
    for (int o = 0; o < OUTPUTS; o += 2) {
        const auto one = Lanes::all(stage.biases[first + o]);
        const auto two = Lanes::all(stage.biases[first + o + 1]);
        for (int v = 0; v < VECTORS; ++v)
            Lanes::store(out + (first + o) / 2 * BLOCK + at + v * Lanes::COUNT,
                         Lanes::pairs(Lanes::activated(sums[o][v], scale, one),
                                      Lanes::activated(sums[o + 1][v], scale, two)));
    }
}

template <class Lanes, int VECTORS>
FHASH_TARGET FHASH_INLINE void hidden_outputs(const std::int32_t* const* inputs,
                                              const Stage& stage, std::int64_t at,
                                              std::int32_t* out) {
    for (std::int64_t first = 0; first < stage.outputs; first += stage.tile) {
        switch (stage.tile) {
            case 8: hidden_part<Lanes, VECTORS, 8>(inputs, stage, first, at, out); break;
            case 6: hidden_part<Lanes, VECTORS, 6>(inputs, stage, first, at, out); break;
            case 4: hidden_part<Lanes, VECTORS, 4>(inputs, stage, first, at, out); break;
            default: hidden_part<Lanes, VECTORS, 2>(inputs, stage, first, at, out);
        }
    }
}

// A hidden layer: the pairs of its outputs.
FHASH_TARGET inline void hidden_layer(const std::int32_t* const* inputs, const Stage& stage,
                                      std::int64_t groups, std::int32_t* out) {
    using Lanes = FHASH_LANES;
    std::int64_t at = 0;
    for (; at + 2 * Lanes::COUNT <= groups * GROUP; at += 2 * Lanes::COUNT)
        hidden_outputs<Lanes, 2>(inputs, stage, at, out);
    for (; at < groups * GROUP; at += Lanes::COUNT)
        hidden_outputs<Lanes, 1>(inputs, stage, at, out);
}

// The last layer: corrected and clipped values of `groups` groups; the correction of the first.
FHASH_TARGET inline float last_layer(const std::int32_t* const* inputs, const Stage& stage,
                                     const float* centre, const Range& range, std::int64_t groups,
                                     float* out) {
    using Lanes = FHASH_LANES;
    const auto scale = Lanes::all(stage.scale), bias = Lanes::all(stage.biases[0]);
    const auto low = Lanes::all(range.low), high = Lanes::all(range.high);
    float corrections[Lanes::COUNT];
    for (std::int64_t at = 0; at < groups * GROUP; at += Lanes::COUNT) {
        typename Lanes::Ints sums[1][1];
        sum_products<Lanes, 1, 1>(inputs, stage.inputs, stage.weights, at, sums);
        const auto correction = Lanes::weighted(sums[0][0], scale, bias);
        if (at == 0) Lanes::store(corrections, correction);
        Lanes::store(out + at, Lanes::clipped_sum(Lanes::load(centre + at), correction, low, high));
    }
    return corrections[0];
}

// The same correction for a whole block.
FHASH_TARGET inline void correct_all(const float* centre, float correction, const Range& range,
                                     std::int64_t groups, float* out) {
    using Lanes = FHASH_LANES;
    const auto low = Lanes::all(range.low), high = Lanes::all(range.high);
    const auto same = Lanes::all(correction);
    for (std::int64_t at = 0; at < groups * GROUP; at += Lanes::COUNT)
        Lanes::store(out + at, Lanes::clipped_sum(Lanes::load(centre + at), same, low, high));
}

constexpr Kernels kernels = {first_inputs, hidden_layer, last_layer, correct_all,
                             FHASH_LANES::TILE};
