"""Series in a file: the user's request, errors of reading, coordinates with units."""

from __future__ import annotations

import hashlib
import importlib
import os
import re
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import (
    FhashError,
    InputError,
    MissingDependencyError,
    MissingInputError,
)
from fhash_formats.readers.cf import Packing, missing_values, note_packing, settled
from fhash_formats.series import (
    AXES,
    Coordinate,
    NotStored,
    Series,
    check_values,
    index_coordinate,
    plain_form,
)
from fhash_formats.support.values import plain_text

HEAD_BYTES = 4096
"""Bytes of a file by which its format is known; HDF5 may begin at byte 2048."""

DTYPES = {
    f"{kind}{8 * size}": f"{kind[0]}{size}"
    for kind, sizes in (("uint", (1, 2, 4, 8)), ("int", (1, 2, 4, 8)), ("float", (2, 4, 8)))
    for size in sizes
}
"""Number types of raw files by long name; the short names are the values."""

ENDIANS: dict[str, Literal["<", ">"]] = {"little": "<", "big": ">"}


def parse_dtype(text: str) -> np.dtype[Any]:
    """The number type of a long or short name ("float32", "f4"), in native byte order.

    Raises InputError for any other name.
    """
    short = DTYPES.get(text.lower(), text.lower())
    if short not in DTYPES.values():
        raise InputError(
            f"'{text}' is not a number type; allowed: {', '.join(DTYPES)} or short, such as f4 and"
            " u1"
        )
    return np.dtype(short)


def parse_shape(text: str) -> dict[str, int]:
    """Lengths by axis from text such as "x=64,y=64,z=32,t=10", in the order given.

    Raises InputError for text of another form.
    """
    shape: dict[str, int] = {}
    for part in text.split(","):
        match = re.fullmatch(r"\s*([tzyx])\s*=\s*([0-9]+)\s*", part)
        if match is None or match[1] in shape:
            raise InputError(
                f"shape '{text}': cannot use '{part.strip()}'; write each axis once, such as"
                " x=64,y=64,z=32,t=10"
            )
        shape[match[1]] = int(match[2])
    return shape


def parse_axes(text: str) -> tuple[str, ...]:
    """The axis of each dimension of the file from text such as "t,z,y,x", in any case.

    Raises InputError for text of another form.
    """
    letters = tuple(word.strip().lower() for word in text.split(","))
    if not set(letters) <= set(AXES) or len(set(letters)) != len(letters):
        raise InputError(
            f"axes '{text}': name the file's dimensions in their order, each once, by t, z, y and"
            " x, such as t,z,y,x"
        )
    return letters


def selection(select: Mapping[str, int | str] | None) -> tuple[tuple[str, str], ...]:
    """Pairs of names and indices, as `Request` holds them."""
    return tuple((str(name), str(index)) for name, index in (select or {}).items())


def inside_folder(path: Path, file: Path) -> None:
    """Raise InputError if a file that another one refers to is outside the folder of that.

    Links of the file system are followed.
    """
    if not file.resolve().is_relative_to(path.parent.resolve()):
        raise InputError(
            f"{path} refers to {file}, which is outside its folder; without --no-external"
            " (no_external=True) it is read"
        )


@dataclass(frozen=True)
class RawLayout:
    """Layout of a headerless file; the file's name replaces what is None.

    Attributes:
        shape: lengths by axis, for at least three of t, z, y, x; axes left out have length 1. x is
            the fastest in the file, then y, z, t.
        dtype: a key or value of DTYPES.
        endian: "little" (also where neither this nor the name says) or "big".

    Raises InputError for a value that is not allowed.
    """

    shape: Mapping[str, int] | None = None
    dtype: str | None = None
    endian: str | None = None

    def __post_init__(self) -> None:
        if self.shape is not None:
            if not set(self.shape) <= set(AXES) or len(self.shape) < 3:
                raise InputError(
                    f"raw shape names {', '.join(self.shape) or 'no axis'}; name three or four of"
                    " t, z, y, x, as in x=64,y=64,z=32"
                )
            for axis, length in self.shape.items():
                if length < 1:
                    raise InputError(f"raw shape: {axis}={length}; a length is at least 1")
        if self.dtype is not None:
            parse_dtype(self.dtype)
        if self.endian is not None and self.endian not in ENDIANS:
            raise InputError(f"byte order '{self.endian}'; allowed: {', '.join(ENDIANS)}")


