"""Backend of xarray: containers as datasets of lazy arrays."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from fhash_codec.appending.growing import bound_of_file
from fhash_codec.boxes import Box, index_ranges, slice_of
from fhash_codec.comparison import EncodeReport
from fhash_codec.config import EncodeConfig
from fhash_codec.dataset import Handle, absolute, acquire, held_again, release
from fhash_codec.encoding import encode
from fhash_codec.header import figure_attributes, history_line, source_attributes, without_figures
from fhash_codec.volume import OUTSIDE, Volume, holds
from fhash_formats.container import is_container
from fhash_formats.errors import InputError, UnsupportedFileError
from fhash_formats.readers.cf import SCALING
from fhash_formats.readers.labelled import labelled_series
from fhash_formats.series import (
    AXES,
    NO_AXIS,
    SourceVariable,
    meant,
    renamed,
    step_blocks,
    with_history,
)
from fhash_formats.support.values import PACKING

Key = tuple[Any, ...]


def shown_names(names: Mapping[str, str]) -> dict[str, str]:
    """The name under which each variable of a file is shown, by its name in the file.

    names: of the variables in their sources, by their names in the file. Where several have the
        same name in their sources, all variables are shown by their names in the file.
    """
    if len(set(names.values())) == len(names):
        return dict(names)
    return {name: name for name in names}


class SideBySide:
    """A dataset that takes one variable after the other.

    Attributes:
        variables: those of the dataset so far, by name.
    """

    def __init__(self, data: Mapping[str, Collection[str]]) -> None:
        """Keep names free. data: dimensions of the variables that will be added, by name."""
        self.variables: dict[str, xr.Variable] = {}
        self._data = data
        # A variable alone may have the name of its own dimension.
        self._taken = set(data) if len(data) > 1 else set()
        self._counts: dict[str, int] = {}
        self._known: dict[Key, str] = {}
        # Length of each dimension, and what its coordinate holds; None without a coordinate.
        self._dimensions: dict[str, tuple[int, Key | None]] = {}

    def add(
        self, name: str, values: xr.Variable, beside: Mapping[str, xr.Variable]
    ) -> dict[str, str]:
        """Add a variable and the arrays beside it; return the names of these in the dataset."""
        sizes: dict[str, int] = {}
        for variable in (values, *beside.values()):
            sizes |= {str(dim): size for dim, size in variable.sizes.items()}
        names = {dim: self._dimension(dim, size, beside.get(dim)) for dim, size in sizes.items()}
        for other, variable in beside.items():
            if other in names:
                continue
            dimensions = tuple(names[str(dim)] for dim in variable.dims)
            if other in self._data and set(variable.dims) == set(self._data[other]):
                names[other] = other  # the values of another variable of the file
                continue
            key = (other, dimensions, _content(variable))
            names[other] = self._named(other, key, lambda free: free not in self._taken)
        changed = {old: new for old, new in names.items() if old != new}
        for other, variable in beside.items():
            if names[other] not in self._data:
                self.variables.setdefault(names[other], _renamed(variable, names, changed))
        self.variables[name] = _renamed(values, names, changed)
        return {other: names[other] for other in beside}

    def _dimension(self, name: str, size: int, coordinate: xr.Variable | None) -> str:
        """The name in the dataset of a dimension, which is shared where nothing contradicts."""
        content = None if coordinate is None else _content(coordinate)

        def fits(free: str) -> bool:
            if free not in self._dimensions:
                return free not in self._taken
            length, other = self._dimensions[free]
            return length == size and (content is None or other in (None, content))

        found = self._named(name, (name, size, content), fits)
        before = self._dimensions.get(found, (size, None))[1]
        self._dimensions[found] = size, content if before is None else before
        return found

    def _named(self, wish: str, key: Key, fits: Callable[[str], bool]) -> str:
        """The name of what a key says, or a new one: the wish, or with a number."""
        if key not in self._known:
            name = wish
            while not fits(name):
                self._counts[wish] = self._counts.get(wish, 1) + 1
                name = f"{wish}_{self._counts[wish]}"
            self._known[key] = name
            self._taken.add(name)
        return self._known[key]


def _content(variable: xr.Variable) -> Key:
    """The form, values and attributes of an array, for comparison with others."""
    values = np.asarray(variable.values)
    data = repr(values.tolist()).encode() if values.dtype.kind == "O" else values.tobytes()
    attributes = repr(sorted(variable.attrs.items(), key=lambda item: str(item[0])))
    form = (variable.dims, values.shape, values.dtype.str)
    return (*form, sha256(data).digest(), attributes)


def _renamed(
    variable: xr.Variable, names: Mapping[str, str], changed: Mapping[str, str]
) -> xr.Variable:
    """A variable with other names of its dimensions and in its attributes."""
    if not changed:
        return variable
    dimensions: Sequence[str] = [names[str(dim)] for dim in variable.dims]
    attributes = renamed(variable.attrs, changed)
    return xr.Variable(dimensions, variable._data, attributes, encoding=variable.encoding)


@dataclass(frozen=True, kw_only=True)
class Form:
    """The form in which a volume is shown.

    Attributes:
        dimensions: of the variable, each with its axis or NO_AXIS.
        lod: level of detail, None for every vertex.
        outside: as in `Volume.read`.
    """

    dimensions: Mapping[str, str]
    lod: int | None
    outside: str

    def vertices(self, volume: Volume) -> dict[str, range]:
        """Steps and vertices of the domain that are shown, by axis."""
        steps, *space = map(range, volume.shape)
        if self.lod is not None:
            space = list(volume.lod_vertices(self.lod))
        return dict(zip(AXES, (steps, *space), strict=True))

    def sizes(self, volume: Volume) -> dict[str, int]:
        """Length of each dimension."""
        lengths = {axis: len(along) for axis, along in self.vertices(volume).items()}
        return {name: lengths.get(axis, 1) for name, axis in self.dimensions.items()}

    def chunks(self, volume: Volume) -> dict[str, int]:
        """Length of a tile along each dimension."""
        t, *space = volume.chunks
        tile = dict(zip(AXES, (t, *(max(1, n >> (self.lod or 0)) for n in space)), strict=True))
        sizes = self.sizes(volume)
        return {name: min(tile.get(axis, 1), sizes[name]) for name, axis in self.dimensions.items()}


def _nothing() -> None:
    """The handle of an array whose file is not open."""


class FhashArray(BackendArray):
    """A variable of a container, decoded as it is indexed; pickled as its place.

    An array of a path does not hold the file open: a dataset may have more files than descriptors.
    """

    def __init__(
        self, place: Any, name: str, form: Form, storage_options: Mapping[str, Any] | None
    ) -> None:
        self._place, self._name, self._form = place, name, form
        self._options = storage_options
        handle = acquire(place, storage_options)
        self._handle: Callable[[], Handle | None] = self._holding(handle)
        self._digest = handle.digest
        volume = handle.volumes[name]
        self.shape = tuple(form.sizes(volume).values())
        self.dtype = volume.dtype if form.lod is None else volume.float_dtype

    def _opened(self) -> Handle:
        """The open file, for as long as it is held; InputError where it has been replaced."""
        handle = self._handle()
        if handle is None or not handle.is_of_this_process():
            handle = acquire(self._place, self._options, self._digest)
            self._handle = self._holding(handle)
        elif isinstance(self._place, str):
            held_again(handle)
        return handle

    def _holding(self, handle: Handle) -> Callable[[], Handle | None]:
        """A way to the open file, which holds only what cannot be opened again."""
        return weakref.ref(handle) if isinstance(self._place, str) else lambda: handle

    def release(self) -> None:
        """Close the file, unless others read from it; the next reading opens it again."""
        handle = self._handle()
        if handle is not None:
            release(handle)
        self._handle = _nothing

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_handle": _nothing}

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._get
        )

    def _get(self, key: tuple[int | slice, ...]) -> npt.NDArray[Any]:
        """Values at whole numbers and slices, one for each dimension."""
        dimensions = list(self._form.dimensions.items())
        ranges = index_ranges(key, self.shape, tuple(self._form.dimensions))
        chosen = dict(zip(self._form.dimensions.values(), ranges, strict=True))
        values = self._values({axis: chosen.get(axis, range(1)) for axis in AXES})
        # from t, z, y, x to the dimensions that there are, in their order
        present = [axis for _, axis in dimensions if axis != NO_AXIS]
        ordered = [axis for axis in AXES if axis in present]
        values = values.reshape([len(chosen[axis]) for axis in ordered])
        values = values.transpose([ordered.index(axis) for axis in present])
        for place, (_, axis) in enumerate(dimensions):
            if axis == NO_AXIS:
                values = np.expand_dims(values, place)
        left = (
            part if axis == NO_AXIS else slice(None) if isinstance(part, slice) else 0
            for (_, axis), part in zip(dimensions, key, strict=True)
        )
        return values[tuple(left)]

    def _values(self, ranges: Mapping[str, range]) -> npt.NDArray[Any]:
        """Values (t, z, y, x) at some of the steps and vertices that are shown."""
        # held until the values are there, even if another thread releases it
        handle, form = self._opened(), self._form
        volume = handle.volumes[self._name]
        result = np.empty([len(ranges[axis]) for axis in AXES], dtype=self.dtype)
        if not result.size:
            return result
        shown = form.vertices(volume)
        region = Box.of(
            (shown[axis][min(ranges[axis])], shown[axis][max(ranges[axis])] + 1)
            for axis in AXES[1:]
        )
        local = tuple(slice_of(ranges[axis], min(ranges[axis])) for axis in AXES[1:])
        if form.lod is not None:
            for number, step in enumerate(ranges["t"]):
                result[number] = volume.read_lod(step, form.lod, region)[local]
            return result
        for places, steps in step_blocks(ranges["t"], region.shape):
            values = volume.values_of_steps(steps, region, outside=form.outside)
            result[places] = values[:, *local]
        return result


SUFFIX = ".fhz"
FILLS = ("_FillValue", "missing_value")
"""Attributes that say which number stands for a missing value."""
MAX_ERROR = "fhash_max_error"
ROUNDED = 1e-6
"""Share of a count by which arithmetic of floats may miss the middle between two."""
VALID = ("valid_min", "valid_max", "valid_range")
"""Attributes that xarray leaves where they are."""


def _dataset(variables: Any, attributes: dict[str, Any], place: Any) -> xr.Dataset:
    """The dataset of a file's variables; UnsupportedFileError where xarray holds no such ones."""
    try:
        return xr.Dataset(variables, attrs=attributes)
    except ValueError as error:
        raise UnsupportedFileError(f"{place}: no dataset of xarray: {error}") from error


