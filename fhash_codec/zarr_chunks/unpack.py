"""`unpack`: a container becomes a Zarr store of the same coded chunks."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from fhash_codec.dataset import Dataset
from fhash_codec.dataset import open as open_file
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_codec.zarr_chunks.chunk_table import FILL, ChunkTable
from fhash_formats.container.sharding import pack_index
from fhash_formats.errors import InputError
from fhash_formats.source_metadata import SourceVariable
from fhash_formats.support.atomic import check_output, replacing
from fhash_formats.support.attributes import json_attributes
from fhash_formats.writers.zarr_store import add_beside, consolidate, flush

__all__ = ["unpack"]


def unpack(
    path: str | Path,
    output: str | Path,
    *,
    variables: Sequence[str] | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make a Zarr store (format 3, a folder) of the tiles of a container.

    The bytes of the tiles are copied. zarr, xarray and dask decode them where fhash is installed,
    and find the values, coordinates and attributes that xarray's engine `fhash` gives.

    variables: names of those to take; all by default. force: replace a store that exists.

    Returns `path`, `bytes`, `seconds`, and in `variables` the number of tiles of each. Raises
    InputError for a file whose tiles alone are not its values, with the command that writes such a
    store; DamagedFileError, OutputExistsError and OutputError.
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
        "variables": {table.outline.name: {"tiles": prod(table.grid)} for table in tables},
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
    total, done = prod(table.grid), 0
    progress("unpacking", 0, total, name)
    for outer, indices in _files(table):
        path = place.joinpath("c", *map(str, outer))
        path.parent.mkdir(parents=True, exist_ok=True)
        sizes = []
        with path.open("wb") as file:
            for index in indices:
                sizes.append(file.write(table.stream(index)))
                done += 1
                progress("unpacking", done, total, name)
            if table.sharding is not None:
                file.write(pack_index(sizes, table.sharding.present(outer, table.outline.shape)))


def _files(table: ChunkTable) -> Iterator[tuple[tuple[int, ...], Sequence[tuple[int, ...]]]]:
    """Yield the index of each file of an array, and those of the chunks in it, in their order."""
    if table.sharding is None:
        yield from ((index, [index]) for index in product(*map(range, table.grid)))
        return
    shape = table.outline.shape
    counts = [-(-n // length) for n, length in zip(shape, table.shard or (), strict=True)]
    for outer in product(*map(range, counts)):
        yield outer, list(table.sharding.chunks_of(outer, shape))
