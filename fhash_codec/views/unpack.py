"""Unpacking of a container into a Zarr store whose chunks are tiles."""

from __future__ import annotations

import base64
import os
import struct
import time
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.dataset import Dataset
from fhash_codec.dataset import open as open_file
from fhash_codec.header import figure_attributes, history_line, read_missing, source_attributes
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume, holds
from fhash_formats.container import StoredArray
from fhash_formats.container.array import ArrayMetadata, with_crc32c
from fhash_formats.container.header import COMPACT, MISSING_ARRAY, PLAIN_FEATURE, TABLE
from fhash_formats.errors import InputError
from fhash_formats.readers.stored_parts import ABSENT
from fhash_formats.series import AXES, NO_AXIS, SourceVariable, with_history
from fhash_formats.support.files import check_output, replacing
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import json_attributes
from fhash_formats.transform.stream import NO_AXIS as NO_TILE_AXIS
from fhash_formats.transform.stream import TILE_AXES, ArrayAxes
from fhash_formats.writers.common import Outline, Region
from fhash_formats.writers.labelled import add_beside, consolidate, flush

if TYPE_CHECKING:
    from fhash_formats.transform.zarr_codec import TransformCodec

FILL = "_FillValue"
"""Attribute that says which number stands for a missing value."""

Index = tuple[int, ...]


class ChunkTable:
    """The tiles of a volume in the dimensions of an array of Zarr.

    Attributes:
        path: of the container.
        outline: of the array, and of all beside it.
        dtype: of the values.
        chunk: lengths of a chunk.
        layout: chunks in the order of the dimensions, as they lie in the file's members, which
            become shards.
        codec: that decodes the chunks.
        fill: the number that stands for a missing value; None where there is none, or NaN.

    Raises InputError for a volume whose tiles alone are not its values.
    """

    def __init__(self, volume: Volume) -> None:
        self.path, self._volume = volume.path, volume
        _require_plain_tiles(volume)
        self._table = volume.container.arrays[TABLE]
        self.dtype = self._table.dtype
        self.fill = self._fill()
        self._check_missing()
        region = Region(
            name=volume.name,
            units=volume.units,
            dtype=self.dtype,
            shape=volume.shape,
            coords=volume.coords,
            attributes=volume.attrs,
            metadata=volume.metadata,
        )
        self.outline = _with_provenance(Outline.of(region), volume)
        made_up = set(AXES) - set(self.outline.dimensions.values())
        lengths = dict(zip(AXES, self._table.chunk_shape, strict=True))
        if any(lengths[axis] > 1 for axis in made_up):
            raise InputError(_refusal(volume, "tiles that are longer than an axis it made up"))
        self.chunk = self.outline.ordered(self._table.chunk_shape)
        self.layout = ArrayMetadata(
            shape=self.outline.shape,
            dtype=self.dtype,
            chunk_shape=self.chunk,
            codecs=(),
            together=self.outline.ordered(self._table.together or (1, 1, 1, 1)),
        )

    @property
    def shard(self) -> Index | None:
        """Lengths of a shard; None where chunks are files of their own."""
        if not self.layout.indexed:
            return None
        return tuple(n * k for n, k in zip(self.chunk, self.layout.together or (), strict=True))

    @property
    def codec(self) -> TransformCodec:
        """The codec that decodes the chunks."""
        from fhash_formats.transform.zarr_codec import TransformCodec

        stored = self._table.axes
        names = TILE_AXES if stored is None else stored.names
        by_axis = dict(zip(AXES, names, strict=True)) | {NO_AXIS: NO_TILE_AXIS}
        axes = ArrayAxes(tuple(by_axis[axis] for axis in self.outline.dimensions.values()))
        told = None if axes.usual else axes.names
        if self._table.settings is None:
            return TransformCodec(reading=True, axes=told)
        return TransformCodec(settings=self._table.settings, axes=told)

    @property
    def stored_fill(self) -> Any:
        """The fill value as xarray has it among the attributes in Zarr."""
        assert self.fill is not None
        if self.dtype.kind != "f":
            return int(self.fill)
        return base64.standard_b64encode(struct.pack("<d", float(self.fill))).decode()

    def stream(self, index: Sequence[int]) -> bytes:
        """The bytes of a chunk. Raises DamagedFileError."""
        by_axis = dict(zip(self.outline.dimensions.values(), index, strict=True))
        place = tuple(by_axis.get(axis, 0) for axis in AXES)
        return bytes(self._table.coded(place))

    def _fill(self) -> int | float | None:
        """The number that stands for a missing value, as xarray's engine shows it."""
        volume = self._volume
        fill = volume.value_type.fill
        if self.dtype.kind == "f":
            return fill if MISSING_ARRAY in volume.container.arrays else None
        told = volume.value_type.has_gaps
        if volume.metadata is not None:
            told = told or bool({FILL, "missing_value"} & set(volume.metadata.variable_attributes))
        return fill if told and fill is not None and holds(self.dtype, fill) else None

    def _check_missing(self) -> None:
        """Refuse a volume with missing vertices where the tiles have some value."""
        volume = self._volume
        if MISSING_ARRAY not in volume.container.arrays:
            return
        for index in product(*map(range, self._table.grid)):
            steps, *space = chunk_region(index, self._table.chunk_shape, volume.shape)
            box = Box.of((along.start, along.stop) for along in space)
            missing = read_missing(volume.container, range(steps.start, steps.stop), box)
            if missing is None or not missing.any():
                continue
            values = self._table.read((steps, *space))[missing]
            known = np.zeros(values.shape, np.bool_) if self.fill is None else values == self.fill
            if values.dtype.kind == "f":
                known |= np.isnan(values)
            if not known.all():
                raise InputError(_refusal(volume, "missing values that its tiles do not tell"))


