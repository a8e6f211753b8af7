"""Which transform goes along each axis: by trial on bytes.

Candidates are coded on a sample at one step; what counts is J = bytes + squared error / (0.8 step^2), so that a transform that gives less
error for the same bytes wins as well. Axes are decided one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.axes.basis import MAX_LENGTH, fit_basis
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
NONE = AxisTransform(kind="none")
BASIS_LENGTH = 128
"""A longer axis gets no basis of its own: its factors would cost too much. Nor does a series that is not in memory."""


def wavelet(kind: str, depth: int, length: int) -> AxisTransform:
    """A wavelet of at most this depth, less deep on a short axis; nothing on an axis of one vertex."""
    depth = min(depth, max(0, (length - 1).bit_length()))
    return AxisTransform(kind=kind, depth=depth) if depth else NONE


def usual_transform(shape: Shape) -> TransformSpec:
    """A good guess without trial: 9/7 everywhere, deepest in the plane."""
    t, z, y, x = shape
    plane = min(4, max(1, max(y, x).bit_length() - 2))
    return TransformSpec(
        axes=(wavelet("9/7", 2, t), wavelet("9/7", 2, z), *_plane("9/7", plane, y, x))
    )


def choose_transform(
    sample: Sample, settings: TileSettings, coding: Coding, *, quick: bool = False
) -> tuple[TileSettings, float]:
    """Settings with the transform of the lowest J on the sample, and that J.

    quick: only the kinds that the settings have, the usual ones, and the data's own bases in the plane and along z.
    """
    shape: Shape = sample.tiles[0][0].shape
    bases = _Bases(sample, settings)
    if quick:
        usual = usual_transform(shape).axes
        own = tuple(
            _known(axis, length)
            for axis, length in zip(settings.transform.axes, shape, strict=True)
        )
        trials = [usual, own]
        if bases.possible(*shape[1:]):
            trials.append((usual[0], *(bases.along(axis) for axis in (1, 2, 3))))
        costs = _judge(sample, settings, trials, coding)  # type: ignore[arg-type]
        best = min(costs)
        return replace(settings, transform=TransformSpec(axes=trials[costs.index(best)])), best  # type: ignore[arg-type]
    axes: Axes = settings.transform.axes
    best = math.inf
    for candidates in (_planes(shape, bases), _along(0, shape, bases), _along(1, shape, bases)):
        others = [tuple(change.get(axis, axes[axis]) for axis in range(4)) for change in candidates]
        group: list[Axes] = [
            *([axes] if math.isinf(best) else []),
            *(other for other in others if other != axes),  # type: ignore[list-item]
        ]
        costs = _judge(sample, settings, group, coding)
        if group and min(costs) < best:
            best = min(costs)
            axes = group[costs.index(best)]
    return replace(settings, transform=TransformSpec(axes=axes)), best


def refit(sample: Sample, settings: TileSettings) -> TileSettings:
    """Settings with the data's own bases made anew for the step; the same object where there are none."""
    axes = settings.transform.axes
    if not any(axis.basis is not None for axis in axes):
        return settings
    bases = _Bases(sample, settings)
    fresh = tuple(
        axis if axis.basis is None else bases.along(number) for number, axis in enumerate(axes)
    )
    return replace(settings, transform=TransformSpec(axes=fresh))  # type: ignore[arg-type]


def _known(axis: AxisTransform, length: int) -> AxisTransform:
    """The same kind on an axis of another length; 9/7 for a basis, which fits one length alone."""
    if axis.basis is not None:
        return wavelet("9/7", 2, length)
    return wavelet(axis.kind, axis.depth, length) if axis.wavelet else axis


def _judge(
    sample: Sample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[float]:
    """J of each."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        factors = sum(len(axis.basis.to_bytes()) * 4 / 3 for axis in axes if axis.basis is not None)
        # Under a bound all that is wrong is mended, in bytes.
        wrong = 0.0 if coding.error is not None else outcome.squares / (0.8 * settings.step**2)
        return outcome.size + factors + wrong

    outcomes = sample.run_all(
        [(replace(settings, transform=TransformSpec(axes=axes)), coding) for axes in trials]
    )
    return [cost(axes, outcome) for axes, outcome in zip(trials, outcomes, strict=True)]


def _plane(kind: str, depth: int, y: int, x: int) -> tuple[AxisTransform, AxisTransform]:
    """A wavelet along y and x, coupled where both are longer than one vertex."""
    if min(y, x) > 1:
        depth = min(depth, max(1, (max(y, x) - 1).bit_length()))
        return AxisTransform(kind=kind, depth=depth), AxisTransform(kind=kind, depth=depth)
    return wavelet(kind, depth, y), wavelet(kind, depth, x)


def _planes(shape: Shape, bases: _Bases) -> Iterator[dict[int, AxisTransform]]:
    y, x = shape[2:]
    # 5/3 wins under tight bounds alone, and is never much better at another depth.
    for kind, depth in (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2)):
        if 2 ** (depth - 1) < max(y, x):
            pair = _plane(kind, depth, y, x)
            yield {2: pair[0], 3: pair[1]}
    if bases.possible(y, x):
        yield {2: bases.along(2), 3: bases.along(3)}


def _along(axis: int, shape: Shape, bases: _Bases) -> Iterator[dict[int, AxisTransform]]:
    length = shape[axis]
    if length == 1:
        return
    yield {axis: NONE}
    for kind, depth in (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1)):
        if 2 ** (depth - 1) < length:
            yield {axis: AxisTransform(kind=kind, depth=depth)}
    if bases.possible(length):
        yield {axis: bases.along(axis)}


class _Bases:
    """The data's own bases, made when they are asked for."""

    def __init__(self, sample: Sample, settings: TileSettings) -> None:
        self._sample, self._settings = sample, settings
        self._known: dict[int, AxisTransform] = {}

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have one."""
        return self._sample.blocks.held and min(lengths) > 1 and max(lengths) <= BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        if axis not in self._known:
            # Of all tiles: what the basis leaves out, no coefficient of any of them could bring back.
            gram = np.zeros((length := self._sample.tiles[0][0].shape[axis], length))
            for part in self._sample.map_all(lambda tile: self._gram(tile[0], axis)):
                gram += part
            self._known[axis] = AxisTransform(
                kind="klt", basis=fit_basis(gram, self._settings.step)
            )
        return self._known[axis]

    def _gram(self, values: npt.NDArray[np.generic], axis: int) -> npt.NDArray[np.float64]:
        # With what does not count as it is: a border to zeros would be what costs most.
        centred = values.astype(np.float64) - self._settings.center
        centred[~np.isfinite(centred)] = 0.0
        columns = np.moveaxis(centred, axis, 0).reshape(values.shape[axis], -1)
        return columns @ columns.T


assert BASIS_LENGTH <= MAX_LENGTH