class FhashBackend(BackendEntrypoint):
    """xarray's engine `fhash`."""

    description = "fhash containers (.fhz) of time-varying volumes"
    url = "https://pypi.org/project/fhash"

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Whether this is a container, by its suffix or its signature."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        place = os.fspath(filename_or_obj)
        return isinstance(place, str) and (
            place.lower().endswith(SUFFIX) or ("://" not in place and is_container(place))
        )

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        mask_and_scale: bool | Mapping[str, bool] = True,
        decode_times: Any = True,
        concat_characters: bool | Mapping[str, bool] = True,
        decode_coords: bool | str = True,
        drop_variables: str | Iterable[str] | None = None,
        use_cftime: bool | Mapping[str, bool] | None = None,
        decode_timedelta: Any = None,
        lod: int | None = None,
        outside: str = "nan",
        variable: str | None = None,
        storage_options: Mapping[str, Any] | None = None,
    ) -> xr.Dataset:
        """Open a container as a lazy dataset; the options of CF are xarray's own.

        lod: level of detail, every 2^lod-th vertex of the feature bounding box; the published
            network has none but 0.
        outside: "nan", or "background" for the mean of the values outside the coreset.
        variable: the only one wanted; all by default.
        storage_options: of a URL.

        Raises InputError for other values of these, and as `fhash_codec.open` does.
        """
        if outside not in OUTSIDE or (lod is not None and outside != OUTSIDE[0]):
            allowed = ", ".join(OUTSIDE) if lod is None else f"{OUTSIDE[0]} with lod"
            raise InputError(f"outside is {outside!r}; allowed: {allowed}")
        place = absolute(filename_or_obj)
        handle = acquire(place, storage_options)
        names = list(handle.volumes)
        if variable is not None and len(names := meant(variable, names)) != 1:
            listed = ", ".join(handle.volumes)
            raise InputError(f"{place} has no single variable {variable!r}; it has {listed}")
        chosen = {name: Shown(handle.volumes[name], lod, outside) for name in names}
        shown_as = shown_names({name: handle.volumes[name].name for name in chosen})
        joined = SideBySide(
            {shown_as[name]: shown.form.dimensions for name, shown in chosen.items()}
        )
        attributes: dict[str, Any] = {}
        coordinates, growing = set[str](), set[str]()
        arrays: list[FhashArray] = []
        packed: dict[str, dict[str, Any]] = {}
        for name, shown in chosen.items():
            array = FhashArray(place, name, shown.form, storage_options)
            beside = joined.add(shown_as[name], shown.values(array, place), shown.beside())
            attributes = shown.attributes()
            coordinates |= {beside[each] for each in shown.coordinates} - set(shown_as.values())
            packed[shown_as[name]] = shown.packing()
            growing |= shown.unlimited(joined.variables[shown_as[name]].dims)
            arrays.append(array)
        decoded = xr.conventions.decode_cf(
            _dataset(joined.variables, attributes, place),
            concat_characters=concat_characters,  # type: ignore[arg-type]
            mask_and_scale=mask_and_scale,  # type: ignore[arg-type]
            decode_times=decode_times,
            decode_coords=decode_coords,  # type: ignore[arg-type]
            drop_variables=drop_variables,
            use_cftime=use_cftime,  # type: ignore[arg-type]
            decode_timedelta=decode_timedelta,
        )
        if decode_coords:
            decoded = decoded.set_coords([name for name in coordinates if name in decoded])
        for name, encoding in packed.items():
            if name in decoded.variables:
                decoded.variables[name].encoding |= encoding
        decoded.encoding |= {"unlimited_dims": growing} if growing else {}
        decoded.set_close(partial(_release, arrays))
        return decoded


