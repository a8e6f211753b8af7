"""The bands of a transformed tile, in the order in which they are coded, and what each may look at.

A band is a box of coefficients. It is of a kind, by which statistics are shared, and refers to at most four bands before it: its spatial
parent, the bands before it along t and along z, and a sibling of the same plane. The coder knows nothing else of the transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.transform.axes.spec import AXES, AxisTransform, TransformSpec
from fhash_formats.transform.entropy.table import COLUMNS, Table
from fhash_formats.transform.entropy.table import NO_REFERENCE as _NONE

__all__ = ["band_table"]

_KLT_PLANE = 13

Span = tuple[int, int, int]
"""(level, start, stop): level 0 is the low band or the whole axis, 1 the finest high band."""


def band_table(spec: TransformSpec, shape: Sequence[int]) -> Table:
    """The table of a transform on tiles of a shape (t, z, y, x); raises InputError for a basis of another length.

    The native coder believes it: every band lies within the shape.
    """
    t, z, y, x = spec.axes
    for name, axis, length in zip(AXES, spec.axes, shape, strict=True):
        if axis.basis is not None and axis.basis.n != length:
            raise InputError(
                f"the basis along {name} is for {axis.basis.n} vertices, the tile has {length}"
            )
    return _table(
        _spans(t, shape[0]),
        _spans(z, shape[1]),
        _spans(y, shape[2]),
        _spans(x, shape[3]),
        spec.coupled,
        y.kind == "klt" or x.kind == "klt",
    )


def _spans(axis: AxisTransform, length: int) -> tuple[Span, ...]:
    """Bands along an axis, the coarsest first."""
    if axis.basis is not None:
        return ((0, 0, axis.basis.rank),) if axis.basis.rank else ()
    lengths = [length]
    for _ in range(axis.depth):
        lengths.append((lengths[-1] + 1) // 2)
    spans = [(0, 0, lengths[-1])]
    spans += [(level, lengths[level], lengths[level - 1]) for level in range(axis.depth, 0, -1)]
    return tuple(span for span in spans if span[1] < span[2])


@lru_cache(maxsize=256)
def _table(
    t: tuple[Span, ...],
    z: tuple[Span, ...],
    y: tuple[Span, ...],
    x: tuple[Span, ...],
    coupled: bool,
    klt: bool,
) -> Table:
    known: dict[tuple[int, int, int, int], int] = {}
    rows: list[list[int]] = []
    for plane in _coupled_planes(y, x) if coupled else [list(product(y, x))]:
        for (ti, ts), (zi, zs) in product(enumerate(t), enumerate(z)):
            for ys, xs in plane:
                key = (ti, zi, ys[0], xs[0])
                kind = 4 * _plane_kind(ys[0], xs[0], klt) + 2 * (ts[0] > 0) + (zs[0] > 0)
                row = [ts[1], zs[1], ys[1], xs[1], ts[2], zs[2], ys[2], xs[2], kind]
                row += _parent(known, key, y, x, coupled)
                row += _reference(known, (ti - 1, zi, ys[0], xs[0]), (int(ti > 1), 0, 0, 0))
                row += _reference(known, (ti, zi - 1, ys[0], xs[0]), (0, int(zi > 1), 0, 0))
                row += _sibling(known, key, coupled)
                known[key] = len(rows)
                rows.append(row)
    table = np.array(rows, dtype=np.int32).reshape(-1, COLUMNS)
    table.setflags(write=False)
    return table


def _coupled_planes(y: tuple[Span, ...], x: tuple[Span, ...]) -> list[list[tuple[Span, Span]]]:
    """Low-low, then from the coarsest level on: low-high, high-low, high-high, the low one reaching as far as that level's."""
    by_y, by_x = {span[0]: span for span in y}, {span[0]: span for span in x}
    planes = [[(by_y[0], by_x[0])]]
    for level in range(max([*by_y, *by_x]), 0, -1):
        # At this level the low quadrant ends where the level's high band begins, or with the axis where it has none.
        low_y, low_x = (
            (
                level,
                0,
                spans[level][1]
                if level in spans
                else max(span[2] for span in spans.values() if span[0] >= level or span[0] == 0),
            )
            for spans in (by_y, by_x)
        )
        plane = []
        if level in by_x:
            plane.append(((-level, *low_y[1:]), by_x[level]))
        if level in by_y:
            plane.append((by_y[level], (-level, *low_x[1:])))
        if level in by_x and level in by_y:
            plane.append((by_y[level], by_x[level]))
        planes.append(plane)
    return planes


def _plane_kind(y: int, x: int, klt: bool) -> int:
    """0 low-low, 1 to 12 by level and orientation, 13 where the data's own basis spans the plane."""
    if klt:
        return _KLT_PLANE
    level = max(y, x)
    return (
        0
        if level <= 0
        else 1 + 3 * min(level - 1, 3) + (2 if y > 0 and x > 0 else 1 if y > 0 else 0)
    )


def _reference(
    known: dict[tuple[int, int, int, int], int],
    key: tuple[int, int, int, int],
    shift: tuple[int, ...],
) -> list[int]:
    return [known[key], *shift] if key in known else _NONE


def _parent(
    known: dict[tuple[int, int, int, int], int],
    key: tuple[int, int, int, int],
    y: tuple[Span, ...],
    x: tuple[Span, ...],
    coupled: bool,
) -> list[int]:
    ti, zi, ly, lx = key
    if coupled:
        level = max(ly, lx)
        if level <= 0:
            return _NONE
        coarser = [
            (ti, zi, (level + 1) * (1 if ly > 0 else -1), (level + 1) * (1 if lx > 0 else -1))
        ]
        found = _reference(known, coarser[0], (0, 0, 1, 1))
        return found if found[0] >= 0 else _reference(known, (ti, zi, 0, 0), (0, 0, 0, 0))
    levels_y, levels_x = [span[0] for span in y], [span[0] for span in x]
    at_y, at_x = levels_y.index(ly), levels_x.index(lx)
    if at_y:
        return _reference(known, (ti, zi, levels_y[at_y - 1], lx), (0, 0, int(at_y > 1), 0))
    return (
        _reference(known, (ti, zi, ly, levels_x[at_x - 1]), (0, 0, 0, int(at_x > 1)))
        if at_x
        else _NONE
    )


def _sibling(
    known: dict[tuple[int, int, int, int], int], key: tuple[int, int, int, int], coupled: bool
) -> list[int]:
    ti, zi, ly, lx = key
    if not coupled or max(ly, lx) <= 0 or ly < 0:
        return _NONE
    # high-low looks at low-high, high-high at high-low.
    return _reference(known, (ti, zi, ly, -ly) if lx > 0 else (ti, zi, lx, -lx), (0, 0, 0, 0))
