"""Series: a time-varying volume that is read step by step, and what its source says about it."""

from __future__ import annotations

import math
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, NotRequired, Self, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError, RegionError
from fhash_formats.support.values import as_array, plain_text

NO_AXIS = ""
"""Axis of a dimension of length 1 that is none of t, z, y and x."""
COORDINATES = "coordinates"
"""CF attribute that names the auxiliary coordinates of a variable."""

MAX_NAME = 256
"""Letters of a name."""
MAX_FILE_NAME = 240
"""Bytes of a name that may become that of a file or folder."""

NAMING = (
    "grid_mapping",
    "bounds",
    "climatology",
    "formula_terms",
    "ancillary_variables",
    "cell_measures",
    "geometry",
    "node_coordinates",
    "node_count",
    "part_node_count",
    "interior_ring",
)
"""Attributes that name further variables, as "name name" or "key: name key: name"."""

LOOSELY_NAMING = re.compile(r"edges|mesh|.+_vars?|.+_variables?", re.IGNORECASE)
"""Further attributes whose words name variables, if there are such: A_var, PS_var, edges."""

Places = int | Sequence[int] | None
"""Places along a dimension: some of them in order, one of them, which takes the dimension away, or
None where none of the stored ones is right."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceVariable:
    """An array beside the data: a coordinate, bounds, a grid mapping, coefficients of levels.

    Attributes:
        name: in the source.
        dimensions: names of its axes, () for a scalar.
        values: in the stored type, not decoded; texts are objects or bytes.
        attributes: as they are stored.
        is_coordinate: whether it is a coordinate of the variable.
    """

    name: str
    dimensions: tuple[str, ...]
    values: npt.NDArray[Any]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    is_coordinate: bool = False

    def cut(self, places: Mapping[str, Places]) -> SourceVariable | None:
        """The variable at some places along dimensions; None where it has no values there."""
        values, kept = self.values, list(self.dimensions)
        for number, name in reversed(list(enumerate(self.dimensions))):
            if name not in places:
                continue
            chosen = places[name]
            if chosen is None:
                return None
            single = isinstance(chosen, int)
            indices = np.array([chosen] if isinstance(chosen, int) else list(chosen), dtype=np.intp)
            values = np.take(values, indices, axis=number)
            if single:
                del kept[number]
                values = values.reshape(values.shape[:number] + values.shape[number + 1 :])
        return replace(self, values=values, dimensions=tuple(kept))


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceMetadata:
    """All that belongs to a variable of a source.

    Attributes:
        dimensions: dimensions of the variable in the source's own order, each with its axis "t",
            "z", "y" or "x", or NO_AXIS where it has length 1 and is none. An axis that is not
            there was made up, with length 1.
        variable_attributes: all attributes of the variable as they are stored.
        variables: the arrays beside it.
        attributes: of the file, or of the group of the variable.
        stored: number type of the stored values, where it is not that of the decoded ones.
        file: name of the file, without folders; None for data in memory.
        digest: SHA-256 of the file, hexadecimal; None where it was not taken.
        unlimited: those of the dimensions that can grow in the file.
    """

    dimensions: Mapping[str, str]
    variable_attributes: Mapping[str, Any] = field(default_factory=dict)
    variables: tuple[SourceVariable, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    stored: str | None = None
    file: str | None = None
    digest: str | None = None
    unlimited: tuple[str, ...] = ()

    def cut(self, places: Mapping[str, Places]) -> SourceMetadata:
        """The metadata of a part of the variable.

        places: along an axis "t", "z", "y" or "x": the chosen vertices or steps in order, or None
            for places between them, at which no array beside the data has a value.
        """
        by_name = {name: places[axis] for name, axis in self.dimensions.items() if axis in places}
        if not by_name:
            return self
        cut = (variable.cut(by_name) for variable in self.variables)
        kept = tuple(variable for variable in cut if variable is not None)
        lost = {variable.name for variable in self.variables} - {each.name for each in kept}
        attributes = without_names(self.variable_attributes, lost)
        return replace(self, variables=kept, variable_attributes=attributes)

    def named(self, name: str) -> SourceVariable | None:
        """The array of a name; None without it."""
        return next((each for each in self.variables if each.name == name), None)

    def along(self, axis: str) -> str | None:
        """Name of the dimension that is an axis; None where the axis was made up."""
        return next((name for name, each in self.dimensions.items() if each == axis), None)


def without_names(attributes: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Attributes whose list of coordinates does not name some variables.

    A name of no variable would keep a reader from all the others.
    """
    listed = attributes.get(COORDINATES)
    if not names or not isinstance(listed, str):
        return dict(attributes)
    kept = " ".join(name for name in listed.split() if name not in names)
    others = {key: value for key, value in attributes.items() if key != COORDINATES}
    return {**others, COORDINATES: kept} if kept else others


