"""Random networks of many shapes, and the 16-corner formula in float64 that they are held to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise, product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.boxes import Box
from fhash_codec.paper.network import ArrayTable, Network, level_resolutions

Points = list[npt.NDArray[np.float64]]
"""Key indices, z, y and x of points, each (n,)."""

# Box (z, y, x), key frames, fold, embedding size, hidden layers.
SHAPES = [
    ((1, 1, 1), 1, 2, 1, 1),
    ((1, 1, 2), 2, 2, 2, 0),
    ((2, 2, 2), 3, 2, 4, 2),
    ((1, 7, 1), 1, 2, 3, 1),
    ((1, 40, 67), 5, 2, 2, 1),
    ((13, 17, 37), 4, 3, 2, 1),
    ((11, 33, 35), 12, 2, 1, 0),
    ((9, 23, 70), 2, 2, 3, 2),
    ((64, 32, 8), 1, 4, 2, 1),
]


class RecordingTable(ArrayTable):
    """A table that remembers the regions read, and accepts plain slices alone."""

    def __init__(self, values: npt.NDArray[Any]) -> None:
        super().__init__(values)
        self.regions: list[tuple[tuple[int, int], ...]] = []

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        assert len(region) == 5
        for axis, size in zip(region, self.shape, strict=True):
            assert axis.step is None
            assert 0 <= axis.start < axis.stop <= size
        self.regions.append(tuple((axis.start, axis.stop) for axis in region))
        return super().read(region)


class Networks:
    """Networks to test with, and what they should give."""

    @staticmethod
    def random(
        box: tuple[int, int, int],
        key_frames: int,
        fold: int,
        embedding_size: int,
        hidden_layers: int,
        *,
        width: int = 16,
        dtype: npt.DTypeLike = np.float32,
    ) -> Network:
        """A network of normally distributed numbers."""
        rng = np.random.default_rng(0)
        levels = level_resolutions(box, key_frames, fold)
        widths = [len(levels) * embedding_size, *[width] * hidden_layers, 1]
        layers = [
            (
                (rng.standard_normal((n, m)) / np.sqrt(m)).astype(np.float32),
                rng.standard_normal(n).astype(np.float32),
            )
            for m, n in pairwise(widths)
        ]
        tables = [
            ArrayTable(rng.standard_normal((*level, embedding_size)).astype(dtype))
            for level in levels
        ]
        return Network(
            levels=levels,
            embedding_size=embedding_size,
            tables=tables,
            layers=tuple(layers),
            box_size=box,
            key_frames=key_frames,
        )

    @staticmethod
    def recording(network: Network) -> Network:
        """The same network with tables that remember what is read."""
        return replace(network, tables=[RecordingTable(table.values) for table in network.tables])  # type: ignore[attr-defined]

    @staticmethod
    def reference(network: Network, points: Sequence[Any]) -> npt.NDArray[np.float64]:
        """Values (n,) at points in float64: 16 corners per level, no shortcuts."""
        sizes = (network.key_frames, *network.box_size)
        inputs = []
        for level, table in zip(network.levels, network.tables, strict=True):
            position = [
                p * (r - 1) / max(s - 1, 1) for p, r, s in zip(points, level, sizes, strict=True)
            ]
            before = [
                np.minimum(np.floor(p), max(r - 2, 0)).astype(int)
                for p, r in zip(position, level, strict=True)
            ]
            embeddings = np.zeros((network.embedding_size, len(points[0])))
            for corner in product((0, 1), repeat=4):
                index = tuple(
                    np.minimum(b + c, r - 1) for b, c, r in zip(before, corner, level, strict=True)
                )
                weight = prod(
                    np.abs(p - b - 1 + c) for p, b, c in zip(position, before, corner, strict=True)
                )
                embeddings += weight * table.values[index].astype(np.float64).T  # type: ignore[attr-defined]
            inputs.append(embeddings)
        hidden = np.concatenate(inputs)
        for number, (weight, bias) in enumerate(network.layers):
            hidden = np.maximum(hidden, 0) if number else hidden
            hidden = weight.astype(np.float64) @ hidden + bias[:, None]
        return hidden[0]

    @staticmethod
    def vertices(network: Network, key_index: float) -> Points:
        """Every vertex of the box at a key index, as points."""
        grid = np.meshgrid(*(np.arange(n, dtype=float) for n in network.box_size), indexing="ij")
        return [np.full(grid[0].size, key_index), *(axis.ravel() for axis in grid)]

    @staticmethod
    def points(network: Network, count: int, seed: int = 1) -> Points:
        """Random points of the box."""
        rng = np.random.default_rng(seed)
        return [rng.random(count) * (size - 1) for size in (network.key_frames, *network.box_size)]

    @staticmethod
    def key_indices(network: Network) -> list[float]:
        """Key indices at both ends and between."""
        last = network.key_frames - 1
        return sorted({0.0, float(last), last / 2, last * 0.37})

    @staticmethod
    def box(network: Network) -> Box:
        """The region of the whole box."""
        z, y, x = ((0, size) for size in network.box_size)
        return z, y, x


@pytest.fixture(scope="session")
def networks() -> type[Networks]:
    return Networks


@pytest.fixture(params=SHAPES, ids=str)
def network(request: pytest.FixtureRequest) -> Network:
    """A random network of each shape."""
    make: Callable[..., Network] = Networks.random
    return make(*request.param)
