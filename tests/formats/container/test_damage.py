"""Every flipped or cut byte of a container is refused: never silent, never another exception."""

from __future__ import annotations

import os
import random

import pytest

from fhash_formats.container import Container
from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


def read_everything(path):
    """Open, verify and read."""
    with Container.open(path) as container:
        container.verify()
        for array in container.arrays.values():
            array.read()


def refused(path):
    """The one-line message with which a damaged file is refused."""
    with pytest.raises(DamagedFileError) as caught:
        read_everything(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_every_flip_is_refused(sample):
    sound = sample.read_bytes()
    read_everything(sample)
    choose = random.Random(0)
    for _ in range(2000):
        at = choose.randrange(len(sound))
        damaged = bytearray(sound)
        damaged[at] ^= choose.randrange(1, 256)
        sample.write_bytes(damaged)
        refused(sample)


def test_every_flip_in_the_last_bytes_is_refused(sample):
    sound = sample.read_bytes()
    for at in range(len(sound) - 150, len(sound)):
        damaged = bytearray(sound)
        damaged[at] ^= 1
        sample.write_bytes(damaged)
        refused(sample)


def test_every_cut_is_refused(sample):
    sound = sample.read_bytes()
    choose = random.Random(1)
    for length in [0, 1, 22, len(sound) - 1, *(choose.randrange(len(sound)) for _ in range(300))]:
        sample.write_bytes(sound[:length])
        refused(sample)


def test_every_removed_or_doubled_part_is_refused(sample):
    sound = sample.read_bytes()
    choose = random.Random(2)
    for _ in range(200):
        a, b = sorted(choose.sample(range(len(sound) + 1), 2))
        sample.write_bytes(sound[:a] + sound[b:])
        refused(sample)
        sample.write_bytes(sound[:b] + sound[a:])
        refused(sample)


def test_exchanged_chunks_are_refused(sample):
    """Each has a sound CRC-32C of its own, so that only the directory tells."""
    with Container.open(sample) as container:
        first, second = list(container.arrays["tables/level_1"].chunks.values())[:2]
    sound = sample.read_bytes()
    a, b = (sound[m.offset + m.header_size : m.end] for m in (first, second))
    size = min(len(a), len(b))
    damaged = bytearray(sound)
    damaged[first.end - size : first.end] = b[-size:]
    sample.write_bytes(damaged)
    assert f"member {first.name}" in refused(sample)


def test_damaged_chunk_is_named_and_the_rest_can_be_read(sample):
    with Container.open(sample) as container:
        member = container.arrays["mlp/weight_1"].chunks[0, 0]
    damaged = bytearray(sample.read_bytes())
    damaged[member.end - 1] ^= 1
    sample.write_bytes(damaged)
    with Container.open(sample) as container:
        container.arrays["mlp/bias_1"].read()
        with pytest.raises(DamagedFileError, match="member mlp/weight_1/c/0/0"):
            container.arrays["mlp/weight_1"].read()
        with pytest.raises(DamagedFileError, match="member mlp/weight_1/c/0/0"):
            container.verify()


def test_file_cut_while_open(sample):
    with Container.open(sample) as container:
        sample.write_bytes(sample.read_bytes()[:100])
        with pytest.raises(DamagedFileError, match="cut short"):
            container.arrays["mlp/weight_1"].read()


def test_disk_error_while_reading(sample, monkeypatch):
    def fail(offset, size):
        raise OSError(5, "Input/output error")

    with Container.open(sample) as container:
        monkeypatch.setattr(container._source, "read", fail)
        with pytest.raises(DamagedFileError, match="cannot be read: Input/output error"):
            container.arrays["mlp/weight_1"].read()


def test_what_does_not_fit_in_memory_is_not_called_damaged(sample, monkeypatch):
    """Or a sound file might be thrown away."""
    with Container.open(sample) as container:
        array = container.arrays["mlp/weight_1"]
        monkeypatch.setattr(
            array, "_decode", lambda index, lod: (_ for _ in ()).throw(MemoryError())
        )
        with pytest.raises(MemoryError):
            array.read()


def test_no_file_folder_and_pipe(tmp_path):
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open(tmp_path / "none.fhz")
    os.mkfifo(tmp_path / "pipe.fhz")
    for path in (tmp_path, tmp_path / "pipe.fhz"):
        with pytest.raises(InputError, match="regular file"):
            Container.open(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x05\x06" + bytes(18),
        b"\x89HDF\r\n\x1a\n" + bytes(500),
        b"fhash 1 sha256=" + b"0" * 64,
    ],
)
def test_another_file_is_refused(tmp_path, content):
    path = tmp_path / "other.fhz"
    path.write_bytes(content)
    refused(path)


def test_closed_container(sample):
    with Container.open(sample) as container:
        pass
    with pytest.raises(InputError, match="closed"):
        container.arrays["mlp/weight_1"].read()
