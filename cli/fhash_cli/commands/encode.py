"""`fhash encode`: a series in, a container out."""

from __future__ import annotations

import dataclasses
import glob
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import click
from click.core import ParameterSource

from fhash_cli.commands.cost import check_report_folder
from fhash_cli.commands.parts import WishedPart, encode_all_or_part
from fhash_cli.options import (
    DURATION,
    BaseCommand,
    SourceOptions,
    check_writable,
    force_option,
    json_option,
    option_group,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import (
    Progress,
    compared,
    duration,
    emit,
    extent,
    factor,
    feature_rows,
    loss_rows,
    model_name,
    number,
    one_line,
    quality_rows,
    say,
    size,
    split_row,
    table,
)
from fhash_cli.variables import config_of, configs_of, report_table, variables_to_encode
from fhash_formats.errors import FhashWarning, InterruptedEncodingError, QualityError
from fhash_formats.support.files import file_name

if TYPE_CHECKING:
    from fhash_codec.comparison import EncodeReport
    from fhash_codec.config import EncodeConfig
    from fhash_codec.cost.prediction import Choice, TimeBudget
    from fhash_codec.encoding import DatasetReport
    from fhash_formats.series import Series

MAX_LABELS = 64
"""Range of integers up to which they may be labels."""


@dataclass(frozen=True, kw_only=True)
class EncodeOptions:
    """Options of `fhash encode` besides its data, output and settings."""

    components: str | None
    time_budget: float | None
    part: str | None
    plan: str | None
    verbose: bool
    report_folder: str | None
    as_json: bool
    quiet: bool


class Chosen(TypedDict, total=False):
    """Choices made for the user, beside the figures of the file."""

    time_budget: Annotated[TimeBudget, "`--time-budget`: the choice of effort or epochs"]


@click.command(
    "encode",
    cls=BaseCommand,
    epilog="fhash encode demo/vortex.h5 -o bound.fhz --max-error 0.01\n"
    "fhash encode demo/vortex.h5 -o small.fhz --ratio 200 --effort 2\n"
    "fhash encode demo/vortex.h5 -o swirl.fhz --feature interval:0.08:2 --psnr 45",
)
@click.argument("data", type=click.Path())
@click.option(
    "-o",
    "output",
    metavar="RUN.fhz",
    type=click.Path(),
    help="Where to write.  [default: DATA.fhz in this folder]",
)
@series_options
@setting_options(by_variable=True)
@click.option(
    "--components",
    metavar="DIM",
    help="Dimension of vectors, each component of which becomes a variable of its own, such as "
    "velocity_0.",
)
@force_option
@json_option
@quiet_option
@click.option(
    "--time-budget",
    type=DURATION,
    help="Choose the highest effort, or with --preset published the most epochs, that should take "
    "no longer than a time such as 60s or 5m, by a short probe; --effort or --epochs is then the "
    "most that may be chosen.",
)
@click.option(
    "--part",
    metavar="I/N",
    help="Encode only the I-th of N parts, counted from 1: whole layers of tiles along time, such "
    "as 3/16. `fhash merge` joins the parts to what one command would write. "
    "Needs --max-error or --max-error-rel.",
)
@click.option(
    "--plan",
    metavar="RUN.plan",
    type=click.Path(),
    help="With --part: the plan that `fhash plan` made, settings included. Only the steps of the "
    "part are then read.",
)
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    help="Print all figures, how long each stage took, and why it ran or did not.",
)
@click.option(
    "--report",
    "report_folder",
    metavar="DIR",
    type=click.Path(),
    help="Also measure reads and pictures of the file, and write the page of `fhash cost` on it.",
)
@option_group(EncodeOptions, "options")
def command(
    data: str,
    output: str | None,
    source: SourceOptions,
    settings: dict[str, Any],
    options: EncodeOptions,
    force: bool,
) -> None:
    """Find the features of DATA, encode them and write them as RUN.fhz.

    DATA is a file of HDF5, NetCDF, numpy or raw values, a Zarr folder, or a pattern of such files
    in quotes ('step_*.raw').

    --var u,v,w or --var all encodes several variables into one file, each with its own promise if
    wished: --max-error u=0.1,v=0.2.

    Ctrl-C leaves no file, and an older RUN.fhz as it was. With --preset published it saves a
    checkpoint of the training beside RUN.fhz, and the same command goes on from there; with the
    others the same command starts again.
    """
    time_budget, report_folder = options.time_budget, options.report_folder
    verbose, as_json, quiet = options.verbose, options.as_json, options.quiet
    others = verbose or time_budget is not None or report_folder is not None
    wish = WishedPart.of(options.part, options.plan, with_others=others)
    if output is None:
        output = default_output(data)
    # The reader says whether a folder is data at all; `encode` then keeps it from being replaced.
    check_writable(output, force, sources=[] if Path(data).is_dir() else [data])
    several = variables_to_encode(source, data, options.components, quiet=quiet)
    if several is not None:
        alone = (time_budget, report_folder, wish)
        if any(given is not None for given in alone):
            raise click.UsageError("--time-budget, --report and --part are for one variable")
        encoded = _encode_several(data, output, several, settings, force, quiet)
        return _emit_several(encoded, verbose, as_json)
    config = config_of(settings)
    if report_folder is not None:
        check_report_folder(Path(report_folder), force, data)
    before = _stamp(output)
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        missed: QualityError | None = None
        stopped: InterruptedEncodingError | None = None
        choice = predicted = None
        if time_budget is not None:
            choice = _choose(series, config, time_budget, progress, quiet=quiet)
            config, predicted = choice.config, dataclasses.asdict(choice.prediction)
        try:
            report = encode_all_or_part(series, output, config, wish, force, progress, predicted)
        except QualityError as error:
            # The file is written, and its figures are a result all the same.
            missed, report = error, error.figures
        except KeyboardInterrupt:
            raise InterruptedEncodingError(_after_interruption(output, before)) from None
        if report_folder is not None:
            stopped = _write_report(
                series, report, config, Path(report_folder), force, missed, progress
            )
    if not quiet:
        _say_remarks(source, series, config, report, promise_kept=missed is None)
    text = summary(report, series.units)
    if verbose:
        text = table(report_rows(report, series.units, part=source.part))
    if report_folder is not None:
        text += f"\n{Path(report_folder) / 'cost.html'}"
    text += _explained(report, verbose)
    chosen: Chosen = {}
    if choice is not None:
        chosen["time_budget"] = choice.to_dict()
    return emit({**report, **chosen}, text, as_json, missed or stopped)


