// Variables of a file: their headers, and their arrays by name (FORMAT.md, Variables and Header).
#pragma once

#include "zarr.hpp"

namespace fhash {

extern const char* const AXES[4];  // "time" and so on
constexpr int64_t MAX_LEVELS = 64;

struct Variable {
    Record top, header;  // of the file, and of the variable
    std::string name, units, attributes;  // the last as JSON text
    std::string group;  // of its arrays, with "/"; empty for the root
    Json coordinates[4] = {};  // objects of the header; null for whole numbers from 0 on
    std::map<std::string, const Array*> arrays;  // by name (FORMAT.md, Arrays)
    int32_t type = 0;                            // of the source
    int64_t shape[4] = {};
    int64_t box[6] = {};
    double range[2] = {};   // ends of the value range, rounded to the nearest
    double within[2] = {};  // the least and the greatest float64 within the range
    double background = 0, max_error = 0, psnr = 0;
    Json fill = nullptr;  // a number, or null for none
    bool compact = false, plain = false;
    bool cubic = false;  // monotone cubic between steps, of the profile compact
    int64_t features = 1;
    Record model;
    std::string mlp;                             // as a block of settings; empty for none
    std::string tables;                          // model.tables
    int32_t values = 0;                          // type of the values, of the profile compact
    std::vector<std::array<int64_t, 4>> levels;  // shapes, the finest first

    const Array* find(const std::string& array) const;
    int64_t keys() const { return levels[0][0]; }
    int64_t length(int axis) const { return box[2 * axis + 1] - box[2 * axis]; }  // z, y, x
    // Whether values are computed in float32.
    bool in_float32() const { return fhash_type_size(type) <= 2 || type == FHASH_FLOAT32; }
};

// The variables of a file, complete and checked.
bool read_variables(Hierarchy& hierarchy, std::vector<Variable>& found, fhash_error& error);

// Positions along an axis, `shape[axis]` of them.
void find_positions(const Variable& variable, int axis, double* positions);

// Bytes of the occupancy of blocks of a key frame; 0 beyond 2^59.
int64_t occupancy_bytes(const Variable& variable, int64_t block = 1);

bool check_array(const Variable& variable, const char* name, const std::vector<int64_t>& shape,
                 std::initializer_list<int32_t> types, bool required, fhash_error& error);
// Check the arrays of a plain file (plain.cpp), and of the profile paper (paper.cpp).
bool check_plain(const Variable& variable, fhash_error& error);
bool check_network(const Variable& variable, fhash_error& error);

}  // namespace fhash
