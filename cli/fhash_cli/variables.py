"""Several variables of one file: those that `--var` names, their settings and their tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fhash_cli.options import SourceOptions
from fhash_cli.output import extent, factor, number, say, size
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig
    from fhash_formats.readers.listing import Listed

ALL = "all"
"""Value of `--var` that stands for every variable that can be encoded as it is."""
MAX_COMPONENTS = 9
"""Components of a vector or a tensor that become variables at most."""


def variables_to_encode(
    source: SourceOptions, path: str, components: str | None, *, quiet: bool
) -> dict[str, SourceOptions] | None:
    """The options that open each of several variables, by its name; None where one is asked for.

    Several are asked for by `--var u,v`, `--var all`, and by `--components DIM`: each index along
    that dimension makes a variable of its own, such as velocity_0. One line on stderr says which
    variables `--var all` leaves out.

    Raises InputError where there is nothing to take, for a name that is given twice, and for a
    dimension that no variable has, or that is an axis.
    """
    several = source.var is not None and (source.var == ALL or "," in source.var)
    if not several and components is None:
        return None
    listed = dataclasses.replace(source, var=None).list(path)
    if several and components is None and source.var in [entry.name for entry in listed]:
        return None
    parts = {} if components is None else _components(listed, components, path)
    names = _names(source, path, listed, parts, components, quiet=quiet)
    found: dict[str, SourceOptions] = {}
    for name in names:
        own = dataclasses.replace(source, var=name)
        if name not in parts:
            found[name] = own
        for index in range(parts.get(name, 0)):
            select = (*source.select, (str(components), str(index)))
            found[f"{name}_{index}"] = dataclasses.replace(own, select=select)
    expected = sum(parts.get(name, 1) for name in names)
    if len(found) < expected:
        raise InputError(f"{path}: components have the name of another variable; choose others")
    return found


def _components(listed: Sequence[Listed], components: str, path: str) -> dict[str, int]:
    """The number of components of each variable that has the dimension."""
    lengths = {}
    for entry in listed:
        for (dimension, axis), length in zip(entry.dimensions, entry.shape, strict=False):
            if dimension == components and axis in ("select", "?"):
                lengths[entry.name] = length
    if not lengths:
        raise InputError(
            f"--components {components}: no variable has that dimension beside t, z, y and x;"
            f" see: fhash info {path}"
        )
    longest = max(lengths.values())
    if longest > MAX_COMPONENTS:
        raise InputError(
            f"--components {components}: {longest} along it; at most {MAX_COMPONENTS} become"
            " variables"
        )
    return lengths


def _names(
    source: SourceOptions,
    path: str,
    listed: Sequence[Listed],
    parts: Mapping[str, int],
    components: str | None,
    *,
    quiet: bool,
) -> list[str]:
    """The names that `--var` asks for, those of vectors whole."""
    from fhash_codec.encoding import encodable

    if source.var is None:
        if len(parts) > 1:
            raise InputError(
                f"--components {components} is a dimension of {', '.join(parts)};"
                " choose by --var, or take --var all"
            )
        return list(parts)
    if source.var != ALL:
        every = [entry.name for entry in listed]
        names = [source.var] if source.var in every else source.var.split(",")
        names = [name.strip() for name in names]
        twice = next((name for name in names if names.count(name) > 1 or not name), None)
        if twice is not None:
            raise InputError(f"--var {source.var} has '{twice}' where another name is needed")
        return names
    scalars = [entry for entry in listed if entry.name not in parts]
    names = encodable(scalars, len(source.select))
    if parts:
        select = (*source.select, (str(components), "0"))
        again = dataclasses.replace(source, var=None, select=select).list(path)
        vectors = [entry for entry in again if entry.name in parts]
        names += encodable(vectors, len(select))
    if not names:
        raise InputError(f"{path} has no variable that can be encoded; see: fhash info {path}")
    others = [entry.name for entry in listed if entry.name not in names]
    if others and not quiet:
        say(f"--var all makes no variables of {', '.join(others)}; fhash info {path} says why")
    return [entry.name for entry in listed if entry.name in names]


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
