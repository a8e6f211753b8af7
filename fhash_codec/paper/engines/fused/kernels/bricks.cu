// The kernels on bricks. In each, block b takes the items b, b + blocks, ...

// Runs the layers up to each group's part of the outputs.
__device__ inline void run_layers(const Shared& at) {
    if constexpr (LAYERS > 0) {
        forward<INPUTS>(at.matrices, at.inputs, at.hidden[0]);
        __syncthreads();
    }
    if constexpr (LAYERS > 1) {
        forward<WIDTH>(at.matrices + FIRST_LAYER, at.hidden[0], at.hidden[1]);
        __syncthreads();
    }
    const float* last = LAYERS == 0 ? at.inputs : at.hidden[LAYERS - 1];
    last_forward(at.matrices + LAST_LAYER_AT, last, at.parts);
    __syncthreads();
}

// Writes the gradient by the inputs of a tile over them, from the residuals of its columns.
__device__ inline void run_back(const Shared& at, float* sums, float (&last_sums)[LAST_STEPS]) {
    float* last = LAYERS == 0 ? at.inputs : at.hidden[LAYERS - 1];
    last_backward(at.matrices + LAST_LAYER_AT, at.residual, last, last_sums);
    __syncthreads();
    if constexpr (LAYERS > 1) {
        add_matrix_gradient<WIDTH + 1>(at.hidden[0], at.hidden[1], sums + FIRST_LAYER);
        __syncthreads();
        backward<WIDTH, true>(at.matrices + FIRST_LAYER, at.hidden[1], at.hidden[0]);
        __syncthreads();
    }
    if constexpr (LAYERS > 0) {
        add_matrix_gradient<INPUTS + 1>(at.inputs, at.hidden[0], sums);
        __syncthreads();
        backward<INPUTS, false>(at.matrices, at.hidden[0], at.inputs);
        __syncthreads();
    }
}

__device__ inline void write_ones(const Shared& at) {
    for (int layer = 0; layer < LAYERS; layer++)
        for (int i = threadIdx.x; i < PITCH; i += THREADS)
            at.hidden[layer][WIDTH * PITCH + i] = 1.f;
}

// Moves the finest embeddings of a tile's samples by a step of Adam.
__device__ inline void move_fine(
    const Model& model, const Brick& brick, const Shared& at, int first_row, int columns,
    const Rate& rate) {
    for (int i = threadIdx.x; i < SIZE * columns; i += THREADS) {
        const int e = i / columns, column = i % columns;
        const int vertex = first_row * BRICK_X + column;
        if (!is_sample(model, brick, vertex)) continue;
        const long long place = fine_place(model, brick, at.samples, vertex, e);
        float mean = model.fine_mean[place], square = model.fine_square[place];
        float number = caught_up(brick.effect, model.fine[place], mean, square);
        mean *= brick.effect.mean_decay;
        square *= brick.effect.square_decay;
        adam(number, at.inputs[e * PITCH + column], mean, square, rate);
        model.fine[place] = number;
        model.fine_mean[place] = mean;
        model.fine_square[place] = square;
    }
}

// Adds the gradient by the sub-lattices to that by the coarse numbers: by atomics, or as entries
// (place, number) of a list that `sum_entries` adds in a fixed order.
__device__ inline void scatter(
    const Model& model, const Shared& at, long long item, int* places, float* entries) {
    each_lattice_number(model, at, [&](int i, long long first, long long second, float weight) {
        const float slope = at.slopes[i];
        if (places) {
            const long long entry = (item * LATTICE + i) * 2;
            places[entry] = static_cast<int>(first);
            places[entry + 1] = static_cast<int>(second);
            entries[entry] = (1.f - weight) * slope;
            entries[entry + 1] = weight * slope;
        } else {
            if (weight != 1.f) atomicAdd(model.gradient + first, (1.f - weight) * slope);
            if (weight != 0.f) atomicAdd(model.gradient + second, weight * slope);
        }
    });
}

