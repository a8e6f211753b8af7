"""The commands `fhash bench train` and `fhash bench ablate`: options, and results as text."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fhash_bench.commands import check_plot, plot_option, save_plot
from fhash_cli.options import (
    BaseCommand,
    RealRange,
    SourceOptions,
    TextType,
    config_options,
    force_option,
    json_option,
    make_folder,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table

if TYPE_CHECKING:
    from fhash_bench.ablate import AblateBench, Row
    from fhash_bench.train import PointRate, TrainBench
    from fhash_codec.config import EncodeConfig


def _engines_named(text: str) -> tuple[str, ...]:
    from fhash_codec.paper.engines import ENGINES

    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in ENGINES:
            raise ValueError(
                f"'{name}' is no engine; allowed, separated by commas: {', '.join(ENGINES)}"
            )
    return names


ENGINES = TextType("A,B", _engines_named)
"""Names of engines, separated by commas."""


def _numbers_of_bricks(text: str) -> tuple[int, ...]:
    words = [word.strip() for word in text.split(",")]
    for word in words:
        if not (word.isascii() and word.isdigit() and int(word) > 0):
            raise ValueError(f"'{word}' is no number of bricks; such as 64,256")
    return tuple(map(int, words))


BRICKS = TextType("N,M", _numbers_of_bricks)
"""Numbers of bricks, separated by commas."""


@click.command(
    "train",
    cls=BaseCommand,
    short_help="training and inference speed of each engine",
    epilog="fhash bench train demo/vortex.h5 --seconds 2",
)
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option("--engines", type=ENGINES, help="Which to measure. Default: all there are.")
@click.option(
    "--seconds",
    type=RealRange(0.1, 3600),
    default=12.0,
    show_default=True,
    metavar="X",
    help="Training of each engine: seconds of processors; on a GPU, seconds that pass.",
)
@click.option(
    "--bricks-per-step",
    "bricks",
    type=BRICKS,
    help="Bricks of a training step, each measured, such as 64,256; without it, --batch.",
)
@click.option(
    "--whole/--no-whole",
    default=True,
    help="With a feature, measure the whole DATA too, or the feature alone.",
)
@config_options(
    "features",
    "dilation",
    "key_frames",
    "embedding_size",
    "hidden_layers",
    "width",
    "learning_rate",
    "batch",
    "device",
    "seed",
    preset="published",
)
@plot_option("Draw PSNR over seconds.")
@force_option
@json_option
@quiet_option
def train(
    data: str | None,
    source: SourceOptions,
    engines: tuple[str, ...] | None,
    seconds: float,
    bricks: tuple[int, ...] | None,
    whole: bool,
    config: EncodeConfig,
    plot: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Train the model of DATA with each engine in turns; speeds in million samples a second.

    With a feature, the whole DATA is measured too, since bricks around a feature are partly empty.
    Without DATA: a made series, a blast's shell as a feature, and whole. DATA generated:argon is
    a made series of the size of the paper's Argon box.

    Speeds are per second of processors (CPU), the work of all threads together. "of peak" is the
    arithmetic of the network alone over that of the processor's multiply-adds, measured in the same
    run and by the same clock.
    """
    from fhash_codec.devices import need_torch

    need_torch("bench train")
    check_plot(plot, force, [data])
    with Progress(quiet=quiet) as progress, ExitStack() as stack:
        from fhash_bench.rate.generated import is_made
        from fhash_bench.train import bench_train
        from fhash_bench.train import plot as draw

        if data is None or is_made(data):
            source.refuse_without_data()
            series: Any = data
        else:
            series = stack.enter_context(source.open(data, progress))
        result = bench_train(
            series,
            config,
            engines=engines or (),
            seconds=seconds,
            bricks=bricks or (),
            whole=whole,
            progress=progress,
        )
    save_plot(plot, force, partial(draw, result))
    emit(result, _train_text(result), as_json)


