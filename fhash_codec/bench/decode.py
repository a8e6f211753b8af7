"""Decoding of the coreset's vertices beside the whole box, for `fhash bench train`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.occupancy import unpack
from fhash_codec.paper.model import decode_region
from fhash_codec.paper.network import Architecture, Layer, Network

__all__ = ["bench_decode"]

TURNS = 5
"""Turns in which both ways decode."""
KEY_FRAMES = 4
"""Largest number of key frames that are decoded in a turn."""

Mask = npt.NDArray[np.bool_]


class _ZeroTable:
    """A `TableSource` of zeros: the time of decoding does not depend on the embeddings."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return zeros float32 in the shape of a region."""
        return np.zeros([axis.stop - axis.start for axis in region], np.float32)


def bench_decode(
    architecture: Architecture, coreset: Coreset, layers: Sequence[Layer]
) -> dict[str, float]:
    """Measure the decoding of key frames: of their coreset alone, and of the whole box, in turns.

    Args:
        architecture: the sizes of the model.
        coreset: the coreset, whose occupancy is decoded.
        layers: weight and bias of each layer.

    Returns:
        `decode_msamples_s`, 10^6 vertices of the coreset a second, and `decode_ratio`, how many
        times as fast as the whole box; medians over the turns.
    """
    size = architecture.embedding_size
    network = Network(
        levels=architecture.levels,
        embedding_size=size,
        tables=[_ZeroTable((*level, size)) for level in architecture.levels],
        layers=tuple(layers),
        box_size=architecture.box_size,
        key_frames=architecture.key_frames,
    )
    every = -(-architecture.key_frames // KEY_FRAMES)
    keys = range(0, architecture.key_frames, every)
    masks = [unpack(coreset.occupancy[key], coreset.box.shape) for key in keys]
    boxes = [np.ones_like(mask) for mask in masks]
    vertices = sum(int(np.count_nonzero(mask)) for mask in masks)
    speeds, ratios = [], []
    for _ in range(TURNS):
        alone, whole = (_seconds(network, keys, requested) for requested in (masks, boxes))
        speeds.append(vertices / alone)
        ratios.append(whole / alone)
    return {"decode_msamples_s": median(speeds) / 1e6, "decode_ratio": median(ratios)}


def _seconds(network: Network, keys: Sequence[int], requested: Sequence[Mask]) -> float:
    """Return the time of decoding the requested vertices of some key frames."""
    box = Box.of((0, n) for n in network.box_size)
    begun = time.perf_counter()
    for key, mask in zip(keys, requested, strict=True):
        decode_region(network, float(key), box, requested=mask)
    return time.perf_counter() - begun
