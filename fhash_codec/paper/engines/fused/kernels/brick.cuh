// A brick: its samples, its sub-lattices of the coarse levels, interpolation and its transpose.
//
// source.py also gives, for each coarse level, LATTICE_SHAPE (corners z, y, x of a sub-lattice),
// TIME_CORNERS, RESOLUTION (t, z, y, x), TABLE_AT (where its table begins in the flat tables),
// LATTICE_AT (where its sub-lattice begins, LATTICE numbers in all) and ROW_AT (where its numbers
// begin in an interpolated row, ROW numbers in all).

constexpr int AXES_LENGTH = 1 + BRICK_Z + BRICK_Y + BRICK_X;
// Where the vertices of an axis begin in a table of all axes.
constexpr int Z_AT = 1;
constexpr int Y_AT = Z_AT + BRICK_Z;
constexpr int X_AT = Y_AT + BRICK_Y;

// Shared memory of a block, all in numbers of 4 bytes.
struct Shared {
    float* inputs;       // (INPUTS + 1, PITCH), the last row 1; later the gradient by them
    float* hidden[2];    // (WIDTH + 1, PITCH) each
    float* matrices;     // MATRICES
    float* sums;         // MATRICES, their gradients
    float* parts;        // (GROUPS, COLUMNS) = 4 THREADS, or scratch
    float* residual;     // COLUMNS
    float* lattice;      // LATTICE, interpolated in time
    float* slopes;       // LATTICE, their gradients
    float* rows;         // (TILE_ROWS, ROW), or their gradients
    float* after;        // (COARSE, AXES_LENGTH), weights of the corners after
    int* before;         // (COARSE, AXES_LENGTH), corners before
    int* start;          // (4, COARSE), first corner of a sub-lattice
    int* samples;        // MASK_BYTES + 1, samples before each byte of the mask
};

__device__ inline Shared shared_memory(float* memory) {
    Shared at;
    at.inputs = memory + AT_INPUTS;
    at.hidden[0] = memory + AT_HIDDEN_1;
    at.hidden[1] = memory + AT_HIDDEN_2;
    at.matrices = memory + AT_MATRICES;
    at.sums = memory + AT_SUMS;
    at.parts = memory + AT_PARTS;
    at.residual = memory + AT_RESIDUAL;
    at.lattice = memory + AT_LATTICE;
    at.slopes = memory + AT_SLOPES;
    at.rows = memory + AT_ROWS;
    at.after = memory + AT_AFTER;
    at.before = reinterpret_cast<int*>(memory + AT_BEFORE);
    at.start = reinterpret_cast<int*>(memory + AT_START);
    at.samples = reinterpret_cast<int*>(memory + AT_SAMPLES);
    return at;
}

struct Brick {
    long long id;
    long long offset;  // of its first sample
    CatchUp effect;
};

__device__ inline int mask_byte(const Model& model, long long id, int byte) {
    return model.mask[id * MASK_BYTES + byte];
}

__device__ inline bool is_sample(const Model& model, const Brick& brick, int vertex) {
    return mask_byte(model, brick.id, vertex / 8) >> (7 - vertex % 8) & 1;
}

// Samples of the brick before a vertex, up to VERTICES.
__device__ inline int samples_before(
    const Model& model, const Brick& brick, const int* samples, int vertex) {
    const int bit = vertex % 8;
    const int count = samples[vertex / 8];
    return bit ? count + __popc(mask_byte(model, brick.id, vertex / 8) >> (8 - bit)) : count;
}

// Place of the finest embedding of a vertex that is a sample, for number e of an embedding.
__device__ inline long long fine_place(
    const Model& model, const Brick& brick, const int* samples, int vertex, int e) {
    return e * model.fine_row + brick.offset + samples_before(model, brick, samples, vertex);
}

// Counts the samples before each byte of the mask. `scratch` holds THREADS numbers.
__device__ inline void count_samples(const Model& model, long long id, int* samples, int* scratch) {
    constexpr int PART = (MASK_BYTES + THREADS - 1) / THREADS;
    const int first = threadIdx.x * PART;
    const int end = first + PART < MASK_BYTES ? first + PART : MASK_BYTES;
    int count = 0;
    for (int byte = first; byte < end; byte++) count += __popc(mask_byte(model, id, byte));
    scratch[threadIdx.x] = count;
    __syncthreads();
    int before = 0;
    for (int i = 0; i < static_cast<int>(threadIdx.x); i++) before += scratch[i];
    for (int byte = first; byte < end; byte++) {
        samples[byte] = before;
        before += __popc(mask_byte(model, id, byte));
    }
    if (end == MASK_BYTES && first < MASK_BYTES) samples[MASK_BYTES] = before;
    __syncthreads();
}

