"""Tiles in blocks: the values of other tiles, and of parts from the blocks that they need."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from specs import spec_of
from tiles import SETTINGS, Values, resealed, wave, with_head

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform import tile as transform_tile
from fhash_formats.transform.tile import Coding, decode_region, decode_tile, encode_tile
from fhash_formats.transform.tile_format import BLOCKS, KIND, TRANSFORMED, TileSettings

SHAPE = (6, 13, 30, 45)
AXES = {
    "coupled": (("haar", "5/3", "9/7", "9/7"), (1, 1, 2, 2), (2, 2, 3, 3)),
    "apart": (("9/7", "none", "5/3", "haar"), (1, 0, 2, 1), (1, 2, 3, 4)),
    "basis": (("klt", "9/7", "klt", "5/3"), (0, 1, 0, 2), (0, 2, 0, 3)),
    "deep": (("none", "none", "9/7", "9/7"), (0, 0, 4, 4), (1, 2, 4, 4)),
    "none": (("none",) * 4, 0, (2, 3, 3, 4)),
}
"""Kinds and depths along t, z, y, x, and logarithms of the lengths of blocks."""
EVERYWHERE = 1 | 2 << 4 | 3 << 8 | 3 << 12


def noisy(shape: tuple[int, ...] = SHAPE, dtype: Any = np.float32) -> Values:
    noise = np.random.default_rng(1).normal(0, 0.2, shape)
    return (wave(shape).astype(float) * 0.8 + noise).clip(-2, 3).astype(dtype)


def made(name: str, **changes: Any) -> tuple[TileSettings, int]:
    """Settings, and where their tiles are cut."""
    kinds, depths, logs = AXES[name]
    settings = replace(SETTINGS, transform=spec_of(kinds, depths, SHAPE), **changes)
    return settings, sum(log << 4 * axis for axis, log in enumerate(logs))


def parts(count: int, shape: tuple[int, ...] = SHAPE) -> list[tuple[slice, ...]]:
    random = np.random.default_rng(2)
    found = []
    for _ in range(count):
        part = []
        for n in shape:
            first = int(random.integers(n))
            part.append(slice(first, int(random.integers(first + 1, min(n, first + 6) + 1))))
        found.append(tuple(part))
    return found


@pytest.mark.parametrize("trellis", [False, True])
@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("name", list(AXES))
def test_parts_are_those_of_the_tile(name: str, fast: bool, trellis: bool) -> None:
    settings, cut = made(name, trellis=trellis)
    for error in (None, 0.05):
        coding = Coding(weight=0.1, fast=fast, cut=cut, error=error)
        coded = encode_tile(noisy(), settings, coding)
        assert coded.data[4] & KIND == BLOCKS
        whole = decode_tile(coded.data, SHAPE, np.float32, settings)
        assert whole.tobytes() == coded.decoded.tobytes()
        found = 0
        for part in parts(20):
            some = decode_region(coded.data, SHAPE, np.float32, settings, part)
            if some is not None:
                assert some.tobytes() == whole[part].tobytes()
                found += 1
        assert found > 5 or name in ("basis", "deep")  # of which most parts need most


@pytest.mark.parametrize("dtype", ["float16", "int16", "float64"])
def test_parts_of_any_type_behind_a_head(dtype: str) -> None:
    settings = replace(with_head(), transform=made("coupled")[0].transform, quantum=0.0)
    settings = settings if dtype != "float64" else replace(settings, head=None, double=True)
    coded = encode_tile(noisy(dtype=dtype), settings, Coding(cut=made("coupled")[1]))
    some = [decode_region(coded.data, SHAPE, dtype, settings, part) for part in parts(20)]
    for part, values in zip(parts(20), some, strict=True):
        assert values is None or values.tobytes() == coded.decoded[part].tobytes()
    assert sum(values is not None for values in some) > 5


def test_blocks_change_no_integer_and_no_level_of_detail() -> None:
    for name in AXES:
        settings, cut = made(name)
        blocks, plain = (encode_tile(noisy(), settings, Coding(cut=c)) for c in (cut, 0))
        assert plain.data[4] & KIND == TRANSFORMED
        for lod in range(4):
            one, other = (decode_tile(c.data, SHAPE, "f4", settings, lod) for c in (blocks, plain))
            assert one.tobytes() == other.tobytes()


def test_any_number_of_threads_makes_the_same(monkeypatch) -> None:
    settings, cut = made("coupled", trellis=True)
    found = []
    for threads in (1, 5):
        monkeypatch.setattr(transform_tile, "usable_threads", lambda threads=threads: threads)
        coded = encode_tile(noisy(), settings, Coding(weight=0.27, aim=1.0, cut=cut))
        found.append((coded.data, decode_tile(coded.data, SHAPE, "f4", settings).tobytes()))
    assert found[0] == found[1]


def test_tiles_that_serve_no_part_are_decoded_whole() -> None:
    settings, cut = made("coupled")
    part = tuple(slice(1, 2) for _ in SHAPE)
    holes = noisy()
    holes[0, 1, 2, 3] = np.nan
    whole = tuple(slice(0, n) for n in SHAPE)
    for values, coding, asked in (
        (noisy(), Coding(), part),
        (holes, Coding(cut=cut), part),
        (noisy(), Coding(cut=cut), whole),
        (noisy(), Coding(cut=cut), (part[0], *whole[1:])),
    ):
        data = encode_tile(values, settings, coding).data
        assert decode_region(data, SHAPE, "f4", settings, asked) is None


def test_large_tiles_are_cut_where_small_regions_gain() -> None:
    """The transform of a tile in which every axis has a basis has no blocks."""
    shape, random = (8, 24, 64, 64), np.random.default_rng(0)
    values = random.normal(0, 0.5, shape).clip(-2, 3).astype(np.float32)
    spec = spec_of(("haar", "haar", "9/7", "9/7"), (1, 1, 1, 1), shape)
    found = encode_tile(values, replace(SETTINGS, transform=spec, quantum=0.0)).data
    assert found[4] & KIND == BLOCKS
    bases = spec_of(("klt",) * 4, 0, shape)
    found = encode_tile(values, replace(SETTINGS, transform=bases, quantum=0.0)).data
    assert found[4] & KIND == TRANSFORMED


@pytest.mark.parametrize("fast", [False, True])
def test_blocks_that_cannot_be_are_damage(fast: bool) -> None:
    settings, cut = made("coupled")
    data = encode_tile(noisy(), settings, Coding(cut=cut, fast=fast)).data
    cuts = {b"\0\0": "not cut", b"\x22\x13": "transform has not", data[5:7]: None}
    for logs, what in cuts.items():
        changed = resealed(data[:5] + logs + data[7:])
        if what is None:
            assert changed == data
            continue
        with pytest.raises(DamagedFileError, match=what):
            decode_tile(changed, SHAPE, "f4", settings)
    for end in (5, 6, 7, 20):
        with pytest.raises(DamagedFileError, match=r"cut short|too few"):
            decode_tile(resealed(data[:end]), SHAPE, "f4", settings)
    plain = replace(settings, transform=spec_of(("none",) * 4, 0, SHAPE))
    with pytest.raises(DamagedFileError, match="more than 1024"):
        decode_tile(resealed(data[:5] + b"\x11\x11" + data[7:]), SHAPE, "f4", plain)
    with pytest.raises(InputError, match="blocks are cut where"):
        encode_tile(noisy(), made("basis")[0], Coding(cut=EVERYWHERE))
