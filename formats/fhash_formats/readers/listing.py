"""Listing of a source: what is said of each variable, and the commands that encode it."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, TypedDict

from fhash_formats.errors import InputError
from fhash_formats.readers.cf import Packing
from fhash_formats.readers.file_series import RawLayout, Request
from fhash_formats.readers.layout import (
    Dimension,
    arrange,
    is_asked,
    label,
    left,
    must_select,
    picks,
    readings,
    single,
)
from fhash_formats.readers.variables import Variable, kind_of, named, plain_name
from fhash_formats.series import AXES, Series, empty_selection
from fhash_formats.support.values import plain_text


class ListedDimension(TypedDict):
    """A dimension of a variable, as JSON values."""

    name: Annotated[str, "its name, or `dim0` and so on"]
    length: Annotated[int, "its length"]
    axis: Annotated[str, "`t`, `z`, `y`, `x`, `select` (one index) or `?` (unclear)"]


class ListedVariable(TypedDict):
    """A variable of a source, as JSON values."""

    name: Annotated[str, "as `--var` takes it"]
    shape: Annotated[list[int], "lengths in the order of the file"]
    dtype: Annotated[str, "type of the values"]
    stored: Annotated[str, "type of packed numbers; empty where nothing is packed"]
    missing: Annotated[list[float | str], "missing values; text if not finite"]
    units: Annotated[str, "may be empty"]
    dimensions: Annotated[list[ListedDimension], "in the order of the file"]
    commands: Annotated[list[str], "the command that encodes it, one for each likely reading"]
    problem: Annotated[str, "why it cannot be encoded; empty where it can"]


@dataclass(frozen=True, kw_only=True)
class Listed:
    """One variable of a source.

    Attributes:
        name: full name, as `--var` takes it.
        shape: lengths in the file's order.
        dtype: type of the values, in words.
        stored: type of the stored numbers, where values are unpacked; "" where it is the same.
        missing: numbers that stand for missing values in the file, by its attributes.
        units: of the values, "" where unknown.
        dimensions: name and axis of each dimension; the axis is "t", "z", "y" or "x", "select"
            where an index must be selected, and "?" where two readings are likely.
        options: for each likely reading, the options of `fhash encode` that it needs; none if the
            variable cannot be encoded.
        problem: why it cannot be encoded, "" if it can.
        output: name of a container for it, which no other variable of the source has.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    stored: str = ""
    missing: tuple[float, ...] = ()
    units: str = ""
    dimensions: tuple[tuple[str, str], ...] = ()
    options: tuple[tuple[str, ...], ...] = ()
    problem: str = ""
    output: str = ""

    def of_steps(self, steps: slice, *, whole: bool) -> Listed:
        """This variable where some steps are asked for: its commands ask for them, too.

        whole: whether the lengths are those of the whole source, so that an empty selection is
        a problem.
        """
        axes = [axis for _, axis in self.dimensions]
        count = self.shape[axes.index("t")] if "t" in axes else 1
        if self.options and whole and not range(*steps.indices(count)):
            return replace(self, options=(), problem=empty_selection(count))
        parts = [steps.start, steps.stop] + ([] if steps.step is None else [steps.step])
        text = ":".join("" if part is None else str(part) for part in parts)
        return replace(self, options=tuple((*words, "--t", text) for words in self.options))

    def commands(self, path: str) -> list[str]:
        """The command for each likely reading, for a shell."""
        output = self.output or f"{self.name}.fhz"
        return [
            shlex.join(["fhash", "encode", path, "-o", output, *options])
            for options in self.options
        ]

    def as_dict(self, path: str) -> ListedVariable:
        """JSON values: all attributes, and the commands."""
        return {
            "name": self.name,
            "shape": list(self.shape),
            "dtype": self.dtype,
            "stored": self.stored,
            "missing": [value if math.isfinite(value) else str(value) for value in self.missing],
            "units": self.units,
            "dimensions": [
                {"name": name, "length": length, "axis": axis}
                for (name, axis), length in zip(self.dimensions, self.shape, strict=False)
            ],
            "commands": self.commands(path),
            "problem": self.problem,
        }


