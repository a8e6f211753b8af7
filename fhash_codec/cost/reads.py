"""Reads of `fhash cost`: frames, regions, lines in time and levels of detail from each file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.facts import Facts
from fhash_codec.cost.own import KeptFile
from fhash_codec.cost.results import Read
from fhash_codec.measure.errors import psnr
from fhash_codec.progress import Progress
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.series import Series

__all__ = ["LEVELS", "interpolated", "measure_reads"]

REGION = 16
"""Vertices of a region along each axis."""
PLACES = 5
"""Random places of each kind of read; one more is a warm-up."""
LEVELS = (1, 2, 3)
"""Levels of detail."""

Values = npt.NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """A kind of read.

    Attributes:
        read: reads at a step and region; the values that were read.
        compare: pairs of (original, read) of the last read, both of one shape.
    """

    what: str
    read: Callable[[Volume, int, Box], Values]
    compare: Callable[[Volume, int, Box, Values], tuple[Values, Values]] | None
    size: tuple[int, int, int] | None


def measure_reads(
    series: Series,
    files: Sequence[KeptFile],
    facts: Facts,
    allowance: Allowance,
    progress: Progress,
) -> Iterator[Read]:
    """Measure every kind of read from every file, until the time of the part is over.

    Each read opens the file anew; the operating system has it in memory. The places are the same
    for every file.
    """
    for number, file in enumerate(files):
        with allowance.work(f"reads of {file.name}"):
            expected = 0.0
            for kind in _kinds(series, _profile(file.path)):
                if not allowance.has(f"{kind.what} of {file.name}", expected):
                    break
                begun = time.perf_counter()
                yield _measured(series, file, kind, facts)
                expected = time.perf_counter() - begun
        progress("reading", number + 1, len(files), file.name)
        if allowance.interrupted:
            break


def _profile(path: Path) -> str:
    with open_volume(path) as volume:
        return volume.profile


def _kinds(series: Series, profile: str) -> Iterator[_Kind]:
    """The kinds of reads that a series and a profile have."""
    steps, *space = series.shape

    def original(_: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        return series.read(step)[region.slices()], values

    def over_time(_: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        frames = [series.read(number)[region.slices()].ravel() for number in range(steps)]
        return np.concatenate(frames), values

    small = tuple(min(REGION, n) for n in space)
    yield _Kind(what="open", read=lambda volume, *_: np.empty(0), compare=None, size=None)
    yield _Kind(
        what="frame",
        read=lambda volume, step, region: volume.read(step),
        compare=original,
        size=(space[0], space[1], space[2]),
    )
    yield _Kind(
        what=f"region of {REGION}^3",
        read=lambda volume, step, region: volume.read(step, region),
        compare=original,
        size=(small[0], small[1], small[2]),
    )
    if steps > 1:
        yield _Kind(what="line in time", read=_line, compare=over_time, size=(1, 1, 1))
    if profile == "compact":
        for lod in LEVELS:
            if max(space) > 1 << lod:
                yield _level(series, lod)


def _line(volume: Volume, step: int, region: Box) -> Values:
    """All steps of one vertex."""
    return np.concatenate([volume.read(t, region).ravel() for t in range(volume.shape[0])])


def _level(series: Series, lod: int) -> _Kind:
    """A whole frame at a level of detail; its error is that of linear interpolation between its
    vertices."""
    _, *space = series.shape

    def compare(volume: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        fine = interpolated(values, volume.lod_vertices(lod), space)
        return series.read(step), fine

    return _Kind(
        what=f"level of detail {lod}",
        read=lambda volume, step, region: volume.read_lod(step, lod),
        compare=compare,
        size=(space[0], space[1], space[2]),
    )


def interpolated(values: Values, places: Sequence[range], space: Sequence[int]) -> Values:
    """Values (z, y, x) at some vertices, linear between them and constant beyond, at all vertices.

    Args:
        values: (z, y, x), NaN where there is none.
        places: the vertices of the values along each axis.
        space: vertices of the domain along each axis.
    """
    result = np.asarray(values, dtype=np.float64)
    for axis, (at, length) in enumerate(zip(places, space, strict=True)):
        position = np.interp(np.arange(length), np.asarray(at), np.arange(len(at)))
        low = np.floor(position).astype(np.int64)
        high = np.minimum(low + 1, len(at) - 1)
        share = (position - low).reshape([-1 if n == axis else 1 for n in range(3)])
        # A weight of 0 must not spread NaN.
        upper = np.where(share > 0, np.take(result, high, axis), 0.0)
        result = np.take(result, low, axis) * (1 - share) + upper * share
    return result


def _measured(series: Series, file: KeptFile, kind: _Kind, facts: Facts) -> Read:
    """The medians of a kind of read."""
    rng = np.random.default_rng(0)
    steps, *space = series.shape
    size = kind.size or (1, 1, 1)
    taken, touched = [], []
    squares, count, largest = 0.0, 0, 0.0
    values: Values = np.empty(0)
    for place in range(PLACES + 1):
        step = int(rng.integers(0, steps))
        low = [int(rng.integers(0, n - m + 1)) for n, m in zip(space, size, strict=True)]
        region = Box.of_shape(size).shift(low)
        begun = time.perf_counter()
        with open_volume(file.path) as volume:
            values = kind.read(volume, step, region)
            seconds = time.perf_counter() - begun
            if place == 0:
                continue
            taken.append(seconds)
            touched.append(volume.container.bytes_read)
            if kind.compare is None:
                continue
            original, decoded = kind.compare(volume, step, region, values)
        both = np.isfinite(original) & np.isfinite(decoded)
        # Scaled by a power of two near the range, squares of large values do not overflow.
        scaled = (part[both].astype(np.float64) * facts.scale for part in (original, decoded))
        error = np.abs(np.subtract(*scaled))
        squares, count = squares + float(np.sum(error**2)), count + error.size
        largest = max(largest, float(error.max(initial=0.0)))
    rmse = (squares / count) ** 0.5 if count else None
    return Read(
        file=file.name,
        file_psnr=file.psnr,
        what=kind.what,
        values=values.size,
        milliseconds=1e3 * median(taken),
        bytes_read=round(median(touched)),
        psnr=psnr(facts.scaled_width, rmse),
        max_abs_error=largest / facts.scale if count else None,
    )
