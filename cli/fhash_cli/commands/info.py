"""`fhash info`: prints what a container holds and how good it is, or what a data file holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
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
@json_option
def command(path: str, source: SourceOptions, as_json: bool) -> None:
    """Say what RUN.fhz or DATA holds.

    Of RUN.fhz: variable, domain, features, network and quality. Of DATA, any source that `fhash
    encode` reads: the variables with shape, type, units and axes, and the command that encodes
    each. The options are those of `fhash encode`.
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
        info = volume.info
        emit(info, table(_rows(volume, info)), as_json)


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
    training = info["training"]
    dtype = info["variable"]["dtype"]
    seconds = (
        "" if training["seconds"] is None else f" in {number(training['seconds'], 's', digits=3)}"
    )
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
        *(_compact(volume, seconds) if volume.profile == "compact" else _network(info, seconds)),
        *quality_rows(info["quality"], volume.units),
    ]


def _missing(volume: Volume) -> str:
    """The number that stood for a missing value in the source, where it is known."""
    fill = volume.value_type.fill
    return "" if fill is None else f", missing where the source had {fill:.9g}"


def _network(info: dict[str, Any], seconds: str) -> list[tuple[str, str]]:
    model, training = info["model"], info["training"]
    rate = training.get("learning_rate")
    lowered = (
        ""
        if rate is None
        else f"; it diverged, and came to its end at a learning rate of {rate:.3g}"
    )
    return [
        *loss_rows(model),
        (
            "network",
            f"{model['profile']}, {len(model['levels'])} levels,"
            f" {model['parameters']:,} parameters in {model['tables']}",
        ),
        (
            "training",
            f"{training['epochs']} epochs{seconds} on {training['device']},"
            f" seed {info['encoder']['seed']}{lowered}",
        ),
    ]


def _compact(volume: Volume, seconds: str) -> list[tuple[str, str]]:
    model = volume.info["model"]
    head = (
        "no head"
        if model["head"] is None
        else f"head with {' and '.join(map(str, model['head']['hidden']))} neurons"
    )
    return [
        ("table", f"compact, {model['parameters']:,} coefficients other than 0, {head}"),
        ("tiles", f"{extent(volume.chunks)} vertices{', encoded' + seconds if seconds else ''}"),
    ]


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
