"""`fhash info`: prints what a container holds and how good it is, or what a data file holds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.card_rows import card_rows
from fhash_cli.options import SourceOptions, json_option, series_options
from fhash_cli.output import (
    compared,
    emit,
    extent,
    listed,
    loss_rows,
    number,
    one_line,
    quality_rows,
    size,
    spans,
    table,
)
from fhash_cli.source_listing import (
    details,
    details_rows,
    listing,
    not_stored_text,
    positions,
)
from fhash_cli.variables import info_table

if TYPE_CHECKING:
    from fhash_codec import Dataset, Volume


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
    and the command that encodes each. The options but -v are those of `fhash encode`; --var and
    --t choose what is told in detail. Of several variables in RUN.fhz, --var chooses one.
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
    with fhash_codec.open(path, variable=source.var) as opened:
        if isinstance(opened, fhash_codec.Dataset):
            _emit_dataset(opened, as_json)
            return
        info = {**opened.info, "config": opened.config, "card": opened.describe()}
        rows = [*_rows(opened, info), *card_rows(info, verbose=verbose)]
        emit(info, table(rows), as_json)


def _emit_dataset(dataset: Dataset, as_json: bool) -> None:
    """Print what a file of several variables holds: a line for each."""
    infos = {name: volume.info for name, volume in dataset.items()}
    version, container = dataset.container.header["format_version"], dataset.container
    raw = sum(info["raw_bytes"] for info in infos.values())
    result = {
        "path": str(dataset.path),
        "format_version": version,
        "bytes": container.size,
        "raw_bytes": raw,
        "ratio": raw / container.size,
        "variables": infos,
    }
    rows = [
        ("file", f"{dataset.path}, format {'.'.join(map(str, version))}"),
        ("size", compared(result)),
    ]
    more = one_line(f"fhash info {dataset.path} --var {next(iter(dataset))} tells all of one")
    emit(result, f"{table(rows)}\n\n{table(info_table(infos))}\n\n{more}", as_json)


def _is_run(path: str) -> bool:
    """Whether a path is, or is meant to be, a container."""
    from fhash_formats.container import is_container
    from fhash_formats.support.locations import is_url

    if is_url(path):
        return True
    place = Path(path)
    return place.suffix.lower() == ".fhz" or (place.is_file() and is_container(place))


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
        *(
            [("not stored", not_stored_text(info["variable"]["not_stored"]))]
            if "not_stored" in info["variable"]
            else []
        ),
        *_source(volume),
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
        *(_compact(volume, info) if volume.profile == "compact" else loss_rows(info["model"])),
        ("training", _training(info)),
        *_predicted(info),
        *quality_rows(info["quality"], volume.units),
    ]


def _source(volume: Volume) -> list[tuple[str, str]]:
    """The row of the source: its name and digest, dimensions, and the arrays kept beside."""
    metadata = volume.metadata
    if metadata is None:
        return []
    digest = "" if metadata.digest is None else f", SHA-256 {metadata.digest[:16]}..."
    names = [each.name for each in metadata.variables if each.name not in metadata.dimensions]
    beside = f"; beside it {listed(names)}" if names else ""
    dimensions = ", ".join(metadata.dimensions)
    return [("source", f"{metadata.file or 'in memory'}{digest}; ({dimensions}){beside}")]


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


def _predicted(info: dict[str, Any]) -> list[tuple[str, str]]:
    """The row of what was predicted before the encoding, and what it took; none without either."""
    encoder = info["encoder"]
    told = encoder.get("predicted")
    if told is None:
        return []
    parts = [
        text
        for name, text in (
            ("seconds", number(told.get("seconds"), "s", digits=3)),
            ("bytes", size(told.get("bytes") or 0)),
            ("psnr", number(told.get("psnr"), "dB")),
        )
        if told.get(name) is not None
    ]
    took = encoder.get("took_seconds")
    was = "" if took is None else f"; it took {number(took, 's', digits=3)}"
    return [("predicted", f"{', '.join(parts)}{was}, {size(info['bytes'])}")]


def tiling_text(info: dict[str, Any]) -> str:
    """The price of the tiles and the time for a region, as far as the header says them."""
    told = info["model"].get("tiling", {})
    text = ""
    if told.get("price") is not None:
        best = told.get("best", info["model"]["levels"][0])
        against = "one tile" if best == info["model"]["levels"][0] else f"tiles of {extent(best)}"
        more = told["price"] - 1
        text = f", {more:.0%} above {against}" if more > 0 else ", the fewest bytes of all tried"
        if not told.get("tried"):
            text = f", at most about {more:.0%} above {against}" if more > 0 else ""
    if told.get("region_ms") is not None:
        text += f"; regions {number(told['region_ms'], 'ms', digits=2)}"
    return text


def _compact(volume: Volume, info: dict[str, Any]) -> list[tuple[str, str]]:
    encoder = info["encoder"] if "steps" in info["training"] else info["training"]
    seconds = encoder.get("seconds")
    took = "" if seconds is None else f", encoded in {number(seconds, 's', digits=3)}"
    return [("tiles", f"{extent(volume.chunks)} vertices{tiling_text(info)}{took}")]
