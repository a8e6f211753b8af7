"""Many files as one series, and what belongs to the variable in all of them."""

from __future__ import annotations

import glob
import json
import os
import re
import warnings
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError, MissingInputError
from fhash_formats.readers.belonging import (
    Labels,
    counted_times,
    join_times,
    require_alike,
    require_same_grid,
)
from fhash_formats.readers.cf import NUMBERED
from fhash_formats.readers.file_series import FileSeries, FolderStamp, Stamp
from fhash_formats.readers.surroundings import warn_left_out
from fhash_formats.series import (
    Coordinate,
    NotStored,
    Series,
    SourceMetadata,
    SourceVariable,
    index_coordinate,
    is_plain_name,
    without_names,
)
from fhash_formats.support.values import PACKING, typed_attribute

DIFFERS = "differs between the files"


class _Joined:
    """The metadata of some files, as far as they were added."""

    def __init__(self, first: SourceMetadata, time: Coordinate) -> None:
        """Begin with those of the first file. time: of all steps."""
        self.left_out: dict[str, str] = {}
        self._first, self._time, self._along = first, time, first.along("t")
        self._attributes, self._own = dict(first.attributes), dict(first.variable_attributes)
        self._stored = first.stored
        self._pieces = {each.name: [each] for each in first.variables}

    def add(self, part: SourceMetadata) -> None:
        """Add the next file; raises InputError where it lies elsewhere on the map."""
        files = (str(part.file), str(self._first.file))
        require_same_grid(part, self._first, files)
        if part.dimensions != self._first.dimensions:
            self.left_out["dimensions"] = DIFFERS
        for name in _differing(self._attributes, part.attributes):
            if name in self._attributes and name != "history":
                del self._attributes[name]
                self.left_out[f":{name}"] = DIFFERS
        for name in _differing(self._own, part.variable_attributes):
            if name in self._own or name in PACKING:
                self._own.pop(name, None)
                self.left_out[name] = DIFFERS
        unpacked = PACKING & self.left_out.keys()
        for name in sorted(PACKING & self._own.keys()) if unpacked else ():
            del self._own[name]
            self.left_out[name] = f"of a packing that {DIFFERS}"
        if unpacked or part.stored != self._stored:
            self._stored = None
        for name, pieces in list(self._pieces.items()):
            other = part.named(name)
            if other is None or not self._fits(pieces[0], other):
                del self._pieces[name]
                self.left_out[name] = DIFFERS
            elif self._along in other.dimensions:
                pieces.append(other)

    def result(self, file: str) -> SourceMetadata:
        """The metadata of all files."""
        name = self._along or self._time.name
        dimensions = dict(self._first.dimensions)
        if self._along is None:
            if name in dimensions or not is_plain_name(name):
                name = "time_of_file"
            dimensions = {name: "t", **dimensions}
        time = self._time_variable(name)
        lost = set()
        if self._along is None or time.name not in self._pieces:
            # bounds of times that each file counts in its own way mean nothing together
            keys = {"bounds", "climatology"} & time.attributes.keys()
            lost = {str(time.attributes[key]) for key in keys}
        variables = [time]
        for each, (first, *others) in self._pieces.items():
            if others:
                values = [first.values, *(other.values for other in others)]
                axis = first.dimensions.index(name)
                first = replace(first, values=np.concatenate(values, axis=axis))
            if each not in (time.name, *lost):
                variables.append(first)
        self.left_out |= dict.fromkeys(lost & self._pieces.keys(), DIFFERS)
        gone = {each.name for each in self._first.variables} - {each.name for each in variables}
        return replace(
            self._first,
            dimensions=dimensions,
            variables=tuple(variables),
            variable_attributes=without_names(self._own, gone),
            stored=self._stored,
            attributes=self._attributes,
            file=file,
            digest=None,
        )

    def _time_variable(self, dimension: str) -> SourceVariable:
        """The times of all steps, in the type of the first file where that holds them."""
        first = self._first.named(self._time.name)
        values: Any = self._time.values
        if first is None or first.attributes.get("units") != self._time.attributes.get("units"):
            # the numbers of the steps stand for times, as some file has none
            return SourceVariable(
                name=dimension,
                dimensions=(dimension,),
                values=values,
                attributes=dict(self._time.attributes),
                is_coordinate=True,
            )
        self.left_out.pop(first.name, None)
        if first.values.dtype.kind in "iuf":
            with np.errstate(over="ignore", invalid="ignore"):
                narrow = values.astype(first.values.dtype)
            values = narrow if np.array_equal(narrow.astype(np.float64), values) else values
        return replace(first, dimensions=(dimension,), values=values)

    def _fits(self, one: SourceVariable, other: SourceVariable) -> bool:
        """Whether two files have the same array, or two pieces of one along time."""
        a, b = one.values, other.values
        if one.dimensions != other.dimensions or a.dtype != b.dtype or a.ndim != b.ndim:
            return False
        if _differing(one.attributes, other.attributes):
            return False
        if self._along in one.dimensions:
            axis = one.dimensions.index(self._along)
            return np.array_equal(np.delete(a.shape, axis), np.delete(b.shape, axis))
        same = a.tolist() == b.tolist() if a.dtype == object else a.tobytes() == b.tobytes()
        return a.shape == b.shape and same


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Names of the attributes that not both have, or that differ."""
    return [
        name
        for name in dict.fromkeys((*one, *other))
        if json.dumps(typed_attribute(one.get(name)))
        != json.dumps(typed_attribute(other.get(name)))
    ]


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
    columns = [texts for texts in zip(*words, strict=True) if len(set(texts)) > 1]
    if len(columns) != 1 or re.match(r"(19|20)[0-9]{4}", columns[0][0]):
        return
    texts = columns[0]
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
    """State of one file when the series was opened: its steps, of which some may count."""

    path: Path
    stamps: tuple[Stamp | FolderStamp, ...]
    steps: range
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

    times: of all steps, in place of those of the files. overlap: where files have the same span of
    time, the "first" or the "last" file counts; None refuses such files.
    """

    def __init__(
        self,
        pattern: str,
        paths: Sequence[Path],
        open_part: Callable[[Path], FileSeries],
        *,
        times: Coordinate | None = None,
        overlap: str | None = None,
    ) -> None:
        self.source = pattern
        self._open_part = open_part
        self._current: tuple[int, FileSeries] | None = None
        self._parts: list[_Part] = []
        names: list[str] = []
        limits: list[tuple[Any, Any] | None] = []
        counted = True
        files: list[Path] = []
        shares: dict[Path, npt.NDArray[np.float64]] = {}
        never: NotStored | None = None
        first: Series | None = None
        known: Labels | None = None
        fills: set[int | float | None] = set()
        for path in paths:
            with open_part(path) as part:
                first = first or part
                labels = replace(Labels.of(part), source=str(path))
                known = known or labels
                require_alike(labels, known)
                time = part.coords["t"] if "t" in part.given else None
                self._parts.append(
                    _Part(path=path, stamps=part.stamps, steps=range(part.shape[0]), time=time)
                )
                told = part.not_stored
                never = never or told
                shares[path] = np.zeros(part.shape[0]) if told is None else told.shares
                names.append(part.name)
                limits.append(part.valid)
                fills.add(part.fill)
                self.remark = self.remark or part.remark
                counted = counted and not part.remark.endswith(NUMBERED)
                files += part.files
        assert first is not None
        self.name, self.files = _common_name(names), tuple(dict.fromkeys(files))
        self.units, self.dtype, self.attributes = first.units, first.dtype, first.attributes
        self.inherit(first)
        # files packed by scales of their own have the same limit as different values
        ends = [each for each in limits if each is not None]
        whole = len(ends) == len(limits)
        self.valid = (min(e[0] for e in ends), max(e[1] for e in ends)) if whole else None
        # what stands for missing values in one file may be a value in another
        self.fill = first.fill if len(fills) == 1 else None
        timed = times or (counted and self._parts[0].time is not None)
        self.given = (first.given - {"t"}) | ({"t"} if timed else set())
        if overlap is not None:
            if not counted:
                raise InputError(f"{pattern}: --overlap is for files with times; some count steps")
            self._parts = _without_overlap(pattern, self._parts, overlap)
        if never is not None:
            cut = [shares[part.path][list(part.steps)] for part in self._parts]
            self.not_stored = replace(never, shares=np.concatenate(cut))
        self.occurring = self._met = set(first.occurring)
        self.defaults = self._defaults = set(first.defaults)
        self._ends = list(accumulate(len(part.steps) for part in self._parts))
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
        frame = part.read(self._parts[number].steps[step - self._ends[number]])
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
        """The metadata of all files, opened one after the other; None where one says nothing.

        Warns (FhashWarning) of what is left out.
        """
        joined: _Joined | None = None
        for part in self._parts:
            with self._reopened(part) as series, warnings.catch_warnings():
                if joined is not None:
                    warnings.simplefilter("ignore")  # it was said of the first file
                found = series.metadata
            if found is None:
                return None
            if len(part.steps) < series.shape[0]:
                found = found.cut({"t": part.steps})
            if joined is None:
                joined = _Joined(found, self.coords["t"])
            else:
                joined.add(found)
        assert joined is not None
        metadata = joined.result(Path(self.source).name)
        warn_left_out(f"{self.source}: not everything beside the values is kept", joined.left_out)
        return metadata

    def _times(self, counted: bool) -> Coordinate:
        """The times of all files; the numbers of the steps unless all files count theirs."""
        times = [(part.path, part.time) for part in self._parts if part.time is not None]
        if not times and all(len(part.steps) == 1 for part in self._parts):
            warn_of_gaps(self.source, [part.path for part in self._parts])
        if not times or not counted:
            return index_coordinate("t", self.shape[0])
        if len(times) < len(self._parts):
            path = next(part.path for part in self._parts if part.time is None)
            raise InputError(f"{self.source}: {path} has no time, and {times[0][0]} has one")
        return join_times(self.source, times)


