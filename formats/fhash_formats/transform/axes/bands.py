"""The bands of a transformed tile in coding order, and the earlier bands that each refers to.

A band is a box of coefficients. Bands of the same kind share statistics. A band refers to at most
four earlier bands: its spatial parent, the bands before it along t and along z, and a sibling of
the same plane. The coder knows nothing else of the transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.transform.axes.spec import AXES, AxisTransform, TransformSpec
from fhash_formats.transform.axes.weights import band_lengths
from fhash_formats.transform.entropy.table import COLUMNS, NO_REFERENCE, Table

__all__ = ["band_table"]

_KLT_PLANE = 13
"""Kind of a plane that is spanned by a basis of the data."""
_LEVELS_APART = 4
"""Finest levels that have kinds of their own; coarser levels share the last one's."""


class Span(NamedTuple):
    """A band along one axis.

    Attributes:
        level: 0 for the low band or the whole axis, 1 for the finest high band, negative for the
            low half of a coupled level.
        start: first coefficient.
        stop: coefficient after the last one.
    """

    level: int
    start: int
    stop: int


class _Key(NamedTuple):
    """The place of a band: its number along t and along z, its levels along y and x."""

    t: int
    z: int
    y: int
    x: int


Rows = dict[_Key, int]
"""Row in the table of each earlier band."""


