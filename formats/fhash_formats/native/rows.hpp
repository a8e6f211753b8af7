// Rows of a tile and the rows before them, as the coders of masks and labels look at them.
#pragma once

#include <cstdint>
#include <vector>

#include "core.hpp"

namespace {

const int PADDING = 2;  // entries beside a row that stand for vertices that do not exist

// A row (K) and the rows before it: N along y, P along z, B along t, doubled for two before. A
// second letter moves on: N and S by -1 and +1 along y, P and F by -1 and +1 along z.
template <class T> struct Rows {
    T* K;
    const T *N, *NN, *P, *PP, *PN, *PS, *B, *BB, *BN, *BS, *BP, *BF;
};

// Entries of all vertices (t, z, y, x), with PADDING at both ends of each row, and a row that
// stands for rows that do not exist. Throws std::bad_alloc.
template <class T> struct PaddedRows {
    int n1, n2;
    std::int64_t y_stride, z_stride, t_stride;
    std::vector<T> entries, nothing;

    PaddedRows(const std::int64_t* shape, T blank)
        : n1((int)shape[1]), n2((int)shape[2]), y_stride(shape[3] + 2 * PADDING),
          z_stride(y_stride * n2), t_stride(z_stride * n1),
          entries((size_t)(t_stride * shape[0]), blank), nothing((size_t)y_stride, blank) {}

    FHASH_INLINE Rows<T> around(int t, int z, int y) {
        const bool has_y = y > 0, has_z = z > 0, has_t = t > 0;
        const bool more_y = y + 1 < n2, more_z = z + 1 < n1;
        T* const K = entries.data() + t * t_stride + z * z_stride + y * y_stride + PADDING;
        const T* const none = nothing.data() + PADDING;
        return {
            K,
            has_y ? K - y_stride : none,
            y > 1 ? K - 2 * y_stride : none,
            has_z ? K - z_stride : none,
            z > 1 ? K - 2 * z_stride : none,
            has_z && has_y ? K - z_stride - y_stride : none,
            has_z && more_y ? K - z_stride + y_stride : none,
            has_t ? K - t_stride : none,
            t > 1 ? K - 2 * t_stride : none,
            has_t && has_y ? K - t_stride - y_stride : none,
            has_t && more_y ? K - t_stride + y_stride : none,
            has_t && has_z ? K - t_stride - z_stride : none,
            has_t && more_z ? K - t_stride + z_stride : none,
        };
    }
};

}  // namespace
