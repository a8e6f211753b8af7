"""Bytes of a tile: its settings, its sections, its labels."""

from __future__ import annotations

import base64
import struct
import sys
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import crc32c
from fhash_formats.support.values import Values, is_wide_integer, is_within
from fhash_formats.transform.head import NeighbourHead
from fhash_formats.transform.predict import Predictor, tap_count
from fhash_formats.transform.spec import (
    KINDS,
    AxisTransform,
    Basis,
    MaskLevels,
    TransformSpec,
    decode_block,
    encode_block,
)

OFFSETS = 6
"""Reconstruction offsets."""
OFFSET_UNIT = 128
"""Units in a quantiser step, for reconstruction offsets."""
_DOUBLE, _CLIP, _LABELS, _TRELLIS, _WHOLE, _HEAD, _MASK, _PREDICTOR = (1 << n for n in range(8))
"""Flags of a packed block."""
_OTHERS = 128
"""Added to the number of edges of a mask with other scores."""
_ORIGIN = 9
"""Bytes of an origin: one of uint64 and one of int64 fit."""
_EXACT = 1 << 53
"""Whole numbers up to this one are exact in float64."""
_FARTHEST = 1 << 63
"""First whole number that is no end of a range."""
_LARGEST = sys.float_info.max
"""Largest magnitude of a number; whole numbers may be larger."""
_MAX_TEXT = 1 << 23
"""Most characters of a block in base64."""
_MOST_BITS = 35
"""Bits of the largest number in LEB128."""