def references(
    attributes: Mapping[str, Any], *, loosely: bool = False
) -> Iterator[tuple[str, str]]:
    """Attributes that name other variables, each with a name in it, in order.

    loosely: those of LOOSELY_NAMING as well, whose words need not be names.
    """
    more = [key for key in attributes if loosely and LOOSELY_NAMING.fullmatch(key)]
    for key in dict.fromkeys((COORDINATES, *NAMING, *more)):
        text = attributes.get(key)
        for word in text.split() if isinstance(text, str) else ():
            if not word.endswith(":"):
                yield key, word
            elif key == "grid_mapping":
                yield key, word[:-1]


def renamed(attributes: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Attributes that name other variables by their new names. names: new by old ones."""

    def word(old: str) -> str:
        bare = old.removesuffix(":")
        return names.get(bare, bare) + old[len(bare) :]

    changed = {
        key: " ".join(
            word(old) if key == "grid_mapping" or not old.endswith(":") else old
            for old in attributes[key].split()
        )
        for key in dict.fromkeys(
            key for key, name in references(attributes, loosely=True) if name in names
        )
    }
    return {**attributes, **changed}


def with_history(attributes: Mapping[str, Any], line: str) -> dict[str, Any]:
    """Attributes of a file with one more line of `history`, as CF asks of every program."""
    before = attributes.get("history")
    text = f"{before.rstrip()}\n{line}" if isinstance(before, str) and before.strip() else line
    return {**attributes, "history": text}


def shown_name(name: str, taken: Collection[str]) -> str:
    """The name of a variable, or another where a dimension has its last part as a name.

    The component "B/x" of a vector on a grid of x, y and z is B_x then, and an array without a
    group values_x. taken: names of the dimensions.
    """
    *groups, last = name.split("/")
    if last not in taken:
        return name
    return f"{next((each for each in groups[::-1] if each and '*' not in each), 'values')}_{last}"


def meant(wish: str, names: Collection[str]) -> list[str]:
    """The names that a wish means: the whole of one, else its last parts, "E/x", "x" or E_x."""
    name = wish.strip("/")
    for whole in (wish, name):
        if whole in names:
            return [whole]
    return [
        each
        for each in names
        if each.endswith((f"/{name}", f".{name}")) or "_".join(each.split("/")[-2:]) == name
    ]


def is_plain_name(name: object) -> bool:
    """Whether every format takes a text as the name of a variable, a dimension or an attribute."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= MAX_NAME
        and name.isprintable()
        and not set(name) & set("/\\")
        and name == name.strip()
        and bool(name.strip("._"))
        and not name.startswith("__")
    )


