"""Filters of HDF5 that only the benches try, and regions of a peer's file.

BitRound is that of numcodecs, followed by Blosc (zstd, shuffle).
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fhash_codec.bench.rate.layouts import Values
from fhash_codec.bench.rate.peers import BOTH, LADDER, Filter, Variant, peers
from fhash_codec.boxes import Box

SMALL_CHUNK = 32
"""Vertices along an axis of a chunk, as a user who reads regions would choose."""

Spans = list[tuple[int, int]]


def all_filters() -> dict[str, tuple[Variant, ...]]:
    """Every peer that is a filter, by name. Raises MissingDependencyError without hdf5plugin."""
    found = peers()
    plugins = importlib.import_module("hdf5plugin")
    rounding = replace(
        _lossless(plugins, "BitRound", "bits"), lossless=False, step=LADDER, prepare=_rounded
    )
    return {**found, "BitRound": (rounding,), "Blosc": (_lossless(plugins, "Blosc", "lossless"),)}


def _lossless(plugins: Any, peer: str, mode: str) -> Variant:
    """Blosc (zstd, shuffle) on single frames."""

    def setting(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Blosc(cname="zstd", clevel=5, shuffle=plugins.Blosc.SHUFFLE)  # type: ignore[no-any-return]

    return Variant(peer=peer, mode=mode, layout="frame", goals=BOTH, setting=setting, lossless=True)


def small_chunks(variants: Sequence[Variant]) -> Variant:
    """Variant of a peer for random access: small chunks of a frame.

    All chunks share one tolerance, since they differ in range and detail.
    """
    return replace(
        next(variant for variant in reversed(variants) if variant.layout == "frame"),
        chunk=SMALL_CHUNK,
    )


def _rounded(values: Values, level: float) -> Values:
    """Values with as many bits of the mantissa as a level has steps."""
    from numcodecs import BitRound

    bits = min(max(round(level / LADDER), 1), np.finfo(values.dtype).nmant)
    codec = BitRound(bits)
    return np.asarray(codec.decode(codec.encode(np.array(values))), dtype=values.dtype).reshape(
        values.shape
    )


def read_region(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> Values:
    """A region (z, y, x) of one step of a series of `shape`."""
    parts = [
        dataset[tuple(slice(*span) for span in spans)]
        for dataset, spans in _parts(file, variant, shape, step, region)
    ]
    return np.concatenate([part.reshape(-1, *part.shape[-2:]) for part in parts])


def touched_bytes(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> int:
    """Stored bytes of the chunks that a region of one step meets."""
    total = 0
    for dataset, spans in _parts(file, variant, shape, step, region):
        firsts = [
            range(low // n * n, high, n)
            for (low, high), n in zip(spans, dataset.chunks, strict=True)
        ]
        total += sum(
            int(dataset.id.get_chunk_info_by_coord(corner).size)
            for corner in itertools.product(*firsts)
        )
    return total


def _parts(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> list[tuple[Any, Spans]]:
    """The datasets that hold a region of one step, with its spans in them."""
    found = spans_of(variant.layout, shape, step, region)
    return [(file[str(number)], spans) for number, spans in found]


def spans_of(
    layout: str, shape: tuple[int, ...], step: int, region: Box
) -> list[tuple[int, Spans]]:
    """Part numbers that hold a region (z, y, x) of one step, with its spans in each."""
    steps, planes = shape[:2]
    (low, high), *plane = region
    if layout == "frame":
        return [(step, [*region])]
    if layout == "plane":
        return [(z, [(step, step + 1), *plane]) for z in range(low, high)]
    if layout == "folded":
        return [(0, [(step * planes + low, step * planes + high), *plane])]
    if layout == "turned":
        return [(0, [(z * steps + step, z * steps + step + 1), *plane]) for z in range(low, high)]
    return [(0, [(step, step + 1), *region])]