@dataclass(frozen=True, kw_only=True)
class TileSettings:
    """Settings of a tile. Raises InputError for values that are not allowed.

    Attributes:
        transform: kinds, depths and bases along (t, z, y, x).
        step: quantiser step, in units of the values; > 0.
        center: value that is coded as zero, in units of the values.
        low: lower end of the range to which values are clipped, before head and residual.
        high: upper end of that range.
        offsets: six reconstruction offsets, in 1/128 step; see `dequantise`.
        double: whether the arithmetic is in float64; otherwise it is in float32.
        quantum: step of the residual that keeps a bound, in units of the values; 0 without bound.
        head: the trained correction; None for none.
        mask: likelihood of the occupancy by decoded values; every tile then has a mask. None for
            tiles without masks.
        predictor: predictor of tiles that are coded by prediction instead of the transform; None
            where no tile is.
        clip: whether decoded values are clipped to the range once more at the end, in the type of
            the array, so that neither residual nor rounding takes them beyond it.
        labels: whether tiles are also tried as labels, without loss. Decoding needs none of it; a
            file that grows goes on as it began.
        trellis: whether coefficients are quantised by two quantisers in turn
            (native/trellis.cpp). Integers are then in steps, of which each quantiser has every
            other one.
        origin: integer that is subtracted from the values before anything else, for arrays of
            64-bit integers alone; `center`, `low` and `high` are then those of the differences.
    """

    transform: TransformSpec
    step: float
    center: float
    low: float
    high: float
    offsets: tuple[int, ...] = (0,) * OFFSETS
    double: bool = False
    quantum: float = 0.0
    head: NeighbourHead | None = None
    mask: MaskLevels | None = None
    predictor: Predictor | None = None
    clip: bool = False
    labels: bool = False
    trellis: bool = False
    origin: int = 0

    def __post_init__(self) -> None:
        for name in ("step", "center", "low", "high", "quantum"):
            _check_finite(name, getattr(self, name))
        if not (self.step > 0 and self.quantum >= 0 and self.low <= self.high):
            raise InputError(
                f"step {self.step}, quantum {self.quantum}, range {self.low} to {self.high} "
                "do not fit together"
            )
        smallest, largest = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
        if not (self.double or smallest < self.step < largest):
            raise InputError(f"step {self.step} is not for float32")
        if len(self.offsets) != OFFSETS or not all(
            type(offset) is int and abs(offset) < OFFSET_UNIT for offset in self.offsets
        ):
            raise InputError(
                f"offsets are {self.offsets!r:.60}; six whole numbers within "
                f"+-{OFFSET_UNIT - 1} are needed"
            )
        if self.head is not None and self.double:
            raise InputError("a head works in float32 only")
        if type(self.origin) is not int or not -(1 << 63) <= self.origin < 1 << 64:
            raise InputError(f"origin is {self.origin!r:.40}; a 64-bit integer is needed")

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the arithmetic."""
        return np.dtype(np.float64 if self.double else np.float32)

    @property
    def table_dtype(self) -> np.dtype[Any]:
        """The type of the table of a tile: that of the arithmetic, or float64 with an origin."""
        return np.dtype(np.float64) if self.origin else self.dtype

    def differences_of(self, dtype: np.dtype[Any]) -> np.dtype[Any]:
        """The type of what is coded of an array: int64 with an origin, else that of the array.

        Raises InputError for an array whose type has no such origin.
        """
        if not self.origin:
            return dtype
        if not (is_wide_integer(dtype) and is_within(self.origin, dtype)):
            raise InputError(f"an array of {dtype} has no values about the origin {self.origin}")
        return np.dtype(np.int64)

    @cached_property
    def packed(self) -> bytes:
        """The packed block; packing a head takes as long as decoding a small tile."""
        return self.to_bytes()

    def to_bytes(self, *, apart: bool = False) -> bytes:
        """The packed block. Raises InputError for ends about an origin that are no int64.

        apart: leave the block of a head empty: a container has the head in its header.
        """
        whole = self.origin != 0 or any(
            type(end) is int and abs(end) > _EXACT for end in (self.low, self.high)
        )
        ends = tuple(map(int, (self.low, self.high))) if whole else (self.low, self.high)
        if whole and (
            ends != (self.low, self.high) or not -_FARTHEST <= ends[0] <= ends[1] < _FARTHEST
        ):
            raise InputError(f"range {self.low} to {self.high} about an origin is of int64")
        flags = sum(
            flag
            for flag, there in (
                (_DOUBLE, self.double),
                (_CLIP, self.clip),
                (_LABELS, self.labels),
                (_TRELLIS, self.trellis),
                (_WHOLE, whole),
                (_HEAD, self.head is not None),
                (_MASK, self.mask is not None),
                (_PREDICTOR, self.predictor is not None),
            )
            if there
        )
        axes = self.transform.axes
        parts = [
            bytes([flags, *(KINDS.index(axis.kind) << 4 | axis.depth for axis in axes)]),
            struct.pack("<3d", self.step, self.quantum, self.center),
            struct.pack("<2q" if whole else "<2d", *ends),
            self.origin.to_bytes(_ORIGIN, "little", signed=True) if whole else b"",
            struct.pack(f"{OFFSETS}b", *self.offsets),
        ]
        blocks = [axis.basis.to_bytes() for axis in axes if axis.basis is not None]
        blocks += [] if self.head is None else [b"" if apart else self.head.to_bytes()]
        parts += [part for block in blocks for part in (varint(len(block)), block)]
        if self.mask is not None:
            parts.append(_pack_mask(self.mask))
        if self.predictor is not None:
            parts.append(_pack_predictor(self.predictor))
        return b"".join(parts)

    @classmethod
    def from_bytes(cls, data: bytes | memoryview) -> TileSettings:
        """The inverse of `to_bytes`. Raises DamagedFileError for anything else.

        The same object for the same bytes.
        """
        return _unpacked(bytes(data))

    def to_text(self, *, apart: bool = False) -> str:
        """The packed block in base64, as JSON documents have it; for `apart` see `to_bytes`."""
        block = self.to_bytes(apart=True) if apart else self.packed
        return base64.b64encode(block).decode("ascii")

    @classmethod
    def from_text(cls, text: Any, head: NeighbourHead | None = None) -> TileSettings:
        """The inverse of `to_text`. Raises DamagedFileError for anything else.

        head: that of a text without it.
        """
        if not isinstance(text, str) or len(text) > _MAX_TEXT:
            raise DamagedFileError(f"settings of tiles are base64, not {text!r:.40}")
        try:
            block = base64.b64decode(text, validate=True)
            return cls.from_bytes(block) if head is None else _apart(block, head)
        except ValueError as error:
            raise DamagedFileError(f"settings of tiles are no base64 ({error})") from error


@lru_cache(maxsize=64)
def _unpacked(data: bytes) -> TileSettings:
    # Unpacking a basis or a head takes as long as decoding a small tile.
    try:
        return _read(_Bytes(memoryview(data)))
    except (InputError, ValueError) as error:
        raise DamagedFileError(f"the settings of a coded tile are damaged: {error}") from error


def _apart(block: bytes, head: NeighbourHead) -> TileSettings:
    try:
        return _read(_Bytes(memoryview(block)), head)
    except InputError as error:
        raise DamagedFileError(f"the settings of a coded tile are damaged: {error}") from error


class _Bytes:
    """Bytes that are read from their start on. Raises DamagedFileError at their end."""

    def __init__(self, rest: memoryview) -> None:
        self.rest = rest

    def take(self, count: int) -> bytes:
        """So many bytes."""
        if count > len(self.rest):
            raise DamagedFileError("the settings of a coded tile are cut short")
        taken, self.rest = bytes(self.rest[:count]), self.rest[count:]
        return taken

    def numbers(self, form: str) -> tuple[Any, ...]:
        """Numbers, by a form of `struct`."""
        return struct.unpack(f"<{form}", self.take(struct.calcsize(f"<{form}")))

    def block(self) -> bytes:
        """Bytes behind their length."""
        count, self.rest = read_varint(self.rest)
        return self.take(count)


def _read(data: _Bytes, head: NeighbourHead | None = None) -> TileSettings:
    flags, *axes = data.numbers("5B")
    step, quantum, center = data.numbers("3d")
    low, high = data.numbers("2q" if flags & _WHOLE else "2d")
    origin = int.from_bytes(data.take(_ORIGIN), "little", signed=True) if flags & _WHOLE else 0
    offsets = data.numbers(f"{OFFSETS}b")
    t, z, y, x = (_read_axis(data, *divmod(axis, 16)) for axis in axes)
    if flags & _HEAD:
        block = data.block()
        head = NeighbourHead.from_bytes(block) if block or head is None else head
    mask = _read_mask(data) if flags & _MASK else None
    predictor = _read_predictor(data) if flags & _PREDICTOR else None
    if len(data.rest):
        raise DamagedFileError("the settings of a coded tile have bytes after their end")
    return TileSettings(
        transform=TransformSpec(axes=(t, z, y, x)),
        step=step,
        center=center,
        low=low,
        high=high,
        offsets=offsets,
        double=bool(flags & _DOUBLE),
        quantum=quantum,
        head=head,
        mask=mask,
        predictor=predictor,
        clip=bool(flags & _CLIP),
        labels=bool(flags & _LABELS),
        trellis=bool(flags & _TRELLIS),
        origin=origin,
    )


def _read_axis(data: _Bytes, kind: int, depth: int) -> AxisTransform:
    if kind >= len(KINDS):
        raise DamagedFileError(f"a coded tile has a transform of kind {kind}")
    basis = Basis.from_bytes(data.block()) if KINDS[kind] == "klt" else None
    return AxisTransform(kind=KINDS[kind], depth=depth, basis=basis)


def _pack_mask(mask: MaskLevels) -> bytes:
    count = len(mask.edges)
    return struct.pack(
        f"<B{count}dB{count + 1 + len(mask.others)}H",
        count | (_OTHERS if mask.others else 0),
        *mask.edges,
        mask.reach,
        *mask.scores,
        *mask.others,
    )


def _read_mask(data: _Bytes) -> MaskLevels:
    (count,) = data.numbers("B")
    edges = data.numbers(f"{count % _OTHERS}d")
    (reach,) = data.numbers("B")
    scores = data.numbers(f"{len(edges) + 1}H")
    others = data.numbers(f"{len(edges) + 1}H") if count & _OTHERS else ()
    return MaskLevels(edges=edges, scores=scores, others=others, reach=reach)


def _pack_predictor(predictor: Predictor) -> bytes:
    order = sum(axis << 2 * place for place, axis in enumerate(predictor.order))
    weights = encode_block(np.array(predictor.weights, dtype=np.int32).reshape(1, 1, 1, -1))
    numbers = (predictor.step, predictor.origin, *predictor.levels, order, predictor.reach)
    return struct.pack("<2d6B", *numbers) + varint(len(weights)) + weights


def _read_predictor(data: _Bytes) -> Predictor:
    step, origin, t, z, y, x, places, reach = data.numbers("2d6B")
    order = (places & 3, places >> 2 & 3, places >> 4 & 3, places >> 6)
    count = tap_count((t, z, y, x), order, reach)  # raises for what is no lattice
    block = decode_block(data.block(), (1, 1, 1, count))
    return Predictor(
        step=step,
        origin=origin,
        levels=(t, z, y, x),
        order=order,
        reach=reach,
        weights=tuple(block.ravel().tolist()),
    )


def varint(number: int) -> bytes:
    """The bytes of a whole number from 0 on: seven bits a byte, lowest first (LEB128)."""
    data = bytearray()
    while True:
        data.append(number & 127 | (128 if number > 127 else 0))
        number >>= 7
        if not number:
            return bytes(data)


def read_varint(data: memoryview) -> tuple[int, memoryview]:
    """The number at the start of some bytes, and the bytes after it. Raises DamagedFileError."""
    number = shift = 0
    for at, byte in enumerate(data[: _MOST_BITS // 7]):
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number, data[at + 1 :]
    raise DamagedFileError("a coded tile is cut short")


def _check_finite(name: str, value: Any) -> None:
    """Raises InputError unless a setting is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise InputError(f"{name} is {value!r:.40}; a finite number is needed")


