"""The bands of a transformed tile, in the order in which they are coded.

A wavelet of depth d along an axis makes a low band and d high bands, the coarsest first. A band of
the tile is a product of one along each axis. Where y and x have the same wavelet and depth they are
*coupled*: each level splits the low-low quarter of the plane alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

WAVELETS = ("haar", "5/3", "9/7")


@dataclass(frozen=True)
class Reference:
    """An earlier band, and how often an index along t, z, y, x is halved on the way to it."""

    band: int
    halvings: tuple[int, ...]


@dataclass(frozen=True)
class Band:
    """A box of coefficients.

    Attributes:
        low, high: first index, and one past the last, along t, z, y, x.
        kind: 0 to 63; bands of one kind share their statistics.
        references: parent, band before along t, band before along z, sibling; None without one.
    """

    low: tuple[int, ...]
    high: tuple[int, ...]
    kind: int
    references: tuple[Reference | None, ...]


Span = tuple[int, int, int]
"""Level, first and last + 1 of a band along one axis. Level 0 is the low band or the whole axis, 1
the finest high band; the low half of a coupled level has its negative number."""
Key = tuple[int, int, int, int]
"""Number of a band along t and along z, its levels along y and x."""


def lengths(n: int, depth: int) -> list[int]:
    """Lengths of the low band of n vertices after 0 to `depth` levels."""
    result = [n]
    for _ in range(depth):
        result.append((result[-1] + 1) // 2)
    return result


def single_band(shape: Sequence[int]) -> list[Band]:
    """The one band of integers that were not transformed."""
    return [Band((0, 0, 0, 0), tuple(shape), 0, (None,) * 4)]


def bands_of(axes: Sequence[Any], shape: Sequence[int]) -> list[Band]:
    """The bands of a tile; axes: an `Axis` of transform.py for each of t, z, y, x."""
    t, z, y, x = (_spans(axis, n) for axis, n in zip(axes, shape, strict=True))
    coupled = axes[2].kind in WAVELETS and axes[2][:2] == axes[3][:2]
    klt = "klt" in (axes[2].kind, axes[3].kind)
    bands: list[Band] = []
    numbers: dict[Key, int] = {}

    def reference(key: Key, *halvings: int) -> Reference | None:
        return Reference(numbers[key], halvings) if key in numbers else None

    for group in _coupled(y, x) if coupled else [list(product(y, x))]:
        for (nt, st), (nz, sz), (sy, sx) in product(enumerate(t), enumerate(z), group):
            spans, key = (st, sz, sy, sx), (nt, nz, sy[0], sx[0])
            parent = _coupled_parent(key, numbers) if coupled else _parent(key, y, x)
            references = (
                reference(*parent) if parent else None,
                reference((nt - 1, *key[1:]), int(nt > 1), 0, 0, 0),
                reference((nt, nz - 1, *key[2:]), 0, int(nz > 1), 0, 0),
                reference(_sibling(key), 0, 0, 0, 0) if coupled else None,
            )
            kind = 4 * _plane_kind(key, klt) + 2 * (st[0] > 0) + (sz[0] > 0)
            numbers[key] = len(bands)
            low, high = (tuple(span[end] for span in spans) for end in (1, 2))
            bands.append(Band(low, high, kind, references))
    return bands


def _spans(axis: Any, n: int) -> list[Span]:
    """The bands along an axis, coarsest first, without empty ones."""
    if axis.kind == "klt":
        return [(0, 0, axis.basis.shape[1])] if axis.basis.shape[1] else []
    ends = lengths(n, axis.depth)
    high = [(level, ends[level], ends[level - 1]) for level in range(axis.depth, 0, -1)]
    return [span for span in [(0, 0, ends[-1]), *high] if span[1] < span[2]]


def _coupled(y: list[Span], x: list[Span]) -> list[list[tuple[Span, Span]]]:
    """Groups of bands (y, x): low-low; then of each level low-high, high-low and high-high."""
    by_y, by_x = {span[0]: span for span in y}, {span[0]: span for span in x}
    groups = [[(by_y[0], by_x[0])]]
    for level in range(max([*by_y, *by_x]), 0, -1):
        low_y, low_x = (-level, 0, _low_end(by_y, level)), (-level, 0, _low_end(by_x, level))
        high_y, high_x = by_y.get(level), by_x.get(level)
        pairs = ((low_y, high_x), (high_y, low_x), (high_y, high_x))
        groups.append([(a, b) for a, b in pairs if a is not None and b is not None])
    return groups


def _low_end(spans: dict[int, Span], level: int) -> int:
    """End of the low half of a level, also of one that does not split this axis."""
    if level in spans:
        return spans[level][1]
    return max(span[2] for number, span in spans.items() if number >= level or number == 0)


def _plane_kind(key: Key, klt: bool) -> int:
    """0 for low-low, 1 to 12 by level (the fourth and coarser ones share) and orientation, 13."""
    y, x = key[2:]
    if klt:
        return 13
    if max(y, x) <= 0:
        return 0
    orientation = 2 if y > 0 and x > 0 else 1 if y > 0 else 0
    return 1 + 3 * (min(max(y, x), 4) - 1) + orientation


Parent = tuple[Any, ...]
"""Arguments of `reference`: a key and four halvings."""


def _coupled_parent(key: Key, numbers: dict[Key, int]) -> Parent | None:
    """The band of the same orientation one level up, or low-low where there is none."""
    level = max(key[2:])
    if level <= 0:
        return None
    y, x = (level + 1 if axis > 0 else -(level + 1) for axis in key[2:])
    coarser = (*key[:2], y, x)
    return (coarser, 0, 0, 1, 1) if coarser in numbers else ((*key[:2], 0, 0), 0, 0, 0, 0)


def _parent(key: Key, y: list[Span], x: list[Span]) -> Parent | None:
    """The next coarser band along y; along x for the coarsest along y."""
    t, z, level_y, level_x = key
    levels_y, levels_x = [span[0] for span in y], [span[0] for span in x]
    at_y, at_x = levels_y.index(level_y), levels_x.index(level_x)
    if at_y:
        return ((t, z, levels_y[at_y - 1], level_x), 0, 0, int(at_y > 1), 0)
    if at_x:
        return ((t, z, level_y, levels_x[at_x - 1]), 0, 0, 0, int(at_x > 1))
    return None


def _sibling(key: Key) -> Key:
    """Low-high for high-low, high-low for high-high, and no band (the key itself) for others."""
    t, z, y, x = key
    if max(y, x) <= 0 or y < 0:
        return key
    return (t, z, y, -y) if x > 0 else (t, z, x, -x)