def plain_form(name: str, taken: Collection[str] = (), *, default: str = "unnamed") -> str:
    """The name as files and folders of every format take it, and as none of `taken` is.

    It is the name itself where that is so.

    default: stands for a name of which nothing is left.
    """
    safe = (c if c.isprintable() and c not in "/\\" else "_" for c in plain_text(name))
    text = "".join(safe).strip()
    while len(text.encode(errors="replace")) > MAX_FILE_NAME:
        text = text[:-1].strip()
    if text.startswith("__"):
        text = f"_{text.lstrip('_')}"
    if text == "zarr.json" or text.startswith(".z"):  # files of Zarr
        text = text.replace(".", "_")
    text = text if text.strip("._") else default
    number, found = 2, text
    while found in taken:
        found, number = f"{text}_{number}", number + 1
    return found


def with_plain_names(metadata: SourceMetadata) -> tuple[SourceMetadata, dict[str, str]]:
    """The metadata with names that every format takes, and the new names by the old ones."""
    every = dict.fromkeys(metadata.dimensions)
    for variable in metadata.variables:
        every |= dict.fromkeys([variable.name, *variable.dimensions])
    names: dict[str, str] = {}
    taken = {name for name in every if plain_form(name) == name}
    for name in every:
        if name not in taken:
            names[name] = plain_form(name, taken | set(names.values()))
    if not names:
        return metadata, {}
    variables = tuple(
        replace(
            variable,
            name=names.get(variable.name, variable.name),
            dimensions=tuple(names.get(each, each) for each in variable.dimensions),
            attributes=renamed(variable.attributes, names),
        )
        for variable in metadata.variables
    )
    return replace(
        metadata,
        dimensions={names.get(name, name): axis for name, axis in metadata.dimensions.items()},
        unlimited=tuple(names.get(name, name) for name in metadata.unlimited),
        variable_attributes=renamed(metadata.variable_attributes, names),
        variables=variables,
    ), names


AXES = ("t", "z", "y", "x")
MAX_SPANS = 64
"""Runs of steps that are told one by one."""
AXIS_NAMES = {"t": "time", "z": "z", "y": "y", "x": "x"}
"""Name of each axis in a container, and of a coordinate that the source does not name."""


@dataclass(frozen=True, kw_only=True)
class Coordinate:
    """Positions along one axis.

    Attributes:
        name: the file's name of the axis.
        values: float64 (n,).
        attributes: JSON values.
    """

    name: str
    values: npt.NDArray[np.float64]
    attributes: Mapping[str, Any] = field(default_factory=dict)


def index_coordinate(axis: str, length: int) -> Coordinate:
    """The coordinate 0, 1, 2, ... of an axis for which the file has none."""
    return Coordinate(name=AXIS_NAMES[axis], values=np.arange(length, dtype=np.float64))


