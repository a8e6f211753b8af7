"""`fhash verify`: reads every part of a container and compares it with its checksums."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import json_option, quiet_option, run_argument, variable_option
from fhash_cli.output import Progress, emit, one_line


@click.command("verify", cls=BaseCommand)
@run_argument
@variable_option
@json_option
@quiet_option
def command(run: str, variable: str | None, as_json: bool, quiet: bool) -> None:
    """Read and check every part of RUN.fhz; exit code 4 if it is damaged."""
    import fhash_codec

    with fhash_codec.open(run, variable=variable) as volume, Progress(quiet=quiet) as progress:
        arrays = volume.verify(progress=progress)
    emit(
        {"path": run, "sound": True, "arrays": arrays},
        f"{one_line(run)}: sound, {arrays} arrays checked",
        as_json,
    )
