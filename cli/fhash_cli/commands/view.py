"""`fhash view`: a container in the browser."""

from __future__ import annotations

import sys
import webbrowser

import click

from fhash_cli.options import BaseCommand, force_option, json_option
from fhash_cli.output import emit, one_line, say, size, table

PORT = 8643
"""Port unless another is asked for."""


@click.command("view", cls=BaseCommand)
@click.argument("runs", metavar="RUN.fhz...", nargs=-1, required=True, type=click.Path())
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=PORT,
    show_default=True,
    help="Port to listen at; 0 for any that is free.",
)
@click.option(
    "--static",
    "folder",
    metavar="DIR",
    type=click.Path(),
    help="Write page and containers into DIR, for any web server, and serve nothing.",
)
@click.option("--no-browser", is_flag=True, help="Open no browser.")
@force_option
@json_option
def command(
    runs: tuple[str, ...],
    port: int,
    folder: str | None,
    no_browser: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Show RUN.fhz in a browser: volume rendering, slices, time.

    A server of this machine alone gives the page and RUN.fhz, no other file, until Ctrl-C. The
    browser decodes, and reads only what it shows. docs/view.md says more.
    """
    from fhash_codec.views.page import Page
    from fhash_codec.views.server import Server

    page = Page(runs)
    if folder is not None:
        outputs = page.write(folder, force=force)
        written = sum(output.stat().st_size for output in outputs)
        rows = [
            ("written", f"{one_line(folder)}: {len(outputs)} files, {size(written)}"),
            ("to look at it", f"python -m http.server -d {one_line(folder)} serves it here"),
        ]
        report = {"folder": folder, "files": [str(output) for output in outputs], "bytes": written}
        emit(report, table(rows), as_json)
        return
    with Server(page, port=port, news=say) as server:
        emit(
            {"url": server.url, "files": list(page.runs)},
            f"{one_line(', '.join(page.runs))} at {server.url}\nCtrl-C ends it.",
            as_json,
        )
        if sys.stdout is not None:
            sys.stdout.flush()
        if not no_browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("stopped")
