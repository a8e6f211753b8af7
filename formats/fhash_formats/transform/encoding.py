"""Encoding of a tile: choice of integers, of values without data, and of the form of the stream."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.support.arrays import Integers, Mask, Values
from fhash_formats.transform.coder import (
    HIGH,
    LOW,
    MAX_INTEGER,
    MAX_LABELS,
    Table,
    array_arguments,
    checked,
    encode_integers,
)
from fhash_formats.transform.decoding import (
    blank_unoccupied,
    linear_values,
    predicted_values,
    transform_for,
    within_range,
)
from fhash_formats.transform.lifting import Transform, band_table
from fhash_formats.transform.predict import Predictor, encode_predicted, integers_of
from fhash_formats.transform.tile_format import (
    EMPTY,
    PREDICTED,
    TRANSFORMED,
    Shape,
    TileSettings,
    build_exact_stream,
    build_stream,
    labelled_stream,
    pack_mask,
    pack_missing,
    restore_missing,
)
from fhash_formats.transform.values import (
    LARGEST,
    about_origin,
    all_finite,
    at_origin,
    cast,
    corrected,
    dequantise,
    free_values,
    quantise,
    residual_of,
    within,
)

BUCKETS = 64
"""Classes of the expected magnitude of an index: 0, and half octaves."""
RATES = 24
"""Indices with a rate of their own; larger ones have the last one's."""
COST = 32768
"""Costs of a squared step; costs are whole numbers."""
MAX_RATE_COST = 1 << 19
"""Largest cost of the bits of an index, so that sums of costs stay in 32 bits."""
SIGN_BITS = 0.85
"""Bits of a sign, which contexts predict a little."""
NEIGHBOUR_SHARE = 0.3
"""Weight of the counts of the next buckets in those of a bucket."""
PRIOR_COUNT = 8.0
"""Observations that a geometric distribution of the mean of a bucket stands for."""


def choose_levels(
    scaled: npt.NDArray[Any], table: Table, weight: float, iterations: int = 1
) -> Integers:
    """The integers v, in units of delta, of the cheapest path through the trellis, int32.

    Args:
        scaled: coefficients / delta (t, z, y, x), float32 or float64, magnitudes below 2^30.
        table: the bands; integers outside of them are 0.
        weight: squared deltas that a bit is worth.
        iterations: how often the path is searched, each time with the bits of the indices that were
            found before.
    """
    scaled = np.ascontiguousarray(scaled)
    buckets, counts = _counted(scaled, table)
    levels = _chosen(scaled, table, buckets, rates_of(counts, weight))
    for _ in range(1, iterations):
        buckets, counts = _counted(levels, table)
        levels = _chosen(scaled, table, buckets, rates_of(counts, weight))
    return levels


def rates_of(counts: npt.NDArray[np.int64], weight: float) -> Integers:
    """The costs of the bits of indices, int32 (2, BUCKETS, RATES).

    Args:
        counts: numbers of indices by quantiser, bucket and index.
        weight: squared deltas that a bit is worth.
    """
    smooth = counts.astype(np.float64)
    smooth[:, 1:] += NEIGHBOUR_SHARE * counts[:, :-1]
    smooth[:, :-1] += NEIGHBOUR_SHARE * counts[:, 1:]
    total = smooth.sum(axis=2, keepdims=True)
    index = np.arange(RATES)
    mean = ((smooth * index).sum(axis=2, keepdims=True) + 0.02) / (total + 1)
    share = mean / (1 + mean)
    chance = (smooth + PRIOR_COUNT * (1 - share) * share**index) / (total + PRIOR_COUNT)
    bits = -np.log2(np.maximum(chance, 1e-9)) + np.where(index > 0, SIGN_BITS, 0.0)
    costs: Integers = np.minimum(np.rint(bits * weight * COST), MAX_RATE_COST).astype(np.int32)
    return costs


