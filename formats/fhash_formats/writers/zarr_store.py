"""Writer of a Zarr v3 group: the variable and its coordinates as arrays with dimension names.

xarray opens it as a dataset. There is one chunk per step (see `chunk_shape`), in zarr's default
compression. zarr writes into memory, and each frame's chunks go from there to plain files: zarr's
own writing to disk continues in another thread after Ctrl-C and would bring back a store that was
just removed.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.series import AXES
from fhash_formats.writers.common.labels import (
    coordinate_attributes,
    safe_names,
    variable_attributes,
)
from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.writer import Frame, Put, Writer, chunk_shape, one_output


def _flush(memory: dict[str, Any], folder: Path) -> None:
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


def _attributes(region: Region) -> dict[str, Any]:
    """The attributes of the variable; an integer that stands for no value is among them."""
    attributes = dict(variable_attributes(region))
    if region.fill is not None and region.dtype.kind in "iu":
        attributes["_FillValue"] = int(region.fill)
    return attributes


@contextmanager
def _open(region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]) -> Iterator[Put]:
    import zarr
    from zarr.storage import MemoryStore

    memory: dict[str, Any] = {}
    folder = temporaries[0]
    folder.mkdir()
    variable, names = safe_names(region)
    store = MemoryStore(memory)
    root = zarr.create_group(store=store, zarr_format=3)
    for axis in AXES:
        coordinate = region.coords[axis]
        attributes = coordinate_attributes(axis, coordinate)
        root.create_array(
            names[axis],
            data=coordinate.values,
            dimension_names=[names[axis]],
            attributes=attributes,
        )
    values = root.create_array(
        variable,
        shape=region.shape,
        dtype=region.dtype,
        chunks=chunk_shape(region),
        fill_value=_fill_value(region),
        dimension_names=[names[axis] for axis in AXES],
        attributes=_attributes(region),
        config={
            "write_empty_chunks": True
        },  # a chunk that is missing is then always a fault, not a frame of fill values
    )
    # that this is not yet in Zarr's specification; xarray looks for it and warns where it is not
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(store)
    _flush(memory, folder)

    def put(step: int, frame: Frame) -> None:
        values[step] = frame
        _flush(memory, folder)

    yield put


ZARR = Writer(name="Zarr", suffixes=(".zarr",), outputs=one_output, open=_open, directory=True)
