"""Series to encode, from a path, an array, a DataArray or dask, and what is selected of it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import (
    Everything,
    Extent,
    Feature,
    FeatureChoice,
    Mask,
    find_extent,
    resolve_features,
)
from fhash_codec.features.key_frames import select_key_frames, time_axis
from fhash_codec.features.scan import Scan, scan
from fhash_codec.measure.value_range import Ranks
from fhash_codec.progress import Progress, stage
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.common.cf import note_packing, packing, settled
from fhash_formats.readers.common.file_series import Request, condense
from fhash_formats.readers.common.layout import Dimension, Layout, arrange, must_select, single
from fhash_formats.readers.common.stored_parts import labelled_parts
from fhash_formats.readers.common.surroundings import (
    Arranged,
    Stored,
    Wanted,
    metadata_of,
    warn_left_out,
)
from fhash_formats.readers.common.variables import MAX_LISTED, MIN_DIMENSIONS
from fhash_formats.readers.netcdf import NetcdfFile, declared, stored_variable
from fhash_formats.readers.registry import open_series
from fhash_formats.series import (
    AXES,
    COORDINATES,
    NAMING,
    ArraySeries,
    NotStored,
    Series,
    SourceMetadata,
    check_coords,
    check_values,
    index_coordinate,
    plain_form,
    references,
    warn_not_stored,
)
from fhash_formats.support.dates import clock
from fhash_formats.support.values import PACKING, STORED, is_wide_integer, json_attributes

if TYPE_CHECKING:
    import xarray as xr

SLAB_BYTES = 64 << 20
"""Bytes of the steps of a chunk that are computed together, so that it is not computed again."""


def is_lazy(array: Any) -> bool:
    """Whether an array is one of dask, whose values are computed when they are asked for."""
    graph = getattr(array, "__dask_graph__", None)
    return graph is not None and graph() is not None


def _require_lengths(array: Any) -> None:
    """Raise InputError for a dask array with lengths that are not known before it is computed."""
    if any(length != length for length in array.shape):
        raise InputError(
            f"the dask array has shape {array.shape}; compute_chunk_sizes() finds the lengths"
        )


class LazyFrames:
    """The frames of a dask array.

    Attributes:
        array: the dask array (t, z, y, x).
    """

    def __init__(self, array: Any) -> None:
        """Take an array of 4 axes; raises InputError for lengths that are not known."""
        _require_lengths(array)
        self.array = array
        self._held: tuple[range, npt.NDArray[Any]] = range(0), np.empty(0)

    def read(self, step: int) -> npt.NDArray[Any]:
        """A frame (z, y, x); the other steps of its chunk, up to SLAB_BYTES, are kept for later."""
        held = self._held
        if step not in held[0]:
            self._held = range(0), np.empty(0)  # its memory is free before more is computed
            steps = self._slab(step)
            held = self._held = steps, np.asarray(self.array[steps.start : steps.stop])
        frame: npt.NDArray[Any] = held[1][step - held[0].start]
        return frame

    def _slab(self, step: int) -> range:
        """The steps that are computed with a step: those of its chunk, as far as they fit."""
        frame = self.array.dtype.itemsize * prod(self.array.shape[1:])
        most, first = max(1, SLAB_BYTES // frame), 0
        for length in self.array.chunks[0]:
            if step < first + length:
                start = first + (step - first) // most * most
                return range(start, min(start + most, first + length))
            first += length
        raise AssertionError("the step is in a chunk")


class DaskSeries(Series):
    """A dask array (t, z, y, x) or (z, y, x) without labels as a series.

    Attributes:
        lazy: its frames.
    """

    def __init__(self, array: Any) -> None:
        """Take an array; raises InputError for one that cannot be a series."""
        _require_lengths(array)
        # An array in memory of this shape and type, which takes no room, has the same labels.
        labels = ArraySeries(np.broadcast_to(np.zeros((), array.dtype), array.shape))
        self.source, self.name, self.units = labels.source, labels.name, labels.units
        self.dtype, self.shape, self.coords = labels.dtype, labels.shape, labels.coords
        self.attributes = labels.attributes
        self.lazy = LazyFrames(array if array.ndim == 4 else array[None])

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.lazy.read(step), dtype=self.dtype)


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
    """A labelled array, read frame by frame; its dimensions, positions and metadata as of a file.

    array: the DataArray. beside: a Dataset with all that its attributes may name.

    Attributes:
        lazy: frames of an array of dask; None for others.
    """

    def __init__(self, array: Any, beside: Any) -> None:
        self.source, self.name = "array", str(array.name or "values")
        self._failed: dict[str, str] = {}
        request = Request(asked=False)
        file = _as_file(array, beside, self.name, self._failed)
        found = NetcdfFile(f"array '{self.name}'", Path(), {"/": file}, request)
        variable = next(each for each in found.variables if each.handle == ("/", self.name))
        dimensions = found.dimensions(variable)
        self._layout = layout = _arranged(found.source, self.name, array, dimensions, request)
        self._axes = layout.axes
        lengths = dict(zip(self._axes, layout.shape, strict=True))
        self._array = array = array.isel({array.dims[n]: at for n, at in layout.picked.items()})
        self.shape = check_values(self.source, [lengths.get(axis, 1) for axis in AXES], array.dtype)
        self.dtype = array.dtype.newbyteorder("=")
        self.coords = {
            axis: index_coordinate(axis, length)
            for axis, length in zip(AXES, self.shape, strict=True)
        } | {
            axis: replace(each, name=plain_form(each.name))
            for axis, each in found.coordinates(variable, layout).items()
        }
        self.coords["t"], self.remark = settled(self.coords["t"])
        if self.remark:
            warnings.warn(f"{found.source}: {self.remark}", FhashWarning, stacklevel=4)
        check_coords(self.source, self.coords, self.shape)
        self.attributes = json_attributes(array.attrs, without=STORED) | layout.attributes()
        self.units = str(self.attributes.get("units", ""))
        self._packing = declared(found.source, array.variable)
        self._origin = _origin(array, beside)
        if self._origin is not None and self._packing is not None:
            note_packing(self, self._packing)
        self.metadata = lambda: self._metadata_of(array, beside, request)
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
        frame: npt.NDArray[Any] = self.read_steps(range(step, step + 1))[0]
        return frame

    def read_steps(self, steps: range) -> npt.NDArray[Any]:
        if self.lazy is not None:
            return super().read_steps(steps)
        chosen = slice(steps.start, steps.stop)
        known = dict(zip(self._axes, self._array.dims, strict=True))
        values = np.asarray(self._array.isel({known["t"]: chosen} if "t" in known else {}).values)
        ordered = values.transpose([self._axes.index(axis) for axis in AXES if axis in known])
        shaped = ordered.reshape(len(steps), *self.shape[1:])
        return np.ascontiguousarray(shaped, dtype=self.dtype)

    def _metadata_of(self, array: Any, beside: Any, request: Request) -> SourceMetadata:
        arrays = {str(key): each for key, each in beside.variables.items() if key != array.name}
        stored = {
            key: _stored(key, each) for key, each in arrays.items() if key not in self._failed
        }
        variables = {**stored, **_bounds(stored, arrays)}
        own = array.variable
        variables[self.name] = Stored(
            dimensions=tuple(each.name or "" for each in self._layout.dimensions),
            shape=tuple(each.length for each in self._layout.dimensions),
            dtype=own.dtype,
            attributes=_attributes(own),
            read=lambda places: np.empty(0),
        )
        source = f"array '{self.name}'"
        warn_left_out(f"{source}: not everything beside it is kept", self._failed)
        # a coordinate is what the dataset calls so, unless it is named in another way
        naming = {
            name
            for each in variables.values()
            for key, name in references(each.attributes)
            if key != COORDINATES
        }
        wanted = Wanted(
            source=source,
            name=self.name,
            coordinates=[key for key in map(str, array.coords) if key not in naming],
            used=[coordinate.name for coordinate in self.coords.values()],
            path=self._origin,
        )
        of_file = {key: value for key, value in beside.attrs.items() if key != COORDINATES}
        arranged = Arranged(
            layout=self._layout, request=request, packed=self._packing, coords=self.coords
        )
        return metadata_of(wanted, variables, of_file, arranged)


def _as_file(array: Any, beside: Any, name: str, failed: dict[str, str]) -> xr.Dataset:
    """A dataset as a NetCDF file gives it: times are numbers, and nothing is read.

    failed: takes the variables that no file holds, with the reason.
    """
    import xarray as xr

    arrays = {}
    for key, each in {**beside.variables, name: array.variable}.items():
        try:
            arrays[str(key)] = each if each.dtype.kind in "iuf" else _encoded(str(key), each)
        except Exception as error:  # indices of several levels, and objects of all kinds
            failed[str(key)] = condense(error)
    plain = {key: each.to_base_variable() for key, each in arrays.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of references to variables that are not there
        decoded = xr.decode_cf(
            xr.Dataset(plain),
            decode_times=False,
            decode_timedelta=False,
            mask_and_scale=False,
            decode_coords="all",
        )
    return decoded.set_coords([each for each in beside.coords if each in decoded])


def _arranged(
    source: str, name: str, array: Any, dimensions: Sequence[Dimension], request: Request
) -> Layout:
    """The reading of an array; raises InputError where an index must be selected."""
    picked = single(dimensions, {})
    open_dims = [dimensions[place].name for place in must_select(dimensions, picked)]
    if open_dims:
        choice = ", ".join(f"{dim}=0" for dim in open_dims)
        raise InputError(
            f"array '{name}' has the dimensions {', '.join(map(str, array.dims))}, and a series"
            f" only t, z, y and x; select one index of the others, such as array.isel({choice})"
        )
    return arrange(source, name, dimensions, request)


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


def _stored(name: str, array: Any) -> Stored:
    """A variable as it stands in a file; numbers are packed when they are read."""
    if array.dtype.kind not in "iuf":
        return stored_variable(_encoded(name, array))
    return Stored(
        dimensions=tuple(map(str, array.dims)),
        shape=array.shape,
        dtype=np.dtype(array.encoding.get("dtype", array.dtype)),
        attributes=_attributes(array),
        read=lambda places: np.asarray(_encoded(name, array[places]).values),
    )


def _bounds(stored: Mapping[str, Stored], arrays: Mapping[str, Any]) -> dict[str, Stored]:
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


Source = str | Path | Series | npt.ArrayLike
"""Data to encode: a file, a Series, an array (t, z, y, x) or (z, y, x), labelled or not, or a
Dataset of xarray with one variable that can be encoded."""


@contextmanager
def open_source(source: Source) -> Iterator[Series]:
    """The series of a source.

    A file is opened by `open_series`, and closed at the end of the context. A Series
    is taken as it is.
    """
    if isinstance(source, str | Path):
        with open_series(source) as series:
            yield series
    else:
        series = source if isinstance(source, Series) else array_series(source)
        time, remark = settled(series.coords["t"])
        if remark:
            warnings.warn(f"{series.source}: {remark}", FhashWarning, stacklevel=4)
            series.coords = {**series.coords, "t": time}
        yield series


def mask_files(config: EncodeConfig) -> list[str]:
    """Paths of the masks among the features."""
    prefix = "mask:"
    return [text.removeprefix(prefix) for text in config.features if text.startswith(prefix)]


def _array_mask(mask: npt.ArrayLike, series: Series) -> Feature:
    """The feature of a mask in memory; raises InputError for a shape other than the series'."""
    values = np.asarray(mask, dtype=bool)
    if values.shape not in (series.shape, series.shape[1:]):
        raise InputError(
            f"mask has shape {values.shape}; the series has {series.shape} in (t, z, y, x)"
        )
    return Mask("array", read=lambda step: values if values.ndim == 3 else values[step])


