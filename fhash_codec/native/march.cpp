// Ray marching on a processor: packets of 4 x 4 rays through a frame of values.
//
// Sample k of a ray lies (k + 0.5) steps behind the place where the ray enters the drawn box, or k
// steps and a share of the ray's own. The last step is as long as the rest of the path, so that the
// steps fill the path through the box exactly. Values are trilinear in a cell. The gradient is that
// of the cell, exact and nearly free, or by central differences. A cell with a vertex without a
// value (NaN) is not seen.
//
// Compositing is front to back. Within BLOCK samples the opacity is summed in float32, and not the
// transparency: 1 - 1e-9 is 1 in float32. Blocks are joined in float64, so that thin fog does not
// vanish in rounding. The code is built for speed, not for the same bits everywhere: pictures agree
// with those of fhash_codec/rendering/stream_march.py within rounding.
#define FHASH_MARCH fhash_march_v1
#include "march_draw.hpp"

// Add the rays of tiles first to stop (of 16 x 16 pixels, in rows) to the pictures of `march`,
// which begin as zeros (depth: infinity). flags: what is drawn (march_packet.hpp). counters, added
// to: rays, passes, samples, gradients, skips, evaluations. Returns -1 for an input that cannot be.
FHASH_EXPORT int64_t fhash_march(const FhashMarch* march, int64_t flags, int64_t first,
                                 int64_t stop, int64_t* counters) {
    const FhashMarch& m = *march;
    if (m.surfaces < 0 || m.surfaces > FHASH_SURFACES) return -1;
    if (m.entries < 2 || m.rays < 1 || !(m.step > 0)) return -1;
    if ((m.cells && !m.distance) || (m.ready && !m.fetch)) return -1;
    if (m.planes < 0 || m.planes > FHASH_PLANES) return -1;
    if ((flags & GRADED) && !m.grading) return -1;
    FhashTiles* tiles = fhash_march_v1;
#if defined(FHASH_TARGETS)
    const unsigned has = fhash_instructions();
    if (m.path < 2 && (has & FHASH_HAS_V3)) tiles = fhash_march_v3;
    if (m.path < 1 && (has & FHASH_HAS_V4) && m.shape[2] > 1) tiles = fhash_march_v4;
#endif
    tiles(m, (int)flags, first, stop, counters);
    return 0;
}
