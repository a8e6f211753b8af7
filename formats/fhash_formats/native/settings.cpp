// The packed settings of a tile (FORMAT.md, Settings; transform/tile_format.py packs them).
#include "settings.hpp"

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstring>

#include "basis.hpp"
#include "bytes.hpp"
#include "coding.hpp"

namespace fhash {

template <class T> bool Bytes::number(T& value) {
    const uint8_t* data;
    if (!take(sizeof(T), data)) return false;
    value = little<T>(data);
    return true;
}

bool Bytes::leb(uint64_t& value) {
    value = 0;
    for (int shift = 0; shift < 35; shift += 7) {
        if (at == end) return false;
        const uint8_t byte = *at++;
        value |= (uint64_t)(byte & 127) << shift;
        if (byte < 128) return true;
    }
    return false;
}

void put_leb(Buffer& out, uint64_t number) {
    do {
        out.push_back((uint8_t)((number & 127) | (number > 127 ? 128 : 0)));
        number >>= 7;
    } while (number);
}

namespace {

constexpr int DOUBLE = 1, CLIP = 2, LABELS = 4, TRELLIS = 8;
constexpr int WHOLE = 16, HEAD = 32, MASK = 64, PREDICTOR = 128;
constexpr int64_t MAX_LENGTH = 512;  // longest axis that may have a basis of its own
constexpr int MAX_DEPTH = 10;
constexpr int MAX_WEIGHT = 31;       // of a head
constexpr size_t REMEMBERED = 64;    // settings that a context keeps

bool damaged(fhash_error& error, const char* what) {
    return fail(error, FHASH_ERROR_DAMAGED, "the settings of a coded tile are damaged: %s", what);
}

bool cut(fhash_error& error) {
    return fail(error, FHASH_ERROR_DAMAGED, "the settings of a coded tile are cut short");
}

// A block of bytes behind its length.
bool read_block(Bytes& data, Bytes& block, fhash_error& error) {
    uint64_t size;
    const uint8_t* start;
    if (!data.leb(size) || !data.take(size, start)) return cut(error);
    block = {start, start + size};
    return true;
}

// cos(pi m / 2 n) for 0 <= m < 4 n, as transform/spec.py computes it.
double cosine(int64_t m, int64_t n) {
    if (m > 2 * n) m = 4 * n - m;
    if (m > n) return -cosine(2 * n - m, n);
    const bool sine = 2 * m > n;
    const double angle = 3.141592653589793 * (double)(sine ? n - m : m) / (double)(2 * n);
    const double square = angle * angle;
    double total = 1.0;
    for (int k = sine ? 21 : 20; k > 1; k -= 2)
        total = 1.0 - square / (double)(k * (k - 1)) * total;
    return sine ? angle * total : total;
}

}  // namespace

double shrink(int exponent) {
    return std::ldexp(exponent % 2 ? 0.7071067811865476 : 1.0, -(exponent / 2));
}

std::vector<double> dct_rows(int64_t n) {
    std::vector<double> cosines((size_t)(4 * n)), rows((size_t)(n * n));
    for (int64_t m = 0; m < 4 * n; m++) cosines[(size_t)m] = cosine(m, n);
    for (int64_t k = 0; k < n; k++) {
        const double unit = std::sqrt((k ? 2.0 : 1.0) / (double)n);
        for (int64_t i = 0; i < n; i++)
            rows[(size_t)(k * n + i)] = cosines[(size_t)((2 * i + 1) * k % (4 * n))] * unit;
    }
    return rows;
}

namespace {

// The vectors of a basis from their coefficients of the DCT, (rank, n).
std::vector<float> synthesis_of(const std::vector<int32_t>& integers,
                                const std::vector<int>& exponents, int64_t n) {
    const int64_t rank = (int64_t)exponents.size();
    const std::vector<double> rows = dct_rows(n);
    std::vector<double> vectors((size_t)(rank * n), 0.0);
    for (int64_t k = 0; k < n; k++)
        for (int64_t r = 0; r < rank; r++) {
            const double factor = (double)integers[(size_t)(r * n + k)];
            double* const out = vectors.data() + r * n;
            for (int64_t i = 0; i < n; i++) out[i] += factor * rows[(size_t)(k * n + i)];
        }
    std::vector<float> result((size_t)(n * rank));
    for (int64_t r = 0; r < rank; r++) {
        const double scale = shrink(exponents[(size_t)r]);
        for (int64_t i = 0; i < n; i++)
            result[(size_t)(i * rank + r)] = (float)(vectors[(size_t)(r * n + i)] * scale);
    }
    return result;
}

// The exponents of the vectors, each a number of steps down (zeros) and a one.
bool read_exponents(Bytes& data, int64_t rank, std::vector<int>& exponents) {
    int level = MAX_EXPONENT;
    size_t position = 0;
    while ((int64_t)exponents.size() < rank) {
        if (position == 8 * data.left() || level < 0) return false;
        if (data.at[position / 8] >> (7 - position % 8) & 1) {
            exponents.push_back(level);
        } else {
            level--;
        }
        position++;
    }
    for (size_t i = position; i % 8; i++)
        if (data.at[i / 8] >> (7 - i % 8) & 1) return false;
    data.at += (position + 7) / 8;
    return true;
}

}  // namespace

std::shared_ptr<const Basis> read_basis(Bytes data, fhash_error& error) {
    uint16_t n, rank;
    if (!data.number(n) || !data.number(rank) || n < 1 || n > MAX_LENGTH || rank > n) {
        damaged(error, "a packed basis has other lengths");
        return nullptr;
    }
    std::vector<int> exponents;
    if (!read_exponents(data, rank, exponents)) {
        damaged(error, "the exponents of a packed basis are cut or out of range");
        return nullptr;
    }
    std::vector<int32_t> integers((size_t)rank * n);
    if (!rank && data.left()) {
        damaged(error, "a packed basis has bytes after its end");
        return nullptr;
    }
    if (rank && !decode_block(data.at, data.left(), {1, 1, rank, n}, integers.data(), error))
        return nullptr;
    for (int64_t r = 0; r < rank; r++) {
        int64_t largest = 0;
        for (int64_t i = 0; i < n; i++)
            largest = std::max(largest, std::abs((int64_t)integers[(size_t)(r * n + i)]));
        const double most = (double)(1 << exponents[(size_t)r] / 2) * 1.5 + 1;
        if (largest == 0 || (double)largest > most) {
            damaged(error, "a vector of the basis is zero or longer than 1");
            return nullptr;
        }
    }
    auto basis = std::make_shared<Basis>();
    basis->n = n;
    basis->rank = rank;
    basis->synthesis = synthesis_of(integers, exponents, n);
    return basis;
}

namespace {

bool read_axes(Bytes& data, const uint8_t* packed, Settings& settings, fhash_error& error) {
    for (int a = 0; a < 4; a++) {
        AxisTransform& axis = settings.axes[a];
        axis.kind = packed[a] >> 4;
        axis.depth = packed[a] & 15;
        if (axis.kind > KLT_KIND)
            return fail(error, FHASH_ERROR_DAMAGED, "a coded tile has a transform of kind %d",
                        axis.kind);
        if (axis.depth > MAX_DEPTH || axis.wavelet() != (axis.depth > 0))
            return damaged(error, "the depth of a transform does not fit its kind");
        if (axis.kind != KLT_KIND) continue;
        Bytes block;
        if (!read_block(data, block, error)) return false;
        axis.basis = read_basis(block, error);
        if (!axis.basis) return false;
    }
    return true;
}

bool no_head(fhash_error& error, const char* what) {
    return fail(error, FHASH_ERROR_DAMAGED,
                "the settings of a coded tile are damaged: a damaged neighbourhood head: %s", what);
}

// The widths of the layers of a head.
bool read_widths(Bytes& data, Head& head, fhash_error& error) {
    constexpr int MAX_HIDDEN = 3, MAX_WIDTH = 64;
    uint8_t count;
    const uint8_t* widths;
    if (!data.number(count)) return no_head(error, "it is cut");
    if (count < 1 || count > MAX_HIDDEN || !data.take(count, widths))
        return no_head(error, "its hidden layers");
    head.widths = {28};
    for (int i = 0; i < count; i++) {
        if (widths[i] < 1 || widths[i] > MAX_WIDTH) return no_head(error, "its widths");
        head.widths.push_back(widths[i]);
    }
    head.widths.push_back(1);
    return true;
}

// Sigma and the ends of the range, as the constants of the kernel.
bool read_range(Bytes& data, Head& head, float& sigma, fhash_error& error) {
    float low, high;
    if (!data.number(sigma) || !data.number(low) || !data.number(high))
        return no_head(error, "it is cut");
    if (!(sigma >= 0x1p-100f && sigma <= 0x1p100f) || !(low <= high) || !std::isfinite(low) ||
        !std::isfinite(high))
        return no_head(error, "its sigma or range");
    const float span = high - low;
    float unit = span > 0 ? 1024.0f / span : 0.0f;
    if (!std::isfinite(unit)) unit = 0.0f;
    const float constants[4] = {low, high, 0.5f / sigma, unit};
    std::memcpy(head.constants, constants, sizeof constants);
    return true;
}

bool read_layers(Bytes& data, Head& head, float sigma, fhash_error& error) {
    const int64_t layers = head.layers();
    std::vector<float> bias_scales;
    for (int64_t l = 0; l < layers; l++) {
        uint16_t weight, bias;
        if (!data.number(weight) || !data.number(bias)) return no_head(error, "it is cut");
        // A positive float16 value that is finite.
        if (weight == 0 || weight >= 0x7c00 || bias == 0 || bias >= 0x7c00)
            return no_head(error, "its scales");
        const float unit_in = l == 0 ? 512.0f : 128.0f, unit_out = l + 1 == layers ? sigma : 128.0f;
        head.scales.push_back(from_half(weight) / unit_in * unit_out);
        bias_scales.push_back(from_half(bias));
    }
    for (int64_t l = 0; l < layers; l++) {
        const float unit_out = l + 1 == layers ? sigma : 128.0f;
        for (int64_t i = 0; i < head.widths[(size_t)l + 1]; i++) {
            int8_t bias;
            if (!data.number(bias) || bias == -128) return no_head(error, "its biases");
            head.biases.push_back(bias_scales[(size_t)l] * (float)bias * unit_out);
        }
    }
    size_t count = 0;
    for (int64_t l = 0; l < layers; l++)
        count += size_t(head.widths[(size_t)l] * head.widths[(size_t)l + 1]);
    if (data.left() != count) return no_head(error, "its weights are cut, or too many");
    int8_t weight;
    while (data.number(weight)) {
        if (weight < -MAX_WEIGHT || weight > MAX_WEIGHT) return no_head(error, "its weights");
        head.weights.push_back(weight);
    }
    return true;
}

bool read_head(Bytes& data, Settings& settings, fhash_error& error) {
    Bytes block;
    if (!read_block(data, block, error)) return false;
    settings.head = std::make_unique<Head>();
    return unpack_head(block, *settings.head, error);
}

bool read_scores(Bytes& data, size_t count, std::vector<int32_t>& scores) {
    for (size_t i = 0; i < count; i++) {
        uint16_t score;
        if (!data.number(score) || score > 4095) return false;
        scores.push_back(score);
    }
    return true;
}

bool read_mask(Bytes& data, Settings& settings, fhash_error& error) {
    settings.mask = std::make_unique<MaskScores>();
    MaskScores& mask = *settings.mask;
    uint8_t count, reach;
    if (!data.number(count)) return cut(error);
    const int edges = count & 127;
    for (int i = 0; i < edges; i++) {
        double edge;
        if (!data.number(edge)) return cut(error);
        if (!std::isfinite(edge) || (i && !(mask.edges.back() < edge)))
            return damaged(error, "the edges of a mask");
        mask.edges.push_back(edge);
    }
    if (edges > 15) return damaged(error, "the edges of a mask");
    if (!data.number(reach)) return cut(error);
    mask.reach = reach;
    if (reach > 64) return damaged(error, "the reach of a mask");
    if (!read_scores(data, (size_t)edges + 1, mask.scores)) return damaged(error, "its scores");
    if (count & 128 && !read_scores(data, (size_t)edges + 1, mask.others))
        return damaged(error, "its scores");
    return true;
}

bool read_predictor(Bytes& data, Settings& settings, fhash_error& error) {
    settings.predictor = std::make_unique<Predictor>();
    Predictor& predictor = *settings.predictor;
    uint8_t numbers[6];
    if (!data.number(predictor.step) || !data.number(predictor.origin)) return cut(error);
    for (uint8_t& number : numbers)
        if (!data.number(number)) return cut(error);
    if (!std::isfinite(predictor.step) || !std::isfinite(predictor.origin) || predictor.step <= 0)
        return damaged(error, "predictor: its step or origin");
    int order[4], seen = 0;
    for (int i = 0; i < 4; i++) {
        order[i] = numbers[4] >> 2 * i & 3;
        seen |= 1 << order[i];
        predictor.levels[(size_t)i] = numbers[i];
        if (numbers[i] > 8) return damaged(error, "predictor: its levels");
    }
    if (seen != 15 || numbers[5] > 2) return damaged(error, "predictor: its order or reach");
    make_passes(predictor, order, numbers[5]);
    const int64_t count = (int64_t)predictor.taps.size() / 5;
    std::vector<int32_t> weights((size_t)count);
    Bytes block;
    if (!read_block(data, block, error) ||
        !decode_block(block.at, block.left(), {1, 1, 1, count}, weights.data(), error))
        return false;
    for (const int32_t weight : weights) {
        if (std::abs((int64_t)weight) > 32767) return damaged(error, "predictor: its weights");
        predictor.weights.push_back((int16_t)weight);
    }
    return true;
}

// The numbers that every block has.
bool read_numbers(Bytes& data, Settings& settings, fhash_error& error) {
    bool all = data.number(settings.step) && data.number(settings.quantum) &&
               data.number(settings.center);
    if (settings.whole) {
        const uint8_t* origin;
        all = all && data.number(settings.whole_low) && data.number(settings.whole_high) &&
              data.take(9, origin);
        if (!all) return cut(error);
        settings.origin.bits = little<uint64_t>(origin);
        settings.origin.negative = origin[8] == 255;
        const bool fits = origin[8] == 0 || (origin[8] == 255 && origin[7] & 128);
        if (!fits) return damaged(error, "its origin is no 64-bit integer");
        settings.low = (double)settings.whole_low;
        settings.high = (double)settings.whole_high;
        if (settings.whole_low > settings.whole_high) return damaged(error, "its range");
    } else {
        all = all && data.number(settings.low) && data.number(settings.high);
    }
    for (int8_t& offset : settings.offsets) {
        all = all && data.number(offset);
        if (all && offset == -128) return damaged(error, "its offsets");
    }
    if (!all) return cut(error);
    const double numbers[] = {settings.step, settings.quantum, settings.center, settings.low,
                              settings.high};
    for (const double number : numbers)
        if (!std::isfinite(number)) return damaged(error, "a finite number is needed");
    if (!(settings.step > 0 && settings.quantum >= 0 && settings.low <= settings.high))
        return damaged(error, "step, quantum and range do not fit together");
    if (!settings.real64 && !(settings.step > FLT_MIN && settings.step < FLT_MAX))
        return damaged(error, "its step is not for float32");
    return true;
}

bool unpack(Bytes data, Settings& settings, fhash_error& error) {
    settings.packed.assign(data.at, data.end);
    const uint8_t* first;
    if (!data.take(5, first)) return cut(error);
    const int flags = first[0];
    settings.real64 = flags & DOUBLE;
    settings.clip = flags & CLIP;
    settings.labels = flags & LABELS;
    settings.trellis = flags & TRELLIS;
    settings.whole = flags & WHOLE;
    if (!read_numbers(data, settings, error) || !read_axes(data, first + 1, settings, error))
        return false;
    if (flags & HEAD && settings.real64) return damaged(error, "a head works in float32 only");
    if (flags & HEAD && !read_head(data, settings, error)) return false;
    if (flags & MASK && !read_mask(data, settings, error)) return false;
    if (flags & PREDICTOR && !read_predictor(data, settings, error)) return false;
    if (data.left()) return damaged(error, "they have bytes after their end");
    return true;
}

}  // namespace

bool unpack_head(Bytes block, Head& head, fhash_error& error) {
    float sigma = 0;
    return read_widths(block, head, error) && read_range(block, head, sigma, error) &&
           read_layers(block, head, sigma, error);
}

bool insert_head(std::string& settings, const std::string& head, fhash_error& error) {
    const uint8_t* const begin = (const uint8_t*)settings.data();
    Bytes data = {begin, begin + settings.size()}, block;
    const uint8_t *first, *rest;
    if (!data.take(5, first) || !data.take(first[0] & WHOLE ? 55 : 46, rest)) return cut(error);
    for (int a = 1; a < 5; a++)
        if (first[a] >> 4 == KLT_KIND && !read_block(data, block, error)) return false;
    const size_t place = size_t(data.at - begin);
    if (!(first[0] & HEAD) != head.empty() ||
        (!head.empty() && (!read_block(data, block, error) || block.left())))
        return damaged(error, "they have a head of their own, or lack that of the header");
    if (head.empty()) return true;
    Buffer length;
    put_leb(length, head.size());
    settings.replace(place, 1, std::string(length.begin(), length.end()) + head);
    return true;
}

std::shared_ptr<const Settings> unpack_settings(fhash_context& context, const uint8_t* data,
                                                size_t size, fhash_error& error) {
    const std::string key((const char*)data, size);
    auto& known = context.settings;
    const auto is_key = [&](const auto& entry) { return entry.first == key; };
    {
        const Guard guard(context.lock);
        const auto found = std::find_if(known.begin(), known.end(), is_key);
        if (found != known.end()) {
            std::rotate(known.begin(), found, found + 1);
            return known.front().second;
        }
    }
    auto settings = std::make_shared<Settings>();
    if (!unpack({data, data + size}, *settings, error)) return nullptr;
    const Guard guard(context.lock);
    if (std::find_if(known.begin(), known.end(), is_key) == known.end())
        known.insert(known.begin(), {key, settings});
    if (known.size() > REMEMBERED) known.pop_back();
    return settings;
}

}  // namespace fhash