def _explained(figures: EncodeReport, verbose: bool, title: str = "") -> str:
    """The table of the stages of a report, which keeps them only where they are asked for."""
    stages = figures.pop("stages", [])
    if not verbose:
        return ""
    figures["stages"] = stages
    return f"\n\n{title}{stage_table(stages)}"


def _say_remarks(
    source: SourceOptions,
    series: Series,
    config: EncodeConfig,
    report: Mapping[str, Any],
    *,
    promise_kept: bool,
) -> None:
    """Lines on what may be a slip in the command, or decided the size."""
    from fhash_codec.compact.goal import decided_by_bulk

    for value in source.missing:
        if value == value and value not in series.occurring:
            say(f"--missing {value:.9g}: {series.source} holds no such value")
    integers = (series.source_dtype or series.dtype).kind in "iu"
    if report["bytes"] > report["raw_bytes"]:
        say(
            f"the file is larger than its {size(report['raw_bytes'])} of values; a looser promise"
            " makes it smaller, and so may lossless codecs"
        )
    few = report["data_range"] <= MAX_LABELS and report["max_abs_error"]
    if integers and few:
        say("few different integers: if they are labels, --max-error 0 keeps each exactly")
    if promise_kept and (line := decided_by_bulk(config, report)) is not None:
        say(line)


