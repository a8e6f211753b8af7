// The MLP over rows of samples: forward, and the gradients by its weights and by its inputs.
//
// A row holds one number of each sample; an activation is a set of rows. Products keep a tile of
// sums in registers. The layer before the output has its gradients divided by the output's weights
// w[j]: with s[j] = 1 where neuron j is above 0 and d the gradient by the output, the gradient by
// its weights (j, k) is w[j] times the sum of s[j] d x[k], and that by w[j] is the sum over k of
// weight (j, k) times that sum. So one product gives both, and no activation is needed again.
#pragma once

#include "vector.hpp"

#if defined(FHASH_VECTORS)

namespace {

// Sizes of the tiles of sums: as many as a path's registers hold beside their operands.
template <class P> struct Tiles {
    static constexpr bool MANY = P::REGISTERS > 16;
    static constexpr int OUTPUTS = MANY ? 6 : P::BYTES > 16 ? 6 : 5;  // outputs of a product
    static constexpr int VECTORS = MANY ? 4 : 2;                      // vectors of samples
    static constexpr int NEURONS = MANY ? 4 : 2;                      // neurons of a gradient
    static constexpr int INPUTS = MANY ? 6 : P::BYTES > 16 ? 6 : 5;   // inputs of a gradient
    static constexpr int CHUNK = MANY ? 28 : 32;  // vectors of samples that the MLP takes at a time
};

// A product of a matrix and rows, out[j] = sum over k of weight[j][k] in[k], and what follows it.
struct Product {
    const float* weight;
    std::int64_t stride;  // numbers from one row of the matrix to the next
    std::int64_t outputs, inputs;
    bool bias;            // whether a row of the matrix ends with a summand
    bool relu;            // whether sums below 0 become 0
    const float* in;
    std::int64_t in_row;  // numbers from one row of inputs to the next
    float* out;           // null where only `sum` is wanted
    std::int64_t out_row;
    const float* above;   // rows like `out`: where they are not above 0, the sums become 0; or null
    float* sum;           // row to which the outputs are added by `share`; or null
    const float* share;   // (outputs,)
};

template <class P, int J, int R>
void product_tile(const Product& p, std::int64_t j, std::int64_t at) {
    typedef typename P::F F;
    const F zero = {};
    F a[J][R];
    const float* w = p.weight + j * p.stride;
    FHASH_UNROLLED for (int q = 0; q < J; q++) {
        const F start = p.bias ? all<P>(w[q * p.stride + p.inputs]) : zero;
        FHASH_UNROLLED for (int r = 0; r < R; r++) a[q][r] = start;
    }
    const float* in = p.in + at;
    for (std::int64_t k = 0; k < p.inputs; k++, in += p.in_row) {
        F x[R];
        FHASH_UNROLLED for (int r = 0; r < R; r++) x[r] = loaded<P>(in + r * P::N);
        FHASH_UNROLLED for (int q = 0; q < J; q++) {
            const F one = all<P>(w[q * p.stride + k]);
            FHASH_UNROLLED for (int r = 0; r < R; r++) a[q][r] += one * x[r];
        }
    }
    // Not a number stays what it is: a training that diverges must show.
    if (p.relu)
        FHASH_UNROLLED for (int q = 0; q < J; q++)
            FHASH_UNROLLED for (int r = 0; r < R; r++) a[q][r] = zero > a[q][r] ? zero : a[q][r];
    if (p.above)
        FHASH_UNROLLED for (int q = 0; q < J; q++)
            FHASH_UNROLLED for (int r = 0; r < R; r++)
                a[q][r] = loaded<P>(p.above + (j + q) * p.out_row + at + r * P::N) > zero ? a[q][r]
                                                                                         : zero;
    if (p.sum) {
        F sum[R];
        FHASH_UNROLLED for (int r = 0; r < R; r++) sum[r] = loaded<P>(p.sum + at + r * P::N);
        FHASH_UNROLLED for (int q = 0; q < J; q++) {
            const F share = all<P>(p.share[j + q]);
            FHASH_UNROLLED for (int r = 0; r < R; r++) sum[r] += share * a[q][r];
        }
        FHASH_UNROLLED for (int r = 0; r < R; r++) store<P>(p.sum + at + r * P::N, sum[r]);
    }
    if (p.out)
        FHASH_UNROLLED for (int q = 0; q < J; q++)
            FHASH_UNROLLED for (int r = 0; r < R; r++)
                store<P>(p.out + (j + q) * p.out_row + at + r * P::N, a[q][r]);
}

// All outputs of R vectors of samples, in tiles as equal as they can be.
template <class P, int R> void product_column(const Product& p, std::int64_t at) {
    constexpr int MOST = Tiles<P>::OUTPUTS;
    const std::int64_t tiles = (p.outputs + MOST - 1) / MOST;
    for (std::int64_t tile = 0; tile < tiles; tile++) {
        const std::int64_t j = p.outputs * tile / tiles, end = p.outputs * (tile + 1) / tiles;
        switch (end - j) {
            case 1: product_tile<P, 1, R>(p, j, at); break;
            case 2: product_tile<P, 2, R>(p, j, at); break;
            case 3: product_tile<P, 3, R>(p, j, at); break;
            case 4: product_tile<P, 4, R>(p, j, at); break;
            case 5: product_tile<P, 5, R>(p, j, at); break;
            default:
                if constexpr (MOST > 5) product_tile<P, 6, R>(p, j, at);
        }
    }
}

template <class P> void product(const Product& p, std::int64_t vectors) {
    constexpr int R = Tiles<P>::VECTORS;
    std::int64_t r = 0;
    for (; r + R <= vectors; r += R) product_column<P, R>(p, r * P::N);
    for (; r < vectors; r++) product_column<P, 1>(p, r * P::N);
}

// sums[j][k] += left[j] * right[k], added over samples but not over the places of a vector.
struct Outer {
    const float* left;
    std::int64_t left_row, neurons;
    const float* right;
    std::int64_t right_row, inputs;
    float* sums;  // (neurons, inputs) vectors
};

template <class P, int J, int K>
void outer_tile(const Outer& o, std::int64_t j, std::int64_t k, std::int64_t vectors) {
    typedef typename P::F F;
    F a[J][K];
    float* sums = o.sums + (j * o.inputs + k) * P::N;
    FHASH_UNROLLED for (int q = 0; q < J; q++)
        FHASH_UNROLLED for (int i = 0; i < K; i++)
            a[q][i] = loaded<P>(sums + (q * o.inputs + i) * P::N);
    const float* left = o.left + j * o.left_row;
    const float* right = o.right + k * o.right_row;
    for (std::int64_t r = 0; r < vectors; r++, left += P::N, right += P::N) {
        F d[J];
        FHASH_UNROLLED for (int q = 0; q < J; q++) d[q] = loaded<P>(left + q * o.left_row);
        FHASH_UNROLLED for (int i = 0; i < K; i++) {
            const F x = loaded<P>(right + i * o.right_row);
            FHASH_UNROLLED for (int q = 0; q < J; q++) a[q][i] += d[q] * x;
        }
    }
    FHASH_UNROLLED for (int q = 0; q < J; q++)
        FHASH_UNROLLED for (int i = 0; i < K; i++)
            store<P>(sums + (q * o.inputs + i) * P::N, a[q][i]);
}

template <class P, int J>
void outer_rows(const Outer& o, std::int64_t j, std::int64_t vectors) {
    constexpr int MOST = Tiles<P>::INPUTS;
    const std::int64_t tiles = (o.inputs + MOST - 1) / MOST;
    for (std::int64_t tile = 0; tile < tiles; tile++) {
        const std::int64_t k = o.inputs * tile / tiles, end = o.inputs * (tile + 1) / tiles;
        switch (end - k) {
            case 1: outer_tile<P, J, 1>(o, j, k, vectors); break;
            case 2: outer_tile<P, J, 2>(o, j, k, vectors); break;
            case 3: outer_tile<P, J, 3>(o, j, k, vectors); break;
            case 4: outer_tile<P, J, 4>(o, j, k, vectors); break;
            case 5: outer_tile<P, J, 5>(o, j, k, vectors); break;
            default:
                if constexpr (MOST > 5) outer_tile<P, J, 6>(o, j, k, vectors);
        }
    }
}

template <class P> void outer(const Outer& o, std::int64_t vectors) {
    constexpr int J = Tiles<P>::NEURONS;
    std::int64_t j = 0;
    for (; j + J <= o.neurons; j += J) outer_rows<P, J>(o, j, vectors);
    for (; j < o.neurons; j++) outer_rows<P, 1>(o, j, vectors);
}

// A network of up to two hidden layers. Its layers lie one after the other, each a matrix (outputs,
// inputs + 1) whose last column is the bias.
struct Mlp {
    std::int64_t inputs, hidden, width;
    const float* layer[3];
    float* back[2];      // of each hidden layer: its weights transposed, (inputs, width)
    float* sums[3];      // of each layer: vectors of sums for its gradient
    float* activation[2];  // of each hidden layer: rows of CHUNK vectors, one more than neurons
    float* value;        // row of CHUNK vectors: outputs, then gradients by them

