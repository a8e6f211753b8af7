"""What `Volume` asks of the model in a container, the same for every profile."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.model import CompactModel
from fhash_codec.coreset.boxes import Box
from fhash_codec.paper.model import PaperModel
from fhash_formats.container import Container

Positions = npt.NDArray[np.float64]


class VolumeModel(Protocol):
    """Values in data units on the feature bounding box. Regions and positions are in vertices of the box, times are key indices:
    0 to key frames - 1, fractional between key frames.
    """

    @property
    def chunks(self) -> tuple[int, ...]:
        """Vertices (t, z, y, x) that one read decodes at least."""
        ...

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Which vertices (z, y, x) of a region are in the coreset between two neighbouring key frames, or at one given twice."""
        ...

    def region(self, key: float, region: Box, wanted: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        """Values (z, y, x) of a region, of any number type; what stands where `wanted` is False is open."""
        ...

    def coarse(self, key: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Every 2^lod-th vertex (z, y, x), low-passed. region: which of them, counted in coarse vertices.

        Raises InputError where the profile has no levels of detail.
        """
        ...

    def points(self, keys: Positions, space: list[Positions]) -> npt.NDArray[np.float64]:
        """Values (n,) at points: key indices and (z, y, x), all inside."""
        ...

    def slopes(
        self, keys: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Values (n,) and derivatives (n, 4) by key index, z, y and x; on the border of two cells those of the cell after it."""
        ...


def open_model(container: Container) -> VolumeModel:
    """The model of a container; nothing is read yet."""
    return (
        CompactModel(container.arrays)
        if container.header["model"]["profile"] == "compact"
        else PaperModel(container)
    )
