"""Export of a container in plain numbers: the same model with the standard codecs of Zarr alone.

Any Zarr v3 library reads every number of such a file; FORMAT.md, Plain files, says what they mean.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import TABLE_AXES, Box, Table
from fhash_codec.compact.model import correction_of, predicted
from fhash_codec.features.occupancy import pack, packed_bytes, write_bits
from fhash_codec.header import check_name
from fhash_codec.measure.value_range import decoded_type
from fhash_codec.paper.model import PaperModel
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import ContainerWriter, StoredArray
from fhash_formats.container.header import (
    BITS_ARRAY,
    CORESET_ARRAY,
    LAYERS,
    MISSING_ARRAY,
    PLAIN_FEATURE,
    SPARSE,
    STEPS,
)
from fhash_formats.container.source_entry import AUXILIARY
from fhash_formats.errors import InputError
from fhash_formats.series import AXES
from fhash_formats.support.files import check_output
from fhash_formats.support.threads import chunk_region, slab_shape
from fhash_formats.transform.head import NeighbourHead

__all__ = ["export_plain"]

CHUNK_BYTES = 2 << 20
"""Bytes of a decoded chunk of a table that is not cut by tiles."""

TAKEN = {
    *(BITS_ARRAY, CORESET_ARRAY, MISSING_ARRAY, STEPS),
    *("key_frames", "corrections", "mlp", "auxiliary", "whole", "step_errors"),
}
"""Names of arrays and groups in the root of a file of one variable."""
SHOWN_ATTRIBUTES = ("units", "long_name", "standard_name")
"""Attributes of a variable that its array has for libraries that show it."""
Index = tuple[int, ...]


class ExportReport(TypedDict):
    """A plain file that was exported."""

    path: Annotated[str, "the plain file written"]
    bytes: Annotated[int, "its size"]
    source_bytes: Annotated[int, "size of the file that it was made from"]
    arrays: Annotated[int, "arrays of the plain file"]
    values: Annotated[int, "numbers in them"]


def export_plain(
    source: str | Path,
    path: str | Path,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> ExportReport:
    """Write the model of the container `source` in plain numbers as `path`, whole or not at all.

    force: replace a file that exists.

    The new file decodes to the same values, integers of any size included, and within rounding to
    float32 or float64 where the source has corrections of floats (a bounded error). Levels of
    detail are there down to a lattice of 2 vertices.

    Raises InputError for a name of a data file or the source itself, OutputExistsError without
    force, and OutputError where the file cannot be written.
    """
    path = Path(os.path.normpath(path))
    check_name(path)
    check_output(path, force, sources=[source])
    with open_volume(source) as volume, ContainerWriter(path, force=force) as writer:
        export = _Export(volume, writer, progress)
        if volume.profile == "paper":
            header = export.paper()
        elif PLAIN_FEATURE in volume.container.header["required_features"]:
            raise InputError(f"{source}: the file is plain already")
        else:
            header = export.compact()
        writer.commit(header)
        source_bytes = volume.container.size
    with open_volume(path) as written:
        arrays = written.container.arrays.values()
        return {
            "path": str(path),
            "bytes": written.container.size,
            "source_bytes": source_bytes,
            "arrays": len(arrays),
            "values": sum(prod(array.shape) for array in arrays),
        }


class _Export:
    """One export: arrays are decoded and written chunk by chunk."""

    def __init__(self, volume: Volume, writer: ContainerWriter, progress: Progress) -> None:
        self._volume, self._writer, self._progress = volume, writer, progress
        self._arrays = volume.container.arrays
        self._header = volume.container.header
        writer.begin()
        self._names = _nodes([each.name for each in volume.coords.values()])
        own = (len(volume.key_times.key_frames), *volume.box.shape)
        sizes = zip(self._names, own, volume.shape, strict=True)
        # A coordinate that has positions beside those of the table names no axis of it.
        self._axes = [axis if part == n else f"{axis}_box" for axis, part, n in sizes]
        self._done, self._total = 0, 1

    def paper(self) -> dict[str, Any]:
        """Write the published network: arrays decoded, tables and occupancy whole."""
        model = self._header["model"]
        # Coded tables become numbers, and tables of needed vertices get all others as well.
        coded = [
            table
            for table in self._volume.tables
            if SPARSE in model or f"table_{table.level}" not in self._arrays
        ]
        levels = (f"table_{table.level}/" for table in coded)
        masks = (f"{CORESET_ARRAY}/", f"{BITS_ARRAY}/") if CORESET_ARRAY in self._arrays else ()
        rewritten = (*levels, f"{LAYERS}/", *masks)
        copied = {
            name: array
            for name, array in self._arrays.items()
            if not f"{name}/".startswith(rewritten)
        }
        keys = len(self._volume.key_times.key_frames) if masks else 0
        self._total = sum(prod(array.grid) for array in copied.values()) + keys
        self._total += sum(map(_chunk_count, coded))
        self._write_coordinates()
        for name, array in copied.items():
            self._copy(name, array)
        if LAYERS in self._arrays:
            for number, layer in enumerate(self._volume.mlp.layers, start=1):
                for name, values in zip(("weight", "bias"), layer, strict=True):
                    self._writer.add_whole(f"mlp/{name}_{number}", values)
        for table in coded:
            self._write_table(table)
        if keys:
            self._write_occupancy(keys)
        tables, mlp = self._volume.tables, self._volume.mlp
        changed = {
            "tables": coded[0].dtype.name if coded else model["tables"],
            "parameters": sum(prod(table.shape) for table in tables) + mlp.parameters,
        }
        return {
            **self._header,
            "model": {key: model[key] for key in model if key != SPARSE} | changed,
            "required_features": [],  # tables that are numbers need none
        }

    def compact(self) -> dict[str, Any]:
        """Write another model: all levels, the head, bits, and corrections."""
        volume = self._volume
        array = self._arrays["table_1"]
        tables, settings = volume.tables, array.settings
        # A head takes differences from the origin, and plain tables have none; what it would do is
        # in the corrections then.
        head = None if settings is None or settings.origin else settings.head
        tiles = prod(array.grid)
        keys = array.shape[0]
        self._total = 2 * tiles + keys + sum(map(_chunk_count, tables[1:]))
        self._write_axes()
        self._write_tiles(
            "table_1",
            array,
            tables[0].dtype,
            lambda index: self._table(array, index)[..., np.newaxis],
            self._shown(),
        )
        for table in tables[1:]:
            self._write_table(table)
        self._write_occupancy(keys)
        self._write_corrections(array, head)
        return {
            **self._header,
            "mlp": None if head is None else head.to_json(),
            "required_features": [PLAIN_FEATURE],
            "model": {
                **self._header["model"],
                "levels": [list(table.shape[:4]) for table in tables],
                "tables": tables[0].dtype.name,
                "values": array.dtype.name,
                "tile": list(array.chunk_shape),
            },
        }

    def _tick(self, what: str) -> None:
        self._done += 1
        self._progress("exporting", self._done, self._total, what)

    def _copy(self, name: str, array: StoredArray) -> None:
        """Write the values of an array as plain numbers, chunk by chunk."""

        def chunks() -> Iterator[npt.NDArray[Any]]:
            for index in product(*map(range, array.grid)):
                region = chunk_region(index, array.chunk_shape, array.shape)
                yield array.decode_chunk(index)[tuple(slice(0, a.stop - a.start) for a in region)]
                self._tick(name)

        self._writer.add_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunk_shape=array.chunk_shape,
            chunks=chunks(),
            dimension_names=array.dimension_names,
            attributes=array.attributes,
        )

    def _write_table(self, table: Table) -> None:
        """Write the table of a level in slabs."""
        chunk = _chunk_shape(table)

        def chunks() -> Iterator[npt.NDArray[Any]]:
            for start in np.ndindex(*_grid(table.shape, chunk)):
                yield table[chunk_region(start, chunk, table.shape)]
                self._tick(f"level {table.level}")

        self._writer.add_array(
            f"table_{table.level}",
            shape=table.shape,
            dtype=table.dtype,
            chunk_shape=chunk,
            chunks=chunks(),
            dimension_names=TABLE_AXES,
        )

    def _write_tiles(
        self,
        name: str,
        array: StoredArray,
        dtype: np.dtype[Any],
        read: Callable[[Index], npt.NDArray[Any]],
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Write an array in the tiles of the coded one. read: gives a tile by its index."""

        def chunks() -> Iterator[npt.NDArray[Any]]:
            for index in product(*map(range, array.grid)):
                yield read(index)
                self._tick(name)

        extra = (1,) if name.startswith("table_") else ()
        self._writer.add_array(
            name,
            shape=(*array.shape, *extra),
            dtype=dtype,
            chunk_shape=(*array.chunk_shape, *extra),
            chunks=chunks(),
            dimension_names=(*self._axes, *TABLE_AXES[4:])[: 4 + len(extra)],
            attributes=attributes,
        )

    def _shown(self) -> dict[str, Any]:
        """Attributes by which libraries of Zarr show a table as that of its variable."""
        variable = self._header["variable"]
        attributes = {**variable["attributes"], "units": variable["units"]}
        shown = {key: attributes[key] for key in SHOWN_ATTRIBUTES if attributes.get(key)}
        return {"long_name": variable["name"], **shown}

    def _table(self, array: StoredArray, index: Index) -> npt.NDArray[Any]:
        region = chunk_region(index, array.chunk_shape, array.shape)
        table = array.decode_table(index)[tuple(slice(0, a.stop - a.start) for a in region)]
        # Tiles with settings of their own may each have another working type.
        return table.astype(self._volume.tables[0].dtype, copy=False)

    def _write_coordinates(self) -> None:
        """Write positions as arrays for libraries of Zarr too; readers take those of the header."""
        coords = self._volume.coords.values()
        for name, coordinate in zip(self._names, coords, strict=True):
            attributes = dict(coordinate.attributes)
            self._writer.add_whole(
                name, coordinate.values, dimension_names=[name], attributes=attributes
            )

    def _write_axes(self) -> None:
        """Write key frames, and arrays of the source beside the values."""
        self._write_coordinates()
        key_frames = np.array(self._volume.key_times.key_frames, dtype=np.int64)
        self._writer.add_whole("key_frames", key_frames)
        for name, array in self._arrays.items():
            # masks, figures of steps, and what belongs to the variable in its source
            if name in (MISSING_ARRAY, STEPS) or name.startswith(AUXILIARY):
                self._total += prod(array.grid)
                self._copy(name, array)

    def _write_occupancy(self, keys: int) -> None:
        """Write the bits of every key frame, of the published network those of each feature."""
        model, box = self._volume._model, self._volume.box.shape
        region = Box.of_shape(box)
        count = len(self._header["features"]) if isinstance(model, PaperModel) else 1

        def row(feature: int, key: int) -> npt.NDArray[np.uint8]:
            if isinstance(model, PaperModel):
                occupied = model.occupied_by((feature,), key, key, region)
            else:
                occupied = model.occupied(key, key, region)
            if feature + 1 == count:
                self._tick("occupancy")
            return pack(occupied)

        write_bits(self._writer, BITS_ARRAY, (count, keys, packed_bytes(box)), row)

    def _write_corrections(self, array: StoredArray, head: NeighbourHead | None) -> None:
        """Write what takes the output of the head to the decoded values, if that is anything."""
        needed = False

        def read(index: Index) -> npt.NDArray[Any]:
            nonlocal needed
            table = self._table(array, index)
            region = tuple(slice(0, n) for n in table.shape)
            values = array.decode_chunk(index)[region]
            correction = correction_of(values, predicted(table, head, array.dtype))
            if values.dtype.kind == "f":
                correction[np.isnan(values)] = 0
            if array.masked:
                region = chunk_region(index, array.chunk_shape, array.shape)
                correction[~array.read_mask(region)] = 0
            needed = needed or bool(correction.any())
            return correction

        mark = self._writer.mark()
        self._write_tiles("corrections", array, decoded_type(array.dtype), read)
        if not needed:
            self._writer.rewind(mark)


def _nodes(names: Sequence[str]) -> list[str]:
    """Names of the arrays of the coordinates of t, z, y and x: their own where that is allowed.

    It is not for what no array may be called, what FORMAT.md calls another, and one that is there.
    """
    found: list[str] = []
    for axis, name in zip(AXES, names, strict=True):
        good = re.fullmatch(r"(?!table_)[A-Za-z0-9-][A-Za-z0-9_-]{0,80}", name)
        free = name if good and name not in {*TAKEN, *found} else f"axis_{axis}"
        found.append(free if free not in found else f"axis_{axis}_")
    return found


def _chunk_shape(table: Table) -> Index:
    return slab_shape(table.shape, table.dtype.itemsize, CHUNK_BYTES)


def _chunk_count(table: Table) -> int:
    return prod(_grid(table.shape, _chunk_shape(table)))


def _grid(shape: Index, chunk: Index) -> Index:
    return tuple(-(-n // c) for n, c in zip(shape, chunk, strict=True))
