"""Arrays without chunks: only the frame's bytes are read, and a file that changes is refused."""

from __future__ import annotations

import bz2
import gzip
import os
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stored_series import VALUES

from fhash_formats.errors import InputError
from fhash_formats.readers.common import stored_bytes
from fhash_formats.readers.common import stored_bytes as flat
from fhash_formats.readers.common.stored_bytes import (
    CompressedFile,
    FlatArray,
    NumbersInText,
    PlainFile,
    StoredBytes,
    axis_steps,
    component_by_number,
    component_names,
    component_variables,
    lattice,
    numbers_of_words,
)
from fhash_formats.readers.common.variables import Variable
from fhash_formats.readers.registry import open_series


@given(
    shape=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    place=st.integers(0, 3),
    part=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    block=st.sampled_from([1, 64, 10**6]),
    run=st.sampled_from([1, 10**6]),
)
@settings(max_examples=60)
def test_a_part_of_a_flat_array_is_that_part(
    tmp_path_factory: pytest.TempPathFactory,
    shape: list[int],
    place: int,
    part: tuple[int, int],
    block: int,
    run: int,
) -> None:
    place = place % len(shape)
    start, stop = sorted(min(edge, shape[place]) for edge in part)
    values = np.arange(np.prod(shape), dtype=">i4").reshape(shape)
    path = tmp_path_factory.mktemp("flat") / "a"
    path.write_bytes(b"head" + values.tobytes())
    ranges = tuple(
        slice(start, stop) if at == place else slice(0, length) for at, length in enumerate(shape)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flat, "BLOCK_BYTES", block)
        patch.setattr(flat, "SHORTEST_RUN", run)
        np.testing.assert_array_equal(
            FlatArray(path, tuple(shape), values.dtype, offset=4).read(ranges), values[ranges]
        )


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_variable_cannot_be_named(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    (tmp_path / "a_6x5x3x4_f4.raw").write_bytes(VALUES.tobytes())
    with pytest.raises(InputError, match="--var v cannot be used"):
        open_series(tmp_path / ("a.npy" if kind == "npy" else "a_6x5x3x4_f4.raw"), var="v")


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_file_that_changes_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a_6x5x3x4_f4.{kind}"
    for change in (
        lambda: os.truncate(path, 500),
        path.unlink,
        lambda: os.truncate(path, 5000),
        lambda: os.utime(path, ns=(1, 1)),
    ):
        if kind == "npy":
            np.save(path, VALUES)
        else:
            path.write_bytes(VALUES.tobytes())
        with open_series(path) as series:
            np.testing.assert_array_equal(series.read(0), VALUES[0])
            change()
            with pytest.raises(InputError, match=r"changed while it was being read|cannot be read"):
                series.read(1)


def test_a_file_cut_during_a_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(VALUES.tobytes()[:-1])
    with pytest.raises(InputError, match="ends after 1439 bytes, 1440 are needed"):
        FlatArray(path, VALUES.shape, VALUES.dtype).read(
            (slice(3, 4), slice(0, 3), slice(0, 5), slice(0, 6))
        )


@pytest.mark.parametrize("order", ["t,z,y,x", "z,t,y,x"])
def test_one_frame_is_read_at_a_time(
    tmp_path: Path, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_formats.readers.common.file_series.SLAB_BYTES", 1)
    values = np.zeros((40, 40, 64, 64), np.float32)
    np.save(tmp_path / "a.npy", values)
    count = 0
    original = FlatArray._read

    def counted(self: FlatArray, file: Any, into: np.ndarray, start: int) -> None:
        nonlocal count
        count += into.nbytes
        original(self, file, into, start)

    monkeypatch.setattr(FlatArray, "_read", counted)
    with open_series(tmp_path / "a.npy", axes=order) as series:
        series.read(0)
        count = 0
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count == 2 * values[0].nbytes
    assert peak < 3 * values[0].nbytes


FLOAT = np.dtype("f4")


def test_positions_are_origin_and_multiples_of_the_spacing() -> None:
    assert lattice("x", 0.1, 0.1, 4).values.tolist() == [0.1 + i * 0.1 for i in range(4)]
    assert lattice("t", 1, -2, 3, first=0.5).values.tolist() == [0, -2, -4]
    assert (lattice("t", 0, 1, 1).name, lattice("y", 5, 0, 1).values.tolist()) == ("time", [5])


@pytest.mark.parametrize(
    ("origin", "spacing"), [(0, 0), (np.nan, 1), (0, np.inf), (-np.inf, 1), (0, np.nan)]
)
def test_positions_must_be_finite_and_apart(origin: float, spacing: float) -> None:
    with pytest.raises(InputError, match="both must be finite, and the spacing not 0"):
        lattice("x", origin, spacing, 2)


def test_directions_along_the_axes() -> None:
    assert axis_steps(np.diag([1.0, -2.0, 3.0])).tolist() == [1, -2, 3]
    nearly = np.eye(3)
    nearly[0, 1] = 0.9e-9
    assert axis_steps(nearly).tolist() == [1, 1, 1]
    for matrix in (np.eye(3)[[1, 0, 2]], np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="turned against the axes"):
            axis_steps(matrix)
    nearly[0, 1] = 1.1e-9
    with pytest.raises(InputError, match="turned against the axes"):
        axis_steps(nearly)


def test_names_of_components() -> None:
    assert component_names(3) == ["x", "y", "z"]
    assert component_names(2) == ["0", "1"]
    assert component_names(2, ["u", "v"]) == ["u", "v"]
    assert component_names(2, ["u", None]) == ["0", "1"]
    assert component_names(2, ["u", "u"]) == ["0", "1"]


def test_components_are_found_by_number() -> None:
    arrays = [
        Variable(name=name, shape=(2, 3, 4), dtype=FLOAT, handle=handle)
        for name, handle in (("u", "a"), ("v", "b"), ("CellData/w", "c"))
    ]
    found = [
        *component_variables(arrays[0], 1),
        *component_variables(arrays[1], 3),
        *component_variables(arrays[2], 2),
    ]
    assert [each.name for each in found[:4]] == ["u", "v.x", "v.y", "v.z"]
    assert found[2].handle == ("b", 1)
    assert component_by_number("v.1", found) == "v.y"
    assert component_by_number("v.y", found) == "v.y"
    assert component_by_number("w.1", found) == "w.1"
    assert component_by_number("v.3", found) == "v.3"
    assert component_by_number("u.0", found) == "u.0"
    assert component_by_number(None, found) is None


DATA = np.random.default_rng(0).integers(0, 9, 50_000).astype("u1").tobytes()
PACKED = {
    "zlib": ("deflate", zlib.compress(DATA)),
    "gzip": ("deflate", gzip.compress(DATA)),
    "members": ("deflate", gzip.compress(DATA[:30_000]) + gzip.compress(DATA[30_000:])),
    "rest": ("deflate", gzip.compress(DATA) + b"other bytes"),
    "bzip2": ("bzip2", bz2.compress(DATA)),
}


def part(stored: StoredBytes, place: int, count: int) -> bytes:
    into = bytearray(count)
    stored.readinto(place, memoryview(into))
    return bytes(into)


def compressed(folder: Path, data: bytes, kind: str, size: int = len(DATA)) -> CompressedFile:
    (folder / "a").write_bytes(b"head" + data)
    return CompressedFile(folder / "a", kind, start=4, size=size)


@pytest.mark.parametrize("chunk", [100, 2**18])
@pytest.mark.parametrize("name", PACKED)
def test_compressed_bytes(
    tmp_path: Path, name: str, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_bytes, "STORED_BYTES", chunk)
    kind, data = PACKED[name]
    file = compressed(tmp_path, data, kind)
    for place, count in ((0, 10), (10, 5000), (40_000, 10_000), (5, 3), (0, len(DATA))):
        assert part(file, place, count) == DATA[place : place + count]
    file.close()
    assert part(file, 7, 7) == DATA[7:14]
    file.close()


@pytest.mark.parametrize("name", ["zlib", "gzip", "members", "bzip2"])
def test_compressed_bytes_that_are_cut_or_changed(tmp_path: Path, name: str) -> None:
    kind, data = PACKED[name]
    for length in (0, 2, len(data) // 2, len(data) - 1):
        with pytest.raises(InputError):
            part(compressed(tmp_path, data[:length], kind), 0, len(DATA))
    changed = data[:-100] + bytes([data[-100] ^ 4]) + data[-99:]
    with pytest.raises(InputError):
        part(compressed(tmp_path, changed, kind), 0, len(DATA))


def test_more_and_fewer_bytes_than_promised(tmp_path: Path) -> None:
    kind, data = PACKED["gzip"]
    with pytest.raises(InputError, match="holds more than the 49999 bytes"):
        part(compressed(tmp_path, data, kind, len(DATA) - 1), 0, len(DATA) - 1)
    with pytest.raises(InputError, match="ends after 50000 decompressed bytes, 50001 are needed"):
        part(compressed(tmp_path, data, kind, len(DATA) + 1), 0, len(DATA) + 1)


def test_sizes_beyond_what_deflate_can_hold(tmp_path: Path) -> None:
    compressed(tmp_path, bytes(100), "deflate", 103_200)
    with pytest.raises(InputError, match="promises 103201 bytes"):
        compressed(tmp_path, bytes(100), "deflate", 103_201)


def test_plain_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"head" + DATA)
    file = PlainFile(tmp_path / "a", start=4, size=len(DATA))
    assert part(file, 17, 100) == DATA[17:117]
    with pytest.raises(InputError, match="its header promises 50005"):
        PlainFile(tmp_path / "a", start=5, size=len(DATA))
    (tmp_path / "a").write_bytes(DATA[:50])
    with pytest.raises(InputError, match="ends after 50 bytes"):
        part(file, 0, 100)


def test_numbers_in_text(tmp_path: Path) -> None:
    values = np.array([1.5, -2, np.inf, 0.1], dtype="f4")
    (tmp_path / "a").write_text("head 1.5,-2\ninf 0.1\n")
    file = NumbersInText(tmp_path / "a", values.dtype, start=4, size=16)
    assert part(file, 4, 8) == values[1:3].tobytes()
    file.close()
    assert part(file, 0, 16) == values.tobytes()
    with pytest.raises(InputError, match="holds 4 numbers, 5 are needed"):
        part(NumbersInText(tmp_path / "a", values.dtype, start=4, size=20), 0, 4)
    with pytest.raises(InputError, match="too short for 100 numbers"):
        NumbersInText(tmp_path / "a", values.dtype, start=4, size=400)


@pytest.mark.parametrize(
    ("words", "dtype", "message"),
    [
        ([b"256"], "u1", "beyond the type uint8"),
        ([b"-1"], "u8", "beyond the type uint64"),
        ([b"1.5"], "i4", "invalid literal"),
        ([b"x"], "f4", "convert"),
        ([b"1" * 65], "f8", "text stands where numbers are needed"),
    ],
)
def test_words_that_are_no_numbers(words: list[bytes], dtype: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        numbers_of_words(words, np.dtype(dtype))
    assert numbers_of_words([b"18446744073709551615"], np.dtype("u8"))[0] == 2**64 - 1
    assert numbers_of_words([b"1" * 64], np.dtype("f8"))[0] == float("1" * 64)
