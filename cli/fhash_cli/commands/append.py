"""`fhash append`: further steps behind those of a container."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import SourceOptions, json_option, quiet_option, run_argument, series_options
from fhash_cli.output import Progress, emit, number, size, table


@click.command("append", cls=BaseCommand)
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
def command(
    run: str,
    data: str,
    source: SourceOptions,
    keep: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Code the steps of DATA behind those of RUN.fhz, in its tiles and to its bound of the error.

    RUN.fhz promises a bound (--max-error, --max-error-rel) of every value, and ends with a whole
    layer of tiles. Its steps are copied and not coded again. It is replaced at the end, so that it
    is complete at every moment; Ctrl-C leaves it as it was.
    """
    from fhash_codec.appending.append import append

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
