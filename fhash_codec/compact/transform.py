"""Choice of the transform: own bases, wavelets, their levels, and an estimate of the bytes."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.compact.attempt import even_tile
from fhash_codec.compact.sample import PricedSample, spread_order
from fhash_codec.compact.tiles import MIN_STEP_SHARE, Blocks, Coding, Index, Outcome, Tile, code
from fhash_codec.measure.errors import BULK_SHARE, pointer
from fhash_codec.progress import stage
from fhash_formats.transform.spec import (
    MAX_LENGTH,
    AxisTransform,
    Basis,
    TransformSpec,
    checked,
    fit_basis,
)
from fhash_formats.transform.tile import forward, plain_step
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import all_finite

Gram = npt.NDArray[np.float64]
"""Products of lines (length, length)."""


def gram_of(planes: npt.NDArray[Any], center: float) -> Gram:
    """Return the sum of v v^T over the lines v along the middle axis of planes.

    planes: values (before, length, after) of any real type. Each counts less the centre, and as 0
        where that is not finite.
    """
    if planes.dtype not in (np.float32, np.float64):
        planes = planes.astype(np.float64)
    planes = np.ascontiguousarray(planes)
    before, length, after = planes.shape
    sums: Gram = np.empty((length, length))
    function = getattr(native.library(), f"fhash_gram_f{planes.itemsize * 8}")
    checked(function(pointer(planes), before, length, after, center, pointer(sums)))
    return sums


Result = TypeVar("Result")
FITTED_LINES = 1 << 15
"""Lines of a series that the data's own bases are fitted on, where they are only priced."""
MIN_LINES = 256
"""The least of them in each tile."""
MAX_BASIS_LENGTH = 128
"""Longest axis in vertices that gets a basis of the data's own: longer factors cost too much."""


class TileSample(Protocol):
    """Tiles on which transforms are tried, such as a `Sample`.

    Attributes:
        tiles: the tiles, all of one shape.
        grams: products of the lines of all tiles, by axis, centre and limit of lines, once they
            were computed: bases for other steps are fitted to them again.
    """

    tiles: list[Tile]
    grams: dict[tuple[int, float, int | None], Gram]

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


class Bases:
    """The data's own bases along the axes of a tile, computed when they are asked for."""

    def __init__(
        self, sample: TileSample, settings: TileSettings, lines: int | None = None
    ) -> None:
        """Begin without any. lines: of each tile, that a basis is fitted on; None for all."""
        self._sample, self._settings, self._lines = sample, settings, lines
        self._allowed = sample.allows_bases
        self._cache: dict[int, AxisTransform] = {}

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis; only a series in memory can."""
        return self._allowed and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

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
        grams, key = self._sample.grams, (axis, self._settings.center, self._lines)
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
        planes = _some_lines(values, axis, self._lines)
        share = values.size / planes.size
        return gram_of(planes, self._settings.center) * share


def _some_lines(
    values: npt.NDArray[np.generic], axis: int, limit: int | None
) -> npt.NDArray[np.generic]:
    """Return the lines of a tile along axis 1 of planes, or about every n-th of them.

    limit: number of lines from which on some are left out; None for none.
    """
    before, length = math.prod(values.shape[:axis]), values.shape[axis]
    planes = values.reshape(before, length, -1)
    after = planes.shape[2]
    if limit is not None and before * after > limit:
        leap = -(-before * after // limit)
        along = min(leap, after)
        planes = planes[:: -(-leap // along), :, ::along]
    return planes


def lines_of_trials(blocks: Blocks) -> int:
    """Return the lines of each tile that bases are fitted on where some will do."""
    return max(FITTED_LINES // math.prod(blocks.grid), MIN_LINES)


def _bases(sample: TileSample, settings: TileSettings) -> Bases:
    """Return bases for trials: those of a priced sample are made anew once chosen (`refit`)."""
    lines = lines_of_trials(sample.blocks) if isinstance(sample, PricedSample) else None
    return Bases(sample, settings, lines)


class CountedBases(Bases):
    """Bases that are counted and not fitted.

    Attributes:
        fitted: axes along which the encoder would fit one.
    """

    def __init__(self, in_memory: bool) -> None:
        self.fitted: set[int] = set()
        self._allowed = in_memory

    def along(self, axis: int) -> AxisTransform:
        """Return what stands for a basis along an axis, other than the usual one, and count it."""
        self.fitted.add(axis)
        return AxisTransform(kind="haar", depth=1)


assert MAX_BASIS_LENGTH <= MAX_LENGTH


Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
"""Transforms along (t, z, y, x)."""
NONE = AxisTransform(kind="none")
"""Marks an axis without a transform."""
PLANE_WAVELETS = (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2))
"""Kinds and depths tried along y and x.

