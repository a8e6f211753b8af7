// The profile paper: tables of embeddings, and the network that makes values of them (FORMAT.md,
// Profile paper).
#include <algorithm>
#include <cmath>
#include <cstring>

#include "bytes.hpp"
#include "volume.hpp"

namespace fhash {

namespace {

constexpr int64_t TOGETHER = 64;  // points that the layers work on at once

struct Layer {
    int64_t outputs = 0, inputs = 0;
    std::vector<float> weights, biases;
};

// What every function needs of a model.
struct Model {
    fhash_file& file;
    const Variable& variable;
    int64_t size = 0, layers = 0, width = 0;  // numbers of an embedding, hidden layers

    explicit Model(fhash_file& f, const Variable& v) : file(f), variable(v) {}
    bool coded() const { return variable.tables == "transform"; }
    bool sparse() const { return variable.model.find("sparse") != nullptr; }
};

bool read_sizes(const Variable& variable, int64_t& size, int64_t& layers, int64_t& width,
                fhash_error& error) {
    const Record& model = variable.model;
    return model.integer("embedding_size", 1, 1024, size, error) &&
           model.integer("hidden_layers", 0, 64, layers, error) &&
           model.integer("width", 1, 65536, width, error);
}

std::string table_name(size_t level) { return "table_" + std::to_string(level + 1); }

std::string component_name(size_t level, int64_t component) {
    return table_name(level) + "/component_" + std::to_string(component + 1);
}

// Outputs and inputs of each layer.
std::vector<std::pair<int64_t, int64_t>> layer_shapes(const Variable& variable, int64_t size,
                                                      int64_t layers, int64_t width) {
    std::vector<std::pair<int64_t, int64_t>> shapes;
    int64_t inputs = int64_t(variable.levels.size()) * size;
    for (int64_t layer = 0; layer <= layers; layer++) {
        const int64_t outputs = layer < layers ? width : 1;
        shapes.emplace_back(outputs, inputs);
        inputs = outputs;
    }
    return shapes;
}

// The numbers of vertices of a sparse table at its time nodes.
bool read_counts(const Variable& variable, size_t level, const Array& array,
                 std::vector<int64_t>& counts, fhash_error& error) {
    const auto& shape = variable.levels[level];
    const double most = double(shape[1]) * double(shape[2]) * double(shape[3]);
    const Record attributes = {array.attributes, "array " + array.path + " attribute "};
    const Json list = attributes.find("counts");
    // Checked first, because lengths of a header may ask for any memory.
    if (!attributes.need(yyjson_is_arr(list) && int64_t(yyjson_arr_size(list)) == shape[0] &&
                             most < 1e18,
                         "counts", "a number for each time node", error))
        return false;
    counts.resize(size_t(shape[0]));
    return attributes.integers("counts", counts.size(), 0, shape[1] * shape[2] * shape[3],
                               counts.data(), error);
}

bool check_table(const Variable& variable, size_t level, int64_t size, fhash_error& error) {
    const std::string& kind = variable.tables;
    const std::string name = table_name(level);
    std::vector<int64_t> shape(variable.levels[level].begin(), variable.levels[level].end());
    if (kind == "transform") {
        for (int64_t component = 0; component < size; component++) {
            const std::string part = component_name(level, component);
            if (!check_array(variable, part.c_str(), shape, {FHASH_FLOAT32}, true, error))
                return false;
            const Record attributes = {variable.find(part)->attributes,
                                       "array " + part + " attribute "};
            std::vector<double> mixing(size_t(size), 0.0);
            if (!attributes.numbers("mixing", size_t(size), mixing.data(), error)) return false;
        }
        return true;
    }
    const Array* const array = variable.find(name);
    if (!array) return fail(error, FHASH_ERROR_DAMAGED, "array %s is missing", name.c_str());
    if (variable.model.find("sparse")) {
        std::vector<int64_t> counts;
        if (!read_counts(variable, level, *array, counts, error)) return false;
        shape = {0};
        for (const int64_t count : counts)
            shape[0] = std::min(shape[0] + count, int64_t(1) << 61);
    }
    shape.push_back(size);
    const Record attributes = {array->attributes, "array " + name + " attribute "};
    double offset = 0, scale = 0;
    return check_array(variable, name.c_str(), shape, {type_of_name(kind.c_str())}, true, error) &&
           (kind != "uint8" || (attributes.number("offset", offset, error) &&
                                attributes.number("scale", scale, error) &&
                                attributes.need(scale >= 0, "scale", "at least 0", error)));
}

// Numbers of an array of float32, float16, or uint8 with its scale, as float32.
bool read_numbers(fhash_file& file, const Array& array, const Region& region,
                  std::vector<float>& numbers, fhash_error& error) {
    Buffer bytes;
    const uint64_t count = region.size(array.axes);
    if (!may_use(*file.context, 8 * count, error) ||
        !read_region(file, array, region, bytes, nullptr, error))
        return false;
    numbers.resize(size_t(count));
    const Json scale = yyjson_obj_get(array.attributes, "scale");
    const Json offset = yyjson_obj_get(array.attributes, "offset");
    const float factor = scale ? float(yyjson_get_num(scale)) : 1.0f;
    const float start = offset ? float(yyjson_get_num(offset)) : 0.0f;
    for (size_t i = 0; i < numbers.size(); i++) {
        const uint8_t* const at = bytes.data() + i * fhash_type_size(array.type);
        if (array.type == FHASH_FLOAT32) numbers[i] = little<float>(at);
        else if (array.type == FHASH_FLOAT16) numbers[i] = from_half(little<uint16_t>(at));
        else if (array.type == FHASH_INT16) numbers[i] = float(little<int16_t>(at));
        else numbers[i] = float(bytes[i]) * factor + start;
    }
    return true;
}

// Which vertices of a level lie beside one of the box, along one axis: the number of the one
// before, and whether there is one after it as well.
void corners(int64_t vertex, int64_t length, int64_t resolution, int64_t& before, int64_t& after) {
    const int64_t span = std::max<int64_t>(length - 1, 1);
    before = vertex * (resolution - 1) / span;
    after = before + (vertex * (resolution - 1) % span > 0);
}

// Which vertices of a level are needed at a time node (FORMAT.md, Sparse tables).
bool read_needed(const Model& model, size_t level, int64_t node, Buffer& mask,
                 fhash_error& error) {
    const Variable& variable = model.variable;
    const auto& shape = variable.levels[level];
    const int64_t keys = variable.keys();
    const bool fringe = yyjson_equals_str(variable.model.find("sparse"), "fringe");
    std::vector<uint8_t> wanted(size_t(keys) + 2, 0);
    for (int64_t key = 0; key < keys; key++) {
        int64_t before, after;
        corners(key, keys, shape[0], before, after);
        if (before != node && after != node) continue;
        wanted[size_t(key) + 1] = 1;
        if (fringe) wanted[size_t(key)] = wanted[size_t(key) + 2] = 1;
    }
    Lattice box;
    for (int a = 0; a < 3; a++) box.count[a] = variable.length(a);
    if (!may_use(*model.file.context, 2 * uint64_t(box.size()), error)) return false;
    mask.assign(size_t(box.size()), 0);
    for (int64_t key = 0; key < keys; key++)
        if (wanted[size_t(key) + 1] &&
            !add_occupancy(model.file, variable, key, box, mask, error))
            return false;
    int64_t lengths[3] = {box.count[0], box.count[1], box.count[2]};
    for (int a = 0; a < 3; a++) {
        const int64_t resolution = shape[size_t(a) + 1], length = lengths[a];
        if (length == resolution) continue;
        const int64_t outer = (a > 0 ? lengths[0] : 1) * (a > 1 ? lengths[1] : 1);
        const int64_t inner = (a < 1 ? lengths[1] : 1) * (a < 2 ? lengths[2] : 1);
        Buffer spread(size_t(outer * resolution * inner), 0);
        for (int64_t o = 0; o < outer; o++)
            for (int64_t i = 0; i < length; i++) {
                int64_t before, after;
                corners(i, length, resolution, before, after);
                const uint8_t* const from = mask.data() + (o * length + i) * inner;
                for (int64_t at : {before, after}) {
                    uint8_t* const to = spread.data() + (o * resolution + at) * inner;
                    for (int64_t k = 0; k < inner; k++) to[k] |= from[k];
                }
            }
        mask = std::move(spread);
        lengths[a] = resolution;
    }
    return true;
}

// The embeddings (z, y, x, E) of a part of a sparse table at a time node.
bool read_sparse(const Model& model, size_t level, int64_t node, const Region& part,
                 std::vector<float>& numbers, fhash_error& error) {
    const Array& array = *model.variable.find(table_name(level));
    const auto& shape = model.variable.levels[level];
    std::vector<int64_t> counts;
    Buffer mask;
    if (!read_counts(model.variable, level, array, counts, error) ||
        !read_needed(model, level, node, mask, error))
        return false;
    Region rows;
    for (int64_t before = 0; before < node; before++) rows.first[0] += counts[size_t(before)];
    rows.last[0] = rows.first[0] + counts[size_t(node)];
    rows.last[1] = model.size;
    if (int64_t(std::count(mask.begin(), mask.end(), 1)) != counts[size_t(node)])
        return fail(error, FHASH_ERROR_DAMAGED,
                    "array %s has another number of vertices than the occupancy asks for",
                    array.path.c_str());
    std::vector<float> held;
    if (counts[size_t(node)] && !read_numbers(model.file, array, rows, held, error)) return false;
    const size_t size = size_t(model.size);
    if (!may_use(*model.file.context, 4 * part.size(4) * size, error)) return false;
    numbers.assign(size_t(part.size(4)) * size, 0.0f);
    size_t rank = 0, vertex = 0;
    for (int64_t z = 0; z < shape[1]; z++)
        for (int64_t y = 0; y < shape[2]; y++)
            for (int64_t x = 0; x < shape[3]; x++) {
                if (!mask[vertex++]) continue;
                const size_t from = size * rank++;
                if (z < part.first[1] || z >= part.last[1] || y < part.first[2] ||
                    y >= part.last[2] || x < part.first[3] || x >= part.last[3])
                    continue;
                const size_t to =
                    size_t(((z - part.first[1]) * (part.last[2] - part.first[2]) + y -
                            part.first[2]) * (part.last[3] - part.first[3]) + x - part.first[3]);
                std::copy_n(held.data() + from, size, numbers.data() + to * size);
            }
    return true;
}

// The embeddings of a table whose components are coded.
bool read_coded(const Model& model, size_t level, const Region& part, std::vector<float>& numbers,
                fhash_error& error) {
    const size_t size = size_t(model.size), count = size_t(part.size(4));
    if (!may_use(*model.file.context, 4 * uint64_t(count) * size, error)) return false;
    numbers.assign(count * size, 0.0f);
    for (size_t component = 0; component < size; component++) {
        const Array& array = *model.variable.find(component_name(level, int64_t(component)));
        const Record attributes = {array.attributes, "attribute "};
        std::vector<double> mixing(size, 0.0);
        std::vector<float> values;
        if (!attributes.numbers("mixing", size, mixing.data(), error) ||
            !read_numbers(model.file, array, part, values, error))
            return false;
        for (size_t i = 0; i < count; i++)
            for (size_t e = 0; e < size; e++) {
                const float product = values[i] * float(mixing[e]);
                numbers[i * size + e] = component ? numbers[i * size + e] + product : product;
            }
    }
    return true;
}

// A part of a level at one time: embeddings (z, y, x, E).
struct Patch {
    int64_t first[3], count[3];
    std::vector<float> numbers;
};

bool read_nodes(const Model& model, size_t level, int64_t node, Patch& patch,
                std::vector<float>& numbers, fhash_error& error) {
    Region part;
    part.first[0] = node;
    part.last[0] = node + 1;
    for (size_t a = 0; a < 3; a++) {
        part.first[a + 1] = patch.first[a];
        part.last[a + 1] = patch.first[a] + patch.count[a];
    }
    bool read;
    if (model.coded()) {
        read = read_coded(model, level, part, numbers, error);
    } else if (model.sparse()) {
        read = read_sparse(model, level, node, part, numbers, error);
    } else {
        part.last[4] = model.size;
        read = read_numbers(model.file, *model.variable.find(table_name(level)), part, numbers,
                            error);
    }
    if (!read) return false;
    const auto finite = [](float number) { return std::isfinite(number); };
    return std::all_of(numbers.begin(), numbers.end(), finite) ||
           fail(error, FHASH_ERROR_DAMAGED,
                "the table of level %zu has numbers that are not finite", level + 1);
}

// The vertex of a level before one of the box, along an axis, and how far behind it that lies.
int64_t corner(int64_t vertex, int64_t length, int64_t resolution, float& weight) {
    const double at = double(vertex) * double(resolution - 1) /
                      double(std::max<int64_t>(length - 1, 1));
    const int64_t before = std::min(int64_t(at), std::max<int64_t>(resolution - 2, 0));
    weight = float(at - double(before));
    return before;
}

// Reads what the vertices of a lattice need of a level, and interpolates it in time.
bool read_patch(const Model& model, size_t level, double key, const Lattice& lattice, Patch& patch,
                fhash_error& error) {
    const auto& shape = model.variable.levels[level];
    for (int a = 0; a < 3; a++) {
        float ignored;
        const int64_t length = model.variable.length(a), resolution = shape[size_t(a) + 1];
        patch.first[a] = corner(lattice.first[a], length, resolution, ignored);
        patch.count[a] = std::min(corner(lattice.last(a) - 1, length, resolution, ignored) + 2,
                                  resolution) - patch.first[a];
    }
    const double at = key * double(shape[0] - 1) /
                      double(std::max<int64_t>(model.variable.keys() - 1, 1));
    const int64_t node = std::min(int64_t(at), shape[0] - 1);
    const float share = float(at - double(node));
    if (!read_nodes(model, level, node, patch, patch.numbers, error)) return false;
    if (!(at > double(node)) || node + 1 >= shape[0]) return true;
    std::vector<float> after;
    if (!read_nodes(model, level, node + 1, patch, after, error)) return false;
    for (size_t i = 0; i < after.size(); i++)
        patch.numbers[i] += share * (after[i] - patch.numbers[i]);
    return true;
}

bool read_layers(const Model& model, std::vector<Layer>& layers, fhash_error& error) {
    const auto shapes = layer_shapes(model.variable, model.size, model.layers, model.width);
    const Array* const together = model.coded() ? model.variable.find("mlp/parameters") : nullptr;
    Region all;
    int64_t start = 0;
    for (size_t i = 0; i < shapes.size(); i++) {
        Layer layer;
        layer.outputs = shapes[i].first;
        layer.inputs = shapes[i].second;
        const std::string number = std::to_string(i + 1);
        for (int part = 0; part < 2; part++) {
            std::vector<float>& numbers = part ? layer.biases : layer.weights;
            const Array* const array =
                together ? together
                         : model.variable.find((part ? "mlp/bias_" : "mlp/weight_") + number);
            const int64_t count = part ? layer.outputs : layer.outputs * layer.inputs;
            all.last = array->shape;
            if (together) {
                all.first[0] = start;
                all.last[0] = start += count;
            }
            if (!read_numbers(model.file, *array, all, numbers, error)) return false;
            const Json scales = yyjson_obj_get(array->attributes, "scales");
            const bool whole = together && array->type == FHASH_INT16;
            const float scale =
                whole ? float(yyjson_get_num(yyjson_arr_get(scales, 2 * i + size_t(part)))) : 1.0f;
            for (float& each : numbers)
                if (!std::isfinite(each *= scale))
                    return fail(error, FHASH_ERROR_DAMAGED,
                                "a layer of the network has numbers that are not finite");
        }
        layers.push_back(std::move(layer));
    }
    return true;
}

// Evaluates the network at points of the lattice.
struct Evaluation {
    const Model& model;
    const Lattice& lattice;
    const std::vector<Patch>& patches;
    const std::vector<Layer>& layers;
    size_t most;  // numbers of the widest layer, inputs included

