"""The model behind a `Volume`: one interface, the same for every profile."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.model import CompactModel
from fhash_codec.coreset.boxes import Box
from fhash_codec.model_parts import Mlp, Table
from fhash_codec.paper.model import PaperModel
from fhash_formats.container import Container

Positions = npt.NDArray[np.float64]
"""Positions (n,) of points along one axis."""
Decoded = tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]
"""Values of a part of the box, and the mask of those in the coreset."""


class VolumeModel(Protocol):
    """Values of a series, in data units, inside the feature bounding box.

    Regions and positions count vertices of the feature bounding box. Times are key indices:
    0 to key frames - 1, fractional between key frames.
    """

    @property
    def chunks(self) -> tuple[int, ...]:
        """Vertices (t, z, y, x) that are decoded together: a read decodes at least so many."""
        ...

    @property
    def tables(self) -> list[Table]:
        """Tables of the levels, finest first."""
        ...

    @property
    def mlp(self) -> Mlp:
        """Layers behind the tables."""
        ...

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of a region: the vertices in the coreset between two key frames.

        first, last: neighbouring key frames, or the same key frame twice.
        """
        ...

    def read(self, key: float, region: Box, requested: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        """Values (z, y, x) of a region, of any number type.

        requested: mask (z, y, x) of the region; where it is False, the values are undefined.
        """
        ...

    def read_lod(self, key: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Low-passed values (z, y, x) at every 2^lod-th vertex of the box, within a region.

        region: in coarse vertices, so that vertex 1 of it is vertex 2^lod of the box.
        Raises InputError if the profile has no levels of detail.
        """
        ...

    def sample(self, keys: Positions, space: list[Positions]) -> npt.NDArray[np.float64]:
        """Values (n,) at points.

        keys: key indices of the points. space: their positions z, y and x. All lie in the box.
        """
        ...

    def sample_with_gradient(
        self, keys: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Values (n,) at points, and derivatives (n, 4) by key index, z, y and x.

        On the border of two cells, the derivatives are those of the cell after the border.
        """
        ...


def open_model(container: Container) -> VolumeModel:
    """The model of a container; nothing is read yet."""
    if container.header["model"]["profile"] == "compact":
        return CompactModel(container)
    return PaperModel(container)
