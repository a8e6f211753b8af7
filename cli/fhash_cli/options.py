"""The base of every command, and the options and their types that several commands share."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from fhash_formats.errors import InputError, OutputError
from fhash_formats.support.values import is_number

AXES = 3
"""Axes of a region: z, y and x."""


class TextType(click.ParamType):  # type: ignore[type-arg]  # no parameter before click 8.4
    """Values that users write as a text.

    name: what stands for the value in the help. parse: gives the value of a text; its ValueError
        says what is wrong.
    """

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name, self._parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text; what is no text, such as a default, stays as it is."""
        if not isinstance(value, str):
            return value
        try:
            return self._parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def _number(text: str) -> int | float:
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    raise ValueError(f"{text!r} is not a number")


NUMBER = TextType("V", _number)
"""A number; whole numbers stay exact beyond the precision of floats."""


def _slice(text: str) -> slice:
    try:
        return parse_slice(text)
    except ValueError as error:
        raise ValueError(
            f"'{text}' {error}; write an index or a half-open range A:B or A:B:S,"
            " such as 4, 40:50, 10: or ::2"
        ) from None


SLICE = TextType("A:B:S", _slice)
"""Indices as in Python, `A:B:S` with any part left out, or a single one; a step is positive.

`-1` is `slice(-1, None)`, the last.
"""


NUMBERS = {2: "A,B", 3: "X,Y,Z"}
"""Placeholders of options that take so many numbers."""


def numbers_type(count: int) -> TextType:
    """A fixed count of numbers with commas; the scene checks later whether they are allowed."""

    def parsed(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count:
            raise ValueError(
                f"'{text}' is not {count} numbers with commas between them,"
                f" such as {','.join('123'[:count])}"
            )
        return numbers

    return TextType(NUMBERS[count], parsed)


def _size(text: str) -> tuple[int, int]:
    across, _, down = text.lower().partition("x")
    try:
        return int(across), int(down or across)
    except ValueError:
        raise ValueError(f"'{text}' is not a size in pixels such as 800x600") from None


SIZE = TextType("WxH", _size)
"""Pixels across and down, or one number for both."""


def opacity_type(*, named: bool = True) -> TextType:
    """Points VALUE:OPACITY with commas between them, or (`named`) the name of a preset."""

    def parsed(text: str) -> Any:
        if named and ":" not in text:
            return text
        try:
            return [[float(end) for end in part.split(":")] for part in text.split(",")]
        except ValueError:
            what = "neither the name of an opacity nor" if named else "not"
            raise ValueError(f"'{text}' is {what} points such as 0:0,0.5:0.2,2:1") from None

    return TextType("NAME|V:O,..." if named else "G:F,...", parsed)


def _plane(text: str) -> dict[str, Any]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 4:
        return {"normal": numbers[:3], "offset": numbers[3]}
    if len(numbers) == 6:
        return {"point": numbers[:3], "normal": numbers[3:]}
    raise ValueError(
        f"'{text}' is neither a normal and an offset, NX,NY,NZ,D, nor a point and a normal,"
        " X,Y,Z,NX,NY,NZ, such as 0,0,1,0.5"
    )


PLANE = TextType("NX,NY,NZ,D", _plane)
"""Settings of a ClipPlane: its normal and an offset, or a point of it and its normal."""


class IntervalsType(TextType):
    """Intervals along z, y and x, of indices or (`number=float`) of positions.

    An end that is left out stands for the end of the domain. Axes that are left out at the end, or
    in place of `...`, are taken whole. A single index stands for its interval of length 1.
    """

    def __init__(self, number: type[int] | type[float]) -> None:
        super().__init__("z0:z1,y0:y1,x0:x1", self._region)
        self.number = number

    def _region(self, text: str) -> tuple[Any, ...]:
        """((z0, z1), (y0, y1), (x0, x1)), None for an end left out."""
        try:
            return self._intervals(text)
        except ValueError as error:
            example = "0:16,:,8:24" if self.number is int else "0:0.5,:,1.5:2"
            raise ValueError(
                f"'{text}': {error}; write z0:z1,y0:y1,x0:x1 as in {example}"
            ) from None

    def _intervals(self, text: str) -> tuple[Any, ...]:
        """The intervals along all axes; raises ValueError with the reason."""
        parts = [part.strip() for part in text.split(",")]
        if parts.count("...") > 1:
            raise ValueError("'...' stands there twice")
        given = len(parts) - parts.count("...")
        if given > AXES:
            raise ValueError(f"{given} intervals, and a region has {AXES} axes (z, y, x)")
        place = parts.index("...") if "..." in parts else len(parts)
        whole = [":"] * (AXES - given)
        return tuple(map(self._interval, [*parts[:place], *whole, *parts[place + 1 :]]))

    def _interval(self, part: str) -> tuple[Any, Any]:
        """One interval; raises ValueError with the reason."""
        if not part:
            raise ValueError("an interval is empty; ':' is a whole axis")
        if self.number is int:
            try:
                chosen = parse_slice(part)
            except ValueError as error:
                raise ValueError(f"'{part}' {error}") from None
            if chosen.step is not None:
                raise ValueError(f"'{part}' has a step, which a region has not (--lod coarsens)")
            return chosen.start, chosen.stop
        ends = part.split(":")
        if len(ends) == 1:
            raise ValueError(f"'{part}' is one position, and an interval has two ends")
        if len(ends) > 2:
            raise ValueError(f"'{part}' has more than two ends")
        low, high = (_position(end) for end in ends)
        return low, high


def parse_slice(text: str) -> slice:
    """`A:B:S` or one index as a slice; raises ValueError that says in a clause why it is none."""
    words = [part.strip() for part in text.split(":")]
    for word in words:
        if word and not _is_integer(word):
            kind = "is between two" if is_number(word) else "is no number"
            raise ValueError(f"is not made of indices: {word} {kind}")
    if not any(words) and len(words) == 1:
        raise ValueError("is empty")
    parts = [int(word) if word else None for word in words]
    if len(parts) == 1 and parts[0] is not None:
        index = parts[0]
        return slice(index, index + 1 if index != -1 else None)
    if len(parts) > 3:
        raise ValueError("has more than three parts")
    if len(parts) == 3 and parts[2] is not None and parts[2] < 1:
        raise ValueError(f"has the step {parts[2]}, and steps go upwards by 1 or more")
    return slice(*parts)


def written(low: int | None, high: int | None) -> str:
    """A range as a user writes it; a single index for a range of length 1."""
    if low is not None and (high == low + 1 or (low == -1 and high is None)):
        return str(low)
    return f"{'' if low is None else low}:{'' if high is None else high}"


def _position(text: str) -> float | None:
    """An end of an interval of positions; None if it is left out."""
    if not text.strip():
        return None
    if not is_number(text) or math.isnan(float(text)):
        raise ValueError(f"'{text}' is no position")
    return float(text)


def _is_integer(text: str) -> bool:
    return text.lstrip("+-").isdecimal() and text.lstrip("+-").isascii() and len(text) < 20


MAX_BUDGET = 86_400.0
"""Longest budget, in seconds."""


def _duration(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh]?)", text.strip())
    if match is None:
        raise ValueError(f"'{text}' is no time; write one such as 90s, 2m or 1h")
    seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]
    if not 1 <= seconds <= MAX_BUDGET:
        raise ValueError(f"'{text}' is {seconds:g} s; allowed: 1s to 24h")
    return seconds


