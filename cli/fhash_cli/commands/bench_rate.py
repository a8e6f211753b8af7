"""`fhash bench rate`: bytes, speed and access of fhash and other codecs at equal quality."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    BaseCommand,
    SourceOptions,
    check_writable,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table
from fhash_cli.peer_options import (
    Peer,
    filters_of,
    opened,
    peer_option,
    programs_of,
    quality_options,
)

if TYPE_CHECKING:
    from fhash_codec.bench.rate.results import RateBench


class ProfileType(click.ParamType[str]):
    """A profile, or 'none'.

    Names are looked up only when one is given, so that --help loads nothing.
    """

    name = "profile"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; refuses one that is unknown."""
        from fhash_codec.config import EncodeConfig

        profiles = next(
            field for field in dataclasses.fields(EncodeConfig) if field.name == "profile"
        ).metadata["choices"]
        allowed = (*profiles, "none")
        if value not in allowed:
            self.fail(f"'{value}' is no profile; allowed: {', '.join(allowed)}", param, ctx)
        return str(value)


@click.command(
    "rate",
    cls=BaseCommand,
    short_help="size, speed and access beside other codecs, at equal quality",
)
@click.argument("data", type=click.Path())
@series_options
@quality_options
@peer_option
@click.option(
    "--profile",
    "profiles",
    type=ProfileType(),
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
    peers: tuple[Peer, ...],
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
    the range. Quality is measured on the decoded values. DATA is held in memory, and may be
    generated:KIND: plateau, noise, labels, smooth, thin, long or short. The other codecs come with
    pip install 'fhash[bench]'; programs are named by their paths.
    """
    if plot is not None:
        check_writable(plot, force, sources=[data])
    with Progress(quiet=quiet) as progress, opened(data, source, progress) as series:
        from fhash_codec.bench.rate.own import PROFILES
        from fhash_codec.bench.rate.plot import plot as draw
        from fhash_codec.bench.rate.rate import BOUNDS, TARGETS, bench_rate
        from fhash_codec.cost.plot import require_matplotlib

        if plot is not None:
            require_matplotlib()
        every = not (targets or bounds)
        result = bench_rate(
            series,
            settings,
            targets=TARGETS if every else targets,
            bounds=BOUNDS if every else bounds,
            names=filters_of(peers),
            named=programs_of(peers),
            profiles=[name for name in profiles or PROFILES if name != "none"],
            speed=speed,
            progress=progress,
        )
    if plot is not None:
        from fhash_formats.support.files import replacing

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
    if result.tiles:
        lines.append("\n" + _tiles_table(result))
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
        name = _quality(goal, asked)
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
            number(speed.encode_core_mb_s, digits=3),
            number(speed.decode_core_mb_s, digits=3),
        )
        for speed in result.speeds
    ]
    header = ("speed", "PSNR", "encode MB/s", "decode MB/s", "encode, a core", "decode, a core")
    return table([header, *rows])


def _tiles_table(result: RateBench) -> str:
    """A row for each quality: bytes of the default tiles beside those of one tile."""
    rows = [
        (
            _quality(price.goal, price.asked),
            f"{price.bytes:,}",
            f"{price.one_tile_bytes:,}",
            number(price.price, "x", digits=4),
            "all" if price.steps == result.shape[0] else f"{price.steps} in the middle",
        )
        for price in result.tiles
    ]
    return table([("tiles", "bytes", "one tile", "price", "steps"), *rows])


def _quality(goal: str, asked: float) -> str:
    """A quality in words."""
    return f"{asked:g} dB" if goal == "psnr" else f"within {100 * asked:g} %"


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
