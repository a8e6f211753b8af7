// A network with values of its own for the marcher, evaluated by the thread of a ray.
//
// Constants in front: LEVELS, SIZE, WIDTH, LAYERS (hidden ones) and SPARSE. The input's
// `network_levels` are records of levels, `network_layers` numbers of each layer in turn: for each
// output the weights, the bias and zeros, to a multiple of four; `network_sizes` are the spans of
// the box along x, y and z, and their inverses, as doubles.
#pragma once

namespace {

constexpr int INPUTS = LEVELS * SIZE;

// Numbers of a row of a layer.
__device__ constexpr int row_of(int inputs) { return (inputs + 4) / 4 * 4; }

struct Rows {
    const float4* at;
    // The product of the next row with some inputs, and its bias.
    template <int COUNT> float next(const float (&inputs)[COUNT]) {
        constexpr int ROW = row_of(COUNT);
        float sum = 0.f;
        FHASH_UNROLL
        for (int i = 0; i < ROW / 4; i++) {
            const float4 four = *at++;
            const float weights[4] = {four.x, four.y, four.z, four.w};
            FHASH_UNROLL
            for (int j = 0; j < 4; j++) {
                if (4 * i + j < COUNT) sum += weights[j] * inputs[4 * i + j];
                if (4 * i + j == COUNT) sum += weights[j];
            }
        }
        return sum;
    }
    // Add the next row times a factor, without its bias.
    template <int COUNT> void add(float factor, float (&sums)[COUNT]) {
        constexpr int ROW = row_of(COUNT);
        FHASH_UNROLL
        for (int i = 0; i < ROW / 4; i++) {
            const float4 four = *at++;
            const float weights[4] = {four.x, four.y, four.z, four.w};
            FHASH_UNROLL
            for (int j = 0; j < 4; j++)
                if (4 * i + j < COUNT) sums[4 * i + j] += factor * weights[j];
        }
    }
};

// Calls action(input, level, value, changes across the cell along x, y, z) for each input.
template <class Action>
void each_input(const FhashInput& m, double x, double y, double z, const Action& action) {
    const Level* const levels = reinterpret_cast<const Level*>(m.network_levels);
    const double* const spans = reinterpret_cast<const double*>(m.network_sizes);
    Places places;
    for (int a = 0; a < 3; a++) places.span[a] = spans[a], places.inverse[a] = spans[3 + a];
    const double at[3] = {x, y, z};
    FHASH_UNROLL
    for (int number = 0; number < LEVELS; number++) {
        const Level& level = levels[number];
        const Cell cell = cell_at(level, places, at);
        FHASH_UNROLL
        for (int e = 0; e < SIZE; e += STEP) {
            Some some[8];
            FHASH_UNROLL
            for (int corner = 0; corner < 8; corner++)
                some[corner] = *reinterpret_cast<const Some*>(
                    level.table + cell.corners[corner] * SIZE + e);
            FHASH_UNROLL
            for (int i = 0; i < STEP; i++) {
                float corners[8], by[3];
                FHASH_UNROLL
                for (int corner = 0; corner < 8; corner++) corners[corner] = some[corner].at[i];
                const float value = interpolated(corners, cell.after, by);
                action(number * SIZE + e + i, level, places, value, by);
            }
        }
    }
}

// The value by the layers, and its slopes by the inputs if `slopes` is not null. On a ReLU's kink
// the slope is that of its flat side.
float by_layers(const float* numbers, const float (&inputs)[INPUTS], float* slopes) {
    constexpr int OUT = LAYERS == 0 ? INPUTS : WIDTH, ROW = row_of(INPUTS), HIDDEN = row_of(OUT);
    const float4* const first = reinterpret_cast<const float4*>(numbers);
    float hidden[OUT], down[OUT] = {};
    Rows rows = {first};
    if constexpr (LAYERS == 0) {
        for (int i = 0; i < INPUTS; i++) hidden[i] = inputs[i];
    } else {
        for (int j = 0; j < WIDTH; j++) hidden[j] = max(rows.next(inputs), 0.f);
    }
    float value;
    if constexpr (LAYERS == 2) {
        const float* const last = reinterpret_cast<const float*>(rows.at) + WIDTH * HIDDEN;
        value = last[WIDTH];
        for (int j = 0; j < WIDTH; j++) {
            Rows again = rows;
            const float second = rows.next(hidden);
            if (!(second > 0)) continue;
            value += last[j] * second;
            if (slopes) again.add(last[j], down);
        }
    } else {
        Rows again = rows;
        value = rows.next(hidden);
        if (slopes) again.add(1.f, down);
    }
    if (!slopes) return value;
    float sums[INPUTS] = {};
    if constexpr (LAYERS == 0) {
        for (int i = 0; i < INPUTS; i++) sums[i] = down[i];
    } else {
        Rows back = {first};
        for (int j = 0; j < WIDTH; j++, back.at = first + j * (ROW / 4))
            if (hidden[j] > 0) back.add(down[j], sums);
    }
    for (int i = 0; i < INPUTS; i++) slopes[i] = sums[i];
    return value;
}

// The normalised value at a place of the box; slopes: by t, z, y and x per vertex, t left out.
FHASH_APART float network_at(const FhashInput& m, double x, double y, double z, float* slopes) {
    float inputs[INPUTS], by_input[INPUTS];
    each_input(m, x, y, z, [&](int input, const Level&, const Places&, float value,
                               const float (&)[3]) { inputs[input] = value; });
    const float* const numbers = reinterpret_cast<const float*>(m.network_layers);
    const float result = by_layers(numbers, inputs, slopes ? by_input : nullptr);
    if (!slopes) return result;
    float sums[3] = {};
    each_input(m, x, y, z, [&](int input, const Level& level, const Places& places, float,
                               const float (&by)[3]) {
        for (int a = 0; a < 3; a++)
            sums[a] += by_input[input] * ((float)(level.scale[a] * places.inverse[a]) * by[a]);
    });
    for (int a = 0; a < 3; a++) slopes[3 - a] = sums[a];
    return result;
}

}  // namespace