DURATION = TextType("TIME", _duration)
"""Seconds as a time such as 90s, 2m or 1h, from 1 s to 24 h; a plain number is in seconds."""


GROUPS: dict[str, tuple[str, ...]] = {
    "Input": (
        "var", "axes", "t", "shape", "dtype", "endian", "missing", "select", "raw-values",
        "keep-extremes", "no-external", "components",
    ),
    "Quality, one of": (
        "psnr", "psnr-bulk", "max-error", "max-error-rel", "ratio", "min-psnr", "target", "bound",
    ),
    "Feature": ("feature", "dilation"),
    "Steps and region": ("time", "roi", "box", "lod"),
    "Values": ("outside", "fill"),
    "Preset": ("preset", "effort", "train", "tile", "without"),
    "Preset published": (
        "key-frames", "samples", "fold", "embedding-size", "hidden-layers", "width", "epochs",
        "train-on-seconds", "learning-rate", "schedule", "batch", "brick", "tables",
        "engines",
    ),
    "Scene": (
        "scene", "steps", "gallery", "set", "effect", "size", "background",
        "antialiasing", "scale",
    ),
    "Camera": (
        "view", "azimuth", "elevation", "zoom", "projection", "position", "focal-point", "view-up",
    ),
    "Colour and opacity": (
        "cmap", "opacity", "gradient-opacity", "range", "density", "isosurface", "no-volume",
        "track",
    ),
    "Clipping": ("clip-box", "clip-plane"),
    "Animation": ("animate", "frames", "fps", "pictures", "evolution", "columns"),
    "Accuracy and speed": ("march", "device", "step"),
    "Parts and further steps": ("plan", "keep"),
    "Comparison": ("peer", "part", "seconds", "turns", "speed"),
    "Address": ("host", "port"),
    "Cases": ("all", "case", "group"),
    "Output": ("o", "plain", "force", "report", "plot", "save-scene", "depth", "normal"),
    "Run": (
        "budget", "time-budget", "seed", "timings", "deterministic", "processes", "explain",
        "json", "q", "quiet", "v", "verbose", "help",
    ),
}  # fmt: skip
"""Names of options by group, in the order of the help; options that none names come last."""
ELSEWHERE = {
    ("decode", "t"): "Steps and region",
    ("decode", "dtype"): "Values",
    ("decode", "isosurface"): "Output",
    ("render", "t"): "Steps and region",
    ("encode", "device"): "Run",
    ("encode", "part"): "Parts and further steps",
    ("train", "device"): "Run",
    ("rate", "device"): "Run",
    ("demo", "shape"): "Scene",
    ("diff", "max-error"): "Quality, gates",
    ("diff", "min-psnr"): "Quality, gates",
    ("rate", "target"): "Comparison",
    ("rate", "bound"): "Comparison",
    ("rate", "preset"): "Comparison",
    ("train", "engines"): "Comparison",
}
"""Groups of options that mean something else in one command, by command and option."""
WHY_ONCE = {"var": "a file RUN.fhz holds one variable, so encode each with a command of its own"}
"""Advice to those who repeat an option, where it is not plain; by the name of its parameter."""
LAST = ("Output", "Run")
"""Groups that end the help, in this order."""
OTHERS = "Further options"
"""Group of the options that GROUPS does not name."""


