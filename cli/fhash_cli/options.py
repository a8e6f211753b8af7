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

from fhash_cli.intervals import NumberType, SliceType
from fhash_formats.errors import InputError, OutputError

Command = Callable[..., None]

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
force_option = click.option("--force", is_flag=True, help="Replace an output that exists.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
feature_option = click.option(
    "--feature",
    "features",
    multiple=True,
    metavar="F",
    help="Only this feature of the file, as `fhash info` names it; repeat for several.",
)
variable_option = click.option(
    "--var", "variable", metavar="NAME", help="Which variable of a file of several."
)
variables_option = click.option(
    "--var",
    "variable",
    metavar="NAME,...",
    help="Which variables of a file of several. Default: all.",
)
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


def make_folder(folder: str | Path) -> Path:
    """Make the folder of a command's outputs if it is not there; the one above it must be.

    Raises InputError where it cannot be made.
    """
    try:
        Path(folder).mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: {error.strerror}; give a folder that exists or whose parent does"
        ) from error
    return Path(folder)


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


class NumberByVariable(RealRange):
    """A number within limits, or one for each of some variables: `u=0.1,v=0.2`."""

    def convert(  # type: ignore[override]
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | dict[str, float]:
        """The number, or numbers by name; fails for a name that is given twice."""
        if not isinstance(value, str) or "=" not in value:
            return super().convert(value, param, ctx)
        numbers: dict[str, float] = {}
        for part in value.split(","):
            name, _, number = (word.strip() for word in part.rpartition("="))
            if not name or name in numbers:
                self.fail(f"'{value}' is not NAME={self.name}, for each name once", param, ctx)
            numbers[name] = super().convert(number, param, ctx)
        return numbers


class SelectType(click.ParamType[tuple[str, str]]):
    """One index along a dimension: `member=2`, `dim3=0`, `lev=850.0`, `member=r1i1p1`."""

    name = "NAME=INDEX"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        """Name and index as texts; the file says what they mean."""
        if isinstance(value, tuple):
            return value
        name, equals, index = (word.strip() for word in str(value).rpartition("="))
        if not (name and equals and index):
            self.fail(f"'{value}' is not NAME=INDEX, such as member=2 or dim3=0", param, ctx)
        return name, index


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Options that `series_options` adds: they say how to read the data."""

    var: str | None
    axes: str | None
    t: slice | None
    shape: str | None
    dtype: str | None
    endian: str | None
    select: tuple[tuple[str, str], ...] = ()
    missing: tuple[float, ...] = ()
    raw_values: bool = False
    keep_extremes: bool = False
    no_external: bool = False

    @property
    def part(self) -> bool:
        """Whether the options choose a part of what the source holds."""
        return self.var is not None or self.t is not None or bool(self.select)

    def open(self, path: str, progress: Callable[[str, int, int, str], None]) -> Any:
        """The Series at a path; the caller closes it.

        progress: is told that the source is being opened: many files take their time.
        """
        from fhash_formats import open_series

        progress("opening", 0, 1, path)
        return open_series(path, steps=self.t, keep_extremes=self.keep_extremes, **self._wishes())

    def list(self, path: str) -> Any:
        """The variables at a path, as `fhash_formats.list_variables` gives them."""
        from fhash_formats import list_variables

        return list_variables(path, steps=self.t, **self._wishes())

    def refuse(self, path: str) -> None:
        """Raise InputError if any option but --var is given, for a path that is no data."""
        given = [
            field.name
            for field in dataclasses.fields(self)
            if field.name != "var" and getattr(self, field.name)
        ]
        if given:
            raise InputError(
                f"{path} is encoded already; --{given[0].replace('_', '-')} is for data that are"
                " read"
            )

    def refuse_without_data(self) -> None:
        """Raise InputError if any option is given, where there is no DATA to read."""
        given = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        if given:
            raise InputError(f"--{given[0].replace('_', '-')} is for DATA that are read; name them")

    def _wishes(self) -> dict[str, Any]:
        from fhash_formats import RawLayout, parse_shape

        names = [name for name, _ in self.select]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"--select {twice} is given twice; one index is selected along it")
        raw = RawLayout(
            shape=None if self.shape is None else parse_shape(self.shape),
            dtype=self.dtype,
            endian=self.endian,
        )
        return {
            "var": self.var,
            "axes": self.axes,
            "raw": raw,
            "missing": self.missing,
            "raw_values": self.raw_values,
            "select": dict(self.select),
            "no_external": self.no_external,
        }


def series_options(command: Command) -> Command:
    """Add the options of SourceOptions; the command gets them as `source`."""

    @click.option(
        "--var",
        metavar="NAME",
        help="Which variable or dataset of the file; 'state.rho' is a field of a compound type.",
    )
    @click.option(
        "--select",
        type=SelectType(),
        multiple=True,
        help="Index along a dimension that is not t, z, y or x, such as member=2; dim3=0 where it"
        " has no name. Repeat for several dimensions.",
    )
    @click.option(
        "--missing",
        type=NumberType(),
        multiple=True,
        help="A value that stands for a missing one, such as -9999 or 1e20; repeat for several.",
    )
    @click.option(
        "--raw-values",
        is_flag=True,
        help="Read packed numbers as stored: no fill value, scale or offset, and no unit.",
    )
    @click.option(
        "--keep-extremes",
        is_flag=True,
        help="An extreme value that repeats, far away from all others, is data.",
    )
    @click.option(
        "--no-external",
        is_flag=True,
        help="Read no file outside the folder of DATA, whatever a header or a link in it names.",
    )
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


def setting_options(*names: str, by_variable: bool = False) -> Callable[[Command], Command]:
    """Add options as `config_options` does; the command gets a dict of them as `settings`.

    It serves commands whose settings are for several profiles.

    by_variable: whether a promise may be given for each variable, as a dict of numbers by name.
    """
    from fhash_codec.config import PROMISES, EncodeConfig

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
            each = by_variable and field.name in PROMISES
            decorated = _setting(field, hints[field.name], by_variable=each)(decorated)
        return decorated

    return decorate


def _setting(
    field: dataclasses.Field[Any], hint: Any, *, by_variable: bool = False
) -> Callable[[Command], Command]:
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
            else (NumberByVariable if by_variable else RealRange)(limits["low"], limits["high"])
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
