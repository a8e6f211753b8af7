"""Stored bytes: plain, compressed, text and many files, read forwards, backwards and past their
end."""

from __future__ import annotations

import bz2
import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common import stored_bytes
from fhash_formats.readers.common.stored_bytes import (
    CompressedFile,
    ManyFiles,
    NumbersInText,
    PlainFile,
    StoredArray,
    StoredBytes,
    numbers_of_words,
)

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


def test_many_files_follow_each_other(tmp_path: Path) -> None:
    parts = []
    for number in range(4):
        (tmp_path / str(number)).write_bytes(DATA[number * 60 : number * 60 + 60])
        parts.append(PlainFile(tmp_path / str(number), start=0, size=60))
    array = StoredArray(tmp_path / "0", (4, 3, 5), np.dtype("<f4"), ManyFiles(parts))
    expected = np.frombuffer(DATA[:240], "<f4").reshape(4, 3, 5)
    whole = (slice(0, 4), slice(0, 3), slice(0, 5))
    np.testing.assert_array_equal(array.read(whole), expected)
    for place, length in enumerate(array.shape):
        ranges = tuple(slice(1, length - 1) if i == place else each for i, each in enumerate(whole))
        np.testing.assert_array_equal(array.read(ranges), expected[ranges])
    assert part(ManyFiles(parts), 50, 130) == DATA[50:180]
