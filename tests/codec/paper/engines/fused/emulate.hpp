// CUDA's kernels on a processor, for tests: the threads of a block are fibres that change at
// barriers, in any order. Shared memory is as large as was asked for, and NaN at first.
#pragma once
#include <setjmp.h>
#include <signal.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <numeric>
#include <random>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __constant__ static const
#define __grid_constant__
#define __launch_bounds__(...)
#define __syncthreads() emulated::wait(__LINE__)
#define FHASH_SHARED(name) float4* name = emulated::shared
#define threadIdx (emulated::now->thread)
#define blockIdx (emulated::block)
#define blockDim (emulated::size)
#define gridDim (emulated::grid)

struct alignas(16) float4 {
    float x, y, z, w;
};

namespace emulated {

struct Place {
    unsigned x = 0, y = 0, z = 0;
};

struct Fibre {
    ucontext_t begin;
    jmp_buf at;
    std::vector<char> stack = std::vector<char>(1 << 17);
    Place thread;
    int barrier = 0;
    bool started = false, done = false;
};

inline std::vector<Fibre> fibres;
inline Fibre* now;
inline jmp_buf scheduler;
inline ucontext_t scheduler_begin;
inline Place block, size, grid;
inline std::function<void()> body;
inline float4* shared;
inline sigjmp_buf escape;

// Signal masks are of no interest, and to save them takes a call of the system at each change.
inline void wait(int line) {
    now->barrier = line;
    if (!_setjmp(now->at)) _longjmp(scheduler, 1);
}

inline void entry() {
    body();
    now->done = true;
    _longjmp(scheduler, 1);
}

inline void run_to_barrier(Fibre& fibre) {
    now = &fibre;
    if (_setjmp(scheduler)) return;
    if (fibre.started) _longjmp(fibre.at, 1);
    fibre.started = true;
    swapcontext(&scheduler_begin, &fibre.begin);
}

// Runs one block; returns whether all threads always met at the same barrier.
inline bool run_block(std::vector<unsigned>& turns, int order, std::mt19937& random) {
    for (unsigned t = 0; t < fibres.size(); t++) {
        Fibre& fibre = fibres[t];
        fibre.thread.x = t;
        fibre.started = fibre.done = false;
        getcontext(&fibre.begin);
        fibre.begin.uc_stack.ss_sp = fibre.stack.data();
        fibre.begin.uc_stack.ss_size = fibre.stack.size();
        fibre.begin.uc_link = nullptr;
        makecontext(&fibre.begin, entry, 0);
    }
    for (bool any = true; any;) {
        if (order > 1) std::shuffle(turns.begin(), turns.end(), random);
        any = false;
        int meeting = -1;
        for (unsigned turn : turns) {
            Fibre& fibre = fibres[turn];
            if (fibre.done) return false;  // others wait at a barrier
            run_to_barrier(fibre);
            const int barrier = fibre.done ? 0 : fibre.barrier;
            if (meeting == -1) meeting = barrier;
            if (meeting != barrier) return false;
            any |= !fibre.done;
        }
    }
    return true;
}

// A kernel that lacks a barrier may take what it finds for an index.
inline void at_wild_address(int) { siglongjmp(escape, 1); }

// Returns 0; 1 where threads met at different barriers, 3 for a wild address.
// Order 0 runs the threads upwards, 1 downwards, another shuffles them at each barrier.
inline int launch(
    unsigned blocks, unsigned threads, std::size_t bytes, int order, std::function<void()> call) {
    body = std::move(call);
    if (fibres.size() != threads) fibres = std::vector<Fibre>(threads);
    std::vector<unsigned> turns(threads);
    std::iota(turns.begin(), turns.end(), 0u);
    if (order == 1) std::reverse(turns.begin(), turns.end());
    std::mt19937 random(order);
    size.x = threads;
    grid.x = blocks;
    void* memory = nullptr;
    if (posix_memalign(&memory, 16, std::max<std::size_t>(bytes, 1))) return 3;
    shared = static_cast<float4*>(memory);
    struct sigaction usual, ours = {};
    ours.sa_handler = at_wild_address;
    sigaction(SIGSEGV, &ours, &usual);
    volatile int answer = 0;
    if (sigsetjmp(escape, 1)) {
        answer = 3;
    } else {
        for (unsigned b = 0; b < blocks && !answer; b++) {
            block.x = b;
            std::memset(static_cast<void*>(shared), 0xff, bytes);
            if (!run_block(turns, order, random)) answer = 1;
        }
    }
    sigaction(SIGSEGV, &usual, nullptr);
    std::free(shared);
    body = nullptr;  // its code may be gone with its library when the process ends
    return answer;
}

// Calls a kernel with the arguments that cuLaunchKernel would get.
template <class... A, std::size_t... I>
void call(void (*kernel)(A...), void** arguments, std::index_sequence<I...>) {
    kernel(*static_cast<std::remove_reference_t<A>*>(arguments[I])...);
}

template <class... A>
std::function<void()> bound(void (*kernel)(A...), void** arguments) {
    return [=] { call(kernel, arguments, std::index_sequence_for<A...>{}); };
}

}  // namespace emulated

inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __popcll(unsigned long long bits) { return __builtin_popcountll(bits); }

template <class T>
T added(T* to, T number) {
    const T old = *to;
    *to += number;
    return old;
}

inline float atomicAdd(float* to, float number) { return added(to, number); }
inline double atomicAdd(double* to, double number) { return added(to, number); }
inline int atomicAdd(int* to, int number) { return added(to, number); }
inline unsigned atomicAdd(unsigned* to, unsigned number) { return added(to, number); }
inline unsigned long long atomicAdd(unsigned long long* to, unsigned long long number) {
    return added(to, number);
}

// Exchanges of a warp, which is all of a block here: between two barriers each thread writes a slot
// of its own and reads others.
namespace emulated {

template <class T, class Read>
auto exchanged(T own, const Read& read) {
    static T slots[32];
    static_assert(sizeof(T) <= 8);
    slots[now->thread.x] = own;
    wait(-1);
    const auto result = read(slots);
    wait(-2);
    return result;
}

}  // namespace emulated

inline unsigned __ballot_sync(unsigned, int holds) {
    return emulated::exchanged(holds, [](const int* slots) {
        unsigned bits = 0;
        for (unsigned t = 0; t < emulated::size.x; t++) bits |= (slots[t] != 0) << t;
        return bits;
    });
}

inline int __any_sync(unsigned all, int holds) { return __ballot_sync(all, holds) != 0; }

template <class T>
T __shfl_sync(unsigned, T own, int from) {
    return emulated::exchanged(own, [from](const T* slots) { return slots[from]; });
}

template <class T>
T __shfl_down_sync(unsigned all, T own, unsigned away) {
    const unsigned from = threadIdx.x + away;
    return __shfl_sync(all, own, (int)(from < emulated::size.x ? from : threadIdx.x));
}

inline float __int_as_float(int bits) {
    float number;
    std::memcpy(&number, &bits, sizeof number);
    return number;
}

inline double __longlong_as_double(long long bits) {
    double number;
    std::memcpy(&number, &bits, sizeof number);
    return number;
}

inline int __ffs(unsigned bits) { return __builtin_ffs((int)bits); }