def _check_rounding(series: Series, scanned: Scan, config: EncodeConfig) -> None:
    """Tell of integers of 64 bits that missing values beside them made floats, and so rounded.

    Raises InputError where a bound of the error is promised, and warns (FhashWarning) elsewhere.
    """
    largest = max(map(abs, scanned.value_range.ends))
    if series.source_dtype is None or not is_wide_integer(series.source_dtype):
        return
    if largest <= 1 << 53:
        return
    told = (
        f"{series.source}: '{series.name}' has integers beyond 2^53 beside missing values, which "
        f"make floats of them: they are rounded, by up to {math.ulp(float(largest)) / 2:g}"
    )
    if config.bounded:
        raise InputError(
            f"{told}, and no bound of the error can be kept; promise a PSNR or a ratio, or encode "
            "the numbers as they are stored (--raw-values with --keep-extremes)"
        )
    warnings.warn(told, FhashWarning, stacklevel=4)


@dataclass(frozen=True, kw_only=True)
class FeatureSelection:
    """The part of a series that the settings select.

    Attributes:
        scanned: range, mean and missing values of the series.
        features: resolved, see `resolve_features`.
        extent: the key frames, and the vertices of the coreset at each of them.
        ranks: of the values of the coreset at the key frames, where they were asked for.
    """

    scanned: Scan
    features: tuple[Feature, ...]
    extent: Extent
    ranks: Ranks | None = None