    std::int64_t inputs_of(std::int64_t n) const { return n ? width : inputs; }
    std::int64_t outputs_of(std::int64_t n) const { return n < hidden ? width : 1; }
    std::int64_t numbers_of(std::int64_t n) const { return outputs_of(n) * (inputs_of(n) + 1); }

    // Numbers of memory that a thread needs, for vectors of N numbers in chunks of CHUNK.
    static std::int64_t memory(std::int64_t inputs, std::int64_t hidden, std::int64_t width,
                               std::int64_t lanes, std::int64_t chunk) {
        Mlp m{inputs, hidden, width, {}, {}, {}, {}, nullptr};
        std::int64_t numbers = chunk * lanes;
        for (std::int64_t n = 0; n <= hidden; n++) numbers += m.numbers_of(n) * lanes;
        for (std::int64_t n = 0; n < hidden; n++)
            numbers += (m.inputs_of(n) * width + 15) / 16 * 16 + (width + 1) * chunk * lanes;
        return numbers;
    }

    template <class P> void lay_out(const float* layers, float* memory) {
        constexpr std::int64_t CHUNK = Tiles<P>::CHUNK * P::N;
        const auto take = [&memory](std::int64_t numbers) FHASH_LAMBDA {
            float* const taken = memory;
            memory += numbers;
            return taken;
        };
        value = take(CHUNK);
        for (std::int64_t n = 0; n <= hidden; n++) {
            layer[n] = layers;
            layers += numbers_of(n);
            sums[n] = take(numbers_of(n) * P::N);
        }
        for (std::int64_t n = 0; n < hidden; n++) {
            activation[n] = take((width + 1) * CHUNK);
            back[n] = take((inputs_of(n) * width + 15) / 16 * 16);
        }
    }

