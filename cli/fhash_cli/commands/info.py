"""`fhash info`: prints what a container holds and how good it is, or what a data file holds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import SourceOptions, json_option, series_options
from fhash_cli.output import (
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
from fhash_cli.source_listing import details, details_rows, listing, positions

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
    each. The options are those of `fhash encode`; --var and --t choose what is told in detail.
    """
    if not _is_run(path):
        from fhash_codec.progress import silent
        from fhash_formats.readers.joined import files_of, is_pattern

        found = source.list(path)
        variables = [variable.as_dict(path) for variable in found]
        files = len(files_of(path)) if is_pattern(path) else 1
        result = {"path": path, "files": files, "variables": variables}
        text = listing(path, files, variables, named=source.var is not None)
        readings = [(entry.name, words) for entry in found for words in entry.options]
        if len(readings) == 1 and (source.var is not None or source.t is not None):
            ((name, words),) = readings
            one = dataclasses.replace(source, var=name) if "--var" in words else source
            with one.open(path, silent) as series:
                result["series"] = details(series)
                text += f"\n\n{table(details_rows(series))}"
        emit(result, text, as_json)
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
        *((f"  {axis}", positions(volume.coords[axis], axis)) for axis in "tzyx"),
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
