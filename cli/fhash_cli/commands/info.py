"""`fhash info`: prints what a container holds and how good it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import json_option, run_argument
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

if TYPE_CHECKING:
    from fhash_codec import Volume


@click.command("info", cls=BaseCommand)
@run_argument
@json_option
def command(run: str, as_json: bool) -> None:
    """Say what RUN.fhz holds: variable, domain, features, network and quality."""
    import fhash_codec

    with fhash_codec.open(run) as volume:
        info = volume.info
        emit(info, table(_rows(volume, info)), as_json)


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
            + (f", in {volume.units}" if volume.units not in ("", "1") else ""),
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
    """Name, first and last position, and units of an axis."""
    coordinate = volume.coords[axis]
    units = coordinate.attributes.get("units", "")
    ends = " to ".join(apart(coordinate.values[0], coordinate.values[-1]))
    return f"{coordinate.name} {ends} {units}".rstrip()