Shape = tuple[int, int, int, int]
"""Lengths of a tile along (t, z, y, x)."""

TRANSFORMED, PREDICTED, LABELS, EXACT, EMPTY, DIFFERENCES, BLOCKS = range(7)
"""Kinds of streams; BLOCKS are transformed as well."""
KIND = 7
"""Bits of the flags that hold the kind."""
OWN = 8
"""Flag of a stream with settings of its own."""
MISSING = 16
"""Flag of a stream with missing values."""
RESIDUAL = 32
"""Flag of a stream with a residual."""
MASKED = 64
"""Flag of a stream that says which values are occupied."""
FAST = 128
"""Flag of a stream whose integers are those of the fast coder."""

_ALLOWED = {
    TRANSFORMED: OWN | MISSING | RESIDUAL | MASKED | FAST,
    PREDICTED: OWN | MISSING | MASKED,
    LABELS: OWN | MASKED,
    EXACT: OWN | MASKED,
    EMPTY: OWN | MISSING | MASKED,
    DIFFERENCES: 0,
    BLOCKS: OWN | MISSING | RESIDUAL | MASKED | FAST,
}
"""Flags that a stream of each kind may have."""
_CHECKSUM = 4
"""Bytes of the checksum."""
FLAGS = _CHECKSUM
"""Place of the flags in a stream."""


