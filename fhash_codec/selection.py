"""From a source to its coreset: open, scan, choose key frames, find features, gather."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy.typing as npt

from fhash_codec.architecture import Architecture
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset import Coreset, box_size, build_coreset
from fhash_codec.features import Feature, resolve_features
from fhash_codec.key_frames import select_key_frames, time_axis
from fhash_codec.progress import Progress
from fhash_codec.scan import Scan, scan
from fhash_formats import open_series
from fhash_formats.series import ArraySeries, Series

Source = str | Path | Series | npt.ArrayLike


class FhashWarning(UserWarning):
    """Something that a user should know and that is no error."""


@contextmanager
def opened(source: Source) -> Iterator[Series]:
    """A file opened by `fhash_formats.open_series` for as long as it is used, a Series as it is, or an array as a series."""
    if isinstance(source, str | Path):
        with open_series(source) as series:
            yield series
    else:
        yield source if isinstance(source, Series) else ArraySeries(source)


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What the settings select of a series, and the model that is to be fitted to it."""

    scanned: Scan
    features: tuple[Feature, ...]
    coreset: Coreset
    architecture: Architecture


def select(series: Series, config: EncodeConfig, progress: Progress) -> Selection:
    """Scan a series, choose its key frames, find its features and gather their coreset, a frame at a time.

    Raises InputError for settings that do not fit the series, or that select nothing. Warns of times that cannot serve as an axis.
    """
    times = time_axis(series.coords["t"].values)
    if times is not series.coords["t"].values:
        warnings.warn(
            f"{series.source}: its times do not strictly ascend or descend; step numbers stand for them", FhashWarning, stacklevel=2
        )
    scanned = scan(series, progress)
    key_frames = select_key_frames(config.key_frames, series, times, progress)
    features = resolve_features(config.features, series, key_frames, scanned.value_range, progress)
    coreset = build_coreset(series, scanned, key_frames, features, config.dilation, progress)
    architecture = Architecture.for_box(
        box_size(coreset.box),
        len(key_frames),
        fold=config.fold,
        embedding_size=config.embedding_size,
        hidden_layers=config.hidden_layers,
        width=config.width,
    )
    return Selection(scanned=scanned, features=features, coreset=coreset, architecture=architecture)
