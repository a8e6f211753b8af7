"""Comparison of a container with its source, and the report of an encode."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.features.selection import Source, open_source
from fhash_codec.file_info import Gain, HistoryPoint
from fhash_codec.measure.errors import find_bulk
from fhash_codec.measure.metrics import BUDGET as SSIM_BUDGET
from fhash_codec.measure.metrics import (
    Comparer,
    Comparison,
    NeighboursOf,
    Quality,
    measure_quality,
    neighbours_of,
    ssim_steps,
)
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, Stage, silent
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Place, is_container
from fhash_formats.container.header import PAPER
from fhash_formats.container.reader import Split
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Series, step_blocks
from fhash_formats.transform.values import about_origin


class Sizes(TypedDict):
    """A written file, and its sizes."""

    path: Annotated[str, "the file written"]
    bytes: Annotated[int, "its size"]
    split: Annotated[dict[str, int], Split, "`bytes` by what they hold; they add up to it"]
    raw_bytes: Annotated[int, "size of the values in the source's number type"]
    ratio: Annotated[float, "`raw_bytes / bytes`"]
    seconds: Annotated[float, "of the whole job"]


class Report(Sizes):
    """Sizes, quality and training of a container; null where a figure has no finite value."""

    source_bytes: Annotated[int | None, "size on disk of the files read; null without files"]
    source_ratio: Annotated[float | None, "`source_bytes / bytes`"]
    psnr: Annotated[float | None, "dB over the coreset; null if error or range is 0"]
    psnr_bulk: Annotated[float | None, "dB within, and relative to, the middle 98 %"]
    rmse: Annotated[float | None, "root of the mean squared error in the coreset, in data units"]
    max_abs_error: Annotated[float | None, "largest error in the coreset, in data units"]
    ssim: Annotated[float | None, "mean structural similarity over the coreset"]
    psnr_domain: Annotated[float | None, "dB over all, background outside the coreset"]
    epochs: Annotated[int, "of the training; 0 without one"]
    saved: Annotated[float | None, "share of the bytes of the values that the MLP saves, about"]
    curve: Annotated[list[HistoryPoint], "course of the training"]
    shape: Annotated[list[int], "of the series, (t, z, y, x)"]
    key_frames: Annotated[list[int], "steps that were encoded"]
    feature_bounding_box: Annotated[list[list[int]], "[first, end) along z, y and x"]
    coreset_fraction: Annotated[float, "share of the domain that is kept, 0 to 1"]
    data_range: Annotated[float, "largest less smallest value"]
    parameters: Annotated[int, "numbers of the model other than 0"]
    published: Annotated[bool, "whether it is the published network"]
    tables_loss_db: Annotated[float | None, "dB that coded tables lose at the key frames"]
    device: Annotated[Literal["cpu", "cuda"], "where it was trained"]
    restarts: Annotated[int, "times that the training diverged and began again, slower"]
    gains: Annotated[list[Gain], "what the search went through; empty without `--timings`"]
    quality: Annotated[dict[str, Any], Quality, "all figures of the quality"]


class EncodeReport(Report):
    """Figures of a file that was encoded."""

    stages: NotRequired[Annotated[list[dict[str, Any]], list[Stage], "`--verbose`"]]


class Compared(Report):
    """Figures of a container against its data; `seconds` is the time of the comparison."""

    differences: Annotated[list[str], "other differences than of values: name, units, positions"]


def report(
    volume: Volume, quality: dict[str, Any], *, seconds: float, files: Iterable[Path] = ()
) -> Report:
    """Sizes, quality and training of a container, as JSON values.

    quality: `metrics.Quality` as JSON values. seconds: duration of the whole job. files: files and
    folders that the series was read from.
    """
    info = volume.info
    device = info["training"]["device"]
    source = bytes_on_disk(files)
    return {
        "path": str(volume.path),
        "bytes": info["bytes"],
        "split": info["split"],
        "raw_bytes": info["raw_bytes"],
        "ratio": info["ratio"],
        "source_bytes": source,
        "source_ratio": None if source is None else source / info["bytes"],
        "psnr": quality["psnr"],
        "rmse": quality["rmse"],
        "max_abs_error": quality["max_abs_error"],
        "ssim": quality["ssim"],
        "psnr_domain": quality["psnr_domain"],
        "psnr_bulk": None if quality["bulk"] is None else quality["bulk"]["psnr"],
        "seconds": seconds,
        "epochs": info["training"]["epochs"],
        "saved": info["training"].get("saved"),
        "curve": info["history"],
        "shape": info["domain"]["shape"],
        "key_frames": info["key_frames"],
        "feature_bounding_box": info["feature_bounding_box"],
        "coreset_fraction": info["coreset_fraction"],
        "data_range": volume.value_range.high - volume.value_range.low,
        "parameters": info["model"]["parameters"],
        "published": info["model"]["profile"] == PAPER,
        "tables_loss_db": info["model"].get("tables_loss_db"),
        # What is not trained is computed on the CPU.
        "device": "cpu" if device == "none" else device,
        "restarts": info["training"].get("restarts", 0),
        "gains": info["model"].get("gains", []),
        "quality": quality,
    }


def bytes_on_disk(paths: Iterable[Path]) -> int | None:
    """Bytes of files, and of all files below folders; None without any, or if one is gone."""
    total, found = 0, False
    try:
        for path in paths:
            found = True
            if not path.is_dir():
                total += path.stat().st_size
                continue
            for folder, _, names in os.walk(path):
                total += sum(os.stat(os.path.join(folder, name)).st_size for name in names)
    except OSError:
        return None
    return total if found else None


LAYER_BYTES = 1 << 30
"""Bytes of decoded frames that are held at a time, at most; a single larger one is allowed."""
QUICK_SSIM_BUDGET = 1 << 20
"""Vertices whose SSIM is measured after an encoding at effort 1."""


def ssim_budget(config: EncodeConfig) -> int:
    """Vertices whose SSIM is measured after an encoding; 0 for none."""
    if "ssim" in config.without:
        return 0
    return QUICK_SSIM_BUDGET if config.effort == 1 else SSIM_BUDGET


def steps_of_ssim(series: Series, budget: int = SSIM_BUDGET) -> list[int]:
    """The steps of a series whose SSIM is measured, within a number of vertices; none for 0."""
    return ssim_steps(series.shape[0], prod(series.shape[1:]), budget) if budget else []


class DecodedSeries(Series):
    """The decoded values of a volume as a series; the volume stays the caller's."""

    def __init__(self, volume: Volume) -> None:
        self.source, self.name, self.units = str(volume.path), volume.name, volume.units
        self.dtype, self.shape, self.coords = volume.dtype, volume.shape, volume.coords
        self.attributes = volume.attrs
        exact = volume.dtype.kind in "iu" and not volume.value_type.has_gaps
        self._frames = DecodedFrames(volume, exact=exact)

    def read(self, step: int) -> npt.NDArray[Any]:
        """One decoded frame (z, y, x)."""
        self.require_step(step)
        return np.ascontiguousarray(self._frames.read(range(step, step + 1))[0], self.dtype)


