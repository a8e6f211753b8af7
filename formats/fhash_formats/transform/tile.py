"""One tile to bytes and back: transform, quantise, code; decode, correct, bound.

A stream is a byte of flags, the CRC-32 of the decoded integers (coefficients, then residual, as little-endian int32; left out if nothing is
coded), and sections, each behind its length (LEB128): own settings, missing, coefficients, residual, exact. What is not finite in the
source, and what the caller does not care for, may decode to anything; the former comes back as it was by the section `missing`: the
CRC-32 of its marks as little-endian int32 (0 for what is finite, 1 NaN, 2 and 3 infinity and its negative), and the coded marks.

Where the settings ask for a mask, what the caller does not care for decodes to NaN (the centre, for whole numbers), and what is occupied is
known from the last section: nothing if all is, else the lower 16 bits of the CRC-32 of the mask, packed, and the coded mask (mask.py).
Such a stream has another number, so that a reader that knows no masks refuses it.

Where the settings have a predictor and a bound is asked for, the coefficients are integers coded by prediction (predict.py) and there is
no residual: the values are origin + step * integer in float64, within the range. These streams have numbers of their own, too.

Encoding and decoding compute the same values by the same operations in the same order, so that the encoder knows what every decoder gets.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.bands import band_table, single_band
from fhash_formats.transform.coder import MAX_INTEGER, decode_integers, encode_integers
from fhash_formats.transform.filling import filled as filled_in
from fhash_formats.transform.lifting import Transform
from fhash_formats.transform.mask import decode_mask, encode_mask
from fhash_formats.transform.mask_levels import Levels
from fhash_formats.transform.predict import decode_predicted, encode_predicted, integers_of, values_of
from fhash_formats.transform.predictor import Predictor
from fhash_formats.transform.quantise import dequantise, quantise
from fhash_formats.transform.settings import Settings
from fhash_formats.transform.spec import TransformSpec

__all__ = ["CodedTile", "Shape", "decode_tile", "decode_tile_mask", "encode_tile", "exact_tile", "transform_for", "within"]

Shape = tuple[int, int, int, int]
Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

_OWN, _MISSING, _RESIDUAL, _EXACT, _EMPTY = 1, 2, 4, 8, 16
_FORMAT, _MASKED, _PREDICTED, _PREDICTED_MASKED = 1 << 5, 2 << 5, 3 << 5, 4 << 5
"""The upper three bits of the flags are the number of the stream format, 1 or with a mask 2; by prediction 3, or with a mask 4."""


@dataclass(frozen=True, kw_only=True)
class CodedTile:
    """data: the stream. decoded: what it decodes to, in the type of the source. nonzero: coefficients that are not 0."""

    data: bytes
    decoded: Values
    nonzero: int


def transform_for(settings: Settings, shape: Shape) -> Transform:
    """The transform of a tile, kept for tiles of the same shape."""
    return _transform(settings.transform, shape, settings.dtype.name)


@lru_cache(maxsize=64)
def _transform(spec: TransformSpec, shape: Shape, dtype: str) -> Transform:
    return Transform(spec, shape, np.dtype(dtype))


def encode_tile(
    values: Values,
    settings: Settings,
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
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    whole = bool(finite.all())
    counts = finite if care is None else finite & care
    every = bool(counts.all())
    missing = b"" if whole or not keep_missing else _pack_missing(values, finite)
    masked = settings.mask is not None
    occupied = counts if masked else None
    if not counts.any():
        decoded = _outside(_cast(np.full(values.shape, settings.center), values.dtype), occupied, settings)
        data = _assemble(settings if own else None, missing, b"", None, None, None if occupied is None else b"")
        return CodedTile(data=data, decoded=_restore(decoded, missing), nonzero=0)
    if settings.predictor is not None and error is not None:
        return _predicted_tile(values, settings, settings.predictor, counts, error, missing, own)
    transform = transform_for(settings, values.shape)
    table = band_table(settings.transform, values.shape)
    target = (values if whole else np.where(finite, values, values.dtype.type(0))).astype(settings.dtype)
    target -= settings.dtype.type(settings.center)
    if not every and not (filled and whole):
        target = filled_in(target, counts, finite, transform, settings, density)
    coefficients = transform.forward(target)
    for _ in range(rounds):
        integers, scaled = quantise(coefficients, settings.step)
        if weight > 0:
            integers = encode_integers(integers, table, scaled=scaled, weight=weight).integers
        rebuilt = transform.inverse(dequantise(integers, settings.step, settings.offsets, settings.dtype))
        free = _free(target, rebuilt, counts, every, settings)
        if not free.any():
            break
        target = np.where(free, rebuilt, target)
        coefficients = transform.forward(target)
    integers, scaled = quantise(coefficients, settings.step)
    coded = encode_integers(integers, table, scaled=scaled if weight > 0 else None, weight=weight)
    if passes > 1 and weight > 0:
        coded = encode_integers(coded.integers, table)
    linear = _linear(coded.integers, transform, settings)
    mask = None if occupied is None or settings.mask is None else _pack_mask(occupied, settings.mask.levels(linear))
    base = linear if settings.head is None else settings.head.apply(linear)
    residual = None
    if error is not None:
        found = _residual(values, base, counts, settings.quantum)
        if found is None:
            return exact_tile(values, settings if own else None, occupied)
        residual = found if found.any() else None
    decoded = _finish(base, residual, settings, values.dtype)
    if error is not None and not within(values, decoded, error, counts):
        return exact_tile(values, settings if own else None, occupied)
    data = _assemble(settings if own else None, missing, coded.data, coded.integers, residual, mask)
    decoded = _restore(_outside(decoded, occupied, settings), missing)
    return CodedTile(data=data, decoded=decoded, nonzero=int(np.count_nonzero(coded.integers)))


def _predicted_tile(
    values: Values, settings: Settings, predictor: Predictor, counts: Mask, error: float, missing: bytes, own: bool
) -> CodedTile:
    """Code by prediction; exactly where that cannot keep the bound."""
    occupied = counts if settings.mask is not None else None
    integers = integers_of(values, counts, predictor)
    if integers is None:
        return exact_tile(values, settings if own else None, occupied)
    coded, integers = encode_predicted(integers, None if counts.all() else counts, predictor)
    linear = _predicted(integers, predictor, settings)
    decoded = _cast(linear, values.dtype)
    if not within(values, decoded, error, counts):
        return exact_tile(values, settings if own else None, occupied)
    mask = None if occupied is None or settings.mask is None else _pack_mask(occupied, settings.mask.levels(linear.astype(settings.dtype)))
    data = _assemble(settings if own else None, missing, coded, integers, None, mask, predicted=True)
    return CodedTile(data=data, decoded=_restore(_outside(decoded, occupied, settings), missing), nonzero=int(np.count_nonzero(integers)))


def exact_tile(values: Values, settings: Settings | None = None, occupied: Mask | None = None) -> CodedTile:
    """A tile stored without loss: its bytes, those of equal weight together, deflated.

    occupied: the mask, for a stream with one; outside of it stands NaN, or 0 for whole numbers.
    """
    flags = (_FORMAT if occupied is None else _MASKED) | _EXACT | (_OWN if settings else 0)
    if occupied is not None:
        values = np.where(occupied, values, values.dtype.type(np.nan if values.dtype.kind == "f" else 0))
    plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    planes = plain.view(np.uint8).reshape(-1, plain.dtype.itemsize).T
    body = zlib.compress(planes.tobytes(), 6)
    sections = [*_own(settings), body, *([] if occupied is None else [_pack_mask(occupied, _no_levels(values.shape))])]
    return CodedTile(data=bytes([flags]) + b"".join(map(_section, sections)), decoded=values.copy(), nonzero=0)


def decode_tile(data: bytes | memoryview, shape: Shape, dtype: npt.DTypeLike, settings: Settings | None = None, lod: int = 0) -> Values:
    """The values (t, z, y, x) of a stream, in the type of the source.

    settings: those shared by all tiles, unless the stream has its own. lod: every 2^lod-th vertex along z, y, x, low-passed, without head,
    residual, missing values and mask. Raises DamagedFileError for bytes that no encoder writes.
    """
    return _decode(data, shape, dtype, settings, lod)[0]


def decode_tile_mask(data: bytes | memoryview, shape: Shape, dtype: npt.DTypeLike, settings: Settings | None = None) -> tuple[Values, Mask]:
    """The values of a stream as `decode_tile` gives them, and which are occupied: all, where the stream has no mask."""
    values, mask = _decode(data, shape, dtype, settings, 0)
    return values, np.ones(shape, bool) if mask is None else mask


def _decode(
    data: bytes | memoryview, shape: Shape, dtype: npt.DTypeLike, settings: Settings | None, lod: int
) -> tuple[Values, Mask | None]:
    kind = np.dtype(dtype)
    data = memoryview(data)
    if not len(data):
        raise DamagedFileError("a coded tile is empty")
    flags = data[0]
    if flags & 0xE0 not in (_FORMAT, _MASKED, _PREDICTED, _PREDICTED_MASKED):
        raise DamagedFileError(f"a coded tile begins with {flags:#04x}, which is no known stream format")
    masked, predicted = flags & 0xE0 in (_MASKED, _PREDICTED_MASKED), flags & 0xE0 in (_PREDICTED, _PREDICTED_MASKED)
    coded = not flags & (_EXACT | _EMPTY)
    if predicted and flags & (_EXACT | _EMPTY | _RESIDUAL):
        raise DamagedFileError("a coded tile is by prediction and something else as well")
    if len(data) < 5 and coded:
        raise DamagedFileError("a coded tile is cut short")
    digest = int.from_bytes(data[1:5], "little") if coded else 0
    sections = _sections(data[5:] if coded else data[1:])
    if flags & _OWN:
        settings = _settings_from(next(sections, b""))
    missing = bytes(next(sections, b"")) if flags & _MISSING else b""
    if flags & _MISSING and not missing:
        raise DamagedFileError("a coded tile has lost its missing values")
    if flags & _EXACT:
        values = _exact_values(next(sections, b""), shape, kind)
        mask = _unpack_mask(_last(sections), _no_levels(shape)) if masked else None
        _ended(sections)
        return values[_every(lod)] if lod else values, mask
    if settings is None:
        raise DamagedFileError("a coded tile has no settings")
    if flags & _EMPTY:
        _ended(sections)
        result = _cast(np.full(_lod_shape(shape, lod), settings.center), kind)
        if lod:
            return result, None
        mask = np.zeros(shape, bool) if masked else None
        return _restore(_outside(result, mask, settings), missing), mask
    predictor = settings.predictor
    if not predicted:
        integers = decode_integers(next(sections, b""), shape, band_table(settings.transform, shape))
    elif predictor is not None:
        integers = decode_predicted(next(sections, b""), shape, predictor)
    else:
        raise DamagedFileError("a coded tile is by prediction, of which its settings know nothing")
    crc = zlib.crc32(_little(integers))
    residual = None
    if flags & _RESIDUAL:
        residual = decode_integers(next(sections, b""), shape, single_band(shape))
        crc = zlib.crc32(_little(residual), crc)
    packed = _last(sections) if masked else None
    _ended(sections)
    if crc != digest:
        raise DamagedFileError("the decoded integers of a tile differ from their digest")
    if predicted and predictor is not None:
        found = _predicted(integers, predictor, settings)
        if lod:
            return _cast(found[_every(lod)], kind), None
        mask = None if packed is None else _mask_of(packed, found, settings)
        return _restore(_outside(_cast(found, kind), mask, settings), missing), mask
    try:
        transform = transform_for(settings, shape)
    except InputError as error:
        raise DamagedFileError(f"the settings of a coded tile do not fit its shape: {error}") from error
    if lod:
        coarse = transform.inverse(dequantise(integers, settings.step, settings.offsets, settings.dtype), lod=lod)
        return _cast(_clipped(coarse, settings), kind), None
    linear = _linear(integers, transform, settings)
    mask = None if packed is None else _mask_of(packed, linear, settings)
    base = linear if settings.head is None else settings.head.apply(linear)
    return _restore(_outside(_finish(base, residual, settings, kind), mask, settings), missing), mask


def within(values: Values, decoded: Values, error: float, counts: Mask | None = None) -> bool:
    """Whether |decoded - value| <= error wherever it counts, without rounding in favour of the answer."""
    one, other = (values, decoded) if counts is None else (values[counts], decoded[counts])
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        most = 0 if error < 0 else np.iinfo(np.uint64).max if error >= 2.0**64 else int(error)
        return bool(np.all(_whole_difference(one, other) <= np.uint64(most)))
    difference = one.astype(np.float64) - other.astype(np.float64)
    # A difference of float64 numbers is rounded: the next one up is surely not too small.
    return bool(
        np.all(
            (one == other)
            | (np.nextafter(np.abs(difference), np.inf) <= error)
            | (values.dtype.itemsize < 8) & (np.abs(difference) <= error)
        )
    )


# -- pieces ----------------------------------------------------------------------------------------------------------------------


def _linear(integers: npt.NDArray[np.int32], transform: Transform, settings: Settings) -> Values:
    """Decoded values in the working type, before head and residual."""
    return _clipped(transform.inverse(dequantise(integers, settings.step, settings.offsets, settings.dtype)), settings)


def _predicted(integers: npt.NDArray[np.int32], predictor: Predictor, settings: Settings) -> npt.NDArray[np.float64]:
    """Values by prediction, within the range."""
    values = values_of(integers, predictor)
    return np.clip(values, settings.low, settings.high, out=values)


def _mask_of(packed: bytes | memoryview, linear: Values, settings: Settings) -> Mask:
    if settings.mask is None:
        raise DamagedFileError("a coded tile has a mask, of which its settings know nothing")
    with np.errstate(over="ignore"):
        return _unpack_mask(packed, settings.mask.levels(linear.astype(settings.dtype, copy=False)))


def _clipped(values: Values, settings: Settings) -> Values:
    kind = settings.dtype.type
    values += kind(settings.center)
    return np.clip(values, kind(settings.low), kind(settings.high), out=values)


def _finish(base: Values, residual: npt.NDArray[np.int32] | None, settings: Settings, dtype: np.dtype[Any]) -> Values:
    """Add the residual and go to the type of the source."""
    if residual is not None:
        with np.errstate(all="ignore"):
            base = base.astype(np.float64) + residual * np.float64(settings.quantum)
    return _cast(base, dtype)


def _cast(values: Values, dtype: np.dtype[Any]) -> Values:
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    # float64 cannot hold the largest 64-bit integers; the number below them is inside.
    low, high = float(limits.min), float(limits.max)
    high = high if int(high) <= limits.max else float(np.nextafter(high, 0.0))
    return np.clip(np.rint(np.nan_to_num(values.astype(np.float64))), low, high).astype(dtype)


def _residual(values: Values, base: Values, counts: Mask, quantum: float) -> npt.NDArray[np.int32] | None:
    """Whole quanta to add where the error is too large; None where they would not fit."""
    with np.errstate(all="ignore"):
        rest = np.where(counts, values.astype(np.float64) - base.astype(np.float64), 0.0)
        whole = np.where(np.abs(rest) > quantum / 2, np.rint(rest / quantum), 0.0)
    if not np.isfinite(whole).all() or np.abs(whole).max(initial=0) > MAX_INTEGER:
        return None
    return whole.astype(np.int32)


def _whole_difference(one: Values, other: Values) -> npt.NDArray[np.uint64]:
    """The distance of 64-bit integers: a signed difference may go round, and as an unsigned number it is right again."""
    return np.where(one > other, one - other, other - one).astype(np.uint64)


def _free(target: Values, rebuilt: Values, counts: Mask, every: bool, settings: Settings) -> Mask:
    """Where the decoded value may be anything: what does not count, and what lies at an end of the range and decodes beyond it."""
    kind = settings.dtype.type
    low, high, margin = settings.low - settings.center, settings.high - settings.center, (settings.high - settings.low) * 1e-4
    free: Mask = ((target <= kind(low + margin)) & (rebuilt < target)) | ((target >= kind(high - margin)) & (rebuilt > target))
    return free if every else free | ~counts


def _every(lod: int) -> tuple[slice, ...]:
    return (slice(None), *[slice(None, None, 1 << lod)] * 3)


def _lod_shape(shape: Shape, lod: int) -> tuple[int, ...]:
    return (shape[0], *(-(-n // (1 << lod)) for n in shape[1:]))


_MISSING_VALUES = (np.nan, np.inf, -np.inf)


def _pack_missing(values: Values, finite: Mask) -> bytes:
    marks = np.where(finite, 0, np.where(np.isnan(values), 1, np.where(values > 0, 2, 3))).astype(np.int32)
    return zlib.crc32(_little(marks)).to_bytes(4, "little") + encode_integers(marks, single_band(values.shape)).data


def _restore(decoded: Values, missing: bytes) -> Values:
    if missing:
        if decoded.dtype.kind != "f":
            raise DamagedFileError("a coded tile of integers has missing values")
        marks = decode_integers(missing[4:], decoded.shape, single_band(decoded.shape))
        if zlib.crc32(_little(marks)).to_bytes(4, "little") != missing[:4] or marks.min() < 0 or marks.max() > 3:
            raise DamagedFileError("the missing values of a coded tile are damaged")
        for mark, value in enumerate(_MISSING_VALUES, start=1):
            decoded[marks == mark] = value
    return decoded


def _outside(decoded: Values, occupied: Mask | None, settings: Settings) -> Values:
    """Decoded values with NaN, or the centre for whole numbers, where a mask says that nothing is."""
    if occupied is not None:
        outside = np.array(np.nan) if decoded.dtype.kind == "f" else np.array(settings.center)
        decoded[~occupied] = _cast(outside, decoded.dtype)
    return decoded


def _no_levels(shape: tuple[int, ...]) -> tuple[Levels, Levels]:
    return np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)


def _pack_mask(occupied: Mask, levels: tuple[Levels, Levels]) -> bytes:
    """The section of a mask; empty where all is occupied."""
    # The coder reads zeros past the end: one zero is as good as no byte.
    return b"" if occupied.all() else _digest(occupied) + (encode_mask(occupied, levels) or b"\0")


def _unpack_mask(packed: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    if not len(packed):
        return np.ones(levels[0].shape, bool)
    mask = decode_mask(packed[2:], levels)
    if _digest(mask) != packed[:2]:
        raise DamagedFileError("the decoded mask of a tile differs from its digest")
    return mask


def _digest(mask: Mask) -> bytes:
    return (zlib.crc32(np.packbits(mask).data) & 0xFFFF).to_bytes(2, "little")


def _last(sections: Iterator[memoryview]) -> memoryview:
    """The section of the mask; DamagedFileError where there is none."""
    found = next(sections, None)
    if found is None:
        raise DamagedFileError("a coded tile has lost its mask")
    return found


def _assemble(
    settings: Settings | None,
    missing: bytes,
    coefficients: bytes,
    integers: npt.NDArray[np.int32] | None,
    residual: npt.NDArray[np.int32] | None,
    mask: bytes | None,
    predicted: bool = False,
) -> bytes:
    numbers = (_PREDICTED, _PREDICTED_MASKED) if predicted else (_FORMAT, _MASKED)
    flags = numbers[mask is not None] | (_OWN if settings else 0) | (_MISSING if missing else 0)
    sections = [*_own(settings), *([missing] if missing else [])]
    if integers is None:
        return bytes([flags | _EMPTY]) + b"".join(map(_section, sections))
    crc = zlib.crc32(_little(integers))
    sections.append(coefficients)
    if residual is not None:
        flags |= _RESIDUAL
        crc = zlib.crc32(_little(residual), crc)
        sections.append(encode_integers(residual, single_band(residual.shape)).data)
    if mask is not None:
        sections.append(mask)
    return bytes([flags]) + crc.to_bytes(4, "little") + b"".join(map(_section, sections))


def _little(integers: npt.NDArray[np.int32]) -> memoryview:
    return np.ascontiguousarray(integers, dtype="<i4").data.cast("B")


def _own(settings: Settings | None) -> list[bytes]:
    if settings is None:
        return []
    return [zlib.compress(json.dumps(settings.to_dict(), separators=(",", ":")).encode("ascii"), 9)]


def _settings_from(data: bytes | memoryview) -> Settings:
    try:
        inflate = zlib.decompressobj()
        text = inflate.decompress(data, 1 << 22)
        if not inflate.eof or inflate.unused_data:
            raise DamagedFileError("the settings of a coded tile are damaged")
        return Settings.from_dict(json.loads(text))
    except (zlib.error, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DamagedFileError(f"the settings of a coded tile are damaged: {error}") from error


def _exact_values(data: bytes | memoryview, shape: Shape, dtype: np.dtype[Any]) -> Values:
    count = int(np.prod(shape)) * dtype.itemsize
    try:
        inflate = zlib.decompressobj()
        plain = inflate.decompress(data, count)
        if inflate.unconsumed_tail:
            inflate.decompress(inflate.unconsumed_tail, 1)
    except zlib.error as error:
        raise DamagedFileError(f"a coded tile is damaged: {error}") from error
    if len(plain) != count or not inflate.eof or inflate.unused_data:
        raise DamagedFileError("a coded tile is damaged: it holds another number of values")
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    return np.array(planes.T, order="C").view(dtype.newbyteorder("<")).reshape(shape).astype(dtype, copy=False)


def _ended(sections: Iterator[memoryview]) -> None:
    if next(sections, None) is not None:
        raise DamagedFileError("a coded tile has more sections than its flags say")


def _section(data: bytes) -> bytes:
    size, head = len(data), bytearray()
    while True:
        head.append(size & 127 | (128 if size > 127 else 0))
        size >>= 7
        if not size:
            return bytes(head) + data


def _sections(data: memoryview) -> Iterator[memoryview]:
    """The sections one after the other; DamagedFileError where one reaches beyond the end."""
    at = 0
    while at < len(data):
        size = shift = 0
        while True:
            if at >= len(data) or shift > 35:
                raise DamagedFileError("a coded tile is cut short")
            size |= (data[at] & 127) << shift
            shift += 7
            at += 1
            if not data[at - 1] & 128:
                break
        if size > len(data) - at:
            raise DamagedFileError("a coded tile is cut short")
        yield data[at : at + size]
        at += size
