// The marcher with hostile values, coordinates and cameras, as far as Python passes them: all numbers of the setting are finite, values are
// never infinite, and steps are no less than a hundredth of a vertex.
#include <algorithm>
#include <cmath>
#include <limits>

#include "march.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

extern "C" {
int64_t fhash_march(const FhashMarch*, int64_t, int64_t, int64_t, int64_t*);
int64_t fhash_march_bricks(const float*, const int64_t*, const int64_t*, int64_t, int64_t, int64_t, float*, float*, float*);
int64_t fhash_march_distance(const int64_t*, std::int32_t*);
}

namespace {

// Mostly of an ordinary size, else anything that is finite up to 1e100, as positions are.
double number_of(Reader& in) {
    const std::uint8_t kind = in.byte();
    if (kind < 200) return (static_cast<double>(in.byte()) - 128) / 8;
    const double value = in.finite<double>();
    return std::max(-1e100, std::min(1e100, value));
}

}  // namespace

void march(Reader& in) {
    FhashMarch m{};
    for (int64_t& n : m.shape) n = in.within(1, 11);
    std::vector<float> values = repeated<float>(in, m.shape[0] * m.shape[1] * m.shape[2]);
    for (float& value : values)
        if (std::isinf(value)) value = std::numeric_limits<float>::quiet_NaN();
    m.values = values.data();
    for (int axis = 0; axis < 3; axis++) m.bricks[axis] = std::max<int64_t>((m.shape[axis] - 1 + FHASH_BRICK - 1) / FHASH_BRICK, 1);
    const int64_t bricks = m.bricks[0] * m.bricks[1] * m.bricks[2];
    const std::uint8_t flags = in.byte(), more = in.byte();

    std::vector<float> lowest(static_cast<std::size_t>(bricks)), highest(lowest.size()), scratch(static_cast<std::size_t>(2 * m.shape[2]));
    fhash_march_bricks(values.data(), m.shape, m.bricks, FHASH_BRICK, 0, m.bricks[0], lowest.data(), highest.data(), scratch.data());
    std::vector<std::int32_t> distance(lowest.size());
    const std::vector<std::uint8_t> matters = repeated<std::uint8_t>(in, bricks);
    for (std::size_t i = 0; i < distance.size(); i++) distance[i] = matters[i] % 3 ? 0 : 255;
    fhash_march_distance(m.bricks, distance.data());
    const std::vector<std::uint32_t> cells = repeated<std::uint32_t>(in, 2 * bricks);
    const bool skips = flags & 1;
    m.distance = skips ? distance.data() : nullptr;
    m.cells = skips && (flags & 2) ? cells.data() : nullptr;
    m.highest = flags & 4 ? highest.data() : nullptr;

    m.entries = in.within(2, 40);
    std::vector<float> table(static_cast<std::size_t>(4 * (m.entries + 1)));
    std::vector<double> extinction(static_cast<std::size_t>(m.entries + 1));
    const std::vector<std::uint8_t> shades = repeated<std::uint8_t>(in, m.entries + 1);
    for (std::size_t i = 0; i < extinction.size(); i++) {
        extinction[i] = i % 2 ? 0.0 : std::ldexp(static_cast<double>(shades[i]), (shades[i] % 40) - 20);
        for (std::size_t c = 0; c < 3; c++) table[4 * i + c] = static_cast<float>(shades[(i + c) % shades.size()]) / 255;
        table[4 * i + 3] = static_cast<float>(-std::expm1(-extinction[i]));
    }
    for (std::size_t c = 0; c < 4; c++) table[table.size() - 4 + c] = table[table.size() - 8 + c];
    extinction.back() = extinction[extinction.size() - 2];
    m.table = table.data();
    m.extinction = extinction.data();
    m.low = number_of(in);
    m.scale = in.finite<double>();

    int64_t light_shape[3];
    for (int64_t& n : light_shape) n = in.within(1, 6);
    std::vector<float> light = repeated<float>(in, 2 * light_shape[0] * light_shape[1] * light_shape[2]);
    for (float& share : light) share = std::isfinite(share) ? share : 0.0F;
    const bool lit = flags & 8;
    m.light = lit ? light.data() : nullptr;
    for (int axis = 0; axis < 3; axis++) {
        m.light_shape[axis] = lit ? light_shape[axis] : 0;
        m.light_offset[axis] = number_of(in);
        m.eye[axis] = number_of(in);
        m.right[axis] = number_of(in);
        m.up[axis] = number_of(in);
        m.forward[axis] = number_of(in);
        m.spacing[axis] = std::ldexp(more & 1 << axis ? -1.0 : 1.0, in.byte() < 200 ? 0 : static_cast<int>(in.within(-100, 100)));
        m.gradient[axis] = number_of(in);
        m.lamp[axis] = number_of(in);
        const double last = static_cast<double>(m.shape[2 - axis] - 1);
        m.box[axis][0] = m.seen[axis][0] = last > 0 ? 0.0 : -0.5;
        m.box[axis][1] = m.seen[axis][1] = last > 0 ? last : 0.5;
        if (more & 8) {  // the frame is a part of what is drawn
            m.box[axis][0] -= in.byte();
            m.box[axis][1] += in.byte();
        }
    }
    m.light_scale = 1.0 / static_cast<double>(in.within(1, 8));
    m.width = in.within(1, 20);
    m.height = in.within(1, 18);
    m.parallel = more >> 4 & 1;
    m.rays = in.within(1, 2);
    m.jitter = more >> 5 & 1;
    m.central = more >> 6 & 1;
    m.path = in.within(0, 2);
    // No ray may take more than some thousands of steps, as in plans.
    double longest = 0;
    for (int axis = 0; axis < 3; axis++) longest += std::fabs((m.box[axis][1] - m.box[axis][0]) * m.spacing[axis]);
    m.step = longest / (1 + in.byte() * 4);
    m.threshold = static_cast<double>(in.byte()) / 256;
    m.ambient = m.diffuse = m.specular = 0.5;
    m.steep = 1.0 + in.byte();
    m.floor = std::fabs(number_of(in));
    std::vector<float> powers(FHASH_POWERS + 2, 0.5F);
    m.powers = powers.data();
    m.surfaces = flags & 16 ? in.within(0, 3) : 0;
    for (int64_t i = 0; i < m.surfaces; i++) {
        m.surface[i][0] = number_of(in);
        for (int c = 1; c < 5; c++) m.surface[i][c] = static_cast<double>(in.byte()) / 255;
    }
    std::vector<float> out(static_cast<std::size_t>(4 * m.width * m.height)), depth(out.size() / 4), normal(3 * depth.size());
    m.out = out.data();
    m.depth = flags & 32 ? depth.data() : nullptr;
    m.normal = flags & 64 && m.depth ? normal.data() : nullptr;
    const int64_t wanted = flags & 128 ? 4 : (m.light ? 2 : 0) | (more >> 7);
    if (wanted & 4) m.surfaces = 0;
    int64_t counters[5] = {};
    fhash_march(&m, wanted, 0, ((m.width + 15) / 16) * ((m.height + 15) / 16), counters);
}
