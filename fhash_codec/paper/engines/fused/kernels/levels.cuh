// The levels of a network around free places, all at one time.
//
// Constants in front: SIZE, and SPARSE, whether the levels hold some vertices only.

constexpr int STEP = SIZE % 4 == 0 ? 4 : SIZE % 2 == 0 ? 2 : 1;  // numbers that are read at a time

struct alignas(4 * STEP) Some {
    float at[STEP];
};

// The eight corners around a place, x first, and the weights of those after it.
struct Cell {
    long long corners[8];
    float after[3];
};

// The place of a vertex among those that a level holds: the rank of its bit.
__device__ inline long long place_of(const Level& level, long long bit) {
    if (!SPARSE) return bit;
    // The bit moves to the top of its word, and all that come after it fall out.
    const unsigned long long upto = level.words[bit >> 6] << (63 - (bit & 63));
    const long long rank = static_cast<long long>(level.blocks[bit >> 8]) +
                           level.within[bit >> 6] + __popcll(upto);
    return upto >> 63 ? rank - 1 : level.nothing;
}

// Finds the cell of a level around a place. The quotient of the position by the span is rounded and
// mended by the remainder, so that a place on a corner lies exactly in the cell that begins there.
__device__ inline Cell cell_at(const Level& level, const Places& places, const double (&at)[3]) {
    Cell cell;
    long long first = 0;
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const double span = places.span[a], last = level.scale[a] > 1. ? level.scale[a] - 1. : 0.;
        const double position = at[a] * level.scale[a];
        double before = floor(position * places.inverse[a]);
        double rest = position - before * span;
        if (rest < 0.) before -= 1., rest += span;
        if (rest >= span) before += 1., rest -= span;
        if (before > last) rest += (before - last) * span, before = last;
        if (!(before >= 0.)) rest += before * span, before = 0.;  // what is not a number, too
        cell.after[a] = static_cast<float>(rest * places.inverse[a]);
        first += static_cast<long long>(before) * level.strides[a];
    }
#pragma unroll
    for (int corner = 0; corner < 8; corner++)
        cell.corners[corner] = place_of(
            level, first + (corner & 1 ? level.strides[0] : 0) +
                       (corner & 2 ? level.strides[1] : 0) + (corner & 4 ? level.strides[2] : 0));
    return cell;
}

__device__ inline float between(float a, float b, float weight) { return a + weight * (b - a); }

// Interpolates a number of the corners along z, y and x in turn; `by` are its changes across the
// cell along x, y and z.
__device__ inline float interpolated(
    const float (&corners)[8], const float (&after)[3], float (&by)[3]) {
    float by_z[4], plane[4], by_y[2], line[2];
#pragma unroll
    for (int i = 0; i < 4; i++) {
        by_z[i] = corners[4 + i] - corners[i];
        plane[i] = corners[i] + after[2] * by_z[i];
    }
#pragma unroll
    for (int i = 0; i < 2; i++) {
        by_y[i] = plane[2 + i] - plane[i];
        line[i] = plane[i] + after[1] * by_y[i];
    }
    by[0] = line[1] - line[0];
    by[1] = between(by_y[0], by_y[1], after[0]);
    by[2] = between(
        between(by_z[0], by_z[2], after[1]), between(by_z[1], by_z[3], after[1]), after[0]);
    return line[0] + after[0] * by[0];
}
