"""`fhash bench ablate`: what each setting changes, one axis at a time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    BaseCommand,
    SourceOptions,
    check_writable,
    force_option,
    json_option,
    make_folder,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table

if TYPE_CHECKING:
    from fhash_codec.bench.ablate.results import AblateBench, Row


@click.command("ablate", cls=BaseCommand, short_help="what each setting changes, one at a time")
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option(
    "--axis",
    "names",
    metavar="NAME",
    multiple=True,
    help="Only this axis; repeat. Axes: encoding, network, key-frames, dilation, fringe, brick,"
    " batch, schedule, tables (profile paper), effort, tile, stages, stages-of-bound (compact).",
)
@click.option(
    "--epochs",
    type=click.IntRange(1, 100_000),
    default=10,
    show_default=True,
    help="Epochs of each training.",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, 100),
    default=1,
    show_default=True,
    help="Encodings of each variation; the table has medians.",
)
@setting_options("features", "psnr", "max_error", "device")
@click.option(
    "-o",
    "output",
    metavar="DIR",
    type=click.Path(),
    help="Keep a JSON file for each finished encoding; the same command goes on from there.",
)
@click.option("--plot", metavar="FILE.png", type=click.Path(), help="Draw a panel for each axis.")
@force_option
@json_option
@quiet_option
def ablate(
    data: str | None,
    source: SourceOptions,
    names: tuple[str, ...],
    epochs: int,
    seeds: int,
    settings: dict[str, Any],
    output: str | None,
    plot: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Encode DATA with one setting varied at a time: accuracy, bytes and seconds of each.

    Ratios and gains are over the default, marked with *. Without DATA: a made bubble of gas, in
    which the bubble is the feature.
    """
    from fhash_codec.bench.ablate.axes import axes_named
    from fhash_codec.devices import need_torch

    if any(axis.profile == "paper" for axis in axes_named(names)):
        need_torch("bench ablate")
    if plot is not None:
        from fhash_codec.cost.plot import require_matplotlib

        require_matplotlib()
        check_writable(plot, force, sources=[] if data is None else [data])
    if data is None:
        source.refuse_without_data()
    folder = None if output is None else make_folder(output)
    with Progress(quiet=quiet) as progress:
        from fhash_codec.bench.ablate.ablate import bench_ablate

        series = None if data is None else source.open(data, progress)
        result = bench_ablate(
            series,
            settings,
            names=names,
            epochs=epochs,
            seeds=seeds,
            folder=folder,
            progress=progress,
        )
    if plot is not None:
        from fhash_codec.bench.ablate.plot import plot as draw
        from fhash_formats.support.files import replacing

        with replacing(Path(plot), force=force) as temporary:
            draw(result, temporary)
    emit(result.to_dict(), _text(result), as_json)


def _text(result: AblateBench) -> str:
    """A table for each axis, and what was left out."""
    from fhash_codec.bench.ablate.axes import AXES

    why = {axis.name: axis.why for axis in AXES}
    references = {(run.axis, str(run.settings)) for run in result.runs if run.reference}
    lines = []
    for axis in dict.fromkeys(row.axis for row in result.rows):
        rows = [row for row in result.rows if row.axis == axis]
        lines += [
            f"{axis}: {why[axis]}",
            table(
                [
                    (
                        *("", "PSNR", "dB", "all values", "bytes", "x", "numbers"),
                        *("points M/s", "seconds", "x", "training"),
                    ),
                    *(_cells(row, (axis, str(row.settings)) in references) for row in rows),
                ]
            ),
            "",
        ]
    lines += [
        "PSNR: in the feature, over all steps, those that are not trained included;"
        " dB, x: beside the row marked *",
        "numbers: of the model; points: queries between vertices, per second of processors",
        f"{result.series}, {extent(result.shape)}, {', '.join(result.features)}",
        *(f"{profile}: {settings}" for profile, settings in result.common.items()),
        *(f"not measured: {reason}" for reason in result.left_out),
    ]
    return "\n".join(lines)


def _cells(row: Row, reference: bool) -> tuple[str, ...]:
    """A row of the table."""
    from fhash_codec.bench.ablate.ablate import told

    spread = "" if row.psnr_spread is None else f" (spread {row.psnr_spread:.1f})"
    return (
        told(row.settings) + (" *" if reference else ""),
        ("exact" if row.psnr is None else number(row.psnr)) + spread,
        "" if row.psnr_gain is None else f"{row.psnr_gain:+.1f}",
        number(row.psnr_domain),
        size(row.bytes),
        "" if row.bytes_ratio is None else number(row.bytes_ratio, digits=3),
        f"{row.parameters:,}",
        number(row.points_per_second / 1e6, digits=3),
        number(row.seconds, digits=3),
        "" if row.seconds_ratio is None else number(row.seconds_ratio, digits=3),
        "" if row.training_seconds is None else number(row.training_seconds, digits=3),
    )
