"""`Volume`: a `.fhz` file read like an array (t, z, y, x). numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from math import prod
from pathlib import Path
from types import EllipsisType, TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Spans
from fhash_codec.coreset.key_frames import KeyTimes, strictly_monotonic, time_axis
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.volume_model import open_model
from fhash_formats.container import Container
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate

Index = int | slice | EllipsisType
OUTSIDE = ("nan", "background")
MAX_LOD = 10


def open(path: str | Path) -> Volume:
    """Open a `.fhz` file for reading; nothing is decoded yet.

    Raises MissingInputError, DamagedFileError or UnsupportedFileError.
    """
    return Volume(Container.open(path))


class Volume:
    """A time-varying volume in a container: reads like a numpy array (t, z, y, x), decoding just what is asked for.

    Values are in data units; vertices outside the coreset, and where the source had no finite value, are NaN.

    Attributes:
        shape: (t, z, y, x). dims: its names. chunks: what one read decodes at least.
        dtype: float64 for sources of float64 or of integers above 16 bits, else float32.
        name, units, attrs: of the variable. coords: a Coordinate for each of "t", "z", "y", "x".
        path: of the file. info: everything the file says of itself, as JSON values.
    """

    dims = AXES
    ndim = 4

    def __init__(self, container: Container) -> None:
        """Over an open container, which it closes; `fhash_codec.open` is for files."""
        header = container.header
        self.container = container
        self.path = Path(container.path)
        self.shape: tuple[int, int, int, int] = tuple(header["domain"]["shape"])
        self.dtype = decoded_type(np.dtype(header["variable"]["dtype"]))
        self.name: str = header["variable"]["name"]
        self.units: str = header["variable"]["units"]
        self.attrs: Mapping[str, Any] = header["variable"]["attributes"]
        self.box = Box.of(header["feature_bounding_box"])
        self.profile: str = header["model"]["profile"]
        self.value_range = ValueRange(*header["value_range"])
        self.background = float(header["background"])
        self._model = open_model(container)
        self.chunks = self._model.chunks

    # -- what the file says ------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of vertices."""
        return prod(self.shape)

    @cached_property
    def coords(self) -> dict[str, Coordinate]:
        """Positions along each axis, in the units of the source."""
        return {axis: self.container.coordinate(stored) for axis, stored in AXIS_NAMES.items()}

    @cached_property
    def key_times(self) -> KeyTimes:
        """How steps and times map to the model's time axis."""
        stored = self.container.arrays.get("key_frames")
        key_frames = tuple(
            range(self.shape[0]) if stored is None else (int(step) for step in stored.read())
        )
        return KeyTimes(times=time_axis(self.coords["t"].values), key_frames=key_frames)

    @property
    def info(self) -> dict[str, Any]:
        """The container's header with the figures that follow from it: bytes, raw bytes, ratio, key frames, arrays."""
        header = self.container.header
        raw = self.size * np.dtype(header["variable"]["dtype"]).itemsize
        arrays = {
            name: {
                "shape": list(array.shape),
                "dtype": str(array.dtype),
                "bytes": array.nbytes_stored,
            }
            for name, array in self.container.arrays.items()
        }
        return {
            **header,
            "path": str(self.path),
            "bytes": self.container.size,
            "overhead_bytes": self.container.overhead(),
            "raw_bytes": raw,
            "ratio": raw / self.container.size,
            "key_frames": list(self.key_times.key_frames),
            "arrays": arrays,
        }

    def verify(self, progress: Progress = silent) -> int:
        """Read and check every array; their number. Raises DamagedFileError."""
        return self.container.verify(lambda done, total: progress("verifying", done, total, ""))

    # -- reading -----------------------------------------------------------------------------------------------------------

    def read(
        self, t: float, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (z, y, x) of `self.dtype` of a region (all if None) at step `t`, which may lie between steps.

        Between steps time runs evenly from one to the next. Outside the coreset stands NaN, or with outside='background' the
        mean of what was left out; where the source had no finite value stands NaN in any case.
        Raises RegionError for a step or region outside the domain, InputError for another `outside`.
        """
        if outside not in OUTSIDE:
            raise InputError(f"outside is '{outside}'; allowed: {', '.join(OUTSIDE)}")
        key = self._key_index(t)
        region = self._checked(region)
        result = np.full(region.shape, np.nan, dtype=self.dtype)
        found = self._within_box(region)
        if found is not None:
            target, local = found
            requested = self._occupied(key, local)
            np.copyto(
                result[target],
                self._model.read(key, local, requested).astype(self.dtype, copy=False),
                where=requested,
            )
        if outside == "background":
            result[np.isnan(result)] = self.background
        missing = self._missing_at(t)
        if missing is not None:
            result[missing[region.slices()]] = np.nan
        return result

    def read_lod(self, t: float, lod: int, region: Spans | None = None) -> npt.NDArray[Any]:
        """Every 2^lod-th vertex (z, y, x) of the feature bounding box at step `t`, low-passed, of `self.dtype`; compact files only.

        lod: 0 to 10; 0 is the box as `read` gives it. region: those that lie in it, in vertices of the domain (all if None); see
        `lod_vertices`. Finer detail, and what lies in other tiles, is not decoded. NaN outside the coreset of these vertices.
        Raises RegionError for a step outside the series and a region without such a vertex, InputError for a file of another profile or
        another lod.
        """
        vertices = self.lod_vertices(lod, region)
        if not float(t).is_integer():
            raise InputError(f"step {t:g} lies between two; levels of detail are of whole steps")
        step = int(self._key_index(t))
        part = Box.of(
            ((v[0] - low) >> lod, ((v[-1] - low) >> lod) + 1)
            for v, low in zip(vertices, self.box.first, strict=True)
        )
        values = self._model.read_lod(step, int(lod), part).astype(self.dtype)
        surrounding = Box.of((v[0], v[-1] + 1) for v in vertices)
        values[~self.occupancy(t, surrounding)[(slice(None, None, 1 << lod),) * 3]] = np.nan
        return values

    def lod_vertices(self, lod: int, region: Spans | None = None) -> tuple[range, range, range]:
        """The vertices (z, y, x) of the domain that `read_lod` gives: every 2^lod-th of the feature bounding box, within a region.

        Raises InputError for another lod than 0 to 10, RegionError for a region outside the domain or without such a vertex.
        """
        if (
            isinstance(lod, bool)
            or not isinstance(lod, int | np.integer)
            or not 0 <= lod <= MAX_LOD
        ):
            raise InputError(f"lod is {lod}; allowed: 0 to {MAX_LOD}")
        every = 1 << int(lod)
        found = []
        for axis, (first, end), (low, high) in zip(
            AXES[1:], self.box, self._checked(region), strict=True
        ):
            inside = range(first + -(-max(low - first, 0) // every) * every, min(high, end), every)
            if not inside:
                raise RegionError(
                    f"{self.path}: region {low}:{high} of axis {axis} holds no vertex of level of detail {lod}, "
                    f"every {every}. from {first} to {end - 1}"
                )
            found.append(inside)
        z, y, x = found
        return z, y, x

    def __getitem__(self, index: Index | tuple[Index, ...]) -> npt.NDArray[Any]:
        """Values by numpy's basic indexing: integers, slices and `...`, negative as usual; RegionError (an IndexError) outside."""
        parts = _expanded(index)
        picked = [
            _positions(part, length, axis)
            for part, length, axis in zip(parts, self.shape, AXES, strict=True)
        ]
        steps, *space = picked
        result = np.empty([len(p) for p in picked], dtype=self.dtype)
        if result.size:
            region = Box.of((min(p), max(p) + 1) for p in space)
            local = np.ix_(*(np.array(p) - low for p, low in zip(space, region.first, strict=True)))
            for number, step in enumerate(steps):
                result[number] = self.read(step, region)[local]
        return result[
            tuple(0 if isinstance(part, int | np.integer) else slice(None) for part in parts)
        ]

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        """The whole volume."""
        if copy is False:
            raise ValueError(
                "a volume cannot become an array without a copy: its values are decoded"
            )
        values = self[...]
        return values if dtype is None else values.astype(dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def sample(
        self,
        *,
        z: npt.ArrayLike,
        y: npt.ArrayLike,
        x: npt.ArrayLike,
        t: npt.ArrayLike | None = None,
        time: npt.ArrayLike | None = None,
        gradient: bool = False,
    ) -> npt.NDArray[Any] | tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Values at points between vertices, in data units; the arguments broadcast against each other.

        z, y, x: positions in vertices (0 is the first). t: position in steps; or time: in the units of the series' times.
        gradient: also return derivatives (..., 4) of the value by t, z, y and x, in data units per step and per vertex: analytic,
        through interpolation and network; on the border of two cells those of the cell after it.
        A point is NaN where a vertex of its cell that counts is outside the coreset, and outside the domain.
        Raises InputError unless just one of t and time is given, RegionError for a step or time outside the series.
        """
        if (t is None) == (time is None):
            raise InputError("give either t (in steps) or time (in the units of the series)")
        if t is None:
            t = self._checked_times().steps_of_times(np.asarray(time, dtype=np.float64))
        points = np.broadcast_arrays(*(np.asarray(p, dtype=np.float64) for p in (t, z, y, x)))
        shape = points[0].shape
        steps, *space = (p.ravel() for p in points)
        keys = self.key_times.key_indices(steps)
        local = [p - low for p, low in zip(space, self.box.first, strict=True)]
        inside = self._interpolable(steps, keys, space)
        values: npt.NDArray[Any] = np.full(inside.shape, np.nan)
        slopes = np.full((*inside.shape, 4), np.nan)
        if inside.any():
            chosen = [p[inside] for p in (keys, *local)]
            if gradient:
                values[inside], slopes[inside] = self._model.sample_with_gradient(
                    chosen[0], chosen[1:]
                )
                # From per key frame to per step: between two steps the key index runs evenly.
                first = np.minimum(np.floor(steps[inside]), max(self.shape[0] - 2, 0))
                after = np.minimum(first + 1, self.shape[0] - 1)
                slopes[inside, 0] *= self.key_times.key_indices(after) - self.key_times.key_indices(
                    first
                )
            else:
                values[inside] = self._model.sample(chosen[0], chosen[1:])
        values = values.reshape(shape).astype(self.dtype)
        return (values, slopes.reshape(*shape, 4).astype(self.dtype)) if gradient else values

    def occupancy(self, t: float, region: Spans | None = None) -> npt.NDArray[np.bool_]:
        """Which vertices (z, y, x) of a region (all if None) are in the coreset at step `t`.

        Between key frames those that are at either of them, in the profile compact at both. Raises RegionError.
        """
        key = self._key_index(t)
        region = self._checked(region)
        result = np.zeros(region.shape, dtype=bool)
        found = self._within_box(region)
        if found is not None:
            target, local = found
            result[target] = self._occupied(key, local)
        missing = self._missing_at(t)
        return result if missing is None else result & ~missing[region.slices()]

    def step_of_time(self, time: float) -> float:
        """The step, fractional between steps, at a time in the units of the series; RegionError outside its times.

        Raises InputError if the series' times do not strictly ascend or descend.
        """
        return self._checked_times().step_of_time(float(time))

    # -- pieces ------------------------------------------------------------------------------------------------------------

    def _checked_times(self) -> KeyTimes:
        if not strictly_monotonic(self.coords["t"].values):
            raise InputError(
                f"{self.path}: the times of the series do not strictly ascend or descend; ask for a step instead"
            )
        return self.key_times

    def _key_index(self, t: float) -> float:
        last = self.shape[0] - 1
        if not 0 <= t <= last:
            raise RegionError(f"{self.path}: step {t:g} is outside 0..{last}")
        return self.key_times.key_index(float(t))

    def _checked(self, region: Spans | None) -> Box:
        if region is None:
            return Box.of_shape(self.shape[1:])
        for axis, (low, high), length in zip(AXES[1:], region, self.shape[1:], strict=True):
            if not 0 <= low < high <= length:
                raise RegionError(
                    f"{self.path}: region {low}:{high} of axis {axis} is empty or outside 0:{length}"
                )
        return Box.of(region)

    def _within_box(self, region: Box) -> tuple[tuple[slice, ...], Box] | None:
        """Where a region of the domain and the box meet: as slices of the region, and in vertices of the box; None where they do not."""
        inner = self.box.intersect(region)
        if inner is None:
            return None
        target = inner.shift(-first for first in region.first)
        return target.slices(), inner.shift(-first for first in self.box.first)

    def _occupied(self, key: float, local: Box) -> npt.NDArray[np.bool_]:
        """Which vertices of a part of the box count at a key index."""
        return self._model.occupied(int(np.floor(key)), int(np.ceil(key)), local)

    def _missing_at(self, t: float) -> npt.NDArray[np.bool_] | None:
        """Where the source had no finite value at a step, or at either step around; None where the file has no such vertices."""
        stored = self.container.arrays.get("missing/bits")
        if stored is None:
            return None
        steps = range(int(np.floor(t)), int(np.ceil(t)) + 1)
        bits = stored.read((slice(steps[0], steps[-1] + 1), slice(0, stored.shape[1])))
        masks = np.unpackbits(
            np.bitwise_or.reduce(bits, axis=0), count=prod(self.shape[1:])
        ).reshape(self.shape[1:])
        return np.asarray(masks, dtype=bool)

    def _interpolable(
        self,
        steps: npt.NDArray[np.float64],
        keys: npt.NDArray[np.float64],
        space: list[npt.NDArray[np.float64]],
    ) -> npt.NDArray[np.bool_]:
        """Points whose every cell vertex of weight above 0 is in the coreset."""
        inside: npt.NDArray[np.bool_] = np.all(
            [(p >= low) & (p <= high - 1) for p, (low, high) in zip(space, self.box, strict=True)],
            axis=0,
        )
        # Points between the same steps and key frames share one occupancy.
        between = np.stack([np.floor(steps), np.ceil(steps), np.floor(keys), np.ceil(keys)])
        _, first, group = np.unique(between, axis=1, return_index=True, return_inverse=True)
        for number, representative in enumerate(first):
            chosen = np.flatnonzero(inside & (group == number))
            if not chosen.size:
                continue
            low = [np.floor(p[chosen]).astype(np.int64) for p in space]
            high = [np.ceil(p[chosen]).astype(np.int64) for p in space]
            around = Box.of(
                (int(b.min()), int(h.max()) + 1) for b, h in zip(low, high, strict=True)
            )
            occupied = self.occupancy(steps[representative], around)
            for corner in np.ndindex(2, 2, 2):
                at = (
                    (h if up else b) - start
                    for up, b, h, start in zip(corner, low, high, around.first, strict=True)
                )
                inside[chosen] &= occupied[tuple(at)]
        return inside

    # -- life --------------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Release the file."""
        self.container.close()

    def __enter__(self) -> Volume:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Path]]:
        return open, (self.path.absolute(),)

    def __repr__(self) -> str:
        sizes = " ".join(f"{axis}={n}" for axis, n in zip(AXES, self.shape, strict=True))
        return f"<fhash Volume '{self.name}' {sizes} {self.dtype} of {self.path}>"


