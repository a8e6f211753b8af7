"""Writer of NetCDF-4 by the CF conventions, through h5netcdf: a variable with four coordinates.

NaN, or the region's fill value, is declared as `_FillValue`. NetCDF has no float16; it is stored as
float32, exactly.
Chunks and compression are those of `hdf5`, for the same reasons.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.series import AXES
from fhash_formats.writers.common.held_file import held_hdf5
from fhash_formats.writers.common.labels import (
    coordinate_attributes,
    hdf5_value,
    safe_names,
    variable_attributes,
)
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


@contextmanager
def _open(region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]) -> Iterator[Put]:
    import h5netcdf

    dtype = little_endian(region.dtype)
    with held_hdf5(temporaries[0], lambda file: h5netcdf.File(file, "w")) as (file, root):
        with file.calling():
            values = _create(root, region, dtype)

        def put(step: int, frame: Frame) -> None:
            with file.calling():
                values[step] = frame.astype(dtype, copy=False)

        yield put


def _create(root: Any, region: Region, dtype: np.dtype[Any]) -> Any:
    """Create the empty variable in `root`, with its attributes, dimensions and coordinates."""
    variable, names = safe_names(region)
    root.attrs["Conventions"] = "CF-1.8"
    root.dimensions = {names[axis]: length for axis, length in zip(AXES, region.shape, strict=True)}
    for axis in AXES:
        coordinate = region.coords[axis]
        scale = root.create_variable(
            names[axis], (names[axis],), data=coordinate.values.astype("<f8")
        )
        for key, value in coordinate_attributes(axis, coordinate).items():
            scale.attrs[key] = hdf5_value(value)
    fill = np.nan if dtype.kind == "f" else None
    fill = fill if region.fill is None else dtype.type(region.fill)
    dimensions = tuple(names[axis] for axis in AXES)
    values = root.create_variable(
        variable, dimensions, dtype, chunks=chunk_shape(region), fillvalue=fill, **COMPRESSION
    )
    for key, value in variable_attributes(region).items():
        values.attrs[key] = hdf5_value(value)
    return values


NETCDF = Writer(name="NetCDF", suffixes=(".nc", ".nc4"), outputs=one_output, open=_open)
