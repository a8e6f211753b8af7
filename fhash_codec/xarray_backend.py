"""xarray's engine `fhash`: `xr.open_dataset("run.fhz")` gives what it gives of the source.

The dataset is lazy: values are decoded when they are asked for, tile by tile. The engine hands
xarray an undecoded dataset, of the values and of all that belongs to them (`Volume.metadata`), and
xarray decodes it by CF as it does any file. docs/xarray.md is for users.

Importing this module registers `Dataset.fhash` and `DataArray.fhash`, whose `encode` writes a
container.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendEntrypoint
from xarray.core import indexing

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.labelled import labelled_series
from fhash_codec.encoding import encode
from fhash_codec.lazy_array import FhashArray, Form
from fhash_codec.provenance import figure_attributes, history_line, source_attributes
from fhash_codec.shared_volumes import acquire, place_of
from fhash_codec.side_by_side import SideBySide, shown_names
from fhash_codec.value_type import holds
from fhash_codec.volume import OUTSIDE, Volume
from fhash_formats.container import is_container
from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import SCALING
from fhash_formats.series import AXES
from fhash_formats.source_metadata import SourceVariable, meant, with_history
from fhash_formats.support.attributes import PACKING

__all__ = ["FhashBackend"]

SUFFIX = ".fhz"
FILLS = ("_FillValue", "missing_value")
"""Attributes that say which number stands for a missing value."""
VALID = ("valid_min", "valid_max", "valid_range")
"""Attributes that xarray leaves where they are."""


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

        lod: level of detail, every 2^lod-th vertex of the feature bounding box (profile compact).
        outside: "nan", or "background" for the mean of the values outside the coreset.
        variable: the only one wanted; all by default.
        storage_options: of a URL.

        Raises InputError for other values of these, and as `fhash_codec.open` does.
        """
        if outside not in OUTSIDE or (lod is not None and outside != OUTSIDE[0]):
            allowed = ", ".join(OUTSIDE) if lod is None else f"{OUTSIDE[0]} with lod"
            raise InputError(f"outside is {outside!r}; allowed: {allowed}")
        place = place_of(filename_or_obj)
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
        coordinates: set[str] = set()
        arrays: list[FhashArray] = []
        packed: dict[str, dict[str, Any]] = {}
        for name, shown in chosen.items():
            array = FhashArray(place, name, shown.form, storage_options)
            beside = joined.add(shown_as[name], shown.values(array, place), shown.beside())
            attributes = shown.attributes()
            coordinates |= {beside[each] for each in shown.coordinates} - set(shown_as.values())
            packed[shown_as[name]] = shown.packing()
            arrays.append(array)
        decoded = xr.conventions.decode_cf(
            xr.Dataset(joined.variables, attrs=attributes),
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

    def values(self, array: FhashArray, place: str) -> xr.Variable:
        """The values, not decoded."""
        encoding = {
            "preferred_chunks": self.form.chunks(self._volume),
            "source": place,
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

    def packing(self) -> dict[str, Any]:
        """The packing of the source, for `encoding`; none where the decoded values do not fit it.

        A value beyond the stored type would wrap, one that is coded as the fill value would become
        a missing one, and a vertex without a value would be written as some number.
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
        return found if self._fits(found) else {}

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
        return found | figure_attributes(volume.container.header)


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
) -> dict[str, Any]:
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
    ) -> dict[str, Any]:
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
    ) -> dict[str, Any]:
        """Encode the array as `fhash_codec.encode` does; settings: fields of `EncodeConfig`."""
        return _encode(self._array, path, None, config, force, client, settings)