def _with_provenance(outline: Outline, volume: Volume) -> Outline:
    """An outline with the attributes that xarray's engine adds: the source, and the errors."""
    header, metadata = volume.container.header, volume.metadata
    of_file = (
        with_history({}, history_line(header))
        if metadata is None
        else {**outline.file_attributes, **source_attributes(metadata)}
    )
    attributes = {**outline.attributes, **figure_attributes(header)}
    return replace(outline, attributes=attributes, file_attributes=of_file)


def _require_plain_tiles(volume: Volume) -> None:
    """Raise InputError for a volume whose values are more than what its tiles decode to."""
    header = volume.container.header
    if header["model"]["profile"] != COMPACT:
        raise InputError(_refusal(volume, "the published network"))
    if PLAIN_FEATURE in header["required_features"]:
        raise InputError(_refusal(volume, "tables of plain numbers"))
    table: StoredArray = volume.container.arrays[TABLE]
    if table.shape != volume.shape:
        raise InputError(_refusal(volume, "tiles of a part of its domain or of its steps alone"))
    if table.masked and table.dtype.kind != "f":
        raise InputError(_refusal(volume, "integers of which some have no value"))
    if table.dtype != volume.dtype and table.dtype != np.float16:
        kinds = f"tiles of {table.dtype} for values of {volume.dtype}"
        raise InputError(_refusal(volume, kinds))


def _refusal(volume: Volume, what: str) -> str:
    return (
        f"{volume.path}: {volume.name} has {what}, which an array of coded chunks cannot show; "
        f"fhash decode {volume.path} -o OUT.zarr writes the values, and fhash export --plain the"
        " model in plain numbers"
    )


class UnpackedVariable(TypedDict):
    """A variable that was unpacked."""

    tiles: Annotated[int, "chunks"]


class UnpackReport(TypedDict):
    """A store that was unpacked of a file."""

    path: Annotated[str, "the store written"]
    bytes: Annotated[int, "all its files"]
    seconds: Annotated[float, "of the whole command"]
    variables: Annotated[dict[str, UnpackedVariable], "the variables by name"]


