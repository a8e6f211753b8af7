"""Encoding of one chunk to a stated quality: the search for a transform and a quantisation step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.support.arrays import Mask, Values
from fhash_formats.support.values import exact_number, integer_origin
from fhash_formats.transform.coder import MAX_LABELS
from fhash_formats.transform.decoding import decode_tile, transform_for
from fhash_formats.transform.encoding import (
    OFFSETS,
    TRELLIS_WEIGHT,
    WEIGHT,
    CodedTile,
    Coding,
    encode_tile,
    exact_tile,
    labelled_tile,
    with_trellis,
)
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import FEW, Shape, TileSettings, has_regions
from fhash_formats.transform.values import within

MAX_DEPTHS = (1, 1, 5, 5)
"""Most levels of a 9/7 transform along (t, z, y, x)."""
NO_TRANSFORM = TransformSpec(axes=(AxisTransform(kind="none"),) * 4)
"""The shortest description of a transform."""


def candidates(shape: Shape) -> tuple[TransformSpec, ...]:
    """The transforms to try, each once.

    9/7 along all axes; then Haar, and then no transform, along the first axis longer than 1, which
    often is time; then Haar along all axes.
    """
    first = next((axis for axis, n in enumerate(shape) if n > 1), None)
    if first is None:
        return (NO_TRANSFORM,)
    depths = [
        0 if n < 2 else max(1, min(deepest, n.bit_length() - 3))
        for n, deepest in zip(shape, MAX_DEPTHS, strict=True)
    ]
    if min(shape[2:]) >= 16:
        depths[2:] = [min(depths[2:])] * 2
    # Few chunks are long in time: there, two levels of Haar are worth it.
    haar_depth = min(2, shape[first].bit_length() - 1) if first < 2 else depths[first]
    specs = (
        _spec("9/7", depths, first, "9/7", depths[first]),
        _spec("9/7", depths, first, "haar", haar_depth),
        _spec("9/7", depths, first, "none", 0),
        _spec("haar", depths, first, "haar", haar_depth),
    )
    return tuple(dict.fromkeys(specs))


def _spec(
    kind: str, depths: list[int], first: int, first_kind: str, first_depth: int
) -> TransformSpec:
    """A wavelet of one kind along all axes with a depth, but another kind along the first axis."""
    kinds = [(kind if depth else "none", depth) for depth in depths]
    kinds[first] = (first_kind, first_depth)
    t, z, y, x = (AxisTransform(kind=name, depth=depth) for name, depth in kinds)
    return TransformSpec(axes=(t, z, y, x))


DEFAULT_EFFORT = 2
"""Least effort that makes trials."""
_MAX_EFFORT = 9
"""Highest effort, as for containers."""
_FIRST_RATIO = 2.5
"""Quantiser step under a bound, in units of half the quantum, with which transforms are tried."""
_OTHER_RATIOS = (4.0, 1.6)
"""Further steps that are tried under a bound.

