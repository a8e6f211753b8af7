"""Every flipped or cut byte of a container is refused: never silent, never another exception.

The exception is a deflated document that inflates to the same text all the same.
"""

from __future__ import annotations

import random
import zlib
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


def deflated_spans(path) -> list[tuple[int, int]]:
    """Offsets (first, end) of the data of deflated members."""
    with ZipFile(path) as members:
        spans = [
            (info.header_offset + 30 + len(info.filename), info.compress_size)
            for info in members.infolist()
            if info.compress_type == ZIP_DEFLATED
        ]
    return [(first, first + size) for first, size in spans]


def inflated(data: bytes) -> bytes | None:
    """The text of a deflated document; None unless the data are one stream that ends with them."""
    stream = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        text = stream.decompress(data)
    except zlib.error:
        return None
    return text if stream.eof and not stream.unused_data else None


def test_every_flip_is_refused_unless_a_document_inflates_to_the_same_text(sample) -> None:
    sound = sample.read_bytes()
    contents, spans = read_everything(sample), deflated_spans(sample)
    choose = random.Random(0)
    # The last bytes of a stream are those with unused bits.
    last = [(end - 1, 1 << bit) for _, end in spans for bit in range(8)]
    flips = [(choose.randrange(len(sound)), choose.randrange(1, 256)) for _ in range(2000)]
    same = 0
    for at, bits in [*flips, *last]:
        damaged = bytearray(sound)
        damaged[at] ^= bits
        sample.write_bytes(damaged)
        span = next(((first, end) for first, end in spans if first <= at < end), None)
        if span is None or inflated(damaged[slice(*span)]) != inflated(sound[slice(*span)]):
            refusal(sample)
            continue
        same += 1
        assert read_everything(sample) == contents
    assert same > 0


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