def unpack(
    path: str | Path,
    output: str | Path,
    *,
    variables: Sequence[str] | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> UnpackReport:
    """Make a Zarr store (format 3, a folder) of the tiles of a container.

    The bytes of the tiles are copied. zarr, xarray and dask decode them where fhash is installed,
    and find the values, coordinates and attributes that xarray's engine `fhash` gives.

    variables: names of those to take; all by default. force: replace a store that exists.

    Raises InputError for a file whose tiles alone are not its values, with the command that writes
    such a store; DamagedFileError, OutputExistsError and OutputError.
    """
    begun, output = time.perf_counter(), Path(os.path.normpath(output))
    check_output(output, force, directory=True, sources=[str(path)])
    with ExitStack() as stack:
        opened = open_file(path)
        stack.callback(opened.close)
        tables = _tables(opened, variables)
        folder = stack.enter_context(replacing(output, force=force, directory=True))
        folder.mkdir()
        _write_documents(folder, tables)
        for table in tables:
            _write_chunks(folder, table, progress)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {
        "path": str(output),
        "bytes": size,
        "seconds": time.perf_counter() - begun,
        "variables": {table.outline.name: {"tiles": prod(table.layout.grid)} for table in tables},
    }


def _tables(opened: Volume | Dataset, variables: Sequence[str] | None) -> list[ChunkTable]:
    """The tables of the variables, all of which can be unpacked."""
    volumes = {opened.name: opened} if isinstance(opened, Volume) else dict(opened.items())
    unknown = [name for name in variables or () if name not in volumes]
    if unknown:
        raise InputError(
            f"{opened.path} has no variable {unknown[0][:80]!r}; it has {', '.join(volumes)[:400]}"
        )
    tables = [ChunkTable(volumes[name]) for name in variables or volumes]
    names = [table.outline.name for table in tables]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{opened.path} has two variables {twice}; choose one by its name")
    return tables


def _write_documents(folder: Path, tables: Sequence[ChunkTable]) -> None:
    """Write all of a store but the chunks of the tables."""
    import zarr
    from zarr.storage import MemoryStore

    memory: dict[str, Any] = {}
    store = MemoryStore(memory)
    attributes = json_attributes(tables[-1].outline.file_attributes)
    root = zarr.create_group(store=store, zarr_format=3, attributes=attributes)
    with warnings.catch_warnings():
        # types of texts are not yet in Zarr's specification
        warnings.simplefilter("ignore")
        for beside in _beside(tables):
            add_beside(root, beside)
    for table in tables:
        _add_table(root, table)
    consolidate(store)
    flush(memory, folder)


def _beside(tables: Sequence[ChunkTable]) -> list[SourceVariable]:
    """The arrays beside the values, each once; raises InputError where two have one name."""
    names = {table.outline.name for table in tables}
    found: dict[str, SourceVariable] = {}
    lengths: dict[str, int] = {}
    for table in tables:
        for name, length in table.outline.lengths.items():
            if lengths.setdefault(name, length) != length:
                raise InputError(
                    f"{table.path}: the variables have dimensions {name} of different lengths; "
                    "unpack them one by one (--var)"
                )
        for each in table.outline.variables:
            known = found.setdefault(each.name, each)
            if each.name not in names and not _same(known, each):
                raise InputError(
                    f"{table.path}: the variables have different arrays {each.name} beside them; "
                    "unpack them one by one (--var)"
                )
    return [each for name, each in found.items() if name not in names]


def _same(first: SourceVariable, second: SourceVariable) -> bool:
    """Whether two arrays are the same in a store."""
    kind = first.values.dtype.kind
    return (
        first.dimensions == second.dimensions
        and first.values.dtype == second.values.dtype
        and np.array_equal(first.values, second.values, equal_nan=kind == "f")
    )


def _add_table(root: Any, table: ChunkTable) -> None:
    """Write the document of an array of tiles."""

    outline, attributes = table.outline, json_attributes(table.outline.attributes)
    if table.fill is not None:
        attributes[FILL] = table.stored_fill
    root.create_array(
        outline.name,
        shape=outline.shape,
        dtype=table.dtype,
        chunks=table.chunk,
        shards=table.shard,
        serializer=table.codec,
        compressors=(),
        filters=(),
        fill_value=np.nan if table.dtype.kind == "f" else 0,
        dimension_names=list(outline.dimensions),
        attributes=attributes,
    )


def _write_chunks(folder: Path, table: ChunkTable, progress: Progress) -> None:
    """Write the chunks of a table, each in a file of its own, or those of a shard in one."""
    place, name = folder / table.outline.name, table.outline.name
    total, done = prod(table.layout.grid), 0
    progress("unpacking", 0, total, name)
    for outer in product(*map(range, table.layout.members)):
        path = place.joinpath("c", *map(str, outer))
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            streams: dict[Index, int] = {}
            for index in table.layout.chunks_of(outer):
                streams[index] = file.write(table.stream(index))
                done += 1
                progress("unpacking", done, total, name)
            if table.shard is not None:
                file.write(_shard_index(table, outer, streams))


def _shard_index(table: ChunkTable, outer: Index, sizes: dict[Index, int]) -> bytes:
    """The index of a shard of Zarr: offset and bytes of each chunk in it, and their CRC-32C.

    sizes: bytes of the chunks that are there, in the order in which they lie in the shard.
    """
    together = table.layout.together or ()
    entries = np.full((*together, 2), ABSENT, dtype="<u8")
    offset = 0
    for index, size in sizes.items():
        corner = (i * k for i, k in zip(outer, together, strict=True))
        place = tuple(i - first for i, first in zip(index, corner, strict=True))
        entries[place] = offset, size
        offset += size
    return with_crc32c(entries.tobytes())