@dataclass(frozen=True, kw_only=True)
class Request:
    """A request to a reader: name of the variable, axes of its dimensions, layout of raw bytes.

    None stands for what was not said.

    Attributes:
        booleans: lets boolean arrays through (for masks), as the numbers 0 and 1.
        missing: numbers that stand for missing values, besides those that the file declares. They
            are compared with the values after unpacking; `open_series` sees to it for all formats.
        raw_values: the numbers are read as stored; fill values, scale and offset are not applied.
        select: for dimensions that are no axis, (name, index) as texts; see layout.py.
        keep_extremes: extreme values that repeat are data, see `Series`.
        digested: the digest of the file is taken where its metadata are asked for.
        no_external: no file outside the folder of the one that is read may be read for it.
        overlap: "first" or "last", which file of a pattern counts where several have the same time.
        asked: a last dimension that may hold components is asked about; else it is x.
    """

    var: str | None = None
    axes: tuple[str, ...] | None = None
    raw: RawLayout | None = None
    booleans: bool = False
    missing: tuple[float, ...] = ()
    raw_values: bool = False
    select: tuple[tuple[str, str], ...] = ()
    keep_extremes: bool = False
    asked: bool = True
    digested: bool = True
    no_external: bool = False
    overlap: str | None = None

    def require_inside(self, path: Path, *files: Path) -> None:
        """Raise InputError if a file refers to others that may not be read; see `no_external`."""
        if self.no_external:
            for file in files:
                inside_folder(path, file)

    def beside(self, path: Path, file: Path) -> Path:
        """A file that another one names: no reader opens such a file in another way.

        Raises InputError for one that may not be read, and MissingInputError where it is not there.
        """
        self.require_inside(path, file)
        if not file.is_file():
            raise MissingInputError(f"{path} names {file}, which is not there")
        return file

    def refuse_var(self, source: str) -> None:
        """Raise InputError if a variable was named for a format that has none."""
        if self.var is not None:
            told = f"--var {self.var} cannot be used, this format holds one array without a name"
            raise InputError(f"{source}: {told}")


LONGEST_MESSAGE = 240
"""Characters kept of a library's message; HDF5 and zarr write paragraphs."""


def condense(error: BaseException) -> str:
    """A library's message on one line without colours, cut to a length that a terminal shows.

    The name of the error's type stands for an empty message.
    """
    text = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", str(error)).split()) or type(error).__name__
    return text if len(text) <= LONGEST_MESSAGE else text[: LONGEST_MESSAGE - 3] + "..."


def library(source: str, what: str, module: str, extra: str) -> Any:
    """A library that reads a format; raises MissingDependencyError that names what to install."""
    try:
        return importlib.import_module(module)
    except (ImportError, OSError, RuntimeError) as error:  # also without the library below it
        raise MissingDependencyError(
            f"{source}: {what} needs {module}: pip install '{extra}'"
        ) from error


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Turn any error of a library on damaged or unsuitable data into an InputError "what: message".

    The catch is wide on purpose: on the same broken file h5py raises OSError, RuntimeError or
    KeyError, and zarr whatever its codecs raise. Errors of this project and a lack of memory pass.
    """
    try:
        yield
    except (FhashError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{what}: {condense(error)}") from error


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put the name of a file before each message of this project that is raised inside.

    Errors of libraries become InputError, as in `refusing`.
    """
    try:
        with refusing(f"{source} cannot be read"):
            yield
    except (InputError, MissingDependencyError) as error:
        if source in str(error):
            raise
        raise type(error)(f"{source}: {error}") from error