    // The interpolated embeddings of a point as inputs, each TOGETHER numbers apart.
    void gather(const int64_t vertex[3], float* inputs) const {
        for (size_t level = 0; level < patches.size(); level++) {
            const Patch& patch = patches[level];
            const auto& shape = model.variable.levels[level];
            int64_t before[3];
            float weights[3];
            for (int a = 0; a < 3; a++)
                before[a] = corner(vertex[a], model.variable.length(a), shape[size_t(a) + 1],
                                   weights[a]) - patch.first[a];
            const int64_t size = model.size;
            for (int64_t e = 0; e < size; e++) inputs[(int64_t(level) * size + e) * TOGETHER] = 0;
            for (int side = 0; side < 8; side++) {
                float weight = 1;
                int64_t at = 0;
                for (int a = 0; a < 3; a++) {
                    const int upper = side >> (2 - a) & 1;
                    weight *= upper ? weights[a] : 1 - weights[a];
                    at = at * patch.count[a] + std::min(before[a] + upper, patch.count[a] - 1);
                }
                if (weight == 0) continue;
                for (int64_t e = 0; e < size; e++)
                    inputs[(int64_t(level) * size + e) * TOGETHER] +=
                        weight * patch.numbers[size_t(at * size + e)];
            }
        }
    }

