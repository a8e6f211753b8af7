"""`fhash plan`, `fhash merge`, `fhash append`: a series encoded in parts, or step by step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypedDict

import click
from click.core import ParameterSource

from fhash_cli.options import (
    BaseCommand,
    SourceOptions,
    check_writable,
    force_option,
    json_option,
    quiet_option,
    run_argument,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table
from fhash_cli.variables import config_of

if TYPE_CHECKING:
    from fhash_codec.comparison import EncodeReport
    from fhash_codec.config import EncodeConfig
    from fhash_formats.series import Series

PLANNED = (
    "features", "dilation", "max_error", "max_error_rel", "preset", "effort", "tile", "without",
    "seed",
)  # fmt: skip
"""Settings of a plan, and a bound as the promise."""


class PlanReport(TypedDict):
    """A plan that was written."""

    path: Annotated[str, "the file written"]
    bytes: Annotated[int, "its size"]
    shape: Annotated[list[int], "vertices of the series along t, z, y and x"]
    tile: Annotated[list[int], "those of a tile"]
    layers: Annotated[int, "layers of tiles along time, and so the most parts that there can be"]
    value_range: Annotated[list[float], "the least and the greatest value"]


@click.command(
    "plan",
    cls=BaseCommand,
    epilog="fhash plan demo/vortex.h5 -o run.plan --max-error 0.01 --tile 8x32x32x32\n"
    "fhash encode demo/vortex.h5 --plan run.plan --part 1/2 -o first.fhz",
)
@click.argument("data", type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.plan", required=True, type=click.Path(), help="Where to write."
)
@series_options
@setting_options(*PLANNED)
@force_option
@json_option
@quiet_option
def plan_command(
    data: str,
    output: str,
    source: SourceOptions,
    settings: dict[str, Any],
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Choose tiles and settings of DATA once, for `fhash encode DATA --part I/N --plan RUN.plan`.

    All steps are read once for their range, and some tiles for the choices. A part then reads its
    own steps alone, and takes its settings from the plan. RUN.plan is JSON; it is refused with
    other data, other settings and another version of fhash. Needs --max-error or --max-error-rel.
    """
    from fhash_codec.appending.series_plan import plan_parts

    # The reader says whether a folder is data at all; `plan_parts` keeps it from being replaced.
    check_writable(output, force, sources=[])
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        plan = plan_parts(series, output, config_of(settings), force=force, progress=progress)
        units = series.units
    low, high = plan.value_range.low, plan.value_range.high
    report: PlanReport = {
        "path": output,
        "bytes": len(plan.to_bytes()),
        "shape": list(plan.shape),
        "tile": list(plan.recipe.tile),
        "layers": plan.layers,
        "value_range": [low, high],
    }
    rows = [
        ("written", output),
        ("size", size(report["bytes"])),
        ("steps, z, y, x", extent(plan.shape)),
        ("tiles", f"{extent(plan.recipe.tile)}; {plan.layers} layers, so at most as many parts"),
        ("values", f"{number(low, units)} to {number(high, units)}"),
    ]
    emit(report, table(rows), as_json)


@click.command(
    "merge",
    cls=BaseCommand,
    epilog="fhash encode demo/vortex.h5 --max-error 0.01 --tile 8x32x32x32 --part 1/2 -o 1.fhz\n"
    "fhash encode demo/vortex.h5 --max-error 0.01 --tile 8x32x32x32 --part 2/2 -o 2.fhz\n"
    "fhash merge 1.fhz 2.fhz -o whole.fhz",
)
@click.argument("parts", metavar="PART.fhz...", nargs=-1, required=True, type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.fhz", required=True, type=click.Path(), help="Where to write."
)
@force_option
@json_option
@quiet_option
def merge_command(
    parts: tuple[str, ...], output: str, force: bool, as_json: bool, quiet: bool
) -> None:
    """Join the files that `fhash encode --part 1/N` to `N/N` wrote, in any order, to RUN.fhz.

    Tiles are copied and their checksums checked; nothing is coded again. Parts that are missing,
    given twice or of another encoding are refused. RUN.fhz is, byte for byte, what one `fhash
    encode` with the same settings writes.
    """
    from fhash_codec.appending.parts import merge

    with Progress(quiet=quiet) as progress:
        report = merge(parts, output, force=force, progress=progress)
    rows = [
        ("written", output),
        ("size", size(report["bytes"])),
        ("steps", f"{report['steps']}, of {report['parts']} parts with {report['tiles']} tiles"),
        ("largest error", number(report["max_abs_error"])),
    ]
    emit(report, table(rows), as_json)


