"""NetCDF files, read by the CF conventions with xarray.

Packing is undone, fill values become NaN, times stay numbers. NetCDF4 is HDF5 and goes through
h5netcdf, NetCDF3 ("classic") through scipy. Times are not decoded: float64 hours near 347921 tell
steps apart, calendars of models need no date, and `units` and `calendar` stay beside the numbers.
`valid_range` never hides a value, since it is wrong in files that are in use.
"""

from __future__ import annotations

import gc
import importlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.common.cf_packing import packing
from fhash_formats.readers.common.failures import Stamp, condense, refusing
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.hdf5_tree import require_filters
from fhash_formats.readers.common.positions import Column, beside, coordinate, usable
from fhash_formats.readers.common.real_time import real_time
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes, role_of_coordinate, role_of_name
from fhash_formats.readers.common.variables import Variable, choose
from fhash_formats.readers.hdf5 import is_hdf5
from fhash_formats.series import AXES, Coordinate
from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes, text_of

if TYPE_CHECKING:
    import xarray as xr

Values = npt.NDArray[Any]
Exact = Callable[[Values, tuple[slice, ...]], Values]

SUFFIXES = (".nc", ".nc4", ".netcdf", ".cdf")
CLASSIC = (b"CDF\x01", b"CDF\x02")
MADE_UP = "phony_dim_"
"""Prefix of the names that xarray makes up for dimensions without one."""

CLASSIC_64 = b"CDF\x05"


def matches(head: bytes, path: Path) -> bool:
    """Whether this is NetCDF: classic, or an HDF5 file that claims to be NetCDF.

    It claims so by its suffix, by `_NCProperties` or by CF `Conventions`.
    """
    return head[:4] in (*CLASSIC, CLASSIC_64) or (
        is_hdf5(head) and (_says_netcdf(path) or path.suffix.lower() in SUFFIXES)
    )


def _says_netcdf(path: Path) -> bool:
    """Whether an HDF5 file claims to be NetCDF; raises InputError if it cannot be opened."""
    import h5py

    with refusing(f"{path} cannot be read as HDF5"), h5py.File(path, "r") as file:
        return "_NCProperties" in file.attrs or text_of(
            file.attrs.get("Conventions", "")
        ).strip().upper().startswith("CF-")


def open_netcdf(path: Path, request: Request) -> FileSeries:
    """Open the series in a NetCDF file: the only suitable variable of any group, or a named one."""
    source, stamp = str(path), Stamp.of(path)
    with path.open("rb") as file:
        head = file.read(4)
    with _quietly(), refusing(f"{source} cannot be read as NetCDF"):
        groups = _open_groups(source, path, head)
        try:
            return _series(source, path, stamp, groups, request)
        except BaseException:
            _close(groups)
            raise


