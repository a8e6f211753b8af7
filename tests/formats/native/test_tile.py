"""Tiles by the C interface of fhash.h, called as C calls it: statuses, types, threads, damage."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from rarely import rarely
from reference.tile import decode_tile

from fhash_formats import native
from fhash_formats.native import crc32c, ffi, pointer
from fhash_formats.transform.spec import AxisTransform, MaskLevels, TransformSpec
from fhash_formats.transform.tile import Coding, encode_tile
from fhash_formats.transform.tile_format import TileSettings

FOLDER = Path(native.__file__).parent
HEADER = (FOLDER / "fhash.h").read_text(encoding="utf-8")
STATUS = {name: int(n) for name, n in re.findall(r"FHASH_(\w+) = (-?\d+)", HEADER)}
TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
SHAPE = (2, 3, 5, 9)
Values = npt.NDArray[Any]


LIBRARY, NULL = native.library(), ffi.NULL
HELD: list[Any] = []


@pytest.fixture
def context() -> Iterator[Any]:
    made = LIBRARY.fhash_context_create(0, 1)
    yield made
    LIBRARY.fhash_context_destroy(made)


def tile_of(shape: tuple[int, ...], dtype: Any, settings: bytes | None = None) -> Any:
    kind = TYPES.index(np.dtype(dtype).str[1:]) + 1
    packed = NULL if settings is None else ffi.from_buffer(settings)
    HELD.append(packed)
    return ffi.new("fhash_tile *", (shape, kind, 0, packed, len(settings or b"")))


def encode(context: Any, values: Values, room: int = 1 << 16, **given: Any) -> Any:
    """Status, text, size and bytes of a stream; given: fields of the quality, `missing`, `tile`."""
    tile = given.pop("tile", tile_of(values.shape, values.dtype))
    missing = np.asarray(given.pop("missing", ()), values.dtype)
    numbers = {"max_error": -1.0, "effort": 2, "missing": len(missing), **given}
    quality = ffi.new("fhash_quality *", numbers)
    error, size, stream = ffi.new("fhash_error *"), ffi.new("size_t *"), bytearray(max(room, 1))
    status = LIBRARY.fhash_tile_encode(
        *(context, tile, pointer(values), quality, pointer(missing if len(missing) else None)),
        *(ffi.from_buffer(stream), room, size, error),
    )
    text = ffi.string(error.text).decode()
    assert error.status == status
    assert bool(text) == (status != 0)
    return status, text, size[0], bytes(stream[: size[0] if not status else 0])


def decode(context: Any, data: bytes, tile: Any, lod: int = 0, mask: bool = False) -> Any:
    """Status, values and mask of a stream; the values are followed by bytes that stay."""
    steps, *space = tile.shape
    shape = (steps, *(-(-n // (1 << max(lod, 0))) for n in space))
    dtype = np.dtype(TYPES[(tile.type - 1) % 11])
    room = np.full(int(np.prod(np.maximum(shape, 1))) * dtype.itemsize + 16, 77, np.uint8)
    seen = np.full(int(np.prod(np.maximum(shape, 1))) + 16, 77, np.uint8) if mask else None
    status = LIBRARY.fhash_tile_decode(
        *(context, tile, ffi.from_buffer(data), len(data)),
        *(lod, pointer(room), pointer(seen), ffi.NULL),
    )
    assert (room[-16:] == 77).all()
    assert seen is None or (seen[-16:] == 77).all()
    if status:
        return status, None, None
    found = room[:-16].view(dtype).reshape(shape)
    return status, found, None if seen is None else seen[:-16].reshape(shape).view(bool)


def field(dtype: Any, shape: tuple[int, ...] = SHAPE) -> Values:
    t, z, y, x = np.indices(shape)
    noise = np.random.default_rng(5).normal(0, 0.1, shape)
    return ((np.sin(0.4 * x + 0.2 * t) + np.cos(0.3 * y - z) + 2 + noise) * 25).astype(dtype)


def settings_of(values: Values, **changes: Any) -> TileSettings:
    nine = AxisTransform(kind="9/7", depth=1)
    return TileSettings(
        transform=TransformSpec(axes=(AxisTransform(kind="haar", depth=1), nine, nine, nine)),
        step=2.0,
        center=50.0,
        low=float(values.min()),
        high=float(values.max()),
        **changes,
    )


def test_version_and_types() -> None:
    major, minor = (int(n) for n in re.findall(r"FHASH_VERSION_M\w+ (\d+)", HEADER))
    assert LIBRARY.fhash_version() == 1000 * major + minor
    sizes = [LIBRARY.fhash_type_size(n) for n in range(-1, 13)]
    assert sizes == [0, 0, *(np.dtype(kind).itemsize for kind in TYPES), 0]


@pytest.mark.parametrize("dtype", TYPES)
def test_every_type_comes_back_as_the_reference_reads_it(dtype: str) -> None:
    """Two threads and one give the same bytes and bits."""
    made = [LIBRARY.fhash_context_create(0, threads) for threads in (1, 2)]
    values, tile = field(dtype), tile_of(SHAPE, dtype)
    for quality, error in (({"max_error": 0.0}, 0), ({"max_error": 3.0}, 3), ({"step": 4.0}, 16)):
        both = [encode(each, values, **quality) for each in made]
        assert both[0] == both[1]
        status, _, size, data = both[0]
        assert status == 0
        assert size <= LIBRARY.fhash_tile_bound(tile)
        expected = decode_tile(data, SHAPE, np.dtype(dtype))[0].tobytes()
        for each in made:
            found, mask = decode(each, data, tile, mask=True)[1:]
            assert found.tobytes() == expected
            assert np.abs(found.astype(float) - values.astype(float)).max() <= error
            assert mask.all()
        for lod in (1, 2, 10):
            coarse = [decode(each, data, tile, lod)[1] for each in made]
            assert coarse[0].tobytes() == coarse[1].tobytes()
            if error == 0 and data[4] & 7 != 0:
                every = 1 << lod
                assert np.array_equal(coarse[0], values[:, ::every, ::every, ::every])
    for each in made:
        LIBRARY.fhash_context_destroy(each)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i2", "u8"])
def test_masks_and_settings_beside_the_stream(dtype: str, context: Any) -> None:
    values = field(dtype)
    settings = settings_of(values, mask=MaskLevels(edges=(60.0,), scores=(0, 90), reach=1))
    occupied = values > values.mean()
    data = encode_tile(values, settings, Coding(weight=0.1), in_coreset=occupied).data
    block = settings.to_bytes()
    _, found, mask = decode(context, data, tile_of(SHAPE, dtype, block), mask=True)
    theirs, their_mask = decode_tile(data, SHAPE, np.dtype(dtype), block)
    assert np.array_equal(mask, occupied)
    assert np.array_equal(mask, their_mask)
    assert found.tobytes() == theirs.tobytes()
    assert decode(context, data, tile_of(SHAPE, dtype, block))[1].tobytes() == theirs.tobytes()
    assert decode(context, data, tile_of(SHAPE, dtype))[0] == STATUS["ERROR_DAMAGED"]


QUALITIES: tuple[dict[str, float], ...] = (
    {"max_error": 0.7},
    {"max_error_rel": 0.01},
    {"step": 4.0},
    {"max_error": 0.0},
)


def error_of(found: Values, values: Values) -> float:
    """The largest error, in Python's numbers."""
    pairs = zip(found.ravel().tolist(), values.ravel().tolist(), strict=True)
    return max((abs(one - other) for one, other in pairs), default=0)


