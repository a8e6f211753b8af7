"""Mutations of the ZIP around a container, with a correct digest: names, sizes, offsets, bombs."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable
from math import prod

from containers import Parts, directory_of, pack, pack_members, resealed, with_crc
from documents import DOCUMENT, GROUP, array_of_zeros, dumped
from numcodecs.zstd import compress

from fhash_formats.container.zip_file import ENTRY, comment, deflated

NUMBERS = (
    *(0, 1, 7, 8, 20, 63, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x10000),
    *(0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF),
)
NAMES = (
    *("../x", "a/../../x", "/etc/passwd", "..", ".", "", "a\\x", "C:x", "c:/x", "x/", "x//y"),
    *("./x", "~/x", "a b", "a\nb", "a\x00b", ".x", "x/.y", "%2e%2e/x", "CON", "x:y"),
    *("x" * 512, "x" * 513, "x" * 65535, "x/" * 250 + "y", "zarr.json/zarr.json", "c/0"),
    *("table_1/c/x", "table_1/t/00", "table_1/t/9223372036854775808"),
)
FIELDS = (
    *((at, "H") for at in (4, 6, 8, 10, 12, 14, 28, 30, 32, 34, 36)),
    *((at, "I") for at in (0, 16, 20, 24, 38, 42)),
)
"""Offset and form of each field of an entry of the directory; END_FIELDS of the end record."""
END_FIELDS = ((0, "I"), (4, "H"), (6, "H"), (8, "H"), (10, "H"), (12, "I"), (16, "I"), (20, "H"))


def _entries(data: bytes) -> list[int]:
    """Return the offset of each entry of the directory."""
    at, offsets = directory_of(data), []
    while data[at : at + 4] == b"PK\x01\x02":
        offsets.append(at)
        at += ENTRY.size + struct.unpack_from("<H", data, at + 28)[0]
    return offsets


def _put(chance: random.Random, data: bytearray, at: int, form: str) -> int:
    """Change a number of a file, and return it."""
    old = struct.unpack_from(f"<{form}", data, at)[0]
    new = chance.choice((*NUMBERS, old + 1, old - 1, old * 2, old // 2))
    new %= 1 << 16 if form == "H" else 1 << 32
    struct.pack_into(f"<{form}", data, at, new)
    return int(new)


def _field(chance: random.Random, parts: Parts) -> bytes:
    """Change one or a few fields of entries, sometimes in the local header, too."""
    data = bytearray(pack(parts))
    start = directory_of(bytes(data))
    for _ in range(chance.choice((1, 1, 2, 4))):
        entry = chance.choice(_entries(bytes(data)) or [start])
        at, form = chance.choice(FIELDS)
        new = _put(chance, data, entry + at, form)
        local = struct.unpack_from("<I", data, entry + 42)[0]
        if 6 <= at <= 30 and chance.random() < 0.5 and local + 30 < start:
            struct.pack_into(f"<{form}", data, local + at - 2, new)
    return resealed(bytes(data), start)


def _end(chance: random.Random, parts: Parts) -> bytes:
    """Change a field of the end record, or put records before it."""
    data = bytearray(pack(parts))
    start, end = directory_of(bytes(data)), len(data) - len(comment(b"")) - 22
    if chance.random() >= 0.3:
        at, form = chance.choice(END_FIELDS)
        _put(chance, data, end + at, form)
        return resealed(bytes(data), start)
    numbers = chance.choices((*NUMBERS, 2**60, 2**63, 2**64 - 1), k=4)
    record = struct.pack("<4sQ2H2I4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, *numbers)
    locator = struct.pack("<4sIQI", b"PK\x06\x07", 0, chance.choice((end, 0, 2**63)), 1)
    struct.pack_into("<I", data, end + 16, 0xFFFFFFFF)
    return resealed(bytes(data[:end]) + record + locator + bytes(data[end:]), start)


def _signature(chance: random.Random, parts: Parts) -> bytes:
    """Put another version or another text into the comment."""
    data, words = pack(parts), ("fhash 0", "fhash 1", "fhash 3", "fhash 9999", "fhash -", "FHASH 2")
    new = chance.choice((*words, "fhash 02")).encode()
    other = data.replace(b"fhash 3", new)
    return other if chance.random() < 0.8 else data[:-1] + chance.randbytes(1)


def _named(chance: random.Random, parts: Parts) -> bytes:
    """Give a member another name: a hostile one, or that of another member."""
    at = chance.randrange(len(parts))
    name = chance.choice(NAMES) if chance.random() < 0.6 else chance.choice(parts)[0]
    if chance.random() < 0.5:
        return pack([*parts[:at], (name, parts[at][1]), *parts[at + 1 :]])
    return pack([*parts[:at], (name, chance.choice((b"", b"x", parts[at][1]))), *parts[at:]])


def _dropped(chance: random.Random, parts: Parts) -> bytes:
    """Remove some members."""
    gone = set(chance.sample(range(len(parts)), chance.choice((1, 1, 2, len(parts) // 2))))
    return pack([member for number, member in enumerate(parts) if number not in gone])


def _exchanged(chance: random.Random, parts: Parts) -> bytes:
    """Replace the data of one member by another's."""
    first, second = chance.randrange(len(parts)), chance.randrange(len(parts))
    changed = list(parts)
    changed[first] = (parts[first][0], parts[second][1])
    if chance.random() < 0.5:
        changed[second] = (parts[second][0], parts[first][1])
    return pack(changed)


