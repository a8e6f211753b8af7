"""Text about data that can be encoded: its variables, and one of them in detail."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fhash_cli.output import apart, extent, listed, one_line

MIN_DIMENSIONS = 3
"""Dimensions of an array that may be a variable; others are named in one line."""

UNOPENED = "what cannot be opened"
"""Beginning of the problem of an array of which nothing is known."""

MAX_NAMES = 8
"""Names of one line; of more `listed` leaves some out."""

MAX_TEXT = 300
"""Characters of an attribute that are shown."""

if TYPE_CHECKING:
    from fhash_formats.series import Coordinate, Series


def listing(
    path: str, files: int, variables: Sequence[Mapping[str, Any]], *, named: bool = False
) -> str:
    """The variables of a data file, each with its commands; then what cannot be encoded.

    named: whether the user named the only variable that is listed.
    """
    good = [variable for variable in variables if not variable["problem"]]
    many = f" ({files} files; shapes are of the first)" if files > 1 else ""
    count = f"{len(good) or 'no'} variable{'' if len(good) == 1 else 's'}"
    lines = [f"{path}{many} holds {count} to encode"] if not named else [f"{path}{many}"]
    for variable in good:
        units = f", in {variable['units']}" if variable["units"] not in ("", "1") else ""
        shape = ", ".join(_dimension(**dimension) for dimension in variable["dimensions"])
        stored = f" stored as {variable['stored']}" if variable["stored"] else ""
        marks = " and ".join(f"{value:.9g}" for value in variable["missing"])
        missing = f", missing where {marks}" if marks else ""
        dtype = variable["dtype"] + stored
        lines += ["", f"{variable['name']}: {dtype}, {shape}{units}{missing}"]
        if len(variable["commands"]) > 1:
            lines.append("  two readings are likely:")
        lines += [f"  {text}" for text in variable["commands"]]
    if len(good) > 1 and all(len(variable["commands"]) == 1 for variable in good):
        words = ["fhash", "encode", path, "-o", f"{Path(path).stem}.fhz", "--var", "all"]
        lines += ["", "all in one file:", f"  {shlex.join(words)}"]
    rest = [variable for variable in variables if variable["problem"]]
    others: list[Mapping[str, Any]] = []
    small: list[Mapping[str, Any]] = []
    for variable in rest:
        known = len(variable["shape"]) < MIN_DIMENSIONS
        (small if known and not variable["problem"].startswith(UNOPENED) else others).append(
            variable
        )
    if others:
        lines += ["", "not to be encoded:"]
        lines += [f"  {variable['name']}: {variable['problem']}" for variable in others]
    if small:
        names = [f"{variable['name']} {tuple(variable['shape'])}" for variable in small]
        count = f"; {len(names)} in all" if len(names) > MAX_NAMES else ""
        lines += ["", f"below {MIN_DIMENSIONS} dimensions: {listed(names)}{count}"]
    return "\n".join(map(one_line, lines))


def _dimension(name: str, length: int, axis: str) -> str:
    """A dimension and what it is: "lev=17 (z)"."""
    note = {"?": " (?)", "select": " (select one)", name: ""}.get(axis, f" ({axis})")
    return f"{name}={length}{note}"


def details(series: Series) -> dict[str, Any]:
    """An open series as JSON values: shape, type, units, coordinates and attributes."""
    from fhash_codec.times import is_dated, time_text
    from fhash_formats.support.attributes import json_attributes

    coordinates = []
    for axis in "tzyx":
        coordinate = series.coords[axis]
        ends = [float(coordinate.values[0]), float(coordinate.values[-1])]
        dated = axis == "t" and is_dated(coordinate)
        coordinates.append(
            {
                "axis": axis,
                "name": coordinate.name,
                "first": ends[0],
                "last": ends[1],
                "units": str(coordinate.attributes.get("units", "")),
                "dates": [time_text(coordinate, end) for end in ends] if dated else [],
            }
        )
    return {
        "name": series.name,
        "shape": list(series.shape),
        "dtype": (series.source_dtype or series.dtype).name,
        "units": series.units,
        "fill": series.fill,
        "not_stored": None if series.not_stored is None else series.not_stored.to_dict(),
        "coordinates": coordinates,
        "attributes": json_attributes(series.attributes, without=frozenset()),
    }


def details_rows(series: Series) -> list[tuple[str, str]]:
    """An open series as rows of a table: shape, positions along each axis, and attributes."""
    from fhash_formats.support.attributes import json_attributes

    rows = [("t, z, y, x", extent(series.shape))]
    rows += [(f"  {axis}", positions(series.coords[axis], axis)) for axis in "tzyx"]
    if series.not_stored is not None:
        rows.append(("not stored", not_stored_text(series.not_stored.to_dict())))
    for name, value in json_attributes(series.attributes).items():
        text = " ".join(str(value).split())
        rows.append((name, text if len(text) <= MAX_TEXT else text[:MAX_TEXT] + "..."))
    return rows


def not_stored_text(told: Mapping[str, Any]) -> str:
    """Values that nobody wrote, as a header has them, in words."""
    from fhash_formats.series import spans_text

    fill = f", read as {told['fill']:.9g}" if "fill" in told else ""
    return f"{100 * told['share']:.3g} % of the values ({spans_text(told['steps'])}){fill}"


def positions(coordinate: Coordinate, axis: str) -> str:
    """Name, first and last position, and units of an axis; times as dates where they are."""
    from fhash_codec.times import is_dated, number_text, time_text

    units = coordinate.attributes.get("units", "")
    ends = [float(coordinate.values[0]), float(coordinate.values[-1])]
    if axis != "t":
        return f"{coordinate.name} {' to '.join(apart(*ends))} {units}".rstrip()
    numbers = " to ".join(number_text(coordinate, time) for time in ends)
    if not is_dated(coordinate):
        return f"{coordinate.name} {numbers} {units}".rstrip()
    dates = " to ".join(time_text(coordinate, time) for time in ends)
    return f"{coordinate.name} {dates} ({numbers} {units})"