def limit_of(quality: dict[str, float], values: Values) -> float:
    """The largest error that a quality allows."""
    if "max_error_rel" in quality:
        return quality["max_error_rel"] * (values.max().item() - values.min().item())
    return quality.get("max_error", np.inf)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("effort", [1, *rarely(3)])
def test_missing_values_come_back_bit_by_bit(dtype: str, effort: int, context: Any) -> None:
    """Far from the others and among them, one and two of them, in every form of a stream; the
    bounds are those of the other values, and the reference reads the same bits."""
    values = field(dtype)
    top = np.iinfo(dtype).max if values.dtype.kind in "iu" else np.finfo(dtype).max
    middle = values.ravel()[40]
    for missing in ([top], [middle], [top, middle], [top, 0]):
        gone = np.random.default_rng(1).random(SHAPE) < 0.3
        named = np.asarray(missing, dtype)
        given = np.where(gone, np.random.default_rng(2).choice(named, SHAPE), values)
        kept = ~np.isin(given, named)
        for quality in QUALITIES:
            data = encode(context, given, missing=missing, effort=effort, **quality)[3]
            found = decode(context, data, tile_of(SHAPE, dtype))[1]
            assert found[~kept].tobytes() == given[~kept].tobytes()
            assert error_of(found[kept], given[kept]) <= limit_of(quality, given[kept])
            assert found.tobytes() == decode_tile(data, SHAPE, np.dtype(dtype))[0].tobytes()


