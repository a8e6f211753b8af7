"""Volume of a file: values of regions and steps, of all or some features."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import (
    ArrayLike,
    Box,
    Sizes,
    Spans,
    checked_region,
    coarse_vertices,
    overlap,
    slice_of,
)
from fhash_codec.compact.model import CompactModel
from fhash_codec.features.key_frames import KeyTimes, strictly_monotonic
from fhash_codec.header import describe_file, read_missing
from fhash_codec.measure.value_range import ValueRange, decoded_type
from fhash_codec.progress import Progress, silent
from fhash_codec.times import Time, times_of
from fhash_codec.volume_model import Card, Decoded, open_model
from fhash_formats.container import Container, Place, StorageOptions
from fhash_formats.container.header import EVERYTHING, MISSING_ARRAY
from fhash_formats.errors import (
    DamagedFileError,
    InputError,
    MissingDependencyError,
    RegionError,
)
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate, step_blocks
from fhash_formats.support.values import exact_number
from fhash_formats.transform.values import about_origin

if TYPE_CHECKING:
    from fhash_codec.file_info import FileInfo

Number = int | float


@dataclass(frozen=True, kw_only=True)
class ValueType:
    """Types of decoded values.

    Attributes:
        source: type of the source.
        floats: type of computed values: float64 for sources of float64 or of integers above 16
            bits, else float32.
        own: type in which values at vertices and steps lose nothing: the source's for integers that
            the file holds as integers of every step, else `floats`.
        has_gaps: whether some vertices have no value.
        fill: the number that stood in the source for a missing value; None where it is unknown.
    """

    source: np.dtype[Any]
    floats: np.dtype[Any]
    own: np.dtype[Any]
    has_gaps: bool
    fill: Number | None

    @classmethod
    def of(cls, container: Container) -> ValueType:
        """The types of a container."""
        header = container.header
        variable, model = header["variable"], header["model"]
        source = np.dtype(variable["dtype"])
        stored_as_integers = (
            source.kind in "iu"
            and model["profile"] == "compact"
            and model.get("values", model["tables"]) == source.name
            and model["levels"][0][0] == header["domain"]["shape"][0]
        )
        return cls(
            source=source,
            floats=decoded_type(source),
            own=source if stored_as_integers else decoded_type(source),
            has_gaps=_has_gaps(header) or MISSING_ARRAY in container.arrays,
            fill=variable.get("fill"),
        )

    def of_array(self, fill: Number | None) -> tuple[np.dtype[Any], Number | None]:
        """The type of values in an array, and what stands in it where there is no value.

        Integers stay what they are if none is missing, or if the fill value is one of their type.
        A fill value that was not asked for is the source's own, and only for integers.

        fill: the number asked for; None for none. Returns None for the fill value where it is NaN.
        """
        if self.own.kind == "f":
            return self.own, fill
        chosen = self.fill if fill is None else fill
        if chosen is not None and not holds(self.own, chosen):
            chosen = None
        if chosen is not None or not self.has_gaps:
            return self.own, 0 if chosen is None else int(chosen)
        return self.floats, fill


def holds(dtype: np.dtype[Any], number: Number) -> bool:
    """Whether a type has this number exactly; floats have every number up to their largest."""
    if dtype.kind == "f":
        return number != number or abs(number) <= float(np.finfo(dtype).max)
    limits = np.iinfo(dtype)
    if not np.isfinite(float(number)) or number != int(number):
        return False
    return bool(limits.min <= int(number) <= limits.max)


def placed(
    values: npt.NDArray[Any], where: npt.NDArray[np.bool_], box: Box, shape: Sizes
) -> npt.NDArray[Any]:
    """Values (z, y, x) where a mask is True, in a box of an array of a shape that is NaN elsewhere.

    The values themselves where they are all of the array. Values and mask may have more axes before
    z, which the result has, too.
    """
    if box.shape == shape and where.all():
        return values
    result = np.full((*values.shape[:-3], *shape), np.nan, dtype=values.dtype)
    np.copyto(result[..., *box.slices()], values, where=where)
    return result


def filled(values: npt.NDArray[Any], fill: Number | None) -> npt.NDArray[Any]:
    """Floats with a fill value in place of NaN; None leaves them as they are."""
    return values if fill is None else np.where(np.isnan(values), values.dtype.type(fill), values)


def rounded(values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Floats as the nearest integers of a type, 0 for NaN.

    The ends of 64-bit types are no floats: what rounding puts beyond them becomes the nearest float
    within.
    """
    limits = np.iinfo(dtype)
    low, high = float(limits.min), float(limits.max)
    if int(high) > limits.max:
        high = float(np.nextafter(high, 0))
    wide = np.nan_to_num(values.astype(np.float64), nan=0.0)
    return np.clip(np.rint(wide), low, high).astype(dtype)


