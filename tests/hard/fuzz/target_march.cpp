// The marcher with hostile values, coordinates and cameras, as far as Python passes them on.
//
// All numbers of the task are finite, values are never infinite, and steps are at least a hundredth
// of a vertex long.
#include <algorithm>
#include <cmath>
#include <limits>

#include "exports.hpp"
#include "march.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

// A number of ordinary size, or sometimes any finite number up to 1e100, as positions may be.
double number_of(Reader& in) {
    const std::uint8_t kind = in.byte();
    if (kind < 200) return (static_cast<double>(in.byte()) - 128) / 8;
    const double value = in.finite<double>();
    return std::max(-1e100, std::min(1e100, value));
}

// The arrays to which a task points.
struct Arrays {
    std::vector<float> values, lowest, highest, scratch, table, light, powers, out, depth, normal;
    std::vector<float> grading, smooth;
    std::vector<double> extinction;
    std::vector<std::int32_t> distance;
    std::vector<std::uint32_t> cells;
};

// Bits of a byte of the input, each of which switches something on.
struct Switches {
    std::uint8_t bits;
    bool on(int bit) const { return bits >> bit & 1; }
};

void make_values(Reader& in, FhashMarch& m, Arrays& arrays) {
    for (int64_t& n : m.shape) n = in.within(1, 11);
    arrays.values = repeated<float>(in, m.shape[0] * m.shape[1] * m.shape[2]);
    for (float& value : arrays.values)
        if (std::isinf(value)) value = std::numeric_limits<float>::quiet_NaN();
    m.values = arrays.values.data();
}

// Find the visible cells of every second brick, for intervals between finite values; the others
// keep hostile ones.
void find_cells(Reader& in, const FhashMarch& m, Arrays& arrays) {
    const int64_t intervals = in.within(0, 20);
    std::vector<float> limits = in.numbers<float>(2 * intervals);
    for (float& limit : limits) limit = std::isnan(limit) ? 0.0F : limit;
    std::sort(limits.begin(), limits.end());
    std::vector<int64_t> numbers;
    for (int64_t brick = 0; brick < m.bricks[0] * m.bricks[1] * m.bricks[2]; brick += 2)
        numbers.push_back(brick);
    const int64_t count = static_cast<int64_t>(numbers.size());
    const int64_t visible =
        fhash_march_cells(m.values, m.shape, m.bricks, limits.data(), intervals, numbers.data(), 0,
                          count, arrays.cells.data());
    require(visible >= 0 && visible <= 64 * count, "more visible cells than there are");
}

// Bricks with hostile distances and cells; the marcher skips them or not.
void make_bricks(Reader& in, Switches flags, FhashMarch& m, Arrays& arrays) {
    const int64_t bricks = m.bricks[0] * m.bricks[1] * m.bricks[2];
    arrays.lowest.resize(static_cast<std::size_t>(bricks));
    arrays.highest.resize(arrays.lowest.size());
    arrays.scratch.resize(static_cast<std::size_t>(2 * m.shape[2]));
    const int64_t strides[] = {m.shape[1] * m.shape[2], m.shape[2]};
    fhash_march_bricks(m.values, m.shape, strides, m.bricks, FHASH_BRICK, 0, m.bricks[0],
                       arrays.lowest.data(), arrays.highest.data(), arrays.scratch.data());
    arrays.distance.resize(arrays.lowest.size());
    const std::vector<std::uint8_t> matters = repeated<std::uint8_t>(in, bricks);
    for (std::size_t i = 0; i < arrays.distance.size(); i++)
        arrays.distance[i] = matters[i] % 3 ? 0 : 255;
    std::vector<std::int32_t> lines(arrays.distance.size());
    fhash_march_distance_layers(m.bricks, arrays.distance.data(), 0, m.bricks[0], lines.data());
    fhash_march_distance_rows(m.bricks, arrays.distance.data(), 0, m.bricks[1], lines.data());
    arrays.cells = repeated<std::uint32_t>(in, 2 * bricks);
    find_cells(in, m, arrays);
    m.distance = flags.on(0) ? arrays.distance.data() : nullptr;
    m.cells = flags.on(0) && flags.on(1) ? arrays.cells.data() : nullptr;
    m.highest = flags.on(2) ? arrays.highest.data() : nullptr;
}