def _counted(
    source: npt.NDArray[Any], table: Table
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """The bucket of each vertex, in coded order, and the counts of `rates_of`.

    source: integers of the path that was found before, int32; or coefficients / delta, for which a
        path is guessed.
    """
    vertices = int(np.prod(table[:, HIGH : HIGH + 4] - table[:, LOW : LOW + 4], axis=1).sum())
    buckets = np.empty(vertices, np.uint8)
    counts = np.zeros((2, BUCKETS, RATES), np.int64)
    library = native.library()
    guess = f"fhash_trellis_guess_f{source.dtype.itemsize * 8}"
    count = library.fhash_trellis_count if source.dtype == np.int32 else getattr(library, guess)
    checked(
        count(
            _pointer(source),
            (ctypes.c_int64 * 4)(*source.shape),
            *array_arguments(table),
            _pointer(buckets),
            _pointer(counts),
        )
    )
    return buckets, counts


def _chosen(
    scaled: npt.NDArray[Any], table: Table, buckets: npt.NDArray[np.uint8], rates: Integers
) -> Integers:
    """The integers of the cheapest path."""
    levels = np.zeros(scaled.shape, np.int32)
    checked(
        getattr(native.library(), f"fhash_trellis_choose_f{scaled.dtype.itemsize * 8}")(
            _pointer(scaled),
            (ctypes.c_int64 * 4)(*scaled.shape),
            *array_arguments(table),
            _pointer(buckets),
            _pointer(rates),
            _pointer(levels),
        )
    )
    return levels


def _pointer(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


WEIGHT = 0.09
"""Squared steps of the plain quantiser that a bit is worth (best between 0.07 and 0.11 in
experiments)."""
OFFSETS = (-5, -1, 0, 0, 0, 0)
"""Shift, in 1/128 step, of the decoded magnitudes after the optimisation, see `dequantise`."""
SHARE = 0.65
"""Step on the trellis as a share of the plain quantiser's of about the same error and bytes."""
TRELLIS_WEIGHT = 0.27
"""Squared steps on the trellis that a bit is worth (0.25 to 0.3 are alike in experiments)."""
TRELLIS_OFFSETS = (17, -10, -5, -3, -2, -1)
"""The same with two quantisers.

It is the mean over coefficients of many series, which differ by 3 or less.
"""

MAX_CHOSEN = 1 << 22
"""Magnitude from which on an integer is the nearest one, and is not chosen by its cost.

The choice compares coefficients in float32, which no longer holds their fractions. The search on
the trellis compares them in the type of the arithmetic.
"""


def with_trellis(settings: TileSettings) -> TileSettings:
    """The settings with two quantisers in place of the plain one, at about the same error."""
    return replace(settings, trellis=True, step=settings.step * SHARE, offsets=TRELLIS_OFFSETS)


def plain_step(settings: TileSettings) -> float:
    """The step with which the plain quantiser errs about as much, in units of the values."""
    return settings.step / SHARE if settings.trellis else settings.step


def choose_integers(
    coefficients: Values, settings: TileSettings, weight: float, passes: int = 1
) -> Integers | None:
    """The integers of coefficients (t, z, y, x), int32; None where the trellis has none so large.

    Args:
        coefficients: in the working type of the settings.
        settings: settings of the tile.
        weight: squared steps that a bit is worth; 0 for the integers of least error.
        passes: how often the path through the trellis is searched.
    """
    table = band_table(settings.transform, coefficients.shape)
    if settings.trellis:
        scaled = _scaled(coefficients, settings)
        return None if scaled is None else choose_levels(scaled, table, weight, passes)
    integers, scaled = quantise(coefficients, settings.step)
    if weight <= 0:
        return integers
    return encode_integers(integers, table, scaled=scaled, weight=weight).integers


def _scaled(coefficients: Values, settings: TileSettings) -> Values | None:
    """Coefficients in steps; None where one is too large for the trellis."""
    scaled: Values = coefficients * settings.dtype.type(1.0 / settings.step)
    # Written so that it holds for NaN as well.
    return scaled if max(-float(scaled.min()), float(scaled.max())) < LARGEST else None


def code_coefficients(
    coefficients: Values, settings: TileSettings, weight: float, passes: int, *, fast: bool = False
) -> tuple[bytes, Integers] | None:
    """The coded coefficients, and the integers that they decode to; None where one is too large.

    The arguments are those of `choose_integers`. Without a trellis, 2 passes code the integers that
    were chosen once more. fast: whether to code them by the fast coder, which searches one path.
    """
    table = band_table(settings.transform, coefficients.shape)
    if settings.trellis and fast:
        scaled = _scaled(coefficients, settings)
        if scaled is None:
            return None
        nothing = np.zeros(scaled.shape, np.int32)
        coded = encode_integers(
            nothing, table, scaled=scaled, weight=weight, trellis=True, fast=True
        )
        return coded.data, coded.integers
    if settings.trellis:
        path = choose_integers(coefficients, settings, weight, passes)
        if path is None:
            return None
        return encode_integers(path, table, trellis=True).data, path
    integers, scaled = quantise(coefficients, settings.step)
    largest = max(-int(integers.min()), int(integers.max()))
    if largest >= LARGEST:
        return None
    chosen_of = scaled if weight > 0 else None
    coded = encode_integers(integers, table, scaled=chosen_of, weight=weight, fast=fast)
    chosen = coded.integers
    if largest >= MAX_CHOSEN and weight > 0 and settings.double:
        large = np.abs(integers) >= MAX_CHOSEN
        nearest = np.rint(coefficients / settings.step).astype(np.int32)
        chosen = np.where(large, nearest, chosen)
    if (passes > 1 and weight > 0 and not fast) or chosen is not coded.integers:
        coded = encode_integers(chosen, table, fast=fast)
    return coded.data, coded.integers


HIGHEST = 64.0
"""First threshold, in quantiser steps."""
LOWEST = 0.4
"""The search ends when the threshold is at or below this many quantiser steps."""
NEARBY = 16.0
"""First threshold, in quantiser steps, where the present values are a good filling already."""
RATIOS = {1: 0.5, 2: 0.7071067811865476, 4: 0.8408964152537145, 8: 0.9170040432046712}
"""Ratio of a threshold to the one before it, by the number of thresholds per factor of two.

The ratios are constants, so that every machine has the same ones.
"""
MOMENTUM = 0.8
"""Share of the last change that is added to the next guess."""
FEW_BITS = 64
"""Tiles whose magnitudes have fewer bits in all are not searched with more thresholds."""


def filled(
    target: Values,
    counted: Mask,
    finite: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int = 1,
) -> Values:
    """`target` (t, z, y, x) with fill values where it is not counted.

    The search starts from the present values, which often continue the counted ones, or from the
    mean of the counted values, whichever takes fewer bits. The present values stay where they take
    no more bytes than the result.

    Args:
        target: the tile, in the working type.
        counted: the values to keep.
        finite: where the tile has present values.
        transform: the transform of the tile.
        settings: settings of the tile; the step is the one the fill values are made for.
        density: 1, 2, 4 or 8 thresholds per factor of two. 0 goes on from a filling that was made
            for other settings, by a few thresholds.
    """
    # A running sum has one order on every machine, a mean has not.
    mean = settings.dtype.type(
        np.cumsum(target[counted], dtype=np.float64)[-1] / np.count_nonzero(counted)
    )
    present = np.where(finite, target, mean)
    if density == 0:
        return _search(present, counted, transform, settings, 1, NEARBY)
    starts = (present, np.where(counted, target, mean))
    results = [_search(start, counted, transform, settings, 1) for start in starts]
    bits = [_bits(values, transform, settings) for values in results]
    better = bits.index(min(bits))
    result = results[better]
    if density > 1 and bits[better] >= FEW_BITS:
        result = _search(starts[better], counted, transform, settings, density)
    # Bits are a rough measure: smooth values of many bits may be coded in few bytes.
    if _size(present, transform, settings) <= _size(result, transform, settings):
        return present
    return result


def _bits(values: Values, transform: Transform, settings: TileSettings) -> int:
    """Bits of the magnitudes of all quantised coefficients."""
    integers = quantise(transform.forward(values), settings.step)[0]
    return int(np.frexp(integers.astype(np.float32))[1].sum(dtype=np.int64))


def _size(values: Values, transform: Transform, settings: TileSettings) -> int:
    """Bytes of the coded coefficients."""
    table = band_table(settings.transform, values.shape)
    integers = quantise(transform.forward(values), settings.step)[0]
    return len(encode_integers(integers, table).data)


def _search(
    start: Values,
    counted: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int,
    threshold: float = HIGHEST,
) -> Values:
    """The values where the search ends; `density` as in `filled`, `threshold` the first one."""
    kind = settings.dtype.type
    current, guess = start, start
    while threshold > LOWEST:
        coefficients = transform.forward(guess)
        coefficients[np.abs(coefficients) < kind(threshold * settings.step)] = 0
        before, current = current, np.where(counted, start, transform.inverse(coefficients))
        guess = current + kind(MOMENTUM) * (current - before)
        threshold *= RATIOS[density]
    return current


_END_MARGIN = 1e-4
"""Values within this share of the range from one of its ends count as lying at that end."""

_FEW = 0.03
"""Share of a tile's values that must be free to change, so that changing them is worth its time."""


@dataclass(frozen=True, kw_only=True)
class Coding:
    """Options of the encoder: how hard it works, what it keeps. A decoder needs none of them.

    Attributes:
        weight: squared quantiser steps that a bit is worth in rate-distortion optimisation; 0 for
            none.
        error: bound on |decoded - value| at every counted value, in units of the values. It is kept
            strictly; a tile that cannot keep it is stored without loss. None for no bound.
        rounds: how often the values that are free to change are replaced by their decoded values.
        rough: whether these are those of the nearest integers, and not of those that are chosen.
        passes: 2 codes the integers that the optimisation chose once more, or searches the path
            through the trellis once more; 1 does not.
        filled: whether the values that are not counted are a good filling already, such as repeated
            border values. Otherwise the encoder looks for a better one.
        density: how thoroughly it looks; see `filling.filled`.
        keep_missing: whether values that are not finite come back as they were.
        own_settings: whether the stream holds the settings.
        fast: whether coefficients and residual are coded by the fast coder, for more bytes.
    """

    weight: float = 0.0
    error: float | None = None
    rounds: int = 0
    rough: bool = False
    passes: int = 1
    filled: bool = False
    density: int = 1
    keep_missing: bool = True
    own_settings: bool = False
    fast: bool = False


_DEFAULT_CODING = Coding()


@dataclass(frozen=True, kw_only=True)
class CodedTile:
    """A coded tile.

    Attributes:
        data: the stream.
        decoded: the values that the stream decodes to, in the type of the source.
        nonzero: number of coded integers that are not 0.
    """

    data: bytes
    decoded: Values
    nonzero: int


def encode_tile(
    values: Values,
    settings: TileSettings,
    coding: Coding = _DEFAULT_CODING,
    *,
    in_coreset: Mask | None = None,
) -> CodedTile:
    """Code the values of a tile.

    Args:
        values: the tile (t, z, y, x), of any real type, with the origin of the settings.
        settings: transform, step, range and so on.
        coding: options of the encoder.
        in_coreset: the values that count, of the same shape; None for all. Values that are not
            finite never count.

    Raises InputError for values that have no differences from the origin.
    """
    if settings.origin:
        assert settings.differences_of(values.dtype) == np.int64
        coded = _encode(about_origin(values, settings.origin), settings, coding, in_coreset)
        decoded = at_origin(coded.decoded, settings.origin, values.dtype)
        return replace(coded, decoded=decoded)
    return _encode(values, settings, coding, in_coreset)


def _encode(
    values: Values, settings: TileSettings, coding: Coding, in_coreset: Mask | None
) -> CodedTile:
    """The coded values of a tile less the origin of its settings."""
    task = _task(values, settings, coding, in_coreset)
    if not task.values.size or (task.counted is not None and not task.counted.any()):
        return _empty_tile(task)
    lossless: list[CodedTile] = []
    labelled = _labelled_tile(task) if settings.labels else None
    if labelled is not None:
        lossless = [labelled, task.exact()]
        if 4 * len(labelled.data) < len(lossless[1].data):
            return labelled  # nothing else is that small
    if settings.predictor is not None and coding.error is not None:
        coded = _predicted_tile(task, settings.predictor, coding.error)
    else:
        coded = _transformed_tile(task)
    return min([coded, *lossless], key=lambda tile: len(tile.data))


def exact_tile(
    values: Values,
    settings: TileSettings | None = None,
    occupied: Mask | None = None,
    *,
    origin: int = 0,
) -> CodedTile:
    """A tile stored without loss: its bytes, those of equal weight together, deflated.

    Args:
        values: the tile (t, z, y, x), of any real type.
        settings: settings to put into the stream; None for none.
        occupied: the mask, for a stream with one. Values outside of it become NaN, or 0 for
            integers.
        origin: integer that is subtracted from the values, where they have not lost it yet.
    """
    if origin:
        coded = exact_tile(about_origin(values, origin), settings, occupied)
        return replace(coded, decoded=at_origin(coded.decoded, origin, values.dtype))
    if occupied is not None:
        blank = values.dtype.type(np.nan if values.dtype.kind == "f" else 0)
        values = np.where(occupied, values, blank)
    data = build_exact_stream(values, settings, occupied)
    return CodedTile(data=data, decoded=values.copy(), nonzero=0)


def labelled_tile(
    values: Values,
    settings: TileSettings | None = None,
    occupied: Mask | None = None,
    most: int = MAX_LABELS,
) -> CodedTile | None:
    """A tile stored as labels, without loss; None for one of too many different values.

    The arguments are those of `exact_tile`, and `most` of `labelled_stream`.
    """
    data = labelled_stream(values, settings, occupied, most)
    return None if data is None else CodedTile(data=data, decoded=values.copy(), nonzero=0)


@dataclass(frozen=True, kw_only=True)
class _Task:
    """A tile to code.

    Attributes:
        values: the tile, in C order.
        settings: its settings.
        coding: options of the encoder.
        finite: where the values are finite; None where all are.
        counted: where they are finite and in the coreset; None where all are.
        missing: the section of missing values.
    """

    values: Values
    settings: TileSettings
    coding: Coding
    finite: Mask | None
    counted: Mask | None
    missing: bytes

    @property
    def shape(self) -> Shape:
        """Shape of the tile."""
        t, z, y, x = self.values.shape
        return t, z, y, x

    @property
    def own_settings(self) -> TileSettings | None:
        """The settings to put into the stream, if any."""
        return self.settings if self.coding.own_settings else None

    @property
    def occupied(self) -> Mask | None:
        """The mask of the stream; None for a stream without one."""
        if self.settings.mask is None:
            return None
        return np.ones(self.values.shape, bool) if self.counted is None else self.counted

    def mask_section(self, linear: Values) -> bytes | None:
        """The section of the mask. linear: decoded values before head and residual."""
        occupied = self.occupied
        if occupied is None or self.settings.mask is None:
            return None
        return pack_mask(
            occupied, self.settings.mask.levels(linear.astype(self.settings.dtype, copy=False))
        )

    def exact(self) -> CodedTile:
        """The tile stored without loss."""
        return exact_tile(self.values, self.own_settings, self.occupied)

    def coded(self, data: bytes, decoded: Values, nonzero: int) -> CodedTile:
        """The coded tile, with unoccupied and missing values as a decoder gives them.

        decoded: decoded values in the type of the source; changed in place.
        """
        decoded = blank_unoccupied(decoded, self.occupied, self.settings)
        decoded = restore_missing(decoded, self.missing)
        return CodedTile(data=data, decoded=decoded, nonzero=nonzero)


def _task(values: Values, settings: TileSettings, coding: Coding, in_coreset: Mask | None) -> _Task:
    values = np.ascontiguousarray(values)
    finite = None if all_finite(values) else np.isfinite(values)
    counted = finite if in_coreset is None else in_coreset
    if in_coreset is not None and finite is not None:
        counted = finite & in_coreset
    if counted is not None and counted.all():
        counted = None
    missing = b"" if finite is None or not coding.keep_missing else pack_missing(values, finite)
    return _Task(
        values=values,
        settings=settings,
        coding=coding,
        finite=finite,
        counted=counted,
        missing=missing,
    )


def _labelled_tile(task: _Task) -> CodedTile | None:
    """A tile of labels, without loss; None for one of too many different values."""
    tile = labelled_tile(task.values, task.own_settings, task.occupied)
    if tile is None:
        return None
    decoded = blank_unoccupied(tile.decoded, task.occupied, task.settings)
    return CodedTile(data=tile.data, decoded=decoded, nonzero=0)


def _empty_tile(task: _Task) -> CodedTile:
    """A tile in which no value counts."""
    mask = None if task.occupied is None else b""
    data = build_stream(EMPTY, task.own_settings, task.missing, mask=mask)
    center = np.full(task.values.shape, task.settings.center)
    return task.coded(data, cast(center, task.values.dtype), 0)


def _predicted_tile(task: _Task, predictor: Predictor, error: float) -> CodedTile:
    """A tile coded by prediction; stored without loss where that cannot keep the bound."""
    integers = integers_of(task.values, task.counted, predictor)
    if integers is None:
        return task.exact()
    data, integers = encode_predicted(integers, task.counted, predictor)
    linear = predicted_values(integers, predictor, task.settings)
    decoded = within_range(cast(linear, task.values.dtype), task.settings)
    if not within(task.values, decoded, error, task.counted):
        return task.exact()
    mask = task.mask_section(linear)
    stream = build_stream(PREDICTED, task.own_settings, task.missing, data, mask=mask)
    return task.coded(stream, decoded, int(np.count_nonzero(integers)))


def _transformed_tile(task: _Task) -> CodedTile:
    """A tile coded by transform.

    It is stored without loss where that cannot keep the bound, and where the quantiser step is too
    fine for its coefficients.
    """
    settings, error = task.settings, task.coding.error
    transform = transform_for(settings, task.shape)
    target = _target(task, transform)
    coefficients = _free_coefficients(task, transform, target)
    weight, passes, fast = task.coding.weight, task.coding.passes, task.coding.fast
    coded = code_coefficients(coefficients, settings, weight, passes, fast=fast)
    if coded is None:
        return task.exact()
    data, integers = coded
    linear = linear_values(integers, transform, settings)
    mask = task.mask_section(linear)
    base = linear if settings.head is None else settings.head.apply(linear)
    residual = None
    if error is not None:
        result = residual_of(task.values, base, task.counted, settings.quantum, MAX_INTEGER)
        if result is None:
            return task.exact()
        residual = result[0] if result[1] else None
    decoded = corrected(base, residual, settings.quantum, task.values.dtype)
    decoded = within_range(decoded, settings)
    if error is not None and not within(task.values, decoded, error, task.counted):
        return task.exact()
    own = task.own_settings
    stream = build_stream(TRANSFORMED, own, task.missing, data, residual, mask, fast=fast)
    return task.coded(stream, decoded, int(np.count_nonzero(integers)))


def _target(task: _Task, transform: Transform) -> Values:
    """The values to transform: about the centre, in the working type, filled where not counted."""
    values, settings = task.values, task.settings
    finite = values
    if task.finite is not None:
        finite = np.where(task.finite, values, values.dtype.type(0))
    target: Values = finite.astype(settings.dtype)
    target -= settings.dtype.type(settings.center)
    if task.counted is None:
        return target
    if not (task.coding.filled and task.finite is None):
        present = np.ones(values.shape, bool) if task.finite is None else task.finite
        target = filled(target, task.counted, present, transform, settings, task.coding.density)
    if settings.transform.axes[0].kind == "none":
        # No step helps another: those beyond the end of a series take the fewest bytes as zeros.
        steps = np.flatnonzero(task.counted.any(axis=(1, 2, 3)))
        target[steps[-1] + 1 :] = 0
    return target


def _free_coefficients(task: _Task, transform: Transform, target: Values) -> Values:
    """The coefficients of the target after `Coding.rounds` replacements of its free values.

    Free values are those that do not count, and those at an end of the range that decode to values
    beyond it, since the decoder clips them. `target` is changed in place.
    """
    settings = task.settings
    margin = (settings.high - settings.low) * _END_MARGIN
    low = settings.low - settings.center + margin
    high = settings.high - settings.center - margin
    coefficients = transform.forward(target)
    ends = (target <= settings.dtype.type(low)) | (target >= settings.dtype.type(high))
    free = np.count_nonzero(ends if task.counted is None else ends | ~task.counted)
    for _ in range(task.coding.rounds if free > _FEW * target.size else 0):
        step, offsets = settings.step, settings.offsets
        integers: Integers | None
        if task.coding.rough:
            step, offsets = plain_step(settings), OFFSETS
            integers, _ = quantise(coefficients, step)
        else:
            integers = choose_integers(coefficients, settings, task.coding.weight)
        if integers is None:
            break
        rebuilt = transform.inverse(dequantise(integers, step, offsets, settings.dtype))
        freed = free_values(target, rebuilt, task.counted, low, high)
        if not freed:
            break
        coefficients = transform.forward(target)
        if freed < _FEW * target.size:
            break
    return coefficients