def _has_gaps(header: Mapping[str, Any]) -> bool:
    """Whether some vertices of the domain are outside the coreset, by the header."""
    box = [[0, length] for length in header["domain"]["shape"][1:]]
    return bool(header["coreset_fraction"] < 1 or header["feature_bounding_box"] != box)


OUTSIDE = ("nan", "background")
"""Choices of what `read` gives outside the coreset."""


def open_container(path: Place, storage_options: StorageOptions = None) -> Container:
    """Open a container; raises InputError for data that are not encoded, else as it does."""
    try:
        return Container.open(path, storage_options=storage_options)
    except DamagedFileError as error:
        if not isinstance(path, str | os.PathLike):
            raise
        from fhash_formats.readers.registry import recognised

        kind = recognised(os.fspath(path))
        if kind is None:
            raise
        raise InputError(
            f"{path} is {kind} data, no container; encode it first: fhash encode {path}"
        ) from error


def open(
    path: Place,
    *,
    variable: str | None = None,
    fill: int | float | None = None,
    storage_options: StorageOptions = None,
) -> Volume:
    """Open one variable of a `.fhz` file for reading, a URL or an open binary file.

    variable: its name; None for the only one of the file.
    fill: what `volume[...]` gives at vertices without a value, see `Volume`.
    storage_options: options of a URL's file system in fsspec.

    Nothing is decoded yet. Raises what `Container.open` raises, and InputError where the file does
    not hold the variable, or holds several and none is named.
    """
    container = open_container(path, storage_options)
    try:
        return Volume(container.select(variable), fill=fill)
    except BaseException:
        container.close()
        raise