def _release(arrays: Iterable[FhashArray]) -> None:
    for array in arrays:
        array.release()


class Shown:
    """A volume as an undecoded dataset.

    Attributes:
        form: the dimensions and the options.
        coordinates: names of the arrays beside the values that are coordinates.
    """

    def __init__(self, volume: Volume, lod: int | None, outside: str) -> None:
        self._volume = volume
        self._metadata = volume.metadata
        dimensions = _invented(volume) if self._metadata is None else self._metadata.dimensions
        self.form = Form(dimensions=dimensions, lod=lod, outside=outside)
        self._beside = self._variables()
        self.coordinates = {each.name for each in self._beside if each.is_coordinate}

    def values(self, array: FhashArray, place: Any) -> xr.Variable:
        """The values, not decoded."""
        encoding = {
            "preferred_chunks": self.form.chunks(self._volume),
            **({"source": place} if isinstance(place, str) else {}),
        }
        lazy = indexing.LazilyIndexedArray(array)
        return xr.Variable(
            tuple(self.form.dimensions), lazy, self._variable_attributes(), encoding=encoding
        )

    def beside(self) -> dict[str, xr.Variable]:
        """The arrays beside the values, not decoded."""
        return {
            each.name: xr.Variable(each.dimensions, each.values, dict(each.attributes))
            for each in self._beside
        }

    def attributes(self) -> dict[str, Any]:
        """Attributes of the file: those of the source, its name and digest, and the history."""
        metadata, volume = self._metadata, self._volume
        if metadata is None:
            return with_history({}, history_line(volume.container.header))
        return {**metadata.attributes, **source_attributes(metadata)}

    def unlimited(self, names: Iterable[Hashable]) -> set[str]:
        """The dimensions that can grow in the source. names: of all of them as they are shown."""
        told = () if self._metadata is None else self._metadata.unlimited
        shown = zip(self.form.dimensions, names, strict=True)
        return {str(name) for own, name in shown if own in told}

    def packing(self) -> dict[str, Any]:
        """The packing of the source, for `encoding`; none where the decoded values do not fit it.

        A value beyond the stored type would wrap, one that is coded as the fill value would become
        a missing one, a vertex without a value would be written as some number, and rounding could
        lead beyond the bound.
        """
        if self._metadata is None or self._volume.dtype.kind != "f":
            return {}
        raw = self._metadata.variable_attributes
        found = {key: value for key, value in raw.items() if key in PACKING and key not in VALID}
        stored = self._metadata.stored
        if stored is not None:
            if self._volume.value_type.has_gaps and not set(FILLS) & set(found):
                return {}
            found["dtype"] = np.dtype(stored)
        if not self._fits(found):
            return {}
        header = self._volume.container.header
        error = header["quality"].get("max_abs_error")
        bound = bound_of_file(header) or 0.0
        kept = error is not None and self.packed_error(found) <= max(error, bound)
        return found if kept or not self._rounds(found) else {}

    def _rounds(self, packing: Mapping[str, Any]) -> bool:
        """Whether a packing changes decoded values."""
        dtype = np.dtype(packing.get("dtype", self._volume.dtype))
        return dtype != self._volume.dtype or bool(SCALING & packing.keys())

    def packed_error(self, packing: Mapping[str, Any]) -> float:
        """The largest error of values that are written in a packing of the source again.

        The values of the source are whole counts, and so is what rounding makes of decoded ones:
        those that are nearer than half a count come back as they were.
        """
        header = self._volume.container.header
        error = float(header["quality"].get("max_abs_error") or 0.0)
        if error == 0 or not self._rounds(packing):
            return error
        dtype = np.dtype(packing.get("dtype", self._volume.dtype))
        scale = abs(float(np.ravel(packing.get("scale_factor", 1))[0]))
        if dtype.kind in "iu":
            return float(scale * np.floor(error / scale + 0.5 + ROUNDED))
        offset = float(np.ravel(packing.get("add_offset", 0))[0])
        largest = max(abs(float(end) - offset) for end in header["value_range"])
        return error + float(np.finfo(dtype).eps) * largest

    def _fits(self, packing: Mapping[str, Any]) -> bool:
        """Whether every decoded value has a number of the packed type that is no fill value."""
        header = self._volume.container.header
        dtype = np.dtype(packing.get("dtype", self._volume.dtype))
        numbers = {key: np.ravel(value) for key, value in packing.items() if key != "dtype"}
        if any(each.dtype.kind not in "iuf" or not each.size for each in numbers.values()):
            return False
        scale = float(numbers.get("scale_factor", [1])[0])
        offset = float(numbers.get("add_offset", [0])[0])
        ends = [float(end) for end in header["value_range"]]
        with np.errstate(all="ignore"):
            ends = sorted(float((np.float64(end) - offset) / scale) for end in ends)
        if not np.isfinite(ends).all():
            return False
        low, high = ends
        if dtype.kind in "iu":
            limits, (low, high) = np.iinfo(dtype), (round(low), round(high))
            if low < limits.min or high > limits.max:
                return False
        fills = [numbers[key] for key in FILLS if key in numbers]
        exact = header["quality"].get("max_abs_error") == 0
        return exact or not any(low <= fill <= high for fill in np.concatenate([[], *fills]))

    def _variables(self) -> tuple[SourceVariable, ...]:
        """The arrays beside the values, cut to the vertices that are shown."""
        volume, metadata = self._volume, self._metadata
        places = self.form.vertices(volume)
        if metadata is not None:
            return (
                metadata.cut(places).variables
                if self.form.lod is not None
                else (metadata.variables)
            )
        return tuple(
            SourceVariable(
                name=name,
                dimensions=(name,),
                values=volume.coords[axis].values[list(places[axis])],
                attributes=volume.coords[axis].attributes,
                is_coordinate=True,
            )
            for name, axis in self.form.dimensions.items()
        )

    def _variable_attributes(self) -> dict[str, Any]:
        """Attributes of the values as a file without packing has them, and how good they are."""
        volume = self._volume
        if self._metadata is None:
            raw = {**volume.attrs, **({"units": volume.units} if volume.units else {})}
        else:
            raw = dict(self._metadata.variable_attributes)
        # limits of packed numbers mean nothing where the packing is not handed on
        lost = SCALING & raw.keys() and not self.packing()
        shown = () if lost else VALID
        found = {key: value for key, value in raw.items() if key not in PACKING or key in shown}
        if volume.dtype.kind in "iu" and self.form.lod is None:
            gaps = volume.value_type.has_gaps
            fill = volume.fill if gaps else volume.value_type.fill
            told = gaps or set(FILLS) & set(raw)
            if told and fill is not None and holds(volume.dtype, fill):
                found[FILLS[0]] = volume.dtype.type(fill)
        if self.form.lod is not None:
            return found  # the figures are those of all vertices
        figures = figure_attributes(volume.container.header)
        packing = self.packing()
        if packing and figures.get(MAX_ERROR):
            figures[MAX_ERROR] = max(figures[MAX_ERROR], self.packed_error(packing))
        # where the file has none of its own, its tiles were taken over with those of the store
        return (without_figures(found) if figures else found) | figures