5/3 wins under tight bounds alone, and is never much better at another depth.
"""
LINE_WAVELETS = (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1))
"""Kinds and depths tried along t and along z."""
ROUGH_WAVELETS = (("haar", 2), ("9/7", 1), ("9/7", 3))
"""Kinds and depths tried beside the usual ones where tilings are compared."""
CODED = 2
"""Transforms that are coded after many were priced."""
ERROR_PRICE = 0.8
"""Squared error in squared steps that is worth a byte."""
BASIS_TEXT = 1.03
"""Bytes in the file for each byte of a packed basis: it stands there as deflated base64."""


def wavelet(kind: str, depth: int, length: int) -> AxisTransform:
    """Return a wavelet of at most this depth for an axis of `length` vertices.

    It is less deep on a short axis; an axis of one vertex gets no transform.
    """
    depth = min(depth, max(0, (length - 1).bit_length()))
    return AxisTransform(kind=kind, depth=depth) if depth else NONE


def usual_transform(shape: Shape, like: TransformSpec | None = None) -> TransformSpec:
    """Return a good guess without trial: 9/7 along all axes, deepest in the plane.

    like: of another shape, whose kinds are taken instead.
    """
    t, z, y, x = shape
    along_t, along_z = wavelet("9/7", 2, t), wavelet("9/7", 2, z)
    kind, depth = "9/7", min(4, max(1, max(y, x).bit_length() - 2))
    if like is not None:
        along_t, along_z = _fitted(like.axes[0], t), _fitted(like.axes[1], z)
        if like.axes[3].kind == "haar":
            kind, depth = "haar", like.axes[3].depth
    of_plane = in_plane(kind, depth, shape)
    return TransformSpec(axes=(along_t, along_z, of_plane[2], of_plane[3]))


CLEARLY_IN_TIME = 0.96
"""Share of the usual price below which another transform along time is taken by few prices."""
CLEARLY_IN_SPACE = 0.85
"""The same in space, of which small parts of tiles say less."""


def chosen_by_prices(sample: TileSample, settings: TileSettings, coding: Coding) -> TransformSpec:
    """Return the transform of the settings, or one that is clearly cheaper on a sample.

    Along time haar and none are tried, then haar in the plane and in all of space.
    """
    shape: Shape = sample.tiles[0].values.shape
    along_t, along_z = (wavelet("haar", 2, shape[axis]) for axis in (0, 1))
    haar = in_plane("haar", 3, shape)
    price, axes = _cheapest(sample, settings, [settings.transform.axes], coding)
    for changes, share in (
        ([{0: along_t}, {0: NONE}], CLEARLY_IN_TIME),
        ([haar, {**haar, 1: along_z}], CLEARLY_IN_SPACE),
    ):
        trials = [_changed(axes, change) for change in changes]
        other, best = _cheapest(sample, settings, trials, coding)
        if other < share * price:
            price, axes = other, best
    return TransformSpec(axes=axes)


def choose_transform(
    sample: TileSample,
    settings: TileSettings,
    coding: Coding,
    *,
    coded: bool = True,
) -> tuple[TileSettings, float]:
    """Return settings with the transform of the lowest J on the sample, and that J.

    Of a priced sample, the best trials are coded at last.

    coded: whether the best ones by price are coded.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = _bases(sample, settings)
    axes = settings.transform.axes
    lowest = math.inf
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
        _time_again(shape),
    )
    along_z = axes[1]
    all_tried: list[tuple[float, Axes]] = []
    for changes in groups:
        if changes is groups[-1] and axes[1] is along_z:
            break  # nothing is new since time was chosen
        changed = [_changed(axes, change) for change in changes]
        trials = [
            *([axes] if math.isinf(lowest) else []),
            *(candidate for candidate in changed if candidate != axes),
        ]
        tried = _tried(sample, settings, trials, coding)
        all_tried += [(cost, axes) for cost, axes, _ in tried]
        # min takes the first of several that are alike
        lowest, axes = min([(lowest, axes), *all_tried], key=itemgetter(0))
    if coded and isinstance(sample, PricedSample):
        best = [axes for _, axes in sorted(all_tried, key=itemgetter(0))[:CODED]]
        # Prices are those of the fast coder; the other one finds much more in some transforms.
        slow = replace(coding, fast=False)
        lowest, axes = _cheapest(sample.sample, settings, best, slow)
    return _along(settings, axes), lowest


