// The instruction paths of this machine, and what it can do at most on one of them: the arithmetic
// of fused multiply-adds in registers, and copies of memory. Benchmarks hold kernels to these.
#include "network.h"
#include "vector.hpp"

#if defined(FHASH_VECTORS)
namespace {

// A constraint of a register that holds a vector.
#if defined(__x86_64__) || defined(__i386__)
#define REGISTER "+v"
#elif defined(__aarch64__)
#define REGISTER "+w"
#else
#define REGISTER "+m"
#endif

// Chains of multiply-adds that do not wait for each other: more than latency times ports.
constexpr int CHAINS = 12;

// A function for each path, not a template: Clang holds the operands of assembly to the target of
// the function in which they are written. The compiler may know nothing of the numbers, and must
// keep each round.
#define FMA(TARGET, NAME, P)                                                                       \
    TARGET std::int64_t NAME(std::int64_t rounds) {                                                \
        P::F chain[CHAINS], factor = P::F{} + 0.999f, summand = P::F{} + 0.001f;                   \
        FHASH_UNROLLED for (int c = 0; c < CHAINS; c++) chain[c] = P::F{} + (1.0f + c);            \
        asm volatile("" : REGISTER(factor), REGISTER(summand));                                    \
        for (std::int64_t round = 0; round < rounds; round++) {                                    \
            FHASH_UNROLLED for (int c = 0; c < CHAINS; c++)                                        \
                chain[c] = chain[c] * factor + summand;                                            \
            FHASH_UNROLLED for (int c = 0; c < CHAINS; c++) asm volatile("" : REGISTER(chain[c])); \
        }                                                                                          \
        return 2 * CHAINS * P::N * rounds;                                                         \
    }
FMA(, fma_v1, Path1)
#if defined(FHASH_TARGETS)
FMA(__attribute__((target(FHASH_FEATURES_3))), fma_v3, Path2)
FMA(__attribute__((target(FHASH_FEATURES_4))), fma_v4, Path4)
#endif

std::int64_t fma(std::int64_t path, std::int64_t rounds) {
#if defined(FHASH_TARGETS)
    if (path == FHASH_PATH_V4) return fma_v4(rounds);
    if (path == FHASH_PATH_V3) return fma_v3(rounds);
#endif
    return fma_v1(rounds);
}

}  // namespace
#endif

// The paths of this machine as bits: 1 the baseline, 2 x86-64-v3, 4 x86-64-v4.
FHASH_EXPORT int64_t fhash_network_paths() { return machine_paths(); }

// Do `rounds` rounds of multiply-adds in registers on a path. Returns the number of floating-point
// operations that were done, two for each multiply-add, or FHASH_NO_PATH.
FHASH_EXPORT int64_t fhash_network_fma(int64_t path, int64_t rounds) {
    if (!has_path(path)) return FHASH_NO_PATH;
#if defined(FHASH_VECTORS)
    return fma(path, rounds);
#else
    return FHASH_NO_PATH;
#endif
}

// Copy memory. Returns the number of bytes moved: those read and those written.
FHASH_EXPORT int64_t fhash_network_copy(void* to, const void* from, int64_t bytes) {
    std::memcpy(to, from, (std::size_t)bytes);
    return 2 * bytes;
}
