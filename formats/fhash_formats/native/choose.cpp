// Choice of the integers of coefficients, and of values where a tile has none.
#include <algorithm>
#include <cmath>

#include "encode.hpp"
#include "kernels.hpp"
#include "priors.hpp"

namespace fhash {
namespace {

constexpr int BUCKETS = 64, RATES = 24;  // classes of indices, and indices with a rate of their own
constexpr double COST = 32768;           // costs of a squared step
constexpr double MAX_RATE_COST = 1 << 19;
constexpr double SIGN_BITS = 0.85;       // of a sign, which contexts predict a little
constexpr double NEIGHBOUR_SHARE = 0.3;  // of the counts of the next buckets in those of a bucket
constexpr double PRIOR_COUNT = 8;        // observations that a geometric distribution stands for
constexpr double DEAD_ZONE = 0.8;        // steps below which coefficients become 0
constexpr double SPREAD = 0.1;           // mean squared error of the others, in squared steps
constexpr int MOST_WEIGHTS = 4;          // by which a squared error is aimed at
constexpr double CLOSE = 0.002;          // change of the logarithm of the error not worth another
constexpr double WEIGHT_RANGE = 1.4;     // of the logarithm of the weight, both ways
constexpr double WEIGHT_SLOPE = 0.15;    // of that of the error by that of the weight, at first
constexpr int64_t MAX_CHOSEN = 1 << 22;  // from which on an integer is the nearest one

// A sum in the order in which numpy adds 24 numbers.
double sum_of(const double* numbers) {
    double lanes[8];
    std::copy_n(numbers, 8, lanes);
    for (int i = 8; i < RATES; i += 8)
        for (int lane = 0; lane < 8; lane++) lanes[lane] += numbers[i + lane];
    return ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) +
           ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
}

// The costs of the bits of indices (2, BUCKETS, RATES) from how often they come.
std::vector<int32_t> rates_of(const std::vector<int64_t>& counts, double weight) {
    std::vector<int32_t> rates;
    rates.reserve(counts.size());
    for (int row = 0; row < 2 * BUCKETS; row++) {
        const int bucket = row % BUCKETS;
        const int64_t* const own = &counts[(size_t)(row * RATES)];
        double smooth[RATES], moments[RATES];
        for (int i = 0; i < RATES; i++) {
            smooth[i] = (double)own[i];
            if (bucket > 0) smooth[i] += NEIGHBOUR_SHARE * (double)own[i - RATES];
            if (bucket + 1 < BUCKETS) smooth[i] += NEIGHBOUR_SHARE * (double)own[i + RATES];
            moments[i] = smooth[i] * i;
        }
        const double total = sum_of(smooth), mean = (sum_of(moments) + 0.02) / (total + 1);
        const double share = mean / (1 + mean);
        for (int i = 0; i < RATES; i++) {
            const double chance =
                (smooth[i] + PRIOR_COUNT * (1 - share) * std::pow(share, i)) /
                (total + PRIOR_COUNT);
            const double bits = -std::log2(std::max(chance, 1e-9)) + (i ? SIGN_BITS : 0.0);
            rates.push_back(
                (int32_t)std::min(std::nearbyint(bits * weight * COST), MAX_RATE_COST));
        }
    }
    return rates;
}

// Looks for the weight of a bit at which the error is the one that is aimed at, near the usual one.
//
// run: chooses integers by a weight, and returns their squared error; below 0 where it fails.
// first: what the usual weight gives.
template <class Run> bool aim_at(double wanted, double weight, double first, const Run& run) {
    double at = 0, slope = WEIGHT_SLOPE, squares = first;  // the logarithm of the weight's change
    for (int i = 0; i < MOST_WEIGHTS && squares > 0; i++) {
        const double off = std::log(wanted / squares);
        const double next = std::min(std::max(at + off / slope, -WEIGHT_RANGE), WEIGHT_RANGE);
        if (std::fabs(off) < CLOSE || next == at) return true;
        const double before = squares;
        squares = run(weight * std::exp(next));
        if (squares < 0) return false;
        if (squares > 0) slope = std::log(squares / before) / (next - at);
        slope = std::min(std::max(slope, 0.05), 2.0);
        at = next;
    }
    return true;
}

// What is coded alone: a block of a tile, or all of it.
template <class T> struct Piece {
    Shape shape;
    Table table;
    std::vector<T> scaled;  // coefficients / step
    std::vector<uint8_t> buckets;
    std::vector<int64_t> counts;
    std::vector<int32_t> levels;

    int64_t bands() const { return (int64_t)table.size() / TABLE_COLUMNS; }
    void make_buckets() {
        int64_t coded = 0;
        for (int64_t band = 0; band < bands(); band++) {
            int64_t product = 1;
            const int32_t* const row = &table[(size_t)(band * TABLE_COLUMNS)];
            for (int a = 0; a < 4; a++) product *= row[4 + a] - row[a];
            coded += product;
        }
        buckets.resize((size_t)coded);
    }
    // Counts indices: guessed ones, or those that were chosen.
    bool count(bool guessed, fhash_error& error) {
        counts.assign(2 * BUCKETS * RATES, 0);
        const int64_t code =
            guessed ? guess_path(scaled.data(), shape.data(), table.data(), bands(),
                                 buckets.data(), counts.data())
                    : fhash_trellis_count(levels.data(), shape.data(), table.data(), bands(),
                                          buckets.data(), counts.data());
        return kernel_done(code, "the trellis", error);
    }
    bool choose(const std::vector<int32_t>& rates, fhash_error& error) {
        levels.assign(scaled.size(), 0);
        return kernel_done(choose_path(scaled.data(), shape.data(), table.data(), bands(),
                                       buckets.data(), rates.data(), levels.data()),
                           "the trellis", error);
    }
};

// The levels of each piece, those of the cheapest path through the trellis, searched `passes`
// times.
//
// aim: null for the usual weight. measure: calls its function with the levels of all.
template <class T>
bool choose_levels(std::vector<Piece<T>>& pieces, int threads, double weight, int passes,
                   const Aim* aim, const std::function<double()>& measure, fhash_error& error) {
    std::vector<int64_t> counts;
    const auto each = [&](const auto& work) {
        return each_of(threads, pieces.size(), error,
                       [&](size_t i, fhash_error& failed) { return work(pieces[i], failed); });
    };
    const auto choose = [&](double of) {
        const std::vector<int32_t> rates = rates_of(counts, of);
        return each([&](Piece<T>& piece, fhash_error& failed) {
            return piece.choose(rates, failed);
        });
    };
    for (Piece<T>& piece : pieces) piece.make_buckets();
    for (int pass = 0; pass < std::max(passes, 1); pass++) {
        if (!each([&](Piece<T>& piece, fhash_error& failed) {
                return piece.count(pass == 0, failed);
            }))
            return false;
        counts.assign(2 * BUCKETS * RATES, 0);
        for (const Piece<T>& piece : pieces)
            for (size_t i = 0; i < counts.size(); i++) counts[i] += piece.counts[i];
        if (!choose(weight)) return false;
    }
    if (!aim) return true;
    return aim_at(aim->squares, weight, measure(),
                  [&](double of) { return choose(of) ? measure() : -1.0; });
}

// Makes coefficients multiples of the step; false where one is too large for the trellis.
template <class T> bool scale_all(const Search<T>& search, std::vector<T>& coefficients) {
    const T unit = (T)(1.0 / search.settings.step);
    bool small = true;
    for (T& coefficient : coefficients) {
        coefficient *= unit;
        small &= std::fabs(coefficient) < (T)LARGEST;  // false for NaN as well
    }
    return small;
}

int64_t largest_of(const std::vector<int32_t>& integers) {
    int64_t largest = 0;
    for (const int32_t q : integers) largest = std::max(largest, std::abs((int64_t)q));
    return largest;
}

template <class T>
void quantise_all(const std::vector<T>& coefficients, double step, std::vector<int32_t>& integers,
                  std::vector<float>& scaled) {
    integers.resize(coefficients.size());
    scaled.resize(coefficients.size());
    quantise(coefficients.data(), (int64_t)coefficients.size(), 1.0 / step, ROUNDING, LARGEST,
             integers.data(), scaled.data());
}

}  // namespace

