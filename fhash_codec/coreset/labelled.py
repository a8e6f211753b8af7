"""Labelled arrays as series: `DataArray` and `Dataset` of xarray, whatever they were opened from.

This is the way in for everything that xarray opens: GRIB, OPeNDAP, Icechunk, files in a cloud.
Frames are computed one by one, or chunk by chunk of a dask array (lazy.py), so that a lazy array is
never held as a whole. What belongs to the
variable is taken as xarray would write it to a file.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.lazy import DaskSeries, LazyFrames, is_lazy
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.common.cf_packing import packing
from fhash_formats.readers.common.layout import Dimension, must_select
from fhash_formats.readers.common.netcdf_surroundings import stored_variable
from fhash_formats.readers.common.roles import assign_axes, role_of_coordinate
from fhash_formats.readers.common.stored_parts import labelled_parts
from fhash_formats.readers.common.surroundings import Stored, Wanted, surroundings
from fhash_formats.readers.common.variables import MAX_LISTED, MIN_DIMENSIONS
from fhash_formats.series import (
    AXES,
    ArraySeries,
    Coordinate,
    NotStored,
    Series,
    check_coords,
    check_values,
    index_coordinate,
    warn_not_stored,
)
from fhash_formats.source_metadata import COORDINATES, NAMING, SourceMetadata, plain_form
from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["LabelledSeries", "array_series", "labelled_series"]

OF_FILE = (*NAMING, *sorted(PACKING - {"dtype"}))
"""Keys of `encoding` that are attributes in a file."""


def array_series(source: Any) -> Series:
    """The series of an array, labelled or not, or of a Dataset; see `labelled_series`.

    Without labels, or with fewer than three dimensions, axes are (t, z, y, x) or (z, y, x).
    """
    if getattr(source, "data_vars", None) is not None:
        return labelled_series(source)
    dims, labels = getattr(source, "dims", None), getattr(source, "coords", None)
    if dims is None or labels is None or len(dims) < MIN_DIMENSIONS:
        return DaskSeries(source) if is_lazy(source) else ArraySeries(source)
    return labelled_series(source)


def labelled_series(source: xr.DataArray | xr.Dataset, variable: Hashable = None) -> Series:
    """The series of a labelled array, or of a variable of a Dataset.

    The axes are what the names and attributes of its dimensions say, else (t, z, y, x) in this
    order.

    variable: of a Dataset; by default the only one that can be encoded. Raises InputError for no
    such variable, several of them, and for dimensions that are no axes.
    """
    if getattr(source, "data_vars", None) is None:
        array: Any = source
        return LabelledSeries(array, array.coords.to_dataset())
    dataset: Any = source
    if variable is None:
        variable = _only(dataset)
    if variable not in dataset.variables:
        raise InputError(f"the dataset has no variable '{variable}'; it has {_listed(dataset)}")
    return LabelledSeries(dataset[variable], dataset)


def _only(dataset: xr.Dataset) -> Hashable:
    """The only variable of a dataset that can be encoded; raises InputError otherwise."""
    bounds = {array.attrs.get("bounds") for array in dataset.variables.values()}
    fitting = [
        name
        for name, array in dataset.data_vars.items()
        if array.ndim >= MIN_DIMENSIONS and array.dtype.kind in "iuf" and name not in bounds
    ]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise InputError(
            f"the dataset has no variable of {MIN_DIMENSIONS} or more dimensions; it has"
            f" {_listed(dataset)}"
        )
    names = ", ".join(map(str, fitting[:MAX_LISTED]))
    raise InputError(
        f"the dataset has {len(fitting)} variables that can be encoded: {names}; choose one, such"
        f" as dataset['{fitting[0]}']"
    )


def _listed(dataset: xr.Dataset) -> str:
    return ", ".join(map(str, list(dataset.data_vars)[:MAX_LISTED])) or "none"


class LabelledSeries(Series):
    """A labelled array, read frame by frame.

    array: the DataArray. beside: a Dataset with all that its attributes may name.

    Attributes:
        lazy: frames of an array of dask; None for others.
    """

    def __init__(self, array: Any, beside: Any) -> None:
        self.source, self.name = "array", str(array.name or "values")
        names = [str(dim) for dim in array.dims]
        self._axes = _axes(self.name, names, array.shape, array.coords)
        self._array = array
        lengths = dict(zip(self._axes, array.shape, strict=True))
        self.shape = check_values(self.source, [lengths.get(axis, 1) for axis in AXES], array.dtype)
        self.dtype = array.dtype.newbyteorder("=")
        self.coords = {
            axis: index_coordinate(axis, length)
            for axis, length in zip(AXES, self.shape, strict=True)
        } | {
            axis: _coordinate(plain_form(str(dim)), array.coords[dim])
            for axis, dim in zip(self._axes, array.dims, strict=True)
            if dim in array.coords and array.coords[dim].dtype.kind in "iufMO"
        }
        check_coords(self.source, self.coords, self.shape)
        self.attributes = json_attributes(array.attrs, without=PLUMBING | PACKING)
        self.units = str(self.attributes.get("units", ""))
        self.metadata = lambda: self._metadata_of(beside)
        self.lazy = LazyFrames(self._in_order(array)) if is_lazy(array) else None
        self.not_stored = self._never_stored()
        warn_not_stored(self)

    def _never_stored(self) -> NotStored | None:
        """Values behind the array that nobody wrote, as far as xarray shows them."""
        variable = self._array.variable
        parts, key = labelled_parts(self.source, variable)
        if parts is None:
            return None
        lengths = [int(borders[-1]) for borders in parts.edges]
        chosen = {place: np.arange(lengths[place])[each] for place, each in key.items()}
        # an index that is a number takes its dimension away
        left = [n for n in range(len(lengths)) if not isinstance(key.get(n), int | np.integer)]
        if len(left) != len(self._axes):
            return None
        time = left[self._axes.index("t")] if "t" in self._axes else None
        shares = 1 - parts.along(time, chosen)
        told = variable.encoding
        stored = np.dtype(told.get("dtype", variable.dtype))
        fill = np.array([parts.fill])
        if stored.kind in "iuf":
            packed = packing(
                self.source, stored, {key: told[key] for key in OF_FILE if key in told}
            )
            fill = packed.unpack(fill.astype(stored))
        if not shares.any() or fill[0] != fill[0]:
            return None
        return NotStored(shares=shares, fill=fill[0].item())

    def _in_order(self, array: Any) -> Any:
        """The dask array of a labelled one, as (t, z, y, x)."""
        known = dict(zip(self._axes, array.dims, strict=True))
        ordered = array.transpose(*(known[axis] for axis in AXES if axis in known)).data
        return ordered[tuple(slice(None) if axis in known else None for axis in AXES)]

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        if self.lazy is not None:
            return np.ascontiguousarray(self.lazy.read(step), dtype=self.dtype)
        at = {
            dim: step for dim, axis in zip(self._array.dims, self._axes, strict=True) if axis == "t"
        }
        values = np.asarray(self._array.isel(at).values)
        space = [axis for axis in self._axes if axis != "t"]
        ordered = values.transpose([space.index(axis) for axis in AXES if axis in space])
        return np.ascontiguousarray(ordered.reshape(self.shape[1:]), dtype=self.dtype)

    def _metadata_of(self, beside: Any) -> SourceMetadata:
        array, name = self._array, self.name
        failed: dict[str, str] = {}
        variables = {
            str(key): stored for key, stored in _encoded(beside, failed) if key != array.name
        }
        attributes = dict(array.attrs)
        attributes |= {key: array.encoding[key] for key in OF_FILE if key in array.encoding}
        listed = str(array.encoding.get(COORDINATES, "")).split()
        if kept := " ".join(each for each in listed if each in variables):
            attributes[COORDINATES] = kept
        coordinates = [str(key) for key in array.coords]
        variables[name] = Stored(
            dimensions=tuple(map(str, array.dims)),
            shape=array.shape,
            dtype=array.dtype,
            attributes=attributes,
            read=lambda places: np.empty(0),
        )
        if failed:
            told = ", ".join(f"{key} ({why})" for key, why in failed.items())
            warnings.warn(
                f"array '{name}': not everything beside it is kept: {told}",
                FhashWarning,
                stacklevel=2,
            )
        stored = np.dtype(array.encoding.get("dtype", array.dtype))
        wanted = Wanted(
            source=f"array '{name}'",
            name=name,
            dimensions=dict(zip(map(str, array.dims), self._axes, strict=True)),
            picked={},
            coordinates=coordinates,
            stored=stored.name if stored != array.dtype and stored.kind in "iuf" else None,
        )
        of_file = {key: value for key, value in beside.attrs.items() if key != COORDINATES}
        return surroundings(wanted, variables, of_file)


def _encoded(dataset: Any, failed: dict[str, str]) -> Iterator[tuple[Any, Stored]]:
    """The variables of a dataset as they stand in a file; those that cannot are noted."""
    for name, array in dataset.variables.items():
        try:
            yield name, _stored(name, array)
        except Exception as error:  # indices of several levels, and objects of all kinds
            failed[str(name)] = str(error).split("\n", 1)[0][:80]


def _stored(name: Any, array: Any) -> Stored:
    """A variable as xarray would write it; numbers stay unpacked, and are not read."""
    import xarray as xr

    plain = array.to_base_variable()
    if plain.dtype.kind not in "iuf":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of types, which are as good as another here
            return stored_variable(xr.conventions.encode_cf_variable(plain, name=name))
    stored = stored_variable(plain)
    named = {key: plain.encoding[key] for key in NAMING if key in plain.encoding}
    return replace(stored, attributes={**stored.attributes, **named})


def _axes(name: str, dims: list[str], shape: tuple[int, ...], labels: Any) -> tuple[str, ...]:
    """The axis of each dimension of a labelled array; raises InputError where it has others."""
    roles = [role_of_coordinate(dim, labels[dim].attrs if dim in labels else {}) for dim in dims]
    if not any(roles) and len(dims) <= len(AXES):
        return AXES[-len(dims) :]
    known = [
        Dimension(name=dim, length=length, role=role)
        for dim, length, role in zip(dims, shape, roles, strict=True)
    ]
    open_dims = [dims[place] for place in must_select(known, {})]
    if open_dims:
        choice = ", ".join(f"{dim}=0" for dim in open_dims)
        raise InputError(
            f"array '{name}' has the dimensions {', '.join(dims)}, and a series only t, z, y and"
            f" x; select one index of the others, such as array.isel({choice})"
        )
    return assign_axes(f"array '{name}'", shape, roles, dims, None)


def _coordinate(name: str, label: Any) -> Coordinate:
    """The coordinate of a labelled axis.

    Dates are counted as the file that they come from counted them; else they become seconds since
    1970. Labels that are no dates leave the index.
    """
    values, attributes = np.asarray(label), json_attributes(label.attrs)
    if values.dtype.kind == "O" or (values.dtype.kind == "M" and "units" in label.encoding):
        try:
            stored = _stored(name, label.variable)
        except (NotImplementedError, TypeError, ValueError):  # objects of all kinds
            stored = None
        if stored is None or stored.dtype.kind not in "iuf":
            return replace(index_coordinate("t", values.size), name=name)
        values, attributes = stored.read((slice(None),)), json_attributes(stored.attributes)
    elif values.dtype.kind == "M":
        values = (values - np.datetime64(0, "s")) / np.timedelta64(1, "s")
        attributes = {"units": "seconds since 1970-01-01", "calendar": "proleptic_gregorian"}
    return Coordinate(name=name, values=values.astype(np.float64), attributes=attributes)