@dataclass(frozen=True, kw_only=True)
class TileStream:
    """The sections of a stream. A section is None where the flags say that there is none.

    Attributes:
        kind: TRANSFORMED, PREDICTED, LABELS, EXACT, EMPTY, DIFFERENCES or BLOCKS.
        masked: whether the stream says which values are occupied.
        fast: whether coefficients and residual are those of the fast coder.
        settings: the tile's own settings.
        missing: missing values.
        body: coefficients, predicted integers, labels, exact values or differences.
        residual: the residual.
        mask: the mask.
    """

    kind: int
    masked: bool
    fast: bool
    settings: memoryview | None = None
    missing: memoryview | None = None
    body: memoryview | None = None
    residual: memoryview | None = None
    mask: memoryview | None = None


def seal(flags: int, sections: list[bytes]) -> bytes:
    """The stream of flags and sections, with its checksum."""
    *others, last = sections or [b""]
    lengths = [part for section in others for part in (varint(len(section)), section)]
    data = b"".join([bytes([flags]), *lengths, last])
    return crc32c(data).to_bytes(_CHECKSUM, "little") + data


def parse_stream(data: bytes | memoryview) -> TileStream:
    """The flags and sections of a stream.

    Raises DamagedFileError where the checksum differs, flags contradict each other, or the sections
    are not those of the flags. All of that is checked before anything is decoded, which may take
    long.
    """
    data = memoryview(data)
    if len(data) <= _CHECKSUM:
        raise DamagedFileError(f"a coded tile has {len(data)} bytes, which are too few")
    if crc32c(data[_CHECKSUM:]) != int.from_bytes(data[:_CHECKSUM], "little"):
        raise DamagedFileError("the CRC-32C of a coded tile differs, it is damaged")
    flags = data[_CHECKSUM]
    kind = flags & KIND
    if flags & ~KIND & ~_ALLOWED.get(kind, 0) or kind not in _ALLOWED:
        raise DamagedFileError(f"a coded tile has the flags {flags:#04x}, which no encoder writes")
    masked = bool(flags & MASKED)
    there = {
        "settings": bool(flags & OWN),
        "missing": bool(flags & MISSING),
        "body": kind != EMPTY,
        "residual": bool(flags & RESIDUAL),
        "mask": masked and kind not in (EMPTY, LABELS),
    }
    names = [name for name in there if there[name]]
    sections = _sections(data[_CHECKSUM + 1 :], len(names))
    fast = bool(flags & FAST)
    return TileStream(
        kind=kind, masked=masked, fast=fast, **dict(zip(names, sections, strict=True))
    )


def _sections(data: memoryview, count: int) -> list[memoryview]:
    """So many sections. Raises DamagedFileError where one reaches beyond the end."""
    found = []
    for _ in range(count - 1):
        size, data = read_varint(data)
        if size > len(data):
            raise DamagedFileError("a coded tile is cut short")
        found.append(data[:size])
        data = data[size:]
    if not count and len(data):
        raise DamagedFileError("an empty tile has bytes after its end")
    return [*found, data] if count else found


FEW = 256
"""Labels that are tried whether or not values lie in regions."""
REGION_SHARE = 0.5
"""Share of vertices with an equal neighbour from which on many different values may be labels."""
_LOOK = 4096
"""Values that are looked at, at least, where there are as many."""


def has_regions(values: Values) -> bool:
    """Whether REGION_SHARE of the values equal the one before along one of the four axes."""
    equal = np.zeros(values.shape, bool)
    for axis in range(4):
        moved, marks = np.moveaxis(values, axis, 0), np.moveaxis(equal, axis, 0)
        marks[1:] |= moved[1:] == moved[:-1]
    return bool(equal.mean() >= REGION_SHARE)


def surely_exceeds(values: Values, most: int) -> bool:
    """Whether a look at some of the values finds more than `most` different ones.

    That is enough for most tiles that have no labels.
    """
    flat = values.reshape(-1)
    return bool(np.unique(flat[:: max(1, flat.size // _LOOK)]).size > most)