// A transfer function whose last entry is repeated, as Python passes it.
void make_table(Reader& in, FhashMarch& m, Arrays& arrays) {
    m.entries = in.within(2, 40);
    std::vector<float>& table = arrays.table;
    std::vector<double>& extinction = arrays.extinction;
    table.resize(static_cast<std::size_t>(4 * (m.entries + 1)));
    extinction.resize(static_cast<std::size_t>(m.entries + 1));
    const std::vector<std::uint8_t> shades = repeated<std::uint8_t>(in, m.entries + 1);
    for (std::size_t i = 0; i < extinction.size(); i++) {
        extinction[i] =
            i % 2 ? 0.0 : std::ldexp(static_cast<double>(shades[i]), (shades[i] % 40) - 20);
        for (std::size_t c = 0; c < 3; c++)
            table[4 * i + c] = static_cast<float>(shades[(i + c) % shades.size()]) / 255;
        table[4 * i + 3] = static_cast<float>(-std::expm1(-extinction[i]));
    }
    for (std::size_t c = 0; c < 4; c++) table[table.size() - 4 + c] = table[table.size() - 8 + c];
    extinction.back() = extinction[extinction.size() - 2];
    m.table = table.data();
    m.extinction = extinction.data();
    m.low = number_of(in);
    m.scale = in.finite<double>();
}

// A box that clips the drawn one, and what the frame has of it, as MarchInput has them.
void clip_box(Reader& in, FhashMarch& m) {
    for (int axis = 0; axis < 3; axis++) {
        const double length = m.box[axis][1] - m.box[axis][0], low = m.box[axis][0];
        const double first = in.byte() / 255.0, second = in.byte() / 255.0;
        m.box[axis][0] = low + std::min(first, second) * length;
        m.box[axis][1] = low + std::max(first, second) * length;
        m.seen[axis][0] = std::max(m.seen[axis][0], m.box[axis][0]);
        m.seen[axis][1] = std::max(std::min(m.seen[axis][1], m.box[axis][1]), m.seen[axis][0]);
    }
}

void make_light_and_camera(Reader& in, Switches flags, Switches more, FhashMarch& m,
                           Arrays& arrays) {
    int64_t light_shape[3];
    for (int64_t& n : light_shape) n = in.within(1, 6);
    arrays.light = repeated<float>(in, 2 * light_shape[0] * light_shape[1] * light_shape[2]);
    for (float& share : arrays.light) share = std::isfinite(share) ? share : 0.0F;
    const bool lit = flags.on(3);
    m.light = lit ? arrays.light.data() : nullptr;
    for (int axis = 0; axis < 3; axis++) {
        m.light_shape[axis] = lit ? light_shape[axis] : 0;
        m.light_offset[axis] = number_of(in);
        m.eye[axis] = number_of(in);
        m.right[axis] = number_of(in);
        m.up[axis] = number_of(in);
        m.forward[axis] = number_of(in);
        const int exponent = in.byte() < 200 ? 0 : static_cast<int>(in.within(-100, 100));
        m.spacing[axis] = std::ldexp(more.on(axis) ? -1.0 : 1.0, exponent);
        m.gradient[axis] = number_of(in);
        m.lamp[axis] = number_of(in);
        const double last = static_cast<double>(m.shape[2 - axis] - 1);
        m.box[axis][0] = m.seen[axis][0] = last > 0 ? 0.0 : -0.5;
        m.box[axis][1] = m.seen[axis][1] = last > 0 ? last : 0.5;
        if (more.on(3)) {  // the frame is smaller than the drawn box
            m.box[axis][0] -= in.byte();
            m.box[axis][1] += in.byte();
        }
    }
    if (in.byte() & 1) clip_box(in, m);
    m.light_scale = 1.0 / static_cast<double>(in.within(1, 8));
}

