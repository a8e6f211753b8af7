"""`append`: further steps of a series behind those of an existing file, all of them or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.growing import GrowingFile
from fhash_codec.appending.resuming import continued
from fhash_codec.coreset.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Series
from fhash_formats.support.threads import thread_pool

__all__ = ["append"]


def append(
    source: Source, path: str | Path, *, keep: int | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Append the steps of a series to the file `path`, in its tiles, settings and bound.

    source: a file, a Series or an array, as `encode` takes it: of the number type and the shape
        (z, y, x) of the file, without missing values. Its times follow those of the file; where
        neither has times, steps are counted on.
    keep: number of steps of the file to keep, whole layers; all if None.

    Returns path, bytes, steps, and of these kept and appended; psnr, rmse and max_abs_error over
    all steps. The file is replaced by the longer one at the end, or stays as it was. Raises
    InputError for a file that cannot grow and for steps that do not fit.
    """
    path = Path(path)
    with open_source(source) as series:
        with open_volume(path) as volume:
            _require_same(series, volume)
        with continued(path, keep) as growing:
            kept = growing.steps
            growing.note(series.not_stored, series.shape[0])
            times = _times(series, growing)
            _add(series, growing, times, progress)
            series.check()
            growing.publish()
            steps = growing.steps
    with open_volume(path) as volume:
        info = volume.info
        figures = {name: info["quality"].get(name) for name in ("psnr", "rmse", "max_abs_error")}
    counted = {"steps": steps, "kept": kept, "appended": steps - kept}
    return {"path": str(path), "bytes": info["bytes"], **counted, **figures}


def _add(
    series: Series, growing: GrowingFile, times: npt.NDArray[np.float64], progress: Progress
) -> None:
    """Code all steps of a series, layer by layer."""
    layer, steps = growing.coder.tile[0], series.shape[0]
    with thread_pool() as workers:
        for first in range(0, steps, layer):
            span = range(first, min(first + layer, steps))
            frames = [_frame(series, step) for step in span]
            coded = growing.coder.code(frames, growing.figures, workers)
            growing.add(coded, times[span.start : span.stop].tolist(), publish=False)
            progress("appending", span.stop, steps, "")


def _frame(series: Series, step: int) -> npt.NDArray[Any]:
    """A frame; raises InputError for one with missing values."""
    frame = series.read(step)
    if frame.dtype.kind == "f" and not np.isfinite(frame).all():
        raise InputError(
            f"{series.source}: step {step} has values that are missing or infinite; a file that "
            "grows has none: encode these data as a file of their own"
        )
    return frame


def _require_same(series: Series, volume: Volume) -> None:
    """Raise InputError unless a series is more of what a volume is."""
    what, path = series.source, volume.path
    for name, here, there in (
        ("shape (z, y, x)", series.shape[1:], volume.shape[1:]),
        ("number type", str(series.source_dtype or series.dtype), volume.info["variable"]["dtype"]),
    ):
        if here != there:
            raise InputError(f"{what} has {name} {here}, {path} has {there}; they must be the same")
    if series.units and volume.units and series.units != volume.units:
        raise InputError(f"{what} is in {series.units}, {path} in {volume.units}; convert one")
    for axis in AXES[1:]:
        these, those = series.coords[axis].values, volume.coords[axis].values
        if not np.array_equal(these, those) and not _is_index(these):
            raise InputError(
                f"{what} has positions {these[0]:.9g} to {these[-1]:.9g} along {axis}, {path} has "
                f"{those[0]:.9g} to {those[-1]:.9g}; they must be the same"
            )
    units = series.coords["t"].attributes.get("units")
    other = volume.coords["t"].attributes.get("units")
    if units is not None and other is not None and units != other:
        raise InputError(f"times of {what} are in '{units}', those of {path} in '{other}'")


def _times(series: Series, growing: GrowingFile) -> npt.NDArray[np.float64]:
    """The times of the steps to append; raises InputError unless they follow those of the file."""
    times, before = series.coords["t"].values, growing.times
    if _is_index(times) and _is_index(np.array(before)):
        return times + len(before)
    _require_ascending(series.source, [*before[-1:], *times.tolist()], bool(before))
    return times


def _require_ascending(what: str, times: list[float], follows: bool) -> None:
    if follows and not times[1] > times[0]:
        raise InputError(
            f"{what} begins at time {times[1]:.9g}, and the file ends at {times[0]:.9g}; keep "
            "fewer steps of the file, or select later ones of the data"
        )
    if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise InputError(f"{what}: its times must be finite and ascend")


def _is_index(positions: npt.NDArray[np.float64]) -> bool:
    """Whether positions are those of an axis without any: counted from 0."""
    return np.array_equal(positions, np.arange(positions.size))
