"""Writer of a series step by step, and `append`, which continues a file."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from math import prod
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.growing import MAX_STEPS, Figures, GrowingFile, LayerCoder, continued
from fhash_codec.compact.attempt import parse_tile
from fhash_codec.compact.encode import CodedTable, table_header
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.plan import OVERHEAD_BYTES, plan
from fhash_codec.compact.tiles import Blocks
from fhash_codec.config import EncodeConfig
from fhash_codec.features.scan import Extremes
from fhash_codec.features.selection import Source, open_source, select_features
from fhash_codec.header import check_name
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.belonging import (
    Labels,
    counted_times,
    is_index,
    require_alike,
    require_same_grid,
)
from fhash_formats.readers.labelled import array_series
from fhash_formats.series import (
    AXES,
    AXIS_NAMES,
    UNNAMED,
    ArraySeries,
    Coordinate,
    Series,
    SourceMetadata,
    check_values,
    index_coordinate,
)
from fhash_formats.support.files import check_output
from fhash_formats.support.threads import thread_pool
from fhash_formats.support.values import (
    as_array,
    exact_number,
    is_wide_integer,
    json_attributes,
)


def bound_of(config: EncodeConfig, value_range: ValueRange | None) -> float:
    """The strict bound of the error that settings promise, in data units.

    value_range: of the whole run; None if it is not known.

    Raises InputError for settings that a file cannot keep whose later steps are not known yet.
    """
    if config.published:
        raise InputError(
            f"preset '{config.preset}' needs all steps at once; a file that grows is of another "
            "preset"
        )
    if config.features != ("all",):
        raise InputError(
            f"features {', '.join(config.features)} are given; a file that grows keeps everything "
            "(feature 'all')"
        )
    if config.max_error is not None:
        return float(config.max_error)
    if config.max_error_rel is None:
        raise InputError(
            "a file that grows promises a bound of the error, which holds step by step: give "
            "max_error, or max_error_rel with value_range; a PSNR or a ratio depends on steps that "
            "are yet to come"
        )
    if value_range is None:
        raise InputError(
            "max_error_rel is a fraction of the range of the whole run, which is not known yet: "
            "give value_range=(low, high) beside it, or max_error in data units"
        )
    return config.max_error_rel * (value_range.high - value_range.low)


def plan_layers(
    frames: Sequence[npt.NDArray[Any]],
    config: EncodeConfig,
    bound: float,
    value_range: ValueRange | None,
) -> tuple[LayerCoder, dict[str, Any]]:
    """The coder of all layers, chosen on the first steps, and what stays the same of the header.

    frames: finite values (z, y, x) of each step. bound: of the error, in data units.
    value_range: that is expected of the whole run; that of the frames if None.

    Raises InputError for a tile that cannot be had.
    """
    series = ArraySeries(np.stack(frames))
    series.keep_extremes = True  # values of a simulation are data
    promised = replace(config, max_error=bound, max_error_rel=None, timings=False)
    selection = select_features(series, promised, silent)
    whole = _joined(selection.scanned.value_range, value_range)
    origin = whole.origin(series.dtype)
    expected = whole.moved(-origin)
    raw_bytes = prod(series.shape) * series.dtype.itemsize
    integers = series.dtype.kind in "iu"
    goal = goal_of(promised, expected, raw_bytes, OVERHEAD_BYTES, integers=integers)
    with thread_pool() as workers:
        found = plan(
            Blocks(series, selection.extent, series.shape, origin),
            expected,
            promised,
            goal,
            workers,
            silent,
            selection.features,
        )
    coder = LayerCoder(
        tile=found.blocks.tile,
        settings=replace(found.settings, origin=origin),
        coding=found.coding,
        dtype=found.blocks.source_dtype,
    )
    header = table_header(series, selection, CodedTable(plan=found), promised, None)
    del header["quality"]
    return coder, {**header, "dilation": promised.dilation}


def _joined(first: ValueRange, second: ValueRange | None) -> ValueRange:
    if second is None:
        return first
    return ValueRange(min(first.low, second.low), max(first.high, second.high))


WINDOW_STEPS = 8
"""Steps on which tiles and settings are chosen where the tile does not say how many."""
WINDOW_BYTES = 512 << 20
"""Bytes of these steps together, at most; a single larger frame is allowed."""


class Writer:
    """A file that grows step by step; a context manager.

        with fhash_codec.Writer("run.fhz", shape=(64, 64, 128), max_error=1e-3) as writer:
            while running:
                writer.append(frame, time=now)

    Some steps are coded together, a *layer*: as many as the tiles have. The frames of one layer are
    in memory at a time, at first those of the steps on which tiles and settings are chosen. After
    every layer the file is complete under its name, and anybody may read it; a process that is
    killed loses the frames of the layer under way and nothing else. `close`, which leaving the
    block calls, writes a last layer that may be shorter; `Writer.resume` goes on after a whole one.

    Attributes:
        path: of the file.
        shape: (z, y, x) of a frame.
        steps: frames that were appended.
        steps_written: those of them that are in the file.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        shape: Sequence[int],
        max_error: float | None = None,
        max_error_rel: float | None = None,
        value_range: tuple[float, float] | None = None,
        config: EncodeConfig | None = None,
        coords: Mapping[str, Coordinate | npt.ArrayLike] | None = None,
        name: str = UNNAMED,
        units: str = "",
        attributes: Mapping[str, Any] | None = None,
        time_units: str = "",
        force: bool = False,
    ) -> None:
        """Begin a file; it is there after the first layer.

        shape: vertices (z, y, x) of a frame.
        max_error: strict bound of the error of each value, in data units; 0 for none.
        max_error_rel: the same as a fraction of `value_range`.
        value_range: values that are expected in the whole run, in data units. Others are kept as
            precisely, in a few more bytes.
        config: further settings, such as effort and tile. It may have the promise, too.
        coords: positions of "z", "y" and "x": a Coordinate or an array of one dimension. A
            Coordinate of "t" gives name and attributes of the times.
        name, units, attributes: of the variable.
        time_units: of the times, such as "s" or "days since 2000-01-01".
        force: replace a file that exists, once the first layer is written.

        Raises InputError for settings that do not fit, OutputExistsError or OutputError for the
        path.
        """
        path = Path(path)
        check_name(path)
        check_output(path, force)
        frame = _frame_shape(shape)
        settings = _settings(config, max_error, max_error_rel)
        known = None if value_range is None else ValueRange(*map(_number, value_range))
        bound = bound_of(settings, known)
        variable: dict[str, Any] = {
            "name": str(name),
            "units": str(units),
            "attributes": json_attributes(dict(attributes or {}), without=frozenset()),
        }
        positions = _positions(coords or {}, frame, time_units)

        def new_file(frames: Sequence[npt.NDArray[Any]]) -> GrowingFile:
            """The file without steps, its tiles and settings chosen on some frames."""
            coder, header = plan_layers(frames, settings, bound, known)
            low, high = coder.settings.low, coder.settings.high
            return GrowingFile(
                path,
                coder,
                {**header, "variable": {**variable, "dtype": coder.dtype.name}},
                positions,
                Figures(Figures.scale_of(ValueRange(low, high))),
                force=force,
            )

        self._new_file = new_file
        told = {"variable": {**variable, "dtype": ""}, "domain": {"shape": (1, *frame)}}
        self._labels = Labels.of_file(path, told, positions)
        tile = parse_tile(settings.tile, (MAX_STEPS, *frame))
        self._tile_steps = None if tile is None or tile[0] == MAX_STEPS else tile[0]
        self._begin(path, frame)

    @classmethod
    def resume(cls, path: str | Path, *, steps: int | None = None) -> Writer:
        """Go on with an existing file, in its tiles and settings and to its bound of the error.

        steps: number of steps to keep, such as those before the checkpoint from which a simulation
            starts again; all if None. They must be whole layers.

        The file stays as it is until the first layer is added. Raises InputError for a file that
        cannot grow, MissingInputError and DamagedFileError as `open`.
        """
        self = cls.__new__(cls)
        stack = ExitStack()
        growing = stack.enter_context(continued(Path(path), steps))
        z, y, x = growing.shape
        self._begin(Path(path), (z, y, x))
        growing.forget_packing()
        self._stack, self._file = stack, growing
        with open_volume(path) as volume:
            self._labels = _labels_of(volume)
        self._dtype = growing.coder.dtype
        self._last = growing.times[-1]
        return self

    def _begin(self, path: Path, shape: tuple[int, int, int]) -> None:
        self.path, self.shape = path, shape
        self._stack = ExitStack()
        self._file: GrowingFile | None = None
        self._dtype: np.dtype[Any] | None = None
        self._frames: list[npt.NDArray[Any]] = []
        self._times: list[float] = []
        self._last: float | None = None
        self._workers: ThreadPoolExecutor | None = None
        self._is_closed = False

    @property
    def steps_written(self) -> int:
        """Steps that are in the file."""
        return 0 if self._file is None else self._file.steps

    @property
    def steps(self) -> int:
        """Steps that were appended, those that wait for their layer included."""
        return self.steps_written + len(self._frames)

    def append(self, frame: npt.ArrayLike, time: float | None = None) -> None:
        """Append the next step; the layer that it fills is written before this returns.

        frame: finite values (z, y, x), each time of the same number type. It is copied. The labels
            of an array of xarray must be those of the file.
        time: of the step, later than that of the step before; by default that of a labelled frame,
            else one more than the one before, from 0 on.

        Raises InputError for a frame or a time that does not fit, which is then left out, and
        OutputError if the file cannot be written; it then keeps the layers before.
        """
        if self._is_closed:
            raise InputError(f"{self.path}: the writer is closed; Writer.resume goes on with it")
        values, time = self._unlabelled(frame, time)
        values = self._checked(values)
        when = self._checked_time(time)
        self._dtype, self._last = values.dtype, when
        self._frames.append(values)
        self._times.append(when)
        if self._file is None and len(self._frames) >= self._window(values):
            self._plan()
        while self._file is not None and len(self._frames) >= self._file.coder.tile[0]:
            self._write(self._file, self._file.coder.tile[0])

    def close(self) -> None:
        """Write the steps that wait for their layer, and release the file."""
        if self._is_closed:
            return
        self._is_closed = True
        with self._stack:
            if self._frames and self._file is None:
                self._plan()
            while self._file is not None and self._frames:
                self._write(self._file, min(self._file.coder.tile[0], len(self._frames)))

    def __enter__(self) -> Writer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file, also where the block failed: what was appended is kept."""
        self.close()

    def _unlabelled(self, frame: Any, time: Any) -> tuple[npt.NDArray[Any], Any]:
        """The values of a frame and its time; raises InputError for one of another series."""
        what = f"step {self.steps}"
        if len(getattr(frame, "dims", None) or ()) < len(self.shape):
            return as_array(frame, what), time
        series = array_series(frame)
        if series.shape[0] != 1:
            raise InputError(f"{what}: the frame has {series.shape[0]} steps; append one at a time")
        labels = replace(Labels.of(series), source=f"{what}: the frame", dtypes=())
        require_alike(labels, replace(self._labels, dtypes=()))
        if time is None and "t" in series.given:
            file, own = self._labels.coords["t"], series.coords["t"]
            time = _counted_as_in(self.path, file, f"{what}: the frame", own)[0]
        return series.read(0), time

    def _checked(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """A copy of a frame; raises InputError for one that does not fit."""
        step = self.steps
        if values.shape != self.shape:
            raise InputError(
                f"step {step}: the frame has shape {values.shape}; {self.shape} in (z, y, x) is "
                "needed"
            )
        check_values(f"step {step}", (1, *values.shape), values.dtype)
        dtype = values.dtype.newbyteorder("=")
        if self._dtype is not None and dtype != self._dtype:
            raise InputError(
                f"step {step}: the frame is {dtype}, those before are {self._dtype}; convert it"
            )
        if dtype.kind == "f" and not np.isfinite(values).all():
            count = int(np.count_nonzero(~np.isfinite(values)))
            raise InputError(
                f"step {step}: {count} of its values are missing or infinite; a file that grows "
                "has none: put a number in their place"
            )
        return np.array(values, dtype=dtype, order="C")

    def _checked_time(self, time: float | None) -> float:
        """The time of the next step; raises InputError for one that is not later than the last."""
        if time is None:
            return 0.0 if self._last is None else self._last + 1.0
        try:
            when = float(time)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"step {self.steps}: its time is {time!r:.40}; a number in the units of the run is "
                "needed"
            ) from error
        if not math.isfinite(when) or (self._last is not None and when <= self._last):
            raise InputError(
                f"step {self.steps}: its time is {when:.9g}, the one before has {self._last}; "
                "times must be finite and ascend"
            )
        return when

    def _window(self, frame: npt.NDArray[Any]) -> int:
        """Number of steps on which tiles and settings are chosen."""
        room = max(1, WINDOW_BYTES // frame.nbytes)
        return min(WINDOW_STEPS, room) if self._tile_steps is None else self._tile_steps

    def _plan(self) -> None:
        """Choose tiles and settings on the steps that wait, and begin the file."""
        self._file = self._stack.enter_context(self._new_file(self._frames))

    def _write(self, growing: GrowingFile, count: int) -> None:
        """Code and write the layer of the first steps that wait."""
        if self._workers is None:
            self._workers = self._stack.enter_context(thread_pool())
        layer = growing.coder.code(self._frames[:count], growing.figures, self._workers)
        try:
            growing.add(layer, self._times[:count])
        except BaseException:
            # What could not be written now is not tried again: the file may have fallen behind.
            self._is_closed = True
            self._stack.close()
            raise
        del self._frames[:count], self._times[:count]


def _number(value: Any) -> float:
    """An end of a range, of any number type; integers beyond 2^53 stay integers."""
    return exact_number(int(value)) if hasattr(value, "__index__") else float(value)


def _frame_shape(shape: Sequence[int]) -> tuple[int, int, int]:
    """The shape of a frame; raises InputError for another than three lengths."""
    lengths = tuple(int(n) for n in shape)
    if len(lengths) != 3 or min(lengths) < 1:
        raise InputError(f"shape is {tuple(shape)}; three lengths (z, y, x) from 1 on are needed")
    return lengths


def _settings(
    config: EncodeConfig | None, max_error: float | None, max_error_rel: float | None
) -> EncodeConfig:
    """The settings with the promise of the arguments."""
    values = {} if config is None else config.to_dict()
    for name, value in (("max_error", max_error), ("max_error_rel", max_error_rel)):
        if value is not None:
            values[name] = value
    return EncodeConfig.from_dict(values)


def _positions(
    coords: Mapping[str, Coordinate | npt.ArrayLike], shape: tuple[int, int, int], time_units: str
) -> dict[str, Coordinate]:
    """The coordinates of z, y and x, and name and attributes of t; raises InputError."""
    unknown = sorted(set(coords) - set(AXES))
    if unknown:
        raise InputError(f"coords names '{unknown[0]}'; allowed: z, y, x, and t for its attributes")
    result = {axis: index_coordinate(axis, n) for axis, n in zip(AXES, (1, *shape), strict=True)}
    if time_units:
        result["t"] = Coordinate(
            name=AXIS_NAMES["t"], values=np.zeros(1), attributes={"units": str(time_units)}
        )
    for axis, given in coords.items():
        known = isinstance(given, Coordinate)
        name = str(given.name) if isinstance(given, Coordinate) else AXIS_NAMES[axis]
        attributes = dict(given.attributes) if isinstance(given, Coordinate) else {}
        stored = given.values if isinstance(given, Coordinate) else given
        values = as_array(stored, f"the coordinate of {axis}").astype(float)
        if axis != "t" and values.shape != result[axis].values.shape:
            raise InputError(
                f"the coordinate of {axis} has shape {values.shape}; "
                f"{result[axis].values.shape} is needed"
            )
        if axis != "t" or known:
            result[axis] = Coordinate(
                name=name,
                values=values,
                attributes=json_attributes(attributes, without=frozenset()),
            )
    return result


class AppendReport(TypedDict):
    """A file that steps were appended to."""

    path: Annotated[str, "the file"]
    bytes: Annotated[int, "its size"]
    steps: Annotated[int, "its steps"]
    kept: Annotated[int, "those that it had before and keeps"]
    appended: Annotated[int, "those that are new"]
    psnr: Annotated[float | None, "dB over all steps"]
    rmse: Annotated[float | None, "root of the mean squared error, in data units"]
    max_abs_error: Annotated[float | None, "largest error, in data units"]


def append(
    source: Source, path: str | Path, *, keep: int | None = None, progress: Progress = silent
) -> AppendReport:
    """Append the steps of a series to the file `path`, in its tiles, settings and bound.

    source: a file, a Series or an array, as `encode` takes it: of the number type and the shape
        (z, y, x) of the file, without missing values. Its times follow those of the file; where
        neither has times, steps are counted on.
    keep: number of steps of the file to keep, whole layers; all if None.

    The file is replaced by the longer one at the end, or stays as it was. Raises InputError for a
    file that cannot grow and for steps that do not fit.
    """
    path = Path(path)
    with open_source(source) as series:
        with open_volume(path) as volume:
            _require_same(series, volume)
            packed = _packing(series.metadata) == _packing(volume.metadata)
        with continued(path, keep) as growing:
            if not packed:
                growing.forget_packing()
            kept = growing.steps
            growing.note(series.not_stored, series.shape[0])
            times = _times(series, growing)
            _add(series, growing, times, progress)
            series.check()
            growing.publish()
            steps = growing.steps
    with open_volume(path) as volume:
        size, quality = volume.container.size, volume.container.header["quality"]
    return {
        "path": str(path),
        "bytes": size,
        "steps": steps,
        "kept": kept,
        "appended": steps - kept,
        "psnr": quality.get("psnr"),
        "rmse": quality.get("rmse"),
        "max_abs_error": quality.get("max_abs_error"),
    }


def _add(
    series: Series, growing: GrowingFile, times: npt.NDArray[np.float64], progress: Progress
) -> None:
    """Code all steps of a series, layer by layer."""
    layer, steps = growing.coder.tile[0], series.shape[0]
    extremes = Extremes(series.dtype, series.unlikely)
    with thread_pool() as workers:
        for first in range(0, steps, layer):
            span = range(first, min(first + layer, steps))
            frames = [_frame(series, step, growing.coder.dtype) for step in span]
            for frame in frames:
                extremes.add(frame, frame.size, frame.min().item(), frame.max().item())
            coded = growing.coder.code(frames, growing.figures, workers)
            growing.add(coded, times[span.start : span.stop].tolist(), publish=False)
            progress("appending", span.stop, steps, "")
    extremes.refuse(series)


def _frame(series: Series, step: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """A frame in the type of the file; raises InputError for one with missing values."""
    frame = series.read(step)
    if frame.dtype.kind == "f" and not np.isfinite(frame).all():
        raise InputError(
            f"{series.source}: step {step} has values that are missing or infinite; a file that "
            "grows has none: encode these data as a file of their own"
        )
    if frame.dtype.kind == "f" and is_wide_integer(dtype) and np.abs(frame).max() > 1 << 53:
        raise InputError(
            f"{series.source}: step {step} has integers beyond 2^53, which a declared fill value "
            "makes floats of: they are rounded; --raw-values reads them as they are stored"
        )
    return frame.astype(dtype, copy=False)


def _packing(metadata: SourceMetadata | None) -> tuple[Any, ...]:
    """The packing of a source, for comparison."""
    if metadata is None:
        return ()
    told = metadata.variable_attributes
    return metadata.stored, *(_first_number(told.get(key, unit)) for key, unit in SCALES.items())


def _first_number(attribute: Any) -> float | str:
    """The number of an attribute that may be a list of one; the text of anything else."""
    numbers = np.ravel(attribute)
    if numbers.size and isinstance(numbers[0], int | float | np.number):
        return float(numbers[0])
    return str(attribute)


SCALES = {"scale_factor": 1.0, "add_offset": 0.0}
"""Attributes of a packing, and what they are where they are left out."""


def _labels_of(volume: Volume) -> Labels:
    return Labels.of_file(volume.path, volume.container.header, volume.coords)


def _require_same(series: Series, volume: Volume) -> None:
    """Raise InputError unless a series is more of what a volume is."""
    labels = Labels.of(series)
    require_alike(replace(labels, dtypes=labels.dtypes[1:]), _labels_of(volume))
    require_same_grid(series.metadata, volume.metadata, (series.source, str(volume.path)))


def _times(series: Series, growing: GrowingFile) -> npt.NDArray[np.float64]:
    """The times of the steps to append, counted as in the file.

    Steps without times go on at the distance of those before. Raises InputError unless all times
    ascend, and warns (FhashWarning) of times that were made up.
    """
    before, what = growing.time, series.source
    if "t" not in series.given:
        return _times_after(what, before, series.shape[0])
    times = _counted_as_in(growing.path, before, what, series.coords["t"])
    if not np.isfinite(times).all() or not (times[1:] > times[:-1]).all():
        raise InputError(f"{what}: its times must be finite and ascend")
    if not (before.values[1:] > before.values[:-1]).all():
        raise InputError(f"{growing.path}: its times do not ascend; begin another file")
    if not times[0] > before.values[-1]:
        raise InputError(
            f"{what} begins at time {times[0]:.9g}, and the file ends at "
            f"{before.values[-1]:.9g}; keep fewer steps of the file, or select later ones of the "
            "data"
        )
    return times


def _counted_as_in(
    path: Path, before: Coordinate, what: str, own: Coordinate
) -> npt.NDArray[np.float64]:
    """Times counted as those of a file; raises InputError where they cannot be compared."""
    here, there = own.attributes.get("units"), before.attributes.get("units")
    if here and not there and is_index(before):
        raise InputError(
            f"{what} has times in '{here}', and {path} has none but the numbers of its steps; "
            "give it times in such units (time_units), or give the data without times"
        )
    if not (here and there):
        return own.values
    return counted_times(what, ((path, before), (Path(what), own)))[1]


def _times_after(what: str, before: Coordinate, count: int) -> npt.NDArray[np.float64]:
    """Times of some steps that have none, behind those of a file whose times are even."""
    steps = np.diff(before.values)
    even = steps.size and steps[0] > 0 and np.allclose(steps, steps[0], rtol=EVEN, atol=0)
    told = before.attributes.get("units")
    if not even and not is_index(before):
        raise InputError(
            f"{what} has no times, and those of the file, which ends at {before.values[-1]:.9g}, "
            "have no even distance; give the data with times"
        )
    step = float(steps[0]) if steps.size else 1.0
    times: npt.NDArray[np.float64] = before.values[-1] + step * np.arange(1, count + 1)
    if told or not is_index(before):
        warnings.warn(
            f"{what} has no times: its steps go on from {times[0]:.9g} to {times[-1]:.9g}, as far "
            f"apart as those before{f', in {told!r}' if told else ''}",
            FhashWarning,
            stacklevel=3,
        )
    return times


EVEN = 1e-6
"""Share by which distances of times that are even may differ, as float64 rounds them."""
