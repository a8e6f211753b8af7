"""Mutations of the contents of chunks: streams and settings of tiles, indices, labels and values.

All checksums are correct, so the contents reach the decoders. A file without what a kind changes is
passed over.
"""

from __future__ import annotations

import base64
import copy
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import (
    FLOATS,
    Documents,
    NothingFitsError,
    hostile,
    is_plain,
    replaced,
    stored,
    without,
)
from reference.sections import pack_planes

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.header import KNOWN_FEATURES, PLAIN_FEATURE
from fhash_formats.errors import InputError
from fhash_formats.native import crc32c
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.head import INPUTS, Layer, NeighbourHead
from fhash_formats.transform.predict import passes_of
from fhash_formats.transform.spec import MAX_LABELS, Basis
from fhash_formats.transform.tile import NO_TRANSFORM
from fhash_formats.transform.tile_format import (
    KIND,
    LABELS,
    MASKED,
    MISSING,
    OWN,
    RESIDUAL,
    TRANSFORMED,
    TileSettings,
    TileStream,
    parse_stream,
    read_varint,
    seal,
    varint,
)

PLAIN = TileSettings(transform=NO_TRANSFORM, step=1.0, center=0.5, low=0.0, high=1.0)
"""Settings of tiles that have none."""
CODED_FEATURES = sorted(KNOWN_FEATURES - {PLAIN_FEATURE})
"""Features of files with coded tiles: all but those of files whose headers differ."""
HEADED = 32
"""Flag of settings with a head."""
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, 1e38, -3.4e38, 1e300, -1e308, 5e-324)


def is_coded(document: dict[str, Any]) -> bool:
    """Whether an array is one of tiles, coded by `fhash.transform`."""
    return "tiles" in document.get("attributes", {})


def type_of(document: dict[str, Any]) -> np.dtype[Any]:
    """Return the type of the values of an array of tiles."""
    return np.dtype(document["attributes"]["tiles"]["data_type"])


def tile_of(document: dict[str, Any]) -> tuple[int, ...]:
    """Return the shape of a coded tile."""
    return tuple(document["attributes"]["tiles"]["tile"])


def settings_of(document: dict[str, Any]) -> TileSettings | None:
    """Return the settings that all tiles of an array share; None where each has its own.

    Some network stands for the MLP of the header.
    """
    text = document["attributes"]["tiles"].get("settings")
    if text is None:
        return None
    headed = base64.b64decode(text)[0] & HEADED
    return TileSettings.from_text(text, head_of(random.Random(0)) if headed else None)


def put_settings(document: dict[str, Any], data: bytes) -> None:
    """Put a block of settings to an array of tiles."""
    document["attributes"]["tiles"]["settings"] = base64.b64encode(data).decode()


def sections_of(stream: TileStream) -> list[bytes]:
    parts = (stream.settings, stream.missing, stream.body, stream.residual, stream.mask)
    return [bytes(part) for part in parts if part is not None]


def sealed(rest: bytes) -> bytes:
    """Return the stream of bytes that follow its checksum."""
    return crc32c(rest).to_bytes(4, "little") + rest


def damaged(chance: random.Random, data: bytes) -> bytes:
    """Return the bytes of a stream changed a little or much."""
    if not data:
        return chance.randbytes(chance.randrange(9))
    turn, at = chance.random(), chance.randrange(len(data))
    if turn < 0.55:
        changed = bytearray(data)
        for _ in range(chance.choice((1, 1, 2, 8))):
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
        return bytes(changed)
    if turn < 0.7:
        return data[:at]
    if turn < 0.8:
        return data[:at] + chance.randbytes(chance.randrange(1, 20)) + data[at:]
    if turn < 0.9:
        return chance.randbytes(chance.randrange(2 * len(data) + 1))
    return chance.choice((b"\xff", b"\x00", b"\x80")) * chance.randrange(1, 3000)


