"""Several variables of one file: those that `--var` names, their settings and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fhash_cli.options import SourceOptions
from fhash_cli.output import extent, factor, number, say, size
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig

ALL = "all"
"""Value of `--var` that stands for every variable that can be encoded as it is."""


def names_to_encode(source: SourceOptions, path: str, *, quiet: bool) -> list[str] | None:
    """The names of several variables that `--var` asks for; None where it is one, or not given.

    One line on stderr says which variables `--var all` leaves out. Raises InputError where there
    is nothing to take, and for a name that is given twice.
    """
    if source.var is None or not (source.var == ALL or "," in source.var):
        return None
    import dataclasses

    from fhash_codec.dataset_encoding import encodable

    listed = dataclasses.replace(source, var=None).list(path)
    if source.var in [entry.name for entry in listed]:
        return None
    if source.var != ALL:
        names = [name.strip() for name in source.var.split(",")]
        twice = next((name for name in names if names.count(name) > 1 or not name), None)
        if twice is not None:
            raise InputError(f"--var {source.var} has '{twice}' where another name is needed")
        return names
    names, others = encodable(listed, len(source.select))
    if not names:
        raise InputError(f"{path} has no variable that can be encoded; see: fhash info {path}")
    if others and not quiet:
        say(f"--var all leaves out {', '.join(others)}; fhash info {path} says why")
    return names


def config_of(settings: Mapping[str, Any]) -> EncodeConfig:
    """The settings of a single variable. Raises InputError for promises by name."""
    from fhash_codec.config import EncodeConfig

    for name, value in settings.items():
        if isinstance(value, Mapping):
            raise InputError(
                f"--{name.replace('_', '-')} has a number for {next(iter(value))}, which is for"
                " several variables (--var u,v); give the number alone"
            )
    return EncodeConfig.from_dict(dict(settings))


def configs_of(settings: Mapping[str, Any], names: Sequence[str]) -> dict[str, EncodeConfig]:
    """The settings of each of several variables.

    A promise that is given for a variable by name stands in place of those for all. Raises
    InputError for a name that is no variable.
    """
    from fhash_codec.config import PROMISES, EncodeConfig

    for promise in PROMISES:
        value = settings[promise]
        unknown = [name for name in value if name not in names] if isinstance(value, dict) else []
        if unknown:
            raise InputError(
                f"--{promise.replace('_', '-')} names {unknown[0]}, which is none of the variables"
                f" {', '.join(names)}"
            )
    configs = {}
    for name in names:
        promised = {promise: settings[promise] for promise in PROMISES}
        own = {p: v[name] for p, v in promised.items() if isinstance(v, dict) and name in v}
        general = {p: None if isinstance(v, dict) else v for p, v in promised.items()}
        chosen = {**dict.fromkeys(PROMISES), **own} if own else general
        configs[name] = EncodeConfig.from_dict({**settings, **chosen})
    return configs


def report_table(figures: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Rows of a table of variables, from the figures of each: size, quality, largest error."""
    rows = [["variable", "size", "smaller", "PSNR", "largest error"]]
    for name, each in figures.items():
        psnr = "exact" if each.get("rmse") == 0 else number(each.get("psnr"), "dB")
        largest = number(each.get("max_abs_error"))
        rows.append([name, size(each["bytes"]), factor(each["ratio"]), psnr, largest])
    return rows


def info_table(infos: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Rows of a table of the variables of a file, from what `Volume.info` says of each."""
    rows = [["variable", "units", "t, z, y, x", "type", "size", "smaller", "PSNR", "largest error"]]
    for name, info in infos.items():
        described = {**info["quality"], "bytes": info["bytes"], "ratio": info["ratio"]}
        _, *measured = report_table({name: described})[1]
        shape = extent(info["domain"]["shape"])
        variable = info["variable"]
        rows.append([name, variable["units"] or "-", shape, variable["dtype"], *measured])
    return rows
