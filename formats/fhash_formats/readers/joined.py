"""Many files, each with one or more steps, as one series: "frames_*.raw"."""

from __future__ import annotations

import glob
import os
import re
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError, MissingInputError
from fhash_formats.readers.common.failures import FolderStamp, Stamp
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.joined_surroundings import joined_metadata
from fhash_formats.readers.common.times import is_numbered, join_times
from fhash_formats.series import Coordinate, NotStored, Series, index_coordinate
from fhash_formats.source_metadata import SourceMetadata


def is_pattern(text: str) -> bool:
    """Whether a path is a pattern of files (*, ?, [..]) and not the name of one."""
    return glob.has_magic(text) and not os.path.exists(text)


def natural_order(text: str) -> list[tuple[int, str]]:
    """Sort key that puts frame_9 before frame_10: runs of digits count as numbers."""
    return [
        (int(part), "") if part[:1].isdecimal() and part.isascii() else (-1, part)
        for part in re.split(r"([0-9]+)", text)
    ]


def files_of(pattern: str) -> list[Path]:
    """Files of a pattern in the order of the numbers in their names.

    Raises MissingInputError if there are none.
    """
    files = sorted(glob.glob(pattern), key=lambda name: (natural_order(name), name))
    if not files:
        raise MissingInputError(f"no file matches {pattern}")
    return [Path(name) for name in files]