def diff(
    source: Source | Volume,
    path: Place,
    *,
    variable: str | None = None,
    progress: Progress = silent,
) -> Compared:
    """Decode every step of the container `path`, or at a URL, and measure it against the data.

    source: data, or another container or a Volume of one, whose decoded values are the reference.
    variable: which one of the container, where it has several.

    Raises InputError if the shapes differ, DamagedFileError for a damaged container.
    """
    begun = time.perf_counter()
    if isinstance(source, str | Path) and is_container(source):
        with open_volume(source, variable=variable) as reference:
            return diff(reference, path, variable=variable, progress=progress)
    if isinstance(source, Volume):
        source = DecodedSeries(source)
    with open_source(source) as series, open_volume(path, variable=variable) as volume:
        if series.shape != volume.shape:
            raise InputError(
                f"{series.source} has shape {series.shape}, {path} has {volume.shape} "
                "in (t, z, y, x); give the same --var, --axes, --t"
            )
        differing = differences(series, volume)
        quality = measure(series, volume, progress)
        seconds = time.perf_counter() - begun
        described = report(volume, quality, seconds=seconds, files=series.files)
        return {**described, "differences": differing}


def differences(series: Series, volume: Volume) -> list[str]:
    """Differences of a series and a container beside the values, one line each.

    They are name and units of the variable and the positions along each axis. A name that a format
    without names took from its file is not compared, and neither are units that are not given, nor
    positions that are plain indices because the file has none.
    """
    found = []
    if series.name != volume.name and not _is_file_name(series):
        found.append(f"the data are of the variable {series.name}, {volume.path} of {volume.name}")
    if series.units and volume.units and series.units != volume.units:
        found.append(f"the data are in {series.units}, {volume.path} in {volume.units}")
    for axis in AXES:
        here, there = series.coords[axis].values, volume.coords[axis].values
        if not np.array_equal(here, there, equal_nan=True) and not _is_index(here):
            found.append(
                f"the data have other positions along {axis} than {volume.path}"
                f" ({here[0]:.9g} to {here[-1]:.9g}, not {there[0]:.9g} to {there[-1]:.9g})"
            )
    return found


def _is_file_name(series: Series) -> bool:
    """Whether the name of a series may come from that of its file, and says nothing of it."""
    stem = Path(series.source).name.replace("*", "")
    return not series.files or stem.startswith(series.name)


def _is_index(positions: npt.NDArray[np.float64]) -> bool:
    return bool((positions == np.arange(positions.size)).all())


