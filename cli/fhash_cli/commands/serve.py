"""`fhash serve`: gives the decoded values of a container over HTTP, as a Zarr v3 hierarchy."""

from __future__ import annotations

import sys

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import json_option, run_argument
from fhash_cli.output import emit, one_line, say

PORT = 8642
"""Port unless another is asked for."""


@click.command("serve", cls=BaseCommand)
@run_argument
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=PORT,
    show_default=True,
    help="Port to listen at; 0 for any that is free.",
)
@click.option(
    "--host",
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
def command(run: str, port: int, host: str, origins: tuple[str, ...], as_json: bool) -> None:
    """Give decoded values of RUN.fhz over HTTP until Ctrl-C.

    Clients see a Zarr v3 hierarchy without any codec of fhash: the values over the whole domain,
    coordinates, and levels of detail. Only the chunks that a client reads are decoded. Web pages
    may read it where --origin names theirs. docs/zarr.md shows xarray, tensorstore, zarrita and
    neuroglancer.
    """
    from fhash_codec.zarr_view.server import Server
    from fhash_codec.zarr_view.view import opened_view

    volume, view = opened_view(run)
    with volume, Server(view, host=host, port=port, origins=origins, news=say) as server:
        arrays = list(view.names.values())
        emit(
            {"path": run, "url": server.url, "arrays": arrays},
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
