"""Commands of `fhash bench`: click options, and results as text.

`fhash_bench.main` imports the commands. The work is imported on use, so that --help loads nothing
slow; nothing is measured here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import click

from fhash_cli.options import Command, TextType, check_writable


def one_of(name: str, allowed: Callable[[], Collection[str]]) -> TextType:
    """One of several names, which are looked up only when one is given."""

    def parsed(text: str) -> str:
        names = allowed()
        if text not in names:
            raise ValueError(f"'{text}' is no {name}; allowed: {', '.join(names)}")
        return text

    return TextType(name, parsed)


def plot_option(help: str) -> Callable[[Command], Command]:
    """The option `--plot`; the command gets it as `plot`."""
    return click.option("--plot", metavar="FILE.png", type=click.Path(), help=help)


def check_plot(plot: str | None, force: bool, sources: Sequence[str | None]) -> None:
    """Refuse a picture that cannot be drawn or written, before any work."""
    if plot is not None:
        from fhash_codec.cost.report import require_matplotlib

        require_matplotlib()
        check_writable(plot, force, sources=[source for source in sources if source is not None])


def save_plot(plot: str | None, force: bool, draw: Callable[[Path], None]) -> None:
    """Write the picture of `--plot`, if it is asked for; `draw` writes it at a path."""
    if plot is not None:
        from fhash_formats.support.files import replacing

        with replacing(Path(plot), force=force) as temporary:
            draw(temporary)
