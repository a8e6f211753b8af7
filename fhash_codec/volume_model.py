"""Model behind a volume, the same for every preset: its card, and values between vertices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from math import floor, prod
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box, Mlp, Spans, Table
from fhash_codec.compact.model import CompactModel, equal_places
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.occupancy import BLOCK, pack, packed_bytes
from fhash_codec.header import metadata_of
from fhash_formats.container import Container
from fhash_formats.container.header import BITS_ARRAY, CORESET_ARRAY, LAYERS, TABLE
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Coordinate, SourceMetadata
from fhash_formats.support.values import Mask

if TYPE_CHECKING:
    from fhash_codec.file_info import CardLayer, CardOccupancy, ModelCard, Stored
    from fhash_codec.paper.model import PaperModel

Positions = npt.NDArray[np.float64]
"""Positions (n,) of points along one axis."""
Decoded = tuple[npt.NDArray[Any], Mask]
"""Values of a part of the box, and the mask of those in the coreset."""


VolumeModel: TypeAlias = "CompactModel | PaperModel"
"""Values of a series, in data units, inside the feature bounding box.

Regions and positions count vertices of that box. Times are key indices: 0 to key frames - 1,
fractional between key frames.

- chunks, tables, mlp: vertices (t, z, y, x) that are decoded together, and what `Card` shows.
- occupied(first, last, region): mask (z, y, x) of the coreset between two neighbouring key frames.
- read(key, region, requested): values (z, y, x), undefined where the mask `requested` is False.
- read_lod(key, lod, region): low-passed values at every 2^lod-th vertex, in coarse vertices.
- sample(keys, space): values (n,) at points of the box; space holds their positions z, y and x.
- sample_with_gradient(keys, space): these, and derivatives (n, 4) by key index, z, y and x; on the
  border of two cells those of the cell after the border.
