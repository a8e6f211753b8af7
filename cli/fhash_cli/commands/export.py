"""`fhash export`: writes the model of a container in plain numbers for other libraries."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import (
    check_writable,
    force_option,
    json_option,
    quiet_option,
    run_argument,
)
from fhash_cli.output import Progress, emit, factor, size, table


@click.command("export", cls=BaseCommand)
@run_argument
@click.option("-o", "output", metavar="PLAIN.fhz", required=True, type=click.Path())
@click.option(
    "--plain",
    is_flag=True,
    help="Standard codecs of Zarr v3 alone: any Zarr library reads every number.",
)
@force_option
@json_option
@quiet_option
def command(run: str, output: str, plain: bool, force: bool, as_json: bool, quiet: bool) -> None:
    """Write the model of RUN.fhz in plain numbers: tables, network, occupancy, corrections.

    The new file is a container too: every command of fhash reads it. It is larger, since nothing
    in it is coded but by zstd. FORMAT.md, Plain files, says how values follow from the numbers.
    """
    if not plain:
        raise click.UsageError("say how to export: --plain is the one way")
    import fhash_codec

    check_writable(output, force, sources=[run])
    with Progress(quiet=quiet) as progress:
        report = fhash_codec.export_plain(run, output, force=force, progress=progress)
    rows = [
        ("written", report["path"]),
        (
            "size",
            f"{size(report['bytes'])}, {factor(report['bytes'] / report['source_bytes'])} of"
            f" {run} ({size(report['source_bytes'])})",
        ),
        ("numbers", f"{report['values']:,} in {report['arrays']} arrays"),
    ]
    emit(report, table(rows), as_json)