def test_values_beside_a_missing_one_beyond_any_difference(context: Any) -> None:
    """Differences from an origin near one end of int64 do not reach the other end."""
    values = (field("i8") + 2**62).astype("i8")
    values[0, 1] = np.iinfo("i8").min
    for quality in QUALITIES:
        data = encode(context, values, missing=[np.iinfo("i8").min], **quality)[3]
        found = decode(context, data, tile_of(SHAPE, "i8"))[1]
        assert (found[0, 1] == values[0, 1]).all()
        kept = values > 0
        assert error_of(found[kept], values[kept]) <= limit_of(quality, values[kept])
        assert found.tobytes() == decode_tile(data, SHAPE, np.dtype("i8"))[0].tobytes()


@pytest.mark.parametrize("dtype", ["f4", "i2", "f2", "u8"])
def test_what_a_store_puts_there_is_found_without_being_named(dtype: str, context: Any) -> None:
    """Flags far from all other values at both ends, and zeros in planes that nobody wrote."""
    values = field(dtype) + np.asarray(20, dtype)
    flags = {"i2": (-32768, -32767, 32767), "u8": (2**63,)}.get(dtype, (-60000, -59000, 60000))
    for number, flag in enumerate(flags):
        values[0, number, 0] = flag
    values[1], values[:, :, 3] = 0, 0
    kept = (values != 0) & ~np.isin(values, np.asarray(flags, dtype))
    for quality in QUALITIES:
        data = encode(context, values, **quality)[3]
        found = decode(context, data, tile_of(SHAPE, dtype))[1]
        assert found[~kept].tobytes() == values[~kept].tobytes()
        assert error_of(found[kept], values[kept]) <= limit_of(quality, values[kept])


def test_rows_are_written_one_after_the_other(context: Any) -> None:
    """A store decodes a chunk, and codes it with new rows: what is not there yet stays, and bounds
    are those of what is there."""
    values, fill = field("f4") - 50, np.float32(-999)
    for missing in ([fill], []):
        blank = fill if missing else np.float32(0)
        chunk = np.full(SHAPE, blank)
        for row in range(SHAPE[2]):
            chunk[:, :, row] = values[:, :, row]
            data = encode(context, chunk, missing=missing, max_error_rel=0.01)[3]
            chunk = decode(context, data, tile_of(SHAPE, "f4"))[1].copy()
            assert (chunk[:, :, row + 1 :] == blank).all()
            assert np.abs(chunk - values)[:, :, row].max() <= 0.01 * np.ptp(values[:, :, : row + 1])


def test_many_nan_of_different_bits(context: Any) -> None:
    """Every bit is asked for: each NaN keeps its own, also where they are too many to be named."""
    for count in (3, 400):
        values = field("f4", (2, 3, 20, 30)).ravel()
        values[:count] = (np.arange(count, dtype="u4") + 0x7FC00000).view("f4")
        values = values.reshape(2, 3, 20, 30)
        data = encode(context, values, max_error=0.0)[3]
        found = decode(context, data, tile_of(values.shape, "f4"))[1]
        assert found.tobytes() == values.tobytes()


def test_missing_values_that_are_damaged(context: Any) -> None:
    values = field("f4")
    values[0, 0, 0, 0], values[0, 0, 0, 1] = np.inf, 1e9
    data = encode(context, values, max_error=0.1)[3]
    at = data.index(np.float32([1e9, np.inf]).tobytes())
    assert data[at - 1] == 2
    for section in (
        bytes([2]) + np.float32([np.inf, 1e9]).tobytes(),
        bytes([2]) + np.float32([1e9, 1e9]).tobytes(),
        bytes([255]) + data[at : at + 8],
    ):
        body = data[4 : at - 1] + section + data[at + 8 :]
        stream = crc32c(body).to_bytes(4, "little") + body
        assert decode(context, stream, tile_of(SHAPE, "f4"))[0] == STATUS["ERROR_DAMAGED"]


