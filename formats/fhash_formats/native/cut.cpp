// Where the encoder cuts a tile into blocks (blocks.hpp).
#include <cmath>

#include "encode.hpp"
#include "region.hpp"

namespace fhash {
namespace {

// Least bytes of a block as they are estimated. Blocks do not know of each other, and learn alone:
// those of half the bytes took 2 to 4 % more for tiles of any kind, those of these less than 2 %.
constexpr double LEAST_BYTES = 1 << 14;
// Share of a tile that a small region needs, from which on blocks are not worth their bytes.
constexpr double MOST_SHARE = 0.5;
constexpr double REGION = 16;      // vertices of a small region along z, y and x, at one step
constexpr int SHORTEST = 2, LONGEST = 12;  // logarithms of lengths
// Bytes of an integer other than 0, with the zeros around it.
constexpr double BYTES = 0.5, FAST_BYTES = 1.0;
// Steps from which on a coefficient becomes an integer other than 0, by the trellis and without.
constexpr double TRELLIS_LEAST = 1.1, LEAST = 0.7;

struct Length {
    int log;
    double count, share;  // blocks along an axis, and what a small region needs of it
};

// Lengths of blocks along an axis; the first is all of it.
std::vector<Length> lengths_of(const AxisTransform& axis, int64_t n, double wanted) {
    constexpr double MARGIN[] = {0, 0, 2, 4};  // on each side, by kind of wavelet
    std::vector<Length> lengths = {{0, 1, 1}};
    if (axis.kind == KLT_KIND) return lengths;
    wanted += 2 * MARGIN[axis.kind];
    for (int log = std::max(axis.depth, SHORTEST); log <= LONGEST; log++) {
        const int64_t length = int64_t(1) << log, count = (n + length / 2) / length;
        if (count < 2) break;
        const double share = (wanted + (double)length - 1) / (double)n;
        lengths.push_back({log, (double)count, std::min(share, 1.0)});
    }
    return lengths;
}

}  // namespace

template <class T>
Cut choose_cut(const Settings& settings, const Shape& shape, bool fast,
               const std::vector<T>& coefficients) {
    const T least = (T)((settings.trellis ? TRELLIS_LEAST : LEAST) * settings.step);
    int64_t many = 0;
    for (const T c : coefficients) many += std::fabs(c) >= least;
    const double most = std::min((double)many * (fast ? FAST_BYTES : BYTES) / LEAST_BYTES,
                                 (double)MAX_BLOCKS);
    Cut best = {};
    if (most < 2) return best;
    std::vector<Length> lengths[4];
    for (size_t a = 0; a < 4; a++) {
        const double wanted = (a ? REGION : 1) + (settings.head ? 2.0 * HEAD_REACH : 0.0);
        lengths[a] = lengths_of(settings.axes[a], shape[a], wanted);
    }
    if (fast) lengths[3].resize(1);  // short rows leave its lanes idle
    double lowest = MOST_SHARE;
    for (const Length& t : lengths[0])
        for (const Length& z : lengths[1])
            for (const Length& y : lengths[2])
                for (const Length& x : lengths[3]) {
                    const double share = t.share * z.share * y.share * x.share;
                    if (t.count * z.count * y.count * x.count > most || share >= lowest) continue;
                    lowest = share;
                    best = {(uint8_t)t.log, (uint8_t)z.log, (uint8_t)y.log, (uint8_t)x.log};
                }
    return best;
}
template Cut choose_cut(const Settings&, const Shape&, bool, const std::vector<float>&);
template Cut choose_cut(const Settings&, const Shape&, bool, const std::vector<double>&);

}  // namespace fhash
