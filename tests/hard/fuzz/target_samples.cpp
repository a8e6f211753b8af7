// What an encoder learns from a tile: products of its lines, and inputs of the head for drawn
// voxels. Values may be anything; places and numbers are those of fhash_codec/compact/choices.
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

const int64_t INPUTS = 28, NEIGHBOURS = 26, BLOCK = 64;
const std::int16_t MAX_INPUT = 4095;

auto gram_of(const float*) { return fhash_gram_f32; }
auto gram_of(const double*) { return fhash_gram_f64; }

// The products are symmetric.
template <class T> void products(Reader& in) {
    const int64_t before = in.within(1, 5), length = in.within(1, 40), after = in.within(1, 150);
    const std::vector<T> values = repeated<T>(in, before * length * after);
    const double center = in.finite<double>();
    std::vector<double> out(static_cast<std::size_t>(length * length));
    require(gram_of(values.data())(values.data(), before, length, after, center, out.data()) == 0,
            "products that are refused");
    for (int64_t i = 0; i < length; i++)
        for (int64_t j = 0; j < i; j++) {
            const double one = out[static_cast<std::size_t>(i * length + j)];
            const double other = out[static_cast<std::size_t>(j * length + i)];
            require(one == other || (std::isnan(one) && std::isnan(other)), "other products");
        }
}

// Offsets (n, 4) of up to `reach` vertices along each axis.
std::vector<int64_t> offsets_of(Reader& in, int64_t n, int64_t reach) {
    std::vector<int64_t> offsets;
    for (int64_t i = 0; i < 4 * n; i++) offsets.push_back(in.within(0, 2 * reach) - reach);
    return offsets;
}

void inputs(Reader& in) {
    const std::uint8_t how = in.byte();
    const std::vector<int64_t> shape = small_shape(in, 9);
    const std::vector<float> decoded = repeated<float>(in, volume(shape));
    const int64_t blocks = in.within(1, 3), count = in.within(0, 255) % (blocks * BLOCK + 1);
    const int64_t looked_at = how & 1 ? 9 : 1;
    const std::vector<int64_t> neighbours = offsets_of(in, NEIGHBOURS, how & 2 ? 3 : 2);
    const std::vector<int64_t> offsets = offsets_of(in, looked_at, 1);
    std::vector<int64_t> places, slots;
    for (std::size_t axis = 0; axis < 4; axis++) {
        const std::vector<std::uint8_t> some = repeated<std::uint8_t>(in, count);
        for (const std::uint8_t place : some) places.push_back(place % shape[axis]);
    }
    for (int64_t i = 0; i < count; i++) slots.push_back((i * 67 + 5) % (blocks * BLOCK));
    float low = in.finite<float>(), high = in.finite<float>();
    if (low > high) std::swap(low, high);
    const float sigma = std::ldexp(1.0F + static_cast<float>(in.byte()) / 256,
                                   static_cast<int>(in.within(-100, 99)));
    const float span = high - low;
    const double unit = span > 0 ? 1024.0F / span : 0.0F;
    std::vector<std::int16_t> out(static_cast<std::size_t>(blocks * INPUTS * looked_at * BLOCK));
    const int64_t code = fhash_head_inputs(
        decoded.data(), shape.data(), places.data(), slots.data(), count, neighbours.data(),
        offsets.data(), looked_at, low, high, 0.5F / sigma, unit, out.data());
    bool near = true;
    for (const int64_t step : neighbours) near &= std::abs(step) <= 2;
    require(code == (near ? 0 : -1), "offsets that are refused, or are not");
    for (const std::int16_t input : out)
        require(std::abs(input) <= MAX_INPUT, "an input beyond its limit");
}

}  // namespace

void samples(Reader& in) {
    switch (in.byte() % 3) {
        case 0: products<float>(in); break;
        case 1: products<double>(in); break;
        default: inputs(in);
    }
}