// One step of training, but for what `move_flat` does. An item is one of `parts` parts of a brick.
// Each block writes its gradient by the matrices (blocks, MATRICES) and its squared error.
extern "C" __global__ void __launch_bounds__(THREADS, 512 / THREADS) train_bricks(
    Model model, const long long* ids, int items, int parts, long long step, float scale,
    Rate rate, float* matrix_gradients, double* errors, int* places, float* entries) {
    FHASH_SHARED(memory);
    const Shared at = shared_memory(reinterpret_cast<float*>(memory));
    float* const gradients = matrix_gradients + static_cast<long long>(blockIdx.x) * MATRICES;
    float* const sums = SUMS_IN_SHARED ? at.sums : gradients;
    load_matrices(model.flat + model.coarse, at.matrices);
    write_ones(at);
    for (int i = threadIdx.x; i < MATRICES; i += THREADS) sums[i] = 0.f;
    float last_sums[LAST_STEPS] = {};
    double error = 0.0;
    for (int item = blockIdx.x; item < items; item += gridDim.x) {
        __syncthreads();
        for (int i = threadIdx.x; i < LATTICE; i += THREADS) at.slopes[i] = 0.f;
        const Brick brick = load_brick(model, ids[item / parts], step - 1, at);
        const int end = TILES * (item % parts + 1) / parts;
        for (int tile = TILES * (item % parts) / parts; tile < end; tile++) {
            const int first_row = tile * TILE_ROWS;
            const int left = BRICK_ROWS - first_row;
            const int columns = (left < TILE_ROWS ? left : TILE_ROWS) * BRICK_X;
            const int first = first_row * BRICK_X;
            const int samples = samples_before(model, brick, at.samples, first + columns) -
                                samples_before(model, brick, at.samples, first);
            if (samples == 0) continue;  // the same in all threads
            interpolate_rows(at, first_row);
            __syncthreads();
            load_inputs(model, brick, at, first_row, columns);
            __syncthreads();
            run_layers(at);
            for (int column = threadIdx.x; column < COLUMNS; column += THREADS) {
                float residual = 0.f;
                if (column < columns && is_sample(model, brick, first + column)) {
                    const long long sample =
                        brick.offset + samples_before(model, brick, at.samples, first + column);
                    residual = output_of(at.parts, column) - model.values[sample];
                    error += static_cast<double>(residual) * residual;
                }
                at.residual[column] = residual * scale;
            }
            __syncthreads();
            run_back(at, sums, last_sums);
            transpose_rows(at, columns);
            if (FINE) move_fine(model, brick, at, first_row, columns, rate);
            __syncthreads();
            add_transposed_rows(at, first_row, columns);
            __syncthreads();
        }
        scatter(model, at, item, places, entries);
    }
    add_last_gradient(last_sums, sums + LAST_LAYER_AT, at.parts);
    double* const thread_errors = reinterpret_cast<double*>(at.parts);
    thread_errors[threadIdx.x] = error;
    __syncthreads();
    if (threadIdx.x == 0) {
        double sum = 0.0;
        for (int i = 0; i < THREADS && i < COLUMNS; i++) sum += thread_errors[i];
        errors[blockIdx.x] = sum;
    }
    if (SUMS_IN_SHARED)
        for (int i = threadIdx.x; i < MATRICES; i += THREADS) gradients[i] = sums[i];
}