def cheaper_transform(
    sample: TileSample, settings: TileSettings, other: TransformSpec, coding: Coding
) -> TileSettings:
    """Return settings with their transform or another one for tiles of the same shape."""
    trials = [settings.transform.axes, other.axes]
    return _along(settings, _cheapest(sample, settings, trials, coding)[1])


def likely_transform(sample: TileSample, settings: TileSettings, coding: Coding) -> TileSettings:
    """Return settings with what `choose_transform` is likely to find, by few trials.

    The usual transform competes with the data's own bases along time, in space, and along both.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases, usual = Bases(sample, settings), usual_transform(shape).axes
    trials = [usual]
    in_space, in_time = bases.possible(*shape[1:]), bases.possible(shape[0])
    if in_space:
        trials.append((usual[0], bases.along(1), bases.along(2), bases.along(3)))
    if in_time:
        trials += [(bases.along(0), *axes[1:]) for axes in trials[:]]
    return _along(settings, _cheapest(sample, settings, trials, coding)[1])


def rough_transform(
    sample: TileSample,
    settings: TileSettings,
    coding: Coding,
    known: dict[int, AxisTransform],
    lines: int,
    *,
    own: bool = True,
    sharp: bool = False,
) -> tuple[TileSettings, Outcome | None]:
    """Return settings with a good transform by very few trials, to compare tilings with.

    Beside them is their outcome on the sample; None where nothing was tried.

    known: transforms of axes that need no trial, such as those of the same axis elsewhere.
    lines: of each tile, that the data's own bases are fitted on.
    own: whether these are tried in space.
    sharp: whether none along t and z, and haar in the plane, are tried, as for a shock.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings, lines)
    axes = _changed(usual_transform(shape).axes, known)
    best: tuple[float, Axes, Outcome | None] = (math.inf, axes, None)
    for axis in (0, 1):
        if axis in known or shape[axis] == 1:
            continue
        tried = [wavelet(kind, depth, shape[axis]) for kind, depth in ROUGH_WAVELETS]
        kinds = list(dict.fromkeys([best[1][axis], *tried, *([NONE] if sharp else [])]))
        if axis == 0 and bases.possible(shape[0]):
            kinds.append(bases.along(0))
        trials = [_changed(best[1], {axis: kind}) for kind in kinds]
        fresh = [trial for trial in trials if best[2] is None or trial != best[1]]
        best = min([best, *_tried(sample, settings, fresh, coding)], key=itemgetter(0))
    if sharp and 3 not in known and min(shape[2:]) > 1:
        haar = _changed(best[1], in_plane("haar", 3, shape))
        best = min([best, *_tried(sample, settings, [haar], coding)], key=itemgetter(0))
    if own and bases.possible(*shape[1:]):
        in_space = (best[1][0], bases.along(1), bases.along(2), bases.along(3))
        trials = [in_space] if best[2] is not None else [axes, in_space]
        if 0 not in known and best[1][0].basis is None and bases.possible(shape[0]):
            # A basis along time may be good with bases in space alone.
            trials.append((bases.along(0), *in_space[1:]))
        best = min([best, *_tried(sample, settings, trials, coding)], key=itemgetter(0))
    return _along(settings, best[1]), best[2]


