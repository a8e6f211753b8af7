"""The design card of a file: config, tables, MLP and occupancy, alike in both profiles.

FORMAT.md, The model, defines these parts. `Volume` inherits them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from math import floor, prod
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.occupancy import pack, packed_bytes
from fhash_codec.model_parts import Mlp, Table
from fhash_codec.paper.model import PaperModel
from fhash_codec.provenance import metadata_of
from fhash_codec.volume_model import VolumeModel
from fhash_formats.container import Container
from fhash_formats.container.header import BITS_ARRAY, MASK_ARRAY, TABLE
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Coordinate
from fhash_formats.source_metadata import SourceMetadata

__all__ = ["Card"]


class Card:
    """The parts of the model of a volume. Tables and occupancy are decoded as they are read."""

    container: Container
    shape: tuple[int, int, int, int]
    box: Box
    _model: VolumeModel

    if TYPE_CHECKING:

        @property
        def coords(self) -> Mapping[str, Coordinate]: ...

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

        t counts key frames; z, y, x count vertices of the level in the feature bounding box. In the
        profile paper a table holds E embeddings at each vertex. In the profile compact E is 1:
        level 1 holds the values before the head corrects them, and level l the low-passed lattice
        of every 2^(l-1)-th vertex along z, y and x.
        """
        return self._model.tables

    @property
    def mlp(self) -> Mlp:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, float32.

        The first layer sees the L E interpolated embeddings of a point in the profile paper; in the
        profile compact 28 functions of a vertex and its neighbours in the table of level 1. There
        are no layers where a compact file has no head.
        """
        return self._model.mlp

    def describe(self) -> dict[str, Any]:
        """The place of each part of the model in the file, as JSON values.

        Each entry has `path` in the file, `coding` and `bytes`, which are those of the whole
        document or array there. `path` is empty, and `bytes` 0, for what takes none of its own: a
        coarser level that is decoded from the tiles of level 1, and an occupancy that is the whole
        box.

        Keys: `config` (with `settings`), `tables` (with `level`, `shape`, `dtype`), `mlp` (with
        `layer`, `shape` of the weights, `activation`) and `occupancy` (with `shape` of the bits,
        and `apart`, the features that have bits of their own).
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
                    **self._place(f"tables/level_{table.level}", "low-passed level 1"),
                }
                for table in self.tables
            ],
            "mlp": self._describe_mlp(),
            "occupancy": self._describe_occupancy(),
        }

    def _describe_mlp(self) -> list[dict[str, Any]]:
        """The layers: (weights, biases) in arrays of their own, or packed in the coded table."""
        count = len(self.mlp.weights)
        return [
            {
                "layer": number,
                "shape": list(weights.shape),
                "activation": self.mlp.activation if number < count else "linear",
                **self._place(
                    f"mlp/weight_{number}",
                    f"packed in the codec of {self._table_path}",
                ),
            }
            for number, weights in enumerate(self.mlp.weights, start=1)
        ]

    def _describe_occupancy(self) -> dict[str, Any]:
        """The bits of all key frames, or what stands in their place."""
        shape = [self.tables[0].shape[0], packed_bytes(self.box.shape)]
        arrays = self.container.arrays
        names = [str(name) for name in self.container.header["features"]]
        apart = names if isinstance(self._model, PaperModel) and len(names) > 1 else []
        for name in (MASK_ARRAY, BITS_ARRAY):
            if name in arrays:
                return {"shape": shape, **self._place(name, ""), "apart": apart}
        masked = self.container.arrays[TABLE].masked
        coding = f"in the tiles of {self._table_path}" if masked else "every vertex of the box"
        return {"shape": shape, "path": "", "coding": coding, "bytes": 0, "apart": []}

    @property
    def _table_path(self) -> str:
        """The path of the table in the file."""
        arrays = self.container.arrays
        return arrays[TABLE].name if TABLE in arrays else TABLE

    def _place(self, name: str, otherwise: str) -> dict[str, Any]:
        """Path, coding and bytes of an array, or of the arrays below that name."""
        stored = self.container.arrays
        found = [key for key in stored if key == name or key.startswith(f"{name}/")]
        arrays = [stored[key] for key in found]
        bias = stored.get(name.replace("weight_", "bias_")) if name.startswith("mlp/") else None
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
