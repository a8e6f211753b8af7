"""`fhash bench`: measures speed and size on this machine, beside other codecs and engines."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseGroup
from fhash_cli.commands.bench_ablate import ablate
from fhash_cli.commands.bench_labels import labels
from fhash_cli.commands.bench_paper import paper
from fhash_cli.commands.bench_render import render
from fhash_cli.options import (
    RealRange,
    SourceOptions,
    check_writable,
    config_options,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table

if TYPE_CHECKING:
    from fhash_codec.bench.rate.results import RateBench
    from fhash_codec.config import EncodeConfig


class EnginesType(click.ParamType[tuple[str, ...]]):
    """Names of engines, separated by commas."""

    name = "A,B"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """The names; refuses one that is unknown."""
        from fhash_codec.config import ENGINES

        names = tuple(name.strip() for name in str(value).split(","))
        for name in names:
            if name not in ENGINES:
                self.fail(
                    f"'{name}' is no engine; allowed, separated by commas: {', '.join(ENGINES)}",
                    param,
                    ctx,
                )
        return names


class NamesType(click.ParamType[str]):
    """One of the names of a bench, or 'none'.

    Names are looked up only when one is given, so that --help loads nothing.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; refuses one that is unknown."""
        from fhash_codec.bench.rate.results import PEERS
        from fhash_codec.config import EncodeConfig

        profiles = next(
            field for field in dataclasses.fields(EncodeConfig) if field.name == "profile"
        ).metadata["choices"]
        allowed = (*(PEERS if self.name == "peer" else profiles), "none")
        if value not in allowed:
            self.fail(f"'{value}' is no {self.name}; allowed: {', '.join(allowed)}", param, ctx)
        return str(value)


@click.group("bench", cls=BaseGroup, short_help="measure speed and size on this machine")
def command() -> None:
    """Measure speed and size on this machine."""


command.add_command(ablate)
command.add_command(labels)
command.add_command(paper)
command.add_command(render)


@command.command("train", short_help="training and inference speed of each engine")
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option("--engines", type=EnginesType(), help="Which to measure. Default: all there are.")
@click.option(
    "--seconds",
    type=RealRange(0.1, 3600),
    default=12.0,
    show_default=True,
    metavar="X",
    help="Training of each engine.",
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
    profile="paper",
)
@json_option
@quiet_option
def train(
    data: str | None,
    source: SourceOptions,
    engines: tuple[str, ...] | None,
    seconds: float,
    config: EncodeConfig,
    as_json: bool,
    quiet: bool,
) -> None:
    """Train the model of DATA with each engine in turns; speeds in million samples a second.

    With a feature, the whole DATA is measured too: bricks around a feature are partly empty.
    Without DATA: a made series, a blast's shell as a feature, and whole. "of peak" is the
    arithmetic of the network over the rate of a large matrix product, measured in the same run.
    """
    from fhash_codec.config import ENGINES
    from fhash_codec.training.devices import need_torch

    need_torch("bench train")
    if data is None:
        source.refuse_without_data()
    with Progress(quiet=quiet) as progress, ExitStack() as stack:
        from fhash_codec.bench.train import bench_train

        series = None if data is None else stack.enter_context(source.open(data, progress))
        result = bench_train(
            series, config, engines=engines or ENGINES, seconds=seconds, progress=progress
        )
    emit(result, _text(result), as_json)


def _text(result: dict[str, Any]) -> str:
    """A row of figures for each engine on each series, how full bricks are, and the machine."""
    header = (
        "features",
        "engine",
        "train M/s",
        "x naive",
        "infer M/s",
        "x naive",
        "of peak",
        "epochs",
        "PSNR dB",
    )
    figures = (
        "train_msamples_s",
        "train_ratio",
        "infer_msamples_s",
        "infer_ratio",
        "fraction_of_peak",
        "epochs",
        "psnr",
    )
    rows = [
        (
            ", ".join(entry["features"]),
            run["engine"],
            *(number(run[name], digits=3) for name in figures),
        )
        for entry in result["series"]
        for run in entry["engines"]
    ]
    facts = {
        name.replace("_", " "): number(fact) if isinstance(fact, float) else fact
        for name, fact in result["machine"].items()
    }
    lines = [
        f"{', '.join(entry['features'])}: {entry['samples']:,} samples in bricks"
        f" {entry['brick_fill']:.0%} full; decoding"
        f" {number(entry['decode_msamples_s'], digits=3)} M/s,"
        f" {number(entry['decode_ratio'], digits=3)} times as fast as by whole blocks"
        for entry in result["series"]
    ]
    machine = ", ".join(f"{name} {fact}" for name, fact in facts.items())
    return "\n".join([table([header, *rows]), *lines, machine])


@command.command("rate", short_help="size, speed and access beside other codecs, at equal quality")
@click.argument("data", type=click.Path())
@series_options
@click.option(
    "--target",
    "targets",
    type=RealRange(5, 200),
    multiple=True,
    metavar="X",
    help="PSNR over all frames in dB; repeat.",
)
@click.option(
    "--bound",
    "bounds",
    type=RealRange(1e-9, 0.5),
    multiple=True,
    metavar="X",
    help="Largest error as a share of the range; repeat.",
)
@click.option(
    "--peer",
    "names",
    type=NamesType("peer"),
    multiple=True,
    help="SZ3, SPERR, ZFP, BitRound, Blosc or none; repeat. Default: all.",
)
@click.option(
    "--profile",
    "profiles",
    type=NamesType("profile"),
    multiple=True,
    help="Of fhash, or none; repeat. Default: all.",
)
@click.option(
    "--speed/--no-speed",
    default=True,
    show_default=True,
    help="Measure speed and access too, at the target nearest to 50 dB.",
)
@setting_options("effort", "tile", "epochs", "width", "device", "seed")
@click.option("--plot", metavar="FILE.png", type=click.Path(), help="Draw bytes against quality.")
@force_option
@json_option
@quiet_option
def rate(
    data: str,
    source: SourceOptions,
    targets: tuple[float, ...],
    bounds: tuple[float, ...],
    names: tuple[str, ...],
    profiles: tuple[str, ...],
    speed: bool,
    settings: dict[str, Any],
    plot: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare fhash with other codecs: bytes that DATA needs at equal quality, and speed.

    Without --target and --bound: 35, 40, 45, 50 and 60 dB, and bounds of 5, 2, 1, 0.5 and 0.1 % of
    the range. Quality is measured on the decoded values. DATA is held in memory. The other codecs
    come with pip install 'fhash[bench]'.
    """
    if plot is not None:
        check_writable(plot, force, sources=[data])
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        from fhash_codec.bench.rate.own import PROFILES
        from fhash_codec.bench.rate.plot import plot as draw
        from fhash_codec.bench.rate.plot import require_matplotlib
        from fhash_codec.bench.rate.rate import BOUNDS, TARGETS, bench_rate
        from fhash_codec.bench.rate.results import PEERS

        if plot is not None:
            require_matplotlib()
        every = not (targets or bounds)
        result = bench_rate(
            series,
            settings,
            targets=TARGETS if every else targets,
            bounds=BOUNDS if every else bounds,
            names=[name for name in names or PEERS if name != "none"],
            profiles=[name for name in profiles or PROFILES if name != "none"],
            speed=speed,
            progress=progress,
        )
    if plot is not None:
        from fhash_formats.support.atomic import replacing

        with replacing(Path(plot), force=force) as temporary:
            draw(result, temporary)
    emit(result.to_dict(), _rate_text(result), as_json)


