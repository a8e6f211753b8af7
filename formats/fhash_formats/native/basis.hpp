// The data's own bases along an axis (basis.cpp).
#pragma once

#include "coding.hpp"

namespace fhash {

constexpr int MAX_EXPONENT = 24;  // of the scale of a vector

// 2^(-exponent / 2), by exact powers of two and one constant.
double shrink(int exponent);
// The rows of the orthonormal DCT-II of a length (n, n), the same bits on every machine.
std::vector<double> dct_rows(int64_t n);
// A basis from its packed bytes; null for what no encoder writes.
std::shared_ptr<const Basis> read_basis(Bytes data, fhash_error& error);

// Eigenvectors of the products of lines: amplitudes, the largest first, and DCTs as rows (n, n).
struct Modes {
    int64_t n = 0;
    std::vector<double> amplitudes, spectra;
};

// gram: (n, n), the sum of v v^T over lines v.
Modes modes_of(const std::vector<double>& gram, int64_t n);

// A packed basis. A vector is left out where its total amplitude is below the step; the others get
// a scale of amplitude / step, to half an octave, so that quantising a vector costs no more than
// quantising its coefficients.
bool pack_basis(const Modes& modes, double step, Buffer& packed, fhash_error& error);

}  // namespace fhash
