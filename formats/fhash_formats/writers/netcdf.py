"""Writer of NetCDF-4 by the CF conventions, through h5netcdf: variables and all beside them.

NaN, or the region's fill value, is declared as `_FillValue`. NetCDF has no float16; it is stored as
float32, exactly.
Chunks and compression are those of `hdf5`, for the same reasons.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.source_metadata import SourceVariable
from fhash_formats.support.attributes import PLUMBING
from fhash_formats.writers.common.held_file import held_hdf5
from fhash_formats.writers.common.labels import hdf5_value
from fhash_formats.writers.common.outline import Beside, Outline
from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.writer import (
    Frame,
    Put,
    Writer,
    chunk_shape,
    little_endian,
    one_output,
)
from fhash_formats.writers.hdf5 import COMPRESSION

FILL = "_FillValue"


@contextmanager
def _open(
    regions: Sequence[Region], outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Sequence[Put]]:
    import h5netcdf

    outlines = [Outline.of(region) for region in regions]
    beside = Beside.of(outlines)
    with held_hdf5(temporaries[0], lambda file: h5netcdf.File(file, "w")) as (file, root):
        with file.calling():
            _set_attributes(root, {"Conventions": "CF-1.8", **beside.attributes})
            root.dimensions = dict(beside.lengths)
            for each in beside.variables:
                _add(root, each)
            values = [_create(root, *each) for each in zip(regions, outlines, strict=True)]

        def put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
            with file.calling():
                place, ordered = outline.place(step, frame)
                values[place] = ordered.astype(values.dtype, copy=False)

        yield [partial(put, *each) for each in zip(outlines, values, strict=True)]


def _create(root: Any, region: Region, outline: Outline) -> Any:
    """Create the empty variable in `root`, whose dimensions are there, with its attributes."""
    dtype = little_endian(region.dtype)
    fill = np.nan if dtype.kind == "f" else None
    fill = fill if region.fill is None else dtype.type(region.fill)
    values = root.create_variable(
        outline.name,
        tuple(outline.dimensions),
        dtype,
        chunks=outline.ordered(chunk_shape(region)),
        fillvalue=fill,
        **COMPRESSION,
    )
    _set_attributes(values, outline.attributes)
    return values


def _add(root: Any, beside: SourceVariable) -> None:
    """Write an array beside the values."""
    import h5py

    values = beside.values
    dtype: Any = h5py.string_dtype() if values.dtype.kind in "OTU" else little_endian(values.dtype)
    fill = beside.attributes.get(FILL) if values.dtype.kind in "iuf" else None
    variable = root.create_variable(
        beside.name, beside.dimensions, dtype, data=values.astype(dtype), fillvalue=fill
    )
    kept = {key: value for key, value in beside.attributes.items() if key not in (FILL, *PLUMBING)}
    _set_attributes(variable, kept)


def _set_attributes(place: Any, attributes: Mapping[str, Any]) -> None:
    for key, value in attributes.items():
        place.attrs[key] = hdf5_value(value)


NETCDF = Writer(
    name="NetCDF", suffixes=(".nc", ".nc4"), outputs=one_output, open=_open, several=True
)