template <class T> double predicted_error(const std::vector<T>& coefficients, double step) {
    const double limit = DEAD_ZONE * step;
    int exponent;
    const double mantissa = std::frexp(limit, &exponent);  // from 1/2 up
    const double bin = std::ldexp(1, exponent - 3);
    const double low = std::floor(mantissa * 8) * bin, high = low + bin;
    const double share = (limit - low) / bin, other = SPREAD * step * step;
    double sums[2] = {0, 0};  // of the squares below the bin, and in it
    int64_t counts[2] = {0, 0};
    for (const T c : coefficients) {
        const double magnitude = std::fabs((double)c), square = magnitude * magnitude;
        sums[0] += magnitude < low ? square : 0;
        counts[0] += magnitude < low;
        sums[1] += magnitude < high ? square : 0;
        counts[1] += magnitude < high;
    }
    const double within = sums[1] - sums[0], there = (double)(counts[1] - counts[0]);
    const double above = (double)((int64_t)coefficients.size() - counts[1]);
    return sums[0] + share * within + (above + (1 - share) * there) * other;
}

bool encode_integers(std::vector<int32_t>& integers, const Shape& shape, const Table& table,
                     const IntegerCoding& how, Buffer& out, fhash_error& error) {
    const int64_t bands = (int64_t)table.size() / TABLE_COLUMNS;
    // Each time the original integers: coding the chosen ones would give other bytes, because rows
    // that became empty are signalled differently. The coder writes to them only where it chooses.
    std::vector<int32_t> given;
    if (how.scaled && !how.fast) given = integers;
    const auto encode = [&](uint8_t* data, int64_t capacity) -> int64_t {
        if (how.fast) {
            double results[2];
            const FastPrior& prior = fast_prior();
            if (how.scaled) std::fill(integers.begin(), integers.end(), 0);
            return fhash_fast_encode(integers.data(), how.scaled, how.trellis, 1.0, how.weight,
                                     shape.data(), table.data(), bands, prior.slots.data(),
                                     prior.defaults.data(), data, capacity, results);
        }
        const State& prior = integer_prior(how.trellis);
        if (how.scaled) integers = given;
        // The state is not kept, so that nothing is written to the prior.
        return fhash_encode(integers.data(), how.scaled, how.weight, how.trellis, shape.data(),
                            table.data(), bands, const_cast<uint16_t*>(prior.slots.data()),
                            prior.slot_count(), const_cast<int32_t*>(prior.weights.data()),
                            (int64_t)prior.weights.size(),
                            const_cast<uint16_t*>(prior.simples.data()), prior.simple_count(), 0,
                            data, capacity);
    };
    return with_room((int64_t)integers.size() / 2, out, error, encode);
}

