// Points of the paper's network, of any size, at positions in the box. Python makes tables and
// layers (fhash_codec/paper/model.py); the positions are a user's.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

namespace {

const int AXES = 4;

template <class T> int64_t address(const std::vector<T>& array) {
    return static_cast<int64_t>(reinterpret_cast<std::uintptr_t>(array.data()));
}

// Numbers of ordinary size.
std::vector<float> numbers_of(Reader& in, int64_t n) {
    std::vector<float> result;
    for (const std::int8_t number : repeated<std::int8_t>(in, n))
        result.push_back(static_cast<float>(number) / 64);
    return result;
}

// A level: all vertices of each time node, or those that a bitmap has, of one time node.
struct Level {
    std::vector<float> table;
    std::vector<std::uint64_t> words;
    std::vector<std::uint32_t> blocks;
    std::vector<std::uint8_t> within;
    int64_t vertices[AXES], strides[AXES];

    void facts(std::vector<int64_t>& to) const {
        to.push_back(address(table));
        to.push_back(static_cast<int64_t>(table.size()));
        for (int a = 0; a < AXES; a++)
            for (const int64_t fact : {vertices[a], int64_t{0}, vertices[a] > 1 ? strides[a] : 0})
                to.push_back(fact);
        const bool some = !words.empty();
        for (const int64_t fact : {some ? address(words) : 0, some ? address(blocks) : 0,
                                   some ? address(within) : 0, some ? int64_t{blocks.back()} : 0})
            to.push_back(fact);
    }
};

// A table with two vertices along x at least, since corners are read in pairs.
void fill(Reader& in, Level& level, int64_t embedding) {
    const int64_t* const n = level.vertices;
    level.strides[3] = embedding;
    level.strides[2] = std::max<int64_t>(n[3], 2) * embedding;
    level.strides[1] = level.strides[2] * n[2];
    level.strides[0] = level.strides[1] * n[1];
    level.table = numbers_of(in, level.strides[0] * n[0]);
}

// A table of the vertices of a bitmap, whose rows are filled up to whole bytes; zeros come last.
void fill_some(Reader& in, Level& level, int64_t embedding) {
    const int64_t* const n = level.vertices;
    level.strides[3] = 1;
    level.strides[2] = (n[3] + 7) / 8 * 8;
    level.strides[1] = level.strides[2] * n[2];
    level.strides[0] = 0;
    const int64_t bits = level.strides[1] * n[1];
    const std::vector<std::uint8_t> seed = repeated<std::uint8_t>(in, bits);
    level.words.assign(static_cast<std::size_t>((bits + 63) / 64), 0);
    for (int64_t bit = 0; bit < bits; bit++)
        if (bit % level.strides[2] < n[3] && seed[static_cast<std::size_t>(bit)] & 1)
            level.words[static_cast<std::size_t>(bit / 64)] |= std::uint64_t{1} << bit % 64;
    std::uint32_t before = 0, in_block = 0;
    for (std::size_t word = 0; word < level.words.size(); word++) {
        if (word % 4 == 0) {
            level.blocks.push_back(before);
            in_block = before;
        }
        level.within.push_back(static_cast<std::uint8_t>(before - in_block));
        before += static_cast<std::uint32_t>(__builtin_popcountll(level.words[word]));
    }
    level.blocks.push_back(before);
    level.table = numbers_of(in, (before + int64_t{1}) * embedding);
    std::fill(level.table.end() - embedding, level.table.end(), 0.0F);
}

// A network, as the native functions take it.
struct Network {
    std::vector<Level> levels;
    std::vector<std::vector<float>> matrices;
    std::vector<int64_t> sizes, facts, layers;
    int64_t embedding;

