"""`fhash info`: prints what a container holds and how good it is, or what a data file holds."""

from __future__ import annotations

import dataclasses
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import BaseCommand, SourceOptions, json_option, series_options
from fhash_cli.output import (
    apart,
    compared,
    emit,
    extent,
    feature_rows,
    listed,
    loss_rows,
    model_name,
    number,
    one_line,
    quality_rows,
    size,
    split_row,
    table,
)
from fhash_cli.variables import info_table
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_codec import Dataset, Volume
    from fhash_codec.file_info import (
        CoordinateDetails,
        DataInfo,
        DatasetInfo,
        SeriesDetails,
        VolumeInfo,
    )
    from fhash_formats.readers.listing import Listed
    from fhash_formats.series import Coordinate, Series


def card_rows(info: Mapping[str, Any], *, verbose: bool) -> list[tuple[str, str]]:
    """Rows for people, from what `fhash info --json` prints.

    verbose: every setting, level and layer on a row of its own.
    """
    card = info["card"]
    return [
        *_config(info, card["config"], verbose=verbose),
        *_tables(info["model"], card["tables"], verbose=verbose),
        *_mlp(card["mlp"], verbose=verbose),
        ("occupancy", _occupancy(card["occupancy"])),
    ]


def _occupancy(part: Mapping[str, Any]) -> str:
    """The bits, and how many features have their own."""
    apart = f"; {len(part['apart'])} features apart" if part["apart"] else ""
    return f"bits {extent(part['shape'])}; {_stored_as(part)}{apart}"


def _stored_as(part: Mapping[str, Any]) -> str:
    """The place of a part in the file, its coding and its bytes."""
    if not part["path"]:
        return str(part["coding"])
    return f"{part['path']}, {part['coding']}, {size(part['bytes'])}"


def _config(
    info: Mapping[str, Any], part: Mapping[str, Any], *, verbose: bool
) -> list[tuple[str, str]]:
    """The settings: those that differ from their defaults, or all."""
    from fhash_codec.config import EncodeConfig

    config, usual = info["config"], EncodeConfig().to_dict()
    changed = [
        f"{name} {_shown(value)}"
        for name, value in config.items()
        if name == "preset" or name not in usual or value != usual[name]
    ]
    text = ", ".join(changed)
    rows = [("config", f"{part['settings']} settings; {text}; {_stored_as(part)}")]
    if verbose:
        rows += [(f"  {name}", _shown(value)) for name, value in config.items()]
    return rows


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if value is None:
        return "-"
    return ", ".join(map(str, value)) if isinstance(value, list) else f"{value}"


def _tables(
    model: Mapping[str, Any], levels: list[dict[str, Any]], *, verbose: bool
) -> list[tuple[str, str]]:
    """The levels: number, resolutions and bytes, or each on its own."""
    total = sum(level["bytes"] for level in levels)
    stored = [level for level in levels if level["path"]]
    folded = listed([extent(level["shape"][:4]) for level in levels[:3]])
    more = ", ..." if len(levels) > 3 else ""
    first = f"{len(levels)} level{'s' if len(levels) > 1 else ''} of {folded}{more}"
    vertex = "needed vertex" if "sparse" in model else "vertex"
    numbers = f"{levels[0]['shape'][4]} at each {vertex}, {levels[0]['dtype']}"
    paths = stored[0]["path"] + (f" to {stored[-1]['path']}" if len(stored) > 1 else "")
    parameters = f"{model['parameters']:,} parameters in the model"
    if not model["parameters"]:
        parameters = "parameters were not counted"
    where = f"{paths}, {stored[0]['coding']}, {size(total)}"
    rows = [("tables", f"{first}; {numbers}; {where}; {parameters}")]
    if verbose:
        rows += _each("level", levels)
    return rows