def _encode_several(
    data: str,
    output: str,
    several: Mapping[str, SourceOptions],
    settings: Mapping[str, Any],
    force: bool,
    quiet: bool,
) -> tuple[DatasetReport, QualityError | None]:
    """Encode several variables into one file: its figures, and the promises that it misses.

    several: how each is opened, by its name.
    """
    from fhash_codec.encoding import encode_dataset

    before, names = _stamp(output), list(several)
    with Progress(quiet=quiet) as progress:
        try:
            figures = encode_dataset(
                data,
                output,
                configs_of(settings, names),
                variables=names,
                open_variable=lambda name: several[name].open(data, progress),
                force=force,
                progress=progress,
            )
        except QualityError as error:
            return error.figures, error
        except KeyboardInterrupt:
            raise InterruptedEncodingError(_after_interruption(output, before)) from None
    return figures, None


def _emit_several(
    encoded: tuple[DatasetReport, QualityError | None], verbose: bool, as_json: bool
) -> None:
    """Print the figures of a file of several variables, and raise what it misses."""
    report, missed = encoded
    variables = report["variables"]
    text = f"{sizes_of(report)}  {duration(report['seconds'])}"
    if verbose:
        text += f"\n\n{table([('size', compared(report)), split_row(report)])}"
    text += f"\n\n{table(report_table(variables))}"
    for name, figures in variables.items():
        text += _explained(figures, verbose, f"{one_line(name)}\n")
    emit(report, text, as_json, missed)


def _choose(
    series: Series, config: EncodeConfig, seconds: float, progress: Progress, *, quiet: bool
) -> Choice:
    """Choose effort or epochs by a budget in seconds, and say so in one line."""
    from fhash_codec.cost.prediction import choose

    name = "epochs" if config.published else "effort"
    given = click.get_current_context().get_parameter_source(name)
    choice = choose(
        series,
        config,
        seconds,
        capped=given is not None and given is not ParameterSource.DEFAULT,
        progress=progress,
    )
    if not choice.fits:
        warnings.warn(choice.why, FhashWarning, stacklevel=2)
    elif not quiet:
        say(choice.why)
    return choice


def stage_table(stages: Sequence[Mapping[str, Any]]) -> str:
    """The stages of an encoding: seconds, share of the whole, and why each ran or did not.

    stages: as in the report of `fhash_codec.encode`.
    """
    total = max(sum(entry["seconds"] for entry in stages), 1e-9)
    rows = [("stage", " seconds  share  why")]
    for entry in stages:
        taken = f"{entry['seconds']:8.2f} {entry['seconds'] / total:6.1%}"
        if not entry["times"]:
            taken = f"{'-':>8} {'-':>6}"
        again = f", {entry['times']} times" if entry["times"] > 1 else ""
        rows.append((entry["stage"], f"{taken}  {entry['why']}{again}"))
    return table(rows)


def _write_report(
    series: Series,
    figures: EncodeReport,
    config: EncodeConfig,
    folder: Path,
    force: bool,
    missed: QualityError | None,
    progress: Progress,
) -> InterruptedEncodingError | None:
    """Measure reads and pictures of the file just written, and write its report.

    The error that is returned says that Ctrl-C ended the measurements; None where it did not.
    """
    from fhash_codec.cost.cost import report_on_encode
    from fhash_codec.cost.report import write_report

    costs = report_on_encode(series, figures, config, missed=missed is not None, progress=progress)
    page, *_ = write_report(costs, folder, force=force)
    if not costs.interrupted:
        return None
    return InterruptedEncodingError(
        f"interrupted; {figures['path']} is complete, {page} has what was measured until then"
    )


