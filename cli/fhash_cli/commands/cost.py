"""`fhash cost`: what accuracy costs on the user's own series, as a page, a PNG and JSON."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import click

from fhash_cli.options import (
    DURATION,
    BaseCommand,
    SourceOptions,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, duration, emit, extent, table
from fhash_formats.errors import InputError, InterruptedEncodingError, OutputError

if TYPE_CHECKING:
    from fhash_codec.cost.results import CostReport


@click.command("cost", cls=BaseCommand, epilog="fhash cost demo/vortex.h5 --budget 1m")
@click.argument("data", type=click.Path())
@click.option(
    "-o",
    "output",
    metavar="DIR",
    type=click.Path(),
    help="Folder of the report: cost.html, cost.png and cost.json.  [default: DATA.cost here]",
)
@series_options
@setting_options("features")
@click.option(
    "--budget",
    type=DURATION,
    default="2m",
    show_default=True,
    help="Time to measure for, such as 90s, 2m or 1h.",
)
@force_option
@json_option
@quiet_option
def command(
    data: str,
    output: str | None,
    source: SourceOptions,
    settings: dict[str, Any],
    budget: float,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure what accuracy costs on DATA: seconds and bytes of encoding, reading and drawing.

    The default settings are always measured. The most telling of the others follow until the budget
    is spent; the report says what was left out. Of large DATA a sample is measured, and seconds and
    bytes are scaled up to all of it, with an interval.
    Ctrl-C ends the measurements, and the report of what there is by then is written.
    SZ3, SPERR and ZFP come with pip install 'fhash[bench]', as does what the page needs.
    """
    folder = Path(output) if output is not None else Path(Path(data).stem + ".cost")
    check_report_folder(folder, force, data)
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        from fhash_codec.cost.cost import measure_cost
        from fhash_codec.cost.report import write_report

        features = settings["features"]
        report = measure_cost(series, features=features, budget=budget, progress=progress)
        paths = write_report(report, folder, force=force)
    stopped = None
    if report.interrupted:
        stopped = InterruptedEncodingError(
            f"interrupted; {paths[0]} has what was measured until then"
        )
    files: ReportFiles = {"paths": [str(path) for path in paths]}
    emit({**files, **report.to_dict()}, report_text(report, paths), as_json, stopped)


class ReportFiles(TypedDict):
    """Files of a report; `cost.json` of it holds the same object without this key."""

    paths: Annotated[list[str], "page, PNG and JSON"]


def check_report_folder(folder: Path, force: bool, data: str) -> None:
    """Refuse the folder of a report before any work; raises InputError and what imports raise."""
    from fhash_codec.cost.report import check_folder

    try:
        check_folder(folder, force, sources=(Path(data),))
    except OutputError as error:
        raise InputError(str(error)) from error


def report_text(report: CostReport, paths: list[Path]) -> str:
    """The table of advice, the conclusion, what was left out, and where the report is."""
    from fhash_codec.cost.results import ADVICE, advice_rows, conclusion, feature_options

    lines = []
    if report.advice:
        lines += table([ADVICE, *advice_rows(report)], left=True).splitlines()
        lines += [f"each with {option}" for option in feature_options(report)]
    lines += ["", *textwrap.wrap(conclusion(report), 100)]
    late = sum(entry.late for entry in report.left_out)
    if late:
        lines += ["", f"no time was left for {late} measurements; the page lists them as left out"]
    lines += [f"left out: {entry.what}: {entry.why}" for entry in report.left_out if not entry.late]
    facts = [
        ("measured", f"{report.measured}, {extent(report.measured_shape)}"),
        ("time", f"{duration(report.seconds)} of {duration(report.budget_seconds)}"),
        *(("written", str(path)) for path in paths),
    ]
    return "\n".join([*lines, "", table(facts)]).strip()