def _invented(volume: Volume) -> dict[str, str]:
    """Dimensions of a file that does not say those of its source: all four axes."""
    names: dict[str, str] = {}
    for axis in AXES:
        name = volume.coords[axis].name or axis
        while name in names or name == volume.name:
            name += "_"
        names[name] = axis
    return names


def _encode(
    data: xr.Dataset | xr.DataArray,
    path: str | Path,
    variable: Hashable | None,
    config: EncodeConfig | None,
    force: bool,
    client: Any,
    settings: Mapping[str, Any],
) -> EncodeReport:
    if config is not None and settings:
        raise InputError(f"give either config or single settings, not both: {', '.join(settings)}")
    chosen = config or EncodeConfig.from_dict(dict(settings))
    return encode(labelled_series(data, variable), path, chosen, force=force, client=client)


@xr.register_dataset_accessor("fhash")  # type: ignore[no-untyped-call]
class DatasetAccessor:
    """`Dataset.fhash`: write a variable as a container."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def encode(
        self,
        path: str | Path,
        *,
        variable: Hashable | None = None,
        config: EncodeConfig | None = None,
        force: bool = False,
        client: Any = None,
        **settings: Any,
    ) -> EncodeReport:
        """Encode a variable, the only one that can be by default; as `fhash_codec.encode` does.

        settings: fields of `EncodeConfig`, such as psnr=45.
        """
        return _encode(self._dataset, path, variable, config, force, client, settings)


@xr.register_dataarray_accessor("fhash")  # type: ignore[no-untyped-call]
class DataArrayAccessor:
    """`DataArray.fhash`: write the array as a container."""

    def __init__(self, array: xr.DataArray) -> None:
        self._array = array

    def encode(
        self,
        path: str | Path,
        *,
        config: EncodeConfig | None = None,
        force: bool = False,
        client: Any = None,
        **settings: Any,
    ) -> EncodeReport:
        """Encode the array as `fhash_codec.encode` does; settings: fields of `EncodeConfig`."""
        return _encode(self._array, path, None, config, force, client, settings)