def measure(
    series: Series,
    volume: Volume,
    progress: Progress,
    measured: Sequence[int] | None = None,
    observe: Callable[[Comparison], None] = lambda comparison: None,
) -> dict[str, Any]:
    """Measure every decoded step of a volume against its series: `metrics.Quality` as JSON values.

    measured: steps whose SSIM is measured; as many as there is time for if None (`steps_of_ssim`).
    observe: called with the comparison of each step, in their order.

    The bulk is that of the volume's header; it is found in the series if the header knows none.
    Raises InputError if the series changed since it was opened.
    """
    data_range = volume.value_range.high - volume.value_range.low
    # Integers of 64 bits are compared as such: as floats, equal ones could differ. Far from 0
    # their differences from one integer are, of which floats hold more digits.
    exact = volume.dtype.kind in "iu" and not volume.value_type.has_gaps
    source = volume.value_type.source
    origin, far = volume.value_range.origin(source), volume.value_range.is_far(source)
    read = partial(_differences, series, origin) if far else series.block
    bulk = _bulk(series, volume)
    about_bulk = None if bulk is None else bulk.moved(-origin)
    quality = measure_quality(
        Comparer(float(data_range), volume.background - origin, about_bulk, observe),
        read,
        DecodedFrames(volume, exact=exact, origin=origin if far else None).read,
        series.shape,
        steps_of_ssim(series) if measured is None else measured,
        progress,
        _neighbours(lambda step: read(range(step, step + 1))[0], series.shape[0], volume),
    )
    series.check()
    figures = quality.to_dict()
    if figures["bulk"] is not None and bulk is not None:
        figures["bulk"]["range"] = list(bulk.ends)
    return figures


def _differences(series: Series, origin: int, steps: range) -> npt.NDArray[Any]:
    """The frames of neighbouring steps less an integer."""
    return about_origin(series.block(steps), origin)


class DecodedFrames:
    """The decoded frames of a volume, read in their order.

    A layer of tiles would be decoded again and again where it is larger than the cache. Then the
    steps of a layer are decoded together.
    """

    def __init__(self, volume: Volume, *, exact: bool, origin: int | None = None) -> None:
        """Read nothing yet. exact: whether integers come as such, and not as floats.

        origin: integer that is subtracted from the values, which are 64-bit integers; None for
            others.
        """
        self._volume, self._exact, self._origin = volume, exact, origin
        self._steps, self._frames = range(0), np.empty(0)
        layer = min(volume.chunks[0], volume.shape[0])
        room = layer * prod(volume.shape[1:]) * volume.float_dtype.itemsize
        parts = -(-room // LAYER_BYTES)
        is_kept = 2 * room <= volume.container.cache_bytes
        self._layer, self._together = layer, 1 if is_kept else -(-layer // parts)

    def read(self, steps: range) -> npt.NDArray[Any]:
        """The frames (t, z, y, x) of neighbouring steps."""
        if self._together == 1:
            return self._decoded(steps)
        # A copy, so that a frame that is still compared does not hold the others.
        return np.stack([self._frame(step) for step in steps])

    def _decoded(self, steps: range) -> npt.NDArray[Any]:
        if self._origin is not None:
            return self._volume.differences_of_steps(steps, self._origin)
        return (self._volume.values_of_steps if self._exact else self._volume.read_steps)(steps)

    def _frame(self, step: int) -> npt.NDArray[Any]:
        """A frame (z, y, x), with which the others of its layer are decoded."""
        if step not in self._steps:
            self._frames = np.empty(0)  # its memory is free before more is decoded
            start = step // self._layer * self._layer
            first = start + (step - start) // self._together * self._together
            end = min(first + self._together, start + self._layer, self._volume.shape[0])
            self._steps = range(first, end)
            self._frames = self._decoded(self._steps)
        frame: npt.NDArray[Any] = self._frames[step - self._steps.start]
        return frame


def _neighbours(
    read: Callable[[int], npt.NDArray[Any]], steps: int, volume: Volume
) -> NeighboursOf | None:
    """The key frames of a series around each other step; None if every step is a key frame."""
    times = volume.key_times
    if len(times.key_frames) == steps:
        return None
    return neighbours_of(times.key_frames, times.key_index, read, volume.occupancy)


def _bulk(series: Series, volume: Volume) -> ValueRange | None:
    """The bulk of the values of a series that are in the coreset of a volume."""
    known = volume.info["quality"]
    if "bulk" in known:
        return None if known["bulk"] is None else ValueRange(*known["bulk"]["range"])

    origin = volume.value_range.origin(volume.value_type.source)
    read = partial(_differences, series, origin) if origin else series.block

    def counted_values() -> Iterator[npt.NDArray[Any]]:
        for _, block in step_blocks(range(series.shape[0]), series.shape[1:]):
            frames, mask = read(block), np.stack([volume.occupancy(step) for step in block])
            yield frames if mask.all() else frames[mask]

    whole = series.dtype.kind in "iu"
    bulk = find_bulk(counted_values, volume.value_range.moved(-origin), whole=whole)
    return None if bulk is None else bulk.moved(origin)
