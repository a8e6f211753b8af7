"""What a reader returns: a time-varying volume that is read one frame at a time.

The contract of every reader:

- axes are always (t, z, y, x), whatever the file's order; a frame is (z, y, x);
- `read(step)` reads one frame, and keeps of the file at most a slab of bounded size, so that no series is ever held whole;
- values are physical (packing undone, fill values turned into NaN) in the native byte order;
- coordinates are float64, one per axis, the plain index where the file has none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, RegionError

AXES = ("t", "z", "y", "x")
AXIS_NAMES = {"t": "time", "z": "z", "y": "y", "x": "x"}


@dataclass(frozen=True, kw_only=True)
class Coordinate:
    """Positions along one axis: `values` float64 (n,), the file's name for it, and its attributes (JSON values)."""

    name: str
    values: npt.NDArray[np.float64]
    attributes: Mapping[str, Any] = field(default_factory=dict)


def index_coordinate(axis: str, length: int) -> Coordinate:
    """The coordinate of an axis for which the file gives none: 0, 1, 2, ..."""
    return Coordinate(name=AXIS_NAMES[axis], values=np.arange(length, dtype=np.float64))


class Series(ABC):
    """A time-varying volume (t, z, y, x), read frame by frame.

    Attributes:
        source: path as given by the user, for messages.
        name: variable name, e.g. "density".
        units: of the values, "" where unknown.
        dtype: of the frames, native byte order, integer or float.
        shape: (t, z, y, x), every length at least 1.
        coords: a Coordinate for each of "t", "z", "y", "x".
        attributes: of the variable, JSON values only.
        files: what it is read from, files and folders; no output may replace them. None where it is in memory.
    """

    source: str
    name: str
    units: str
    dtype: np.dtype[Any]
    shape: tuple[int, int, int, int]
    coords: Mapping[str, Coordinate]
    attributes: Mapping[str, Any]
    files: tuple[Path, ...] = ()

    @abstractmethod
    def read(self, step: int) -> npt.NDArray[Any]:
        """One frame (z, y, x), C-contiguous, of `self.dtype`, not to be written to.

        Raises RegionError for a step outside 0 .. shape[0] - 1, InputError if the file cannot be read.
        """

    def require_step(self, step: int) -> None:
        """Raise RegionError for a step that the series has not; negative ones do not count from the end."""
        if not 0 <= step < self.shape[0]:
            raise RegionError(f"{self.source}: step {step} is outside 0..{self.shape[0] - 1}")

    def check(self) -> None:  # noqa: B027 - a series in memory does not change
        """Raise InputError if what it is read from changed since it was opened: then the frames read are not of one state.

        `read` notices most changes at once. Only this looks at every file, such as the chunks of a Zarr folder; whoever makes something
        of all frames calls it before that counts.
        """

    def close(self) -> None:  # noqa: B027 - a series in memory has nothing to release
        """Release the file."""

    def frames(self) -> Iterator[npt.NDArray[Any]]:
        """Every frame in order."""
        for step in range(self.shape[0]):
            yield self.read(step)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class StepsSeries(Series):
    """Some steps of another series, in the order given."""

    def __init__(self, whole: Series, steps: Sequence[int]) -> None:
        if not steps:
            raise InputError(
                f"{whole.source}: the selection of steps is empty; the series has {whole.shape[0]} steps"
            )
        for step in steps:
            whole.require_step(step)
        time = whole.coords["t"]
        self.whole = whole
        self.steps = tuple(steps)
        self.source, self.name, self.units = whole.source, whole.name, whole.units
        self.dtype, self.attributes, self.files = whole.dtype, whole.attributes, whole.files
        self.shape = (len(self.steps), *whole.shape[1:])
        chosen = Coordinate(
            name=time.name, values=time.values[list(self.steps)], attributes=time.attributes
        )
        self.coords = {**whole.coords, "t": chosen}

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return self.whole.read(self.steps[step])

    def check(self) -> None:
        self.whole.check()

    def close(self) -> None:
        self.whole.close()


class ArraySeries(Series):
    """An array in memory (t, z, y, x) or (z, y, x) as a series; masked values of floats are NaN.

    Raises InputError for an array that cannot be a series, and for coordinates that do not fit it.
    """

    def __init__(
        self,
        array: npt.ArrayLike,
        *,
        name: str = "values",
        units: str = "",
        coords: Mapping[str, Coordinate] | None = None,
    ) -> None:
        values = _unmasked(array)
        self.source, self.name, self.units, self.attributes = "array", name, units, {}
        if values.ndim == 3:
            values = values[None]
        self.shape = check_values(self.source, values.shape, values.dtype)
        self.dtype = values.dtype.newbyteorder("=")
        self.values = values
        self.coords = {
            axis: index_coordinate(axis, n) for axis, n in zip(AXES, self.shape, strict=True)
        } | dict(coords or {})
        check_coords(self.source, self.coords, self.shape)

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.values[step], dtype=self.dtype)


def check_values(
    what: str, shape: Sequence[int], dtype: np.dtype[Any]
) -> tuple[int, int, int, int]:
    """The shape (t, z, y, x) if an array of this shape and type can be a series, or an InputError that says why not."""
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(
            f"{what}: values of type {dtype} cannot be encoded; integers and floats up to 64 bits can"
        )
    if len(shape) != 4:
        raise InputError(
            f"{what}: {len(shape)} dimensions {tuple(shape)}; a series has 4 (t, z, y, x), or 3 (z, y, x) for one step"
        )
    if min(shape) < 1:
        raise InputError(f"{what}: an axis is empty, shape {tuple(shape)} in (t, z, y, x)")
    t, z, y, x = (int(n) for n in shape)
    return t, z, y, x


def check_coords(
    what: str, coords: Mapping[str, Coordinate], shape: tuple[int, int, int, int]
) -> None:
    """Raise InputError unless there is a coordinate for each of t, z, y, x, float64 and as long as its axis."""
    if set(coords) != set(AXES):
        raise InputError(
            f"{what}: coordinates of {sorted(coords)}; exactly those of t, z, y and x are needed"
        )
    for axis, length in zip(AXES, shape, strict=True):
        values = coords[axis].values
        if values.shape != (length,) or values.dtype != np.float64:
            raise InputError(
                f"{what}: the coordinate of {axis} is {values.dtype} {values.shape}; float64 ({length},) is needed"
            )


def _unmasked(array: npt.ArrayLike) -> npt.NDArray[Any]:
    """The values; masked ones must not pass for what happens to stand under the mask."""
    if not np.ma.is_masked(array):
        return np.asarray(array)
    masked: np.ma.MaskedArray[Any, Any] = np.ma.asarray(array)
    if masked.dtype.kind != "f":
        raise InputError(
            f"array: masked values of type {masked.dtype}, which has no NaN; convert it to float32 or float64 first"
        )
    filled: npt.NDArray[Any] = masked.filled(np.nan)
    return filled
