"""Choice of the transform of a trained table, by coding its fullest tile with each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Protocol

from fhash_codec.compact.tiles import Coding, Outcome
from fhash_codec.compact.transform import NONE, Bases, TileSample, in_plane
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import Shape, TileSettings

PLANE_WAVELETS = (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2))
"""Kinds and depths tried along y and x.

5/3 wins under tight bounds alone, and is never much better at another depth.
"""
LINE_WAVELETS = (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1))
"""Kinds and depths tried along t and along z."""
ERROR_PRICE = 0.8
"""Squared error in squared steps that is worth a byte."""
BASIS_TEXT = 1.03
"""Bytes in the file for each byte of a packed basis: it stands there as deflated base64."""


Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
"""Transforms along (t, z, y, x)."""


class TableTiles(TileSample, Protocol):
    """Tiles of a table on which transforms are tried."""

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the size and the error that the tiles have with each settings and coding."""
        ...


def choose_transform(sample: TableTiles, settings: TileSettings, coding: Coding) -> TileSettings:
    """Return settings with the transform of the lowest J on the sample."""
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings)
    best: tuple[float, Axes] = math.inf, settings.transform.axes
    along_z = best[1][1]
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
        _time_again(shape),
    )
    for changes in groups:
        if changes is groups[-1] and best[1][1] is along_z:
            break  # nothing is new since time was chosen
        axes = best[1]
        changed = [_changed(axes, change) for change in changes]
        trials = [
            *([axes] if math.isinf(best[0]) else []),
            *(candidate for candidate in changed if candidate != axes),
        ]
        tried = _tried(sample, settings, trials, coding)
        best = min([best, *tried], key=itemgetter(0))  # the first of several that are alike
    return replace(settings, transform=TransformSpec(axes=best[1]))


def _changed(axes: Axes, change: dict[int, AxisTransform]) -> Axes:
    """Return transforms with some replaced, by the number of the axis."""
    t, z, y, x = (change.get(number, axis) for number, axis in enumerate(axes))
    return t, z, y, x


def basis_bytes(transform: TransformSpec) -> float:
    """Return the bytes that the data's own bases take in the file."""
    packed = (axis.basis.to_bytes() for axis in transform.axes if axis.basis is not None)
    return BASIS_TEXT * sum(map(len, packed))


def _tried(
    sample: TableTiles, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[tuple[float, Axes]]:
    """Return J of each trial, beside the trial."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        bases = basis_bytes(TransformSpec(axes=axes))
        return outcome.size + bases + outcome.squares / (ERROR_PRICE * settings.step**2)

    of_trials = [replace(settings, transform=TransformSpec(axes=axes)) for axes in trials]
    outcomes = sample.run_all([(each, coding) for each in of_trials])
    return [(cost(*pair), pair[0]) for pair in zip(trials, outcomes, strict=True)]


def _plane_trials(shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along y and x."""
    y, x = shape[2:]
    for kind, depth in PLANE_WAVELETS:
        if 2 ** (depth - 1) < max(y, x):
            yield in_plane(kind, depth, shape)
    if bases.possible(y, x):
        yield {2: bases.along(2), 3: bases.along(3)}


def _time_again(shape: Shape) -> Iterator[dict[int, AxisTransform]]:
    """Yield what is tried along time once more, after the choice along z.

    Of a thin shell that moves, steps have nothing in common; beside a wavelet along z that does no
    good either, this was not seen.
    """
    if shape[0] > 1:
        yield {0: NONE}


def _line_trials(axis: int, shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along one axis."""
    length = shape[axis]
    if length == 1:
        return
    yield {axis: NONE}
    for kind, depth in LINE_WAVELETS:
        if 2 ** (depth - 1) < length:
            yield {axis: AxisTransform(kind=kind, depth=depth)}
    if bases.possible(length):
        yield {axis: bases.along(axis)}
