"""Writers of arrays: HDF5, NetCDF and Zarr, which name dimensions; NPY, and raw bytes with NRRD."""

from __future__ import annotations

import base64
import json
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

from fhash_formats.errors import InputError
from fhash_formats.series import AXES, SourceVariable
from fhash_formats.support.values import PLUMBING, json_attributes
from fhash_formats.writers.common import (
    Frame,
    Opened,
    Outline,
    Paths,
    Puts,
    Region,
    Regions,
    Writer,
    chunk_shape,
    coordinate_attributes,
    even_spacing,
    hdf5_value,
    held_hdf5,
    little_endian,
    printable,
    safe_name,
    together,
    variable_attributes,
    write_frame,
)

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
FILL = "_FillValue"


def _open_hdf5(regions: Regions, outputs: Paths, temporaries: Paths) -> Opened:
    import h5py

    def create(root: Any) -> Puts:
        taken, scales = {safe_name(region.name) for region in regions}, dict[Any, Any]()
        return [_create_hdf5(root, region, scales, taken).__setitem__ for region in regions]

    return held_hdf5(temporaries[0], lambda file: h5py.File(file, "w"), create)


def _create_hdf5(root: Any, region: Region, scales: dict[Any, Any], taken: set[str]) -> Any:
    """Create the empty dataset in `root`, with its attributes and scales.

    scales: those that are there, by what they hold; further ones are added. taken: names in the
    file.
    """
    dtype = little_endian(region.dtype, half=True)
    values = root.create_dataset(
        safe_name(region.name),
        shape=region.shape,
        dtype=dtype,
        chunks=chunk_shape(region),
        **COMPRESSION,
    )
    _set_attributes(values, variable_attributes(region))
    if region.fill is not None:
        values.attrs[FILL] = dtype.type(region.fill)
    for dimension, axis in zip(values.dims, AXES, strict=True):
        coordinate = region.coords[axis]
        attributes = coordinate_attributes(axis, coordinate)
        told = json.dumps(attributes, sort_keys=True)
        key = (axis, coordinate.name, told, coordinate.values.tobytes())
        if key not in scales:
            name = safe_name(coordinate.name or axis, taken)
            scales[key] = root.create_dataset(name, data=coordinate.values.astype("<f8"))
            _set_attributes(scales[key], attributes)
            scales[key].make_scale(name)
        dimension.attach_scale(scales[key])
        dimension.label = scales[key].name[1:]
    return values


HDF5 = Writer(name="HDF5", suffixes=(".h5", ".hdf5"), open=_open_hdf5, several=True)


def _put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
    """Write a frame into an array that has the dimensions of an outline."""
    place, ordered = outline.slab(step, frame)
    values[place] = ordered.astype(values.dtype, copy=False)


def _open_netcdf(regions: Regions, outputs: Paths, temporaries: Paths) -> Opened:
    import h5netcdf

    outlines = [Outline.of(region) for region in regions]
    lengths, beside, attributes = together(outlines)

    def create(root: Any) -> Puts:
        _set_attributes(root, {"Conventions": "CF-1.8", **attributes})
        growing = {name for outline in outlines for name in outline.unlimited}
        root.dimensions = {n: None if n in growing else each for n, each in lengths.items()}
        for name in growing:
            root.resize_dimension(name, lengths[name])
        for each in beside:
            _add(root, each)
        pairs = zip(regions, outlines, strict=True)
        return [partial(_put, each, _create_netcdf(root, region, each)) for region, each in pairs]

    return held_hdf5(temporaries[0], lambda file: h5netcdf.File(file, "w"), create)


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
    variable = root.create_variable(beside.name, beside.dimensions, dtype, fillvalue=fill)
    variable[...] = values.astype(dtype)
    kept = {key: value for key, value in beside.attributes.items() if key not in (FILL, *PLUMBING)}
    _set_attributes(variable, kept)


def _set_attributes(place: Any, attributes: Mapping[str, Any]) -> None:
    for key, value in attributes.items():
        place.attrs[key] = hdf5_value(value)


NETCDF = Writer(name="NetCDF", suffixes=(".nc", ".nc4"), open=_open_netcdf, several=True)


