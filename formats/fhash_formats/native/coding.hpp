// Entropy coding of a tile's parts with the priors that it begins with.
#pragma once

#include "settings.hpp"

namespace fhash {

constexpr int TABLE_COLUMNS = 29;  // of a band: lowest and highest indices, kind, four references

// Bands in the order in which they are coded, TABLE_COLUMNS numbers each (plan.hpp).
using Table = std::vector<int32_t>;

// The bands of a transform on tiles of a shape, which fits its bases.
Table band_table(const AxisTransform* axes, const Shape& shape);
// The table of integers that were not transformed: one band.
Table single_band(const Shape& shape);

inline int64_t vertices(const Shape& shape) { return shape[0] * shape[1] * shape[2] * shape[3]; }

// Integers of a shape; `out` need not be zeros.
bool decode_integers(const uint8_t* data, size_t size, const Shape& shape, const Table& table,
                     bool trellis, bool fast, int32_t* out, fhash_error& error);
// A small block that stands alone.
bool decode_block(const uint8_t* data, size_t size, const Shape& shape, int32_t* out,
                  fhash_error& error);
bool decode_labels(const uint8_t* data, size_t size, int64_t count, const Shape& shape,
                   uint16_t* out, fhash_error& error);
bool decode_predicted(const uint8_t* data, size_t size, const Shape& shape,
                      const Predictor& predictor, int32_t* out, fhash_error& error);
// levels: two of each vertex.
bool decode_mask(const uint8_t* data, size_t size, const Shape& shape, const uint8_t* first,
                 const uint8_t* second, uint8_t* out, fhash_error& error);

// The passes and taps of a predictor, whose levels are given.
void make_passes(Predictor& predictor, const int* order, int reach);

// False with FHASH_ERROR_MEMORY where the code of a kernel is that of no memory, and with
// FHASH_ERROR_DAMAGED for another error.
bool kernel_done(int64_t code, const char* what, fhash_error& error);

}  // namespace fhash