template <class T>
bool make_search(fhash_context& context, const Settings& settings, const Shape& shape,
                 std::shared_ptr<Search<T>>& search, fhash_error& error) {
    search.reset(new Search<T>{context, settings, shape, nullptr, nullptr});
    search->forward = forward_plan<T>(context, settings, shape, error);
    if (search->forward) search->inverse = plan_for<T>(context, settings, shape, 0, error);
    return search->inverse != nullptr;
}

template <class T>
bool choose_integers(const Search<T>& search, std::vector<T>& coefficients,
                     const fhash_coding& coding, int passes, const Aim* aim,
                     std::vector<int32_t>& integers, fhash_error& error) {
    const double weight = coding.weight;
    if (search.settings.trellis) {
        if (!scale_all(search, coefficients)) return false;
        std::vector<Piece<T>> whole(1);
        whole[0].shape = search.shape;
        whole[0].table = search.table();
        whole[0].scaled.swap(coefficients);
        const auto measure = [&] { return aim->measure(whole[0].levels); };
        const bool done = choose_levels(whole, 1, weight, passes, aim, measure, error);
        coefficients.swap(whole[0].scaled);
        integers = std::move(whole[0].levels);
        return done;
    }
    std::vector<float> scaled;
    quantise_all(coefficients, search.settings.step, integers, scaled);
    if (weight <= 0) return true;
    Buffer unused;
    return encode_integers(integers, search.shape, search.table(),
                           {false, coding.fast != 0, scaled.data(), weight}, unused, error);
}

