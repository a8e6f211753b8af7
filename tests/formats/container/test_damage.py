"""Every flipped or cut byte of a container is refused: never silent, never another exception."""

from __future__ import annotations

import random
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
from hostile_files import read_everything

from fhash_formats.container import Container
from fhash_formats.errors import DamagedFileError


def refusal(path):
    """The one-line message with which a damaged file is refusal."""
    with pytest.raises(DamagedFileError) as caught:
        read_everything(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_every_flip_is_refused(sample) -> None:
    sound = sample.read_bytes()
    contents, refused = read_everything(sample), 0
    with ZipFile(sample) as members:
        spans = [
            (info.header_offset + 30 + len(info.filename), info.compress_size, info.compress_type)
            for info in members.infolist()
        ]
    deflated = [(first, first + size) for first, size, method in spans if method == ZIP_DEFLATED]
    choose = random.Random(0)
    for _ in range(2000):
        at = choose.randrange(len(sound))
        damaged = bytearray(sound)
        damaged[at] ^= choose.randrange(1, 256)
        sample.write_bytes(damaged)
        if not any(first <= at < end for first, end in deflated):
            refusal(sample)
            continue
        # Other bits may inflate to the same metadata, which is all that their CRC-32 is about.
        try:
            read = read_everything(sample)
        except DamagedFileError:
            refused += 1
        else:
            assert read == contents
    assert refused > 0


def test_every_flip_in_the_last_bytes_is_refused(sample) -> None:
    sound = sample.read_bytes()
    for at in range(len(sound) - 150, len(sound)):
        damaged = bytearray(sound)
        damaged[at] ^= 1
        sample.write_bytes(damaged)
        refusal(sample)


def test_every_cut_is_refused(sample) -> None:
    sound = sample.read_bytes()
    choose = random.Random(1)
    for length in [0, 1, 22, len(sound) - 1, *(choose.randrange(len(sound)) for _ in range(300))]:
        sample.write_bytes(sound[:length])
        refusal(sample)


def test_every_removed_or_doubled_part_is_refused(sample) -> None:
    sound = sample.read_bytes()
    choose = random.Random(2)
    for _ in range(200):
        a, b = sorted(choose.sample(range(len(sound) + 1), 2))
        sample.write_bytes(sound[:a] + sound[b:])
        refusal(sample)
        sample.write_bytes(sound[:b] + sound[a:])
        refusal(sample)


def test_exchanged_chunks_are_refused(sample) -> None:
    """Each has a sound CRC-32C of its own, so that only the directory tells."""
    with Container.open(sample) as container:
        first, second = list(container.arrays["tables/level_1"].chunks.values())[:2]
    sound = sample.read_bytes()
    a, b = (sound[m.offset + m.header_size : m.end] for m in (first, second))
    size = min(len(a), len(b))
    damaged = bytearray(sound)
    damaged[first.end - size : first.end] = b[-size:]
    sample.write_bytes(damaged)
    assert f"member {first.name}" in refusal(sample)