"""


def open_model(container: Container) -> VolumeModel:
    """The model of a container; nothing is read yet."""
    if container.header["model"]["profile"] == "compact":
        return CompactModel(container)
    from fhash_codec.paper.model import PaperModel

    return PaperModel(container)


class Card:
    """The parts of the model of a volume. Tables and occupancy are decoded as they are read."""

    container: Container
    profile: str
    shape: tuple[int, int, int, int]
    box: Box
    _model: VolumeModel

    if TYPE_CHECKING:

        @property
        def coords(self) -> Mapping[str, Coordinate]: ...

        @property
        def key_times(self) -> KeyTimes: ...

        def occupancy(self, t: float, region: Spans | None = None) -> Mask: ...

        def sample(
            self, *, z: Any, y: Any, x: Any, t: Any = None, time: Any = None, gradient: bool = False
        ) -> Any: ...

        def _key_index(self, t: float) -> float: ...

    @property
    def size(self) -> int:
        """Number of vertices over all steps."""
        return prod(self.shape)

    @cached_property
    def metadata(self) -> SourceMetadata | None:
        """All that belongs to the variable in its source, with a line of history for the encoding.

        None where the file says nothing of it: arrays, formats without such things.
        """
        return metadata_of(self.container, self.coords)

    @property
    def config(self) -> dict[str, Any]:
        """Every setting that the file was made with, by the names of `EncodeConfig`."""
        return dict(self.container.header["config"])

    @property
    def tables(self) -> list[Table]:
        """Tables (t, z, y, x, E) of the levels, finest first, decoded as they are read.

        t counts key frames; z, y, x count vertices of the level in the feature bounding box. A
        table of the published network holds E embeddings at each vertex. In other files E is 1:
        level 1 holds the values before the head corrects them, and level l the low-passed lattice
        of every 2^(l-1)-th vertex along z, y and x.
        """
        return self._model.tables

    @property
    def mlp(self) -> Mlp:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, float32.

        The first layer sees the L E interpolated embeddings of a point in the published network;
        in other files 28 functions of a vertex and its neighbours in the table of level 1. There
        are no layers where such a file has no head.
        """
        return self._model.mlp

    def describe(self) -> ModelCard:
        """The place of each part of the model in the file, as JSON values.

        `path` is empty, and `bytes` 0, for what takes none of its own: a coarser level that is
        decoded from the tiles of level 1, and an occupancy that is the whole box.
        """
        settings = len(self.config)
        return {
            "config": {
                "path": "zarr.json",
                "coding": "JSON, deflated",
                "bytes": self.container.header_bytes,
                "settings": settings,
            },
            "tables": [
                {
                    "level": table.level,
                    "shape": list(table.shape),
                    "dtype": table.dtype.name,
                    **self._stored(f"table_{table.level}", "low-passed level 1"),
                }
                for table in self.tables
            ],
            "mlp": self._describe_mlp(),
            "occupancy": self._describe_occupancy(),
        }

    def _describe_mlp(self) -> list[CardLayer]:
        """The layers: in arrays of their own, all in one, or in the header."""
        count, together = len(self.mlp.weights), LAYERS in self.container.arrays
        return [
            {
                "layer": number,
                "shape": list(weights.shape),
                "activation": self.mlp.activation if number < count else "linear",
                **self._stored(
                    LAYERS if together else f"mlp/weight_{number}",
                    "whole numbers in the header",
                ),
            }
            for number, weights in enumerate(self.mlp.weights, start=1)
        ]

    def _describe_occupancy(self) -> CardOccupancy:
        """The bits of all key frames, or what stands in their place."""
        shape = [self.tables[0].shape[0], packed_bytes(self.box.shape)]
        arrays = self.container.arrays
        names = [str(name) for name in self.container.header["features"]]
        apart = names if self.profile == "paper" and len(names) > 1 else []
        if BITS_ARRAY in arrays:
            stored = self._stored(BITS_ARRAY, "")
            block = arrays[BITS_ARRAY].attributes.get(BLOCK, 1)
            if CORESET_ARRAY in arrays or block > 1:
                stored["coding"] = f"blocks of {block} vertices; {self._in_tiles}"
            return {"shape": list(arrays[BITS_ARRAY].shape[1:]), **stored, "apart": apart}
        masked = TABLE in arrays and arrays[TABLE].masked
        coding = self._in_tiles if masked else "every vertex of the box"
        return {"shape": shape, "path": "", "coding": coding, "bytes": 0, "apart": []}

    @property
    def _in_tiles(self) -> str:
        path = CORESET_ARRAY if CORESET_ARRAY in self.container.arrays else self._table_path
        return f"of every vertex in the tiles of {path}"

    @property
    def _table_path(self) -> str:
        """The path of the table in the file."""
        arrays = self.container.arrays
        return arrays[TABLE].name if TABLE in arrays else TABLE

    def _stored(self, name: str, otherwise: str) -> Stored:
        """The place of an array, or of the arrays below that name."""
        stored = self.container.arrays
        found = [key for key in stored if key == name or key.startswith(f"{name}/")]
        arrays = [stored[key] for key in found]
        beside = name.replace("weight_", "bias_")
        bias = stored.get(beside) if beside != name else None
        if not arrays:
            return {"path": "", "coding": otherwise, "bytes": 0}
        first, size = arrays[0], sum(array.nbytes_stored for array in arrays)
        return {
            "path": first.name[: len(first.name) - len(found[0]) + len(name)],
            "coding": first.coding,
            "bytes": size + (0 if bias is None else bias.nbytes_stored),
        }

    def occupancy_bits(self, t: float) -> npt.NDArray[np.uint8]:
        """Packed occupancy of the feature bounding box at step `t`, uint8 (bytes,).

        One bit for each vertex, 1 in the coreset, in ragged Morton order (FORMAT.md, Occupancy).
        Between key frames it is that of `Volume.occupancy`. Raises RegionError for a step outside
        the series.
        """
        key = self._key_index(t)
        last = floor(key) + (not float(key).is_integer())
        return pack(self._model.occupied(floor(key), last, Box.of_shape(self.box.shape)))

    def model(self, points: npt.ArrayLike) -> npt.NDArray[Any]:
        """Values (...) of the model at points (..., 4), in data units.

        points: positions (t, z, y, x), in steps and in vertices of the domain. They are fractional
            between vertices and between steps. Values are NaN where `Volume.sample` has NaN.

        Raises InputError for points of another shape, RegionError for a step outside the series.
        """
        positions = np.asarray(points, dtype=np.float64)
        if positions.ndim < 1 or positions.shape[-1] != len(AXES):
            raise InputError(
                f"points have shape {positions.shape}; (..., 4) is needed: t, z, y and x of each"
            )
        t, z, y, x = np.moveaxis(positions, -1, 0)
        values: npt.NDArray[Any] = self.sample(t=t, z=z, y=y, x=x)
        return values

    def _sampled(
        self, steps: Positions, space: Sequence[Positions], *, gradient: bool
    ) -> tuple[Positions, Positions | None]:
        """Values (n,) at points, NaN where there is none, and derivatives (n, 4) by t, z, y and x.

        steps: of the points. space: positions z, y and x of the points, in vertices of the domain.
        gradient: whether derivatives are asked for; None is returned for them otherwise.
        """
        keys = self.key_times.key_indices(steps)
        inside = interpolable(self.box, steps, keys, space, self.occupancy)
        values = np.full(inside.shape, np.nan)
        slopes = np.full((*inside.shape, 4), np.nan) if gradient else None
        if inside.any():
            first = self.box.first
            local = [(along - low)[inside] for along, low in zip(space, first, strict=True)]
            if slopes is None:
                values[inside] = self._model.sample(keys[inside], local)
            else:
                found = self._model.sample_with_gradient(keys[inside], local)
                values[inside], slopes[inside] = found
                slopes[inside, 0] *= self.key_times.keys_per_step(steps[inside])
        return values, slopes