class Tiles:
    """The tiles of an array of a sound file.

    Attributes:
        metadata: of the array.
        members: index of each member in the grid of them.
    """

    def __init__(self, file: Documents, name: str) -> None:
        self._file, self._name = file, name
        self.metadata = ArrayMetadata.from_dict(file.arrays[name])
        self.members = list(np.ndindex(*self.metadata.members))

    def index_name(self, member: Sequence[int]) -> str:
        """Return the name of the chunk of the index of a member."""
        return f"{self._name}/c/{'/'.join(map(str, member))}"

    def streams(self, member: tuple[int, ...]) -> dict[tuple[int, ...], bytes]:
        """Return the streams of a member by the places of their tiles in the grid."""
        data = dict(self._file.parts)[f"{self._name}/{self.metadata.member_name(member)}"]
        places = list(self.metadata.chunks_of(member))
        if not self.metadata.indexed:
            return {places[0]: data}
        shape = self.metadata.together
        assert shape is not None
        index = self._file.values(self.index_name(member)).reshape(shape)
        within = zip(*places, strict=True)
        sizes = index[tuple(np.array(n) % k for n, k in zip(within, shape, strict=True))]
        ends = np.cumsum(sizes).tolist()
        return {
            place: data[end - size : end]
            for place, end, size in zip(places, ends, sizes.tolist(), strict=True)
        }

    def packed(self, member: tuple[int, ...], streams: Sequence[bytes]) -> dict[str, bytes]:
        """Return the data of a member of other streams, and the chunk of its index."""
        found = {f"{self._name}/{self.metadata.member_name(member)}": b"".join(streams)}
        if self.metadata.indexed:
            sizes = [len(stream) for stream in streams]
            found[self.index_name(member)] = self.metadata.index_chunk(member, sizes)
        return found


def _coded(chance: random.Random, file: Documents) -> str:
    """Choose an array of tiles."""
    names = [name for name, document in file.arrays.items() if is_coded(document)]
    if not names:
        raise NothingFitsError
    return chance.choice(names)


Stream = Callable[[random.Random, bytes, dict[str, Any]], bytes]
"""Makes another stream of that of a tile, whose array has a document."""


def _tile(
    change: Stream, *, fits: Callable[[bytes], bool] = lambda stream: True
) -> Callable[[random.Random, Parts], Parts]:
    """Return a mutation of one of the tiles that fit."""

    def changed(chance: random.Random, parts: Parts) -> Parts:
        file, found = Documents(parts), []
        for name in filter(lambda name: is_coded(file.arrays[name]), file.arrays):
            tiles = Tiles(file, name)
            for member in tiles.members:
                streams = list(tiles.streams(member).values())
                numbers = [n for n, stream in enumerate(streams) if fits(stream)]
                found += [(name, tiles, member, streams, number) for number in numbers]
        if not found:
            raise NothingFitsError
        name, tiles, member, streams, number = chance.choice(found)
        streams[number] = change(chance, streams[number], file.arrays[name])
        return replaced(parts, tiles.packed(member, streams))

    return changed


def _stream(chance: random.Random, stream: bytes, document: dict[str, Any]) -> bytes:
    """Change sections of a coded tile: another valid tile, unless a decoder refuses it."""
    flags, sections = stream[4], sections_of(parse_stream(stream))
    if sections:
        number = chance.randrange(len(sections))
        sections[number] = damaged(chance, sections[number])
    if chance.random() < 0.15 and flags & KIND == TRANSFORMED and not flags & RESIDUAL:
        flags |= RESIDUAL  # a residual where none was
        residual = chance.randbytes(chance.randrange(200))
        sections.insert(len(sections) - bool(flags & MASKED), residual)
    return seal(flags, sections)