Small steps pay for loose bounds, large ones for tight bounds.
"""
_CLEARLY = 4
"""Ratio of a deflated chunk to its labels from which on nothing else is tried."""
_MAX_WINDOW = 1 << 16
"""Most values of the window on which settings are tried at effort 2; each further effort has four
times as many."""
_WRITTEN = 4
"""Bounds that decoded fill values are away at most: each time that a part of a chunk is written
adds one."""
_QUANTUM_SHARE = 1 - 1e-6
"""Quantum as a share of twice the largest error, so that rounding cannot break the bound."""
_MAX_STEPS = 2.5e8
"""Largest coefficient, as estimated, in quantiser steps. The coder ends at four times as much."""
_MAX_VALUE = 1e300
"""Largest magnitude of a value that is coded by transform."""
_MIN_STEP = 1e-290
"""Smallest quantiser step."""
_MAX_SINGLE = 1e30
"""Largest magnitude of values and steps for arithmetic in float32."""
_MIN_SINGLE = 1e-30
"""Smallest quantiser step for arithmetic in float32."""


@dataclass(frozen=True, kw_only=True)
class Quality:
    """The quality asked of a chunk: exactly one of the three. Raises InputError.

    Attributes:
        max_error: bound on |decoded - value|, in units of the values, kept strictly; 0 is lossless.
        max_error_rel: the same bound as a fraction of the range of the chunk's finite values, but
            for those that a store may have put there, see `encode_chunk`.
        step: quantiser step, in units of the values, without a bound.
    """

    max_error: float | None = None
    max_error_rel: float | None = None
    step: float | None = None

    def __post_init__(self) -> None:
        given = self.to_dict()
        if len(given) != 1:
            named = " and ".join(given) if given else "none"
            raise InputError(
                f"fhash.transform needs one of max_error, max_error_rel and step; given: {named}"
            )
        for name, value in given.items():
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not 0 <= value < math.inf
            ):
                raise InputError(f"{name} is {value!r:.40}; a finite number, 0 or more, is needed")
        if self.step == 0:
            raise InputError("step is 0; a number above 0 is needed (max_error 0 is lossless)")

    def to_dict(self) -> dict[str, float]:
        """The quality that is given, by its name."""
        qualities = {
            "max_error": self.max_error,
            "max_error_rel": self.max_error_rel,
            "step": self.step,
        }
        return {name: value for name, value in qualities.items() if value is not None}


def supported(dtype: npt.DTypeLike) -> np.dtype[Any]:
    """The type in this machine's byte order.

    Raises InputError unless the type is float16, float32, float64 or an integer.
    """
    kind = np.dtype(dtype)
    if kind.kind not in "fiu" or kind.itemsize > 8:
        raise InputError(
            f"fhash.transform codes float16, float32, float64 and integers, not {kind.name}"
        )
    return kind.newbyteorder("=")


def tile_shape(shape: tuple[int, ...]) -> Shape:
    """The shape (t, z, y, x) of a tile for an array of any number of axes.

    Fewer axes get ones in front. Of more than four, the leading ones become one.
    """
    lengths = (1, 1, 1, *shape)
    z, y, x = lengths[-3:]
    return math.prod(lengths[:-3]), z, y, x


def encode_chunk(
    values: Values,
    *,
    max_error: float | None = None,
    max_error_rel: float | None = None,
    step: float | None = None,
    transform: TransformSpec | Mapping[str, Any] | None = None,
    fill: Any = 0,
    effort: int = DEFAULT_EFFORT,
) -> bytes:
    """The stream of an array.

    NaN and infinities come back where they were and take no part in range or bound. Stores put fill
    values where nothing was written, and beyond the end of an array. So these take no part in the
    range of `max_error_rel` either, nor does a value that is the only one of a plane at either end
    of an axis: a filter may have changed the fill value, and some stores do not tell it. Where
    parts of a chunk are written one after the other, the same holds for what the bound made of a
    fill value.

    Args:
        values: array of a type that `supported` accepts; its axes become those of `tile_shape`.
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`.
        step: as in `Quality`.
        transform: transform along (t, z, y, x); None for the one that codes best in a trial.
        fill: the fill value of the store; None where it has none.
        effort: 1 tries nothing; 2 to 9 try transforms, steps and two quantisers, on ever larger
            parts of the array.

    Raises InputError.
    """
    check_effort(effort)
    quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
    values = np.asarray(values)
    tile = np.ascontiguousarray(values, dtype=supported(values.dtype)).reshape(
        tile_shape(values.shape)
    )
    specs = candidates(tile_shape(tile.shape)) if transform is None else (_spec_from(transform),)
    fills = _fills(values, fill) if quality.max_error_rel is not None else []
    return _encode(tile, quality, specs, fills, effort).data if tile.size else b""


def check_effort(effort: Any) -> None:
    """Raises InputError for an effort that is no whole number from 1 to 9."""
    if type(effort) is not int or not 1 <= effort <= _MAX_EFFORT:
        raise InputError(
            f"effort is {effort!r:.40}; a whole number from 1 to {_MAX_EFFORT} is needed"
        )


def _fills(values: Values, fill: Any) -> list[Any]:
    """The values of an array that a store may have put there: see `encode_chunk`."""
    fills = [] if fill is None else [np.asarray(fill).astype(values.dtype)[()]]
    for axis in range(values.ndim):
        for plane in (values.take(end, axis) for end in (0, -1) if values.shape[axis]):
            if plane.size and bool((plane == plane.flat[0]).all()):
                fills.append(plane.flat[0])
    return fills


def decode_chunk(data: bytes | memoryview, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Values:
    """The values of a stream, with the shape and type that were coded.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    if not math.prod(shape):
        return np.empty(shape, dtype)
    return (
        decode_tile(data, tile_shape(shape), supported(dtype))
        .reshape(shape)
        .astype(dtype, copy=False)
    )


@dataclass(frozen=True, kw_only=True)
class _Task:
    """A chunk to code, of at least one finite value.

    Attributes:
        tile: the values (t, z, y, x).
        finite: where they are finite; None where all are.
        origin: integer that is subtracted from the values before they become floats; 0 for most.
        low: smallest finite value, less the origin; for integers a Python integer, since float64
            is too narrow for 64 bits.
        high: largest finite value, likewise.
        quality: the quality asked for.
        error: bound on the decoded values; None for none.
        reach: largest error before decoded values are rounded to their type; 0 without a bound.
    """

    tile: Values
    finite: Mask | None
    origin: int
    low: float
    high: float
    quality: Quality
    error: float | None
    reach: float

    @property
    def lossless(self) -> bool:
        """Whether the bound allows no error at all."""
        whole = self.tile.dtype.kind != "f"
        return self.error is not None and self.error < (1 if whole else math.ulp(0.0))

    @property
    def center(self) -> float:
        """The middle of the range."""
        return float(self.low) + self.half_range

    @property
    def half_range(self) -> float:
        """Half of the range; each end is halved first, so that the range cannot overflow."""
        return float(self.high) / 2 - float(self.low) / 2

    @property
    def largest(self) -> float:
        """Largest magnitude of a value."""
        return max(abs(float(self.low)), abs(float(self.high)))


def _encode(
    tile: Values,
    quality: Quality,
    specs: tuple[TransformSpec, ...],
    fills: Sequence[Any],
    effort: int,
) -> CodedTile:
    """The coded chunk, stored without loss where that takes no more bytes.

    fills: values that take no part in the range of a relative bound.
    """
    task = _task(tile, quality, fills)
    if task is None:
        return _constant_tile(tile, 0.0)
    constant = _encode_constant(task)
    if constant is not None:
        return constant
    labelled = None
    if task.lossless:
        labelled = labelled_tile(tile, most=MAX_LABELS if has_regions(tile) else FEW)
    if labelled is not None and _CLEARLY * len(labelled.data) < len(exact_tile(tile).data):
        return labelled
    others = [_transformed(task, specs, effort), labelled]
    tiles = [other for other in others if other is not None]
    if not any(2 * len(other.data) < tile.nbytes for other in tiles):
        tiles.insert(0, exact_tile(tile))
    return min(tiles, key=lambda coded: len(coded.data))


def _transformed(task: _Task, specs: tuple[TransformSpec, ...], effort: int) -> CodedTile | None:
    """The chunk coded by transform; None where that cannot be."""
    first = _first_settings(task, specs[0])
    if first is None:
        return None
    coding = Coding(
        weight=WEIGHT, error=task.error, passes=1 if effort < 3 else 2, own_settings=True
    )
    trial = _Trial(settings=first, coding=coding)
    if effort > 1:
        trial = _best_trial(task, trial, specs, _MAX_WINDOW << 2 * (effort - 2))
    norms = transform_for(trial.settings, tile_shape(task.tile.shape)).norms
    gain = [float(norm.max()) for norm in norms]
    if task.half_range / trial.settings.step * gain[0] * gain[1] > _MAX_STEPS:
        return None
    if trial.coded is not None and trial.coded.decoded.shape == task.tile.shape:
        return trial.coded
    return trial.run(task.tile).coded


def _task(tile: Values, quality: Quality, fills: Sequence[Any]) -> _Task | None:
    """The chunk with its range and bound; None where no value is finite."""
    finite = np.isfinite(tile)
    all_finite = bool(finite.all())
    values = tile if all_finite else tile[finite]
    if not values.size:
        return None
    low, high = values.min().item(), values.max().item()
    origin = integer_origin(low, high, tile.dtype)
    low, high = low - origin, high - origin
    with_bound = quality.step is None
    kept = values[np.logical_and.reduce([values != fill for fill in fills])] if fills else values
    for fill in fills:
        kept = _without_moved(kept, float(fill), float(quality.max_error_rel or 0.0))
    ends = (kept.min().item(), kept.max().item()) if kept.size else (0, 0)
    error, reach = _bound(quality, low, high, ends, tile.dtype) if with_bound else (None, 0.0)
    mask = None if all_finite else finite
    return _Task(
        tile=tile,
        finite=mask,
        origin=origin,
        low=low,
        high=high,
        quality=quality,
        error=error,
        reach=reach,
    )


def _without_moved(values: Values, fill: float, fraction: float) -> Values:
    """The values without those that stood for `fill` in a chunk that was coded before.

    Who writes a part of a chunk codes what was decoded of the rest once more. Beside values far
    away those would give a range, and so a bound, as wide as the way to the fill value.
    """
    if not values.size:
        return values
    with np.errstate(over="ignore", invalid="ignore"):
        ways = np.abs(values.astype(np.float64) - fill)
        near = ways <= fraction * float(np.ptp(values.astype(np.float64)))
        others = values[~near]
        if not near.any() or not others.size:
            return values
        bound = fraction * float(np.ptp(others.astype(np.float64)))
    return others if ways[near].max() <= _WRITTEN * bound else values


def _bound(
    quality: Quality, low: Any, high: Any, ends: tuple[Any, Any], dtype: np.dtype[Any]
) -> tuple[float, float]:
    """The bound on decoded values, and the largest error before they are rounded to their type.

    low, high: range of the values. ends: of the range that a relative bound is of.
    """
    error = 0.0 if quality.max_error is None else float(quality.max_error)
    if quality.max_error_rel is not None:
        fraction, span = float(quality.max_error_rel), float(ends[1] - ends[0])
        error = fraction * span
        if not math.isfinite(span):
            error = fraction * float(ends[1]) - fraction * float(ends[0])
    if dtype.kind != "f":
        largest = math.floor(error) if math.isfinite(error) else 1 << 64
        return error, largest + 0.5
    return error, error - max(abs(low), abs(high)) * float(np.finfo(dtype).eps)


def _constant_tile(tile: Values, center: float, origin: int = 0) -> CodedTile:
    """A tile whose finite values all decode to one value."""
    settings = TileSettings(
        transform=NO_TRANSFORM,
        step=1.0,
        center=center,
        low=center,
        high=center,
        double=True,
        origin=origin,
    )
    nothing = np.zeros(tile.shape, bool)
    return encode_tile(tile, settings, Coding(own_settings=True), in_coreset=nothing)


def _encode_constant(task: _Task) -> CodedTile | None:
    """The chunk as a constant, if all values are equal or the bound allows it; otherwise None."""
    error, values_equal = task.error, task.high == task.low
    if not values_equal and (error is None or task.half_range > task.reach):
        return None
    constant = _constant_tile(task.tile, task.center, task.origin)
    # A lossless zero keeps its sign, and a constant has one sign only.
    counted = task.tile if task.finite is None else task.tile[task.finite]
    signed = error == 0 and task.low == 0 and bool(np.signbit(counted).any())
    if not signed and within(task.tile, constant.decoded, error or 0.0, task.finite):
        return constant
    return exact_tile(task.tile) if values_equal else None


def _first_settings(task: _Task, transform: TransformSpec) -> TileSettings | None:
    """The settings before anything is tried; None for a chunk to store without loss.

    That is a chunk whose bound is below the precision of its type, or whose values or steps are out
    of range.
    """
    step = task.quality.step
    first = _FIRST_RATIO * task.reach if step is None else float(step)
    too_fine = task.error is not None and task.reach < task.error / 2
    in_range = (
        first >= _MIN_STEP and task.largest <= _MAX_VALUE and task.half_range / first < _MAX_STEPS
    )
    if too_fine or not in_range:
        return None
    return TileSettings(
        transform=transform,
        step=first,
        center=task.center,
        low=exact_number(task.low),
        high=exact_number(task.high),
        origin=task.origin,
        clip=True,
        offsets=OFFSETS,
        double=_double(task.tile.dtype, task.largest, 2 * task.half_range, first),
        quantum=0.0 if task.error is None else 2 * task.reach * _QUANTUM_SHARE,
    )


def _double(dtype: np.dtype[Any], largest: float, span: float, step: float) -> bool:
    """Whether float32 would lose what the step keeps."""
    if max(largest, step) > _MAX_SINGLE or step < _MIN_SINGLE:
        return True
    return dtype.itemsize >= 4 and (
        span / step > 1 << 18 or (dtype != np.float32 and largest / step > 1 << 20)
    )


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """Settings and options of the encoder, and what they made of a window; None before."""

    settings: TileSettings
    coding: Coding
    coded: CodedTile | None = None

    def run(self, values: Values) -> _Trial:
        """The trial on these values."""
        return replace(self, coded=encode_tile(values, self.settings, self.coding))

    @property
    def size(self) -> int:
        """Bytes of the coded window."""
        return 0 if self.coded is None else len(self.coded.data)


def _best_trial(task: _Task, first: _Trial, specs: tuple[TransformSpec, ...], most: int) -> _Trial:
    """The trial of the transform, then the step, then the quantiser that takes the fewest bytes.

    The first of equals is taken.

    first: with the settings before anything is tried.
    most: values of the window on which they are tried.
    """
    bounded = task.error is not None
    trials = [replace(first, settings=replace(first.settings, transform=spec)) for spec in specs]
    if len(trials) == 1 and not bounded:
        return trials[0]
    window = _window(task.tile, most)
    best = min((trial.run(window) for trial in trials), key=lambda trial: trial.size)
    if not bounded:
        return best
    steps = [replace(best.settings, step=ratio * task.reach) for ratio in _OTHER_RATIOS]
    others = [replace(best, settings=settings).run(window) for settings in steps]
    best = min([best, *others], key=lambda trial: trial.size)
    if best.settings.double:
        return best  # steps so fine come near the finest one that the trellis has
    other = _Trial(
        settings=with_trellis(best.settings), coding=replace(best.coding, weight=TRELLIS_WEIGHT)
    )
    return min([best, other.run(window)], key=lambda trial: trial.size)


def _window(tile: Values, most: int) -> Values:
    """A block of at most `most` values from the middle of a tile."""
    lengths = list(tile.shape)
    while math.prod(lengths) > most:
        longest = lengths.index(max(lengths))
        lengths[longest] = (lengths[longest] + 1) // 2
    middle = tuple(
        slice((n - length) // 2, (n - length) // 2 + length)
        for n, length in zip(tile.shape, lengths, strict=True)
    )
    return np.ascontiguousarray(tile[middle])


def _spec_from(transform: TransformSpec | Mapping[str, Any]) -> TransformSpec:
    return transform if isinstance(transform, TransformSpec) else TransformSpec.from_dict(transform)