def warn_of_gaps(pattern: str, paths: Sequence[Path]) -> None:
    """Warn (FhashWarning) of numbers that the names of files leave out.

    They go up by one step as a rule, and somewhere by several. Dates are no such numbers.
    """
    words = [re.split(r"([0-9]+)", str(path)) for path in paths]
    if len({len(each) for each in words}) > 1:
        return
    places = [n for n in range(len(words[0])) if len({each[n] for each in words}) > 1]
    if len(places) != 1 or re.match(r"(19|20)[0-9]{4}", words[0][places[0]]):
        return
    texts = [each[places[0]] for each in words]
    if not all(text.isdecimal() and len(text) < 18 for text in texts):
        return
    gaps = np.diff(np.array(texts, dtype=np.int64))
    usual = gaps.min(initial=1 << 62)
    if usual < 1 or (gaps == usual).sum() * 2 < len(gaps) or (gaps % usual).any():
        return
    (wide,) = np.nonzero(gaps > usual)
    if wide.size and len(gaps) > 1:
        first = int(wide[0])
        missing = int((gaps[wide] // usual - 1).sum())
        warnings.warn(
            f"{pattern}: {missing} numbers are left out, the first between {paths[first].name} and"
            f" {paths[first + 1].name}; the steps are taken as they are there",
            FhashWarning,
            stacklevel=2,
        )


@dataclass(frozen=True, kw_only=True)
class _Part:
    """State of one file when the series was opened."""

    path: Path
    stamps: tuple[Stamp | FolderStamp, ...]
    steps: int
    time: Coordinate | None

    def check(self) -> None:
        """Raise InputError if the file has changed since it was opened."""
        for stamp in self.stamps:
            stamp.check()


class JoinedSeries(Series):
    """The steps of several files one after the other; only the file read last is open.

    All files have the same variable, frame shape, type and spatial coordinates. Times are those of
    the files if they give them, counted as in the first one, and must then increase from file to
    file; otherwise they are 0, 1, 2, ... Raises InputError that names the file which differs.

    times: of all steps, in place of those of the files.
    """

    def __init__(
        self,
        pattern: str,
        paths: Sequence[Path],
        open_part: Callable[[Path], FileSeries],
        *,
        times: Coordinate | None = None,
    ) -> None:
        self.source = pattern
        self._open_part = open_part
        self._current: tuple[int, FileSeries] | None = None
        self._parts: list[_Part] = []
        names: list[str] = []
        counted = True
        files: list[Path] = []
        shares: list[npt.NDArray[np.float64]] = []
        never: NotStored | None = None
        first: Series | None = None
        for path in paths:
            with open_part(path) as part:
                first = first or part
                _check_alike(part, path, first, paths[0])
                time = part.coords["t"] if "t" in part.given else None
                self._parts.append(
                    _Part(path=path, stamps=part.stamps, steps=part.shape[0], time=time)
                )
                never = never or part.not_stored
                told = part.not_stored
                shares.append(np.zeros(part.shape[0]) if told is None else told.shares)
                names.append(part.name)
                self.remark = self.remark or part.remark
                counted = counted and not is_numbered(part.remark)
                files += part.files
        assert first is not None
        self.name, self.files = _common_name(names), tuple(dict.fromkeys(files))
        self.units, self.dtype, self.attributes = first.units, first.dtype, first.attributes
        self.inherit(first)
        if never is not None:
            self.not_stored = replace(never, shares=np.concatenate(shares))
        self._met = set(first.occurring)
        self.occurring = self._met
        self._defaults = set(first.defaults)
        self.defaults = self._defaults
        self._ends = list(accumulate(part.steps for part in self._parts))
        self.shape = (self._ends[-1], *first.shape[1:])
        self.coords = {**first.coords, "t": times or self._times(counted)}
        self.metadata = self._joined_metadata

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        number = bisect_right(self._ends, step)
        if self._current is None or self._current[0] != number:
            self.close()
            self._current = (number, self._reopened(self._parts[number]))
        part = self._current[1]
        frame = part.read(step - (self._ends[number] - self._parts[number].steps))
        self._met.update(part.occurring)
        self._defaults.update(part.defaults)
        return frame

    def check(self) -> None:
        for part in self._parts:
            part.check()

    def close(self) -> None:
        if self._current is not None:
            self._current[1].close()
            self._current = None

    def _reopened(self, part: _Part) -> FileSeries:
        part.check()  # before, because a file that is being written may not open at all
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it was said when the series was opened
            series = self._open_part(part.path)
        try:
            # after, because from here on the series compares with the file that it opened
            part.check()
        except BaseException:
            series.close()
            raise
        return series

    def _joined_metadata(self) -> SourceMetadata | None:
        """The metadata of all files, which are opened one after the other."""

        def each() -> Iterator[SourceMetadata | None]:
            for number, part in enumerate(self._parts):
                with self._reopened(part) as series, warnings.catch_warnings():
                    if number:
                        warnings.simplefilter("ignore")  # it was said of the first file
                    metadata = series.metadata
                yield metadata

        return joined_metadata(self.source, each(), self.coords["t"])

    def _times(self, counted: bool) -> Coordinate:
        """The times of all files; the numbers of the steps unless all files count theirs."""
        times = [(part.path, part.time) for part in self._parts if part.time is not None]
        if not times and all(part.steps == 1 for part in self._parts):
            warn_of_gaps(self.source, [part.path for part in self._parts])
        if not times or not counted:
            return index_coordinate("t", self.shape[0])
        for part in self._parts:
            if part.time is None:
                raise InputError(
                    f"{self.source}: {part.path} has no time, and {times[0][0]} has one"
                )
        return join_times(self.source, times)


def _common_name(names: Sequence[str]) -> str:
    """The name of all, or their common beginning before the numbers: "frame" for frame_01 and
    frame_02."""
    low, high = min(names), max(names)
    if low == high:
        return low
    same = next(
        (place for place, (one, other) in enumerate(zip(low, high, strict=False)) if one != other),
        len(low),
    )
    return low[:same].rstrip("0123456789_-. ") or names[0]


def _check_alike(part: Series, path: Path, first: Series, first_path: Path) -> None:
    for what, here, there in (
        ("a frame (z, y, x) of shape", part.shape[1:], first.shape[1:]),
        ("values of type", part.dtype, first.dtype),
        ("the unit", part.units, first.units),
    ):
        if here != there:
            raise InputError(
                f"{path} has {what} {here}, {first_path} {there}; files of one series must be alike"
            )
    for axis in ("z", "y", "x"):
        if not np.array_equal(part.coords[axis].values, first.coords[axis].values):
            raise InputError(
                f"{path} has other coordinates along {axis} than {first_path}; files of one series"
                " must be alike"
            )
