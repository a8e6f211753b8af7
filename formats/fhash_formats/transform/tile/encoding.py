"""One tile to bytes: transform, quantise, code, correct, bound. The way back is in decoding.py, the bytes are described in sections.py.

Encoding and decoding compute the same values by the same operations in the same order, so that the encoder knows what every decoder gets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.entropy.coder import MAX_INTEGER, encode_integers
from fhash_formats.transform.entropy.predict import encode_predicted, integers_of
from fhash_formats.transform.entropy.predictor import Predictor
from fhash_formats.transform.tile.decoding import (
    decode_tile,
    decode_tile_mask,
    linear_values,
    outside,
    predicted_values,
    transform_for,
)
from fhash_formats.transform.tile.filling import filled as filled_in
from fhash_formats.transform.tile.sections import (
    Shape,
    assembled,
    exact_bytes,
    pack_mask,
    pack_missing,
    restored,
)
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.elementwise import (
    all_finite,
    cast,
    corrected,
    free_values,
    residual_of,
    within,
)
from fhash_formats.transform.values.quantise import dequantise, quantise

__all__ = [
    "CodedTile",
    "Shape",
    "decode_tile",
    "decode_tile_mask",
    "encode_tile",
    "exact_tile",
    "transform_for",
    "within",
]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class CodedTile:
    """data: the stream. decoded: what it decodes to, in the type of the source. nonzero: coefficients that are not 0."""

    data: bytes
    decoded: Values
    nonzero: int


def encode_tile(
    values: Values,
    settings: TileSettings,
    *,
    care: Mask | None = None,
    weight: float = 0.0,
    error: float | None = None,
    rounds: int = 0,
    passes: int = 1,
    own: bool = False,
    keep_missing: bool = True,
    filled: bool = False,
    density: int = 1,
) -> CodedTile:
    """Code values (t, z, y, x) of any real type.

    care: what counts (bool, same shape; None is all). Values that are not finite never count. weight: squared steps that a bit is worth to
    the rate-distortion optimisation, 0 for none. error: a bound on |decoded - value| wherever it counts, in units of the values: kept
    strictly, exactly stored if need be. rounds: projections of what does not count. passes: 2 codes the chosen integers once more.
    own: put the settings into the stream. keep_missing: bring back values that are not finite as they were. filled: values that
    do not count are sensible already (a border that was repeated), so that nothing better is looked for; else density says how
    thoroughly (see `filling.filled`).
    """
    values = np.ascontiguousarray(values)
    finite = None if all_finite(values) else np.isfinite(values)
    counts = finite if care is None else care if finite is None else finite & care
    if counts is not None and counts.all():
        counts = None  # all does
    missing = b"" if finite is None or not keep_missing else pack_missing(values, finite)
    occupied = (
        None if settings.mask is None else np.ones(values.shape, bool) if counts is None else counts
    )
    if not values.size or (counts is not None and not counts.any()):
        decoded = outside(
            cast(np.full(values.shape, settings.center), values.dtype), occupied, settings
        )
        data = assembled(
            settings if own else None, missing, b"", None, None, None if occupied is None else b""
        )
        return CodedTile(data=data, decoded=restored(decoded, missing), nonzero=0)
    if settings.predictor is not None and error is not None:
        return _predicted_tile(values, settings, settings.predictor, counts, error, missing, own)
    transform = transform_for(settings, values.shape)
    table = band_table(settings.transform, values.shape)
    target = (values if finite is None else np.where(finite, values, values.dtype.type(0))).astype(
        settings.dtype
    )
    target -= settings.dtype.type(settings.center)
    if counts is not None and not (filled and finite is None):
        target = filled_in(
            target,
            counts,
            np.ones(values.shape, bool) if finite is None else finite,
            transform,
            settings,
            density,
        )
    coefficients = transform.forward(target)
    for _ in range(rounds):
        integers, scaled = quantise(coefficients, settings.step)
        if weight > 0:
            integers = encode_integers(integers, table, scaled=scaled, weight=weight).integers
        rebuilt = transform.inverse(
            dequantise(integers, settings.step, settings.offsets, settings.dtype)
        )
        # What lies at an end of the range may decode to anything beyond it.
        margin = (settings.high - settings.low) * 1e-4
        if not free_values(
            target,
            rebuilt,
            counts,
            settings.low - settings.center + margin,
            settings.high - settings.center - margin,
        ):
            break
        coefficients = transform.forward(target)
    integers, scaled = quantise(coefficients, settings.step)
    coded = encode_integers(integers, table, scaled=scaled if weight > 0 else None, weight=weight)
    if passes > 1 and weight > 0:
        coded = encode_integers(coded.integers, table)
    linear = linear_values(coded.integers, transform, settings)
    mask = (
        None
        if occupied is None or settings.mask is None
        else pack_mask(occupied, settings.mask.levels(linear))
    )
    base = linear if settings.head is None else settings.head.apply(linear)
    residual = None
    if error is not None:
        found = residual_of(values, base, counts, settings.quantum, MAX_INTEGER)
        if found is None:
            return exact_tile(values, settings if own else None, occupied)
        residual = found[0] if found[1] else None
    decoded = corrected(base, residual, settings.quantum, values.dtype)
    if error is not None and not within(values, decoded, error, counts):
        return exact_tile(values, settings if own else None, occupied)
    data = assembled(settings if own else None, missing, coded.data, coded.integers, residual, mask)
    decoded = restored(outside(decoded, occupied, settings), missing)
    return CodedTile(data=data, decoded=decoded, nonzero=int(np.count_nonzero(coded.integers)))


def _predicted_tile(
    values: Values,
    settings: TileSettings,
    predictor: Predictor,
    counts: Mask | None,
    error: float,
    missing: bytes,
    own: bool,
) -> CodedTile:
    """Code by prediction; exactly where that cannot keep the bound."""
    occupied = (
        None if settings.mask is None else np.ones(values.shape, bool) if counts is None else counts
    )
    integers = integers_of(values, counts, predictor)
    if integers is None:
        return exact_tile(values, settings if own else None, occupied)
    coded, integers = encode_predicted(integers, counts, predictor)
    linear = predicted_values(integers, predictor, settings)
    decoded = cast(linear, values.dtype)
    if not within(values, decoded, error, counts):
        return exact_tile(values, settings if own else None, occupied)
    mask = (
        None
        if occupied is None or settings.mask is None
        else pack_mask(occupied, settings.mask.levels(linear.astype(settings.dtype)))
    )
    data = assembled(
        settings if own else None, missing, coded, integers, None, mask, predicted=True
    )
    return CodedTile(
        data=data,
        decoded=restored(outside(decoded, occupied, settings), missing),
        nonzero=int(np.count_nonzero(integers)),
    )


def exact_tile(
    values: Values, settings: TileSettings | None = None, occupied: Mask | None = None
) -> CodedTile:
    """A tile stored without loss: its bytes, those of equal weight together, deflated.

    occupied: the mask, for a stream with one; outside of it stands NaN, or 0 for whole numbers.
    """
    if occupied is not None:
        values = np.where(
            occupied, values, values.dtype.type(np.nan if values.dtype.kind == "f" else 0)
        )
    return CodedTile(data=exact_bytes(values, settings, occupied), decoded=values.copy(), nonzero=0)
