"""HDF5 files of any make, walked with h5py.

NetCDF files are HDF5 too, but have rules of their own (netcdf.py).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from fhash_formats.readers.common.failures import Stamp, refusing
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.hdf5_tree import (
    column,
    columns,
    datasets,
    files_beside,
    own_name,
    require_filters,
    require_sources,
    variables,
)
from fhash_formats.readers.common.positions import beside, coordinate, usable
from fhash_formats.readers.common.real_time import counts_steps
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes, role_of_coordinate, role_of_name
from fhash_formats.readers.common.variables import choose
from fhash_formats.series import Coordinate
from fhash_formats.support.attributes import json_attributes, plain_text, text_of

PACKED = {"scale_factor": 1, "add_offset": 0, "_FillValue": "NaN", "missing_value": "NaN"}
"""Attributes by which NetCDF files pack values, each with the value that changes nothing."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_hdf5(head: bytes) -> bool:
    """Whether the first bytes of a file are those of HDF5.

    A user block of 512, 1024 or 2048 bytes may precede the signature.
    """
    return any(
        head[offset : offset + len(SIGNATURE)] == SIGNATURE for offset in (0, 512, 1024, 2048)
    )


def matches(head: bytes, path: Path) -> bool:
    """Whether this is an HDF5 file."""
    return is_hdf5(head)


def open_hdf5(path: Path, request: Request) -> FileSeries:
    """Open the series in an HDF5 file: the only suitable dataset, or the one named.

    Coordinates are the dimension scales, else 1-D datasets of a conventional name beside the
    dataset or in the root. Values are as stored: fill values and packing have a meaning in NetCDF
    files only.
    """
    import h5py

    source, stamp = str(path), Stamp.of(path)
    with refusing(f"{source} cannot be read as HDF5"):
        file = h5py.File(path, "r")
    try:
        with refusing(f"{source} cannot be read as HDF5"):
            return _series(source, path, stamp, file, request)
    except BaseException:
        file.close()
        raise


def _series(source: str, path: Path, stamp: Stamp, file: Any, request: Request) -> FileSeries:
    tree = dict(datasets(file))
    var = own_name(file, tree, request.var) if request.var else None
    variable = choose(source, variables(tree), var, booleans=request.booleans)
    dataset = variable.handle
    require_filters(source, variable.name, dataset)
    require_sources(source, path, variable.name, dataset)
    _warn_of_packing(variable.name, dataset)
    scales = [_scale(dimension) for dimension in dataset.dims]
    names = [
        dimension.label or (scale[0] if scale else None)
        for dimension, scale in zip(dataset.dims, scales, strict=True)
    ]
    hints = [
        _hint(dimension.label, scale) for dimension, scale in zip(dataset.dims, scales, strict=True)
    ]
    axes = assign_axes(source, dataset.shape, hints, names, request.axes)
    certain = request.axes is not None or all(hint is not None for hint in hints)
    group = variable.name.rpartition("/")[0]
    places = [columns(tree, place) for place in dict.fromkeys([group, ""])]
    scaled = _scale_coordinates(source, axes, dataset.shape, scales)
    tied = [axis for axis, scale in zip(axes, scales, strict=True) if scale is not None]
    if "t" in scaled and counts_steps(scaled["t"].values) and "units" not in scaled["t"].attributes:
        tied.remove("t")  # numbers of steps: a time beside them comes first
    coords = beside(source, axes, dataset.shape, places, certain=certain, tied=tied)
    coords = {**scaled, **coords}
    return FileSeries(
        source=source,
        name=variable.name.rpartition("/")[2],
        shape=dataset.shape,
        dtype=dataset.dtype,
        axes=axes,
        fetch=lambda ranges: dataset[ranges],
        stamp=stamp,
        coords=coords,
        attributes=json_attributes(dataset.attrs),
        chunks=dataset.chunks,
        close=file.close,
        beside=files_beside(path, dataset),
    )


def _warn_of_packing(name: str, dataset: Any) -> None:
    """Warn that attributes which change the values of a NetCDF file change none here.

    The message names no path, so that it appears once for many files.
    """
    attributes = json_attributes(dataset.attrs)
    packing = [
        key
        for key, idle in PACKED.items()
        if key in attributes and attributes[key] not in (idle, [idle])
    ]
    if packing:
        plural = "s" if len(packing) > 1 else ""
        text = f"{plain_text(name)} has the attribute{plural} {', '.join(packing)}"
        warnings.warn(
            f"{text}; its values are read as they stand in HDF5, a file named .nc is unpacked",
            UserWarning,
            stacklevel=2,
        )


def _scale(dimension: Any) -> tuple[str, Any] | None:
    """Name and dataset of the dimension scale that was attached first; None without one."""
    if len(dimension) == 0:
        return None
    dataset = dimension[0]
    return dataset.name.rpartition("/")[2], dataset


def _hint(label: str, scale: tuple[str, Any] | None) -> str | None:
    if scale is not None:
        role = role_of_coordinate(scale[0], json_attributes(scale[1].attrs))
        if role is not None:
            return role
    return role_of_name(label) if label else None


def _scale_coordinates(
    source: str, axes: tuple[str, ...], shape: tuple[int, ...], scales: list[tuple[str, Any] | None]
) -> dict[str, Coordinate]:
    coords = {}
    for axis, length, scale in zip(axes, shape, scales, strict=True):
        # a NetCDF dimension without values is a scale too, and says so in its NAME
        if (
            scale is None
            or scale[1].shape != (length,)
            or not usable(scale[1].dtype)
            or _valueless(scale[1])
        ):
            continue
        values = column(*scale)
        coords[axis] = coordinate(source, values.name, values.read(), values.attributes)
    return coords


def _valueless(scale: Any) -> bool:
    return text_of(scale.attrs.get("NAME", "")).startswith(
        "This is a netCDF dimension but not a netCDF variable"
    )