// Writes the values at the samples of bricks, one brick after another; `first` says where each
// brick's begin.
extern "C" __global__ void __launch_bounds__(THREADS, 512 / THREADS) infer_bricks(
    Model model, const long long* ids, int items, const long long* first, long long step,
    float* values) {
    FHASH_SHARED(memory);
    const Shared at = shared_memory(reinterpret_cast<float*>(memory));
    load_matrices(model.flat + model.coarse, at.matrices);
    write_ones(at);
    for (int item = blockIdx.x; item < items; item += gridDim.x) {
        __syncthreads();
        const Brick brick = load_brick(model, ids[item], step, at);
        for (int tile = 0; tile < TILES; tile++) {
            const int first_row = tile * TILE_ROWS;
            const int left = BRICK_ROWS - first_row;
            const int columns = (left < TILE_ROWS ? left : TILE_ROWS) * BRICK_X;
            const int vertex = first_row * BRICK_X;
            const int before = samples_before(model, brick, at.samples, vertex);
            if (samples_before(model, brick, at.samples, vertex + columns) == before) continue;
            interpolate_rows(at, first_row);
            __syncthreads();
            load_inputs(model, brick, at, first_row, columns);
            __syncthreads();
            run_layers(at);
            for (int column = threadIdx.x; column < columns; column += THREADS)
                if (is_sample(model, brick, vertex + column))
                    values[first[item] +
                           samples_before(model, brick, at.samples, vertex + column)] =
                        output_of(at.parts, column);
        }
    }
}

// Moves the flat vector by a step of Adam, clears the coarse gradient, and marks the bricks of the
// batch as visited. The gradient by the network is the sum over the blocks, in their order.
extern "C" __global__ void __launch_bounds__(THREADS) move_flat(
    Model model, const long long* ids, int bricks, long long step, Rate rate,
    const float* matrix_gradients, int blocks) {
    const long long i = static_cast<long long>(blockIdx.x) * THREADS + threadIdx.x;
    if (i < bricks) model.visited[ids[i]] = step;
    if (i >= model.coarse + PARAMETERS) return;
    float gradient = 0.f;
    if (i < model.coarse) {
        gradient = model.gradient[i];
        model.gradient[i] = 0.f;
    } else {
        const int place = place_in_matrices(static_cast<int>(i - model.coarse));
        for (int block = 0; block < blocks; block++)
            gradient += matrix_gradients[static_cast<long long>(block) * MATRICES + place];
    }
    adam(model.flat[i], gradient, model.flat_mean[i], model.flat_square[i], rate);
}

// Adds the entries of a list to the coarse gradient, those of one place in their order. The list is
// sorted by place, and places below 0 are none.
extern "C" __global__ void __launch_bounds__(THREADS) sum_entries(
    Model model, const int* places, const long long* order, const float* entries,
    long long count) {
    const long long i = static_cast<long long>(blockIdx.x) * THREADS + threadIdx.x;
    if (i >= count || places[i] < 0 || (i > 0 && places[i - 1] == places[i])) return;
    float sum = 0.f;
    for (long long j = i; j < count && places[j] == places[i]; j++) sum += entries[order[j]];
    model.gradient[places[i]] += sum;
}

// Lets the bricks `first` .. `first + items` catch up with a step.
extern "C" __global__ void __launch_bounds__(THREADS) settle_bricks(
    Model model, long long first, int items, long long step) {
    FHASH_SHARED(memory);
    for (int item = blockIdx.x; item < items; item += gridDim.x) {
        const long long id = first + item, visited = model.visited[id];
        const CatchUp effect = catch_up(model, visited, step, reinterpret_cast<float*>(memory));
        if (FINE && visited > 0 && visited < step) {  // the same in all threads
            const long long first_sample = model.offsets[id];
            const int samples = static_cast<int>(model.offsets[id + 1] - first_sample);
            for (int i = threadIdx.x; i < SIZE * samples; i += THREADS) {
                const long long place = i / samples * model.fine_row + first_sample + i % samples;
                const float mean = model.fine_mean[place], square = model.fine_square[place];
                model.fine[place] = caught_up(effect, model.fine[place], mean, square);
                model.fine_mean[place] = mean * effect.mean_decay;
                model.fine_square[place] = square * effect.square_decay;
            }
        }
        // All threads have read it: `catch_up` has barriers unless it is the step already.
        if (threadIdx.x == 0 && visited > 0) model.visited[id] = step;
    }
}