    // Begin a step: no sums yet, weights for the way back.
    template <class P> void begin() {
        for (std::int64_t n = 0; n <= hidden; n++)
            std::memset(sums[n], 0, numbers_of(n) * P::BYTES);
        for (std::int64_t n = 0; n < hidden; n++) {
            const std::int64_t count = inputs_of(n);
            for (std::int64_t j = 0; j < width; j++) {
                const float share = n == hidden - 1 ? layer[hidden][j] : 1.0f;
                for (std::int64_t k = 0; k < count; k++)
                    back[n][k * width + j] = share * layer[n][j * (count + 1) + k];
            }
            // The row of ones that carries the bias of the next layer.
            float* ones = activation[n] + width * Tiles<P>::CHUNK * P::N;
            for (std::int64_t i = 0; i < Tiles<P>::CHUNK * P::N; i++) ones[i] = 1;
        }
    }

    // Write the outputs of some vectors of samples into `value`. in: rows `row` numbers apart.
    template <class P>
    void forward(const float* in, std::int64_t row, std::int64_t vectors, bool keep) {
        constexpr std::int64_t CHUNK = Tiles<P>::CHUNK * P::N;
        const typename P::F bias = all<P>(layer[hidden][inputs_of(hidden)]);
        for (std::int64_t r = 0; r < vectors; r++) store<P>(value + r * P::N, bias);
        if (!hidden) {
            for (std::int64_t k = 0; k < inputs; k++)
                for (std::int64_t i = 0; i < vectors * P::N; i += P::N)
                    store<P>(value + i, loaded<P>(value + i) + all<P>(layer[0][k]) *
                                                                   loaded<P>(in + k * row + i));
            return;
        }
        for (std::int64_t n = 0; n < hidden; n++) {
            const bool last = n == hidden - 1;
            product<P>({layer[n], inputs_of(n) + 1, width, inputs_of(n), true, true,
                        n ? activation[n - 1] : in, n ? CHUNK : row,
                        last && !keep ? nullptr : activation[n], CHUNK, nullptr,
                        last ? value : nullptr, layer[hidden]},
                       vectors);
        }
    }

