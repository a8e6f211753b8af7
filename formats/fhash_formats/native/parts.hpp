// Parts of a tile on which settings are tried.
#pragma once

#include <algorithm>

#include "coding.hpp"

namespace fhash {
namespace {

constexpr double LEAST_COST = 0.05;   // share of the mean cost that each part has at least

// A block of a tile, and for how many blocks it stands.
struct Part {
    Shape first;
    double cost, weight;
};
struct Parts {
    Shape shape;
    std::vector<Part> all;
};

// A shape of at most `most` values, if the longest of some axes may be halved down to `least`.
// axes: these, a bit each.
Shape shortened(Shape shape, int64_t most, int axes, int64_t least) {
    while (vertices(shape) > most) {
        int64_t* longest = nullptr;
        for (size_t a = 0; a < 4; a++)
            if (axes >> a & 1 && (!longest || shape[a] > *longest)) longest = &shape[a];
        if (!longest || *longest <= least) break;
        *longest = (*longest + 1) / 2;
    }
    return shape;
}

template <class Work>
void each_row(const Shape& of, const Shape& first, const Shape& shape, Work work) {
    for (int64_t t = first[0]; t < first[0] + shape[0]; t++)
        for (int64_t z = first[1]; z < first[1] + shape[1]; z++)
            for (int64_t y = first[2]; y < first[2] + shape[2]; y++)
                work(((t * of[1] + z) * of[2] + y) * of[3] + first[3]);
}

// Some of the parts of a tile: those of about the same cost are a group, of which the one in the
// middle stands for all. All groups cost the same, so that a costly part stands for few.
std::vector<Part> strata(std::vector<Part> all, size_t most) {
    std::sort(all.begin(), all.end(),
              [](const Part& a, const Part& b) { return a.cost < b.cost; });
    double total = 0, so_far = 0;
    for (const Part& part : all) total += part.cost;
    const double least = total > 0 ? LEAST_COST * total / (double)all.size() : 1.0;
    total += least * (double)all.size();
    std::vector<Part> chosen;
    size_t group = 0;
    for (size_t first = 0, i = 0; i < all.size(); i++) {
        so_far += all[i].cost + least;
        const bool last = i + 1 == all.size();
        const double next = last ? 0 : so_far + all[i + 1].cost + least;
        const auto number = (size_t)(next / total * (double)most * (1 - 1e-12));
        if (!last && number == group) continue;
        chosen.push_back(all[(first + i + 1) / 2]);
        chosen.back().weight = (double)(i + 1 - first);
        group = number;
        first = i + 1;
    }
    return chosen;
}

}  // namespace
}  // namespace fhash
