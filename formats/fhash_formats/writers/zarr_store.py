"""Writer of a Zarr v3 group: variables and all beside them as arrays with dimension names.

xarray opens it as a dataset. There is one chunk per step (see `chunk_shape`), in zarr's default
compression. zarr writes into memory, and each frame's chunks go from there to plain files: zarr's
own writing to disk continues in another thread after Ctrl-C and would bring back a store that was
just removed.
"""

from __future__ import annotations

import base64
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.source_metadata import SourceVariable
from fhash_formats.support.attributes import json_attributes
from fhash_formats.writers.common.outline import Beside, Outline
from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.writer import Frame, Put, Writer, chunk_shape, one_output

FILL = "_FillValue"


def flush(memory: dict[str, Any], folder: Path) -> None:
    """Move the chunks that zarr wrote from memory to files."""
    while memory:
        key, buffer = memory.popitem()
        path = folder / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(buffer.to_bytes())


def _fill_value(region: Region) -> Any:
    """The value of chunks that were not written; it also marks missing values of floats."""
    if region.fill is not None and region.dtype.kind == "f":
        return region.dtype.type(region.fill)
    return np.nan if region.dtype.kind == "f" else 0


def _attributes(region: Region, outline: Outline) -> dict[str, Any]:
    """The attributes of the variable; an integer that stands for no value is among them."""
    attributes = json_attributes(outline.attributes)
    if region.fill is not None and region.dtype.kind in "iu":
        attributes[FILL] = int(region.fill)
    return attributes


def add_beside(root: Any, beside: SourceVariable) -> None:
    """Write an array beside the values."""
    values = beside.values
    if values.dtype.kind in "OU":
        values = values.astype(np.dtypes.StringDType())
    attributes = json_attributes(beside.attributes)
    fill = beside.attributes.get(FILL)
    if fill is not None and values.dtype.kind == "f":
        # as xarray writes and reads it
        attributes[FILL] = base64.standard_b64encode(struct.pack("<d", float(fill))).decode()
    root.create_array(
        beside.name, data=values, dimension_names=list(beside.dimensions), attributes=attributes
    )


def consolidate(store: Any) -> None:
    """Write the metadata of all arrays into those of the root, where xarray looks for them."""
    import zarr

    # that this and types of texts are not yet in Zarr's specification; xarray warns where it is not
    # there
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(store)


@contextmanager
def _open(
    regions: Sequence[Region], outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Sequence[Put]]:
    import zarr
    from zarr.storage import MemoryStore

    outlines = [Outline.of(region) for region in regions]
    beside = Beside.of(outlines)
    memory: dict[str, Any] = {}
    folder = temporaries[0]
    folder.mkdir()
    store = MemoryStore(memory)
    attributes = json_attributes(beside.attributes)
    root = zarr.create_group(store=store, zarr_format=3, attributes=attributes)
    with warnings.catch_warnings():
        # types of texts are not yet in Zarr's specification
        warnings.simplefilter("ignore")
        for each in beside.variables:
            add_beside(root, each)
    values = [_create(root, *each) for each in zip(regions, outlines, strict=True)]
    consolidate(store)
    flush(memory, folder)

    def put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
        place, ordered = outline.place(step, frame)
        values[place] = ordered
        flush(memory, folder)

    yield [partial(put, *each) for each in zip(outlines, values, strict=True)]


def _create(root: Any, region: Region, outline: Outline) -> Any:
    """Create the empty array of a variable."""
    return root.create_array(
        outline.name,
        shape=outline.shape,
        dtype=region.dtype,
        chunks=outline.ordered(chunk_shape(region)),
        fill_value=_fill_value(region),
        dimension_names=list(outline.dimensions),
        attributes=_attributes(region, outline),
        config={
            "write_empty_chunks": True
        },  # a chunk that is missing is then always a fault, not a frame of fill values
    )


ZARR = Writer(
    name="Zarr",
    suffixes=(".zarr",),
    outputs=one_output,
    open=_open,
    directory=True,
    several=True,
)