template <class T>
bool code_coefficients(const Search<T>& search, std::vector<T>& coefficients,
                       const fhash_coding& coding, const Aim* aim, Buffer& data,
                       std::vector<int32_t>& integers, fhash_error& error) {
    const Settings& settings = search.settings;
    const bool fast = coding.fast;
    const auto encode = [&](const IntegerCoding& how) {
        return encode_integers(integers, search.shape, search.table(), how, data, error);
    };
    if (settings.trellis && fast) {
        if (!scale_all(search, coefficients)) return false;
        integers.assign(coefficients.size(), 0);
        if constexpr (std::is_same<T, float>::value)
            return encode({true, true, coefficients.data(), coding.weight});
        const std::vector<float> narrow(coefficients.begin(), coefficients.end());
        return encode({true, true, narrow.data(), coding.weight});
    }
    if (settings.trellis)
        return choose_integers(search, coefficients, coding, coding.passes, aim, integers, error) &&
               encode({true, false, nullptr, 0});
    std::vector<float> scaled;
    quantise_all(coefficients, settings.step, integers, scaled);
    const int64_t largest = largest_of(integers);
    if ((double)largest >= LARGEST) return false;
    const bool chooses = coding.weight > 0;
    const bool mended = largest >= MAX_CHOSEN && chooses && settings.real64;
    std::vector<int32_t> nearest;
    if (mended) nearest = integers;
    if (!encode({false, fast, chooses ? scaled.data() : nullptr, coding.weight})) return false;
    for (size_t i = 0; mended && i < integers.size(); i++)
        if (std::abs((int64_t)nearest[i]) >= MAX_CHOSEN)
            integers[i] = (int32_t)std::nearbyint(coefficients[i] / (T)settings.step);
    if (!mended && !(coding.passes > 1 && chooses && !fast)) return true;
    return encode({false, fast, nullptr, 0});
}

namespace {

// The bytes of blocks, after the lengths of all but the last one.
void join_blocks(const std::vector<Buffer>& blocks, Buffer& data) {
    for (size_t i = 0; i + 1 < blocks.size(); i++) put_leb(data, blocks[i].size());
    for (const Buffer& block : blocks) data.insert(data.end(), block.begin(), block.end());
}

// A search on a block.
template <class T> Search<T> search_on(const Search<T>& search, const Shape& shape) {
    const auto plan = std::make_shared<Plan<T>>();
    plan->table = block_table(search.settings.axes, shape);
    return {search.context, search.settings, shape, nullptr, plan};
}

}  // namespace