    // One output for each of TOGETHER points; `rooms` are two times most * TOGETHER numbers.
    const float* run(float* rooms) const {
        float* in = rooms;
        float* out = rooms + most * TOGETHER;
        for (size_t l = 0; l < layers.size(); l++) {
            const Layer& layer = layers[l];
            for (int64_t o = 0; o < layer.outputs; o++) {
                float* const to = out + o * TOGETHER;
                const float* const weights = layer.weights.data() + o * layer.inputs;
                std::fill_n(to, TOGETHER, layer.biases[size_t(o)]);
                for (int64_t i = 0; i < layer.inputs; i++)
                    for (int64_t k = 0; k < TOGETHER; k++)
                        to[k] += weights[i] * in[i * TOGETHER + k];
                for (int64_t k = 0; l + 1 < layers.size() && k < TOGETHER; k++)
                    to[k] = to[k] > 0 ? to[k] : 0.0f;
            }
            std::swap(in, out);
        }
        return in;
    }

    // Values u of the requested points from `begin` to before `end`.
    void evaluate(const std::vector<int64_t>& points, size_t begin, size_t end,
                  double* values) const {
        std::vector<float> rooms(2 * most * TOGETHER, 0.0f);
        for (size_t first = begin; first < end; first += TOGETHER) {
            const size_t count = std::min(size_t(TOGETHER), end - first);
            for (size_t k = 0; k < count; k++) {
                int64_t rest = points[first + k], vertex[3];
                for (int a = 2; a >= 0; a--) {
                    vertex[a] = lattice.first[a] + (rest % lattice.count[a] << lattice.lod);
                    rest /= lattice.count[a];
                }
                gather(vertex, rooms.data() + k);
            }
            const float* const found = run(rooms.data());
            for (size_t k = 0; k < count; k++) values[points[first + k]] = double(found[k]);
        }
    }
};

// Values in the units of the source, clipped to the range.
void from_unit(const Variable& variable, const std::vector<int64_t>& points, double* values) {
    const double* const range = variable.range;
    const double peak = std::max(std::fabs(range[0]), std::fabs(range[1]));
    int exponent = 0;
    std::frexp(peak, &exponent);
    const double scale = peak > 0x1p-900 && peak < 0x1p1022
                             ? 1.0
                             : std::ldexp(1.0, -std::clamp(exponent, -1000, 1000));
    const double low = range[0] * scale, high = range[1] * scale;
    for (const int64_t point : points) {
        const double value = std::clamp(values[point] * (high - low) + low, low, high) / scale;
        values[point] = std::clamp(value, variable.within[0], variable.within[1]);
    }
}

}  // namespace

bool check_network(const Variable& variable, fhash_error& error) {
    const Record& model = variable.model;
    const std::string& kind = variable.tables;
    int64_t size, layers, width;
    const Json sparse = model.find("sparse");
    if (!read_sizes(variable, size, layers, width, error) ||
        !model.need(kind == "float32" || kind == "float16" || kind == "uint8" ||
                        kind == "transform",
                    "tables", "float32, float16, uint8 or transform", error) ||
        !model.need(!sparse || ((yyjson_equals_str(sparse, "coreset") ||
                                 yyjson_equals_str(sparse, "fringe")) && kind != "transform"),
                    "sparse", "coreset or fringe", error))
        return false;
    for (size_t level = 0; level < variable.levels.size(); level++)
        if (!check_table(variable, level, size, error)) return false;
    const auto shapes = layer_shapes(variable, size, layers, width);
    if (kind == "transform") {
        int64_t count = 0;
        for (const auto& shape : shapes) count += shape.first * (shape.second + 1);
        if (!check_array(variable, "mlp/parameters", {count}, {FHASH_FLOAT32, FHASH_INT16}, true,
                         error))
            return false;
        const Array& numbers = *variable.find("mlp/parameters");
        const Json scales = yyjson_obj_get(numbers.attributes, "scales");
        bool good = numbers.type != FHASH_INT16 || yyjson_arr_size(scales) == 2 * shapes.size();
        yyjson_arr_iter iter = yyjson_arr_iter_with(yyjson_is_arr(scales) ? scales : nullptr);
        while (Json each = yyjson_arr_iter_next(&iter))
            good = good && yyjson_is_num(each) && std::isfinite(float(yyjson_get_num(each)));
        if (!good)
            return fail(error, FHASH_ERROR_DAMAGED,
                        "array mlp/parameters attribute scales is no list of a number for each "
                        "weight and bias");
    } else {
        for (size_t i = 0; i < shapes.size(); i++) {
            const std::string number = std::to_string(i + 1);
            if (!check_array(variable, ("mlp/weight_" + number).c_str(),
                             {shapes[i].first, shapes[i].second}, {FHASH_FLOAT32}, true, error) ||
                !check_array(variable, ("mlp/bias_" + number).c_str(), {shapes[i].first},
                             {FHASH_FLOAT32}, true, error))
                return false;
        }
    }
    return true;
}

bool read_network(fhash_file& file, const Variable& variable, double key, const Lattice& lattice,
                  const Buffer& requested, double* values, fhash_error& error) {
    std::vector<int64_t> points;
    if (!may_use(*file.context, 8 * uint64_t(requested.size()), error)) return false;
    for (size_t i = 0; i < requested.size(); i++)
        if (requested[i]) points.push_back(int64_t(i));
    if (points.empty()) return true;
    Model model(file, variable);
    std::vector<Layer> layers;
    std::vector<Patch> patches(variable.levels.size());
    if (!read_sizes(variable, model.size, model.layers, model.width, error) ||
        !read_layers(model, layers, error))
        return false;
    for (size_t level = 0; level < patches.size(); level++)
        if (!read_patch(model, level, key, lattice, patches[level], error)) return false;
    size_t most = 1;
    for (const Layer& layer : layers)
        most = std::max({most, size_t(layer.inputs), size_t(layer.outputs)});
    const Evaluation evaluation = {model, lattice, patches, layers, most};
    const size_t threads = std::min<size_t>(size_t(file.context->threads),
                                            points.size() / (16 * TOGETHER) + 1);
    together(int(threads), [&](int part) {
        evaluation.evaluate(points, points.size() * size_t(part) / threads,
                            points.size() * size_t(part + 1) / threads, values);
    });
    from_unit(variable, points, values);
    return true;
}

}  // namespace fhash
