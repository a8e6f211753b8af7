"""`fhash diff`: measures a container against its data, with gates for scripts."""

from __future__ import annotations

from typing import Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import (
    RealRange,
    SourceOptions,
    json_option,
    quiet_option,
    run_argument,
    series_options,
)
from fhash_cli.output import Progress, compared, emit, extent, number, quality_rows, say, table
from fhash_formats.errors import QualityError


@click.command("diff", cls=BaseCommand)
@click.argument("data", type=click.Path())
@run_argument
@series_options
@click.option(
    "--min-psnr",
    metavar="DB",
    type=RealRange(0),
    help="Exit code 3 if the PSNR in the coreset is below this.",
)
@click.option(
    "--max-error",
    metavar="E",
    type=RealRange(0),
    help="Exit code 3 if the largest error in the coreset is above this.",
)
@json_option
@quiet_option
def command(
    data: str,
    run: str,
    source: SourceOptions,
    min_psnr: float | None,
    max_error: float | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare RUN.fhz with the DATA it was made from, over all steps."""
    import fhash_codec

    if data.endswith(".fhz") and not run.endswith(".fhz"):
        raise click.UsageError(f"the data come first: fhash diff {run} {data}")
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        report = fhash_codec.diff(series, run, progress=progress)
        fill = None if source.missing or series.fill is not None else _missing_of(run)
    if fill is not None and not quiet:
        say(f"{run} was encoded with --missing {fill:.9g}; add it here, or it counts as a value")
    rows = [
        ("size", compared(report, part=source.part)),
        ("steps, z, y, x", extent(report["shape"])),
        *quality_rows(report, series.units),
    ]
    emit(report, table(rows), as_json, _missed_gate(run, report, min_psnr, max_error))


def _missing_of(run: str) -> float | None:
    """The number that stood for a missing value in the source of a container, if any."""
    import fhash_codec

    with fhash_codec.open(run) as volume:
        return volume.value_type.fill


def _missed_gate(
    run: str, report: dict[str, Any], min_psnr: float | None, max_error: float | None
) -> QualityError | None:
    """The error of the first gate that the figures miss; None if they miss none.

    Where nothing differs no PSNR is defined, and any gate is met. Where the data are constant, or
    nothing can be compared, none is defined either, and no gate is met.
    """
    if (
        min_psnr is not None
        and report["rmse"] != 0
        and not (report["psnr"] is not None and report["psnr"] >= min_psnr)
    ):
        reached = (
            "no PSNR is defined"
            if report["psnr"] is None
            else f"PSNR {number(report['psnr'], 'dB')}"
        )
        return QualityError(
            f"{run}: {reached} in the coreset; at least {min_psnr:g} dB was asked for"
        )
    worst = report["max_abs_error"]
    if max_error is not None and not (worst is not None and worst <= max_error):
        largest = "no value can be compared" if worst is None else f"largest error {worst:.6g}"
        return QualityError(f"{run}: {largest} in the coreset; at most {max_error:g} was asked for")
    return None
