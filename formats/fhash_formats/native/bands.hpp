// The table of bands (coding.hpp): which part of a tile each is, and the earlier bands from
// which it takes contexts.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace {

// Columns of the table. LOW, HIGH and SHIFT are the first of four columns, for t, z, y and x. BAND
// and SHIFT are columns within a reference.
enum Column { LOW = 0, HIGH = 4, KIND = 8, REFERENCES = 9, BAND = 0, SHIFT = 1 };
const int REFERENCE_COUNT = 4, REFERENCE_COLUMNS = 5;
const int COLUMNS = REFERENCES + REFERENCE_COUNT * REFERENCE_COLUMNS;
const int KINDS = 64;  // kinds of bands

struct Reference {
    int band, shift[4];
};
struct BandPlace {
    int low[4], size[4], kind;
    Reference references[REFERENCE_COUNT];
};

// State of a trellis of two quantisers that follows, by the lowest bit of the index; the quantiser
// of a state is its lowest bit. Index k is 2 k steps in the first one, and 2 k - 1 in the other.
constexpr std::uint8_t TRELLIS_NEXT[8][2] = {{0, 2}, {5, 7}, {1, 3}, {6, 4},
                                             {2, 0}, {4, 6}, {3, 1}, {7, 5}};

// Read the table of as many bands as there are. False for a band that does not lie within the
// shape.
template <class Band>
bool read_bands(const std::int32_t* table, const std::int64_t* shape, std::vector<Band>& bands) {
    for (std::size_t b = 0; b < bands.size(); b++) {
        const std::int32_t* const row = table + b * COLUMNS;
        BandPlace& band = bands[b];
        for (int a = 0; a < 4; a++) {
            const std::int32_t low = row[LOW + a], high = row[HIGH + a];
            if (low < 0 || low > high || high > shape[a]) return false;
            band.low[a] = low;
            band.size[a] = high - low;
        }
        band.kind = row[KIND];
        for (int k = 0; k < REFERENCE_COUNT; k++) {
            const std::int32_t* const reference = row + REFERENCES + k * REFERENCE_COLUMNS;
            band.references[k].band = reference[BAND];
            for (int a = 0; a < 4; a++) band.references[k].shift[a] = reference[SHIFT + a];
        }
    }
    return true;
}

}  // namespace
