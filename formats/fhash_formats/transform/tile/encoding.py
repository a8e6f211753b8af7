"""One tile to bytes: fill, transform, quantise, code, correct, bound.

decoding.py is the way back, and sections.py describes the bytes. The encoder computes the decoded
values by the same operations in the same order as a decoder, so it knows what every decoder gets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.axes.lifting import Transform
from fhash_formats.transform.entropy.coder import MAX_INTEGER
from fhash_formats.transform.entropy.labels import MAX_LABELS
from fhash_formats.transform.entropy.predict import encode_predicted, integers_of
from fhash_formats.transform.entropy.predictor import Predictor
from fhash_formats.transform.tile.decoding import (
    blank_unoccupied,
    linear_values,
    predicted_values,
    transform_for,
    within_range,
)
from fhash_formats.transform.tile.filling import filled
from fhash_formats.transform.tile.integers import choose_integers, code_coefficients
from fhash_formats.transform.tile.labelled import labelled_stream
from fhash_formats.transform.tile.sections import (
    EMPTY,
    PREDICTED,
    TRANSFORMED,
    Shape,
    build_exact_stream,
    build_stream,
    pack_mask,
    pack_missing,
    restore_missing,
)
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.elementwise import (
    about_origin,
    all_finite,
    at_origin,
    cast,
    corrected,
    free_values,
    residual_of,
    within,
)
from fhash_formats.transform.values.quantise import dequantise

__all__ = ["CodedTile", "Coding", "encode_tile", "exact_tile", "labelled_tile"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

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
        passes: 2 codes the integers that the optimisation chose once more, or searches the path
            through the trellis once more; 1 does not.
        filled: whether the values that are not counted are a good filling already, such as repeated
            border values. Otherwise the encoder looks for a better one.
        density: how thoroughly it looks; see `filling.filled`.
        keep_missing: whether values that are not finite come back as they were.
        own_settings: whether the stream holds the settings.
    """

    weight: float = 0.0
    error: float | None = None
    rounds: int = 0
    passes: int = 1
    filled: bool = False
    density: int = 1
    keep_missing: bool = True
    own_settings: bool = False


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
    coded = code_coefficients(coefficients, settings, task.coding.weight, task.coding.passes)
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
    stream = build_stream(TRANSFORMED, task.own_settings, task.missing, data, residual, mask)
    return task.coded(stream, decoded, int(np.count_nonzero(integers)))


def _target(task: _Task, transform: Transform) -> Values:
    """The values to transform: about the centre, in the working type, filled where not counted."""
    values, settings = task.values, task.settings
    finite = values
    if task.finite is not None:
        finite = np.where(task.finite, values, values.dtype.type(0))
    target: Values = finite.astype(settings.dtype)
    target -= settings.dtype.type(settings.center)
    if task.counted is None or (task.coding.filled and task.finite is None):
        return target
    present = np.ones(values.shape, bool) if task.finite is None else task.finite
    return filled(target, task.counted, present, transform, settings, task.coding.density)


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
        integers = choose_integers(coefficients, settings, task.coding.weight)
        if integers is None:
            break
        rebuilt = transform.inverse(
            dequantise(integers, settings.step, settings.offsets, settings.dtype)
        )
        freed = free_values(target, rebuilt, task.counted, low, high)
        if not freed:
            break
        coefficients = transform.forward(target)
        if freed < _FEW * target.size:
            break
    return coefficients
