"""Series to encode, and what is selected of it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

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
from fhash_formats.readers.cf import settled
from fhash_formats.readers.labelled import array_series
from fhash_formats.readers.registry import open_series
from fhash_formats.series import Series
from fhash_formats.support.values import as_array, is_wide_integer

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
    given = as_array(mask, "mask")
    values = (given != 0) & (given == given)  # as in a file: neither zero nor NaN
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
