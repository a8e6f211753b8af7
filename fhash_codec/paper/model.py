"""The paper profile's model as `Volume` reads it: the network, in data units, and its occupancy.

This module needs numpy only.
"""

from __future__ import annotations

from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.occupancy import read_occupancy
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.model_parts import CORNERS, Mlp, Table
from fhash_codec.paper.network import Network
from fhash_codec.paper.points import decode_region, sample_points
from fhash_codec.paper.storage import load_network
from fhash_formats.container import Container
from fhash_formats.errors import InputError

Positions = npt.NDArray[np.float64]


class PaperModel:
    """A `VolumeModel` (volume_model.py) of the network in a container.

    At a fractional key index the embeddings are interpolated in time, not the values.
    """

    def __init__(self, container: Container) -> None:
        header = container.header
        self._container = container
        self._range = ValueRange(*header["value_range"])
        self._box = Box.of(header["feature_bounding_box"])
        self.chunks: tuple[int, ...] = (1, *header["domain"]["shape"][1:])
        self._occupancy = lru_cache(maxsize=4)(partial(_merged, container))

    @cached_property
    def network(self) -> Network:
        """The network. Its tables are read on demand."""
        return load_network(self._container)

    @cached_property
    def tables(self) -> list[Table]:
        """The tables, finest first."""
        stored = self._container.header["model"]["tables"]
        dtype = "float16" if stored == "float16" else "float32"
        return [Table(n, table, dtype) for n, table in enumerate(self.network.tables, start=1)]

    @cached_property
    def mlp(self) -> Mlp:
        """The layers of the network."""
        weights, biases = zip(*self.network.layers, strict=True)
        return Mlp(weights=weights, biases=biases, activation="relu", stencil=CORNERS)

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset at either key frame."""
        return self._occupancy(first, last)[region.slices()]

    def occupied_by(
        self, features: tuple[int, ...], first: int, last: int, region: Box
    ) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset for some features.

        Args:
            features: their numbers, counted from 0.
            first, last: neighbouring key frames, or the same key frame twice.
            region: the region.
        """
        return self._occupancy(first, last, features)[region.slices()]

    def read(
        self, key: float, region: Box, requested: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.float64]:
        """Return the values (z, y, x) of a region.

        Vertices that are not requested are NaN and cost nothing.
        """
        return self._range.from_unit(decode_region(self.network, key, region, requested=requested))

    def read_lod(self, key: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Raise InputError: the embeddings of a coarser level alone give no values."""
        raise InputError(
            f"{self._container.path}: a file of the profile paper has no levels of detail; "
            "decode it whole"
        )

    def sample(self, keys: Positions, space: list[Positions]) -> npt.NDArray[np.float64]:
        """Return the values (n,) at points inside the box."""
        return self._range.from_unit(sample_points(self.network, keys, *space))

    def sample_with_gradient(
        self, keys: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the values (n,) and analytic derivatives (n, 4) by key index, z, y and x."""
        unit, slopes = sample_points(self.network, keys, *space, gradient=True)
        return self._range.from_unit(unit), slopes.astype(np.float64) * (
            self._range.high - self._range.low
        )


def _merged(
    container: Container, first: int, last: int, features: tuple[int, ...] | None = None
) -> npt.NDArray[np.bool_]:
    """Return which vertices (z, y, x) of the box are in the coreset at either of two key frames.

    `features` are the numbers of those whose coresets are taken, or None for all.
    """
    frames = read_occupancy(container, first, last + 1, features)
    return np.asarray(frames[0] | frames[-1])