def test_arguments_that_are_not_allowed(context: Any) -> None:
    values, wrong = field("f4"), STATUS["ERROR_ARGUMENT"]
    shapes = ((0, 1, 1, 1), (1, 1, -1, 1), (1, 1 << 14, 1 << 14, 1))
    bad = [tile_of(shape, "f4") for shape in shapes]
    bad += [ffi.new("fhash_tile *", (SHAPE, kind)) for kind in (0, 12, -1)]
    shared = tile_of(SHAPE, "f4", settings_of(values).to_bytes())
    for tile in (*bad, shared):
        assert encode(context, values, max_error=1.0, tile=tile)[0] == wrong
    qualities: tuple[dict[str, Any], ...] = (
        {},
        {"max_error": 1.0, "step": 1.0},
        {"max_error": np.nan},
        {"step": np.inf},
        {"step": -1.0},
        {"max_error": 1.0, "effort": 0},
        {"max_error": 1.0, "effort": 10},
        {"max_error": 1.0, "transform_given": 1, "transform": (0, 0, 64, 0)},
        {"max_error": 1.0, "transform_given": 1, "transform": (0, 0, 59, 0)},
    )
    for quality in qualities:
        assert encode(context, values, **quality)[0] == wrong
    assert encode(NULL, values, max_error=1.0)[0] == wrong
    data, tile = encode(context, values, max_error=1.0)[3], tile_of(SHAPE, "f4")
    assert decode(NULL, data, tile)[0] == wrong
    assert [decode(context, data, tile, lod)[0] for lod in (-1, 11)] == [wrong, wrong]
    assert decode(context, data, tile, 1, mask=True)[0] == wrong
    for each in bad[:2]:
        assert decode(context, data, each)[0] == wrong
    some, call = ffi.new("char[]", 1 << 12), LIBRARY.fhash_tile_decode
    for of, stream, room in ((NULL, data, some), (tile, NULL, some), (tile, data, NULL)):
        assert call(context, of, stream, len(data), 0, room, NULL, NULL) == wrong
    assert LIBRARY.fhash_tile_bound(NULL) == 0


def test_room_that_is_too_small_is_told_with_the_size(context: Any) -> None:
    values = field("f4")
    _, _, size, data = encode(context, values, max_error=0.1)
    for room in (0, size - 1):
        status, text, needed, _ = encode(context, values, room, max_error=0.1)
        assert (status, needed) == (STATUS["ERROR_SIZE"], size)
        assert str(size) in text
    assert encode(context, values, size, max_error=0.1)[3] == data


def test_memory_is_limited_by_the_context() -> None:
    narrow, values = LIBRARY.fhash_context_create(1000, 1), field("f4")
    wide = LIBRARY.fhash_context_create(1 << 26, 1)
    data = encode(wide, values, max_error=0.1)[3]
    assert encode(narrow, values, max_error=0.1)[0] == STATUS["ERROR_MEMORY"]
    assert decode(narrow, data, tile_of(SHAPE, "f4"))[0] == STATUS["ERROR_MEMORY"]
    assert decode(wide, data, tile_of(SHAPE, "f4"))[0] == 0
    for each in (narrow, wide):
        LIBRARY.fhash_context_destroy(each)


def test_damage_is_told_or_gives_some_values(context: Any) -> None:
    """Cut and flipped streams, under the checksum that they have and under the right one."""
    random, damaged = np.random.default_rng(0), STATUS["ERROR_DAMAGED"]
    qualities = {"f4": {"max_error": 0.1}, "i2": {"max_error": 0.0}, "f8": {"step": 9.0}}
    for dtype, quality in qualities.items():
        data, tile = encode(context, field(dtype), **quality)[3], tile_of(SHAPE, dtype)
        assert all(decode(context, data[:cut], tile)[0] == damaged for cut in range(len(data)))
        for turn in range(200):
            other = bytearray(data)
            for _ in range(1 + turn % 3):
                other[random.integers(len(other))] ^= 1 << random.integers(8)
            if other == data:
                continue
            assert decode(context, bytes(other), tile)[0] == damaged
            body = bytes(other[4 : random.integers(5, len(other) + 1)])
            stream = crc32c(body).to_bytes(4, "little") + body
            assert decode(context, stream, tile, turn % 2)[0] in (0, damaged)


def test_two_threads_share_a_context(context: Any) -> None:
    """Settings and norms are made once, by whoever comes first."""
    several = [field(dtype, (1, 2, n, 12)) for n in (5, 8, 17) for dtype in ("f4", "f8", "i4")]
    alone = [encode(context, values, max_error=0.5)[3] for values in several]
    fresh = LIBRARY.fhash_context_create(0, 2)

    def there_and_back(number: int) -> tuple[bytes, bytes]:
        values = several[number % len(several)]
        data = encode(fresh, values, max_error=0.5)[3]
        return data, decode(fresh, data, tile_of(values.shape, values.dtype))[1].tobytes()

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(there_and_back, range(2 * len(several))))
    LIBRARY.fhash_context_destroy(fresh)
    for (data, bits), values, one in zip(found, several * 2, alone * 2, strict=True):
        assert data == one
        expected = decode(context, one, tile_of(values.shape, values.dtype))[1]
        assert bits == expected.tobytes()