def select_features(
    series: Series,
    config: EncodeConfig,
    progress: Progress,
    mask: npt.ArrayLike | None = None,
    *,
    ranked: bool = False,
    known: tuple[Scan, Ranks] | None = None,
) -> FeatureSelection:
    """Scan a series, choose its key frames and find its features, one frame at a time.

    ranked: whether the ranks of the values are taken in the same passes.
    known: the scan of the series and the ranks of all its values, where they were taken elsewhere;
        for the feature 'all' alone.
    mask: booleans (t, z, y, x) or (z, y, x), one more feature. It replaces the feature 'all' if the
        settings name no other.

    Raises InputError for settings that do not fit the series, or that select nothing. Warns of
    times that cannot serve as an axis.
    """
    ranks = known[1] if known is not None else Ranks() if ranked else None
    everything = "all" in config.features and (mask is None or config.features != ("all",))
    scanned, key_frames, features = resolve_selection(
        series,
        config,
        progress,
        mask,
        ranks if everything else None,
        scanned=None if known is None else known[0],
    )
    selected = None if everything else ranks
    with stage("features", f"vertices of {', '.join(map(str, features))}"):
        choice = FeatureChoice(key_frames, features, config.dilation)
        extent = find_extent(series, scanned, choice, progress, selected)
    return FeatureSelection(scanned=scanned, features=features, extent=extent, ranks=ranks)