def interpolable(
    box: Box,
    steps: Positions,
    keys: Positions,
    space: Sequence[Positions],
    occupancy: Callable[[float, Box], Mask],
) -> Mask:
    """Mask (n,) of the points whose cell vertices of weight above 0 are all in the coreset.

    box: the feature bounding box; points outside it have no value.
    steps, keys: times of the points, in steps and as key indices.
    space: positions z, y and x of the points, in vertices of the domain.
    occupancy: the vertices (z, y, x) of a region of the domain that are in the coreset at a step.
    """
    inside: Mask = np.all(
        [
            (position >= first) & (position <= end - 1)
            for position, (first, end) in zip(space, box, strict=True)
        ],
        axis=0,
    )
    candidates = np.flatnonzero(inside)
    # Points between the same steps and the same key frames share an occupancy.
    for group in equal_places(_between(steps[candidates]), _between(keys[candidates])):
        chosen = candidates[group]
        step = float(steps[chosen[0]])
        inside[chosen] = _cells_occupied([p[chosen] for p in space], step, occupancy)
    return inside


def _between(positions: Positions) -> npt.NDArray[np.int64]:
    """Numbers (n,) that are equal for positions on one whole number, or between the same two."""
    return (np.floor(positions) + np.ceil(positions)).astype(np.int64)


def _cells_occupied(
    space: Sequence[Positions], step: float, occupancy: Callable[[float, Box], Mask]
) -> Mask:
    """Mask (n,) of the points whose cell is in the coreset.

    On a face of a cell the lower and the upper vertex are the same: vertices without weight do not
    matter.
    """
    lower = [np.floor(position).astype(np.int64) for position in space]
    upper = [np.ceil(position).astype(np.int64) for position in space]
    region = Box.of(
        (int(low.min()), int(high.max()) + 1) for low, high in zip(lower, upper, strict=True)
    )
    occupied = occupancy(step, region)
    complete = np.ones(space[0].shape, dtype=bool)
    if occupied.all():
        return complete
    for corner in np.ndindex(2, 2, 2):
        vertex = tuple(
            (high if is_upper else low) - first
            for is_upper, low, high, first in zip(corner, lower, upper, region.first, strict=True)
        )
        complete &= occupied[vertex]
    return complete
