"""From a source to its coreset: open, scan, choose key frames, find features, gather."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.extent import Extent, find_extent
from fhash_codec.coreset.features import Feature, Mask, resolve_features
from fhash_codec.coreset.key_frames import select_key_frames, time_axis
from fhash_codec.coreset.scan import Scan, scan
from fhash_codec.progress import Progress
from fhash_formats import open_series
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import AXES, ArraySeries, Coordinate, Series
from fhash_formats.support.attributes import json_attributes

Source = str | Path | Series | npt.ArrayLike


@contextmanager
def open_source(source: Source) -> Iterator[Series]:
    """A file opened by `fhash_formats.open_series` for as long as it is used, a Series as it is, or an array as a series."""
    if isinstance(source, str | Path):
        with open_series(source) as series:
            yield series
    else:
        yield source if isinstance(source, Series) else _array_series(source)


def _array_series(source: npt.ArrayLike) -> Series:
    """An array as a series; of a labelled one (xarray.DataArray) also the name, units and coordinates, its axes being (t, z, y, x)."""
    dims, labels = getattr(source, "dims", None), getattr(source, "coords", None)
    if dims is None or labels is None:
        return ArraySeries(source)
    coords = {}
    for axis, dim in zip(AXES[-len(dims) :], dims, strict=True):
        if dim in labels and labels[dim].dtype.kind in "iufM":
            values, attributes = np.asarray(labels[dim]), json_attributes(labels[dim].attrs)
            if values.dtype.kind == "M":
                values = (values - np.datetime64(0, "s")) / np.timedelta64(1, "s")
                attributes = {
                    "units": "seconds since 1970-01-01",
                    "calendar": "proleptic_gregorian",
                }
            coords[axis] = Coordinate(
                name=str(dim), values=values.astype(np.float64), attributes=attributes
            )
    attributes = json_attributes(source.attrs)  # type: ignore[union-attr]
    name = str(getattr(source, "name", None) or "values")
    return ArraySeries(
        np.asarray(source), name=name, units=str(attributes.get("units", "")), coords=coords
    )


def _array_mask(mask: npt.ArrayLike, series: Series) -> Feature:
    marked = np.asarray(mask, dtype=bool)
    if marked.shape not in (series.shape, series.shape[1:]):
        raise InputError(
            f"mask has shape {marked.shape}; the series has {series.shape} in (t, z, y, x)"
        )
    return Mask("array", read=lambda step: marked if marked.ndim == 3 else marked[step])


@dataclass(frozen=True, kw_only=True)
class FeatureSelection:
    """What the settings select of a series: its range, the key frames, the features, where they lie."""

    scanned: Scan
    features: tuple[Feature, ...]
    extent: Extent


def select_features(
    series: Series, config: EncodeConfig, progress: Progress, mask: npt.ArrayLike | None = None
) -> FeatureSelection:
    """Scan a series, choose its key frames and find its features, a frame at a time.

    mask: booleans (t, z, y, x) or (z, y, x), one more feature; it stands for 'all' where the settings name nothing else.
    Raises InputError for settings that do not fit the series, or that select nothing. Warns of times that cannot serve as an axis.
    """
    scanned, key_frames, features = resolve_selection(series, config, progress, mask)
    return FeatureSelection(
        scanned=scanned,
        features=features,
        extent=find_extent(series, scanned, key_frames, features, config.dilation, progress),
    )


def resolve_selection(
    series: Series, config: EncodeConfig, progress: Progress, mask: npt.ArrayLike | None
) -> tuple[Scan, tuple[int, ...], tuple[Feature, ...]]:
    times = time_axis(series.coords["t"].values)
    if times is not series.coords["t"].values:
        warnings.warn(
            f"{series.source}: its times do not strictly ascend or descend; step numbers stand for them",
            FhashWarning,
            stacklevel=3,
        )
    scanned = scan(series, progress)
    key_frames = select_key_frames(config.key_frames, series, times, progress)
    features = resolve_features(config.features, series, key_frames, scanned.value_range, progress)
    if mask is not None:
        features = (
            _array_mask(mask, series),
            *(feature for feature in features if config.features != ("all",)),
        )
    return scanned, tuple(key_frames), features
