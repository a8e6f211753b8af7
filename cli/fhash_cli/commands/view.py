"""Containers in the browser (`fhash view`), ParaView and HDF5's tools; completion of the shell."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any, TypedDict
from xml.sax.saxutils import quoteattr

import click
from click.shell_completion import get_completion_class

from fhash_cli.options import BaseCommand, force_option, json_option, variable_option
from fhash_cli.output import emit, one_line, say, size, table
from fhash_formats.errors import MissingDependencyError, OutputError
from fhash_formats.native import FOLDER
from fhash_formats.support.files import file_name

PORT = 8643
"""Port unless another is asked for."""
SHELLS = ("bash", "zsh", "fish")
"""Shells that click writes code for."""


class Shown(TypedDict):
    """Containers that a server shows; printed once, when it listens."""

    url: Annotated[str, "where the page is, with a slash at the end"]
    files: Annotated[list[str], "names of the containers"]


class Written(TypedDict):
    """The page and containers, written for another server."""

    folder: Annotated[str, "the folder written"]
    files: Annotated[list[str], "paths of all files written"]
    bytes: Annotated[int, "size of these files"]


@click.command(
    "view",
    cls=BaseCommand,
    epilog="fhash view run.fhz\nfhash view run.fhz --live\nfhash view run.fhz --static site",
)
@click.argument("runs", metavar="RUN.fhz...", nargs=-1, required=True, type=click.Path())
@click.option(
    "--port",
    metavar="N",
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
@click.option(
    "--live",
    is_flag=True,
    help="Draw here, on a GPU if there is one, and send pictures instead of RUN.fhz.",
)
@variable_option
@force_option
@json_option
def view_command(
    runs: tuple[str, ...],
    port: int,
    folder: str | None,
    no_browser: bool,
    live: bool,
    variable: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Show RUN.fhz in a browser: volume rendering, slices, time.

    A server of this machine alone gives the page and RUN.fhz, no other file, until Ctrl-C. The
    browser decodes, and reads only what it shows. With --live this machine decodes and draws.
    """
    from fhash_codec.views.page import Page

    if live:
        from fhash_codec.views.live import Live
        from fhash_codec.volume import open as open_volume

        if len(runs) > 1 or folder is not None or force:
            raise click.UsageError("--live shows one RUN.fhz, without --static and --force")
        with (
            open_volume(runs[0], variable=variable) as volume,
            closing(Live(volume)) as view,
        ):
            return _serve(view, [file_name(runs[0])], port, no_browser, as_json)
    if variable is not None:
        raise click.UsageError("--var is of --live: give --live too")
    page = Page(runs)
    if folder is not None:
        outputs = page.write(folder, force=force)
        written = sum(output.stat().st_size for output in outputs)
        rows = [
            ("written", f"{one_line(folder)}: {len(outputs)} files, {size(written)}"),
            ("to look at it", f"python -m http.server -d {one_line(folder)} serves it here"),
        ]
        files = [str(output) for output in outputs]
        report: Written = {"folder": folder, "files": files, "bytes": written}
        return emit(report, table(rows), as_json)
    return _serve(page, list(page.runs), port, no_browser, as_json)


def _serve(view: Any, names: list[str], port: int, no_browser: bool, as_json: bool) -> None:
    """Serve a `Page` or `Live` of containers with these names until Ctrl-C."""
    from fhash_codec.views.server import Server

    with Server(view, port=port, news=say) as server:
        shown: Shown = {"url": server.url, "files": names}
        emit(shown, f"{one_line(', '.join(names))} at {server.url}\nCtrl-C ends it.", as_json)
        if sys.stdout is not None:
            sys.stdout.flush()
        if not no_browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("stopped")


_GETARGSPEC = """import inspect
if not hasattr(inspect, "getargspec"):
    inspect.getargspec = inspect.getfullargspec
"""
"""Python module that gives ParaView 5.11 what Python 3.11 no longer has: it loads no plugin of
Python without it."""


def _print(*lines: object) -> None:
    if sys.stdout is None:
        raise OutputError("the path cannot be printed, stdout is closed")
    for line in lines:
        click.echo(line)


@click.command(
    "hdf5-plugin-path",
    cls=BaseCommand,
    epilog="export HDF5_PLUGIN_PATH=$(fhash hdf5-plugin-path)",
)
def hdf5_plugin_path_command() -> None:
    """Print the folder of the filter for HDF5, which programs look for in HDF5_PLUGIN_PATH.

    \b
    export HDF5_PLUGIN_PATH=$(fhash hdf5-plugin-path)
    h5dump run.h5
    """
    _print(FOLDER)


@click.command("paraview", cls=BaseCommand, epilog="fhash paraview run.fhz")
@click.argument("files", metavar="[FILE]...", nargs=-1, type=click.Path(path_type=Path))
def paraview_command(files: tuple[Path, ...]) -> None:
    """Start ParaView with its reader of .fhz files and with FILEs; or print the reader's path.

    Without FILEs nothing is started. Load the path by Tools > Manage Plugins > Load New, or in
    pvpython by LoadPlugin. A copy of the file elsewhere needs the variable FHASH_LIBRARY, which is
    printed, too.
    """
    from fhash_codec import paraview_reader

    plugin = Path(paraview_reader.__file__)
    if not files:
        _print(plugin, f"FHASH_LIBRARY={FOLDER / 'libfhash.so'}")
        return
    program = shutil.which("paraview")
    if program is None:
        raise MissingDependencyError("there is no program paraview; install ParaView 5.11 or newer")
    with tempfile.TemporaryDirectory(prefix="fhash-paraview-") as folder:
        plugins = Path(folder, "plugins.xml")
        plugins.write_text(
            f'<Plugins><Plugin name="{plugin.stem}" filename={quoteattr(str(plugin))}'
            ' auto_load="1"/></Plugins>',
            encoding="utf-8",
        )
        Path(folder, "sitecustomize.py").write_text(_GETARGSPEC, encoding="utf-8")
        paths = [folder, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {
            **os.environ,
            "PV_PLUGIN_CONFIG_FILE": str(plugins),
            "PYTHONPATH": os.pathsep.join(paths),
        }
        sys.exit(subprocess.run([program, *map(str, files)], env=environment).returncode)


@click.command("completion", cls=BaseCommand, epilog='eval "$(fhash completion bash)"')
@click.argument("shell", metavar="SHELL", type=click.Choice(SHELLS))
@click.pass_context
def completion_command(context: click.Context, shell: str) -> None:
    """Print code for SHELL that completes commands, options and file names on Tab.

    \b
    Put into the start-up file of the shell:
      bash   eval "$(fhash completion bash)"
      zsh    eval "$(fhash completion zsh)"
      fish   fhash completion fish | source
    """
    kind = get_completion_class(shell)
    if kind is None:
        raise click.UsageError(f"click writes no completion for {shell}")
    if sys.stdout is None:
        raise OutputError("the code cannot be printed, stdout is closed")
    program = context.find_root()
    code = kind(program.command, {}, "fhash", "_FHASH_COMPLETE").source()
    click.echo(code)
