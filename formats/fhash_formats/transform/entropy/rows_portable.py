"""Rows of a tile and the rows before them, for the portable coders of masks and labels.

This is the twin of native/rows.hpp.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["PADDING", "SEGMENT", "Rows", "common_state", "rows_around"]

SEGMENT = 16
"""Vertices of a row that share a flag."""
PADDING = 2
"""Entries at both ends of a row that stand for vertices that do not exist."""


class Rows(NamedTuple):
    """Places where the rows around a row begin, in entries that are padded.

    They are `row` itself, `north` and `north2` before it along y, `below` and `below2` along z,
    `back` and `back2` along t. A suffix moves on: `_n` and `_s` by -1 and +1 along y, `_b` and `_f`
    by -1 and +1 along z. The first row of the entries stands for rows that do not exist.
    """

    row: int
    north: int
    north2: int
    below: int
    below2: int
    below_n: int
    below_s: int
    back: int
    back2: int
    back_n: int
    back_s: int
    back_b: int
    back_f: int


def rows_around(t: int, z: int, y: int, r: int, shape: tuple[int, int, int, int]) -> Rows:
    """The rows around the row (t, z, y), whose number is r."""
    n1, n2, n3 = shape[1], shape[2], shape[3]
    m2 = n3 + 2 * PADDING
    m1 = m2 * n2
    m0 = m1 * n1
    row = (r + 1) * m2 + PADDING
    return Rows(
        row,
        row - m2 if y > 0 else PADDING,
        row - 2 * m2 if y > 1 else PADDING,
        row - m1 if z > 0 else PADDING,
        row - 2 * m1 if z > 1 else PADDING,
        row - m1 - m2 if z > 0 and y > 0 else PADDING,
        row - m1 + m2 if z > 0 and y + 1 < n2 else PADDING,
        row - m0 if t > 0 else PADDING,
        row - 2 * m0 if t > 1 else PADDING,
        row - m0 - m2 if t > 0 and y > 0 else PADDING,
        row - m0 + m2 if t > 0 and y + 1 < n2 else PADDING,
        row - m0 - m1 if t > 0 and z > 0 else PADDING,
        row - m0 + m1 if t > 0 and z + 1 < n1 else PADDING,
    )


def common_state(states: tuple[int, int, int, int], nothing: int, mixed: int) -> tuple[int, int]:
    """State that segments have, as far as they exist; and how many exist.

    The state is `nothing` where none exists and `mixed` where they differ.
    """
    same, existing = nothing, 0
    for state in states:
        if state == nothing:
            continue
        existing += 1
        same = state if same in (nothing, state) else mixed
    return same, existing
