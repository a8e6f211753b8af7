"""`fhash completion`: shell code that completes commands, options and file names on Tab."""

from __future__ import annotations

import sys

import click
from click.shell_completion import get_completion_class

from fhash_cli.options import BaseCommand
from fhash_formats.errors import OutputError

SHELLS = ("bash", "zsh", "fish")
"""Shells that click writes code for."""


@click.command("completion", cls=BaseCommand, epilog='eval "$(fhash completion bash)"')
@click.argument("shell", metavar="SHELL", type=click.Choice(SHELLS))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
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
