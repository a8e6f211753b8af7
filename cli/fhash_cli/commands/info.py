"""`fhash info`: prints what a container holds and how good it is, or what a data file holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.card_rows import card_rows
from fhash_cli.options import SourceOptions, json_option, series_options
from fhash_cli.output import (
    apart,
    compared,
    emit,
    extent,
    listed,
    loss_rows,
    number,
    quality_rows,
    spans,
    table,
)

MIN_DIMENSIONS = 3
"""Dimensions of an array that may be a variable; others are named in one line."""

if TYPE_CHECKING:
    from fhash_codec import Volume


@click.command("info", cls=BaseCommand)
@click.argument("path", metavar="RUN.fhz|DATA", type=click.Path())
@series_options
@click.option("-v", "--verbose", is_flag=True, help="Every setting, level and layer of RUN.fhz.")
@json_option
def command(path: str, source: SourceOptions, verbose: bool, as_json: bool) -> None:
    """Say what RUN.fhz or DATA holds.

    Of RUN.fhz: variable, domain, features, quality, and the card of its model: settings, tables,
    network and occupancy, each with its place in the file, coding and bytes.

    Of DATA, any source that `fhash encode` reads: the variables with shape, type, units and axes,
    and the command that encodes each. The options but -v are those of `fhash encode`.
    """
    if not _is_run(path):
        from fhash_formats.readers.joined import files_of, is_pattern

        found = source.list(path)
        variables = [variable.as_dict(path) for variable in found]
        files = len(files_of(path)) if is_pattern(path) else 1
        text = _listing(path, files, variables)
        emit({"path": path, "files": files, "variables": variables}, text, as_json)
        return
    import fhash_codec

    source.refuse(path)
    with fhash_codec.open(path) as volume:
        info = {**volume.info, "config": volume.config, "card": volume.describe()}
        rows = [*_rows(volume, info), *card_rows(info, verbose=verbose)]
        emit(info, table(rows), as_json)


def _is_run(path: str) -> bool:
    """Whether a path is, or is meant to be, a container."""
    from fhash_formats.container import is_container

    place = Path(path)
    return place.suffix.lower() == ".fhz" or (place.is_file() and is_container(place))


def _listing(path: str, files: int, variables: Sequence[Mapping[str, Any]]) -> str:
    """The variables of a data file, each with its commands; then what cannot be encoded."""
    good = [variable for variable in variables if not variable["problem"]]
    many = f" ({files} files; shapes are of the first)" if files > 1 else ""
    count = f"{len(good) or 'no'} variable{'' if len(good) == 1 else 's'}"
    lines = [f"{path}{many} holds {count} to encode"]
    for variable in good:
        units = f", in {variable['units']}" if variable["units"] not in ("", "1") else ""
        shape = ", ".join(_dimension(**dimension) for dimension in variable["dimensions"])
        stored = f" stored as {variable['stored']}" if variable["stored"] else ""
        marks = " and ".join(f"{value:.9g}" for value in variable["missing"])
        missing = f", missing where {marks}" if marks else ""
        dtype = variable["dtype"] + stored
        lines.append(f"\n{variable['name']}: {dtype}, {shape}{units}{missing}")
        if len(variable["commands"]) > 1:
            lines.append("  two readings are likely:")
        lines += [f"  {text}" for text in variable["commands"]]
    rest = [variable for variable in variables if variable["problem"]]
    others = [variable for variable in rest if len(variable["shape"]) >= MIN_DIMENSIONS]
    small = [variable for variable in rest if len(variable["shape"]) < MIN_DIMENSIONS]
    if others:
        lines.append("\nnot to be encoded:")
        lines += [f"  {variable['name']}: {variable['problem']}" for variable in others]
    if small:
        names = [f"{variable['name']} {tuple(variable['shape'])}" for variable in small]
        lines.append(f"\nbelow {MIN_DIMENSIONS} dimensions: {listed(names)}")
    return "\n".join(lines)


def _dimension(name: str, length: int, axis: str) -> str:
    """A dimension and what it is: "lev=17 (z)"."""
    note = {"?": " (?)", "select": " (select one)", name: ""}.get(axis, f" ({axis})")
    return f"{name}={length}{note}"


def _rows(volume: Volume, info: dict[str, Any]) -> list[tuple[str, str]]:
    dtype = info["variable"]["dtype"]
    return [
        (
            "file",
            f"{info['path']}, format {'.'.join(map(str, info['format_version']))},"
            f" by fhash {info['encoder']['version']}",
        ),
        ("size", compared(info)),
        (
            "variable",
            f"{volume.name}, {dtype}"
            + (f", in {volume.units}" if volume.units not in ("", "1") else "")
            + _missing(volume),
        ),
        ("t, z, y, x", extent(volume.shape)),
        *((f"  {axis}", _positions(volume, axis)) for axis in "tzyx"),
        ("features", f"{', '.join(info['features'])}; grown by {info['dilation']}"),
        (
            "coreset",
            f"{info['coreset_fraction']:.3%} of the domain,"
            f" in {spans(info['feature_bounding_box'])}",
        ),
        (
            "key frames",
            f"{len(info['key_frames'])}: {listed([str(step) for step in info['key_frames']])}",
        ),
        *(_compact(volume, info) if volume.profile == "compact" else loss_rows(info["model"])),
        ("training", _training(info)),
        *quality_rows(info["quality"], volume.units),
    ]


def _missing(volume: Volume) -> str:
    """The number that stood for a missing value in the source, where it is known."""
    fill = volume.value_type.fill
    return "" if fill is None else f", missing where the source had {fill:.9g}"


def _training(info: dict[str, Any]) -> str:
    """The training of the model: steps, time, device; files before version 1.3 tell less."""
    training, model = info["training"], info["model"]
    told = "steps" in training
    if model["profile"] == "compact" and (not told or training["steps"] == 0):
        return "not told" if model["head"] and not told else "none"
    steps = f"{training['steps']:,} steps, " if told else ""
    seconds = training["seconds"]
    took = "" if seconds is None else f" in {number(seconds, 's', digits=3)}"
    rate = training.get("learning_rate")
    lowered = (
        ""
        if rate is None
        else f"; it diverged, and came to its end at a learning rate of {rate:.3g}"
    )
    unused = model["profile"] == "compact" and model["head"] is None
    return (
        f"{steps}{training['epochs']} epochs{took} on {training['device']},"
        f" seed {info['encoder']['seed']}{lowered}{'; the head was left out' if unused else ''}"
    )


def _compact(volume: Volume, info: dict[str, Any]) -> list[tuple[str, str]]:
    encoder = info["encoder"] if "steps" in info["training"] else info["training"]
    seconds = encoder.get("seconds")
    took = "" if seconds is None else f", encoded in {number(seconds, 's', digits=3)}"
    return [("tiles", f"{extent(volume.chunks)} vertices{took}")]


def _positions(volume: Volume, axis: str) -> str:
    """Name, first and last position, and units of an axis; times as dates where they are."""
    from fhash_codec.times import is_dated, number_text, time_text

    coordinate = volume.coords[axis]
    units = coordinate.attributes.get("units", "")
    ends = [float(coordinate.values[0]), float(coordinate.values[-1])]
    if axis != "t":
        return f"{coordinate.name} {' to '.join(apart(*ends))} {units}".rstrip()
    numbers = " to ".join(number_text(coordinate, time) for time in ends)
    if not is_dated(coordinate):
        return f"{coordinate.name} {numbers} {units}".rstrip()
    dates = " to ".join(time_text(coordinate, time) for time in ends)
    return f"{coordinate.name} {dates} ({numbers} {units})"