    explicit Network(Reader& in) {
        const std::uint8_t how = in.byte();
        const bool times = how & 1, sparse = how & 2;
        int64_t box[AXES];
        for (int64_t& length : box) length = in.within(1, 12);
        embedding = in.within(1, 5);
        levels.resize(static_cast<std::size_t>(in.within(1, 3)));
        for (Level& level : levels) {
            for (int a = 0; a < AXES; a++)
                level.vertices[a] = a == 0 && !times ? 1 : in.within(1, box[a]);
            if (sparse && !times) fill_some(in, level, embedding);
            else fill(in, level, embedding);
        }
        add_layers(in);
        sizes.assign(box, box + AXES);
        for (const int64_t size : {static_cast<int64_t>(levels.size()),
                                   static_cast<int64_t>(matrices.size()), embedding,
                                   int64_t{has_times()}})
            sizes.push_back(size);
        for (const Level& level : levels) level.facts(facts);
    }
    // Whether a table has several time nodes.
    bool has_times() const {
        return std::any_of(levels.begin(), levels.end(),
                           [](const Level& level) { return level.vertices[0] > 1; });
    }

private:
    void add_layers(Reader& in) {
        const int64_t hidden = in.within(0, 3);
        int64_t inputs = static_cast<int64_t>(levels.size()) * embedding;
        for (int64_t n = 0; n <= hidden; n++) {
            const int64_t outputs = n == hidden ? 1 : in.within(1, 20);
            matrices.push_back(numbers_of(in, (outputs + 1) * (inputs + 1)));
            layers.insert(layers.end(), {address(matrices.back()), outputs, inputs});
            inputs = outputs;
        }
    }
};

// Coordinates in a box of a length: on a vertex, between two, or on either end.
std::vector<double> column_of(Reader& in, int64_t n, int64_t length) {
    const std::vector<std::uint32_t> seed = repeated<std::uint32_t>(in, n);
    const double last = static_cast<double>(length - 1);
    std::vector<double> column;
    for (const std::uint32_t number : seed) {
        const double share = static_cast<double>(number) / 4294967295.0;
        const double whole = static_cast<double>(number % static_cast<std::uint32_t>(length));
        column.push_back(number & 1 ? whole : std::min(share * last, last));
    }
    return column;
}

using Columns = std::vector<std::vector<double>>;

struct Found {
    std::vector<float> values, slopes, by_inputs;  // the last point by point
    bool operator==(const Found& other) const {
        return same(values, other.values) && same(slopes, other.slopes) &&
               same(by_inputs, other.by_inputs);
    }

private:
    static bool same(const std::vector<float>& one, const std::vector<float>& other) {
        return one.size() == other.size() &&
               (one.empty() || !std::memcmp(one.data(), other.data(), 4 * one.size()));
    }
};

// Values and slopes of the points from `first` on.
Found evaluated(const Network& network, const std::vector<int64_t>& facts,
                const std::vector<int64_t>& sizes, const Columns& columns, std::size_t first,
                int64_t count, int64_t path, bool slopes) {
    std::vector<int64_t> places;
    for (const std::vector<double>& column : columns) {
        const bool one = column.size() == 1;
        places.push_back(address(column) + (one ? 0 : static_cast<int64_t>(8 * first)));
        places.push_back(one ? 0 : 1);
    }
    Found found;
    found.values.resize(static_cast<std::size_t>(count));
    const std::size_t inputs = static_cast<std::size_t>(sizes[4] * sizes[6]);
    std::vector<float> by_inputs(slopes ? inputs * found.values.size() : 0);
    if (slopes) found.slopes.resize(4 * found.values.size());
    require(fhash_network_points(sizes.data(), facts.data(), network.layers.data(), places.data(),
                                 count, path, found.values.data(),
                                 slopes ? found.slopes.data() : nullptr,
                                 slopes ? by_inputs.data() : nullptr) == 0,
            "points that are refused");
    for (std::size_t i = 0; slopes && i < found.values.size(); i++)
        for (std::size_t k = 0; k < inputs; k++)
            found.by_inputs.push_back(by_inputs[k * found.values.size() + i]);
    for (const float value : found.values) require(std::isfinite(value), "a value of no size");
    return found;
}

// The same values by tables that are interpolated at the points' one time.
void at_one_time(const Network& network, const Columns& columns, int64_t count, int64_t path,
                 const Found& found) {
    std::vector<std::vector<float>> tables;
    std::vector<int64_t> facts = network.facts, sizes = network.sizes;
    const std::size_t each = facts.size() / network.levels.size();
    for (std::size_t l = 0; l < network.levels.size(); l++) {
        const Level& level = network.levels[l];
        tables.emplace_back(level.table.size() / static_cast<std::size_t>(level.vertices[0]));
        int64_t* const of = facts.data() + l * each;
        if (level.vertices[0] > 1)
            require(fhash_network_still(sizes.data(), of, columns[0][0], path,
                                        tables.back().data()) == 0,
                    "a time that is refused");
        else
            tables.back() = level.table;
        of[0] = address(tables.back());
        of[1] = static_cast<int64_t>(tables.back().size());
        of[2] = 1;
        of[4] = 0;
    }
    sizes[7] = 0;
    const Found still = evaluated(network, facts, sizes, columns, 0, count, path, false);
    for (std::size_t i = 0; i < still.values.size(); i++)
        require(still.values[i] == found.values[i], "other values at one time");
}

}  // namespace

void points(Reader& in) {
    const std::uint8_t how = in.byte();
    const Network network(in);
    const int64_t count = in.within(1, 200), path = int64_t{1} << how % 3;
    if (!(fhash_network_paths() & path)) return;
    Columns columns;
    for (std::size_t axis = 0; axis < AXES; axis++)
        columns.push_back(column_of(in, how >> axis & 8 ? count : 1, network.sizes[axis]));
    const bool slopes = how & 4;
    const Found all = evaluated(network, network.facts, network.sizes, columns, 0, count, path,
                                slopes);
    // A point has the same bits whatever points are given with it.
    const int64_t part = in.within(0, count - 1);
    const Found rest = evaluated(network, network.facts, network.sizes, columns,
                                 static_cast<std::size_t>(part), count - part, path, slopes);
    Found expected = all;
    expected.values.erase(expected.values.begin(), expected.values.begin() + part);
    if (slopes)
        expected.slopes.erase(expected.slopes.begin(), expected.slopes.begin() + 4 * part);
    const int64_t inputs = slopes ? network.sizes[4] * network.sizes[6] : 0;
    expected.by_inputs.erase(expected.by_inputs.begin(),
                             expected.by_inputs.begin() + inputs * part);
    require(rest == expected, "other bits beside other points");
    if (columns[0].size() == 1 && network.has_times())
        at_one_time(network, columns, count, path, all);
}
