// The light that passes the volume, with hostile values. The numbers of a table are finite, and the
// steps are those of fhash_codec/rendering/light.py.
#include <algorithm>
#include <cmath>

#include "exports.hpp"
#include "reader.hpp"
#include "setups.hpp"

using std::int64_t;

void light(Reader& in) {
    int64_t shape[3], points[3];
    const int64_t cell = in.within(1, 64);
    for (int axis = 0; axis < 3; axis++) {
        shape[axis] = in.within(1, axis == 2 ? 40 : 9);
        points[axis] = (shape[axis] - 1 + cell - 1) / cell + 1;
    }
    const std::vector<float> values = repeated<float>(in, shape[0] * shape[1] * shape[2]);
    const int64_t entries = in.within(2, 40);
    std::vector<float> table = repeated<float>(in, entries + 1);
    for (float& entry : table)
        entry = std::isfinite(entry) ? std::min(std::fabs(entry), 1e30F) : 0.0F;
    const double low = in.finite<double>(), scale = std::fabs(in.finite<double>());
    // Factors by which extinctions count: a share from 0 to 1 for each vertex, or none.
    std::vector<float> factors;
    if (in.within(0, 1)) factors = repeated<float>(in, shape[0] * shape[1] * shape[2]);
    for (float& factor : factors)
        factor = std::isfinite(factor) ? std::min(std::fabs(factor), 1.0F) : 0.0F;
    std::vector<float> extinction(static_cast<std::size_t>(points[0] * points[1] * points[2])),
        scratch(static_cast<std::size_t>(shape[2]));
    fhash_march_extinction(values.data(), shape, table.data(), entries, low, scale, cell, points, 0,
                           points[0], factors.empty() ? nullptr : factors.data(),
                           extinction.data(), scratch.data());
    double step[3];
    for (double& length : step) length = std::remainder(in.finite<double>(), 16.0);
    std::vector<float> sum(extinction.size());
    fhash_march_sum(extinction.data(), points, step, in.within(1, 60), 0, points[0], sum.data());
    for (std::size_t i = 0; i < sum.size(); i++) {
        if (extinction[i] >= 0 && sum[i] >= 0) continue;
        std::fprintf(stderr, "extinctions of %g and a sum of %g\n",
                     static_cast<double>(extinction[i]), static_cast<double>(sum[i]));
        std::abort();
    }
}
