// Kernels of the rarer effects, apart from march.cpp so that both compile side by side: projections
// other than the maximum, and opacity by gradient.
#if defined(__GNUC__) && !defined(__clang__)
// As in march.cpp.
#pragma GCC optimize("no-tree-pre")
#endif
#include "march_draw.hpp"

namespace {

FHASH_KERNEL(minimum, MAXIMUM | MINIMUM)
FHASH_KERNEL(average, AVERAGE)
FHASH_KERNEL(attenuated, ATTENUATED)
FHASH_KERNEL(graded, SHADED | GRADED)
FHASH_KERNEL(graded_lit, SHADED | GRADED | LIT)

}  // namespace

int64_t fhash_march_effect(const FhashMarch& m, int64_t flags, int64_t first, int64_t stop,
                           int64_t* counters) {
    Counters counted;
    if (flags & MINIMUM) minimum(m, first, stop, counted);
    else if (flags & AVERAGE) average(m, first, stop, counted);
    else if (flags & ATTENUATED) attenuated(m, first, stop, counted);
    else if (!m.grading) return -1;
    else if (flags & LIT) graded_lit(m, first, stop, counted);
    else graded(m, first, stop, counted);
    counted.add_to(counters);
    return 0;
}
