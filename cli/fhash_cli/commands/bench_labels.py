"""`fhash bench labels`: sizes of labels without loss, beside xz."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    BaseCommand,
    SourceOptions,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, table

if TYPE_CHECKING:
    from fhash_codec.bench.labels import LabelBench


@click.command("labels", cls=BaseCommand, short_help="sizes of labels without loss, beside xz")
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option(
    "--kind",
    "kinds",
    metavar="NAME",
    multiple=True,
    help="A made series, such as basins; repeat. Default: all.",
)
@setting_options("effort")
@json_option
@quiet_option
def labels(
    data: str | None,
    source: SourceOptions,
    kinds: tuple[str, ...],
    settings: dict[str, Any],
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare the bytes of labels in a container with those of xz -9e, all without loss.

    Without DATA: made series of many kinds, from connected regions to random numbers. The worst
    ratio stands first; below 1, fhash is smaller. DATA is held in memory.
    """
    with Progress(quiet=quiet) as progress:
        from fhash_codec.bench.labels import bench_labels

        effort = settings.get("effort")
        if data is None:
            result = bench_labels(kinds=kinds, effort=effort, progress=progress)
        else:
            with source.open(data, progress) as series:
                result = bench_labels(series, kinds=kinds, effort=effort, progress=progress)
    emit(result.to_dict(), _text(result), as_json)


def _text(result: LabelBench) -> str:
    """A row of figures for each series, and how they were measured."""
    header = ("labels", "array", "values", "xz -9e", "fhash", "fhash / xz", "codec", "seconds")
    rows = [
        (
            size.kind,
            f"{size.dtype} {extent(size.shape)}",
            f"{size.distinct:,}",
            f"{size.xz_bytes:,}",
            f"{size.fhash_bytes:,}",
            f"{size.ratio:.3f}",
            f"{size.codec_bytes:,}",
            number(size.seconds, digits=2),
        )
        for size in result.sizes
    ]
    return "\n".join([table([header, *rows]), "", *result.notes])