def adapted_transform(
    sample: TileSample, settings: TileSettings, found: Axes, coding: Coding
) -> TileSettings:
    """Return settings with transforms that were found on a part, or with own bases in space.

    found: the transforms along (t, z, y, x); bases among them are made anew for the sample.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = _bases(sample, settings)
    axes = _of_shape(found, shape, bases)
    usual = usual_transform(shape).axes
    trials = [axes]
    if axes[3].basis is not None:
        trials.append((*axes[:2], *usual[2:]))
    elif bases.possible(*shape[1:]):
        trials.append((axes[0], bases.along(1), bases.along(2), bases.along(3)))
    if len(trials) > 1:
        axes = _cheapest(sample, settings, trials, coding)[1]
    return _along(settings, axes)


def moved_transform(sample: TileSample, settings: TileSettings) -> TileSettings:
    """Return settings with the same kinds of transforms for the tiles of a sample."""
    bases = _bases(sample, settings)
    axes = _of_shape(settings.transform.axes, sample.tiles[0].values.shape, bases)
    return _along(settings, axes)


def _of_shape(axes: Axes, shape: Shape, bases: Bases) -> Axes:
    """Return transforms of the same kinds for a shape, with bases that are made anew."""
    return _changed(
        axes,
        {
            axis: (
                bases.along(axis)
                if transform.basis is not None and bases.possible(shape[axis])
                else _fitted(transform, shape[axis])
            )
            for axis, transform in enumerate(axes)
        },
    )


def count_trials(shape: Shape, *, in_memory: bool) -> tuple[int, int]:
    """Return the codings of a sample by `choose_transform`, and the bases that it fits.

    The second look at time, which few series have, is not counted.

    shape: of a tile.
    in_memory: whether the series is, so that bases are possible.
    """

    bases = CountedBases(in_memory)
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
    bases = Bases(sample, replace(settings, step=coarser * settings.step))
    fresh = {
        number: bases.along(number) for number, axis in enumerate(axes) if axis.basis is not None
    }
    return _along(settings, _changed(axes, fresh))


def _changed(axes: Axes, change: dict[int, AxisTransform]) -> Axes:
    """Return transforms with some replaced, by the number of the axis."""
    t, z, y, x = (change.get(number, axis) for number, axis in enumerate(axes))
    return t, z, y, x


def _fitted(axis: AxisTransform, length: int) -> AxisTransform:
    """Return the same kind for another length; 9/7 for a basis, which fits one length only."""
    if axis.basis is not None:
        return wavelet("9/7", 2, length)
    return wavelet(axis.kind, axis.depth, length) if axis.wavelet else axis


def _along(settings: TileSettings, axes: Axes) -> TileSettings:
    """Return settings with transforms along (t, z, y, x)."""
    return replace(settings, transform=TransformSpec(axes=axes))


def _cheapest(
    sample: TileSample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> tuple[float, Axes]:
    """Return the lowest J of some trials, and the first trial that has it."""
    return min(_tried(sample, settings, trials, coding), key=itemgetter(0))[:2]


def _tried(
    sample: TileSample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[tuple[float, Axes, Outcome]]:
    """Return J of each trial, beside the trial and its outcome."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        bases = basis_bytes(TransformSpec(axes=axes))
        # Under a bound, bytes of the residual correct the errors already.
        error = 0.0
        if coding.error is None:
            error = outcome.squares / (ERROR_PRICE * settings.step**2)
        return outcome.size + bases + error

    outcomes = sample.run_all([(_along(settings, axes), coding) for axes in trials])
    return [
        (cost(axes, outcome), axes, outcome) for axes, outcome in zip(trials, outcomes, strict=True)
    ]


def in_plane(kind: str, depth: int, shape: Shape) -> dict[int, AxisTransform]:
    """Return a wavelet by the axes y and x, of one depth where both have more than one vertex."""
    y, x = shape[2:]
    if min(y, x) > 1:
        depth = min(depth, max(1, (max(y, x) - 1).bit_length()))
        return dict.fromkeys((2, 3), AxisTransform(kind=kind, depth=depth))
    return {2: wavelet(kind, depth, y), 3: wavelet(kind, depth, x)}


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