def _without_overlap(source: str, parts: Sequence[_Part], overlap: str) -> list[_Part]:
    """Files with the steps that count where several have the same span of time.

    A file of which no step counts is left out. Raises InputError where a file has no times, or its
    own do not increase.
    """
    timed = [(part.path, part.time) for part in parts if part.time is not None]
    if len(timed) < len(parts):
        raise InputError(f"{source}: --overlap is for files with times; some have none")
    values = counted_times(source, timed)
    for each, (path, _) in zip(values, timed, strict=True):
        if not (np.isfinite(each).all() and (np.diff(each) > 0).all()):
            raise InputError(f"{source}: times do not increase in {path}")
    is_first = overlap == "first"
    edge = -np.inf if is_first else np.inf
    found = []
    for part, each in list(zip(parts, values, strict=True))[:: 1 if is_first else -1]:
        place = int(np.searchsorted(each, edge, "right" if is_first else "left"))
        steps = range(place, len(each)) if is_first else range(place)
        edge = max(edge, each[-1]) if is_first else min(edge, each[0])
        if steps:
            assert part.time is not None
            time = replace(part.time, values=part.time.values[steps.start : steps.stop])
            found.append(replace(part, steps=steps, time=time))
    return found[:: 1 if is_first else -1]


def _common_name(names: Sequence[str]) -> str:
    """The name of all, or what all begin with: "frame" for frame_01 and frame_02."""
    low, high = min(names), max(names)
    pairs = takewhile(lambda pair: pair[0] == pair[1], zip(low, high, strict=False))
    common = "".join(letter for letter, _ in pairs).rstrip("0123456789_-. ")
    return low if low == high else common or names[0]