def _shuffled(chance: random.Random, parts: Parts) -> bytes:
    """Shuffle the members."""
    changed = list(parts)
    chance.shuffle(changed)
    return pack(changed)


def _nested(chance: random.Random, parts: Parts) -> bytes:
    """Put nodes into nodes: an array into an array, groups hundreds deep, a hierarchy below its own
    array."""
    deep = "a/" * chance.choice((1, 60, 200)) + "a"
    prefix = chance.choice(("missing", "table_1", "table_2", "table_1/t", deep))
    below = [(f"{prefix}/{name}", data) for name, data in parts if len(prefix) + len(name) < 512]
    if chance.random() < 0.5:
        path = prefix.split("/")
        below += [("/".join([*path[:n], DOCUMENT]), GROUP) for n in range(1, len(path) + 1)]
    return pack([*dict([*below, *parts]).items()])


def _many(chance: random.Random, parts: Parts) -> bytes:
    """Add thousands of members."""
    count = chance.choice((100, 3000))
    document = chance.choice((GROUP, b"{}", b""))
    return pack([*((f"g{number}/{DOCUMENT}", document) for number in range(count)), *parts])


def _bomb(chance: random.Random, parts: Parts) -> bytes:
    """Replace a document or chunk by one that inflates to 2^20 to 2^31 bytes, declared truly or
    not."""
    at = chance.randrange(len(parts))
    name, data = parts[at]
    size = 1 << chance.choice((20, 24, 26, 30, 31))
    bomb: tuple[str, bytes, int | None, int]
    if name.endswith(DOCUMENT):
        block = chance.choice((b" ", b"[", b'{"a":', b"0", b'"')) * (1 << 20)
        small = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
        pieces = [small.compress(block[: 1 << 20]) for _ in range(min(size, 1 << 26) >> 20)]
        full = chance.choice((size, len(data), 16 << 20, (16 << 20) + 1, 2**32 - 1)) % (1 << 32)
        bomb = (name, b"".join(pieces) + small.flush(), full, zlib.crc32(data))
    else:
        declared = chance.choice((None, size, 64, 2**63, 2**64 - 1))
        stored = with_crc(_zeros(min(size, 1 << 30), declared))
        bomb = (name, stored, None, zlib.crc32(stored))
    plain = [(other, content, None, zlib.crc32(content)) for other, content in parts]
    return pack_members([*plain[:at], bomb, *plain[at + 1 :]])


def _zeros(size: int, declared: int | None) -> bytes:
    """Return a zstd frame of zeros in blocks of one repeated byte: 128 KiB from 4 bytes."""
    head = struct.pack("<IB", 0xFD2FB528, 0x00) + b"\x88"
    if declared is not None:
        head = struct.pack("<IBBQ", 0xFD2FB528, 0xC0, 0x88, declared)
    block, last = (struct.pack("<I", (1 << 17) << 3 | end)[:3] + b"\0" for end in (2, 3))
    return head + block * (-(-size // (1 << 17)) - 1) + last


def _deflated(chance: random.Random, parts: Parts) -> bytes:
    """Deflate members that may or may not be deflated, with sizes that are right or wrong."""
    given = []
    for name, data in parts:
        packed = name.endswith(DOCUMENT) or chance.random() < 0.1
        full = max(0, len(data) + chance.choice((*[0] * 20, 1, -1))) if packed else None
        given.append((name, deflated(data) if packed else data, full, zlib.crc32(data)))
    return pack_members(given)


def _extra(chance: random.Random, parts: Parts) -> bytes:
    """Add another array, sound or not."""
    shape = [chance.choice((1, 2, 2**20, 2**31, 2**60)) for _ in range(chance.choice((1, 2, 4, 8)))]
    chunk = [chance.choice((1, n, min(n, 2**28))) for n in shape]
    names = ("extra", "missing", "occupancy", "key_frames", "step_figures", "corrections", "time")
    name = chance.choice(names)
    small = array_of_zeros(name, [1], "uint8")
    document = json.loads(small[0][1])
    document["shape"], document["chunk_grid"]["configuration"]["chunk_shape"] = shape, chunk
    size = min(1 << 28, max(1, prod(chunk)))
    frame = _zeros(size, size) if chance.random() < 0.5 else compress(bytes(min(size, 1 << 20)), 1)
    members = {
        small[0][0]: dumped(document),
        f"{name}/c/" + "/".join("0" * len(shape)): with_crc(frame),
        **({f"{name.split('/')[0]}/{DOCUMENT}": GROUP} if "/" in name else {}),
    }
    return pack([*{**dict(parts), **members}.items()])


KINDS: dict[str, Callable[[random.Random, Parts], bytes]] = {
    "entry": _field,
    "end": _end,
    "signature": _signature,
    "named": _named,
    "dropped": _dropped,
    "exchanged": _exchanged,
    "shuffled": _shuffled,
    "nested": _nested,
    "many": _many,
    "bomb": _bomb,
    "deflated": _deflated,
    "extra": _extra,
}
