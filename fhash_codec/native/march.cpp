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
#if defined(__GNUC__) && !defined(__clang__)
// It makes branches of the loops below, and loops with branches are not vectorised.
#pragma GCC optimize("no-tree-pre")
#endif
#include "march_draw.hpp"

namespace {

FHASH_KERNEL(plain, 0)
FHASH_KERNEL(shaded, SHADED)
FHASH_KERNEL(lit, LIT)
FHASH_KERNEL(shaded_lit, SHADED | LIT)
FHASH_KERNEL(central, SHADED | CENTRAL)
FHASH_KERNEL(central_lit, SHADED | CENTRAL | LIT)
FHASH_KERNEL(maximum, MAXIMUM)

}  // namespace

// Add the rays of tiles first to stop (of 16 x 16 pixels, in rows) to the pictures of `march`,
// which begin as zeros (depth: infinity). flags: SHADED, LIT, MAXIMUM, or those of
// march_effects.cpp. counters, added to: rays, passes, samples, gradients, skips, evaluations.
// Returns -1 for an input that cannot be.
FHASH_EXPORT int64_t fhash_march(const FhashMarch* march, int64_t flags, int64_t first,
                                 int64_t stop, int64_t* counters) {
    const FhashMarch& m = *march;
    if (m.surfaces < 0 || m.surfaces > FHASH_SURFACES) return -1;
    if (m.entries < 2 || m.rays < 1 || !(m.step > 0)) return -1;
    if (m.cells && !m.distance) return -1;
    if (m.planes < 0 || m.planes > FHASH_PLANES) return -1;
    if (flags & (MINIMUM | AVERAGE | ATTENUATED | GRADED))
        return fhash_march_effect(m, flags, first, stop, counters);
    Counters counted;
    const bool differences = (flags & SHADED) && (m.central || m.smooth);
    if (flags & MAXIMUM) maximum(m, first, stop, counted);
    else if (differences && (flags & LIT)) central_lit(m, first, stop, counted);
    else if (differences) central(m, first, stop, counted);
    else if ((flags & SHADED) && (flags & LIT)) shaded_lit(m, first, stop, counted);
    else if (flags & LIT) lit(m, first, stop, counted);
    else if (flags & SHADED) shaded(m, first, stop, counted);
    else plain(m, first, stop, counted);
    counted.add_to(counters);
    return 0;
}