class WishedPart(NamedTuple):
    """The part that a command line names, such as "3/16", and its plan; None to make one."""

    text: str
    plan: str | None

    @classmethod
    def of(cls, text: str | None, plan: str | None, *, with_others: bool) -> WishedPart | None:
        """The part that two options name; None for all of the series.

        with_others: whether there are options that need all of it.
        """
        if text is None and plan is not None:
            raise click.UsageError("--plan goes with --part")
        if text is not None and with_others:
            raise click.UsageError("--part goes without -v, --time-budget and --report")
        return None if text is None else cls(text, plan)


def encode_all_or_part(
    series: Series,
    output: str,
    config: EncodeConfig,
    part: WishedPart | None,
    force: bool,
    progress: Progress,
    predicted: dict[str, Any] | None,
) -> EncodeReport:
    """Encode a series, or one part of it."""
    import fhash_codec
    from fhash_codec.appending.parts import Part, encode_part
    from fhash_codec.appending.series_plan import SeriesPlan

    if part is None:
        return fhash_codec.encode(
            series, output, config, force=force, progress=progress, predicted=predicted
        )
    one, plan = Part.parse(part.text), None
    if part.plan is not None:
        plan = SeriesPlan.read(part.plan)
        plan.require_settings(_given(config))
    report = encode_part(
        series,
        output,
        config if plan is None else None,
        one,
        plan=plan,
        force=force,
        progress=progress,
    )
    return {**report, "stages": []}


def _given(config: EncodeConfig) -> dict[str, Any]:
    """The settings that the command line names, by name."""
    default, context = ParameterSource.DEFAULT, click.get_current_context()
    return {
        name: value
        for name, value in vars(config).items()
        if context.get_parameter_source(name) not in (None, default)
    }


@click.command(
    "append",
    cls=BaseCommand,
    epilog="fhash encode demo/vortex.h5 --t :8 -o long.fhz --max-error 0.01 --tile 8x32x32x32\n"
    "fhash append long.fhz demo/vortex.h5 --t 8:",
)
@run_argument
@click.argument("data", type=click.Path())
@series_options
@click.option(
    "--keep",
    metavar="STEPS",
    type=click.IntRange(1),
    help="Keep so many steps of RUN.fhz, and put those of DATA in the place of the others. By "
    "default all are kept.",
)
@json_option
@quiet_option
def append_command(
    run: str, data: str, source: SourceOptions, keep: int | None, as_json: bool, quiet: bool
) -> None:
    """Code the steps of DATA behind those of RUN.fhz, in its tiles and to its bound of the error.

    RUN.fhz promises a bound (--max-error, --max-error-rel) of every value, and ends with a whole
    layer of tiles. Its steps are copied and not coded again. It is replaced at the end, so that it
    is complete at every moment; Ctrl-C leaves it as it was.
    """
    from fhash_codec.appending.writer import append

    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        report = append(series, run, keep=keep, progress=progress)
        units = series.units
    rows = [
        ("written", run),
        ("size", size(report["bytes"])),
        ("steps", f"{report['steps']}: {report['kept']} kept, {report['appended']} appended"),
        ("largest error", number(report["max_abs_error"], units)),
    ]
    emit(report, table(rows), as_json)
