// The data's own bases along an axis: products of lines, their eigenvectors, and the basis that is
// as precise as a quantiser step needs (FORMAT.md, Bases).
#include "loops.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "basis.hpp"
#include "encode.hpp"

namespace fhash {
namespace {

constexpr double MIN_NEW = 0.3;   // share of a vector that the vectors before it do not hold
constexpr int MAX_ITERATIONS = 64;  // of an eigenvalue; a few are usual

using Matrix = std::vector<double>;  // (n, n)

// Reduces a symmetric matrix to a tridiagonal one by Householder reflections (EISPACK's tred2):
// `matrix` gets the orthogonal transformation, `diagonal` and `beside` the result.
void reduce(Matrix& matrix, int64_t n, std::vector<double>& diagonal, std::vector<double>& beside) {
    const auto at = [&](int64_t r, int64_t c) -> double& { return matrix[(size_t)(r * n + c)]; };
    for (int64_t i = n - 1; i > 0; i--) {
        double scale = 0, h = 0;
        for (int64_t k = 0; k < i; k++) scale += std::fabs(at(i, k));
        if (i == 1 || scale == 0) {
            beside[(size_t)i] = at(i, i - 1);
            diagonal[(size_t)i] = 0;
            continue;
        }
        for (int64_t k = 0; k < i; k++) {
            at(i, k) /= scale;
            h += at(i, k) * at(i, k);
        }
        const double f = at(i, i - 1), g = f >= 0 ? -std::sqrt(h) : std::sqrt(h);
        beside[(size_t)i] = scale * g;
        h -= f * g;
        at(i, i - 1) = f - g;
        std::vector<double> p((size_t)i, 0.0);
        for (int64_t j = 0; j < i; j++) {
            at(j, i) = at(i, j) / h;
            const double u = at(i, j);
            double sum = at(j, j) * u;
            for (int64_t k = 0; k < j; k++) {  // the lower triangle, by rows
                sum += at(j, k) * at(i, k);
                p[(size_t)k] += at(j, k) * u;
            }
            p[(size_t)j] += sum;
        }
        double total = 0;
        for (int64_t j = 0; j < i; j++) {
            p[(size_t)j] /= h;
            total += p[(size_t)j] * at(i, j);
        }
        const double half = total / (h + h);
        for (int64_t j = 0; j < i; j++) p[(size_t)j] -= half * at(i, j);
        for (int64_t j = 0; j < i; j++) {
            const double u = at(i, j), q = p[(size_t)j];
            for (int64_t k = 0; k <= j; k++) at(j, k) -= u * p[(size_t)k] + q * at(i, k);
        }
        diagonal[(size_t)i] = h;
    }
    diagonal[0] = beside[0] = 0;
    for (int64_t i = 0; i < n; i++) {
        if (diagonal[(size_t)i] != 0) {
            std::vector<double> sums((size_t)i, 0.0);
            for (int64_t k = 0; k < i; k++)
                for (int64_t j = 0; j < i; j++) sums[(size_t)j] += at(i, k) * at(k, j);
            for (int64_t k = 0; k < i; k++)
                for (int64_t j = 0; j < i; j++) at(k, j) -= sums[(size_t)j] * at(k, i);
        }
        diagonal[(size_t)i] = at(i, i);
        at(i, i) = 1;
        for (int64_t j = 0; j < i; j++) at(j, i) = at(i, j) = 0;
    }
}

// Eigenvalues and eigenvectors of a tridiagonal matrix by implicit shifts (EISPACK's tql2).
// vectors: rows; the transformation that led to the matrix, transposed, and then the vectors.
void diagonalise(Matrix& vectors, int64_t n, std::vector<double>& diagonal,
                 std::vector<double>& beside) {
    for (int64_t i = 1; i < n; i++) beside[(size_t)i - 1] = beside[(size_t)i];
    beside[(size_t)n - 1] = 0;
    for (int64_t l = 0; l < n; l++)
        for (int iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
            int64_t m = l;
            for (; m < n - 1; m++) {
                const double sum = std::fabs(diagonal[(size_t)m]) +
                                   std::fabs(diagonal[(size_t)m + 1]);
                if (std::fabs(beside[(size_t)m]) <= 1e-16 * sum) break;
            }
            if (m == l) break;
            double g = (diagonal[(size_t)l + 1] - diagonal[(size_t)l]) / (2 * beside[(size_t)l]);
            double r = std::hypot(g, 1.0);
            g = diagonal[(size_t)m] - diagonal[(size_t)l] +
                beside[(size_t)l] / (g + (g >= 0 ? r : -r));
            double sine = 1, cosine = 1, p = 0;
            int64_t i = m - 1;
            for (; i >= l; i--) {
                const double f = sine * beside[(size_t)i], b = cosine * beside[(size_t)i];
                r = std::hypot(f, g);
                beside[(size_t)i + 1] = r;
                if (r == 0) {
                    diagonal[(size_t)i + 1] -= p;
                    beside[(size_t)m] = 0;
                    break;
                }
                sine = f / r;
                cosine = g / r;
                g = diagonal[(size_t)i + 1] - p;
                r = (diagonal[(size_t)i] - g) * sine + 2 * cosine * b;
                p = sine * r;
                diagonal[(size_t)i + 1] = g + p;
                g = cosine * r - b;
                double* const low = vectors.data() + i * n;
                double* const high = low + n;
                for (int64_t k = 0; k < n; k++) {
                    const double h = high[k];
                    high[k] = sine * low[k] + cosine * h;
                    low[k] = cosine * low[k] - sine * h;
                }
            }
            if (r == 0 && i >= l) continue;
            diagonal[(size_t)l] -= p;
            beside[(size_t)l] = g;
            beside[(size_t)m] = 0;
        }
}

void transpose(Matrix& matrix, int64_t n) {
    for (int64_t r = 0; r < n; r++)
        for (int64_t c = 0; c < r; c++)
            std::swap(matrix[(size_t)(r * n + c)], matrix[(size_t)(c * n + r)]);
}

double dot(const double* a, const double* b, int64_t n) {
    double sum = 0;
    for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

}  // namespace

Modes modes_of(const std::vector<double>& gram, int64_t n) {
    Matrix vectors = gram;
    std::vector<double> diagonal((size_t)n), beside((size_t)n);
    reduce(vectors, n, diagonal, beside);
    transpose(vectors, n);
    diagonalise(vectors, n, diagonal, beside);
    std::vector<int64_t> order((size_t)n);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
        return diagonal[(size_t)a] > diagonal[(size_t)b];
    });
    const std::vector<double> rows = dct_rows(n);
    Modes modes;
    modes.n = n;
    for (const int64_t number : order) {
        modes.amplitudes.push_back(std::sqrt(std::max(diagonal[(size_t)number], 0.0)));
        for (int64_t k = 0; k < n; k++)
            modes.spectra.push_back(dot(&vectors[(size_t)(number * n)], &rows[(size_t)(k * n)], n));
    }
    return modes;
}