// Place of a corner's number in the coarse numbers in use.
__device__ inline long long coarse_place(
    const Model& model, const int* start, int level, int t, int z, int y, int x, int e) {
    const int* size = RESOLUTION[level];
    const long long plane =
        static_cast<long long>(start[level] + t) * size[1] + start[COARSE + level] + z;
    const long long row = plane * size[2] + start[2 * COARSE + level] + y;
    const long long place =
        TABLE_AT[level] + (row * size[3] + start[3 * COARSE + level] + x) * SIZE + e;
    return model.rank ? model.rank[place] : place;
}

// Calls action(place in the sub-lattices, place of the corner at the first time in the coarse
// numbers, of that at the second, weight of the second) for each number of the sub-lattices.
// Without a second corner its place is -1 and its weight 0.
template <class Action>
__device__ inline void each_lattice_number(
    const Model& model, const Shared& at, const Action& action) {
    for (int level = 0; level < COARSE; level++) {
        const int* shape = LATTICE_SHAPE[level];
        const int t = at.before[level * AXES_LENGTH];
        const float weight = at.after[level * AXES_LENGTH];
        const bool two = t + 1 < TIME_CORNERS[level];
        for (int i = threadIdx.x; i < shape[0] * shape[1] * shape[2] * SIZE; i += THREADS) {
            const int e = i % SIZE, x = i / SIZE % shape[2];
            const int y = i / (SIZE * shape[2]) % shape[1], z = i / (SIZE * shape[2] * shape[1]);
            const long long first = coarse_place(model, at.start, level, t, z, y, x, e);
            const long long second =
                two ? coarse_place(model, at.start, level, t + 1, z, y, x, e) : -1;
            action(LATTICE_AT[level] + i, first, second, two ? weight : 0.f);
        }
    }
}

// Loads what all tiles of a brick need.
__device__ inline Brick load_brick(
    const Model& model, long long id, long long step, const Shared& at) {
    for (int axis = 0; axis < 4; axis++) {
        const long long coordinate = model.bricks[id * 4 + axis] * COARSE;
        const int length = axis == 0 ? 1 : axis == 1 ? BRICK_Z : axis == 2 ? BRICK_Y : BRICK_X;
        const int place = axis == 0 ? 0 : axis == 1 ? Z_AT : axis == 2 ? Y_AT : X_AT;
        for (int i = threadIdx.x; i < COARSE * length; i += THREADS) {
            const int to = i / length * AXES_LENGTH + place + i % length;
            at.before[to] = model.before[axis][coordinate * length + i];
            at.after[to] = model.after[axis][coordinate * length + i];
        }
        for (int i = threadIdx.x; i < COARSE; i += THREADS)
            at.start[axis * COARSE + i] = model.start[axis][coordinate + i];
    }
    count_samples(model, id, at.samples, reinterpret_cast<int*>(at.parts));
    each_lattice_number(model, at, [&](int i, long long first, long long second, float weight) {
        float value = (1.f - weight) * model.flat[first];
        if (weight != 0.f) value += weight * model.flat[second];
        at.lattice[i] = value;
    });
    const CatchUp effect = catch_up(model, FINE ? model.visited[id] : 0, step, at.parts);
    __syncthreads();
    return {id, model.offsets[id], effect};
}

// Interpolates the sub-lattices along z and y to the rows of a tile.
__device__ inline void interpolate_rows(const Shared& at, int first_row) {
    for (int level = 0; level < COARSE; level++) {
        const int* shape = LATTICE_SHAPE[level];
        const float* lattice = at.lattice + LATTICE_AT[level];
        const int* before = at.before + level * AXES_LENGTH;
        const float* after = at.after + level * AXES_LENGTH;
        const int width = shape[2] * SIZE, plane = shape[1] * width;
        for (int i = threadIdx.x; i < TILE_ROWS * width; i += THREADS) {
            const int row = first_row + i / width, number = i % width;
            if (row >= BRICK_ROWS) continue;
            const int z = row / BRICK_Y + Z_AT, y = row % BRICK_Y + Y_AT;
            const float weight_z = after[z], weight_y = after[y];
            const float* corner = lattice + before[z] * plane + before[y] * width + number;
            const int next_z = before[z] + 1 < shape[0] ? plane : 0;
            const int next_y = before[y] + 1 < shape[1] ? width : 0;
            const float low = (1.f - weight_y) * corner[0] + weight_y * corner[next_y];
            const float high =
                (1.f - weight_y) * corner[next_z] + weight_y * corner[next_z + next_y];
            at.rows[i / width * ROW + ROW_AT[level] + number] =
                (1.f - weight_z) * low + weight_z * high;
        }
    }
}