@dataclass(frozen=True)
class Stamp:
    """State of a file when it was opened: size, time of change, identity.

    Readers check it around every frame.
    """

    path: Path
    size: int
    state: object
    files: int = 0

    @classmethod
    def of(cls, path: Path) -> Self:
        """The stamp of what is at the path now; raises InputError if it is gone."""
        with refusing(f"{path} cannot be read"):
            return cls(path, *cls._look(path))

    @staticmethod
    def _look(path: Path) -> tuple[int, object, int]:
        found = os.stat(path)
        return found.st_size, (found.st_mtime_ns, found.st_ino), 0

    def again(self) -> Self:
        """The stamp of what is there now. Raises OSError."""
        return type(self)(self.path, *self._look(self.path))

    def check(self) -> None:
        """Raise InputError if anything has changed, so that frames of two states never mix."""
        try:
            now = self.again()
        except FileNotFoundError:
            raise InputError(f"{self.path} was removed while it was being read") from None
        except OSError as error:
            raise InputError(f"{self.path} cannot be read: {condense(error)}") from error
        if now == self:
            return
        told = "same size, written again"
        if now.files != self.files:
            told = (
                f"{self.files} files and {self.size} bytes before, {now.files} and {now.size} now"
            )
        elif now.size != self.size:
            told = f"{self.size} bytes before, {now.size} now"
        raise InputError(
            f"{self.path} changed while it was being read ({told}); wait until it is complete and"
            " start again"
        )


class FolderStamp(Stamp):
    """State of a folder: number of files, their bytes, and a digest of names, sizes and times.

    It looks at every file, which is too slow around every frame: `Series.check` uses it.
    """

    @staticmethod
    def _look(path: Path) -> tuple[int, object, int]:
        files, size, digest = 0, 0, hashlib.sha256()
        folders = [os.fspath(path)]
        while folders:
            folder = folders.pop()
            with os.scandir(folder) as found:
                entries = sorted(found, key=lambda entry: entry.name)
            for entry in entries:
                if entry.is_dir():
                    folders.append(entry.path)
                    continue
                state = os.stat(entry.path)
                files, size = files + 1, size + state.st_size
                figures = f"{state.st_size} {state.st_mtime_ns} {state.st_ino}"
                digest.update(f"{entry.path}\0{figures}\0".encode(errors="surrogateescape"))
        return size, digest.digest(), files


@dataclass(frozen=True)
class UrlStamp(Stamp):
    """State of a file at a URL, as far as its server tells it.

    Each look is a request, so `Series.check` alone uses it.

    Attributes:
        ask: gives the server's answer as a mapping, as `info` of fsspec does.
    """

    ask: Callable[[], Mapping[str, Any]] = field(default=dict, compare=False)

    @classmethod
    def at(cls, url: str, ask: Callable[[], Mapping[str, Any]]) -> Self:
        """The stamp of a file. Raises OSError, or what the library of the store raises."""
        from fhash_formats.container.remote import state_of

        told = ask()
        return cls(Path(url), int(told.get("size") or 0), state_of(told), ask=ask)

    def again(self) -> Self:
        return self.at(str(self.path), self.ask)


SLAB_BYTES = 64 * 2**20
"""Bytes of a file that are kept between frames, at most.

A chunk that spans many steps would be decompressed again for each of them. With this limit, chunks
of several frames of 128^3 float64 are decompressed once, and memory stays small beside the
encoder's own.
"""

MAX_AXIS = 1 << 24
"""Positions along an axis of a file, which take 128 MiB."""


def require_length(axis: str, count: int) -> None:
    """Raise InputError for more positions along an axis than there can be."""
    if count > MAX_AXIS:
        raise InputError(f"it has {count} positions along {axis}; {MAX_AXIS} are possible")


Fetch = Callable[[tuple[slice | int, ...]], npt.NDArray[Any]]