def _rate_text(result: RateBench) -> str:
    """Tables of bytes, speed and access, and notes on how they were measured."""
    lines = [_bytes_table(result)]
    if any(point.as_asked is False for point in result.points):
        lines.append(
            "* its own tolerance of this bound does not keep it;"
            " a tighter one was taken where one does"
        )
    short = {point.codec: point for point in result.points if not point.reached}
    lines += [
        f"{codec} does not reach all: {number(point.psnr, 'dB')} in {point.bytes:,} bytes"
        for codec, point in short.items()
    ]
    if result.speeds:
        lines.append("\n" + _speed_table(result))
    if result.access:
        lines.append("\n" + _access_table(result))
    lines += [
        "",
        f"{result.series}, {result.dtype} {extent(result.shape)}, {size(result.raw_bytes)}",
        *result.notes,
    ]
    if result.missing:
        lines.append(
            f"{result.missing:,} values are not finite;"
            " lossy peers were given neighbouring values in their place"
        )
    lines += [f"not measured: {reason}" for reason in result.refused.values()]
    return "\n".join(lines)


def _bytes_table(result: RateBench) -> str:
    """A row for each quality: bytes of each codec, and how many times larger the best peer is."""
    codecs = list(dict.fromkeys(point.codec for point in result.points))
    points = {(point.goal, point.asked, point.codec): point for point in result.points}
    best = result.best_peers()
    own = list(best[0]["ratios"]) if any(row["peer"] for row in best) else []
    rows = [("bytes", *codecs, *(f"best / {codec}" for codec in own))]
    for row in best:
        goal, asked = row["goal"], row["asked"]
        cells = []
        for codec in codecs:
            point = points.get((goal, asked, codec))
            broken = "*" if point is not None and point.as_asked is False else ""
            cells.append(f"{point.bytes:,}{broken}" if point is not None and point.reached else "-")
        name = f"{asked:g} dB" if goal == "psnr" else f"within {100 * asked:g} %"
        rows.append((name, *cells, *(number(row["ratios"][codec], "x", digits=3) for codec in own)))
    return table(rows)


def _speed_table(result: RateBench) -> str:
    """A row for each codec: PSNR, and speed of encoding and decoding."""
    rows = [
        (
            speed.codec,
            number(speed.psnr, "dB"),
            number(speed.encode_mb_s, digits=3),
            number(speed.decode_mb_s, digits=3),
        )
        for speed in result.speeds
    ]
    return table([("speed", "PSNR", "encode MB/s", "decode MB/s"), *rows])


def _access_table(result: RateBench) -> str:
    """A row for each codec and layout: time and bytes that a small region takes."""
    rows = [
        (
            entry.setting,
            number(entry.psnr, "dB"),
            f"{entry.bytes:,}",
            number(entry.milliseconds, digits=3),
            f"{entry.bytes_read:,}",
        )
        for entry in result.access
    ]
    region = f"{extent(result.access[0].region)} of a step"
    return table([(region, "PSNR", "bytes", "ms", "bytes read"), *rows])