class Volume(Card, ArrayLike):
    """A time-varying volume in a container, read like a numpy array (t, z, y, x).

    Only the tiles that a request needs are decoded. Values are in data units. Vertices outside the
    coreset, and those where the source had no finite value, have none: they are NaN, or the fill
    value. Integers stay integers in `volume[...]`, unless they have vertices without a value and no
    fill value is known; `read` and `sample` always give floats.

    Attributes:
        shape: vertices (t, z, y, x).
        dims: names of the axes.
        chunks: vertices (t, z, y, x) that are decoded together.
        dtype: type of `volume[...]`: that of the source for integers, else `float_dtype`.
        float_dtype: type of `read` and `sample`: float64 for sources of float64 or of integers
            above 16 bits, else float32.
        fill: what `volume[...]` has at vertices without a value; None for NaN.
        name, units, attrs: of the variable.
        coords: a Coordinate for each of "t", "z", "y", "x".
        box: the feature bounding box, in vertices of the domain.
        path: of the file; a URL is text.
        variable: name among several variables of the file; None where it is the only one.
        info: everything the file says of itself, as JSON values.
        config, tables, mlp: the parts of the model, see `Card`, as are `occupancy_bits` and
            `model`.
    """

    def __init__(self, container: Container, *, fill: int | float | None = None) -> None:
        """Read from an open container, which `close` closes; `fhash_codec.open` opens files.

        fill: the fill value; None for the source's own, which only integers have, or NaN. Integers
            become floats for a fill value that their type does not have.
        """
        header = container.header
        self.container = container
        self.path = container.path
        self.variable = container.variable
        self.shape: tuple[int, int, int, int] = tuple(header["domain"]["shape"])
        self.value_type = ValueType.of(container)
        self.float_dtype = self.value_type.floats
        self._asked_fill = fill
        self.dtype, self.fill = self.value_type.of_array(fill)
        self.name: str = header["variable"]["name"]
        self.units: str = header["variable"]["units"]
        self.attrs: Mapping[str, Any] = header["variable"]["attributes"]
        self.box = Box.of(header["feature_bounding_box"])
        self.profile: str = header["model"]["profile"]
        self.value_range = ValueRange(*header["value_range"])
        self.background = exact_number(header["background"])
        every_step = header["model"]["levels"][0][0] == self.shape[0]
        self._outside_is_missing = every_step and EVERYTHING in header["features"]
        self._model = open_model(container)
        self.chunks = self._model.chunks

    def _decoded(self, ranges: Sequence[range]) -> npt.NDArray[Any]:
        steps, *space = ranges
        result = np.empty([len(positions) for positions in ranges], dtype=self.dtype)
        region = Box.of((min(positions), max(positions) + 1) for positions in space)
        local = tuple(map(slice_of, space, region.first))
        for places, together in step_blocks(steps, region.shape):
            result[places] = self.values_of_steps(together, region)[:, *local]
        return result

    # -- contents of the file --

    @cached_property
    def coords(self) -> dict[str, Coordinate]:
        """Positions along each axis, in the units of the source."""
        return {axis: self.container.coordinate(stored) for axis, stored in AXIS_NAMES.items()}

    @cached_property
    def key_times(self) -> KeyTimes:
        """The map from steps and times to the model's time axis."""
        return KeyTimes.of(self.container)

    @property
    def info(self) -> FileInfo:
        """The container's header, and what follows from it."""
        return describe_file(self.container, self.path, self.key_times.key_frames)

    def verify(self, progress: Progress = silent) -> int:
        """Read and check every array; return their number. Raises DamagedFileError."""
        return self.container.verify(lambda done, total: progress("verifying", done, total, ""))

    # -- reading --

    def read(
        self, t: float, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (z, y, x) of a region at step `t`, of `self.float_dtype`.

        t: a step; a fraction lies between two steps, and time runs evenly from one to the next.
        region: in vertices of the domain; the whole domain if None.
        outside: "nan", or "background" for the mean of the values outside the coreset. Where the
            source had no finite value, NaN stands in any case.
        Raises RegionError for a step or region outside the domain, InputError for another
        `outside`.
        """
        key, region = self._key_index(t), self._checked(region)

        def decode(in_box: Box) -> Decoded:
            requested = self._occupied(key, in_box)
            values = self._model.read(key, in_box, requested)
            values = values.astype(self.float_dtype, copy=False)
            return (values if key.is_integer() else self._in_range(values)), requested

        return self._completed(decode, region, self._missing_at(t, region), outside)

    @property
    def source_dtype(self) -> np.dtype[Any]:
        """Number type of the source, as a series has it."""
        return self.value_type.source

    def read_steps(
        self, steps: range, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (t, z, y, x) of a region at neighbouring steps, each as `read` gives it.

        steps: whole steps; together, small frames are read faster. Errors as in `read`.
        """
        return self._read_steps(steps, region, outside)[0]

    def _read_steps(
        self, steps: range, region: Spans | None, outside: str
    ) -> tuple[npt.NDArray[Any], Decoded | None]:
        """Values as `read_steps` gives them, and the part in the box as decoded, if it was."""
        model = self._model_of_steps
        if model is None or steps.step != 1:
            return np.stack([self.read(step, region, outside=outside) for step in steps]), None
        first, last = (int(self._key_index(step)) for step in (steps[0], steps[-1]))
        decoded = None

        def decode(in_box: Box) -> Decoded:
            nonlocal decoded
            values, occupied = decoded = model.read_steps(first, last + 1, in_box)
            return values.astype(self.float_dtype, copy=False), occupied

        region = self._checked(region)
        missing = read_missing(self.container, range(first, last + 1), region)
        return self._completed(decode, region, missing, outside, (len(steps),)), decoded

    def values(
        self, t: float, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (z, y, x) of a region at step `t` as `volume[...]` has them.

        They are of `self.dtype`, with the fill value where there is no value. Between steps they
        are interpolated, and so of `self.float_dtype`. Arguments and errors as in `read`; the
        background is rounded to integers.
        """
        if not float(t).is_integer():
            return filled(self.read(t, region, outside=outside), self.fill)
        alone = range(int(t), int(t) + 1)
        return np.asarray(self.values_of_steps(alone, region, outside=outside)[0])

    def values_of_steps(
        self, steps: range, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (t, z, y, x) of a region at neighbouring steps, each as `values` gives it."""
        read, decoded = self._read_steps(steps, region, outside)
        if self.dtype.kind == "f":
            return filled(read, self.fill)
        if self.dtype.itemsize < 8:
            result: npt.NDArray[Any] = rounded(read, self.dtype)
        else:  # float64 has not every integer of 64 bits
            limits = np.iinfo(self.dtype)
            nearest = min(max(round(self.background), int(limits.min)), int(limits.max))
            result = np.full(read.shape, nearest, self.dtype)
            common = overlap(self.box, self._checked(region))
            if common is not None:
                assert decoded is not None, "only such files hold integers"
                np.copyto(result[(slice(None), *common[0].slices())], decoded[0], where=decoded[1])
        result[np.isnan(read)] = self.fill
        return result

    def differences_of_steps(self, steps: range, origin: int) -> npt.NDArray[Any]:
        """Values (t, z, y, x) at neighbouring steps less an integer, as the file holds them.

        They are int64 where all vertices have a value and the file holds integers, else float64
        with NaN where there is none.
        """
        read, decoded = self._read_steps(steps, None, "nan")
        if decoded is None or decoded[0].dtype.kind == "f":
            return about_origin(read, origin)
        differences = about_origin(decoded[0], origin)
        if not np.isnan(read).any():
            return differences
        result = read.astype(np.float64)
        in_box = result[(slice(None), *self.box.slices())]
        np.copyto(in_box, differences, where=~np.isnan(in_box))
        return result

    def read_lod(self, t: float, lod: int, region: Spans | None = None) -> npt.NDArray[Any]:
        """Low-passed values (z, y, x) at every 2^lod-th vertex of the feature bounding box.

        They are of `self.float_dtype`. t: a whole step.
        lod: level of detail, 0 to 10; level 0 is the box as `read` gives it.
        region: in vertices of the domain (all if None); see `lod_vertices` for the vertices in it.

        Neither finer detail nor other tiles are decoded. Vertices outside the coreset are NaN. Only
        compact files have levels of detail. Raises RegionError for a step outside the series and
        for a region without such a vertex, InputError for the published network or another lod.
        """
        values, occupied = self.decoded_lod(t, lod, region)
        values = values.astype(self.float_dtype)
        values[~occupied] = np.nan
        return values

    def decoded_lod(self, t: float, lod: int, region: Spans | None = None) -> Decoded:
        """Values (z, y, x) as `read_lod` gives them, in the type of the file, and which count.

        Arguments and errors as in `read_lod`.
        """
        vertices = self.lod_vertices(lod, region)
        if not float(t).is_integer():
            raise InputError(f"step {t:g} lies between two; levels of detail are of whole steps")
        step = int(self._key_index(t))
        coarse = Box.of(
            ((along[0] - first) >> lod, ((along[-1] - first) >> lod) + 1)
            for along, first in zip(vertices, self.box.first, strict=True)
        )
        values = self._model.read_lod(step, int(lod), coarse)
        surrounding = Box.of((along[0], along[-1] + 1) for along in vertices)
        return values, self.occupancy(t, surrounding)[(slice(None, None, 1 << lod),) * 3]

    def lod_vertices(self, lod: int, region: Spans | None = None) -> tuple[range, range, range]:
        """The vertices (z, y, x) of the domain whose values `read_lod` gives.

        They are every 2^lod-th vertex of the feature bounding box that lies in the region. Raises
        InputError for another lod than 0 to 10, RegionError for a region outside the domain or
        without such a vertex.
        """
        return coarse_vertices(self.box, self._checked(region), lod, str(self.path))

    def to_vtk(self, t: float, region: Spans | None = None, lod: int = 0) -> Any:
        """Values at step `t` as points of a vtkImageData, or vtkRectilinearGrid on uneven axes.

        t: a step; a fraction lies between two steps, with lod 0.
        region: in vertices of the domain; the whole domain if None.
        lod: level of detail, as `read_lod` takes it; it gives vertices of the feature bounding box.

        Positions ascend; points without a value are NaN and hidden. Raises what `read` and
        `read_lod` raise, and MissingDependencyError without VTK.
        """
        from fhash_codec.paraview_reader import ascending, vtk_grid

        values = self.read_lod(t, lod, region) if lod else self.read(t, region)
        whole = [range(*span) for span in self._checked(region)]
        vertices = self.lod_vertices(lod, region) if lod else whole
        axes = [
            ascending(self.coords[axis].values[list(along)])
            for axis, along in zip(AXES[1:], vertices, strict=True)
        ]
        turned = values[tuple(slice(None, None, turn) for _, turn in axes)]
        try:
            return vtk_grid(
                [(self.name, self.units, turned)], [positions for positions, _ in axes], (0, 0, 0)
            )
        except ImportError as error:
            raise MissingDependencyError("to_vtk needs VTK: pip install vtk") from error

    def to_pyvista(self, t: float, region: Spans | None = None, lod: int = 0) -> Any:
        """The grid of `to_vtk` as PyVista's; MissingDependencyError without PyVista."""
        try:
            from pyvista import wrap
        except ImportError as error:
            raise MissingDependencyError("to_pyvista needs pip install pyvista") from error
        return wrap(self.to_vtk(t, region, lod))

    def sample(
        self,
        *,
        z: npt.ArrayLike,
        y: npt.ArrayLike,
        x: npt.ArrayLike,
        t: npt.ArrayLike | None = None,
        time: npt.ArrayLike | Time | None = None,
        gradient: bool = False,
    ) -> npt.NDArray[Any] | tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Values at points between vertices, in data units.

        The positions broadcast against each other.

        z, y, x: positions in vertices of the domain; 0 is the first vertex.
        t: positions in steps. time: times as `step_of_time` takes them. One of the two.
        gradient: also return derivatives (..., 4) of the value by t, z, y and x, in data units per
            step and per vertex. They are analytic, through interpolation and network. On the border
            of two cells they are those of the cell after the border.

        A point is NaN outside the domain, and where a vertex of its cell is outside the coreset;
        vertices of weight 0 do not matter. Raises InputError unless one of t and time is given,
        RegionError for a step or time outside the series.
        """
        if (t is None) == (time is None):
            raise InputError("give either t (in steps) or time (in the units of the series)")
        if t is None:
            t = self._steps_of_times(time)
        points = np.broadcast_arrays(*(np.asarray(p, dtype=np.float64) for p in (t, z, y, x)))
        steps, *space = (position.ravel() for position in points)
        values, slopes = self._sampled(steps, space, gradient=gradient)
        shape = points[0].shape
        values = self._in_range(values.reshape(shape).astype(self.float_dtype))
        if slopes is None:
            return values
        with np.errstate(over="ignore"):  # a derivative may be too large for its type
            return values, slopes.reshape(*shape, 4).astype(self.float_dtype)

    def occupancy(self, t: float, region: Spans | None = None) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the vertices of a region that are in the coreset at step `t`.

        region: in vertices of the domain; the whole domain if None. Between key frames a vertex
        must be in the coreset at both of the two; of the published network, at either. Raises
        RegionError for a step or region outside the domain.
        """
        key, region = self._key_index(t), self._checked(region)
        result = np.zeros(region.shape, dtype=bool)
        common = overlap(self.box, region)
        if common is not None:
            in_region, in_box = common
            result[in_region.slices()] = self._occupied(key, in_box)
        missing = self._missing_at(t, region)
        return result if missing is None else result & ~missing

    def step_of_time(self, time: Time) -> float:
        """The step at a time; a fraction lies between two steps.

        time: in the units of the series, or a date where these have a calendar; see `times.Time`.
        Raises RegionError for a time outside the series; InputError if the series' times do not
        strictly ascend or descend, and for a date where they are no dates.
        """
        return float(self._steps_of_times(time))

    # -- steps, regions and masks --

    def _in_range(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Interpolated values without the rounding that takes some beyond the series' range."""
        low, high = map(self.float_dtype.type, self.value_range.floats)
        return np.asarray(np.clip(values, low, high))

    def _steps_of_times(self, times: Any) -> npt.NDArray[np.float64]:
        if not strictly_monotonic(self.coords["t"].values):
            what = "the times of the series do not strictly ascend or descend"
            raise InputError(f"{self.path}: {what}; ask for a step instead")
        return self.key_times.steps_of_times(times_of(self.coords["t"], times, str(self.path)))

    def _key_index(self, t: float) -> float:
        last = self.shape[0] - 1
        if not 0 <= t <= last:
            raise RegionError(f"{self.path}: step {t:g} is outside 0..{last}")
        return self.key_times.key_index(float(t))

    def _checked(self, region: Spans | None) -> Box:
        return checked_region(region, self.shape[1:], str(self.path))

    def _occupied(self, key: float, region: Box) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the coreset at a key index; the region is in vertices of the box."""
        return self._model.occupied(int(np.floor(key)), int(np.ceil(key)), region)

    def _missing_at(self, t: float, region: Box) -> npt.NDArray[np.bool_] | None:
        """Mask (z, y, x) of the values that are not finite at step `t`, or at a step beside it."""
        beside = range(int(np.floor(t)), int(np.ceil(t)) + 1)
        missing = read_missing(self.container, beside, region)
        return None if missing is None else np.asarray(missing.any(axis=0))

    def _completed(
        self,
        decode: Callable[[Box], Decoded],
        region: Box,
        missing: npt.NDArray[np.bool_] | None,
        outside: str,
        steps: tuple[int, ...] = (),
    ) -> npt.NDArray[Any]:
        """Decoded values (z, y, x) of a region, or (t, z, y, x), and what stands beside them.

        decode: gives values of a region of the feature bounding box, and where they count.
        """
        if outside not in OUTSIDE:
            raise InputError(f"outside is '{outside}'; allowed: {', '.join(OUTSIDE)}")
        common = overlap(self.box, region)
        if common is None:
            result: npt.NDArray[Any] = np.full((*steps, *region.shape), np.nan, self.float_dtype)
        else:
            in_region, in_box = common
            result = placed(*decode(in_box), in_region, region.shape)
        if outside == "background" and not self._outside_is_missing:
            result[np.isnan(result)] = self.background
        if missing is not None:
            result[missing] = np.nan
        return result

    @cached_property
    def _model_of_steps(self) -> CompactModel | None:
        """The model where it is a table with a row for each step; None for others."""
        every = len(self.key_times.key_frames) == self.shape[0]
        return self._model if every and isinstance(self._model, CompactModel) else None

    # -- life --

    def close(self) -> None:
        """Release the file."""
        self.container.close()

    def __enter__(self) -> Volume:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Place]]:
        again = partial(open, variable=self.variable, fill=self._asked_fill)
        return again, (self.container.reopening(),)

    def view(self, height: int = 560) -> Any:
        """Show the file in a notebook by the page of `fhash view`, `height` pixels high.

        Raises MissingDependencyError without anywidget (`fhash[notebook]`), MissingInputError for a
        file that is not on this machine, and InputError for one that is too large to be sent.
        """
        from fhash_codec.views.page import widget

        return widget(self.path, height)

    def _repr_html_(self) -> str:
        """A table and a slice, for notebooks."""
        from fhash_codec.views.page import html_of

        return html_of(self)

    def __repr__(self) -> str:
        sizes = " ".join(f"{axis}={n}" for axis, n in zip(AXES, self.shape, strict=True))
        return f"<fhash Volume '{self.name}' {sizes} {self.dtype} of {self.path}>"


class FeatureVolume(Volume):
    """A `Volume` whose coreset is that of some features of the file.

    Attributes:
        numbers: of these features among those of the file, counted from 0.
    """

    def __init__(
        self, container: Container, numbers: Sequence[int], *, fill: int | float | None = None
    ) -> None:
        """Read from an open container; `only_features` gives the numbers."""
        super().__init__(container, fill=fill)
        self.numbers = tuple(numbers)

    def _occupied(self, key: float, region: Box) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the features' coreset at a key index; region in vertices of the box."""
        from fhash_codec.paper.model import PaperModel

        assert isinstance(self._model, PaperModel), "only_features refuses other models"
        first, last = int(np.floor(key)), int(np.ceil(key))
        return self._model.occupied_by(self.numbers, first, last, region)

    def __reduce__(self) -> tuple[Any, tuple[Place]]:
        again = partial(_reopen, self.numbers, self.variable, self._asked_fill)
        return again, (self.container.reopening(),)


def only_features(volume: Volume, features: Sequence[str]) -> Volume:
    """The volume with some features of its file alone.

    It shares the open container, so that closing either closes both. A volume whose file has these
    features and no others comes back as it is.

    Args:
        volume: an open container.
        features: as the file names them; "segmentation" stands for the one with a threshold.

    Raises InputError for a feature that the file does not name, and for a file that keeps its
    features merged.
    """
    numbers = _numbers(volume, features)
    if set(numbers) == set(range(len(_names(volume)))):
        return volume
    if not holds_features_apart(volume):
        raise InputError(
            f"{volume.path}: its features are merged, none can be taken alone; "
            "encode with --preset published, which keeps several features apart"
        )
    return FeatureVolume(volume.container, numbers, fill=volume._asked_fill)


def holds_features_apart(volume: Volume) -> bool:
    """Whether a file keeps the occupancy of each of its features."""
    return volume.profile == "paper"


def _numbers(volume: Volume, features: Sequence[str]) -> tuple[int, ...]:
    """The numbers of features among those of a file, ascending and each once; errors as above."""
    names = _names(volume)
    found = set()
    for text in features:
        equal = [
            number
            for number, name in enumerate(names)
            if name == text or (text == "segmentation" and name.startswith("segmentation:"))
        ]
        if not equal:
            raise InputError(
                f"{volume.path}: '{text[:80]}' is none of its features: {', '.join(names)[:400]}"
            )
        found.update(equal)
    return tuple(sorted(found))


def feature_names(volume: Volume) -> list[str]:
    """The features that a volume shows, as its file names them: all, or those chosen."""
    names = _names(volume)
    if isinstance(volume, FeatureVolume):
        return [names[number] for number in volume.numbers]
    return names


def _names(volume: Volume) -> list[str]:
    """The features of a file, as it names them."""
    return [str(name) for name in volume.container.header["features"]]


def _reopen(
    numbers: Sequence[int], variable: str | None, fill: int | float | None, path: Place
) -> Volume:
    """A volume of some features of the file at a place."""
    container = open(path, variable=variable, fill=fill).container
    return FeatureVolume(container, numbers, fill=fill)