def listing(
    source: str,
    variables: Sequence[Variable],
    dimensions: Callable[[Variable], list[Dimension]],
    request: Request,
    packed: Callable[[Variable], Packing | None] = lambda variable: None,
) -> list[Listed]:
    """The variables of a file; coordinates and the members of joined ones are left out.

    A request that names a variable gets that one alone, whatever it is.

    dimensions, packed: dimensions of a variable that can be read, and the packing that the file
        declares, whatever the request is.
    """
    shown = [variable for variable in variables if not variable.auxiliary]
    good = [each for each in shown if not each.problem(request.booleans) and not each.note]
    several = len(good) > 1
    found = []
    plain = Counter(plain_name(variable.name) for variable in shown)
    if request.var is not None:
        shown = [named(source, variables, good or shown, request.var)]
    for variable in shown:
        name, problem = plain_text(variable.name), variable.problem(request.booleans)
        problem = problem or ("" if request.var else variable.note)
        entry = Listed(
            name=name,
            shape=variable.shape,
            dtype=kind_of(variable.dtype),
            units=plain_text(variable.units),
            problem=problem,
            output=_output(variable.name, plain[plain_name(variable.name)] > 1),
        )
        if not problem:
            said = ("--var", name) if several or request.var else ()
            try:
                # of raw values, attributes that make no sense are not used
                with suppress(*[InputError] * request.raw_values):
                    entry = _typed(entry, packed(variable), raw_values=request.raw_values)
                entry = _read(source, entry, dimensions(variable), request, said)
            except InputError as error:  # of attributes that make no sense
                entry = replace(entry, problem=str(error).removeprefix(f"{source}: "))
        found.append(entry)
    return found


def _output(name: str, whole: bool) -> str:
    """A name of a container for a variable, with its groups where the last part is not enough."""
    text = name.replace("/", "_") if whole else plain_name(name)
    return re.sub(r"[*#\s]+", "", "".join(filter(str.isprintable, text))).strip("._") + ".fhz"


def _typed(entry: Listed, packed: Packing | None, *, raw_values: bool) -> Listed:
    """An entry with the type of the values and the fill values, or with the stored type."""
    if packed is None:
        return entry
    if raw_values:  # counts have not the unit of the values
        units = "" if packed.scaled else entry.units
        return replace(entry, dtype=kind_of(packed.stored), units=units)
    # integers of which some are missing decode to integers again
    changed = packed.scaled and packed.dtype != packed.stored
    return replace(
        entry,
        dtype=kind_of(packed.dtype if packed.scaled else packed.stored),
        stored=kind_of(packed.stored) if changed else "",
        missing=tuple(fill.item() for fill in packed.fills),
    )


def _read(
    source: str,
    entry: Listed,
    dimensions: Sequence[Dimension],
    request: Request,
    named: tuple[str, ...],
) -> Listed:
    """An entry with its dimensions and the options of its readings."""
    names = [label(place, dimension) for place, dimension in enumerate(dimensions)]
    axes, problem = ["?"] * len(dimensions), ""
    options: tuple[tuple[str, ...], ...] = ()
    try:
        chosen = picks(source, entry.name, dimensions, request.select)
        said = (*named, *_given(request))
        if request.axes is None:
            chosen |= single(dimensions, chosen)
            for place in must_select(dimensions, chosen):
                chosen[place] = 0
                said = (*said, "--select", f"{names[place]}=0")
                request = replace(request, select=(*request.select, (names[place], "0")))
        for place in chosen:
            axes[place] = "select"
        kept = [place for place in range(len(dimensions)) if place not in chosen]
        selected = bool(request.select)
        if request.axes is None and is_asked(dimensions, chosen, selected=selected):
            for place in kept[:-1]:
                axes[place] = dimensions[place].role or "?"
            both = readings(dimensions, left(dimensions, chosen))
            options = tuple((*said, *text.split()) for text in both)
        else:
            layout = arrange(source, entry.name, dimensions, request)
            for place, axis in zip(kept, layout.axes, strict=True):
                axes[place] = axis
            options = (said,)
    except InputError as error:
        problem = str(error).removeprefix(f"{source}: ")
    told = tuple(zip(names, axes, strict=True))
    return replace(entry, dimensions=told, options=options, problem=problem)


def _given(request: Request) -> tuple[str, ...]:
    """The options that the user gave already, which the commands repeat."""
    raw = request.raw or RawLayout()
    shape = raw.shape and ",".join(f"{axis}={n}" for axis, n in raw.shape.items())
    pairs = [
        ("--axes", request.axes and ",".join(request.axes)),
        *(("--select", f"{name}={index}") for name, index in request.select),
        ("--shape", shape),
        ("--dtype", raw.dtype),
        ("--endian", raw.endian),
        ("--raw-values", "" if request.raw_values else None),
        ("--overlap", request.overlap),
        *(("--missing", repr(value)) for value in request.missing),
    ]
    return tuple(word for pair in pairs if pair[1] is not None for word in pair if word)


def listed_series(series: Series, request: Request) -> Listed:
    """The only variable of a source that is one series already."""
    return Listed(
        name=series.name,
        shape=series.shape,
        dtype=kind_of(series.source_dtype or series.dtype),
        missing=request.missing,
        units=series.units,
        dimensions=tuple((series.coords[axis].name, axis) for axis in AXES),
        options=(("--var", request.var, *_given(request)) if request.var else _given(request),),
        output=_output(series.name, whole=False),
    )