def _mlp(layers: list[dict[str, Any]], *, verbose: bool) -> list[tuple[str, str]]:
    """The layers: widths and bytes, or each on its own."""
    if not layers:
        return [("MLP", "none: the values are those of level 1")]
    widths = " to ".join(str(width) for width in _widths(layers))
    # Layers may share an array.
    stored = list({layer["path"]: layer for layer in layers if layer["path"]}.values())
    place = _stored_as(layers[0])
    if len(stored) > 1:
        total = size(sum(layer["bytes"] for layer in stored))
        place = f"{stored[0]['path']} to {stored[-1]['path']}, {stored[0]['coding']}, {total}"
    rows = [("MLP", f"{widths}, {layers[0]['activation']}; {place}")]
    if verbose:
        rows += _each("layer", layers)
    return rows


def _each(what: str, parts: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """A row for each level or layer: shape and place."""
    return [
        (f"  {what} {part[what]}", f"{extent(part['shape'])}; {_stored_as(part)}") for part in parts
    ]


def _widths(layers: list[dict[str, Any]]) -> list[int]:
    """Inputs of the first layer, and outputs of every layer."""
    return [layers[0]["shape"][1], *(layer["shape"][0] for layer in layers)]


MAX_ROWS = 24
"""Variables of a table that is for one screen; of more the names follow."""

MAX_PROBLEMS = 6
"""Lines of what cannot be encoded, and why."""

MAX_TEXT = 300
"""Characters of an attribute that are shown."""


def listing(path: str, files: int, found: Sequence[Listed], *, named: bool = False) -> str:
    """The variables of a data file as one table, a command, and what cannot be encoded.

    named: whether the user named the only variable that is listed.
    """
    good = [entry for entry in found if entry.options]
    needs = [" or ".join(shlex.join(_needs(words)) for words in entry.options) for entry in good]
    more = f" ({files} files; shapes are of the first)" if files > 1 else ""
    count = f": {len(good) or 'no'} variable{'' if len(good) == 1 else 's'} to encode"
    lines = [f"{path}{more}{'' if named else count}"]
    if good:
        rows = [_row(entry, need) for entry, need in zip(good[:MAX_ROWS], needs, strict=False)]
        if len(set(needs)) == 1:
            rows = [row[:-1] for row in rows]
        titles = ["variable", "type", "dimensions", "units", "missing", "needs"][: len(rows[0])]
        used = [place for place in range(len(titles)) if place < 3 or any(r[place] for r in rows)]
        rows = [[row[place] for place in used] for row in [titles, *rows]]
        lines += ["", *table(rows, left=True).splitlines()]
        if len(good) > MAX_ROWS:
            rest = [entry.name for entry in good[MAX_ROWS:]]
            lines.append(f"and {len(rest)} more: {listed(rest)}; --json lists all")
        lines += ["", *_commands(path, good)]
    if refused := _refused([entry for entry in found if not entry.options]):
        lines += ["", *refused]
    return "\n".join(map(one_line, lines))


def _needs(words: Sequence[str]) -> list[str]:
    """The options of a reading beside the name of the variable."""
    return list(words[2:] if words[:1] == ("--var",) else words)


def _row(entry: Listed, needs: str) -> list[str]:
    stored = f" stored as {entry.stored}" if entry.stored else ""
    pairs = zip(entry.dimensions, entry.shape, strict=False)
    shape = ", ".join(_dimension(name, length, axis) for (name, axis), length in pairs)
    marks = ", ".join(dict.fromkeys(f"{value:.6g}" for value in entry.missing))
    units = "" if entry.units == "1" else entry.units
    return [entry.name, entry.dtype + stored, shape, units, marks, needs]


def _commands(path: str, good: Sequence[Listed]) -> list[str]:
    """The command for all that is read in one way with the same options, else for the first."""
    alike = [entry for entry in good if len(entry.options) == 1]
    usual = Counter(tuple(_needs(entry.options[0])) for entry in alike)
    words, count = min(usual.items(), key=lambda each: (len(each[0]), -each[1]), default=((), 0))
    if count < 2:
        return (alike or good)[0].commands(path)
    output = f"{Path(path).stem.strip('*?.') or 'run'}.fhz"
    return [shlex.join(["fhash", "encode", path, "-o", output, "--var", "all", *words])]


def _refused(others: Sequence[Listed]) -> list[str]:
    """Lines that say what cannot be encoded, together where the reason is the same."""
    reasons: dict[str, list[str]] = {}
    for entry in others:
        small = entry.problem.startswith(f"{len(entry.shape)} dimension")
        reason = "too few dimensions" if small and len(entry.shape) < 2 else entry.problem
        reasons.setdefault(reason, []).append(
            f"{entry.name} {entry.shape}" if small else entry.name
        )
    lines = [f"not to be encoded: {listed(names)}: {why}" for why, names in reasons.items()]
    left = len(lines) - MAX_PROBLEMS
    return lines[:MAX_PROBLEMS] + ([f"and {left} more reasons; --json has all"] if left > 0 else [])


def _dimension(name: str, length: int, axis: str) -> str:
    """A dimension and what it is: "lev=17 (z)"."""
    note = {"?": " (?)", "select": " (select one)", name: ""}.get(axis, f" ({axis})")
    return f"{name}={length}{note}"


def details(series: Series) -> SeriesDetails:
    """An open series as JSON values."""
    from fhash_codec.times import is_dated, time_text
    from fhash_formats.support.values import json_attributes

    coordinates: list[CoordinateDetails] = []
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
    from fhash_formats.support.values import json_attributes

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


@click.command(
    "info",
    cls=BaseCommand,
    epilog="fhash info demo/vortex.h5\nfhash info run.fhz --json",
)
@click.argument("path", metavar="RUN.fhz|DATA", type=click.Path())
@series_options
@click.option("-v", "--verbose", is_flag=True, help="Every setting, level and layer of RUN.fhz.")
@json_option
def command(path: str, source: SourceOptions, verbose: bool, as_json: bool) -> None:
    """Say what RUN.fhz or DATA holds.

    Of RUN.fhz: variable, domain, features, quality, and the card of its model: settings, tables,
    network and occupancy, each with its place in the file, coding and bytes.

    Of DATA, any source that `fhash encode` reads: the variables with type, dimensions and units,
    and the command that encodes them; the exit code is 2 where nothing can be encoded. The options
    but -v are those of `fhash encode`; --var and --t choose what is told in detail. Of several
    variables in RUN.fhz, --var chooses one.
    """
    if not _is_run(path):
        from fhash_codec.progress import silent
        from fhash_formats.readers.joined import files_of, is_pattern

        found = source.list(path)
        files = len(files_of(path)) if is_pattern(path) else 1
        variables = [variable.as_dict(path) for variable in found]
        result: DataInfo = {"path": path, "files": files, "variables": variables}
        text = listing(path, files, found, named=source.var is not None)
        readings = [(entry.name, words) for entry in found for words in entry.options]
        if len(readings) == 1 and (source.var is not None or source.t is not None):
            ((name, words),) = readings
            one = dataclasses.replace(source, var=name) if "--var" in words else source
            with one.open(path, silent) as series:
                result["series"] = details(series)
                text += f"\n\n{table(details_rows(series))}"
        missed = None if readings else InputError(f"{path} holds nothing that can be encoded")
        emit(result, text, as_json, missed)
        return
    import fhash_codec

    source.refuse(path)
    with fhash_codec.open(path, variable=source.var) as opened:
        if isinstance(opened, fhash_codec.Dataset):
            _emit_dataset(opened, as_json)
            return
        info: VolumeInfo = {**opened.info, "card": opened.describe()}
        rows = [*_rows(opened, info), *card_rows(info, verbose=verbose)]
        emit(info, table(rows), as_json)


def _emit_dataset(dataset: Dataset, as_json: bool) -> None:
    """Print what a file of several variables holds: a line for each."""
    infos = {name: volume.info for name, volume in dataset.items()}
    version, container = dataset.container.header["format_version"], dataset.container
    raw = sum(info["raw_bytes"] for info in infos.values())
    result: DatasetInfo = {
        "path": str(dataset.path),
        "format_version": version,
        "bytes": container.size,
        "split": container.split(),
        "raw_bytes": raw,
        "ratio": raw / container.size,
        "variables": infos,
    }
    rows = [
        ("file", f"{dataset.path}, format {'.'.join(map(str, version))}"),
        ("size", compared(result)),
        split_row(result),
    ]
    more = one_line(f"fhash info {dataset.path} --var {next(iter(dataset))} tells all of one")
    emit(result, f"{table(rows)}\n\n{table(info_table(infos))}\n\n{more}", as_json)


def _is_run(path: str) -> bool:
    """Whether a path is, or is meant to be, a container."""
    from fhash_formats.support.files import is_url

    if is_url(path):
        from fhash_formats.readers.labelled import is_data_url

        return not is_data_url(path)
    place = Path(path)
    if place.suffix.lower() == ".fhz":
        return True
    if not place.is_file():
        return False
    with suppress(OSError), place.open("rb") as file:
        if file.read(2) == b"PK":
            # the import takes as long as most listings
            from fhash_formats.container import is_container

            return is_container(place)
    return False


def _rows(volume: Volume, info: VolumeInfo) -> list[tuple[str, str]]:
    dtype = info["variable"]["dtype"]
    return [
        (
            "file",
            f"{info['path']}, format {'.'.join(map(str, info['format_version']))},"
            f" by fhash {info['encoder']['version']}",
        ),
        ("size", compared(info)),
        split_row(info),
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
        *feature_rows(info, info["features"], info["dilation"]),
        (
            "key frames",
            f"{len(info['key_frames'])}: {listed([str(step) for step in info['key_frames']])}",
        ),
        ("model", model_name(published=volume.profile == "paper")),
        *(_compact(volume, info) if volume.profile == "compact" else loss_rows(info["model"])),
        ("between steps", between_text(info["model"]["between"])),
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


def _training(info: VolumeInfo) -> str:
    """The training of the model: steps, time, device; files before version 1.3 tell less."""
    training, model = info["training"], info["model"]
    told = "steps" in training
    if model["profile"] == "compact" and (not told or training["steps"] == 0):
        return "not told" if info.get("mlp") and not told else "none"
    steps = f"{training['steps']:,} steps, " if told else ""
    seconds = training["seconds"]
    took = "" if seconds is None else f" in {number(seconds, 's', digits=3)} of wall time,"
    rate = training.get("learning_rate")
    lowered = (
        ""
        if rate is None
        else f"; it diverged, and came to its end at a learning rate of {rate:.3g}"
    )
    unused = model["profile"] == "compact" and info.get("mlp") is None
    saved = "; it saved too little, and was left out" if unused else ""
    if "saved" in training:
        saved = f"; it saves about {training['saved']:.0%} of the bytes of the values"
    return (
        f"{steps}{training['epochs']} epochs{took} on {training['device']},"
        f" seed {info['config']['seed']}{lowered}{saved}"
    )


def _predicted(info: VolumeInfo) -> list[tuple[str, str]]:
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


def between_text(told: Mapping[str, Any]) -> str:
    """The rule of values between steps, and what it gained where it was chosen."""
    rule, gain = told["rule"], told["gain_db"]
    if gain is None:
        return str(rule)
    other = "linear" if rule == "cubic" else "cubic"
    return f"{rule} (measured: {abs(gain):.1f} dB better than {other} over left-out steps)"


def tiling_text(info: VolumeInfo) -> str:
    """The price of the tiles and their coder, as far as the header says them."""
    told = info["model"].get("tiling", {})
    text = ""
    if told.get("price") is not None:
        more = told["price"] - 1
        text = ", the fewest bytes of all priced"
        if more > 0:
            text = f", by price {more:.0%} above the fewest bytes"
    if told.get("coder"):
        text += f"; by the {told['coder']} coder"
    return text


def _compact(volume: Volume, info: VolumeInfo) -> list[tuple[str, str]]:
    encoder = info["encoder"] if "steps" in info["training"] else info["training"]
    seconds = encoder.get("seconds")
    took = "" if seconds is None else f", encoded in {number(seconds, 's', digits=3)}"
    return [("tiles", f"{extent(volume.chunks)} vertices{tiling_text(info)}{took}")]
