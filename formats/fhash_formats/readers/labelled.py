"""Arrays in memory as sources: xarray's objects, and arrays of dask; by xarray URLs and GRIB."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.file_series import (
    HEAD_BYTES,
    FileSeries,
    Request,
    Stamp,
    UrlStamp,
    condense,
    library,
    naming,
    refusing,
)
from fhash_formats.readers.hdf5 import NETCDF_SUFFIXES, default_fill, says_netcdf
from fhash_formats.readers.layout import Read, must_select, single
from fhash_formats.readers.listing import Listed
from fhash_formats.readers.netcdf3 import matches as is_classic
from fhash_formats.readers.select import Selection
from fhash_formats.readers.stored_parts import labelled_parts, require_alone
from fhash_formats.readers.variables import (
    FIELD_DIMENSIONS,
    MAX_LISTED,
    MIN_DIMENSIONS,
    Behind,
    Source,
    Variable,
    file_source,
)
from fhash_formats.series import (
    AXES,
    COORDINATES,
    NAMING,
    ArraySeries,
    Series,
    references,
    warn_not_stored,
)
from fhash_formats.support.dates import clock
from fhash_formats.support.files import file_name, is_url, object_store, without_secrets
from fhash_formats.support.values import PACKING, as_array, is_lazy

if TYPE_CHECKING:
    import xarray as xr

OF_FILE = (COORDINATES, *NAMING, *sorted(PACKING - {"dtype"}))
"""Keys of `encoding` that are attributes in a file."""
FILL = "_FillValue"
SINCE_1970 = "seconds since 1970-01-01"
"""Units of dates that no file has counted."""


def array_series(source: Any) -> Series:
    """The series of an array, labelled or not, or of a Dataset; see `labelled_series`.

    Without labels, or with fewer than three dimensions, axes are (t, z, y, x) or (z, y, x).
    """
    if getattr(source, "data_vars", None) is not None:
        return labelled_series(source)
    dims, labels = getattr(source, "dims", None), getattr(source, "coords", None)
    if dims is None or labels is None or len(dims) < MIN_DIMENSIONS:
        return _dask_series(source) if is_lazy(source) else ArraySeries(source)
    return labelled_series(source)


def _dask_series(array: Any) -> FileSeries:
    """The series of an array of dask (t, z, y, x) or (z, y, x) without labels.

    Raises InputError for one that cannot be a series.
    """
    _require_lengths(array)
    labels = ArraySeries(np.broadcast_to(np.zeros((), array.dtype), array.shape))  # of no memory
    whole = Variable(
        name=labels.name,
        shape=array.shape,
        dtype=array.dtype,
        read=lambda places: as_array(array[places]),
        chunks=array.chunks,
    )
    source = Source(name=labels.source, variables=[whole])
    series = Selection(source, Request(asked=False)).series()
    series.lazy = array if array.ndim == len(AXES) else array[None]
    return series


def _require_lengths(array: Any) -> None:
    """Raise InputError for a dask array with lengths that are not known before it is computed."""
    if any(length != length for length in array.shape):
        raise InputError(
            f"the dask array has shape {array.shape}; compute_chunk_sizes() finds the lengths"
        )


def labelled_series(source: xr.DataArray | xr.Dataset, variable: Hashable = None) -> FileSeries:
    """The series of a labelled array, or of a variable of a Dataset.

    It is that of the file which it was opened from, where nothing was computed since.

    variable: of a Dataset; by default the only one that can be encoded. Raises InputError for no
    such variable, several of them, and for dimensions that are no axes. Warns (FhashWarning) of
    what `open_series` warns of.
    """
    if getattr(source, "data_vars", None) is None:
        array: Any = source
        beside: Any = array.coords.to_dataset()
    else:
        beside = source
        variable = _only(beside) if variable is None else variable
        if variable not in beside.variables:
            raise InputError(f"the dataset has no variable '{variable}'; it has {_listed(beside)}")
        array = beside[variable]
    opened = _source(array, beside, str(array.name or "values"))
    found = Selection(opened, Request(asked=False, var=opened.only))
    own = found.choose()
    dimensions = found.dimensions(own)
    open_dims = [
        dimensions[place].name for place in must_select(dimensions, single(dimensions, {}))
    ]
    if open_dims:
        choice = ", ".join(f"{dim}=0" for dim in open_dims)
        raise InputError(
            f"{opened.name} has the dimensions {', '.join(map(str, array.dims))}, and a series"
            f" only t, z, y and x; select one index of the others, such as array.isel({choice})"
        )
    layout = found.arrange(own)
    series = found.series_of(own, layout)
    if is_lazy(array):
        kept = array.isel({array.dims[n]: at for n, at in layout.picked.items()})
        known = dict(zip(layout.axes, kept.dims, strict=True))
        ordered = kept.transpose(*(known[axis] for axis in AXES if axis in known)).data
        series.lazy = ordered[tuple(slice(None) if axis in known else None for axis in AXES)]
    if series.remark:
        warnings.warn(f"{opened.name}: {series.remark}", FhashWarning, stacklevel=3)
    warn_not_stored(series)
    return series


def list_dataset(dataset: xr.Dataset) -> list[Listed]:
    """The variables of a Dataset in its order, as `list_variables` gives those of a file."""
    order = [str(name) for name in dataset.data_vars]
    if not order:
        return []
    opened = replace(_source(dataset[order[0]], dataset, order[0]), only="", name="the dataset")
    found = {each.name: each for each in Selection(opened, Request(asked=False)).listed()}
    return [found[name] for name in order if name in found]


def _only(dataset: xr.Dataset) -> Hashable:
    """The only variable of a dataset that can be encoded; raises InputError otherwise."""
    bounds = {array.attrs.get("bounds") for array in dataset.variables.values()}
    found = {
        name: array.ndim
        for name, array in dataset.data_vars.items()
        if array.ndim >= MIN_DIMENSIONS and array.dtype.kind in "iuf" and name not in bounds
    }
    fitting = [name for name, count in found.items() if count >= FIELD_DIMENSIONS] or [*found]
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


def _source(array: Any, beside: Any, name: str) -> Source:
    """A labelled array and all beside it as the file has or would have them.

    Nothing is read. Values are those that xarray gives; all others are as they are stored.
    """
    failed: dict[str, str] = {}
    origin = _origin(array, beside)
    stored: dict[str, Variable] = {}
    for key, each in beside.variables.items():
        if key != array.name:
            try:
                stored[str(key)] = _stored(str(key), each, auxiliary=key in beside.coords)
            except Exception as error:  # indices of several levels, and objects of all kinds
                failed[str(key)] = condense(error)
    stored |= _bounds(stored, beside.variables)
    own = array.variable
    dtype = np.dtype(own.encoding.get("dtype", own.dtype))
    packed = own.dtype.kind in "iuf" and dtype.kind in "iuf"
    stored[name] = Variable(
        name=name,
        flat=True,
        shape=own.shape,
        dtype=dtype if packed else own.dtype,
        values=own.dtype.newbyteorder("="),
        dimensions=tuple(map(str, array.dims)),
        attributes=_attributes(own),
        read=lambda places: as_array(own[places], f"array '{name}'"),
        chunks=own.chunks or own.encoding.get("chunksizes"),
        behind=lambda: _behind(own),
        unlimited=sorted(map(str, beside.encoding.get("unlimited_dims") or ())),
        handle=own.encoding,
    )
    naming = {
        other
        for each in stored.values()
        for key, other in references(each.attributes)
        if key != COORDINATES
    }
    return Source(
        name=f"array '{name}'",
        path=origin,
        variables=list(stored.values()),
        groups={"": {key: value for key, value in beside.attrs.items() if key != COORDINATES}},
        naming=True,
        only=name,
        # a coordinate is what the dataset calls so, unless it is named in another way
        coordinates=[key for key in map(str, array.coords) if key not in naming],
        computed=origin is None,
        left_out=failed,
        default_fill=default_fill if _is_netcdf(origin) else lambda dtype: None,
    )


def _is_netcdf(path: Path | None) -> bool:
    """Whether a file is one whose library has default fill values."""
    if path is None or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return is_classic(head, path) or says_netcdf(head, path)


def _stored(name: str, array: Any, *, auxiliary: bool) -> Variable:
    """A variable as it stands in a file; numbers are packed when they are read."""
    numbers = array.dtype.kind in "iuf"
    made = array if numbers else _encoded(name, array)
    return Variable(
        name=name,
        flat=True,
        shape=made.shape,
        dtype=np.dtype(made.encoding.get("dtype", made.dtype)) if numbers else made.dtype,
        dimensions=tuple(map(str, made.dims)),
        attributes=_attributes(made) if numbers else dict(made.attrs),
        read=(
            (lambda places: as_array(_encoded(name, made[places])))
            if numbers
            else (lambda places: made[places].to_numpy())
        ),
        auxiliary=auxiliary,
    )


def _behind(own: Any) -> Behind:
    """Stored parts of the array behind a variable, as far as xarray shows them."""
    parts, key = labelled_parts("array", own)
    if parts is None:
        return Behind()
    taken = parts.taken(key)
    return Behind(parts=taken if taken.share.ndim == own.ndim else None)


def _encoded(name: str, array: Any) -> Any:
    """A variable as xarray writes it to a file, and as the file that it comes from has it."""
    import xarray as xr

    plain = array.to_base_variable()
    encoding = {**plain.encoding}
    if FILL not in encoding and FILL not in plain.attrs:
        encoding[FILL] = None  # xarray adds one
    if plain.dtype.kind == "M" and "units" not in encoding:
        encoding |= {"units": SINCE_1970, "calendar": "proleptic_gregorian", "dtype": "float64"}
    plain.encoding = encoding
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of types, which are as good as another here
        encoded = xr.conventions.encode_cf_variable(plain, name=name)
        if encoded.dtype.kind == "S" and "char_dim_name" in encoding:
            coder: Any = xr.coding.strings.CharacterArrayCoder()
            encoded = coder.encode(encoded, name=name)
    encoded.attrs = {key: value for key, value in encoded.attrs.items() if value is not None}
    _as_written(encoded, encoding)
    return encoded


def _as_written(encoded: Any, encoding: Mapping[str, Any]) -> None:
    """Give dates the units and the calendar that their file has, where these mean the same."""
    units, now = encoding.get("units"), clock(encoded.attrs)
    if now is None or units is None or encoded.dtype.kind not in "iuf" or not encoded.size:
        return
    then = clock({"units": units, "calendar": encoded.attrs.get("calendar")})
    if then == now:
        encoded.attrs["units"] = units
    # the calendars of the world differ before 1582 alone
    usual = clock({"units": units})
    since = usual is not None and usual.epoch == now.epoch and usual.unit == now.unit
    if "calendar" not in encoding and since and np.nanmin(encoded.values) >= 0:
        encoded.attrs.pop("calendar", None)


def _bounds(stored: Mapping[str, Variable], arrays: Mapping[str, Any]) -> dict[str, Variable]:
    """Bounds of dates without the units and the calendar that decoding copied to them."""
    found = {}
    for each in stored.values():
        name = str(each.attributes.get("bounds"))
        if name in stored and arrays[name].dtype.kind in "MO":
            own = stored[name].attributes.items()
            kept = {key: value for key, value in own if each.attributes.get(key) != value}
            found[name] = replace(stored[name], attributes=kept)
    return found


def _attributes(array: Any) -> dict[str, Any]:
    """The attributes that a variable of numbers has in a file."""
    encoding = {key: array.encoding.get(key) for key in OF_FILE}
    found = {**array.attrs, **{key: each for key, each in encoding.items() if each is not None}}
    dtype = np.dtype(array.encoding.get("dtype", array.dtype))
    if isinstance(found.get(FILL), int | float) and dtype.kind in "iuf":
        found[FILL] = dtype.type(found[FILL])  # of Zarr, which has no types of attributes
    return found


def _origin(array: Any, beside: Any) -> Path | None:
    """The file that an array comes from; None for one in memory or one that was computed.

    Arrays that xarray computes have no encoding, although their dataset keeps its own.
    """
    place = array.encoding and array.encoding.get("source", beside.encoding.get("source"))
    if not isinstance(place, str) or array.variable._in_memory or not Path(place).exists():
        return None
    return Path(place)


DATA_SUFFIXES = (".zarr", ".nc", ".nc4", ".cdf", ".h5", ".hdf5", ".he5")
"""Suffixes of data that are read where they lie; other URLs are those of containers."""


BLOCK = 1 << 18
"""Bytes that are asked for at once of a file elsewhere."""


def is_data_url(place: object) -> bool:
    """Whether a place is the URL of a Zarr store, or of a file of NetCDF or HDF5."""
    return is_url(place) and Path(file_name(str(place))).suffix.lower() in DATA_SUFFIXES


def _told(files: Any, inside: str) -> Mapping[str, Any]:
    """The answer of a store about a file now, not a cached one."""
    if hasattr(files, "invalidate_cache"):
        files.invalidate_cache(inside)
    found: Mapping[str, Any] = files.info(inside)
    return found


def open_url(url: str, request: Request) -> Source:
    """A Zarr store, or a file of NetCDF-4 or HDF5, elsewhere; values are fetched as they are read.

    xarray opens its uppermost group, by obstore where that is installed, else by fsspec: keys and
    secrets are those of their environment. Raises MissingDependencyError without either, and
    InputError for what cannot be opened, and for a URL of other data.
    """
    if not is_data_url(url):
        raise InputError(
            f"{without_secrets(url)}: data at a URL are a Zarr store or a file of NetCDF-4 or HDF5,"
            f" with one of the suffixes {', '.join(DATA_SUFFIXES)}; others are to be downloaded"
        )
    xr = library(url, "a URL", "xarray", "fhash[remote]")
    wishes = {"decode_cf": False, "cache": False, "chunks": None}
    place, shown, slow = url.split("?")[0].rstrip("/"), without_secrets(url), None
    suffix = Path(file_name(url)).suffix.lower()
    fsspec = library(url, "a URL", "fsspec", "fhash[remote]")
    files = object_store(url)
    with refusing(f"{shown} cannot be read"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a store without consolidated metadata
        if suffix == ".zarr":
            stored: Any = url
            if files is not None:
                store = import_module("obstore.store").from_url(place)
                stored = import_module("zarr.storage").ObjectStore(store, read_only=True)
            dataset = xr.open_dataset(stored, engine="zarr", **wishes)
        else:
            # blocks, since HDF5 reads few bytes here and there
            if files is not None:
                inside, stored = place, files.open(place, buffer_size=BLOCK)
            else:
                files, inside = fsspec.core.url_to_fs(url)
                stored = files.open(inside, cache_type="blockcache", block_size=BLOCK)
            slow = UrlStamp.at(shown, partial(_told, files, inside))
            if request.no_external:
                require_alone(shown, stored)
            dataset = xr.open_dataset(stored, engine="h5netcdf", phony_dims="sort", **wishes)

    def reader(array: Any) -> Read:
        return lambda places: as_array(array[places])

    unlimited = sorted(map(str, dataset.encoding.get("unlimited_dims") or ()))
    variables = [
        Variable(
            name=str(key),
            flat=True,
            shape=each.shape,
            dtype=each.dtype,
            dimensions=tuple(map(str, each.dims)),
            attributes=each.attrs,
            read=reader(each),
            chunks=each.encoding.get("chunks") or each.encoding.get("chunksizes"),
            unlimited=unlimited,
        )
        for key, each in dataset.variables.items()
    ]
    return Source(
        name=shown,
        variables=variables,
        groups={"": dataset.attrs},
        close=dataset.close,
        slow=slow,
        naming=True,
        default_fill=default_fill if suffix in NETCDF_SUFFIXES else lambda dtype: None,
    )


GRIB_SUFFIXES = (".grib", ".grib2", ".grb", ".grb2", ".grb1", ".grib1")


def is_grib(head: bytes, path: Path) -> bool:
    """Whether this is GRIB by its first bytes."""
    return head.startswith(b"GRIB")


def open_grib(path: Path, request: Request) -> Source:
    """The variables of a GRIB file as cfgrib makes them of its messages.

    Grids that do not fit together are groups by their kind of level: `surface/t`. Raises
    MissingDependencyError without cfgrib, and InputError for messages that are damaged.
    """
    stamp = Stamp.of(path)
    cfgrib = library(str(path), "GRIB", "cfgrib", "fhash[grib]")
    with naming(str(path)), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of xarray, about cfgrib
        # no index is left beside the file
        wishes = {"indexpath": "", "errors": "raise"}
        datasets = cfgrib.open_datasets(str(path), backend_kwargs=wishes, cache=False)
        variables: list[Variable] = []
        groups: dict[str, Mapping[str, Any]] = {}
        for number, dataset in enumerate(datasets):
            levels = {each.attrs.get("GRIB_typeOfLevel") for each in dataset.data_vars.values()}
            group = "" if len(datasets) == 1 else "_".join(sorted(map(str, levels)))
            group = f"{group}_{number}" if group in groups else group
            groups[group] = dataset.attrs
            for name, each in dataset.variables.items():
                made = _stored(str(name), each, auxiliary=name in dataset.coords)
                full = f"{group}/{name}".lstrip("/")
                variables.append(replace(made, name=full, flat=False))
    return file_source(path, variables, groups=groups, stamp=stamp, naming=True)