class NotStoredValues(TypedDict):
    """Values that nobody wrote, as JSON values."""

    share: Annotated[float, "of all values, 0 to 1"]
    steps: Annotated[list[list[int]], "runs of steps that have such values, [first, end)"]
    fill: NotRequired[Annotated[float, "what stands there; left out where it is not finite"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class NotStored:
    """Values of a series that nobody wrote: one number stands in their place.

    Attributes:
        shares: of the values of each step, 0 to 1, float64 (t,).
        fill: that number, as it is read.
    """

    shares: npt.NDArray[np.float64]
    fill: float | int

    @property
    def share(self) -> float:
        """Share of all values."""
        return float(self.shares.mean())

    def spans(self) -> list[list[int]]:
        """Steps of which something was not stored, as [first, last + 1]; the last may be longer."""
        steps = np.flatnonzero(self.shares)
        ends = np.flatnonzero(np.diff(steps) > 1)
        firsts, lasts = steps[np.r_[0, ends + 1]], steps[np.r_[ends, len(steps) - 1]]
        spans = [[int(first), int(last) + 1] for first, last in zip(firsts, lasts, strict=True)]
        if len(spans) > MAX_SPANS:
            spans[MAX_SPANS - 1 :] = [[spans[MAX_SPANS - 1][0], spans[-1][1]]]
        return spans

    def to_dict(self) -> NotStoredValues:
        """JSON values, as the header of a container has them."""
        found: NotStoredValues = {"share": round(self.share, 6), "steps": self.spans()}
        if math.isfinite(self.fill):
            found["fill"] = self.fill
        return found

    def of_steps(self, steps: Sequence[int]) -> NotStored | None:
        """The same of some steps; None where everything of these was stored."""
        shares = self.shares[list(steps)]
        return replace(self, shares=shares) if shares.any() else None


BLOCK = 1 << 18
"""Most vertices of several steps that are worked on together; they take a few MiB in all forms.

What is done once for each block takes no time then beside what is done for each value.
"""


def step_blocks(steps: range, shape: Sequence[int]) -> Iterator[tuple[slice, range]]:
    """Cut steps into neighbouring ones that are read together, so that a block stays small.

    steps: of any stride. shape: (z, y, x) of one frame. Yields places in `steps`, and the steps
    there, which follow one another.
    """
    many = max(1, BLOCK // math.prod(shape)) if steps.step == 1 else 1
    for place in range(0, len(steps), many):
        together = steps[place : place + many]
        alone = together if len(together) > 1 else range(together[0], together[0] + 1)
        yield slice(place, place + len(together)), alone


class Series(ABC):
    """A time-varying volume (t, z, y, x), read frame by frame.

    Attributes:
        source: path as given by the user, for messages.
        name: name of the variable, e.g. "density".
        units: units of the values, "" where unknown.
        dtype: number type of the frames, integer or float, native byte order.
        shape: (t, z, y, x), every length at least 1.
        coords: a Coordinate for each of "t", "z", "y", "x".
        attributes: attributes of the variable, JSON values.
        files: files and folders that the series is read from, which no output may replace; empty
            for a series in memory.
        source_dtype: the integer type of the source where missing values made the frames floats;
            None where the frames have the type of the source.
        fill: the number that stood in the source for a missing value; None where there is none.
        occurring: numbers that the user named as missing, and that were met in the frames read so
            far.
        keep_extremes: whether the user said that extreme values which repeat are data.
        unlikely: values that stand for the lowest integers of the stored type, where counts are
            unpacked; they are hardly ever data.
        remark: what is to be said of the times, "" for nothing.
        not_stored: what of the values nobody wrote; None where nothing is known of such.
        held: all frames (t, z, y, x) as `read` gives them; None where they are not in memory.
        lazy: the array of dask (t, z, y, x) that the frames are computed from, if they are.
        defaults: default fill values of the format that were met in the frames read so far, of an
            array that declares no other. Among floats they are missing.
        valid: least and greatest valid value that the source declares. Values outside are data.
        named: whether the source names the variable; else its name is made of that of the file.
        group: that the variable is in, "" for none, and where the user names the variable.
        given: axes whose coordinate the source gives.
    """

    source: str
    name: str
    units: str
    dtype: np.dtype[Any]
    shape: tuple[int, int, int, int]
    coords: Mapping[str, Coordinate]
    attributes: Mapping[str, Any]
    files: tuple[Path, ...] = ()
    source_dtype: np.dtype[Any] | None = None
    fill: int | float | None = None
    occurring: AbstractSet[float] = frozenset()
    keep_extremes: bool = False
    unlikely: frozenset[float] = frozenset()
    remark: str = ""
    not_stored: NotStored | None = None
    held: npt.NDArray[Any] | None = None
    lazy: Any = None
    defaults: AbstractSet[float] = frozenset()
    valid: tuple[Any, Any] | None = None
    named: bool = True
    group: str = ""
    given: AbstractSet[str] = frozenset()
    _metadata: SourceMetadata | Callable[[], SourceMetadata | None] | None = None

    @property
    def metadata(self) -> SourceMetadata | None:
        """All that belongs to the variable in its source; None where nothing is known.

        It is read at the first use. Warns (FhashWarning) of what is left out, and of names that
        other files could not have and that were changed.
        """
        if callable(self._metadata):
            found = self._metadata()
            self._metadata = found
            if found is not None:
                self._metadata, names = with_plain_names(found)
                if names:
                    told = ", ".join(f"{old[:40]!r} to {new!r}" for old, new in names.items())
                    warnings.warn(
                        f"{self.source}: names that other files cannot have were changed: {told}",
                        FhashWarning,
                        stacklevel=2,
                    )
        return self._metadata

    @metadata.setter
    def metadata(self, metadata: SourceMetadata | Callable[[], SourceMetadata | None]) -> None:
        self._metadata = metadata

    @abstractmethod
    def read(self, step: int) -> npt.NDArray[Any]:
        """One frame (z, y, x) of `self.dtype`, C-contiguous; callers must not write to it.

        Raises RegionError for a step outside 0 .. shape[0] - 1, and InputError if the file cannot
        be read.
        """

    def read_steps(self, steps: range) -> npt.NDArray[Any]:
        """The frames (t, z, y, x) of neighbouring steps, as `read` gives and raises them."""
        frames = [self.read(step) for step in steps]
        return frames[0][None] if len(frames) == 1 else np.stack(frames)

    def block(self, steps: range) -> npt.NDArray[Any]:
        """The frames (t, z, y, x) of neighbouring steps, which are read unless they are held."""
        if self.held is None:
            return self.read_steps(steps)
        return np.ascontiguousarray(self.held[steps.start : steps.stop])

    def frame(self, step: int) -> npt.NDArray[Any]:
        """The frame (z, y, x) of a step, which is read unless it is held."""
        frame: npt.NDArray[Any] = self.block(range(step, step + 1))[0]
        return frame

    def require_step(self, step: int) -> None:
        """Raise RegionError for a step outside the series; negative steps are outside, too."""
        if not 0 <= step < self.shape[0]:
            raise RegionError(f"{self.source}: step {step} is outside 0..{self.shape[0] - 1}")

    def check(self) -> None:  # noqa: B027 - a series in memory does not change
        """Raise InputError if the files changed since they were opened.

        The frames that were read would then not be of one state. `read` notices most changes at
        once, but only this looks at every file, such as the chunks of a Zarr folder. A caller that
        makes an output of all frames calls this before the output takes its name.
        """

    def close(self) -> None:  # noqa: B027 - a series in memory has nothing to release
        """Release the files."""

    def inherit(self, series: Series) -> None:
        """Take over what is known of the source of another series with the same values."""
        self.source_dtype, self.fill = series.source_dtype, series.fill
        self.occurring = series.occurring
        self.keep_extremes, self.unlikely = series.keep_extremes, series.unlikely
        self.not_stored, self.defaults = series.not_stored, series.defaults
        self.valid = series.valid
        self.named, self.group, self.given = series.named, series.group, series.given

    def outside(self, frames: npt.NDArray[Any]) -> int:
        """Number of values in frames that are outside the range which the source calls valid."""
        if self.valid is None:
            return 0
        low, high = self.valid
        if frames.dtype.kind == "f":
            low, high = (frames.dtype.type(end) for end in self.valid)
        return int(np.count_nonzero(frames < low) + np.count_nonzero(frames > high))

    def frames(self) -> Iterator[npt.NDArray[Any]]:
        """Yield every frame in order."""
        for _, frames in self.blocks(range(self.shape[0])):
            yield from frames

    def blocks(self, steps: range) -> Iterator[tuple[range, npt.NDArray[Any]]]:
        """Yield some neighbouring steps with their frames (t, z, y, x), cut by `step_blocks`."""
        for _, block in step_blocks(steps, self.shape[1:]):
            yield block, self.block(block)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def spans_text(spans: Sequence[Sequence[int]]) -> str:
    """Runs of steps for people: "step 3", "steps 0 to 4, 7"."""
    words = [str(a) if b == a + 1 else f"{a} to {b - 1}" for a, b in spans]
    shown = [*words[:8], "..."] if len(words) > 8 else words
    one = len(words) == 1 and spans[0][1] == spans[0][0] + 1
    return f"step{'' if one else 's'} {', '.join(shown)}"


def warn_not_stored(series: Series) -> None:
    """Warn (FhashWarning) of values that nobody wrote, in one line."""
    found = series.not_stored
    if found is None:
        return
    fill = f"{found.fill:.9g}" if isinstance(found.fill, float) else str(found.fill)
    warnings.warn(
        f"{series.source}: {100 * found.share:.3g} % of the values of '{series.name}' are not"
        f" stored ({spans_text(found.spans())}): read as {fill}; --missing {fill} takes that number"
        " for a missing value",
        FhashWarning,
        stacklevel=3,
    )


def warn_defaults(series: Series) -> None:
    """Warn (FhashWarning) of default fill values that were met, in one line."""
    for value in series.defaults:
        what = f"{series.source}: '{series.name}' declares no fill value and has the default one of"
        what += f" NetCDF, {value:.9g}, which stands for values that nobody wrote: "
        if series.dtype.kind == "f":
            what += "it is missing, by NetCDF's convention; --keep-extremes keeps the number"
        else:
            what += f"it is kept as a number; --missing {value} takes it for a missing value"
        warnings.warn(what, FhashWarning, stacklevel=3)


def warn_outside(series: Series, count: int) -> None:
    """Warn (FhashWarning) of values outside the range that the source calls valid, in one line."""
    if count and series.valid is not None:
        low, high = (f"{end:.9g}" for end in series.valid)
        warnings.warn(
            f"{series.source}: {100 * count / math.prod(series.shape):.3g} % of the values of"
            f" '{series.name}' ({count}) are outside the valid range {low} to {high} that it"
            " declares, which CF takes for missing; they are kept as data, --missing takes a number"
            " for a missing value",
            FhashWarning,
            stacklevel=3,
        )


def empty_selection(steps: int) -> str:
    """The message for a selection of no step out of some."""
    return f"the selection of steps is empty; the series has {steps} steps"


class StepsSeries(Series):
    """Some steps of another series, in the order given.

    Raises InputError for no steps, and RegionError for a step outside the other series.
    """

    def __init__(self, series: Series, steps: Sequence[int]) -> None:
        if not steps:
            raise InputError(f"{series.source}: {empty_selection(series.shape[0])}")
        for step in steps:
            series.require_step(step)
        self.series = series
        self.steps = tuple(steps)
        self.source, self.name, self.units = series.source, series.name, series.units
        self.dtype, self.attributes, self.files = series.dtype, series.attributes, series.files
        self.inherit(series)
        if series.not_stored is not None:
            self.not_stored = series.not_stored.of_steps(self.steps)
        self.metadata = self._metadata_of_steps
        self.shape = (len(self.steps), *series.shape[1:])
        time = series.coords["t"]
        self.coords = {
            **series.coords,
            "t": replace(time, values=time.values[list(self.steps)]),
        }

    def _metadata_of_steps(self) -> SourceMetadata | None:
        metadata = self.series.metadata
        return None if metadata is None else metadata.cut({"t": self.steps})

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return self.series.read(self.steps[step])

    def read_steps(self, steps: range) -> npt.NDArray[Any]:
        chosen = self.steps[steps.start : steps.stop]
        together = range(chosen[0], chosen[0] + len(steps))
        if chosen != tuple(together):
            return super().read_steps(steps)
        return self.series.read_steps(together)

    def check(self) -> None:
        self.series.check()

    def close(self) -> None:
        self.series.close()


UNNAMED = "values"
"""Name of a variable that has none."""


class ArraySeries(Series):
    """An array in memory, (t, z, y, x) or (z, y, x), as a series; masked floats become NaN.

    missing: numbers that stand for missing values. They become NaN, and integers become floats.
    keep_extremes: see `Series`.

    Raises InputError for an array that cannot be a series, and for coordinates that do not fit.
    """

    def __init__(
        self,
        array: Any,
        *,
        name: str = UNNAMED,
        units: str = "",
        coords: Mapping[str, Coordinate] | None = None,
        missing: Sequence[float] = (),
        keep_extremes: bool = False,
    ) -> None:
        values = as_array(array)
        if missing and values.dtype.kind in "iuf":
            self.source_dtype = values.dtype if values.dtype.kind in "iu" else None
            self.fill = missing[0]
            values = _without(values, missing)
        self.keep_extremes = keep_extremes
        self.named, self.given = name != UNNAMED, frozenset(coords or ())
        self.source, self.name, self.units, self.attributes = "array", name, units, {}
        if values.ndim == 3:
            values = values[None]
        self.shape = check_values(self.source, values.shape, values.dtype)
        self.dtype = values.dtype.newbyteorder("=")
        self.values = values
        self.held = values if values.dtype == self.dtype else None
        self.coords = {
            axis: index_coordinate(axis, n) for axis, n in zip(AXES, self.shape, strict=True)
        } | dict(coords or {})
        check_coords(self.source, self.coords, self.shape)

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.values[step], dtype=self.dtype)

    def read_steps(self, steps: range) -> npt.NDArray[Any]:
        return np.ascontiguousarray(self.values[steps.start : steps.stop], dtype=self.dtype)


def check_values(
    what: str, shape: Sequence[int], dtype: np.dtype[Any]
) -> tuple[int, int, int, int]:
    """The shape (t, z, y, x) of an array that can be a series; raises InputError for others.

    Args:
        what: name of the array, for messages.
        shape: of the array.
        dtype: of the array.
    """
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(
            f"{what}: values of type {dtype} cannot be encoded; "
            "integers and floats up to 64 bits can"
        )
    if len(shape) != 4:
        raise InputError(
            f"{what}: {len(shape)} dimensions {tuple(shape)}; "
            "a series has 4 (t, z, y, x), or 3 (z, y, x) for one step"
        )
    if min(shape) < 1:
        raise InputError(f"{what}: an axis is empty, shape {tuple(shape)} in (t, z, y, x)")
    t, z, y, x = (int(n) for n in shape)
    return t, z, y, x


def check_coords(
    what: str, coords: Mapping[str, Coordinate], shape: tuple[int, int, int, int]
) -> None:
    """Raise InputError unless each of t, z, y, x has a float64 coordinate as long as the axis."""
    if set(coords) != set(AXES):
        raise InputError(
            f"{what}: coordinates of {sorted(coords)}; exactly those of t, z, y and x are needed"
        )
    for axis, length in zip(AXES, shape, strict=True):
        values = coords[axis].values
        if values.shape != (length,) or values.dtype != np.float64:
            raise InputError(
                f"{what}: the coordinate of {axis} is {values.dtype} {values.shape}; "
                f"float64 ({length},) is needed"
            )


def _without(values: npt.NDArray[Any], missing: Sequence[float]) -> npt.NDArray[Any]:
    """A copy with NaN for some numbers.

    Integers become float32 where it holds all of their type (up to 16 bits), else float64.
    """
    dtype = values.dtype
    if dtype.kind != "f":
        dtype = np.dtype(np.float32 if dtype.itemsize <= 2 else np.float64)
    result = values.astype(dtype)
    for number in missing:
        # a number of the array's own type is compared exactly; one beyond it is nowhere
        limits = np.iinfo(values.dtype) if values.dtype.kind in "iu" else None
        if limits is None:
            with np.errstate(over="ignore"):
                result[values == values.dtype.type(number)] = np.nan
        elif float(number).is_integer() and limits.min <= number <= limits.max:
            result[values == int(number)] = np.nan
    return result