void make_march(Reader& in, Switches flags, Switches more, FhashMarch& m, Arrays& arrays) {
    m.width = in.within(1, 20);
    m.height = in.within(1, 18);
    m.parallel = more.on(4);
    m.rays = in.within(1, 2);
    m.jitter = more.on(5);
    m.central = more.on(6);
    m.path = in.within(0, 2);
    // A ray takes at most some thousands of steps, as in plans.
    double longest = 0;
    for (int axis = 0; axis < 3; axis++)
        longest += std::fabs((m.box[axis][1] - m.box[axis][0]) * m.spacing[axis]);
    m.step = longest / (1 + in.byte() * 4);
    if (!(m.step > 0)) m.step = 1;  // a box without a length
    m.threshold = static_cast<double>(in.byte()) / 256;
    m.ambient = m.diffuse = m.specular = 0.5;
    m.steep = 1.0 + in.byte();
    m.floor = std::fabs(number_of(in));
    arrays.powers.assign(FHASH_POWERS + 2, 0.5F);
    m.powers = arrays.powers.data();
    m.surfaces = flags.on(4) ? in.within(0, 3) : 0;
    for (int64_t i = 0; i < m.surfaces; i++) {
        m.surface[i][0] = number_of(in);
        for (int c = 1; c < 5; c++) m.surface[i][c] = static_cast<double>(in.byte()) / 255;
    }
    m.planes = in.within(0, FHASH_PLANES);
    for (int64_t i = 0; i < m.planes; i++)
        for (double& number : m.plane[i]) number = number_of(in);
    const std::vector<std::uint8_t> factors = in.numbers<std::uint8_t>(8);
    for (std::size_t i = 0; i < FHASH_GRADES + 2; i++)
        arrays.grading.push_back(static_cast<float>(factors[i / 129]) / 255);
    m.grading = arrays.grading.data();
    m.grade_scale = std::fabs(number_of(in));
    m.unlit = in.within(0, 1);
    const int64_t vertices = static_cast<int64_t>(arrays.values.size());
    if (in.byte() & 1) arrays.smooth = repeated<float>(in, vertices);
    m.smooth = arrays.smooth.empty() ? nullptr : arrays.smooth.data();
    arrays.out.resize(static_cast<std::size_t>(4 * m.width * m.height));
    arrays.depth.assign(arrays.out.size() / 4, std::numeric_limits<float>::infinity());
    arrays.normal.resize(3 * arrays.depth.size());
    m.out = arrays.out.data();
    m.depth = flags.on(5) ? arrays.depth.data() : nullptr;
    m.normal = flags.on(6) && m.depth ? arrays.normal.data() : nullptr;
}

// A network of one wave, which is asked for no more places than it is made for.
int64_t stand_in(const int64_t*, const int64_t*, const int64_t*, const int64_t* columns,
                 int64_t count, int64_t, float* values, float* slopes, float*) {
    require(count >= 0 && count <= FHASH_POINTS, "more points than fit");
    for (int64_t i = 0; i < count; i++) {
        double sum = 0;
        for (int axis = 1; axis < 4; axis++)
            sum += reinterpret_cast<const double*>(columns[2 * axis])[i];
        values[i] = (float)(0.5 + std::sin(sum));
        for (int axis = 0; slopes && axis < 4; axis++)
            slopes[4 * i + axis] = axis ? (float)std::cos(sum) : 0.0F;
    }
    return 0;
}

// Bricks of a frame that is decoded while it is marched, and how many may be fetched.
std::vector<std::int32_t> ready;
int64_t fetches;

int64_t fetch(int64_t brick) {
    require(brick >= 0 && brick < static_cast<int64_t>(ready.size()), "a brick beyond the frame");
    require(!ready[static_cast<std::size_t>(brick)], "a brick that is there is fetched again");
    if (fetches-- <= 0) return 1;
    ready[static_cast<std::size_t>(brick)] = 1;
    return 0;
}

}  // namespace

void march(Reader& in) {
    FhashMarch m{};
    Arrays arrays;
    make_values(in, m, arrays);
    for (int axis = 0; axis < 3; axis++)
        m.bricks[axis] = std::max<int64_t>((m.shape[axis] - 1 + FHASH_BRICK - 1) / FHASH_BRICK, 1);
    const Switches flags{in.byte()}, more{in.byte()};
    make_bricks(in, flags, m, arrays);
    make_table(in, m, arrays);
    make_light_and_camera(in, flags, more, m, arrays);
    make_march(in, flags, more, m, arrays);
    const int64_t projections[] = {4, 4 | 32, 64, 128};
    const bool projected = flags.on(7);
    const int64_t drawn = (m.light ? 2 : 0) | (more.on(7) ? 1 : 0);
    const int64_t effects =
        projected ? projections[in.within(0, 3)] : in.within(0, 1) ? drawn | 1 | 256 : drawn;
    if (projected) m.surfaces = 0;
    int64_t status = 0;
    if (in.within(0, 1)) {
        m.network = stand_in;
        m.network_low = m.low;
        m.network_span = (double)(m.entries - 1) / m.scale;
        m.network_whole = in.within(0, 1);
        m.network_status = &status;
    }
    if (in.within(0, 1)) {
        ready = repeated<std::int32_t>(in, m.bricks[0] * m.bricks[1] * m.bricks[2]);
        for (std::int32_t& one : ready) one &= 1;
        fetches = in.byte();
        m.ready = ready.data();
        m.fetch = fetch;
    }
    int64_t counters[6] = {};
    fhash_march(&m, effects, 0, ((m.width + 15) / 16) * ((m.height + 15) / 16), counters);
    // The light that is left adds up to no more than all, whatever the values are.
    for (std::size_t pixel = 0; pixel < arrays.depth.size(); pixel++) {
        const float opacity = arrays.out[4 * pixel + 3];
        require(opacity >= -1e-5F && opacity <= 1.00001F, "an opacity beyond 0 to 1");
    }
}
