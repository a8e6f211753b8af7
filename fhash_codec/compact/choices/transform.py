"""Choice of the transform along each axis, by trial on bytes.

Candidates are coded on a sample at one step. The cost J = bytes + squared error / (0.8 step^2)
decides, so that a transform of less error for the same bytes wins as well. The plane, time and z
are decided one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.quantiser import plain_step
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.stage_clock import stage
from fhash_formats.transform.axes.basis import MAX_LENGTH, Basis, fit_basis
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

Result = TypeVar("Result")
Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
"""Transforms along (t, z, y, x)."""
Gram = npt.NDArray[np.float64]
"""Products of lines (length, length)."""
NONE = AxisTransform(kind="none")
"""Marks an axis without a transform."""
MAX_BASIS_LENGTH = 128
"""Longest axis in vertices that gets a basis of the data's own: longer factors cost too much."""
PLANE_WAVELETS = (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2))
"""Kinds and depths tried along y and x.

5/3 wins under tight bounds alone, and is never much better at another depth.
"""
LINE_WAVELETS = (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1))
"""Kinds and depths tried along t and along z."""
MATRICES_AT_ONCE = 64
"""Matrices of lines whose products are held at once."""
ERROR_PRICE = 0.8
"""Squared error in squared steps that is worth a byte."""
BASIS_TEXT = 1.03
"""Bytes in the file for each byte of a packed basis: it stands there as deflated base64."""


class TileSample(Protocol):
    """Tiles on which transforms are tried, such as a `Sample`.

    Attributes:
        tiles: the tiles, all of one shape.
        grams: products of the lines of all tiles, by axis and centre, once they were computed:
            bases for other steps are fitted to them again.
    """

    tiles: list[Tile]
    grams: dict[tuple[int, float], Gram]

    @property
    def allows_bases(self) -> bool:
        """Whether bases of the data's own may be computed."""
        ...

    def map_all(self, work: Callable[[Tile], Result]) -> Iterator[Result]:
        """Yield the results of `work` for all tiles that the sample stands for."""
        ...

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the size and the error that the tiles have with each settings and coding."""
        ...


def wavelet(kind: str, depth: int, length: int) -> AxisTransform:
    """Return a wavelet of at most this depth for an axis of `length` vertices.

    It is less deep on a short axis; an axis of one vertex gets no transform.
    """
    depth = min(depth, max(0, (length - 1).bit_length()))
    return AxisTransform(kind=kind, depth=depth) if depth else NONE


def usual_transform(shape: Shape) -> TransformSpec:
    """Return a good guess without trial: 9/7 along all axes, deepest in the plane."""
    t, z, y, x = shape
    depth = min(4, max(1, max(y, x).bit_length() - 2))
    return TransformSpec(
        axes=(wavelet("9/7", 2, t), wavelet("9/7", 2, z), *_plane("9/7", depth, y, x))
    )


def choose_transform(
    sample: TileSample, settings: TileSettings, coding: Coding, *, quick: bool = False
) -> tuple[TileSettings, float]:
    """Return settings with the transform of the lowest J on the sample, and that J.

    quick: tries only the kinds of the settings, the usual ones, and the data's own bases in the
        plane and along z.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = _Bases(sample, settings)
    if quick:
        trials = _quick_trials(shape, settings.transform.axes, bases)
        costs = _costs(sample, settings, trials, coding)
        lowest = min(costs)
        axes = trials[costs.index(lowest)]
        return replace(settings, transform=TransformSpec(axes=axes)), lowest
    axes = settings.transform.axes
    lowest = math.inf
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
    )
    for changes in groups:
        changed = [_changed(axes, change) for change in changes]
        trials = [
            *([axes] if math.isinf(lowest) else []),
            *(candidate for candidate in changed if candidate != axes),
        ]
        costs = _costs(sample, settings, trials, coding)
        if trials and min(costs) < lowest:
            lowest = min(costs)
            axes = trials[costs.index(lowest)]
    return replace(settings, transform=TransformSpec(axes=axes)), lowest


def likely_transform(sample: TileSample, settings: TileSettings, coding: Coding) -> TileSettings:
    """Return settings with what `choose_transform` is likely to find, by few trials.

    The usual transform competes with the data's own bases along time, in space, and along both.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases, usual = _Bases(sample, settings), usual_transform(shape).axes
    trials = [usual]
    in_space, in_time = bases.possible(*shape[1:]), bases.possible(shape[0])
    if in_space:
        trials.append((usual[0], bases.along(1), bases.along(2), bases.along(3)))
    if in_time:
        trials += [(bases.along(0), *axes[1:]) for axes in trials[:]]
    costs = _costs(sample, settings, trials, coding)
    return replace(settings, transform=TransformSpec(axes=trials[costs.index(min(costs))]))


def count_trials(shape: Shape, *, in_memory: bool) -> tuple[int, int]:
    """Return the codings of a sample by `choose_transform`, and the bases that it fits.

    shape: of a tile.
    in_memory: whether the series is, so that bases are possible.
    """

    bases = _CountedBases(in_memory)
    axes = usual_transform(shape).axes
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
    )
    trials = 1 + sum(_changed(axes, change) != axes for group in groups for change in group)
    return trials, len(bases.fitted)


def basis_bytes(transform: TransformSpec) -> float:
    """Return the bytes that the data's own bases take in the file."""
    packed = (axis.basis.to_bytes() for axis in transform.axes if axis.basis is not None)
    return BASIS_TEXT * sum(map(len, packed))


