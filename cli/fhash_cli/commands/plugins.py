"""`fhash hdf5-plugin-path` and `fhash paraview`: plugins of this package for other programs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

import click

from fhash_cli.options import BaseCommand
from fhash_formats.errors import MissingDependencyError, OutputError
from fhash_formats.native import FOLDER

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


@click.command("hdf5-plugin-path", cls=BaseCommand)
def hdf5_plugin_path_command() -> None:
    """Print the folder of the filter for HDF5, which programs look for in HDF5_PLUGIN_PATH.

    \b
    export HDF5_PLUGIN_PATH=$(fhash hdf5-plugin-path)
    h5dump run.h5
    """
    _print(FOLDER)


@click.command("paraview", cls=BaseCommand)
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