def decoded_type(source: np.dtype[Any]) -> np.dtype[Any]:
    """The type of decoded values: a float wide enough for the source's own precision."""
    narrow = source.itemsize <= 2 or source == np.float32
    return np.dtype(np.float32 if narrow else np.float64)


def _expanded(index: Index | tuple[Index, ...]) -> list[int | slice]:
    """One part per axis, `...` and missing axes filled with full slices."""
    parts = list(index) if isinstance(index, tuple) else [index]
    for part in parts:
        if part is not Ellipsis and (
            isinstance(part, bool) or not isinstance(part, int | np.integer | slice)
        ):
            raise RegionError(
                f"a volume is indexed by integers, slices and '...', not by {type(part).__name__}; take np.asarray of it for more"
            )
    dots = [number for number, part in enumerate(parts) if part is Ellipsis]
    if len(dots) > 1 or len(parts) - len(dots) > 4:
        raise RegionError(f"a volume has 4 axes (t, z, y, x); the index has {len(parts)} parts")
    at = dots[0] if dots else len(parts)
    fill = [slice(None)] * (4 - len(parts) + len(dots))
    return [part for part in [*parts[:at], *fill, *parts[at + len(dots) :]] if part is not Ellipsis]


def _positions(part: int | slice, length: int, axis: str) -> range:
    if isinstance(part, slice):
        return range(length)[part]
    if not -length <= part < length:
        raise RegionError(f"index {part} is outside axis {axis} of {length}")
    return range(part % length, part % length + 1)