// Writes the inputs of the layers at the vertices of a tile; 0 in columns without a vertex, and in
// place of finest embeddings of a vertex that is no sample.
__device__ inline void load_inputs(
    const Model& model, const Brick& brick, const Shared& at, int first_row, int columns) {
    for (int i = threadIdx.x; i < COLUMNS * (LEVELS + 1); i += THREADS) {
        const int column = i % COLUMNS, level = i / COLUMNS - 1;  // level -1: the ones
        float* to = at.inputs + (level < 0 ? INPUTS : level * SIZE) * PITCH + column;
        if (level < 0) {
            *to = 1.f;
        } else if (column >= columns) {
            for (int e = 0; e < SIZE; e++) to[e * PITCH] = 0.f;
        } else if (FINE && level == 0) {
            const int vertex = first_row * BRICK_X + column;
            if (!is_sample(model, brick, vertex)) {
                for (int e = 0; e < SIZE; e++) to[e * PITCH] = 0.f;
                continue;
            }
            for (int e = 0; e < SIZE; e++) {
                const long long place = fine_place(model, brick, at.samples, vertex, e);
                to[e * PITCH] = caught_up(
                    brick.effect, model.fine[place], model.fine_mean[place],
                    model.fine_square[place]);
            }
        } else {
            const int x = (level - FINE) * AXES_LENGTH + X_AT + column % BRICK_X;
            const int corner = at.before[x];
            const float weight = at.after[x];
            const int next = corner + 1 < LATTICE_SHAPE[level - FINE][2] ? SIZE : 0;
            const float* row =
                at.rows + column / BRICK_X * ROW + ROW_AT[level - FINE] + corner * SIZE;
            for (int e = 0; e < SIZE; e++)
                to[e * PITCH] = (1.f - weight) * row[e] + weight * row[next + e];
        }
    }
}

// Weight of a corner at a vertex whose corner before is `before`.
__device__ inline float weight_of(int corner, int before, float after) {
    return corner == before ? 1.f - after : corner == before + 1 ? after : 0.f;
}

// Writes the gradient by the rows of a tile: the transpose of the last part of `load_inputs`.
__device__ inline void transpose_rows(const Shared& at, int columns) {
    for (int level = 0; level < COARSE; level++) {
        const int width = LATTICE_SHAPE[level][2] * SIZE;
        const int place = level * AXES_LENGTH + X_AT;
        for (int i = threadIdx.x; i < columns / BRICK_X * width; i += THREADS) {
            const int row = i / width, corner = i % width / SIZE, e = i % SIZE;
            const float* down = at.inputs + ((level + FINE) * SIZE + e) * PITCH + row * BRICK_X;
            float sum = 0.f;
            for (int x = 0; x < BRICK_X; x++)
                sum += weight_of(corner, at.before[place + x], at.after[place + x]) * down[x];
            at.rows[row * ROW + ROW_AT[level] + i % width] = sum;
        }
    }
}

// Adds the gradient by the sub-lattices: the transpose of `interpolate_rows`.
__device__ inline void add_transposed_rows(const Shared& at, int first_row, int columns) {
    const int end_row = first_row + columns / BRICK_X;
    for (int level = 0; level < COARSE; level++) {
        const int* shape = LATTICE_SHAPE[level];
        const int* before = at.before + level * AXES_LENGTH;
        const float* after = at.after + level * AXES_LENGTH;
        const int width = shape[2] * SIZE;
        for (int i = threadIdx.x; i < shape[0] * shape[1] * width; i += THREADS) {
            const int number = i % width, y = i / width % shape[1], z = i / (width * shape[1]);
            float sum = 0.f;
            for (int row = first_row; row < end_row;) {
                const int at_z = Z_AT + row / BRICK_Y;
                const int end_y = (row / BRICK_Y + 1) * BRICK_Y;
                const int end = end_y < end_row ? end_y : end_row;
                const float weight_z = weight_of(z, before[at_z], after[at_z]);
                if (weight_z == 0.f) {
                    row = end;
                    continue;
                }
                float along_y = 0.f;
                for (; row < end; row++) {
                    const int at_y = Y_AT + row % BRICK_Y;
                    along_y += weight_of(y, before[at_y], after[at_y]) *
                               at.rows[(row - first_row) * ROW + ROW_AT[level] + number];
                }
                sum += weight_z * along_y;
            }
            at.slopes[LATTICE_AT[level] + i] += sum;
        }
    }
}
