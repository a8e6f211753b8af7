"""One tile of `fhash.transform`: its bytes to values, in the order of FORMAT.md's section Decoding.

A stream is a byte of flags, a digest of the coded integers, and sections.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.bands import bands_of
from reference.head import apply_head, unpack_head
from reference.integers import decode_block, decode_integers
from reference.labels import unpack_labelled
from reference.masks import mask_levels, unpack_mask
from reference.predictor import decode_predicted, passes_of
from reference.transform import axis_of, inverse

Values = npt.NDArray[Any]
Settings = dict[str, Any]

OWN, MISSING, RESIDUAL, EXACT, EMPTY = 1, 2, 4, 8, 16
"""Bits of the flags."""
MANY = 16
"""Bit of the flags of a stream of labels that are many."""
PLAIN, MASKED, PREDICTED, PREDICTED_MASKED, LABELS, LABELS_MASKED = range(1, 7)
"""Numbers in the upper three bits of the flags."""


class Stream:
    """The parts of a stream.

    Attributes:
        flags: the first byte; its upper three bits are `number`.
        sections: the sections by name.
        digest: CRC-32 of the coded integers, where there are some.
        settings: its own settings, or those that it shares.
        shape, kind: of the tile (t, z, y, x), less the origin.
    """

    def __init__(self, data: memoryview, shape: Sequence[int], dtype: Any, shared: Any) -> None:
        self.flags, self.number = data[0], data[0] >> 5
        self.labelled = self.number in (LABELS, LABELS_MASKED)
        self.predicted = self.number in (PREDICTED, PREDICTED_MASKED)
        self.masked = self.number in (MASKED, PREDICTED_MASKED, LABELS_MASKED)
        coded = not self.labelled and not self.flags & (EXACT | EMPTY)
        names = ["settings"] * bool(self.flags & OWN)
        if self.labelled:
            names.append("labels")
        else:
            names += ["missing"] * bool(self.flags & MISSING)
            names += ["coefficients"] * coded + ["residual"] * bool(coded and self.flags & RESIDUAL)
            names += ["exact"] * bool(self.flags & EXACT)
            names += ["mask"] * (self.masked and not self.flags & EMPTY)
        found = sections_in(data[5 if coded else 1 :])
        self.sections = dict(zip(names, found, strict=True))
        self.digest = int.from_bytes(data[1:5], "little")
        own = self.sections.get("settings")
        self.settings: Settings = shared or {} if own is None else json.loads(zlib.decompress(own))
        self.shape, self.origin = tuple(shape), self.settings.get("origin", 0)
        self.kind = np.dtype(np.int64 if self.origin else dtype)
        self.working = np.dtype(np.float64 if self.settings.get("double") else np.float32)


def sections_in(data: memoryview) -> Iterator[memoryview]:
    """Sections, each behind its length (LEB128)."""
    while data:
        size = shift = 0
        while True:
            byte, data = data[0], data[1:]
            size |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        yield data[:size]
        data = data[size:]


def decode_tile(
    data: bytes, shape: Sequence[int], dtype: Any, settings: Settings | None = None
) -> tuple[Values, Values | None]:
    """The values (t, z, y, x) of a stream, and which are occupied; None without a mask.

    Args:
        data: the stream.
        shape: lengths of the tile along t, z, y, x.
        dtype: type of the array.
        settings: settings that all tiles of the array share; a stream's own replace them.
    """
    stream = Stream(memoryview(data), shape, dtype, settings)
    values, mask = decode_stream(stream)
    if stream.origin:
        limits = np.iinfo(dtype)
        sums = [min(max(int(v) + stream.origin, limits.min), limits.max) for v in values.flat]
        values = np.array(sums, dtype).reshape(stream.shape)
    return values, mask


def decode_stream(stream: Stream) -> tuple[Values, Values | None]:
    """The values of a stream less the origin, and its mask."""
    sections, kind, settings = stream.sections, stream.kind, stream.settings
    nothing = np.zeros(stream.shape, int)
    if stream.labelled:
        many = bool(stream.flags & MANY)
        values, mask = unpack_labelled(sections["labels"], stream.shape, kind, stream.masked, many)
        return blanked(values.astype(kind), mask, settings), mask
    if stream.flags & EXACT:
        plain = np.frombuffer(zlib.decompress(sections["exact"]), np.uint8)
        planes = np.ascontiguousarray(plain.reshape(kind.itemsize, -1).T)
        values = planes.view(kind.newbyteorder("<")).reshape(stream.shape).astype(kind)
        return values, unpack_mask(sections["mask"], (nothing, nothing)) if stream.masked else None
    if stream.flags & EMPTY:
        values = cast(np.full(stream.shape, float(settings["center"])), kind)
        mask = np.zeros(stream.shape, bool) if stream.masked else None
    else:
        before, values = predicted(stream) if stream.predicted else transformed(stream)
        mask = None
        if stream.masked:
            levels = mask_levels(before.astype(stream.working), settings["mask"])
            mask = unpack_mask(sections["mask"], levels)
        if settings.get("clip"):
            low, high = (in_type(end, kind) for end in settings["range"])
            values = np.where(values < low, low, np.where(values > high, high, values))
    values = blanked(values, mask, settings)
    if "missing" in sections:
        marks = decode_block(sections["missing"][4:], stream.shape)
        check(marks, int.from_bytes(sections["missing"][:4], "little"))
        for mark, value in ((1, np.nan), (2, np.inf), (3, -np.inf)):
            values[marks == mark] = value
    return values, mask


def predicted(stream: Stream) -> tuple[Values, Values]:
    """The values of a tile coded by prediction: in float64, and in their type."""
    predictor = stream.settings["predictor"]
    passes = passes_of(predictor, base64.b64decode)
    coded = stream.sections["coefficients"]
    integers = decode_predicted(coded, stream.shape, predictor["levels"], passes)
    check(integers, stream.digest)
    values = integers * np.float64(predictor["step"]) + np.float64(predictor["origin"])
    values = np.clip(values, *map(np.float64, stream.settings["range"]))
    return values, cast(values, stream.kind)


def transformed(stream: Stream) -> tuple[Values, Values]:
    """The values of a tile coded by transform: before head and residual, and in their type."""
    settings, shape, number = stream.settings, stream.shape, stream.working.type
    axes = [axis_of(settings["transform"][name], base64.b64decode) for name in "tzyx"]
    coded, trellis = stream.sections["coefficients"], settings.get("trellis", False)
    integers = decode_integers(coded, shape, bands_of(axes, shape), trellis)
    residual = None
    if "residual" in stream.sections:
        residual = decode_block(stream.sections["residual"], shape)
    check(integers, stream.digest, residual)
    with np.errstate(all="ignore"):
        coefficients = dequantised(integers, settings, stream.working)
        values = inverse(coefficients, axes) + number(settings["center"])
        before = after = np.clip(values, *(number(end) for end in settings["range"]))
        if "head" in settings:
            after = apply_head(before, unpack_head(base64.b64decode(settings["head"])))
        if residual is not None:
            after = after.astype(np.float64) + residual * np.float64(settings["quantum"])
    return before, cast(after, stream.kind)


def dequantised(integers: Values, settings: Settings, working: np.dtype[Any]) -> Values:
    """The coefficients of integers: a magnitude m > 0 stands for m + offset / 128 steps."""
    offsets = settings.get("offsets", [0] * (6 if settings.get("trellis") else 3))
    one, two, *more = offsets  # of magnitudes 1, 2, 3, 4, of odd ones from 5, of even ones from 6
    shifts = np.array([0, one, two, *(more if len(more) > 1 else more * 4)]) / 128
    magnitude = np.abs(integers)
    which = np.where(magnitude < 5, magnitude, 6 - (magnitude & 1))
    values = magnitude.astype(working) + shifts.astype(working)[which]
    values = values * working.type(settings["step"])
    return np.where(integers < 0, -values, values)


def check(integers: Values, digest: int, residual: Values | None = None) -> None:
    """Raises ValueError where decoded integers differ from their CRC-32."""
    crc = zlib.crc32(integers.astype("<i4").tobytes())
    if residual is not None:
        crc = zlib.crc32(residual.astype("<i4").tobytes(), crc)
    if crc != digest:
        raise ValueError("the decoded integers of a tile differ from their digest")


def cast(values: Values, kind: np.dtype[Any]) -> Values:
    """Floats in a type: rounded to nearest, and for integers clipped to what they hold."""
    with np.errstate(over="ignore"):
        if kind.kind == "f":
            return values.astype(kind)
    limits = np.iinfo(kind)
    low, high = float(limits.min), float(limits.max)
    if int(high) > limits.max:  # float64 has not all large integers
        high = float(np.nextafter(high, 0.0))
    return np.clip(np.rint(np.nan_to_num(values.astype(np.float64))), low, high).astype(kind)


def in_type(end: Any, kind: np.dtype[Any]) -> Any:
    """An end of the range in the type of the array; exact where both are integers."""
    if isinstance(end, int) and kind.kind != "f":
        limits = np.iinfo(kind)
        return kind.type(min(max(end, limits.min), limits.max))
    return cast(np.array([float(end)]), kind)[0]


def blanked(values: Values, mask: Values | None, settings: Settings) -> Values:
    """Values with NaN, or the centre for integers, where the mask is 0."""
    if mask is not None and settings:
        blank = np.nan if values.dtype.kind == "f" else float(settings["center"])
        values[~mask] = cast(np.array([blank]), values.dtype)[0]
    return values


def chunk_of(tile: Values, axes: Sequence[str] | None, shape: Sequence[int]) -> Values:
    """The chunk of an array from its tile: `axes` names the tile's axis of each of its own.

    Args:
        tile: values (t, z, y, x).
        axes: key `axes` of the codec; None for the last axes of t, z, y, x.
        shape: lengths of the chunk.
    """
    if axes is None:
        return tile.reshape(shape)
    named = [axis for axis in "tzyx" if axis in axes]
    lengths = [tile.shape["tzyx".index(axis)] for axis in named]
    order = [named.index(axis) for axis in axes if axis]
    return tile.reshape(lengths).transpose(order).reshape(shape)