bool pack_basis(const Modes& modes, double step, Buffer& packed, fhash_error& error) {
    const int64_t n = modes.n;
    std::vector<int32_t> integers, row((size_t)n);
    std::vector<int> exponents;
    std::vector<double> span, rest((size_t)n);  // span: orthonormal, of the vectors so far
    for (int64_t i = 0; i < n && modes.amplitudes[(size_t)i] >= step; i++) {
        const double* const spectrum = &modes.spectra[(size_t)(i * n)];
        const double octaves = 2 * std::log2(modes.amplitudes[(size_t)i] / step);
        const int exponent = (int)std::min<double>(MAX_EXPONENT, std::nearbyint(octaves));
        const double* const largest = std::max_element(
            spectrum, spectrum + n, [](double a, double b) { return std::fabs(a) < std::fabs(b); });
        const double scale = (*largest > 0 ? 1.0 : -1.0) / shrink(exponent);
        for (int64_t k = 0; k < n; k++)
            row[(size_t)k] = (int32_t)std::nearbyint(spectrum[k] * scale);
        for (int64_t k = 0; k < n; k++) rest[(size_t)k] = row[(size_t)k];
        const double length = std::sqrt(dot(rest.data(), rest.data(), n));
        for (int pass = 0; pass < 2; pass++)  // Gram-Schmidt, repeated against rounding
            for (size_t other = 0; other < span.size(); other += (size_t)n) {
                const double share = dot(rest.data(), &span[other], n);
                for (int64_t k = 0; k < n; k++) rest[(size_t)k] -= share * span[other + (size_t)k];
            }
        const double left = std::sqrt(dot(rest.data(), rest.data(), n));
        if (length == 0 || left < MIN_NEW * length) continue;
        for (const double value : rest) span.push_back(value / left);
        integers.insert(integers.end(), row.begin(), row.end());
        exponents.push_back(exponent);
    }
    const int64_t rank = (int64_t)exponents.size();
    packed = {(uint8_t)n, (uint8_t)(n >> 8), (uint8_t)rank, (uint8_t)(rank >> 8)};
    int level = MAX_EXPONENT, bits = 0;
    const auto put = [&](int bit) {
        if (bits % 8 == 0) packed.push_back(0);
        if (bit) packed.back() |= (uint8_t)(128 >> bits % 8);
        bits++;
    };
    for (const int exponent : exponents) {
        for (; level > exponent; level--) put(0);
        put(1);
    }
    if (!rank) return true;
    Buffer block;
    const Shape shape = {1, 1, rank, n};
    if (!encode_integers(integers, shape, single_band(shape), {}, block, error)) return false;
    packed.insert(packed.end(), block.begin(), block.end());
    return true;
}

}  // namespace fhash