def flush(memory: dict[str, Any], folder: Path) -> None:
    """Move the chunks that zarr wrote from memory to files."""
    while memory:
        key, buffer = memory.popitem()
        path = folder / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(buffer.to_bytes())


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
def _open_zarr(regions: Regions, outputs: Paths, temporaries: Paths) -> Iterator[Puts]:
    import zarr
    from zarr.storage import MemoryStore

    outlines = [Outline.of(region) for region in regions]
    _, beside, attributes = together(outlines)
    memory: dict[str, Any] = {}
    folder = temporaries[0]
    folder.mkdir()
    store = MemoryStore(memory)
    root = zarr.create_group(store=store, zarr_format=3, attributes=json_attributes(attributes))
    with warnings.catch_warnings():
        # types of texts are not yet in Zarr's specification
        warnings.simplefilter("ignore")
        for each in beside:
            add_beside(root, each)
    values = [_create_zarr(root, *each) for each in zip(regions, outlines, strict=True)]
    consolidate(store)
    flush(memory, folder)

    def put(outline: Outline, values: Any, step: int, frame: Frame) -> None:
        _put(outline, values, step, frame)
        flush(memory, folder)

    yield [partial(put, *each) for each in zip(outlines, values, strict=True)]


def _create_zarr(root: Any, region: Region, outline: Outline) -> Any:
    """Create the empty array of a variable; an integer that is no value is an attribute of it."""
    dtype, fill = region.dtype, region.fill
    attributes = json_attributes(outline.attributes)
    empty = np.nan if dtype.kind == "f" else 0
    if fill is not None and dtype.kind == "f":
        empty = dtype.type(fill)
    elif fill is not None:
        attributes[FILL] = int(fill)
    return root.create_array(
        outline.name,
        shape=outline.shape,
        dtype=dtype,
        chunks=outline.ordered(chunk_shape(region)),
        fill_value=empty,
        dimension_names=list(outline.dimensions),
        attributes=attributes,
        # a chunk that is missing is then always a fault, not a frame of fill values
        config={"write_empty_chunks": True},
    )


ZARR = Writer(name="Zarr", suffixes=(".zarr",), open=_open_zarr, directory=True, several=True)


@contextmanager
def _open_npy(regions: Regions, outputs: Paths, temporaries: Paths) -> Iterator[Puts]:
    (region,) = regions
    dtype = little_endian(region.dtype, half=True)
    descr = npy_format.dtype_to_descr(dtype)
    header = {"descr": descr, "fortran_order": False, "shape": region.shape}
    with temporaries[0].open("xb") as handle:
        npy_format.write_array_header_1_0(handle, header)
        yield [lambda step, frame: write_frame(handle, frame, dtype)]


NPY = Writer(name="NumPy", suffixes=(".npy",), open=_open_npy)


NRRD_TYPES = {"float32": "float", "float64": "double"}  # the integers are called as in numpy


def _raw_outputs(path: Path, region: Region) -> list[Path]:
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
    shape = tuple(layout.shape.get(axis, 1) for axis in AXES)
    if shape != region.shape or parse_dtype(layout.dtype) != region.dtype:
        t, z, y, x = region.shape
        raise InputError(
            f"{path}: the name says another layout than the values have; use"
            f" *_{x}x{y}x{z}x{t}_{region.dtype.name}.raw or a name that says none"
        )
    return [path]


@contextmanager
def _open_raw(regions: Regions, outputs: Paths, temporaries: Paths) -> Iterator[Puts]:
    from fhash_formats.readers.file_series import ENDIANS
    from fhash_formats.readers.images import layout_of_name

    (region,) = regions
    _, layout = layout_of_name(outputs[0].stem)
    dtype = little_endian(region.dtype)
    if layout.dtype is not None:
        dtype = region.dtype.newbyteorder(ENDIANS[layout.endian or "little"])
    with temporaries[0].open("xb") as handle:
        yield [lambda step, frame: write_frame(handle, frame, dtype)]
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
    ]
    steps = [even_spacing(region.coords[axis].values) for axis in "xyz"]
    if None not in steps:
        dx, dy, dz = steps
        directions = [f"({dx!r},0,0)", f"(0,{dy!r},0)", f"(0,0,{dz!r})"]
        origin = ",".join(repr(float(region.coords[axis].values[0])) for axis in "xyz")
        lines += [
            "space dimension: 3",
            f"space directions: {' '.join(directions + ['none'] * (len(axes) - 3))}",
            f"space origin: ({origin})",
        ]
    lines += ["endian: little", "encoding: raw"]
    if region.units:
        lines.append(f"sample units: {printable(region.units, ' ')}")
    lines.append(f"data file: {data_file}")
    for axis in AXES:
        coordinate = region.coords[axis]
        lines.append(f"name_{axis}:={printable(coordinate.name, ' ')}")
        for key in ("units", "calendar"):
            if key in coordinate.attributes:
                text = printable(str(coordinate.attributes[key]), " ")
                lines.append(f"{key}_{axis}:={text}")
        lines.append(f"coordinates_{axis}:={' '.join(map(repr, coordinate.values.tolist()))}")
    return "\n".join(lines) + "\n\n"


RAW = Writer(name="raw", suffixes=(".raw",), open=_open_raw, outputs=_raw_outputs)
