"""One tile of `fhash.transform`: its bytes to values, as FORMAT.md's section Decoding says."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from numcodecs.zstd import decompress

from reference.bands import WAVELETS, Band, bands_of, lengths, single_band
from reference.fast import decode_fast
from reference.head import apply_head, unpack_head
from reference.integers import decode_integers
from reference.labels import LabelDecoder, number_in, unpack_labelled, unpack_planes
from reference.masks import mask_levels, unpack_mask
from reference.predictor import decode_predicted, passes_of
from reference.transform import Axis, inverse, is_coupled, unpack_basis

Values = npt.NDArray[Any]
Settings = dict[str, Any]

TRANSFORMED, PREDICTED, LABELS, EXACT, EMPTY, DIFFERENCES, BLOCKS = range(7)
"""Kinds of streams, the lower three bits of the flags."""
OWN, MISSING, RESIDUAL, MASKED, FAST = 8, 16, 32, 64, 128
"""Other bits of the flags."""


class Stream:
    """The parts of a stream.

    Attributes:
        kind: what it is, and `masked` whether it says which values are occupied, `fast` whether its
            integers are those of the fast coder.
        sections: the sections by name.
        settings: its own settings, or those that it shares.
        shape, dtype: of the tile (t, z, y, x), less the origin.
    """

    def __init__(
        self, data: memoryview, shape: Sequence[int], dtype: Any, shared: Settings | None
    ) -> None:
        if crc32c(data[4:]) != int.from_bytes(data[:4], "little"):
            raise ValueError("the checksum of a tile differs")
        flags, data = data[4], data[5:]
        self.kind, self.masked, self.fast = flags & 7, bool(flags & MASKED), bool(flags & FAST)
        there = {
            "settings": flags & OWN,
            "missing": flags & MISSING,
            "body": self.kind != EMPTY,
            "residual": flags & RESIDUAL,
            "mask": self.masked and self.kind not in (EMPTY, LABELS),
        }
        names = [name for name in there if there[name]]
        self.sections = {}
        for name in names[:-1]:
            size, data = number_in(data)
            self.sections[name], data = data[:size], data[size:]
        self.sections |= {name: data for name in names[-1:]}
        own = self.sections.get("settings")
        self.settings = shared or {} if own is None else unpack_settings(own)
        self.shape, self.origin = tuple(shape), self.settings.get("origin", 0)
        self.dtype = np.dtype(np.int64 if self.origin else dtype)
        self.working = np.dtype(np.float64 if self.settings.get("double") else np.float32)


def crc32c(data: bytes | memoryview) -> int:
    """The checksum of some bytes, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def unpack_settings(data: bytes | memoryview) -> Settings:
    """The settings in a block."""
    rest = memoryview(data)

    def take(form: str) -> tuple[Any, ...]:
        nonlocal rest
        size = struct.calcsize("<" + form)
        numbers, rest = struct.unpack("<" + form, rest[:size]), rest[size:]
        return numbers

    def block() -> bytes:
        nonlocal rest
        size, rest = number_in(rest)
        return take(f"{size}s")[0]

    flags, *kinds = take("5B")
    names = ("double", "clip", "labels", "trellis", "whole", "head", "mask", "predictor")
    settings: Settings = {name: bool(flags >> bit & 1) for bit, name in enumerate(names)}
    whole, has_head, has_mask, has_predictor = map(settings.pop, names[4:])
    settings |= zip(("step", "quantum", "center"), take("3d"), strict=True)
    settings["range"] = take("2q" if whole else "2d")
    if whole:
        settings["origin"] = int.from_bytes(take("9s")[0], "little", signed=True)
    settings["offsets"] = take("6b")
    settings["axes"] = [
        Axis("klt", basis=unpack_basis(block()))
        if kind >> 4 == 4
        else Axis(("none", "haar", "5/3", "9/7")[kind >> 4], kind & 15)
        for kind in kinds
    ]
    if has_head:
        settings["head"] = unpack_head(block())
    if has_mask:
        (count,) = take("B")
        edges, (reach,) = take(f"{count & 127}d"), take("B")
        scores = [take(f"{len(edges) + 1}H") for _ in range(1 + (count >> 7))]
        settings["mask"] = {"edges": edges, "reach": reach, "scores": scores}
    if has_predictor:
        step, origin, *levels, order, reach = take("2d6B")
        passes = passes_of(levels, [order >> 2 * i & 3 for i in range(4)], reach, block())
        settings["predictor"] = {"step": step, "origin": origin, "levels": levels, "passes": passes}
    return settings