def _train_text(result: TrainBench) -> str:
    """A table for each entry, its facts and points, what the machine can do, and the machine."""
    lines = []
    for entry in result["series"]:
        lines += [
            f"{', '.join(entry['features'])}: {entry['samples']:,} samples in bricks"
            f" {entry['brick_fill']:.0%} full, {entry['batch_bricks']:.0f} bricks a step;"
            f" model {size(entry['float16_bytes'])} as float16",
            _engines(entry["engines"]),
            *_threads(entry["engines"]),
            _points(entry["points"]),
            f"decoding {number(entry['decode_msamples_s'], digits=3)} M/s,"
            f" {number(entry['decode_ratio'], digits=3)} times as fast as the whole box",
            "",
        ]
    for peak in result["peaks"]:
        rate = (
            f"{number(peak['gb_s'], digits=3)} GB/s"
            if peak["gflops"] is None
            else f"{number(peak['gflops'], digits=3)} GFLOP/s {peak['precision']}"
        )
        lines.append(" ".join(filter(None, [peak["what"], peak["path"], rate])))
    facts = {
        name.replace("_", " "): number(fact) if isinstance(fact, float) else fact
        for name, fact in result["machine"].items()
    }
    return "\n".join([*lines, ", ".join(f"{name} {fact}" for name, fact in facts.items())])


def _engines(runs: list[dict[str, Any]]) -> str:
    """A row for each engine; seconds to a quality are those of processors."""
    goals = [goal["psnr"] for goal in runs[0]["seconds_to"]]
    header = (
        *("engine", "threads", "train M/s", "per CPU s", "of peak"),
        *("infer per CPU s", "of peak", "PSNR dB"),
        *(f"CPU s to {goal:g} dB" for goal in goals),
    )
    figures = (
        *("train_msamples_s", "train_msamples_cpu_s", "fraction_of_peak"),
        *("infer_msamples_cpu_s", "infer_fraction_of_peak", "psnr"),
    )
    rows = [
        (
            " ".join(filter(None, [run["engine"], run["path"]])),
            str(run["threads"]),
            *(number(run[name], digits=3) for name in figures),
            *(number(goal["cpu_seconds"], digits=3) for goal in run["seconds_to"]),
        )
        for run in runs
    ]
    return table([header, *rows])


def _threads(runs: list[dict[str, Any]]) -> list[str]:
    """A line with the rates of several threads over one, by time that passed; none without."""
    ratios = [
        f"{run['engine']} {number(run['thread_ratio'], digits=3)}"
        for run in runs
        if run["thread_ratio"] is not None
    ]
    count = max(run["threads"] for run in runs)
    return [f"{count} threads over one, time that passed: {', '.join(ratios)}"] if ratios else []


def _points(points: list[PointRate]) -> str:
    """The rates of queries at points in one thread."""
    rates = [
        f"{point['order']}{' with gradient' * point['gradient']}"
        f" {number(point['mpoints_cpu_s'], digits=3)}"
        for point in points
        if point["threads"] == points[0]["threads"]
    ]
    return f"points, M per CPU s: {', '.join(rates)}"


@click.command(
    "ablate",
    cls=BaseCommand,
    short_help="what each setting changes, one at a time",
    epilog="fhash bench ablate demo/vortex.h5 --axis tile",
)
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option(
    "--axis",
    "names",
    metavar="NAME",
    multiple=True,
    help="Only this axis; repeat. Axes: encoding, network, key-frames, dilation, fringe, brick,"
    " batch, schedule, tables (preset published), effort, tile, stages, stages-of-bound (default).",
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
@plot_option("Draw a panel for each axis.")
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
    from fhash_bench.ablate import axes_named
    from fhash_codec.devices import need_torch

    if any(axis.preset == "published" for axis in axes_named(names)):
        need_torch("bench ablate")
    check_plot(plot, force, [data])
    if data is None:
        source.refuse_without_data()
    folder = None if output is None else make_folder(output)
    with Progress(quiet=quiet) as progress:
        from fhash_bench.ablate import bench_ablate
        from fhash_bench.ablate import plot as draw

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
    save_plot(plot, force, partial(draw, result))
    emit(result.to_dict(), _ablate_text(result), as_json)


def _ablate_text(result: AblateBench) -> str:
    """A table for each axis, and what was left out."""
    from fhash_bench.ablate import AXES

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
        *(f"{preset}: {settings}" for preset, settings in result.common.items()),
        *(f"not measured: {reason}" for reason in result.left_out),
    ]
    return "\n".join(lines)


def _cells(row: Row, reference: bool) -> tuple[str, ...]:
    """A row of the table."""
    from fhash_bench.ablate import as_options

    spread = "" if row.psnr_spread is None else f" (spread {row.psnr_spread:.1f})"
    return (
        as_options(row.settings) + (" *" if reference else ""),
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
