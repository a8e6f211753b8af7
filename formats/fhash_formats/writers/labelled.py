"""Writers of arrays: HDF5, NetCDF and Zarr, which name dimensions; NPY, and raw bytes with NRRD."""

from __future__ import annotations

import base64
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Coordinate, SourceVariable
from fhash_formats.support.values import PLUMBING, json_attributes
from fhash_formats.writers.common import (
    Beside,
    Frame,
    Outline,
    Put,
    Region,
    Writer,
    chunk_shape,
    coordinate_attributes,
    even_spacing,
    hdf5_value,
    held_hdf5,
    little_endian,
    of_one,
    one_output,
    printable,
    safe_name,
    unused_name,
    variable_attributes,
    write_frame,
)

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


@contextmanager
def _open_hdf5(
    regions: Sequence[Region], outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Sequence[Put]]:
    import h5py

    with held_hdf5(temporaries[0], lambda file: h5py.File(file, "w")) as (file, root):
        with file.calling():
            taken, scales = {safe_name(region.name) for region in regions}, list[_Scale]()
            values = [_create_hdf5(root, region, scales, taken) for region in regions]

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


def _create_hdf5(root: Any, region: Region, scales: list[_Scale], taken: set[str]) -> Any:
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


HDF5 = Writer(
    name="HDF5", suffixes=(".h5", ".hdf5"), outputs=one_output, open=_open_hdf5, several=True
)


FILL = "_FillValue"


@contextmanager
def _open_netcdf(
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
            values = [_create_netcdf(root, *each) for each in zip(regions, outlines, strict=True)]

        def put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
            with file.calling():
                place, ordered = outline.slab(step, frame)
                values[place] = ordered.astype(values.dtype, copy=False)

        yield [partial(put, *each) for each in zip(outlines, values, strict=True)]


def _create_netcdf(root: Any, region: Region, outline: Outline) -> Any:
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
    name="NetCDF", suffixes=(".nc", ".nc4"), outputs=one_output, open=_open_netcdf, several=True
)


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
def _open_zarr(
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
    values = [_create_zarr(root, *each) for each in zip(regions, outlines, strict=True)]
    consolidate(store)
    flush(memory, folder)

    def put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
        place, ordered = outline.slab(step, frame)
        values[place] = ordered
        flush(memory, folder)

    yield [partial(put, *each) for each in zip(outlines, values, strict=True)]


def _create_zarr(root: Any, region: Region, outline: Outline) -> Any:
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
    open=_open_zarr,
    directory=True,
    several=True,
)


@contextmanager
def _open_npy(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    dtype = little_endian(region.dtype, half=True)
    header = {
        "descr": npy_format.dtype_to_descr(dtype),
        "fortran_order": False,
        "shape": region.shape,
    }
    with temporaries[0].open("xb") as handle:
        npy_format.write_array_header_1_0(handle, header)

        def put(step: int, frame: Frame) -> None:
            write_frame(handle, frame, dtype)

        yield put


NPY = Writer(name="NumPy", suffixes=(".npy",), outputs=one_output, open=of_one(_open_npy))


NRRD_TYPES = {"float32": "float", "float64": "double"}  # the integers are called as in numpy


def _outputs(path: Path, region: Region) -> list[Path]:
    from fhash_formats.readers.file_series import parse_dtype
    from fhash_formats.readers.images import layout_of_name

    _, layout = layout_of_name(path.stem)
    if layout.shape is None or layout.dtype is None:
        if not path.name.isprintable():
            raise InputError(
                f"{path}: the file name holds control characters, which a .nhdr header cannot"
                " name; use another name"
            )
        return [path, path.with_suffix(".nhdr")]
    if (
        tuple(layout.shape.get(axis, 1) for axis in AXES) != region.shape
        or parse_dtype(layout.dtype) != region.dtype
    ):
        t, z, y, x = region.shape
        true = f"*_{x}x{y}x{z}x{t}_{region.dtype.name}.raw"
        raise InputError(
            f"{path}: the name says another layout than the values have; use {true} or a name that"
            " says none"
        )
    return [path]


@contextmanager
def _open_raw(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    from fhash_formats.readers.file_series import ENDIANS
    from fhash_formats.readers.images import layout_of_name

    _, layout = layout_of_name(outputs[0].stem)
    dtype = (
        little_endian(region.dtype)
        if layout.dtype is None
        else region.dtype.newbyteorder(ENDIANS[layout.endian or "little"])
    )
    with temporaries[0].open("xb") as handle:

        def put(step: int, frame: Frame) -> None:
            write_frame(handle, frame, dtype)

        yield put
    if len(outputs) == 2:
        temporaries[1].write_text(_header(region, dtype, outputs[0].name), encoding="utf-8")


def _header(region: Region, dtype: np.dtype[Any], data_file: str) -> str:
    """The NRRD header (teem.sourceforge.net/nrrd/format.html): axes fastest first.

    A single step is a plain volume. There are no `labels`: VTK would name the values by the first.
    """
    axes = "xyzt" if region.shape[0] > 1 else "xyz"
    sizes = dict(zip(AXES, region.shape, strict=True))
    lines = [
        "NRRD0005",
        f"content: {printable(region.name, ' ')}",
        f"type: {NRRD_TYPES.get(dtype.name, dtype.name)}",
        f"dimension: {len(axes)}",
        f"sizes: {' '.join(str(sizes[axis]) for axis in axes)}",
        f"kinds: {' '.join('time' if axis == 't' else 'space' for axis in axes)}",
        *_space(region, axes),
        "endian: little",
        "encoding: raw",
        *([f"sample units: {printable(region.units, ' ')}"] if region.units else []),
        f"data file: {data_file}",
    ]
    for axis in AXES:
        coordinate = region.coords[axis]
        lines.append(f"name_{axis}:={printable(coordinate.name, ' ')}")
        for key in ("units", "calendar"):
            if key in coordinate.attributes:
                text = printable(str(coordinate.attributes[key]), " ")
                lines.append(f"{key}_{axis}:={text}")
        lines.append(f"coordinates_{axis}:={' '.join(map(repr, coordinate.values.tolist()))}")
    return "\n".join(lines) + "\n\n"


def _space(region: Region, axes: str) -> list[str]:
    """Lines that place the grid in space; none where an axis is uneven."""
    steps = [even_spacing(region.coords[axis].values) for axis in "xyz"]
    if None in steps:
        return []
    directions = [
        f"({','.join(repr(step) if i == j else '0' for j in range(3))})"
        for i, step in enumerate(steps)
    ]
    origin = ",".join(repr(float(region.coords[axis].values[0])) for axis in "xyz")
    return [
        "space dimension: 3",
        f"space directions: {' '.join(directions + ['none'] * (len(axes) - 3))}",
        f"space origin: ({origin})",
    ]


RAW = Writer(name="raw", suffixes=(".raw",), outputs=_outputs, open=of_one(_open_raw))