DEAD_ZONE = 0.8
"""Share of the step below which a coefficient becomes 0."""
SPREAD = 0.1
"""Mean square of the error of the other coefficients, in squared steps."""
ROUGH_VERTICES = 1 << 20
"""Vertices of the tiles whose coefficients give a first idea of the size."""
TRIALS = 8
"""Tiles that are coded at most to measure the error of the estimate."""
TRIAL_VERTICES = 1 << 18
"""Vertices of a tile coded for it; larger tiles are cut to about this size."""
TRIAL_STEPS = 8
"""Time steps of such a smaller tile."""
BYTES_PER_COEFFICIENT = 0.7
"""Approximate bytes per coefficient that is not 0."""
SHIFT = 21
"""Low bits of a float32 that a bin leaves out.

The rest is the exponent and two bits of the mantissa: a bin is a quarter of an octave.
"""
BINS = 1 << (31 - SHIFT)
"""Number of bins of magnitudes."""

with np.errstate(invalid="ignore"):
    _EDGES = (np.arange(BINS, dtype=np.uint32) << SHIFT).view(np.float32).astype(np.float64)
_EDGES[~np.isfinite(_EDGES)] = np.inf


@dataclass(frozen=True, kw_only=True)
class Magnitudes:
    """Histogram of the magnitudes of coefficients, with logarithmic bins."""

    counts: npt.NDArray[np.int64]
    """Number of coefficients in each bin."""
    squares: npt.NDArray[np.float64]
    """Sum of the squares of the coefficients in each bin."""

    def error(self, step: float) -> float:
        """Return the approximate sum of the squared errors at a step."""
        limit = DEAD_ZONE * step
        number = self._bin_of(limit)
        share = (limit - _EDGES[number]) / (_EDGES[number + 1] - _EDGES[number])
        zeroed = math.fsum(self.squares[:number]) + float(share * self.squares[number])
        kept = float(self.counts[number:].sum() - share * self.counts[number])
        return zeroed + kept * SPREAD * step * step

    def size(self, step: float) -> float:
        """Return the approximate number of bytes at a step."""
        number = self._bin_of(DEAD_ZONE * step)
        return BYTES_PER_COEFFICIENT * float(self.counts[number:].sum())

    def step(self, error: float, min_step: float) -> float:
        """Return the step for a sum of squared errors, at least `min_step`."""
        low, high = min_step, min_step * 2
        while self.error(high) < error and high < min_step * 2.0**60:
            low, high = high, high * 2
        for _ in range(30):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.error(middle) < error else (low, middle)
        return low

    @staticmethod
    def _bin_of(magnitude: float) -> int:
        """Return the bin that holds a magnitude."""
        return int(np.searchsorted(_EDGES, min(magnitude, 1e38), side="right")) - 1


def magnitudes(coefficients: npt.NDArray[np.float32]) -> Magnitudes:
    """Return the histogram of coefficients (fhash_codec/native/quality.cpp)."""
    flat = np.ascontiguousarray(coefficients, dtype=np.float32).reshape(-1)
    histogram = Magnitudes(counts=np.zeros(BINS, np.int64), squares=np.zeros(BINS))
    native.library().fhash_magnitudes(
        pointer(flat),
        ctypes.c_int64(flat.size),
        ctypes.c_int64(SHIFT),
        pointer(histogram.counts),
        pointer(histogram.squares),
    )
    return histogram


def tile_costs(
    blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor
) -> list[float] | None:
    """Return the approximate bytes of each tile, in C order; None for a series not in memory."""
    if not blocks.in_memory:
        return None
    return [tile.size(settings.step) for tile in _tile_magnitudes(blocks, settings, workers)]


