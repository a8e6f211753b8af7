"""Rows of `fhash info` for the card of a model: config, tables, MLP, occupancy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fhash_cli.output import extent, listed, size


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
    return f"bits {extent(part['shape'])}; {_place(part)}{apart}"


def _place(part: Mapping[str, Any]) -> str:
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
        if name == "profile" or name not in usual or value != usual[name]
    ]
    text = ", ".join(changed)
    rows = [("config", f"{part['settings']} settings; {text}; {_place(part)}")]
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
    place = _place(layers[0])
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
        (f"  {what} {part[what]}", f"{extent(part['shape'])}; {_place(part)}") for part in parts
    ]


def _widths(layers: list[dict[str, Any]]) -> list[int]:
    """Inputs of the first layer, and outputs of every layer."""
    return [layers[0]["shape"][1], *(layer["shape"][0] for layer in layers)]
