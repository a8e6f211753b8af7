// The records that kernels are launched with, in plain C: Python takes them from this text
// (setup.py).

// The arrays of an engine. A table of an axis (t, z, y, x) holds,
// for each coordinate of a brick and each coarse level, where the brick's sub-lattice begins, and
// for each of its vertices the corner before it and the weight of the corner after it.
typedef struct Model {
    const long long* bricks;          // (bricks, 4)
    const unsigned char* mask;        // (bricks, MASK_BYTES), as np.packbits
    const float* values;              // (samples,)
    const long long* offsets;         // (bricks + 1,)
    const int* rank;                  // place of a coarse number among those in use, or null
    const int* start[4];              // (coordinates, COARSE)
    const int* before[4];             // (coordinates, COARSE, vertices)
    const float* after[4];            // (coordinates, COARSE, vertices)
    const float* powers;              // (WINDOW + 1, 2), of the decays of a step without gradient
    const float* weights;             // (steps, 2), see `catch_up`
    float* fine;                      // (SIZE, fine_row): at the samples, brick by brick
    float* fine_mean;
    float* fine_square;
    long long* visited;               // (bricks,)
    float* flat;                      // coarse numbers in use, then the layers
    float* flat_mean;
    float* flat_square;
    float* gradient;                  // of the coarse numbers
    long long fine_row;               // numbers from one row of `fine` to the next
    long long coarse;                 // number of coarse numbers
    int steps;                        // length of `weights`
} Model;

// Adam's numbers of one step, `corrections` in paper/engines/parameters.py: the factor of the mean square's
// root, and the pace.
typedef struct Rate {
    float root;
    float pace;
} Rate;

// The table of a level at one time. Axes are x, y and z. Strides
// count vertices, or bits of the bitmap where the level holds some vertices only
// (paper/network.py); an axis of one vertex has the stride 0, which makes both corners the
// same.
typedef struct Level {
    const float* table;               // (vertices, SIZE)
    const unsigned long long* words;  // the bitmap
    const unsigned* blocks;           // ones before each block of 4 words
    const unsigned char* within;      // ones before a word in its block
    long long nothing;                // place of the embedding of vertices that are not held
    long long strides[3];
    double scale[3];                  // vertices of the level after the first one
} Level;

// Places.
typedef struct Places {
    const double* at;   // (count, 3): x, y, z in vertices of the box
    long long count;
    double span[3];     // vertices of the box after the first one, at least 1
    double inverse[3];  // 1 / span
} Places;