    // Replace inputs by the gradients by them, after `forward` with `keep` and with the gradients
    // by the outputs in `value`. The row behind the inputs holds ones, and stays.
    template <class P>
    void backward(float* in, std::int64_t row, std::int64_t vectors) {
        constexpr std::int64_t CHUNK = Tiles<P>::CHUNK * P::N;
        typedef typename P::F F;
        const F zero = {};
        if (!hidden) {
            outer<P>({value, CHUNK, 1, in, row, inputs + 1, sums[0]}, vectors);
            for (std::int64_t k = 0; k < inputs; k++)
                for (std::int64_t i = 0; i < vectors * P::N; i += P::N)
                    store<P>(in + k * row + i, all<P>(layer[0][k]) * loaded<P>(value + i));
            return;
        }
        for (std::int64_t r = 0; r < vectors; r++) {
            const F d = loaded<P>(value + r * P::N);
            float* at = activation[hidden - 1] + r * P::N;
            for (std::int64_t j = 0; j < width; j++, at += CHUNK)
                store<P>(at, loaded<P>(at) > zero ? d : zero);
            // The gradient by the output's bias is the sum of all d.
            float* bias = sums[hidden] + width * P::N;
            store<P>(bias, loaded<P>(bias) + d);
        }
        for (std::int64_t n = hidden - 1; n >= 0; n--) {
            float* const before = n ? activation[n - 1] : in;
            const std::int64_t apart = n ? CHUNK : row, count = inputs_of(n);
            outer<P>({activation[n], CHUNK, width, before, apart, count + 1, sums[n]}, vectors);
            product<P>({back[n], width, count, width, false, false, activation[n], CHUNK, before,
                        apart, n ? before : nullptr, nullptr, nullptr},
                       vectors);
        }
    }

    // Write the gradient by all layers, after all samples of a step.
    template <class P> void gradient(float* to) const {
        const auto total = [](const float* vector) FHASH_LAMBDA {
            float sum = 0;
            for (int i = 0; i < P::N; i++) sum += vector[i];
            return sum;
        };
        float* out = to;
        for (std::int64_t n = 0; n < hidden; n++) out += numbers_of(n);
        if (!hidden) {
            for (std::int64_t k = 0; k <= inputs; k++) out[k] = total(sums[0] + k * P::N);
            return;
        }
        out[width] = total(sums[hidden] + width * P::N);
        for (std::int64_t n = 0; n < hidden; n++) {
            const std::int64_t count = inputs_of(n) + 1;
            for (std::int64_t j = 0; j < width; j++, to += count) {
                const float* row = sums[n] + j * count * P::N;
                const float* weights = layer[n] + j * count;
                const bool last = n == hidden - 1;
                double product = 0;
                for (std::int64_t k = 0; k < count; k++) {
                    const float sum = total(row + k * P::N);
                    product += (double)sum * weights[k];
                    to[k] = last ? sum * layer[hidden][j] : sum;
                }
                if (last) out[j] = (float)product;
            }
        }
    }
};

}  // namespace

#endif  // FHASH_VECTORS