def _stamp(path: str) -> tuple[int, int] | None:
    """Inode and time of a file, which one that replaces it has not; None without a file."""
    try:
        state = os.stat(path)
    except OSError:
        return None
    return state.st_ino, state.st_mtime_ns


def _after_interruption(output: str, before: tuple[int, int] | None) -> str:
    """A line that says what an interrupted encoding left, and what the same command will do."""
    if _stamp(output) not in (None, before):
        return f"interrupted after {output} was written; the file is complete"
    left = f"{output} is not written" if before is None else f"the older {output} is unchanged"
    folder, name = Path(output).parent, glob.escape(Path(output).name)
    goes_on = any(folder.glob(f"{name}.*.checkpoint"))
    again = "goes on from the checkpoint beside it" if goes_on else "starts again"
    return f"interrupted; {left}, and the same command {again}"


def default_output(data: str) -> str:
    """RUN.fhz of DATA, in this folder; raises UsageError where DATA has no name for it."""
    stem = Path(file_name(data)).stem.replace("*", "").replace("?", "").rstrip("_-. ")
    if not stem:
        raise click.UsageError("Missing option '-o'; DATA gives no name for RUN.fhz")
    return f"{stem}.fhz"


def summary(report: Mapping[str, Any], units: str) -> str:
    """An encoding in one line: file, sizes, what it keeps, and the time that it took."""
    if report["rmse"] == 0:
        kept = "every value exact"
    else:
        worst = number(report["max_abs_error"], units, digits=2)
        kept = f"{number(report['psnr'], 'dB', digits=3)}  max error {worst}"
    return f"{sizes_of(report)}  {kept}  {duration(report['seconds'])}"


def sizes_of(report: Mapping[str, Any]) -> str:
    """A file, the bytes of its values, its own, and how often these fit into those."""
    sizes = f"{size(report['raw_bytes'])} -> {size(report['bytes'])}"
    return f"{one_line(str(report['path']))}  {sizes} ({factor(report['ratio'])})"


def report_rows(report: EncodeReport, units: str, *, part: bool) -> list[tuple[str, str]]:
    """An encoding's report as a table, with the size after each stage of the search.

    part: whether options chose a part of the source.
    """
    published = report["published"]
    size_of_model = (
        f"{report['parameters']:,} parameters, {report['epochs']} epochs"
        if published
        else f"{report['parameters']:,} numbers that are not zero"
    )
    return [
        ("written", str(report["path"])),
        ("size", compared(report, part=part)),
        split_row(report),
        *gain_rows(report),
        ("steps, z, y, x", extent(report["shape"])),
        *([("key frames", str(len(report["key_frames"])))] if published else []),
        *feature_rows(report),
        *quality_rows(report, units),
        ("model", f"{model_name(published=published)}, {size_of_model}"),
        *([] if published else [("MLP", trained(report))]),
        *loss_rows(report),
        ("time", f"{duration(report['seconds'])} of wall time, on {report['device']}"),
    ]


def trained(report: Mapping[str, Any]) -> str:
    """The training of the MLP, and what it saved; why there was none, where the stages tell."""
    if report["saved"] is not None:
        return (
            f"trained for {report['epochs']} epochs; it saves about {report['saved']:.0%} of the"
            " bytes of the values"
        )
    if report["epochs"]:
        return f"trained for {report['epochs']} epochs; it saved too little, and was left out"
    why = [each["why"] for each in report.get("stages", []) if each["stage"] == "head"]
    return f"none: {why[0]}" if why else "none"


def gain_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The size after each stage of an encoding, and when the stage was done.

    All but the last are estimated from a sample.
    """
    rows, last = [], len(report["gains"]) - 1
    for stage, gain in enumerate(report["gains"]):
        after = f" after {duration(gain['seconds'])}" if "seconds" in gain else ""
        about = "" if stage == last else "about "
        rows.append(("  " + gain["what"], f"{about}{size(gain['bytes'])}{after}"))
    return rows