def _flags(chance: random.Random, stream: bytes, document: dict[str, Any]) -> bytes:
    """Change the flags of a coded tile, or give it settings of its own."""
    if chance.random() < 0.5:
        return sealed(bytes([chance.randrange(256)]) + stream[5:])
    parsed = parse_stream(stream)
    own = parsed.settings
    settings = settings_of(document) if own is None else TileSettings.from_bytes(own)
    block = _other_block(chance, settings or PLAIN, tile_of(document))
    return seal(stream[4] | OWN, [block, *sections_of(parsed)[own is not None :]])


def _bytes(chance: random.Random, parts: Parts) -> Parts:
    """Change bytes of a chunk as stored, with a correct checksum."""
    file = Documents(parts)
    name = chance.choice(list(file.arrays))
    members = file.members(name)
    if is_coded(file.arrays[name]) and (not members or chance.random() < 0.8):
        return _tile(lambda chance, stream, _: sealed(damaged(chance, stream[4:])))(chance, parts)
    member = chance.choice(members)
    return replaced(parts, {member: with_crc(damaged(chance, dict(parts)[member][:-4]))})


def _index(chance: random.Random, parts: Parts) -> Parts:
    """Change the index of tiles: sums that do not fill the member, bytes of tiles that are none,
    another type, shape or grid, missing and further chunks."""
    file = Documents(_together(chance, parts) if chance.random() < 0.5 else parts)
    parts = file.parts
    names = [name for name, document in file.arrays.items() if is_coded(document)]
    names = [name for name in names if file.members(name)]
    if not names:
        raise NothingFitsError
    name = chance.choice(names)
    document, member = file.arrays[name], chance.choice(file.members(name))
    values, turn = file.values(member), chance.randrange(10)
    grid = document["chunk_grid"]["configuration"]
    if turn < 5:
        sizes = values.astype(np.int64)
        for _ in range(chance.choice((1, 1, 2))):
            a, b = chance.randrange(values.size), chance.randrange(values.size)
            if chance.random() < 0.5:  # from one tile to another, so that the sum stays
                moved = chance.choice((1, sizes[a], sizes[a] // 2))
                sizes[a] -= moved
                sizes[b] += moved
            else:
                others = (0, 1, 4, 5, sizes.sum(), sizes[a] + 1, sizes[b], 2**31, 2**32 - 1)
                sizes[a] = chance.choice(others)
        return replaced(parts, {member: stored(sizes.astype(np.uint32))})
    if turn == 5:  # another type
        kind = document["data_type"] = chance.choice(list(DTYPES))
        return file.packed({member: stored(values.astype(kind))})
    if turn == 6:  # more or fewer tiles in a member, some of which are none
        axis = chance.randrange(len(grid["chunk_shape"]))
        old = values.reshape(grid["chunk_shape"])
        more = chance.choice((1, 1, 3, 1000))
        grid["chunk_shape"][axis] += more
        padding = np.pad(old, [(0, more * (a == axis)) for a in range(old.ndim)])
        if chance.random() < 0.4:
            padding[(-1,) * old.ndim] = chance.choice((1, 5, 2**32 - 1))
        return file.packed({member: stored(padding)})
    if turn == 7:
        lengths = chance.choice((document["shape"], grid["chunk_shape"]))
        at = chance.randrange(len(lengths))
        lengths[at] = chance.choice((1, lengths[at] + 1, 2 * lengths[at], 2**20, 2**32, 2**62))
        return file.packed()
    if turn == 8:  # none, or another one
        kept = [item for item in parts if item[0] != member]
        other = f"{name}/c/{chance.choice(('0', '0/0/0/1', '1/0/0/0', '0/0/0/0/0', '0/0/0/00'))}"
        return [*([] if chance.random() < 0.5 else [(other, dict(parts)[member])]), *kept]
    sizes = chance.choice((values[:-1], np.append(values, 0), values[:0], values[::-1].copy()))
    return replaced(parts, {member: stored(sizes.astype(values.dtype))})


NUMBERED = (
    *("t/00", "t/01", "t/", "t", "t/-1", "t/0/0", "t/0x0", "t/ 0", "T/0", "t/1.0", "c/0", "t/c/0"),
    *(f"t/{number}" for number in (1, 2, 7, 2**31, 2**32, 2**63, 2**64, 10**19 - 1)),
)
"""Names of members of tiles, most of them of none."""


def _members(chance: random.Random, parts: Parts) -> Parts:
    """Rename, repeat, drop, cut or lengthen a member of tiles, or put one to another array."""
    file = Documents(_together(chance, parts) if chance.random() < 0.5 else parts)
    parts, name, turn = file.parts, _coded(chance, file), chance.randrange(6)
    at = chance.choice([at for at, item in enumerate(parts) if item[0].startswith(f"{name}/t/")])
    member, data = parts[at]
    number = int(member.rpartition("/")[2])
    same = (f"t/0{number}", *(f"t/{number + 2**bits}" for bits in (31, 32, 63, 63, 64)))
    other = f"{name}/{chance.choice(NUMBERED if chance.random() < 0.7 else same)}"
    if turn == 0:
        changed = [(other, data)]
    elif turn == 1:
        changed = [(member, data), (other, chance.choice((data, b"", data[:5])))]
    elif turn == 2:
        changed = [(member, data), (f"{chance.choice(list(file.arrays))}/t/0", data)]
    elif turn == 3:
        changed = [(f"{name}/c/{'/'.join('0' * len(tile_of(file.arrays[name])))}", data)]
    elif turn == 4:
        changed = []
    else:
        changed = [(member, chance.choice((b"", data[:-1], data + b"\0", data[:5], data * 2)))]
    return [*parts[:at], *changed, *parts[at + 1 :]]


def _together(chance: random.Random, parts: Parts) -> Parts:
    """Lay the tiles of an array into other members. The file is sound."""
    file = Documents(parts)
    name = _coded(chance, file)
    tiles = Tiles(file, name)
    streams = {
        place: stream for member in tiles.members for place, stream in tiles.streams(member).items()
    }
    document, grid = file.arrays[name], tiles.metadata.grid
    counts = [chance.choice((1, 2, n, n + 1, 3 * n)) for n in grid]
    document["chunk_grid"]["configuration"]["chunk_shape"] = counts
    other, new = Tiles(file, name), {}
    for member in other.members:
        new |= other.packed(member, [streams[i] for i in other.metadata.chunks_of(member)])
    rest = without(file.packed(), f"{name}/c/", f"{name}/t/")
    return [*new.items(), *rest]


def _settings(chance: random.Random, parts: Parts) -> Parts:
    """Change settings of a codec: steps, ranges, transforms, heads, masks and predictors."""
    file = Documents(parts)
    coded = [document for document in file.arrays.values() if is_coded(document)]
    if not coded:
        raise NothingFitsError
    document = chance.choice(coded)
    settings, apart = settings_of(document) or PLAIN, chance.random() < 0.9
    put_settings(document, _other_block(chance, settings, tile_of(document), apart=apart))
    if chance.random() < 0.1:
        tiles = document["attributes"]["tiles"]
        tiles["settings"] = hostile(chance, tiles["settings"])
    file.top["required_features"] = CODED_FEATURES
    return file.packed()


def _other_block(
    chance: random.Random, settings: TileSettings, shape: tuple[int, ...], *, apart: bool = False
) -> bytes:
    """Return a block of other settings, most of them not allowed. apart: without a head."""
    if chance.random() < 0.2:
        return damaged(chance, settings.to_bytes(apart=apart))
    try:
        return unchecked(settings, **_other(chance, settings, shape)).to_bytes(apart=apart)
    except (InputError, OverflowError, ValueError, struct.error):  # no such block
        return damaged(chance, settings.to_bytes(apart=apart))


def unchecked(settings: TileSettings, **values: Any) -> TileSettings:
    """Return settings with other values, without the checks of settings."""
    changed = copy.copy(settings)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def _other(chance: random.Random, settings: TileSettings, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return some other values of settings."""
    turn = chance.randrange(8)
    numbers = (1e-300, 1e-38, 1.2e-38, 1e-12, 1.0, 1e12, 3.3e38, 1e300, 1.7e308)
    signed = (*numbers, *(-n for n in numbers), 0.0, np.nan, np.inf)
    if turn == 0:
        return {"step": chance.choice((*numbers, 0.0, -1.0)), "double": chance.random() < 0.5}
    if turn == 1:
        low, high = sorted(chance.choices(signed, k=2))
        return {"low": low, "high": high, "center": chance.choice(signed)}
    if turn == 2:
        offsets = tuple(chance.choice((-128, 127, 0)) for _ in settings.offsets)
        return {"quantum": chance.choice((*numbers, 0.0)), "offsets": offsets}
    if turn == 3:
        axes: list[Any] = list(settings.transform.axes)
        kinds = (("none", 0), ("haar", 1), ("haar", 10), ("5/3", 10), ("9/7", 10), ("9/7", 0))
        kind, depth = chance.choice(kinds)
        axis = SimpleNamespace(kind=kind, depth=depth, basis=None)
        if chance.random() < 0.5:
            axis = SimpleNamespace(kind="klt", depth=0, basis=_basis(chance, shape))
        axes[chance.randrange(4)] = axis
        return {"transform": SimpleNamespace(axes=tuple(axes))}
    if turn == 4:
        return {"head": _packed(chance, head_of(chance).to_bytes())}
    if turn == 5:
        some = chance.choices((*numbers, -1.0, 0.0, 0.25, 0.5, 0.75), k=chance.randrange(16))
        scores, others = (
            tuple(chance.choice((0, 1, 2048, 4095, 4096)) for _ in range(len(some) + 1))
            for _ in range(2)
        )
        mask = {"edges": tuple(sorted(some)), "scores": scores, "reach": chance.choice((0, 1, 65))}
        return {"mask": SimpleNamespace(**mask, others=chance.choice(((), others)))}
    if turn == 6:
        return {"predictor": _predictor(chance)}
    whole = (0, 1, -(1 << 63), (1 << 63) - 1, (1 << 53) + 1)
    low, high = sorted(chance.choices(whole, k=2))
    origin = chance.choice((*whole, (1 << 64) - 1, 1 << 64, -(1 << 71)))
    switches = {name: chance.random() < 0.5 for name in ("clip", "labels")}
    return {"low": low, "high": high, "origin": origin, **switches}


def _packed(chance: random.Random, data: bytes) -> Any:
    """Return what stands for a basis or head of some bytes, or of damaged ones."""
    data = damaged(chance, data) if chance.random() < 0.3 else data
    return SimpleNamespace(to_bytes=lambda: data)


def _basis(chance: random.Random, shape: tuple[int, ...]) -> Any:
    """Return a packed basis, mostly of a wrong length."""
    n = min(chance.choice((*shape, 1, 2, 512)), 512)  # longer ones cannot be packed
    rank = chance.randrange(n + 1) if n < 40 else 3
    integers = np.zeros((rank, n), np.int32)
    integers[:, 0] = 1
    packed = Basis(integers=integers, exponents=(0,) * rank).to_bytes()
    if chance.random() < 0.5:
        lengths = chance.choice((n, 0, 513, 65535)), chance.choice((rank, 0, 65535))
        packed = struct.pack("<HH", *lengths) + packed[4:]
    return _packed(chance, packed)


def head_of(chance: random.Random) -> NeighbourHead:
    """Return a head with extreme numbers."""
    hidden = [chance.choice((1, 3, 14)) for _ in range(chance.randrange(1, 4))]
    rng = np.random.default_rng(chance.getrandbits(32))
    scales = (6.0e-8, 0.001, 1.0, 65504.0)
    layers = tuple(
        Layer(
            weights=rng.integers(-31, 32, (width, columns)).astype(np.int8),
            biases=rng.integers(-127, 128, width).astype(np.int8),
            weight_scale=float(np.float16(chance.choice(scales))),
            bias_scale=float(np.float16(chance.choice(scales))),
        )
        for columns, width in pairwise((INPUTS, *hidden, 1))
    )
    ends = sorted(chance.choices((-3.4e38, -1.0, 0.0, 1e-45, 1.0, 2.0, 3.4e38), k=2))
    low, high, sigma = map(
        float, np.float32([*ends, chance.choice((2.0**-100, 1e-6, 1.0, 2.0**100))])
    )
    return NeighbourHead(layers=layers, sigma=sigma, low=low, high=high)


def _predictor(chance: random.Random) -> Any:
    """Return a predictor with extreme weights."""
    a, b, c, d = levels = [chance.choice((0, 1, 3, 8)) for _ in range(4)]
    e, f, g, h = order = chance.sample(range(4), 4)
    reach = chance.randrange(3)
    count = sum(len(each.taps) for each in passes_of((a, b, c, d), (e, f, g, h), reach))
    return SimpleNamespace(
        step=chance.choice((1e-300, 1.0, 1e300, 0.0)),
        origin=chance.choice((0.0, 1e308, -1e308)),
        levels=levels,
        order=order,
        reach=chance.choice((reach, reach, 3)),
        weights=chance.choices((-32767, 32767, 0, 4096, 32768), k=count),
    )


def _labels(chance: random.Random, stream: bytes, document: dict[str, Any]) -> bytes:
    """Change the palette, the labels or the flags of a tile of labels: a valid one, unless a
    decoder refuses it."""
    dtype = type_of(document)
    sections, flags = sections_of(parse_stream(stream)), stream[4]
    size, rest = read_varint(memoryview(sections[-1]))
    length, rest = read_varint(rest)
    packed, coded = bytes(rest[:length]), bytes(rest[length:])
    planes = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(dtype.itemsize, -1)
    steps = np.ascontiguousarray(planes.T).view(f"<u{dtype.itemsize}").reshape(-1)
    bits = np.cumsum(steps, dtype=steps.dtype)
    turn = chance.randrange(10)
    if turn == 0:  # other values
        packed = _palette(_specials(chance, bits, dtype))
    elif turn == 1:  # another number of values
        counts = (0, 1, 2, size - 1, size + 1, 256, 257, MAX_LABELS - 1, MAX_LABELS, 70_000)
        size = min(chance.choice(counts), 1 << min(8 * dtype.itemsize, 20))
        packed = _palette(np.arange(size, dtype=bits.dtype))
    elif turn == 2:  # values that do not ascend
        order = chance.choice((bits[::-1], np.repeat(bits, 2), np.roll(bits, 1), bits[:1] * 0))
        size, packed = len(order), _palette(order)
    elif turn == 3:  # bytes that are no palette
        others = (zlib.compress(bits.tobytes() + b"x"), zlib.compress(bytes(1 << 26)))
        packed = chance.choice((packed + b"x", packed[:-1], b"", damaged(chance, packed), *others))
    elif turn in (4, 5):  # other labels
        coded = damaged(chance, coded)
    elif turn in (6, 7):  # with a mask or without one, and other flags
        flags ^= chance.choice((OWN, MISSING, RESIDUAL, *[MASKED] * 8, 1, 3, 4, 128))
    length = len(packed)
    if turn == 8:  # another number of values, or another length of the palette
        number = chance.choice((0, 1, len(coded), length - 1, length + 1, 2**32 - 1, 2**35 - 1))
        size, length = chance.choice(((number, length), (size, number)))
    body = sections[-1] = varint(size) + varint(length) + packed + coded
    if turn == 9:
        cut = chance.choice((b"", body[:1], body[:2], body * 2, b"\xff" * 9))
        return sealed(bytes([flags]) + cut)
    return seal(flags, sections)


def _palette(values: Any) -> bytes:
    """Return a packed palette."""
    return pack_planes(np.diff(values, prepend=values.dtype.type(0)))


def _specials(chance: random.Random, bits: Any, dtype: np.dtype[Any]) -> Any:
    """Return the bits of as many other values: extreme ones, NaN among floats, or random ones."""
    most = (1 << 8 * dtype.itemsize) - 1
    chosen = {int(bit) for bit in bits}
    for bit in chance.sample(sorted(chosen), min(len(chosen), chance.choice((1, 2, 300)))):
        chosen.discard(bit)
        specials = [0, 1, most, most >> 1, (most >> 1) + 1, chance.randint(0, most)]
        if dtype.kind == "f":
            largest = np.finfo(dtype).max
            numbers = np.array((np.nan, np.inf, -np.inf, largest, -largest, -0.0), dtype)
            specials += map(int, numbers.view(f"u{dtype.itemsize}"))
        free = [special for special in specials if special not in chosen]
        chosen.add(chance.choice(free) if free else bit)
    return np.array(sorted(chosen), bits.dtype)


def _clip(chance: random.Random, parts: Parts) -> Parts:
    """Change the range to which values are clipped, the switch, or the features of the header.

    Without an error all decoded values lie in the range (hostile_trial.py checks it).
    """
    file = Documents(parts)
    document = file.arrays.get(file.table)
    settings = settings_of(document) if document and is_coded(document) else None
    if document is None or settings is None or not settings.clip:
        raise NothingFitsError
    low, high = float(settings.low), float(settings.high)
    middle = (low + high) / 2
    ends = (
        *((low, low), (high, high), (middle, middle), (middle, high), (low, middle), (high, low)),
        *((-0.0, 0.0), (low - 1, high + 1), (5e-324, 1e-323), (-1e300, 1e300), (-3.4e38, 3.4e38)),
        *((3.5e38, 3.6e38), (-1e39, -1e38), (1e308, 1.7e308), (low, np.inf), (np.nan, high)),
    )
    turn, values = chance.randrange(6), {}
    if turn == 0:
        values = {"clip": False}
    elif turn in (1, 2):
        values = dict(zip(("low", "high"), chance.choice(ends), strict=True))
    elif turn == 3:  # residuals far beyond the range
        values = {"quantum": chance.choice((*FLOATS, 1e6, 1e30, 1e300, 2.0**1000))}
    elif turn == 4:
        file.header["value_range"] = chance.choice(
            ([low - 9, low - 8], [middle, middle], [high, high], [0, 0], [-3e38, 3e38])
        )
    else:
        file.top["format_version"] = chance.choice(([1, 8], [2, 1], [2, 2], [3, 0]))
        values = {"double": chance.random() < 0.5}
    try:
        put_settings(document, unchecked(settings, **values).to_bytes(apart=True))
    except (InputError, OverflowError, ValueError) as error:  # whole ends have no fractions
        raise NothingFitsError from error
    return file.packed()


def _changed(chance: random.Random, values: np.ndarray[Any, Any]) -> None:
    """Change one value of a chunk, or many."""
    for _ in range(chance.choice((1, 1, 2, 4, values.size))):
        at = chance.randrange(values.size)
        old = values[at].item()
        if values.dtype.kind == "f":
            near = (old * 1e6, old * 2, old / 3, -old, float(values[0]))
            values[at] = chance.choice((*NUMBERS, 0.5, 128.0, 2.0**63, 2.0**100, *near))
        elif values.dtype.kind == "b":
            values[at] = not old
        else:
            most = np.iinfo(values.dtype)
            bit = values.dtype.type(1) << values.dtype.type(chance.randrange(8))
            others = (0, 1, most.min, most.max, old ^ 1, 255 & old + 1)
            values[at] = values[at] ^ bit if chance.random() < 0.3 else chance.choice(others)


def _values(
    *beginnings: str, fits: Callable[[Documents], bool] = lambda file: True
) -> Callable[[random.Random, Parts], Parts]:
    """Return a mutation of values of ordinary arrays: weights, tables, occupancy, sums of errors.
    beginnings: of their paths."""

    def changed(chance: random.Random, parts: Parts) -> Parts:
        file = Documents(parts)
        names = [
            name
            for name, document in file.arrays.items()
            if name.startswith(beginnings or ("",)) and not is_coded(document)
        ]
        members = [member for name in names for member in file.members(name)]
        if not members or not fits(file):
            raise NothingFitsError
        member = chance.choice(members)
        values = file.values(member)
        with np.errstate(all="ignore"):
            _changed(chance, values)
            if chance.random() < 0.15:
                whole = NUMBERS if values.dtype.kind == "f" else (0, 1, 128, 255)
                values[:] = chance.choice([np.array(one).astype(values.dtype) for one in whole])
        return replaced(parts, {member: stored(values)})

    return changed


CORRECTIONS = "corrections"
ERRORS = "step_errors"
OCCUPANCY = "occupancy"
"""Paths of the corrections of a plain file, of sums of errors and of occupancy."""


def _numbers(chance: random.Random, parts: Parts) -> Parts:
    """Change numbers of a plain file: tables and corrections, and the type of these."""
    file = Documents(parts)
    if not is_plain(file):
        raise NothingFitsError
    if chance.random() < 0.25 and CORRECTIONS in file.arrays:
        if chance.random() < 0.5:
            return [item for item in parts if not item[0].startswith(f"{CORRECTIONS}/")]
        kind = chance.choice(("float32", "float64", "int32", "float16", "uint8"))
        new = {
            member: stored(file.values(member).astype(kind)) for member in file.members(CORRECTIONS)
        }
        document = file.arrays[CORRECTIONS]
        document["data_type"] = kind
        document["codecs"][0]["configuration"] = {} if kind == "uint8" else {"endian": "little"}
        return file.packed(new)
    return _values("table_", CORRECTIONS)(chance, parts)


def _occupancy(chance: random.Random, parts: Parts) -> Parts:
    """Change which vertices are in the coreset, in the array that says so."""
    file, name = Documents(parts), OCCUPANCY
    if name not in file.arrays:
        raise NothingFitsError
    turn = chance.randrange(7)
    if turn == 0:  # another block, or none
        old, block = (
            file.arrays[name].get("attributes", {}),
            (1, 2, 8, 16, 64, 2**40, 3, 0, -1, 1.0),
        )
        changed = {**old, "block": chance.choice(block)} if chance.random() < 0.7 else {}
        file.arrays[name]["attributes"] = changed
        return file.packed()
    if turn == 1:  # gone
        return [item for item in parts if not item[0].startswith(f"{name}/")]
    if turn == 2:
        features = file.top["required_features"]
        file.top["required_features"] = chance.choice(
            (features * 2, [*features, "sparse-tables"], [*features, "transform"], [])
        )
        return file.packed()
    if turn == 3:
        file.header["features"] = chance.choice(
            ([], ["all"], ["all"] * 2, ["interval:1:2"], ["interval:1:2"] * 40)
        )
        return file.packed()
    return _values(name)(chance, parts)


def _errors(chance: random.Random, parts: Parts) -> Parts:
    """Change the sums of errors of a part, or the form of their array."""
    file = Documents(parts)
    if ERRORS in file.arrays and chance.random() < 0.15:
        shapes = ([1, 10], [3, 10], [2, 9], [20], [2, 10, 1])
        file.arrays[ERRORS]["shape"] = chance.choice(shapes)
        return file.packed()
    return _values(ERRORS)(chance, parts)


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "bytes": _bytes,
    "stream": _tile(_stream),
    "index": _index,
    "members": _members,
    "together": _together,
    "values": _values(),
    "flags": _tile(_flags),
    "settings": _settings,
    "labels": _tile(_labels, fits=lambda stream: stream[4] & KIND == LABELS),
    "clip": _clip,
    "plain numbers": _numbers,
    "occupancy": _occupancy,
    "errors": _errors,
}