def decode_tile(
    data: bytes, shape: Sequence[int], dtype: Any, settings: bytes | None = None
) -> tuple[Values, Values | None]:
    """The values (t, z, y, x) of a stream, and which are occupied; None without a mask.

    Args:
        data: the stream.
        shape: lengths of the tile along t, z, y, x.
        dtype: type of the array.
        settings: block that all tiles of the array share; a stream's own settings replace it.
    """
    shared = None if settings is None else unpack_settings(settings)
    stream = Stream(memoryview(data), shape, dtype, shared)
    values, mask = decode_stream(stream)
    if stream.origin:
        limits = np.iinfo(dtype)
        sums = [min(max(int(v) + stream.origin, limits.min), limits.max) for v in values.flat]
        values = np.array(sums, dtype).reshape(stream.shape)
    return with_missing(values, stream.sections.get("missing"), stream.shape), mask


def decode_stream(stream: Stream) -> tuple[Values, Values | None]:
    """The values of a stream less the origin, and its mask."""
    sections, dtype, settings = stream.sections, stream.dtype, stream.settings
    nothing = np.zeros(stream.shape, int)
    if stream.kind == LABELS:
        values, mask = unpack_labelled(sections["body"], stream.shape, dtype, stream.masked)
        return blanked(values.astype(dtype), mask, settings), mask
    if stream.kind == EXACT:
        values = unpack_planes(sections["body"], dtype).reshape(stream.shape)
        return values, unpack_mask(sections["mask"], (nothing, nothing)) if stream.masked else None
    if stream.kind == DIFFERENCES:
        return unpack_differences(sections["body"], stream.shape, dtype), None
    if stream.kind == EMPTY:
        values = cast(np.full(stream.shape, float(settings["center"])), dtype)
        mask = np.zeros(stream.shape, bool) if stream.masked else None
    else:
        by_kind = {TRANSFORMED: transformed, BLOCKS: transformed, PREDICTED: predicted}
        before, values = by_kind[stream.kind](stream)
        mask = None
        if stream.masked:
            levels = mask_levels(before.astype(stream.working), settings["mask"])
            mask = unpack_mask(sections["mask"], levels)
        if settings["clip"]:
            low, high = (in_type(end, dtype) for end in settings["range"])
            values = np.where(values < low, low, np.where(values > high, high, values))
    return blanked(values, mask, settings), mask


def with_missing(values: Values, section: memoryview | None, shape: Sequence[int]) -> Values:
    """Decoded values with the missing ones in their places, which are kept bit by bit."""
    if section is None:
        return values
    size = values.dtype.itemsize
    palette, end = [], 1 + section[0] * size
    for first in range(1, end, size):
        palette.append(int.from_bytes(section[first : first + size], "little"))
    assert palette == sorted(set(palette))
    marks = LabelDecoder(section[end:], len(palette) + 1, shape).run()
    bits = np.array([0, *palette], f"u{size}")[marks]
    return np.where(marks > 0, bits.view(values.dtype), values)