def native(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Type of the frames of stored values: native byte order, booleans as the numbers 0 and 1."""
    return np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")


@dataclass(frozen=True, kw_only=True)
class Stored:
    """The values of a series as they lie in its files.

    Attributes:
        source: name for messages, that of the first file.
        stamp: checked before and after every fetch; None for values in memory.
        beside: further files that hold values, checked likewise.
        slow: stamp that takes long, of a folder or at a URL: `FileSeries.check` alone looks at it.
        close: lets go of all that is open.
        shape, axes: lengths and axes of the dimensions, in the file's order.
        dtype: type of the physical values, in any byte order.
        fetch: `fetch(slices)` returns a fresh array of the file's dimensions.
        chunks: shape of a stored chunk, or the lengths of all along a dimension; None without
            chunks. As many steps of one chunk as fit SLAB_BYTES are fetched at once and kept until
            the next fetch; without chunks, one frame at a time.
        packing: the packing that `fetch` undoes, if any; it says what stood for missing values.
        not_stored: what nobody wrote, with the number that stands there as it is stored.
        default_fill: value as it is read that stands for one that nobody wrote, see
            `Series.defaults`.
    """

    source: str
    stamp: Stamp | None
    beside: Sequence[Path]
    slow: Stamp | None
    close: Callable[[], None]
    shape: Sequence[int]
    axes: Sequence[str]
    dtype: np.dtype[Any]
    fetch: Fetch
    chunks: Sequence[int | Sequence[int]] | None
    packing: Packing | None
    not_stored: NotStored | None
    default_fill: float | None


class FileSeries(Series):
    """A series whose frames are fetched from a file, as slices in the file's order of dimensions.

    Raises InputError for a shape or type that cannot be a series.

    Attributes:
        stamps: stamps of everything that is read, from when it was opened.
    """

    def __init__(
        self,
        name: str,
        stored: Stored,
        coords: Mapping[str, Coordinate],
        attributes: Mapping[str, Any],
    ) -> None:
        lengths = dict(zip(stored.axes, stored.shape, strict=True))
        self.source, self.name, self.dtype = stored.source, plain_text(name), native(stored.dtype)
        self.files = () if stored.stamp is None else (Path(stored.source), *stored.beside)
        self.shape = check_values(self.source, [lengths.get(axis, 1) for axis in AXES], self.dtype)
        for axis, length in zip(AXES, self.shape, strict=True):
            require_length(axis, length)
        self.attributes = dict(attributes)
        self.units = str(self.attributes.get("units", ""))
        if "t" in coords:
            time, self.remark = settled(coords["t"])
            coords = {**coords, "t": time}
        self.given = frozenset(coords)
        self.coords = {
            axis: index_coordinate(axis, length)
            for axis, length in zip(AXES, self.shape, strict=True)
        } | {axis: replace(each, name=plain_form(each.name)) for axis, each in coords.items()}
        self._axes, self._fetch, self._close = tuple(stored.axes), stored.fetch, stored.close
        opened = () if stored.stamp is None else (stored.stamp,)
        self._quick = (*opened, *map(Stamp.of, stored.beside))
        self.stamps = self._quick if stored.slow is None else (*self._quick, stored.slow)
        most = max(1, SLAB_BYTES // (self.dtype.itemsize * prod(self.shape[1:])))
        self._starts = _slabs(_steps_of_chunks(self._axes, stored.shape, stored.chunks), most)
        self._held_slab: tuple[int, npt.NDArray[Any]] | None = None
        self._missing: Packing | None = None
        self._sought: dict[float, Any] = {}
        self.occurring = self._met = set[float]()
        self.not_stored = stored.not_stored
        self._default = stored.default_fill
        self.defaults = self._defaults = set[float]()
        if stored.packing is not None:
            note_packing(self, stored.packing)
        self._unpack_fill(stored.packing)

    def hide(self, missing: Sequence[float]) -> None:
        """Make some values missing: they become NaN, and integers become floats.

        missing: as they are read, after unpacking.
        """
        if missing:
            self._missing = missing_values(self.source, self.dtype, missing)
            for value in missing:
                for fill in missing_values(self.source, self.dtype, [value]).fills:
                    self._sought[value] = fill
                    self._default = None if fill == self._default else self._default
            note_packing(self, self._missing)
            self.dtype = self._missing.dtype
            self._unpack_fill(self._missing)

    def _unpack_fill(self, packing: Packing | None) -> None:
        """Make the number that stands for what nobody wrote a value; a missing one tells itself."""
        found = self.not_stored
        if found is None:
            return
        stored = np.array([found.fill], self.dtype if packing is None else packing.stored)
        fill = stored[0] if packing is None else packing.unpack(stored)[0]
        self.not_stored = None if fill != fill else replace(found, fill=fill.item())

    def as_asked(self, request: Request) -> Self:
        """Return this series with the values missing, or kept, that the user named."""
        self.hide(request.missing)
        self.keep_extremes = request.keep_extremes
        if self.keep_extremes:
            self._default = None
        told = self.not_stored
        if told is not None and told.fill == self._default and self.dtype.kind == "f":
            self.not_stored = None  # missing, as the frames will show
        return self

    def read(self, step: int) -> npt.NDArray[Any]:
        frame: npt.NDArray[Any] = self.read_steps(range(step, step + 1))[0]
        return frame

    def read_steps(self, steps: range) -> npt.NDArray[Any]:
        self.require_step(steps.start)
        self.require_step(steps.stop - 1)
        if len(self._starts) > self.shape[0]:  # a slab is a step
            return np.ascontiguousarray(self._block(steps.start, steps.stop), dtype=self.dtype)
        result = np.empty((len(steps), *self.shape[1:]), self.dtype)
        place = steps.start
        while place < steps.stop:
            number = bisect_right(self._starts, place) - 1
            last = bisect_right(self._starts, steps.stop) - 1
            if place != self._starts[number] or last == number:
                inside = place - self._starts[number]
                values = self._slab(number)[inside:][: steps.stop - place]
            else:  # whole chunks, of which nothing is read again
                values = self._block(place, self._starts[last])
            result[place - steps.start :][: len(values)] = values
            place += len(values)
        return result

    def _slab(self, number: int) -> npt.NDArray[Any]:
        """The steps of a slab, which are kept."""
        held = self._held_slab
        if held is None or held[0] != number:
            self._held_slab = None  # before the fetch, so that two slabs are never held
            read = self._block(self._starts[number], self._starts[number + 1])
            held = self._held_slab = (number, read)
        else:
            self._check_files()
        return held[1]

    def check(self) -> None:
        for stamp in self.stamps:
            stamp.check()

    def close(self) -> None:
        self._held_slab = None
        self._close()

    def _check_files(self) -> None:
        for stamp in self._quick:
            stamp.check()

    def _block(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Steps start to stop as (t, z, y, x)."""
        steps = f"step {start}" if stop == start + 1 else f"steps {start} to {stop - 1}"
        expected = dict(zip(AXES, (stop - start, *self.shape[1:]), strict=True))
        ranges = {axis: slice(0, length) for axis, length in expected.items()}
        ranges["t"] = slice(start, stop)
        self._check_files()
        try:
            with refusing(f"{self.source}: {steps} of {self.name} cannot be read"):
                values = self._fetch(tuple(ranges[axis] for axis in self._axes))
        except InputError:
            self.check()  # a part that was cut or written again tells nothing of that
            raise
        self._check_files()
        if values.shape != tuple(expected[axis] for axis in self._axes):
            raise InputError(
                f"{self.source}: {steps} of {self.name} came as {values.shape}; the file changed"
                " while it was being read"
            )
        if self._default is not None and (unwritten := values == self._default).any():
            self._defaults.add(self._default)
            if values.dtype.kind == "f":
                values = np.where(unwritten, values.dtype.type(np.nan), values)
        if self._missing is not None:
            self._met.update(
                value
                for value, fill in self._sought.items()
                if value not in self._met and (values == fill).any()
            )
            values = self._missing.unpack(values.astype(self._missing.stored, copy=False))
        ordered = values.transpose([self._axes.index(each) for each in AXES if each in self._axes])
        return ordered.reshape([*expected.values()])


def _steps_of_chunks(
    axes: Sequence[str], shape: Sequence[int], chunks: Sequence[int | Sequence[int]] | None
) -> list[int]:
    """Steps in each chunk.

    Without chunks one in each, or all steps where time is not the slowest dimension.
    """
    if "t" not in axes:
        return [1]
    place = axes.index("t")
    if chunks is None:
        return [1] * shape[0] if place == 0 else [shape[place]]
    told = chunks[place]
    if isinstance(told, int | np.integer):
        whole, rest = divmod(shape[place], int(told))
        return [int(told)] * whole + [rest] * (rest > 0)
    return [int(each) for each in told]


def _slabs(chunks: Sequence[int], most: int) -> list[int]:
    """First steps of slabs of at most so many steps, none of two chunks, and the end of all."""
    starts: list[int] = []
    first = 0
    for length in chunks:
        starts += range(first, first + length, most)
        first += length
    return [*starts, first]