@contextmanager
def _quietly() -> Iterator[None]:
    """Silence xarray's warnings about a file (several fill values, bounds that are missing).

    None of them changes the values that are read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _open_groups(source: str, path: Path, head: bytes) -> Mapping[str, xr.Dataset]:
    """Datasets of all groups by path, "/" first."""
    if head == CLASSIC_64:
        raise InputError(
            f"{source} is NetCDF of the kind CDF-5, which cannot be read here; convert it with:"
            " nccopy -k nc4 IN OUT"
        )
    try:
        import xarray as xr
    except ImportError as error:
        raise MissingDependencyError(
            f"{source}: NetCDF needs xarray and h5netcdf; pip install 'fhash[formats]'"
        ) from error
    options: dict[str, Any] = {
        "decode_times": False,
        "decode_timedelta": False,
        "decode_coords": "all",
        "cache": False,
        "chunks": None,
    }
    if head in CLASSIC:
        try:
            importlib.import_module("scipy")
        except ImportError as error:
            advice = "pip install scipy, or convert it with: nccopy -k nc4 IN OUT"
            raise InputError(f"{source} is classic NetCDF3, which needs scipy; {advice}") from error
        return {"/": _open_classic(source, path, options)}
    try:
        importlib.import_module("h5netcdf")
    except ImportError as error:
        raise MissingDependencyError(
            f"{source}: NetCDF4 needs h5netcdf; pip install 'fhash[formats]'"
        ) from error
    # dimensions without a scale get a made-up name, so that HDF5 files named .nc open too
    return xr.open_groups(path, engine="h5netcdf", phony_dims="access", **options)


def _open_classic(source: str, path: Path, options: Mapping[str, Any]) -> xr.Dataset:
    import xarray as xr

    try:
        return xr.open_dataset(path, engine="scipy", **options)
    except Exception as error:
        message = condense(error)
    # the error is not chained: its traceback holds scipy's half-open file, which warns when it is
    # dropped, and here nobody hears that
    gc.collect()
    raise InputError(
        f"{source} cannot be read as classic NetCDF3: {message}; nccopy -k nc4 IN OUT may convert"
        " it"
    )


def _close(groups: Mapping[str, xr.Dataset]) -> None:
    with _quietly():
        for dataset in groups.values():
            dataset.close()


def _series(
    source: str, path: Path, stamp: Stamp, groups: Mapping[str, xr.Dataset], request: Request
) -> FileSeries:
    variables = [
        Variable(
            name=f"{group}/{name}".lstrip("/"),
            shape=array.shape,
            dtype=array.dtype,
            auxiliary=name in dataset.coords,
            handle=(group, name),
        )
        for group, dataset in groups.items()
        for name, array in ((str(name), array) for name, array in dataset.variables.items())
    ]
    variable = choose(source, variables, request.var, booleans=request.booleans)
    group, name = variable.handle
    array = groups[group].variables[name]
    _check_filters(source, path, variable.name)
    scope = [groups[place] for place in _upwards(group) if place in groups]
    dimensions = [str(dimension) for dimension in array.dims]
    hints = [_role(dimension, scope) for dimension in dimensions]
    axes = assign_axes(source, array.shape, hints, dimensions, request.axes)

    exact = _exactly_filled(source, path, variable.name, array.encoding)

    def fetch(ranges: tuple[slice, ...]) -> Any:
        with _quietly():
            values = array[ranges].to_numpy()
            return values if exact is None else exact(values, ranges)

    return FileSeries(
        source=source,
        name=name,
        shape=array.shape,
        dtype=array.dtype,
        axes=axes,
        fetch=fetch,
        stamp=stamp,
        coords=_coordinates(
            source,
            axes,
            dimensions,
            array.shape,
            scope,
            groups[group][name],
            request.axes is not None,
        ),
        attributes=json_attributes(array.attrs, without=PLUMBING | PACKING),
        chunks=array.encoding.get("chunksizes"),
        close=lambda: _close(groups),
    )


def _exactly_filled(
    source: str, path: Path, name: str, encoding: Mapping[str, Any]
) -> Exact | None:
    """A test that tells a fill value from its neighbours; None where float64 suffices.

    xarray compares as float64, in which many 64-bit integers beyond 2^53 are equal.
    """
    import h5py

    stored = np.dtype(encoding.get("dtype", np.float32))
    if stored.kind not in "iu" or stored.itemsize < 8:
        return None
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in encoding.items()
    }
    packed = packing(source, stored, plain)
    if all(abs(int(fill)) < 1 << 53 for fill in packed.fills):
        return None

    def exact(values: Values, ranges: tuple[slice, ...]) -> Values:
        if not np.isnan(values).any():
            return values
        with h5py.File(path, "r") as file:
            return packed.unpack(np.asarray(file[name][ranges]))

    return exact


def _check_filters(source: str, path: Path, name: str) -> None:
    import h5py

    if not h5py.is_hdf5(path):
        return
    with h5py.File(path, "r") as file:
        dataset = file.get(name)
        if isinstance(dataset, h5py.Dataset):
            require_filters(source, name, dataset)


def _upwards(group: str) -> list[str]:
    """Path of a group and of the groups around it, the root last.

    NetCDF4 groups inherit dimensions and coordinates from those around them.
    """
    parts = [part for part in group.split("/") if part]
    return ["/" + "/".join(parts[:count]) for count in range(len(parts), -1, -1)]


def _along(dimension: str, scope: Sequence[xr.Dataset]) -> Iterator[tuple[str, xr.Variable]]:
    """Number variables along one dimension alone: its namesake, then coordinates, then the rest.

    A made-up dimension has none: xarray shares those by length, and a length has no meaning.
    """
    if dimension.startswith(MADE_UP):
        return
    for rank in ("named", "coordinate", "other"):
        for dataset in scope:
            for key, array in dataset.variables.items():
                kind = (
                    "named"
                    if key == dimension
                    else "coordinate"
                    if key in dataset.coords
                    else "other"
                )
                if kind == rank and array.dims == (dimension,) and usable(array.dtype):
                    yield str(key), array


def _role(dimension: str, scope: Sequence[xr.Dataset]) -> str | None:
    for name, array in _along(dimension, scope):
        role = role_of_coordinate(name, array.attrs)
        if role is not None:
            return role
    return role_of_name(dimension)


def _columns(dataset: xr.Dataset) -> dict[str, Column]:
    """Variables of a dataset that may be coordinates, by lower-case name."""
    arrays = [
        (str(key), array)
        for key, array in dataset.variables.items()
        if array.ndim < 2 and usable(array.dtype)
    ]
    return {
        key.lower(): Column(
            name=key, length=array.size, read=array.to_numpy, attributes=array.attrs
        )
        for key, array in arrays
    }


def _coordinates(
    source: str,
    axes: Sequence[str],
    dimensions: Sequence[str],
    shape: Sequence[int],
    scope: Sequence[xr.Dataset],
    values: xr.DataArray,
    certain: bool,
) -> dict[str, Coordinate]:
    """Coordinate of each dimension: its namesake, else one along it whose CF role is its axis.

    Axes that the variable lacks take scalar coordinates. Where the file names no dimension,
    coordinates go by conventional names, as in any HDF5 file.
    """
    if all(dimension.startswith(MADE_UP) for dimension in dimensions):
        return beside(
            source, axes, shape, [_columns(dataset) for dataset in scope], certain=certain
        )
    coords = {}
    for axis, dimension, length in zip(axes, dimensions, shape, strict=True):
        along = [
            Column(name=name, length=length, read=array.to_numpy, attributes=array.attrs)
            for name, array in _along(dimension, scope)
            if array.shape == (length,)
        ]
        named = next((column for column in along if column.name == dimension), None)
        others = [column for column in along if column is not named]
        roles = (each for each in others if role_of_coordinate(each.name, each.attributes) == axis)
        found = real_time(named, others) if axis == "t" else named
        found = found or next(roles, None)
        if found is not None:
            coords[axis] = coordinate(source, found.name, found.read(), found.attributes)
    for key, scalar in values.coords.items():
        role = role_of_coordinate(str(key), scalar.attrs)
        if (
            scalar.ndim == 0
            and usable(scalar.dtype)
            and role in AXES
            and role not in axes
            and role not in coords
        ):
            coords[role] = coordinate(source, str(key), scalar.to_numpy(), scalar.attrs)
    return coords