template <class T>
bool code_blocks(const Search<T>& search, const Cut& cut, std::vector<T>& coefficients,
                 const fhash_coding& coding, const Aim* aim, Buffer& data,
                 std::vector<int32_t>& integers, fhash_error& error) {
    const Settings& settings = search.settings;
    const std::vector<Box> boxes = blocks_of(search.shape, cut);
    const bool levels = settings.trellis && !coding.fast;
    if (levels && !scale_all(search, coefficients)) return false;
    std::vector<BlockPlaces> places;
    std::vector<Piece<T>> pieces(boxes.size());
    for (size_t i = 0; i < boxes.size(); i++) {
        places.emplace_back(settings.axes, search.shape, boxes[i]);
        pieces[i].shape = boxes[i].shape();
        pieces[i].table = block_table(settings.axes, pieces[i].shape);
        pieces[i].scaled.resize((size_t)vertices(pieces[i].shape));
        places[i].gather(coefficients.data(), pieces[i].scaled.data());
    }
    integers.assign(coefficients.size(), 0);
    const auto scatter = [&] {
        for (size_t i = 0; i < boxes.size(); i++)
            places[i].scatter(pieces[i].levels.data(), integers.data());
    };
    const auto measure = [&] {
        scatter();
        return aim->measure(integers);
    };
    const int threads = search.context.threads;
    if (levels && !choose_levels(pieces, threads, coding.weight, coding.passes, aim, measure,
                                 error))
        return false;
    std::vector<Buffer> coded(boxes.size());
    const bool done = each_of(threads, boxes.size(), error, [&](size_t i, fhash_error& failed) {
        Piece<T>& piece = pieces[i];
        if (levels)
            return encode_integers(piece.levels, piece.shape, piece.table,
                                   {true, false, nullptr, 0}, coded[i], failed);
        return code_coefficients(search_on(search, piece.shape), piece.scaled, coding, nullptr,
                                 coded[i], piece.levels, failed);
    });
    if (!done) return false;
    scatter();
    data.assign({(uint8_t)(cut[0] | cut[1] << 4), (uint8_t)(cut[2] | cut[3] << 4)});
    join_blocks(coded, data);
    return true;
}

bool encode_in_blocks(const std::vector<int32_t>& integers, const Shape& shape, const Cut& cut,
                      bool fast, int threads, Buffer& data, fhash_error& error) {
    const std::vector<Box> boxes = blocks_of(shape, cut);
    std::vector<Buffer> coded(boxes.size());
    const bool done = each_of(threads, boxes.size(), error, [&](size_t i, fhash_error& failed) {
        const Shape own = boxes[i].shape();
        std::vector<int32_t> some((size_t)vertices(own));
        BlockPlaces(nullptr, shape, boxes[i]).gather(integers.data(), some.data());
        return encode_integers(some, own, single_band(own), {false, fast, nullptr, 0}, coded[i],
                               failed);
    });
    data.clear();
    if (done) join_blocks(coded, data);
    return done;
}

namespace {

constexpr double HIGHEST = 64, LOWEST = 0.4;  // first and last threshold, in quantiser steps
constexpr double NEARBY = 16;  // first one where the present values are a good filling already
constexpr double MOMENTUM = 0.7;  // share of the last change that is added to the next guess
constexpr int64_t FEW_BITS = 64;  // tiles of fewer are not searched with more thresholds

// Ratio of a threshold to the one before it: eight thresholds per factor of two, or one.
double ratio_of(int density) { return density > 1 ? 0.9170040432046712 : 0.5; }

// Quantised coefficients of values.
template <class T>
bool integers_of(const Search<T>& search, const std::vector<T>& values,
                 std::vector<int32_t>& integers, fhash_error& error) {
    std::vector<T> coefficients(values.size());
    std::vector<float> scaled;
    if (!kernel_done(search.forward->transform(values.data(), coefficients.data()), "a transform",
                     error))
        return false;
    quantise_all(coefficients, search.settings.step, integers, scaled);
    return true;
}

// The values where the search by falling thresholds ends.
template <class T>
bool search_filling(const Search<T>& search, const std::vector<T>& start, const uint8_t* counted,
                    int density, double threshold, std::vector<T>& current, fhash_error& error) {
    std::vector<T> guess = start, coefficients(start.size()), values(start.size());
    current = start;
    while (threshold > LOWEST) {
        const T least = (T)(threshold * search.settings.step);
        if (!kernel_done(search.forward->transform(guess.data(), coefficients.data()),
                         "a transform", error))
            return false;
        for (T& c : coefficients)
            if (std::fabs(c) < least) c = 0;
        if (!kernel_done(search.inverse->invert(coefficients.data(), values.data()), "a transform",
                         error))
            return false;
        for (size_t i = 0; i < start.size(); i++) {
            const T before = current[i];
            current[i] = counted[i] ? start[i] : values[i];
            guess[i] = current[i] + (T)MOMENTUM * (current[i] - before);
        }
        threshold *= ratio_of(density);
    }
    return true;
}

// Bits of the magnitudes of all quantised coefficients.
template <class T>
bool bits_of(const Search<T>& search, const std::vector<T>& values, int64_t& bits,
             fhash_error& error) {
    std::vector<int32_t> integers;
    if (!integers_of(search, values, integers, error)) return false;
    bits = 0;
    for (const int32_t q : integers) {
        int exponent = 0;
        if (q) std::frexp((float)q, &exponent);
        bits += exponent;
    }
    return true;
}

// Bytes of the coded coefficients.
template <class T>
bool size_of(const Search<T>& search, const std::vector<T>& values, size_t& size,
             fhash_error& error) {
    std::vector<int32_t> integers;
    Buffer data;
    if (!integers_of(search, values, integers, error) ||
        !encode_integers(integers, search.shape, search.table(), {}, data, error))
        return false;
    size = data.size();
    return true;
}

}  // namespace

