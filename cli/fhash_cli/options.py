"""Options that several commands share, and their types: slices, regions, encoding settings."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from fhash_cli.intervals import SliceType
from fhash_formats.errors import InputError, OutputError

Command = Callable[..., None]

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
force_option = click.option("--force", is_flag=True, help="Replace an output that exists.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
run_argument = click.argument("run", metavar="RUN.fhz", type=click.Path())


def check_writable(
    path: str | Path, force: bool, *, region: bool = False, sources: Sequence[str | Path] = ()
) -> None:
    """Refuse an output before any work: it exists, cannot be replaced, or is one of the `sources`.

    region: the output is written by `save_region`, whose checks differ.
    Raises InputError in every case (exit code 2): only the command line is wrong so far.
    """
    from fhash_formats import save_check
    from fhash_formats.support.atomic import check_output

    try:
        (save_check if region else check_output)(Path(path), force, sources=sources)
    except OutputError as error:
        raise InputError(str(error)) from error


class RealRange(click.FloatRange):
    """A number within limits, and no NaN, which click's own range lets through."""

    name = "number"

    def _describe_range(self) -> str:
        """The limits in the help, in few digits and without those that nobody meets."""
        low = "" if self.min is None else f"{self.min:g}<="
        high = "" if self.max is None or self.max > 1e12 else f"<={self.max:g}"
        return f"{low}x{high}"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number; fails for NaN and for a number outside the limits."""
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"'{value}' is not a number", param, ctx)
        return number


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Options that `series_options` adds: they say how to read the data."""

    var: str | None
    axes: str | None
    t: slice | None
    shape: str | None
    dtype: str | None
    endian: str | None

    @property
    def part(self) -> bool:
        """Whether the options choose a part of what the source holds."""
        return self.var is not None or self.t is not None

    def open(self, path: str, progress: Callable[[str, int, int, str], None]) -> Any:
        """The Series at a path; the caller closes it.

        progress: is told that the source is being opened: many files take their time.
        """
        from fhash_formats import RawLayout, open_series, parse_shape

        progress("opening", 0, 1, path)
        raw = RawLayout(
            shape=None if self.shape is None else parse_shape(self.shape),
            dtype=self.dtype,
            endian=self.endian,
        )
        return open_series(path, var=self.var, axes=self.axes, steps=self.t, raw=raw)


def series_options(command: Command) -> Command:
    """Add the options of SourceOptions; the command gets them as `source`."""

    @click.option("--var", metavar="NAME", help="Which variable or dataset of the file.")
    @click.option(
        "--axes",
        metavar="t,z,y,x",
        help="What the file's dimensions are, in its own order; letters left out have length 1.",
    )
    @click.option(
        "--t", "t", type=SliceType(), help="Only these steps, half-open as in Python: 40:50, ::2."
    )
    @click.option(
        "--shape",
        metavar="x=64,y=64,z=32,t=10",
        help="Lengths of a raw file, the fastest axis first.",
    )
    @click.option(
        "--dtype", metavar="NAME", help="Number type of a raw file, such as float32 or uint8."
    )
    @click.option(
        "--endian", type=click.Choice(["little", "big"]), help="Byte order of a raw file."
    )
    @functools.wraps(command)
    def collected(**values: Any) -> None:
        names = [field.name for field in dataclasses.fields(SourceOptions)]
        command(source=SourceOptions(**{name: values.pop(name) for name in names}), **values)

    return collected


def config_options(*names: str, profile: str | None = None) -> Callable[[Command], Command]:
    """Add an option for each field of EncodeConfig, or for each of `names`.

    Help, choices and range of an option are those of the field. The command gets an EncodeConfig as
    `config`.

    profile: the profile of a command that has no option for it.
    """
    from fhash_codec.config import EncodeConfig

    fixed = {} if profile is None else {"profile": profile}

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collected(settings: dict[str, Any], **values: Any) -> None:
            command(config=EncodeConfig.from_dict(settings | fixed), **values)

        return setting_options(*names)(collected)

    return decorate


def setting_options(*names: str) -> Callable[[Command], Command]:
    """Add options as `config_options` does; the command gets a dict of them as `settings`.

    It serves commands whose settings are for several profiles.
    """
    from fhash_codec.config import EncodeConfig

    fields = [
        field for field in dataclasses.fields(EncodeConfig) if not names or field.name in names
    ]
    hints = typing.get_type_hints(EncodeConfig)

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collected(**values: Any) -> None:
            settings = {field.name: values.pop(field.name) for field in fields}
            command(settings=settings, **values)

        decorated: Command = collected
        for field in reversed(fields):
            decorated = _setting(field, hints[field.name])(decorated)
        return decorated

    return decorate


def _setting(field: dataclasses.Field[Any], hint: Any) -> Callable[[Command], Command]:
    """The click option of one field of EncodeConfig."""
    limits = field.metadata
    flag = "--" + (limits["option"] or field.name).replace("_", "-")
    text = limits["help"][0].upper() + limits["help"][1:] + "."
    if hint is bool:
        return click.option(
            f"{flag}/--no-{flag[2:]}",
            field.name,
            default=field.default,
            show_default=True,
            help=text,
        )
    multiple = typing.get_origin(hint) is tuple
    kind: Any = next(
        inner for inner in (typing.get_args(hint) or (hint,)) if inner is not type(None)
    )
    metavar = None
    if limits["choices"]:
        kind = click.Choice(limits["choices"])
    elif limits["low"] is not None:
        metavar = "N" if kind is int else "X"
        kind = (
            click.IntRange(int(limits["low"]), int(limits["high"]))
            if kind is int
            else RealRange(limits["low"], limits["high"])
        )
    return click.option(
        flag,
        field.name,
        type=kind,
        default=field.default,
        show_default=field.default is not None,
        multiple=multiple,
        metavar=metavar,
        help=text,
    )
