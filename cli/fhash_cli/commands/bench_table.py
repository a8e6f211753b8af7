"""`fhash bench table`: fhash beside its best peer on many series, as one table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from fhash_cli.options import (
    BaseCommand,
    SourceOptions,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit
from fhash_cli.peer_options import (
    Peer,
    filters_of,
    opened,
    peer_option,
    programs_of,
    quality_options,
)


@click.command(
    "table", cls=BaseCommand, short_help="bench rate on many series, as one table; goes on"
)
@click.argument("data", type=click.Path(), nargs=-1)
@series_options
@click.option(
    "--generated", "with_generated", is_flag=True, help="Add every generated series to DATA."
)
@quality_options
@peer_option
@click.option(
    "--speed/--no-speed",
    default=True,
    show_default=True,
    help="Measure speed and access too, of every codec at every quality.",
)
@setting_options("effort", "tile", "seed")
@click.option(
    "-o",
    "folder",
    metavar="DIR",
    type=click.Path(file_okay=False),
    default="bench-table",
    show_default=True,
    help="Folder of the cells, one JSON file each; finished cells are not measured again.",
)
@json_option
@quiet_option
def rate_table(
    data: tuple[str, ...],
    source: SourceOptions,
    with_generated: bool,
    targets: tuple[float, ...],
    bounds: tuple[float, ...],
    peers: tuple[Peer, ...],
    speed: bool,
    settings: dict[str, Any],
    folder: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare the profile compact with other codecs on each DATA; the table is in Markdown.

    Without --target and --bound: 35, 45 and 60 dB, and bounds of 5, 1 and 0.1 % of the range. A row
    has the bytes, those of one tile, the best peer in its best layout, and speed and access of
    both. DATA may be generated:KIND: plateau, noise, labels, smooth, thin, long or short.
    """
    if not data and not with_generated:
        raise click.UsageError("Missing DATA; or give --generated")
    with Progress(quiet=quiet) as progress:
        from fhash_codec.bench.rate.generated import GENERATED, PREFIX, is_generated
        from fhash_codec.bench.rate.table import BOUNDS, TARGETS, bench_table

        if all(is_generated(name) for name in data):
            source.refuse_without_data()
        names = [*data, *(PREFIX + kind for kind in GENERATED if with_generated)]
        every = not (targets or bounds)
        result = bench_table(
            {
                name: partial(opened, name, None if is_generated(name) else source, progress)
                for name in names
            },
            Path(folder),
            settings,
            targets=TARGETS if every else targets,
            bounds=BOUNDS if every else bounds,
            names=filters_of(peers),
            named=programs_of(peers),
            speed=speed,
            progress=progress,
        )
    emit(result.to_dict(), result.markdown(), as_json)
