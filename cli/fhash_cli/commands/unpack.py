"""`fhash unpack`: a container becomes a Zarr store of the same coded chunks."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import force_option, json_option, quiet_option, run_argument
from fhash_cli.output import Progress, emit, size, table


@click.command("unpack", cls=BaseCommand)
@run_argument
@click.option(
    "-o", "output", metavar="RUN.zarr", required=True, type=click.Path(), help="Where to write."
)
@click.option("--var", metavar="NAME,...", help="Only these variables; by default all.")
@force_option
@json_option
@quiet_option
def command(
    run: str, output: str, var: str | None, force: bool, as_json: bool, quiet: bool
) -> None:
    """Put the tiles of RUN.fhz into a Zarr store (format 3, a folder) as they are coded.

    `xarray.open_zarr` and zarr read it where fhash is installed, with coordinates and attributes,
    and decode the very values of RUN.fhz. Files whose tiles alone are not the values, such as those
    of features, are refused; `fhash decode RUN.fhz -o RUN.zarr` writes decoded values.
    """
    import fhash_codec

    names = None if var is None else [name.strip() for name in var.split(",")]
    with Progress(quiet=quiet) as progress:
        report = fhash_codec.unpack(run, output, variables=names, force=force, progress=progress)
    rows = [("written", output), ("size", size(report["bytes"]))]
    rows += [(name, f"{each['tiles']} chunks") for name, each in report["variables"].items()]
    emit(report, table(rows), as_json)
