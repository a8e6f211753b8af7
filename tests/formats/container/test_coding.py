"""Chunks to bytes and back; hostile chunks."""

from __future__ import annotations

import struct

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import frame, refused, replaced

from fhash_formats import native
from fhash_formats.container import Container
from fhash_formats.container.coding import (
    PlainCoder,
    chunk_coder,
    crc32c,
    plain_codecs,
    with_crc32c,
    zstd_content_size,
)
from fhash_formats.errors import DamagedFileError, UnsupportedFileError


@pytest.mark.parametrize("size", [0, 1, 255, 256, 257, 65535, 65536, 65791, 65792, 2**20])
def test_content_size_of_what_zstd_writes(size) -> None:
    assert zstd_content_size(memoryview(numcodecs.zstd.compress(bytes(size), 3))) == size


def test_crc32c_of_the_check_string() -> None:
    """RFC 3720, appendix B.4, and the usual check value."""
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(memoryview(bytes(32))) == 0x8A9136AA


@pytest.mark.parametrize("plain", [False, True])
def test_crc32c_of_known_answers(plain: bool) -> None:
    """RFC 3720, appendix B.4; by tables and by the instruction of the processor."""
    scsi = bytes.fromhex(
        "01c00000000000000000000000000000140000000000040000000014000000182800000000000000"
        "0200000000000000"
    )
    answers = {
        b"": 0x00000000,
        b"123456789": 0xE3069283,
        bytes(32): 0x8A9136AA,
        b"\xff" * 32: 0x62A8AB43,
        bytes(range(32)): 0x46DD794E,
        bytes(range(31, -1, -1)): 0x113FDB5C,
        scsi: 0xD9963A56,
    }
    crc = native.library().fhash_crc32c
    for data, answer in answers.items():
        assert crc(data, len(data), 0, plain) == answer
        half = len(data) // 2
        assert crc(data[half:], len(data) - half, crc(data, half, 0, plain), plain) == answer


@pytest.mark.parametrize("size", [7, 255, 767, 768, 769, 12287, 12288, 12289, 100_003])
def test_crc32c_is_that_of_the_definition(size: int) -> None:
    """Long data go in three parts side by side; tables are those of single bits."""
    data = np.random.default_rng(size).bytes(size)
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    rest = 0xFFFFFFFF
    for byte in data:
        rest = rest >> 8 ^ table[(rest ^ byte) & 255]
    crc = native.library().fhash_crc32c
    assert crc(data, size, 0, 0) == crc(data, size, 0, 1) == rest ^ 0xFFFFFFFF
    assert crc32c(memoryview(data)) == crc32c(data) == rest ^ 0xFFFFFFFF


@pytest.mark.parametrize("dtype", ["int8", "uint16", "float16", "float64"])
def test_decoding_gives_what_was_coded(dtype) -> None:
    chunk = np.arange(24).reshape(2, 3, 4).astype(dtype)
    coder = chunk_coder(plain_codecs(chunk.dtype), chunk.dtype, chunk.shape)
    for given in (chunk, np.asfortranarray(chunk), chunk.astype(chunk.dtype.newbyteorder())):
        decoded = coder.decode(memoryview(coder.encode(given)))
        np.testing.assert_array_equal(decoded, chunk)
        assert decoded.dtype == chunk.dtype
        assert decoded.dtype.isnative


def test_a_lack_of_memory_is_no_damage(monkeypatch) -> None:
    chunk = np.arange(24, dtype=np.float32)
    coder = chunk_coder(plain_codecs(chunk.dtype), chunk.dtype, chunk.shape)
    data = memoryview(coder.encode(chunk))

    def fail(*_):
        raise RuntimeError("Zstd decompression error: b'Allocation error : not enough memory'")

    monkeypatch.setattr(numcodecs.zstd, "decompress", fail)
    with pytest.raises(MemoryError):
        coder.decode(data)


def test_unknown_codecs_are_refused(sample, samples) -> None:
    codecs = [{"name": "test.negative"}, {"name": "crc32c"}]
    with pytest.raises(UnsupportedFileError, match=r"codecs 'test[.]negative, crc32c'"):
        chunk_coder(codecs, np.dtype(np.uint8), (4,))


def test_a_tile_that_would_take_gigabytes_is_refused() -> None:
    codecs = [{"name": "fhash.transform", "configuration": {}}]
    with pytest.raises(
        DamagedFileError, match=r"tiles of 134,217,729 vertices; the limit is 134,217,728"
    ):
        chunk_coder(codecs, np.dtype(np.uint8), (1, 1, 1, (1 << 27) + 1))


CHUNKS = {
    "bomb": (
        lambda right: numcodecs.zstd.compress(bytes(1 << 26), 1),
        "zstd declares 67108864 bytes; the chunk has 32",
    ),
    "bomb of unknown size": (lambda right: frame(bytes(1 << 16)), "zstd declares None"),
    "bomb that lies": (lambda right: frame(bytes(1 << 16), size=32), "zstd data are damaged"),
    "two frames": (lambda right: numcodecs.zstd.compress(right, 1) * 2, "zstd data are damaged"),
    "fewer bytes": (lambda right: frame(right[:16], size=32), "zstd data are damaged"),
    "declares 2^63": (lambda right: frame(right, size=2**63), "zstd declares"),
    "other content": (lambda right: right, "not a zstd frame"),
    "empty": (lambda right: b"", "not a zstd frame"),
    "header only": (
        lambda right: frame(right, size=32)[:8],
        "the header of the zstd frame is cut short",
    ),
}


@pytest.mark.parametrize("case", CHUNKS)
def test_chunk_data(sample, samples, case) -> None:
    make, message = CHUNKS[case]
    coded = make(np.arange(4, dtype="<f8").tobytes())
    coded += struct.pack("<I", crc32c(coded))
    data = replaced(sample, samples, "time/c/0", coded)
    refused(sample, data, f"member time/c/0: {message}")


def test_a_frame_cannot_declare_more_than_zstd_packs_into_its_bytes() -> None:
    """Otherwise damage could pass for a lack of memory, or a lack of memory for damage."""
    float64 = np.dtype("<f8")
    most = PlainCoder(plain_codecs(float64), float64, (2**17,))
    data = with_crc32c(numcodecs.zstd.compress(bytes(2**20), 19))
    assert not most.decode(memoryview(data)).any()
    with pytest.raises(DamagedFileError, match="which 17 bytes cannot hold"):
        PlainCoder(plain_codecs(float64), float64, (2**40,)).decode(
            memoryview(with_crc32c(frame(b"abc"[:1], size=2**43)))
        )


@pytest.mark.parametrize(
    "coded", [b"", b"abc", b"abcd", numcodecs.zstd.compress(bytes(32), 1) + b"abcd"]
)
def test_chunk_without_its_crc(sample, samples, coded) -> None:
    data = replaced(sample, samples, "time/c/0", coded)
    refused(sample, data, "member time/c/0: .*CRC-32C")


def test_frame_made_by_hand_is_read(sample, samples) -> None:
    """The hostile frames above differ from this one only in what they are refused for."""
    right = np.arange(4, dtype="<f8")
    coded = frame(right.tobytes(), size=32)
    coded += struct.pack("<I", crc32c(coded))
    sample.write_bytes(replaced(sample, samples, "time/c/0", coded))
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.arrays["coords/time"].read(), right)