def refit(sample: TileSample, settings: TileSettings, coarser: float = 1.0) -> TileSettings:
    """Return settings with the data's own bases made anew for their step.

    Settings without such bases are returned themselves, the same object.

    coarser: factor of the step that the bases are as precise as.
    """
    axes = settings.transform.axes
    if not any(axis.basis is not None for axis in axes):
        return settings
    bases = _Bases(sample, replace(settings, step=coarser * settings.step))
    fresh = {
        number: bases.along(number) for number, axis in enumerate(axes) if axis.basis is not None
    }
    return replace(settings, transform=TransformSpec(axes=_changed(axes, fresh)))


def _changed(axes: Axes, change: dict[int, AxisTransform]) -> Axes:
    """Return transforms with some replaced, by the number of the axis."""
    t, z, y, x = (change.get(number, axis) for number, axis in enumerate(axes))
    return t, z, y, x


def _quick_trials(shape: Shape, axes: Axes, bases: _Bases) -> list[Axes]:
    """Return the usual transform, the kinds of `axes`, and bases where they are possible."""
    usual = usual_transform(shape).axes
    t, z, y, x = (_fitted(axis, length) for axis, length in zip(axes, shape, strict=True))
    trials = [usual, (t, z, y, x)]
    if bases.possible(*shape[1:]):
        trials.append((usual[0], bases.along(1), bases.along(2), bases.along(3)))
    return trials


def _fitted(axis: AxisTransform, length: int) -> AxisTransform:
    """Return the same kind for another length; 9/7 for a basis, which fits one length only."""
    if axis.basis is not None:
        return wavelet("9/7", 2, length)
    return wavelet(axis.kind, axis.depth, length) if axis.wavelet else axis


def _costs(
    sample: TileSample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[float]:
    """Return J of each trial."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        bases = basis_bytes(TransformSpec(axes=axes))
        # Under a bound, bytes of the residual correct the errors already.
        error = 0.0
        if coding.error is None:
            error = outcome.squares / (ERROR_PRICE * settings.step**2)
        return outcome.size + bases + error

    outcomes = sample.run_all(
        [(replace(settings, transform=TransformSpec(axes=axes)), coding) for axes in trials]
    )
    return [cost(axes, outcome) for axes, outcome in zip(trials, outcomes, strict=True)]


def _plane(kind: str, depth: int, y: int, x: int) -> tuple[AxisTransform, AxisTransform]:
    """Return a wavelet along y and x, of one depth where both have more than one vertex."""
    if min(y, x) > 1:
        depth = min(depth, max(1, (max(y, x) - 1).bit_length()))
        return AxisTransform(kind=kind, depth=depth), AxisTransform(kind=kind, depth=depth)
    return wavelet(kind, depth, y), wavelet(kind, depth, x)


def _plane_trials(shape: Shape, bases: _Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along y and x."""
    y, x = shape[2:]
    for kind, depth in PLANE_WAVELETS:
        if 2 ** (depth - 1) < max(y, x):
            along_y, along_x = _plane(kind, depth, y, x)
            yield {2: along_y, 3: along_x}
    if bases.possible(y, x):
        yield {2: bases.along(2), 3: bases.along(3)}


def _line_trials(axis: int, shape: Shape, bases: _Bases) -> Iterator[dict[int, AxisTransform]]:
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


class _Bases:
    """The data's own bases along the axes of a tile, computed when they are asked for."""

    def __init__(self, sample: TileSample, settings: TileSettings) -> None:
        self._sample, self._settings = sample, settings
        self._cache: dict[int, AxisTransform] = {}

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis; only a series in memory can."""
        allowed = self._sample.allows_bases
        return allowed and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        """Return the basis along an axis, as precise as the step of the settings needs."""
        if axis not in self._cache:
            with stage("bases", "the data's own bases, which compete as transforms of short axes"):
                basis = self._fitted(axis)
            self._cache[axis] = AxisTransform(kind="klt", basis=basis)
        return self._cache[axis]

    def _fitted(self, axis: int) -> Basis:
        """Return the basis of all tiles.

        A direction that the basis drops cannot be restored by any coefficient.
        """
        grams, key = self._sample.grams, (axis, self._settings.center)
        if key not in grams:
            length = self._sample.tiles[0].values.shape[axis]
            gram = np.zeros((length, length))
            for tile_gram in self._sample.map_all(lambda tile: self._gram(tile.values, axis)):
                gram += tile_gram
            grams[key] = gram
        return fit_basis(grams[key], plain_step(self._settings))

    def _gram(self, values: npt.NDArray[np.generic], axis: int) -> Gram:
        """Return the products of the lines of a tile along an axis, (length, length)."""
        # Values that do not count are kept: zeroing them would create an edge that dominates.
        centred = values.astype(np.float64) - self._settings.center
        centred[~np.isfinite(centred)] = 0.0
        length = values.shape[axis]
        lines = centred.reshape(math.prod(values.shape[:axis]), length, -1)
        if lines.shape[2] == 1:
            last: Gram = lines[:, :, 0].T @ lines[:, :, 0]
            return last
        gram = np.zeros((length, length))
        for matrices in np.array_split(lines, -(-len(lines) // MATRICES_AT_ONCE)):
            gram += np.matmul(matrices, matrices.transpose(0, 2, 1)).sum(axis=0)
        return gram


class _CountedBases(_Bases):
    """Bases that are counted and not fitted.

    Attributes:
        fitted: axes along which the encoder would fit one.
    """

    def __init__(self, in_memory: bool) -> None:
        self.fitted: set[int] = set()
        self._in_memory = in_memory

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis."""
        return self._in_memory and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        """Return what stands for a basis along an axis, other than the usual one, and count it."""
        self.fitted.add(axis)
        return AxisTransform(kind="haar", depth=1)


assert MAX_BASIS_LENGTH <= MAX_LENGTH