def band_table(spec: TransformSpec, shape: Sequence[int]) -> Table:
    """The bands of a transform on tiles of a shape (t, z, y, x); read-only.

    The native coder trusts the table: every band lies within the shape. Raises InputError for a
    basis of another length than its axis.
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
    """The bands along an axis, coarsest first, without empty ones."""
    if axis.basis is not None:
        return (Span(0, 0, axis.basis.rank),) if axis.basis.rank else ()
    lengths = band_lengths(length, axis.depth)
    low = Span(0, 0, lengths[-1])
    high = [Span(level, lengths[level], lengths[level - 1]) for level in range(axis.depth, 0, -1)]
    return tuple(span for span in (low, *high) if span.start < span.stop)


@lru_cache(maxsize=256)
def _table(
    t: tuple[Span, ...],
    z: tuple[Span, ...],
    y: tuple[Span, ...],
    x: tuple[Span, ...],
    coupled: bool,
    klt: bool,
) -> Table:
    """The table of all bands; coupled: of y and x. klt: whether a basis lies along y or x."""
    rows_of: Rows = {}
    rows: list[list[int]] = []
    for plane in _coupled_planes(y, x) if coupled else [list(product(y, x))]:
        for (t_number, t_span), (z_number, z_span) in product(enumerate(t), enumerate(z)):
            for y_span, x_span in plane:
                key = _Key(t_number, z_number, y_span.level, x_span.level)
                spans = (t_span, z_span, y_span, x_span)
                kind = 4 * _plane_kind(key, klt) + 2 * (t_span.level > 0) + (z_span.level > 0)
                rows.append(
                    [
                        *(span.start for span in spans),
                        *(span.stop for span in spans),
                        kind,
                        *(
                            _coupled_parent(rows_of, key)
                            if coupled
                            else _parent(rows_of, key, y, x)
                        ),
                        *_before_along_t(rows_of, key),
                        *_before_along_z(rows_of, key),
                        *(_sibling(rows_of, key) if coupled else NO_REFERENCE),
                    ]
                )
                rows_of[key] = len(rows) - 1
    table = np.array(rows, dtype=np.int32).reshape(-1, COLUMNS)
    table.setflags(write=False)
    return table


def _coupled_planes(y: tuple[Span, ...], x: tuple[Span, ...]) -> list[list[tuple[Span, Span]]]:
    """The bands (y, x) of a coupled plane, in groups.

    The first group is the low-low band. Each level from the coarsest on follows with low-high,
    high-low and high-high. The low half of a level has the level's negative number.
    """
    by_y, by_x = {span.level: span for span in y}, {span.level: span for span in x}
    planes = [[(by_y[0], by_x[0])]]
    for level in range(max([*by_y, *by_x]), 0, -1):
        low_y, low_x = (
            Span(-level, 0, _low_end(by_y, level)),
            Span(-level, 0, _low_end(by_x, level)),
        )
        plane = []
        if level in by_x:
            plane.append((low_y, by_x[level]))
        if level in by_y:
            plane.append((by_y[level], low_x))
        if level in by_x and level in by_y:
            plane.append((by_y[level], by_x[level]))
        planes.append(plane)
    return planes


def _low_end(spans: dict[int, Span], level: int) -> int:
    """The end of the low half of a level.

    It is where the level's high band begins, or where the axis ends at a level without one.
    """
    if level in spans:
        return spans[level].start
    return max(span.stop for span in spans.values() if span.level >= level or span.level == 0)


def _plane_kind(key: _Key, klt: bool) -> int:
    """0 for low-low, 1 to 12 by level and orientation, 13 where a basis spans the plane."""
    if klt:
        return _KLT_PLANE
    level = max(key.y, key.x)
    if level <= 0:
        return 0
    orientation = 2 if key.y > 0 and key.x > 0 else 1 if key.y > 0 else 0
    return 1 + 3 * (min(level, _LEVELS_APART) - 1) + orientation


def _reference(rows_of: Rows, key: _Key, halvings: tuple[int, int, int, int]) -> list[int]:
    """The columns of a reference to an earlier band.

    halvings: along (t, z, y, x), how often an index is halved on the way to that band.
    """
    return [rows_of[key], *halvings] if key in rows_of else NO_REFERENCE


def _before_along_t(rows_of: Rows, key: _Key) -> list[int]:
    """The next coarser band along t."""
    return _reference(rows_of, key._replace(t=key.t - 1), (int(key.t > 1), 0, 0, 0))


def _before_along_z(rows_of: Rows, key: _Key) -> list[int]:
    """The next coarser band along z."""
    return _reference(rows_of, key._replace(z=key.z - 1), (0, int(key.z > 1), 0, 0))


def _coupled_parent(rows_of: Rows, key: _Key) -> list[int]:
    """The band of the same orientation one level up, or the low-low band where there is none."""
    level = max(key.y, key.x)
    if level <= 0:
        return NO_REFERENCE
    coarser = key._replace(
        y=level + 1 if key.y > 0 else -(level + 1), x=level + 1 if key.x > 0 else -(level + 1)
    )
    if coarser in rows_of:
        return _reference(rows_of, coarser, (0, 0, 1, 1))
    return _reference(rows_of, key._replace(y=0, x=0), (0, 0, 0, 0))


def _parent(rows_of: Rows, key: _Key, y: tuple[Span, ...], x: tuple[Span, ...]) -> list[int]:
    """The next coarser band along y, or along x where the band is the coarsest along y."""
    levels_y, levels_x = [span.level for span in y], [span.level for span in x]
    y_number, x_number = levels_y.index(key.y), levels_x.index(key.x)
    if y_number:
        coarser = key._replace(y=levels_y[y_number - 1])
        return _reference(rows_of, coarser, (0, 0, int(y_number > 1), 0))
    if x_number:
        coarser = key._replace(x=levels_x[x_number - 1])
        return _reference(rows_of, coarser, (0, 0, 0, int(x_number > 1)))
    return NO_REFERENCE


def _sibling(rows_of: Rows, key: _Key) -> list[int]:
    """The band of the same level that a band of a coupled plane refers to.

    High-low refers to low-high, and high-high to high-low.
    """
    if max(key.y, key.x) <= 0 or key.y < 0:
        return NO_REFERENCE
    sibling = key._replace(x=-key.y) if key.x > 0 else key._replace(y=key.x, x=-key.x)
    return _reference(rows_of, sibling, (0, 0, 0, 0))