def unpack_differences(body: memoryview, shape: Sequence[int], dtype: np.dtype[Any]) -> Values:
    """The values of a tile of differences, one after the other, in Python's integers."""
    data = bytes(decompress(body))
    flags, scale, hole, orders = struct.unpack_from("<BdQB", data)
    kind = np.dtype(np.float32) if flags & 4 else dtype
    count, size = int(np.prod(shape)), kind.itemsize
    shape = (1, 1, 1, *shape)[-4:]
    _, z, y, x = shape
    apart = x <= 8 < y
    order = np.arange(count).reshape(shape)
    order = order.transpose(0, 3, 1, 2) if apart else order
    planes = order.reshape(-1, *((z, y) if apart else (y, x)))
    marks = np.unpackbits(np.frombuffer(data[18 + count * size * (2 if flags & 2 else 1) :], "u1"))

    def integer(first: int, number: int) -> int:
        parts = data[first + number : first + count * size : count]
        coded = int.from_bytes(parts, "little")
        return coded // 2 if coded % 2 == 0 else -(coded + 1) // 2

    numbers = np.array([integer(18, number) for number in range(count)], dtype=object)
    numbers = numbers.reshape(planes.shape)
    for axis, times in ((1, orders // 16), (2, orders % 16)):
        for _ in range(times):
            numbers = np.cumsum(numbers, axis)
    bits = []
    for number, value in enumerate(wrapped(each, size) for each in numbers.flat):
        if kind.kind == "f":
            near = np.array(np.float64(value) / scale).astype(kind)
            place = int(near.view(f"i{size}"))
            place = place if place >= 0 else ~place - (1 << 8 * size - 1)
            place += integer(18 + count * size, number) if flags & 2 else 0
            place = wrapped(place, size)
            value = place if place >= 0 else ~(place + (1 << 8 * size - 1))
        bits.append(hole if flags & 1 and marks[number] else value % (1 << 8 * size))
    values = np.empty(count, f"u{size}")
    values[planes.reshape(-1)] = bits
    return values.view(kind).astype(dtype).reshape(shape)


def wrapped(number: int, size: int) -> int:
    """A whole number as a signed one of `size` bytes."""
    half = 1 << 8 * size - 1
    return (number + half) % (2 * half) - half


def predicted(stream: Stream) -> tuple[Values, Values]:
    """The values of a tile coded by prediction: in float64, and in their type."""
    predictor = stream.settings["predictor"]
    integers = decode_predicted(
        stream.sections["body"], stream.shape, predictor["levels"], predictor["passes"]
    )
    values = integers * np.float64(predictor["step"]) + np.float64(predictor["origin"])
    values = np.clip(values, *map(np.float64, stream.settings["range"]))
    return values, cast(values, stream.dtype)


def transformed(stream: Stream) -> tuple[Values, Values]:
    """The values of a tile coded by transform: before head and residual, and in their type."""
    settings, number = stream.settings, stream.working.type
    integers = coded_integers(stream, "body")
    with np.errstate(all="ignore"):
        coefficients = dequantised(integers, settings, stream.working)
        values = inverse(coefficients, settings["axes"]) + number(settings["center"])
        before = after = np.clip(values, *(number(end) for end in settings["range"]))
        if "head" in settings:
            after = apply_head(before, settings["head"])
        if "residual" in stream.sections:
            residual = coded_integers(stream, "residual")
            after = after.astype(np.float64) + residual * np.float64(settings["quantum"])
    return before, cast(after, stream.dtype)


def coded_integers(stream: Stream, section: str) -> Values:
    """The coefficients of a transformed tile, or its residual; in blocks or not."""
    bytes_of, shape, is_body = stream.sections[section], stream.shape, section == "body"
    axes = stream.settings["axes"] if is_body else [Axis("none")] * 4
    trellis = is_body and stream.settings["trellis"]
    decode = decode_fast if stream.fast else decode_integers
    if stream.kind != BLOCKS:
        bands = bands_of(axes, shape) if is_body else single_band(shape)
        return decode(bytes_of, shape, bands, trellis)
    logs = [byte >> shift & 15 for byte in stream.sections["body"][:2] for shift in (0, 4)]
    boxes = list(product(*(blocks_along(n, log) for n, log in zip(shape, logs, strict=True))))
    rest, sizes = bytes_of[2:] if is_body else bytes_of, []
    for _ in boxes[1:]:
        size, rest = number_in(rest)
        sizes.append(size)
    result = np.zeros(shape, np.int32)
    for box, size in zip(boxes, [*sizes, len(rest) - sum(sizes)], strict=True):
        own = tuple(last - first for first, last in box)
        bands = bands_of(axes, own) if is_body else single_band(own)
        integers = decode(rest[:size], own, bands, trellis)
        first = [ends[0] for ends in box]
        for band in bands:
            there = places_of(band, axes, shape, own, first)
            here = tuple(slice(a, b) for a, b in zip(band.low, band.high, strict=True))
            result[there] = integers[here]
        rest = rest[size:]
    return result


def blocks_along(n: int, log: int) -> list[tuple[int, int]]:
    """The ends of each block of 2^log vertices along an axis; 0 for one block.

    What is left is a block of its own if it is at least half as long.
    """
    length = 2**log if log else n
    count = max(1, (n + length // 2) // length)
    return [(i * length, n if i + 1 == count else (i + 1) * length) for i in range(count)]


def places_of(
    band: Band, axes: Sequence[Axis], shape: Sequence[int], own: Sequence[int], first: Sequence[int]
) -> tuple[slice, ...]:
    """The places that the coefficients of a band of a block have in the tile.

    own: lengths of the block. first: its first vertices.
    """
    levels = [axis.depth if axis.kind in WAVELETS else 0 for axis in axes]
    for a, (axis, n) in enumerate(zip(axes, own, strict=True)):
        if band.low[a]:
            ends = lengths(n, axis.depth)
            levels[a] = next(
                level
                for level in range(1, axis.depth + 1)
                if (ends[level], ends[level - 1]) == (band.low[a], band.high[a])
            )
    if is_coupled(axes[2], axes[3]) and bool(band.low[2]) != bool(band.low[3]):
        levels[2] = levels[3] = levels[2 if band.low[2] else 3]
    places = []
    for a, level in enumerate(levels):
        start = (first[a] >> level) + (lengths(shape[a], level)[level] if band.low[a] else 0)
        places.append(slice(start, start + band.high[a] - band.low[a]))
    return tuple(places)


def dequantised(integers: Values, settings: Settings, working: np.dtype[Any]) -> Values:
    """The coefficients of integers: a magnitude m > 0 stands for m + offset / 128 steps."""
    # Of magnitudes 1, 2, 3, 4, of odd ones from 5, of even ones from 6.
    shifts = np.array([0, *settings["offsets"]]) / 128
    magnitude = np.abs(integers)
    which = np.where(magnitude < 5, magnitude, 6 - (magnitude & 1))
    values = magnitude.astype(working) + shifts.astype(working)[which]
    values = values * working.type(settings["step"])
    return np.where(integers < 0, -values, values)


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