template <class T>
bool fill_uncounted(const Search<T>& search, const uint8_t* counted, const uint8_t* finite,
                    int density, std::vector<T>& target, fhash_error& error) {
    const size_t n = target.size();
    double sum = 0;
    int64_t count = 0;
    for (size_t i = 0; i < n; i++)
        if (counted[i]) {
            sum += (double)target[i];
            count++;
        }
    const T mean = (T)(sum / (double)count);
    std::vector<T> starts[2] = {target, target}, results[2];
    for (size_t i = 0; i < n; i++) {
        if (!finite[i]) starts[0][i] = mean;
        if (!counted[i]) starts[1][i] = mean;
    }
    if (density == 0)
        return search_filling(search, starts[0], counted, 1, NEARBY, target, error);
    int64_t bits[2];
    for (int i = 0; i < 2; i++)
        if (!search_filling(search, starts[i], counted, 1, HIGHEST, results[i], error) ||
            !bits_of(search, results[i], bits[i], error))
            return false;
    const int better = bits[1] < bits[0];
    target = results[better];
    if (density > 1 && bits[better] >= FEW_BITS &&
        !search_filling(search, starts[better], counted, density, HIGHEST, target, error))
        return false;
    // Bits are a rough measure: smooth values of many bits may be coded in few bytes.
    size_t sizes[2];
    if (!size_of(search, starts[0], sizes[0], error) || !size_of(search, target, sizes[1], error))
        return false;
    if (sizes[0] <= sizes[1]) target = starts[0];
    return true;
}

#define FHASH_CHOOSE(T) \
    template bool make_search(fhash_context&, const Settings&, const Shape&, \
                              std::shared_ptr<Search<T>>&, fhash_error&); \
    template bool choose_integers(const Search<T>&, std::vector<T>&, const fhash_coding&, int, \
                                  const Aim*, std::vector<int32_t>&, fhash_error&); \
    template bool code_coefficients(const Search<T>&, std::vector<T>&, const fhash_coding&, \
                                    const Aim*, Buffer&, std::vector<int32_t>&, fhash_error&); \
    template bool code_blocks(const Search<T>&, const Cut&, std::vector<T>&, const fhash_coding&, \
                              const Aim*, Buffer&, std::vector<int32_t>&, fhash_error&); \
    template double predicted_error(const std::vector<T>&, double); \
    template bool fill_uncounted(const Search<T>&, const uint8_t*, const uint8_t*, int, \
                                 std::vector<T>&, fhash_error&);
FHASH_CHOOSE(float)
FHASH_CHOOSE(double)

}  // namespace fhash
