// The kernel of the marcher: fhash_codec/native/march_draw.hpp with a thread for each ray. A warp
// marches 8 x 4 pixels in step.
//
// rendering/march_device.py puts constants in front: FHASH_FLAGS, and FHASH_NO_... for each part of
// the input that is absent, so that nothing of it is compiled.
#define FHASH_CUDA
#include "codec.h"

struct FhashInput : FhashMarch {
#if defined(FHASH_NO_SURFACES)
    static constexpr int64_t surfaces = 0;
#endif
#if defined(FHASH_NO_NETWORK)
    static constexpr const void* network = nullptr;
#endif
#if defined(FHASH_NO_READY)
    static constexpr const int32_t* ready = nullptr;
#endif
#if defined(FHASH_NO_SMOOTH)
    static constexpr const float* smooth = nullptr;
#endif
#if defined(FHASH_NO_CENTRAL)
    static constexpr int64_t central = 0;
#endif
#if defined(FHASH_NO_NORMAL)
    static constexpr float* normal = nullptr;
#endif

    // Mark what a brick's samples read as missing, in the array that the host put in place of its
    // function; the ray ends.
    __device__ int64_t fetch(int64_t brick) const {
        reinterpret_cast<int32_t*>(FhashMarch::fetch)[brick] = 1;
        return 1;
    }
};

#include "march_draw.hpp"

#if defined(FHASH_NO_NETWORK)
namespace {
float network_at(const FhashInput&, double, double, double, float*) { return NONE; }
}  // namespace
#else
#include "records.h"
#include "levels.cuh"
#include "march_network.cuh"
#endif

// Draw the warps from first to before stop into the pictures of `march`, in rows of warps.
// counters, added to: as those of `fhash_march`.
extern "C" __global__ void __launch_bounds__(FHASH_THREADS) march_pixels(
    const __grid_constant__ FhashInput march, unsigned long long* counters, long long first,
    long long stop) {
    const long long across = (march.width + 7) / 8;
    const long long warp = first + (blockIdx.x * (long long)FHASH_THREADS + threadIdx.x) / 32;
    if (warp >= stop) return;
    const int lane = threadIdx.x % 32;
    const long long x = warp % across * 8 + lane % 8, y = warp / across * 4 + lane / 8;
    if (x < march.width && y < march.height) {
        const long long pixel = y * march.width + x;
        for (int c = 0; c < 4; c++) march.out[4 * pixel + c] = 0;
        if (march.depth) march.depth[pixel] = FAR;
        for (int c = 0; march.normal && c < 3; c++) march.normal[3 * pixel + c] = 0;
    }
    Counters counted;
    Packet packet(march);
    for (long long ray = 0; ray < march.rays * march.rays; ray++) {
        const int met = packet.aim(x, y, ray);
        if (!of_any(met)) continue;
        counted.rays += met;
        packet.march(counted);
        packet.write(x, y);
    }
    if (lane) counted.passes = 0;  // of the warp
    const int64_t all[] = {counted.rays,      counted.passes, counted.samples,
                           counted.gradients, counted.skips,  counted.evaluations};
    for (int n = 0; n < 6; n++) {
        long long sum = all[n];
        for (int away = 16; away; away /= 2) sum += __shfl_down_sync(0xffffffffu, sum, away);
        if (!lane && sum) atomicAdd(counters + n, (unsigned long long)sum);
    }
}

// The table of a level at a time between two: `share` of the second.
extern "C" __global__ void mix_tables(
    const float* one, const float* other, float share, float* out, long long count) {
    const long long step = (long long)gridDim.x * blockDim.x;
    for (long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x; i < count; i += step)
        out[i] = one[i] + share * (other[i] - one[i]);
}