def resolve_selection(
    series: Series,
    config: EncodeConfig,
    progress: Progress,
    mask: npt.ArrayLike | None,
    ranks: Ranks | None = None,
    *,
    scanned: Scan | None = None,
) -> tuple[Scan, tuple[int, ...], tuple[Feature, ...]]:
    """The scan, the key frames and the resolved features of a series; see `select_features`.

    ranks: gets all finite values, unless the series was scanned before.
    """
    times = time_axis(series.coords["t"].values)
    if times is not series.coords["t"].values:
        warnings.warn(
            f"{series.source}: its times do not strictly ascend or descend; "
            "step numbers stand for them",
            FhashWarning,
            stacklevel=3,
        )
    with stage("scan", "range and missing values, by one pass over all steps"):
        scanned = scan(series, progress, ranks) if scanned is None else scanned
    _check_rounding(series, scanned, config)

    def features_at(key_frames: Sequence[int]) -> tuple[Feature, ...]:
        with stage("features", f"thresholds of {', '.join(config.features)}"):
            texts, value_range = config.features, scanned.value_range
            found = resolve_features(texts, series, key_frames, value_range, progress)
        if mask is None:
            return found
        return (_array_mask(mask, series), *(() if texts == ("all",) else found))

    with stage("key frames", f"steps to encode: {config.key_frames}"):
        vertices = None
        if config.key_frames.startswith("auto:"):
            steps = range(series.shape[0])
            choice = FeatureChoice(steps, features_at(steps), config.dilation)
            if not any(isinstance(feature, Everything) for feature in choice.features):
                vertices = find_extent(series, scanned, choice, progress).vertices
        key_frames = select_key_frames(config.key_frames, series, times, progress, vertices)
    return scanned, tuple(key_frames), features_at(key_frames)