def group_of(command: str, option: click.Option) -> str:
    """The group of an option of a command: the first that names it, else the last of all."""
    names = [name.lstrip("-") for name in option.opts]
    for name in names:
        if (command, name) in ELSEWHERE:
            return ELSEWHERE[command, name]
    return next((title for title, members in GROUPS.items() if set(names) & set(members)), OTHERS)


EXIT_CODES = (
    "0 success; 1 failure; 2 usage or unsuitable input; 3 a promise or gate missed; 4 damaged or"
    " unsupported file; 130 interrupted."
)
"""Meanings of the exit codes, which are those of every command."""


class BaseCommand(click.Command):
    """A command whose help lists its options by purpose, and which takes single values once."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an option that is given twice and takes one value: click would drop the first."""
        if not ctx.resilient_parsing:
            given = self.make_parser(ctx).parse_args(args=list(args))[2]
            for option in given:
                if given.count(option) > 1 and isinstance(option, click.Option):
                    _check_repeated(option, ctx)
        return super().parse_args(ctx, args)

    def grouped(self, ctx: click.Context) -> dict[str, list[tuple[str, str]]]:
        """Options as they are typed, and their helps, by the titles of groups in their order."""
        rows: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                title = group_of(self.name or "", parameter)
                rows.setdefault(title, []).append(record)
        first = [title for title in dict.fromkeys((*GROUPS, *rows)) if title not in LAST]
        return {title: rows[title] for title in (*first, *LAST) if title in rows}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The options of the help, in their groups."""
        for title, records in self.grouped(ctx).items():
            with formatter.section(title):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The lines of `epilog` as examples, as they are typed, and the exit codes."""
        with formatter.section("Examples"):
            formatter.write("".join(f"  {line}\n" for line in (self.epilog or "").splitlines()))
        with formatter.section("Exit codes"):
            formatter.write_text(EXIT_CODES)


class BaseGroup(click.Group):
    """A group of such commands."""

    command_class = BaseCommand

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse a line without a command by the names of the commands, not by the whole help."""
        if not args and not ctx.resilient_parsing:
            names = ", ".join(self.list_commands(ctx))
            raise click.UsageError(f"Missing command; give one of {names}", ctx)
        return super().parse_args(ctx, args)


def _check_repeated(option: click.Option, ctx: click.Context) -> None:
    """Raise UsageError for an option that is given twice, unless that means something."""
    if option.multiple or option.count or (option.is_flag and not option.secondary_opts):
        return
    name = "/".join([option.opts[-1], *option.secondary_opts])
    advice = WHY_ONCE.get(option.name or "", "give it once")
    raise click.UsageError(f"{name} is given more than once; {advice}", ctx)


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


def option_group(
    record: type, name: str, *options: Callable[[Command], Command]
) -> Callable[[Command], Command]:
    """A decorator that adds options, and gives the command one record in place of their values.

    record: a dataclass whose fields are the options' parameters; those that are not among `options`
        stand above the decorator. name: of the command's argument.
    """
    names = [field.name for field in dataclasses.fields(record)]

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collected(**values: Any) -> None:
            given = record(**{field: values.pop(field) for field in names})
            command(**{name: given}, **values)

        decorated: Command = collected
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


def check_writable(
    path: str | Path, force: bool, *, region: bool = False, sources: Sequence[str | Path] = ()
) -> None:
    """Refuse an output before any work: it exists, cannot be replaced, or is one of the `sources`.

    region: the output is written by `save_region`, whose checks differ.
    Raises InputError in every case (exit code 2): only the command line is wrong so far.
    """
    from fhash_formats.support.files import check_output
    from fhash_formats.writers.registry import save_check

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
        """The number; fails for NaN and for a number outside the limits. A share may be in %."""
        if isinstance(value, str) and value.strip().endswith("%"):
            name = "" if param is None else param.opts[0]
            if not name.endswith("-rel"):
                share = "" if name != "--max-error" else "; --max-error-rel is a share of the range"
                self.fail(f"'{value}' is a share, and {name} is in data units{share}", param, ctx)
            value = click.FLOAT(value.strip()[:-1], param, ctx) / 100
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


def _selected(text: str) -> tuple[str, str]:
    name, equals, index = (word.strip() for word in text.rpartition("="))
    if not (name and equals and index):
        raise ValueError(f"'{text}' is not NAME=INDEX, such as member=2 or dim3=0")
    return name, index


SELECT = TextType("NAME=INDEX", _selected)
"""One index along a dimension: `member=2`, `dim3=0`, `lev=850.0`, `member=r1i1p1`.