def estimated_size(
    blocks: Blocks,
    settings: TileSettings,
    *,
    psnr: float,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """Return a very rough number of bytes that the tiles of a series take at a PSNR (dB).

    The series must be as in `estimated_step`.
    """
    indices = list(blocks.indices())
    count = min(len(indices), max(1, ROUGH_VERTICES // math.prod(blocks.tile)))
    some = [indices[number] for number in sorted(spread_order(len(indices))[:count])]
    share = count / len(indices)
    series = _sum(_tile_magnitudes(blocks, settings, workers, some))
    error = squared_error(math.prod(blocks.shape), psnr, data_range) * share
    return series.size(series.step(error, data_range * MIN_STEP_SHARE)) / share


def estimated_step(
    blocks: Blocks,
    settings: TileSettings,
    coding: Coding,
    *,
    psnr: float,
    even_psnr: float | None = None,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """Return the step at which the tiles of a series should reach a PSNR (dB).

    even_psnr: PSNR that keeps the promise if errors are everywhere alike: more than `psnr`, the
        default, where the coding measures a bulk that needs it.

    The series must be in memory, all of its vertices in the coreset, and coded in float32.
    """
    min_step = data_range * MIN_STEP_SHARE
    error = squared_error(math.prod(blocks.shape), psnr, data_range)
    tiles = _tile_magnitudes(blocks, settings, workers)
    series = _sum(tiles)
    step = series.step(
        squared_error(math.prod(blocks.shape), even_psnr or psnr, data_range), min_step
    )
    if math.prod(blocks.tile) > TRIAL_VERTICES:
        # Large tiles take long to code, and smaller ones tell as much.
        parts = math.prod(blocks.tile) // TRIAL_VERTICES + 1
        blocks = blocks.retile(even_tile(blocks.tile, parts, TRIAL_STEPS))
        transform = usual_transform(blocks.tile, settings.transform)
        settings = replace(settings, transform=transform)
        tiles = _tile_magnitudes(blocks, settings, workers)
    settings = replace(settings, step=step)
    indices = list(blocks.indices())

    def measured_to_estimated(number: int) -> tuple[float, float]:
        outcome = code(blocks.read(indices[number]), settings, coding)[1]
        estimate = tiles[number].error(step)
        if estimate > 0 and outcome.squares > 0:
            return outcome.squares / estimate, outcome.bulk_squares / estimate
        return 1.0, 0.0

    # The chance of a tile is its share of the error, so that those of most error stand for all.
    sums = np.cumsum([tile.error(step) for tile in tiles])
    chosen = np.searchsorted(sums, sums[-1] * (np.arange(TRIALS) + 0.5) / TRIALS)
    numbers = np.unique(chosen.clip(0, len(tiles) - 1))
    ratios = list(workers.map(measured_to_estimated, (int(number) for number in numbers)))
    whole, bulk = (math.fsum(part) for part in zip(*ratios, strict=True))
    step = series.step(error * len(ratios) / whole, min_step)
    if bulk == 0:
        return step
    error *= BULK_SHARE
    return min(step, series.step(error * len(ratios) / bulk, min_step))


def squared_error(vertices: int, psnr: float, data_range: float) -> float:
    """Return the sum of the squared errors over so many vertices at a PSNR (dB)."""
    return vertices * data_range**2 * 10 ** (-psnr / 10)


def _tile_magnitudes(
    blocks: Blocks,
    settings: TileSettings,
    workers: ThreadPoolExecutor,
    indices: Sequence[Index] | None = None,
) -> list[Magnitudes]:
    """Return the magnitudes of the coefficients of some tiles; of all, in C order, if None."""

    def of_tile(index: Index) -> Magnitudes:
        return magnitudes_of(blocks.read(index).values, settings)

    return list(workers.map(of_tile, blocks.indices() if indices is None else indices))


def magnitudes_of(values: npt.NDArray[Any], settings: TileSettings) -> Magnitudes:
    """Return the magnitudes of the coefficients of a tile (t, z, y, x).

    Only the kinds of the transform matter; float32 is precise enough.
    """
    kinds = replace(settings, double=False, step=1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        single = values.astype(np.float32)
        single -= np.float32(settings.center)
    if not all_finite(single):
        single[~np.isfinite(single)] = 0
    return magnitudes(forward(single, kinds))


def magnitudes_of_all(
    blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor
) -> Magnitudes:
    """Return the magnitudes of the coefficients of all tiles together."""
    return _sum(_tile_magnitudes(blocks, settings, workers))


def _sum(tiles: Sequence[Magnitudes]) -> Magnitudes:
    """Return the histogram of all tiles together."""
    counts, squares = np.zeros(BINS, np.int64), np.zeros(BINS)
    for tile in tiles:
        counts += tile.counts
        squares += tile.squares
    return Magnitudes(counts=counts, squares=squares)
