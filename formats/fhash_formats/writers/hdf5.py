"""Writer of HDF5: a dataset (t, z, y, x) for each variable, coordinates as dimension scales.

Chunks are single frames, compressed by gzip 1 after the byte shuffle. Both are part of every HDF5
library (lzf is not), and decoded values are mostly NaN outside the coreset. Two series took 0.01
and 0.13 of the size where only a feature was decoded, 0.15 and 0.74 on full frames, at 50-400 MB/s;
level 4 takes a third longer for at most a few percent.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.series import AXES, Coordinate
from fhash_formats.writers.common.held_file import held_hdf5
from fhash_formats.writers.common.labels import (
    coordinate_attributes,
    hdf5_value,
    safe_name,
    unused_name,
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

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


@contextmanager
def _open(
    regions: Sequence[Region], outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Sequence[Put]]:
    import h5py

    with held_hdf5(temporaries[0], lambda file: h5py.File(file, "w")) as (file, root):
        with file.calling():
            taken, scales = {safe_name(region.name) for region in regions}, list[_Scale]()
            values = [_create(root, region, scales, taken) for region in regions]

        def put(values: Any, step: int, frame: Frame) -> None:
            with file.calling():
                values[step] = frame

        yield [partial(put, each) for each in values]


@dataclass(frozen=True, kw_only=True)
class _Scale:
    """A coordinate in the file.

    Attributes:
        axis: of "t", "z", "y" and "x".
        coordinate: positions, name and attributes.
        dataset: in the file.
        name: of the dataset.
    """

    axis: str
    coordinate: Coordinate
    dataset: Any
    name: str

    def suits(self, axis: str, coordinate: Coordinate) -> bool:
        """Whether it is a coordinate along an axis."""
        mine = self.coordinate
        return (
            (axis, coordinate.name, coordinate.attributes)
            == (self.axis, mine.name, mine.attributes)
        ) and np.array_equal(coordinate.values, mine.values)


def _create(root: Any, region: Region, scales: list[_Scale], taken: set[str]) -> Any:
    """Create the empty dataset in `root`, with its attributes and scales.

    scales: those that are there; further ones are added. taken: names in the file.
    """
    dtype = little_endian(region.dtype, half=True)
    values = root.create_dataset(
        safe_name(region.name),
        shape=region.shape,
        dtype=dtype,
        chunks=chunk_shape(region),
        **COMPRESSION,
    )
    for key, value in variable_attributes(region).items():
        values.attrs[key] = hdf5_value(value)
    if region.fill is not None:
        values.attrs["_FillValue"] = dtype.type(region.fill)
    for dimension, axis in enumerate(AXES):
        scale = _scale(root, axis, region.coords[axis], scales, taken)
        values.dims[dimension].attach_scale(scale.dataset)
        values.dims[dimension].label = scale.name
    return values


def _scale(
    root: Any, axis: str, coordinate: Coordinate, scales: list[_Scale], taken: set[str]
) -> _Scale:
    """The scale of a coordinate: one that is there, or a new one."""
    for scale in scales:
        if scale.suits(axis, coordinate):
            return scale
    name = unused_name(coordinate.name or axis, taken)
    dataset = root.create_dataset(name, data=coordinate.values.astype("<f8"))
    for key, value in coordinate_attributes(axis, coordinate).items():
        dataset.attrs[key] = hdf5_value(value)
    dataset.make_scale(name)
    scales.append(_Scale(axis=axis, coordinate=coordinate, dataset=dataset, name=name))
    return scales[-1]


HDF5 = Writer(name="HDF5", suffixes=(".h5", ".hdf5"), outputs=one_output, open=_open, several=True)
