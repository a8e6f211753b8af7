"""`fhash pack`: the coded arrays of a Zarr store become a container, without coding again."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import SelectType, force_option, json_option, quiet_option
from fhash_cli.output import Progress, emit, extent, factor, size, table
from fhash_formats.errors import InputError

ALL = "all"
"""Value of `--var` that stands for every variable."""


@click.command("pack", cls=BaseCommand)
@click.argument("data", metavar="RUN.zarr", type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.fhz", required=True, type=click.Path(), help="Where to write."
)
@click.option(
    "--var",
    metavar="NAME,...",
    help="Only these variables; by default all, each of which must be coded by fhash.transform.",
)
@click.option(
    "--select",
    multiple=True,
    type=SelectType(),
    help="One index along a dimension that is none of t, z, y and x, such as member=2.",
)
@click.option("--axes", metavar="t,z,y,x", help="Which axis each dimension is, in their order.")
@click.option(
    "--absent",
    type=click.Choice(["refuse", "fill"]),
    default="refuse",
    show_default=True,
    help="Chunks that the store lacks: refuse those whose fill value marks no missing value, or "
    "take the fill value for them.",
)
@force_option
@json_option
@quiet_option
def command(
    data: str,
    output: str,
    var: str | None,
    select: tuple[tuple[str, str], ...],
    axes: str | None,
    absent: str,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Put the arrays of a Zarr store that the codec fhash.transform wrote into RUN.fhz.

    The coded chunks are copied, so that RUN.fhz decodes to the very values of the store. Each is
    decoded once, to check it and for the range of the values. What only the original data could
    tell, such as the PSNR, is not in the file.
    """
    import fhash_codec
    from fhash_formats.readers.common.request import parse_axes

    names = None if var is None or var == ALL else [name.strip() for name in var.split(",")]
    if names is not None and len(set(names)) < len(names):
        raise InputError(f"--var {var} has a name twice")
    with Progress(quiet=quiet) as progress:
        report = fhash_codec.pack(
            data,
            output,
            variables=names,
            axes=None if axes is None else parse_axes(axes),
            select=dict(select),
            absent=absent,
            force=force,
            progress=progress,
        )
    rows = [
        ("written", output),
        ("size", f"{size(report['bytes'])}, {factor(report['ratio'])} smaller than the values"),
        ("the store", size(report["source_bytes"] or 0)),
    ]
    for name, each in report["variables"].items():
        told = f"{extent(each['shape'])} in {each['tiles']} tiles of {extent(each['tile'])}"
        lacks = f", {each['absent']} not in the store" if each["absent"] else ""
        codec = each["codec"]
        bound = f"; error within {codec['max_error']:g}" if "max_error" in codec else ""
        rows.append((name, told + lacks + bound))
    emit(report, table(rows), as_json)