Name and index are texts; the file says what they mean.
"""


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
    overlap: str | None = None

    @property
    def part(self) -> bool:
        """Whether the options choose a part of what the source holds."""
        return self.var is not None or self.t is not None or bool(self.select)

    def open(self, path: str, progress: Callable[[str, int, int, str], None]) -> Any:
        """The Series at a path; the caller closes it.

        progress: is told that the source is being opened: many files take their time.
        """
        from fhash_formats.readers.registry import open_series

        progress("opening", 0, 1, path)
        return open_series(path, steps=self.t, keep_extremes=self.keep_extremes, **self._wishes())

    def list(self, path: str) -> Any:
        """The variables at a path, as `list_variables` gives them."""
        from fhash_formats.readers.registry import list_variables

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
        from fhash_formats.readers.file_series import RawLayout, parse_shape

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
            "overlap": self.overlap,
        }


series_options = option_group(
    SourceOptions,
    "source",
    click.option(
        "--var",
        metavar="NAME",
        help="Which variable or dataset of the file; 'state.rho' is a field of a compound type.",
    ),
    click.option(
        "--select",
        type=SELECT,
        multiple=True,
        help="Index along a dimension that is not t, z, y or x, such as member=2; dim3=0 where it"
        " has no name. Repeat for several dimensions.",
    ),
    click.option(
        "--missing",
        type=NUMBER,
        multiple=True,
        help="A value that stands for a missing one, such as -9999 or 1e20; repeat for several.",
    ),
    click.option(
        "--raw-values",
        is_flag=True,
        help="Read packed numbers as stored: no fill value, scale or offset, and no unit.",
    ),
    click.option(
        "--keep-extremes",
        is_flag=True,
        help="An extreme value that repeats, far away from all others, is data.",
    ),
    click.option(
        "--no-external",
        is_flag=True,
        help="Read no file outside the folder of DATA, whatever a header or a link in it names.",
    ),
    click.option(
        "--overlap",
        type=click.Choice(["first", "last"]),
        help="Which of the files of a pattern counts where several have the same time.",
    ),
    click.option(
        "--axes",
        metavar="t,z,y,x",
        help="What the file's dimensions are, in its own order; letters left out have length 1.",
    ),
    click.option(
        "--t", "t", type=SLICE, help="Only these steps, half-open as in Python: 40:50, ::2."
    ),
    click.option(
        "--shape",
        metavar="x=64,y=64,z=32,t=10",
        help="Lengths of a raw file, the fastest axis first.",
    ),
    click.option(
        "--dtype", metavar="NAME", help="Number type of a raw file, such as float32 or uint8."
    ),
    click.option(
        "--endian", type=click.Choice(["little", "big"]), help="Byte order of a raw file."
    ),
)
"""Options of commands that read data; the command gets them as `source`."""


def config_options(*names: str, preset: str | None = None) -> Callable[[Command], Command]:
    """Add an option for each field of EncodeConfig, or for each of `names`.

    Help, choices and range of an option are those of the field. The command gets an EncodeConfig as
    `config`.

    preset: that of a command that has no option for it.
    """
    from fhash_codec.config import EncodeConfig

    fixed = {} if preset is None else {"preset": preset}

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collected(settings: dict[str, Any], **values: Any) -> None:
            command(config=EncodeConfig.from_dict(settings | fixed), **values)

        return setting_options(*names)(collected)

    return decorate


def setting_options(*names: str, by_variable: bool = False) -> Callable[[Command], Command]:
    """Add options as `config_options` does; the command gets a dict of them as `settings`.

    It serves commands whose settings are for several presets.

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
    from fhash_codec.config import EncodeConfig

    limits = field.metadata
    flag = f"--{EncodeConfig.label(field)}"
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
