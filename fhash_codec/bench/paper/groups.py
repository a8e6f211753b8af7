"""Cells that differ in their seed alone, joined, and medians over them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from fhash_codec.bench.paper.cell import Cell, Point
from fhash_codec.bench.paper.printed import ENCODINGS, FEATURES, SETS
from fhash_codec.bench.paper.protocols import PROTOCOLS
from fhash_codec.bench.paper.table import Spread

__all__ = ["Group", "by_data", "groups", "of_protocol", "within"]


@dataclass(frozen=True)
class Group:
    """Cells that differ in their seed alone.

    Attributes:
        protocol, data_set, feature, encoding: as of a cell.
        cells: at least one.
    """

    protocol: str
    data_set: str
    feature: str
    encoding: str
    cells: tuple[Cell, ...]

    def spread(self, figure: Callable[[Cell], float | None], digits: int = 3) -> Spread | None:
        """A figure over the seeds that have it."""
        found = [figure(cell) for cell in self.cells]
        return Spread.of([one for one in found if one is not None], digits)

    def reached(self, decibels: float, quality: str, clock: str) -> Spread:
        """Time to a quality, by a field of a point; NR counts as infinitely long."""
        points = (cell.reached(decibels, quality) for cell in self.cells)
        found = Spread.of([None if point is None else getattr(point, clock) for point in points])
        assert found is not None
        return found

    def after(self, epochs: int, figure: str, digits: int = 3) -> Spread | None:
        """A field of the last point within some epochs."""
        return self.spread(lambda cell: getattr(within(cell, epochs), figure), digits)

    @property
    def first(self) -> Cell:
        """The cell of the smallest seed."""
        return self.cells[0]


def groups(cells: Iterable[Cell]) -> list[Group]:
    """Join cells by protocol, data set, feature and encoding, in the paper's order."""
    found: dict[tuple[str, str, str, str], list[Cell]] = {}
    for cell in cells:
        key = cell.protocol, cell.data_set, cell.feature, cell.encoding
        found.setdefault(key, []).append(cell)
    orders: list[Sequence[str]] = [
        PROTOCOLS, tuple(SETS), FEATURES, tuple(ENCODINGS),
    ]  # fmt: skip

    def rank(key: tuple[str, ...]) -> list[tuple[int, str]]:
        """Place of each name in its order; unknown names come last, by the alphabet."""
        return [
            (order.index(name) if name in order else len(order), name)
            for name, order in zip(key, orders, strict=True)
        ]

    return [
        Group(*key, tuple(sorted(found[key], key=lambda cell: cell.seed)))
        for key in sorted(found, key=rank)
    ]


def of_protocol(grouped: Sequence[Group], protocol: str) -> list[Group]:
    """Groups of a protocol; beside released F-Hash stand the other encodings as published."""
    return [
        group
        for group in grouped
        if group.protocol == protocol
        or ((protocol, group.protocol) == ("released", "published") and group.encoding != "fhash")
    ]


def by_data(grouped: Sequence[Group]) -> list[tuple[tuple[str, str], dict[str, Group]]]:
    """Groups of one protocol by (data set, feature), then by encoding."""
    found: dict[tuple[str, str], dict[str, Group]] = {}
    for group in grouped:
        found.setdefault((group.data_set, group.feature), {})[group.encoding] = group
    return list(found.items())


def within(cell: Cell, epochs: int) -> Point:
    """The last point of a curve within some epochs."""
    return max(
        (point for point in cell.curve if point.epoch <= epochs), key=lambda point: point.epoch
    )
