"""States of two quantisers that take turns (FORMAT.md, Two quantisers), as the coder follows them.

The class of a state, 0 or 1, is its lowest bit: it names the quantiser of the next integer.
native/coder_contexts.hpp has the same table.
"""

from __future__ import annotations

from fhash_formats.transform.entropy.mixing_portable import Sequence

__all__ = ["AFTER", "MISPLACED", "NO_TRELLIS", "after_zeros"]

AFTER = (0, 2, 5, 7, 1, 3, 6, 4, 2, 0, 4, 6, 3, 1, 7, 5)
"""State that follows; entry 2 s + 1 for an odd index in state s, entry 2 s for an even one."""
NO_TRELLIS = -3
"""Code of a run that met an integer which its quantiser does not have."""
MISPLACED = "an integer is not one of the quantiser of its place"
"""Message for such an integer."""


def after_zeros(state: int, n: int, after: Sequence) -> int:
    """The state after n zeros, which repeat after at most four."""
    for _ in range(n & 3):
        state = after[2 * state]
    return state
