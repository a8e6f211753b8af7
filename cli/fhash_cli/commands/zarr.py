"""`fhash pack`, `unpack`, `export`, `serve`: a container from and as arrays of Zarr."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, TypedDict

import click

from fhash_cli.options import (
    SELECT,
    BaseCommand,
    check_writable,
    force_option,
    json_option,
    option_group,
    quiet_option,
    run_argument,
)
from fhash_cli.output import Progress, emit, extent, factor, one_line, say, size, table
from fhash_formats.errors import InputError

ALL = "all"
"""Value of `--var` that stands for every variable."""


@dataclass(frozen=True, kw_only=True)
class PackOptions:
    """Options of `fhash pack` about the arrays of the store."""

    var: str | None
    select: tuple[tuple[str, str], ...]
    axes: str | None
    absent: str


@click.command(
    "pack",
    cls=BaseCommand,
    epilog="fhash unpack run.fhz -o coded.zarr\nfhash pack coded.zarr -o again.fhz",
)
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
    type=SELECT,
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
@option_group(PackOptions, "chosen")
def pack_command(
    data: str, output: str, chosen: PackOptions, force: bool, as_json: bool, quiet: bool
) -> None:
    """Put the arrays of a Zarr store that the codec fhash.transform wrote into RUN.fhz.

    The coded chunks are copied, so that RUN.fhz decodes to the very values of the store. Each is
    decoded once, to check it and for the range of the values. What only the original data could
    tell, such as the PSNR, is not in the file.
    """
    import fhash_codec
    from fhash_formats.readers.file_series import parse_axes

    var, axes = chosen.var, chosen.axes
    names = None if var is None or var == ALL else [name.strip() for name in var.split(",")]
    if names is not None and len(set(names)) < len(names):
        raise InputError(f"--var {var} has a name twice")
    with Progress(quiet=quiet) as progress:
        report = fhash_codec.pack(
            data,
            output,
            variables=names,
            axes=None if axes is None else parse_axes(axes),
            select=dict(chosen.select),
            absent=chosen.absent,
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


@click.command("unpack", cls=BaseCommand, epilog="fhash unpack run.fhz -o run.zarr")
@run_argument
@click.option(
    "-o", "output", metavar="RUN.zarr", required=True, type=click.Path(), help="Where to write."
)
@click.option("--var", metavar="NAME,...", help="Only these variables; by default all.")
@force_option
@json_option
@quiet_option
def unpack_command(
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


@click.command("export", cls=BaseCommand, epilog="fhash export run.fhz -o plain.fhz --plain")
@run_argument
@click.option(
    "-o", "output", metavar="PLAIN.fhz", required=True, type=click.Path(), help="Where to write."
)
@click.option(
    "--plain",
    is_flag=True,
    help="Standard codecs of Zarr v3 alone: any Zarr library reads every number.",
)
@force_option
@json_option
@quiet_option
def export_command(
    run: str, output: str, plain: bool, force: bool, as_json: bool, quiet: bool
) -> None:
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


PORT = 8642
"""Port unless another is asked for."""


class Served(TypedDict):
    """A file that is served; printed once, when the server listens."""

    path: Annotated[str, "the file served"]
    url: Annotated[str, "where, with a slash at the end and the port that `--port 0` found"]
    arrays: Annotated[list[str], "names of the arrays of values, one for each variable"]


@click.command("serve", cls=BaseCommand, epilog="fhash serve run.fhz --port 8642")
@run_argument
@click.option(
    "--port",
    metavar="N",
    type=click.IntRange(0, 65535),
    default=PORT,
    show_default=True,
    help="Port to listen at; 0 for any that is free.",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at. The default is this machine alone; 0.0.0.0 is every address of it,"
    " so that whoever reaches it may read RUN.fhz.",
)
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="ORIGIN",
    help="Web pages that may read it, such as https://neuroglancer-demo.appspot.com; may be"
    " repeated. * is every page. Default: none.",
)
@json_option
def serve_command(run: str, port: int, host: str, origins: tuple[str, ...], as_json: bool) -> None:
    """Give decoded values of RUN.fhz over HTTP until Ctrl-C.

    Clients see a Zarr v3 hierarchy without any codec of fhash: the values over the whole domain,
    coordinates, and levels of detail. Only the chunks that a client reads are decoded. Web pages
    may read it where --origin names theirs.
    """
    from fhash_codec.views.server import Server
    from fhash_codec.views.view import opened_view

    volume, view = opened_view(run)
    with volume, Server(view, host=host, port=port, origins=origins, news=say) as server:
        arrays = list(view.names.values())
        served: Served = {"path": run, "url": server.url, "arrays": arrays}
        emit(
            served,
            f"{one_line(run)}: {one_line(', '.join(arrays))} at {server.url}\n"
            f'  xarray.open_zarr("{server.url}")\nCtrl-C ends it.',
            as_json,
        )
        if sys.stdout is not None:
            sys.stdout.flush()
        if not server.is_local:
            say(
                f"warning: every machine that reaches {host}:{server.server_address[1]} can read it"
            )
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("stopped")
