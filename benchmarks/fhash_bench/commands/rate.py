"""The commands `fhash bench rate`, `table`, `labels` and `kinds`: options, and results as text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_bench.commands import check_plot, one_of, plot_option, save_plot
from fhash_cli.options import (
    BaseCommand,
    Command,
    RealRange,
    SourceOptions,
    TextType,
    check_writable,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table

if TYPE_CHECKING:
    from fhash_bench.labels import LabelBench
    from fhash_bench.rate.kinds_bench import KindsBench
    from fhash_bench.rate.measuring import RateBench
    from fhash_bench.rate.table import RateCell, RateTable

NONE = "none"
"""Name that stands for no peer at all."""


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A peer that was named.

    Attributes:
        name: of a filter, of a program, or NONE.
        path: of the program; empty for a filter.
    """

    name: str
    path: str = ""


def _peer(text: str) -> Peer:
    from fhash_bench.rate.measuring import PEERS
    from fhash_bench.rate.peers import PROGRAMS

    name, equals, path = text.partition("=")
    if name in (PROGRAMS if equals else (*PEERS, NONE)):
        return Peer(name=name, path=path)
    allowed = f"{', '.join((*PEERS, NONE))}, and as NAME=PATH {', '.join(PROGRAMS)}"
    raise ValueError(f"'{text}' is no peer; allowed: {allowed}")


PEER = TextType("NAME[=PATH]", _peer)
"""A filter of HDF5 by its name, a program as NAME=PATH, or 'none'."""

peer_option = click.option(
    "--peer",
    "peers",
    type=PEER,
    multiple=True,
    help="SZ3, SPERR, ZFP, BitRound, Blosc or none; repeat. Default: all. Besides, as NAME=PATH,"
    " a program: tthresh, qoz, hpez, sz3, or an ffmpeg for hevc, av1 or vvc.",
)
"""Option for the codecs to compare with."""


def quality_options(command: Command) -> Command:
    """Add the options for qualities that are compared at: PSNRs and bounds."""
    for option in (
        click.option(
            "--bound",
            "bounds",
            type=RealRange(1e-9, 0.5),
            multiple=True,
            metavar="X",
            help="Largest error as a share of the range; repeat.",
        ),
        click.option(
            "--target",
            "targets",
            type=RealRange(5, 200),
            multiple=True,
            metavar="X",
            help="PSNR over all frames in dB; repeat.",
        ),
    ):
        command = option(command)
    return command


def filters_of(peers: Sequence[Peer], default: Sequence[str]) -> list[str]:
    """Names of the filters among the peers, once each; the default where none was named."""
    given = [peer.name for peer in peers if not peer.path]
    return [name for name in dict.fromkeys(given or default) if name != NONE]


def programs_of(peers: Sequence[Peer]) -> dict[str, str]:
    """Paths of the programs among the peers by name."""
    return {peer.name: peer.path for peer in peers if peer.path}


@contextmanager
def opened(
    data: str, source: SourceOptions | None, progress: Callable[[str, int, int, str], None]
) -> Iterator[Any]:
    """The series of a file, or a generated one.

    source: options of files, which are refused for a generated series; None where there are none.
    """
    from fhash_bench.rate.generated import generated, is_generated

    if is_generated(data):
        if source is not None:
            source.refuse_without_data()
        yield generated(data)
        return
    assert source is not None
    with source.open(data, progress) as series:
        yield series


def _presets() -> tuple[str, ...]:
    from fhash_codec.config import PRESETS

    return (*PRESETS, NONE)


def _presets_of_table() -> tuple[str, ...]:
    from fhash_codec.config import PRESETS, PUBLISHED

    return tuple(name for name in PRESETS if name != PUBLISHED)


@click.command(
    "rate",
    cls=BaseCommand,
    short_help="size, speed and access beside other codecs, at equal quality",
    epilog="fhash bench rate demo/vortex.h5 --preset default --target 50 --bound 0.01",
)
@click.argument("data", type=click.Path())
@series_options
@quality_options
@peer_option
@click.option(
    "--preset",
    "presets",
    type=one_of("preset", _presets),
    multiple=True,
    help="Of fhash, or none; repeat. Default: default and published.",
)
@click.option(
    "--speed/--no-speed",
    default=True,
    show_default=True,
    help="Measure speed and access too, at the target nearest to 50 dB.",
)
@setting_options("effort", "tile", "epochs", "width", "device", "seed")
@plot_option("Draw bytes against quality.")
@force_option
@json_option
@quiet_option
def rate(
    data: str,
    source: SourceOptions,
    targets: tuple[float, ...],
    bounds: tuple[float, ...],
    peers: tuple[Peer, ...],
    presets: tuple[str, ...],
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
    generated:KIND: plateau, noise, labels, smooth, turbulence, thin, long or short. The
    other codecs come with
    pip install 'fhash[bench]'; programs are named by their paths.
    """
    check_plot(plot, force, [data])
    with Progress(quiet=quiet) as progress, opened(data, source, progress) as series:
        from fhash_bench.rate.measuring import MEASURED, PEERS
        from fhash_bench.rate.rate import BOUNDS, TARGETS, bench_rate
        from fhash_bench.rate.rate import plot as draw

        every = not (targets or bounds)
        result = bench_rate(
            series,
            settings,
            targets=TARGETS if every else targets,
            bounds=BOUNDS if every else bounds,
            names=filters_of(peers, PEERS),
            named=programs_of(peers),
            presets=[name for name in presets or MEASURED if name != NONE],
            speed=speed,
            progress=progress,
        )
    save_plot(plot, force, partial(draw, result))
    emit(result.to_dict(), _rate_text(result), as_json)


def _rate_text(result: RateBench) -> str:
    """Tables of bytes, speed and access, and notes on how they were measured."""
    lines = [table(bytes_rows(result))]
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
        lines.append("\n" + table(speed_rows(result)))
    if result.access:
        lines.append("\n" + table(access_rows(result)))
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


def bytes_rows(result: RateBench) -> list[tuple[str, ...]]:
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
    return rows


def speed_rows(result: RateBench) -> list[tuple[str, ...]]:
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
    return [header, *rows]


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


def access_rows(result: RateBench) -> list[tuple[str, ...]]:
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
    return [(region, "PSNR", "bytes", "ms", "bytes read"), *rows]


@click.command(
    "table",
    cls=BaseCommand,
    short_help="size, speed and access on many series, one core, as one table; goes on",
    epilog="fhash bench table generated:smooth --target 45",
)
@click.argument("data", type=click.Path(), nargs=-1)
@series_options
@click.option(
    "--generated", "with_generated", is_flag=True, help="Add every generated series to DATA."
)
@quality_options
@click.option(
    "--effort",
    "efforts",
    type=click.IntRange(1, 9),
    multiple=True,
    metavar="N",
    help="Of fhash; repeat. Default: 1, 5 and 7.",
)
@click.option(
    "--preset",
    "presets",
    type=one_of("preset", _presets_of_table),
    multiple=True,
    help="Of fhash, with each effort; repeat. Default: default.",
)
@click.option(
    "--peer",
    "peers",
    type=PEER,
    multiple=True,
    help="As of bench rate. Default: SPERR, SZ3 and ZFP.",
)
@click.option(
    "--speed/--no-speed",
    default=True,
    show_default=True,
    help="Measure speed and access too, of every codec at every quality.",
)
@setting_options("tile", "seed", "without")
@click.option(
    "-o",
    "folder",
    metavar="DIR",
    type=click.Path(file_okay=False),
    default="bench-table",
    show_default=True,
    help="Folder of the cells, one JSON file each, and of table.csv; finished cells are not"
    " measured again.",
)
@json_option
@quiet_option
def rate_table(
    data: tuple[str, ...],
    source: SourceOptions,
    with_generated: bool,
    targets: tuple[float, ...],
    bounds: tuple[float, ...],
    efforts: tuple[int, ...],
    presets: tuple[str, ...],
    peers: tuple[Peer, ...],
    speed: bool,
    settings: dict[str, Any],
    folder: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare fhash with other codecs on each DATA: bytes, and seconds of the processor.

    Without --target and --bound: 45 and 60 dB, and bounds of 1 and 0.1 % of the range. All run on
    one thread. DATA is held in memory, and may be generated:KIND: plateau, noise, labels, smooth,
    turbulence, thin, long or short.
    """
    if not data and not with_generated:
        raise click.UsageError("Missing DATA; or give --generated")
    with Progress(quiet=quiet) as progress:
        from fhash_bench.rate.generated import GENERATED, PREFIX, is_generated
        from fhash_bench.rate.table import (
            BOUNDS,
            EFFORTS,
            FILTERS,
            TARGETS,
            bench_table,
            own_coders,
        )

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
            own_coders(efforts or EFFORTS, presets, settings),
            targets=TARGETS if every else targets,
            bounds=BOUNDS if every else bounds,
            names=filters_of(peers, FILTERS),
            named=programs_of(peers),
            speed=speed,
            progress=progress,
        )
    emit(result.to_dict(), _table_text(result), as_json)


def cell_rows(cells: Sequence[RateCell]) -> list[tuple[str, ...]]:
    """A row for each series, quality and codec."""
    header = ("series", "quality", "codec", "bytes", "encode MB/s", "decode MB/s", "region ms")
    rows = [
        (
            Path(cell.series).name,
            _quality(cell.goal, cell.asked),
            cell.codec,
            f"{cell.bytes:,}" if cell.bytes else "-",
            number(cell.encode_mb_s, digits=3),
            number(cell.decode_mb_s, digits=3),
            number(cell.region_ms, digits=3),
            number(cell.psnr, digits=4),
            number(cell.max_error and 100 * cell.max_error, "%", digits=3)
            + ("" if cell.reached else " !"),
            cell.setting or cell.why or "-",
        )
        for cell in cells
    ]
    return [(*header, "PSNR", "error", "layout"), *rows]


def _table_text(result: RateTable) -> str:
    """The cells, and how they were measured."""
    seconds = number(result.startup_seconds, "s", digits=2)
    return "\n".join(
        [
            table(cell_rows(result.cells)),
            "",
            *result.notes,
            f"start-up of fhash, a whole `fhash encode` of 16 values: {seconds},"
            " which the speed of encoding does not hold",
        ]
    )


@click.command(
    "labels",
    cls=BaseCommand,
    short_help="sizes of labels without loss, beside xz",
    epilog="fhash bench labels",
)
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
        from fhash_bench.labels import bench_labels

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


def _kinds() -> Sequence[str]:
    from fhash_bench.rate.kinds import KINDS

    return list(KINDS)


def _filters() -> Sequence[str]:
    from fhash_bench.rate.kinds_bench import FILTERS, THREADS

    return (*FILTERS, THREADS, NONE)


@click.command(
    "kinds",
    cls=BaseCommand,
    short_help="size, speed and quality on many kinds of made data, beside another checkout",
    epilog="fhash bench kinds --only single --only labels",
)
@click.option(
    "--only",
    "kinds",
    type=one_of("kind", _kinds),
    multiple=True,
    help="A kind, such as shock; repeat. Default: all but large, which is 300 MB.",
)
@click.option(
    "--beside",
    metavar="DIR",
    type=click.Path(exists=True, file_okay=False),
    help="Another checkout that is built in place, or a folder site-packages with fhash: the same"
    " kinds, in turns.",
)
@click.option(
    "--peer",
    "peers",
    type=one_of("peer", _filters),
    multiple=True,
    help="SPERR, SZ3, threads (fhash on all processors) or none; repeat. Default: SPERR and SZ3.",
)
@click.option(
    "--repeat",
    type=click.IntRange(1, 100),
    metavar="N",
    default=1,
    show_default=True,
    help="Runs of encoding and decoding, of which the fastest counts.",
)
@setting_options("effort")
@click.option(
    "-o",
    "record",
    metavar="FILE.json",
    type=click.Path(dir_okay=False),
    help="Keep what --json prints.",
)
@force_option
@json_option
@quiet_option
def kinds(
    kinds: tuple[str, ...],
    beside: str | None,
    peers: tuple[str, ...],
    repeat: int,
    settings: dict[str, Any],
    record: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure fhash on kinds of data that NumPy makes, to decide about the encoder.

    Choices of the encoder are made on half of the kinds; the others are only reported, and come
    first. All are encoded with the default promise or one of their own, and some also at 45 dB,
    60 dB and within 0.1 % of the range. SPERR and SZ3 come with pip install 'fhash[bench]'.
    """
    if record is not None:
        check_writable(record, force)
    with Progress(quiet=quiet) as progress:
        from fhash_bench.kept import save
        from fhash_bench.rate.kinds_bench import FILTERS, bench_kinds

        result = bench_kinds(
            kinds,
            beside=beside,
            names=[name for name in dict.fromkeys(peers or FILTERS) if name != NONE],
            repeat=repeat,
            effort=settings.get("effort"),
            progress=progress,
        )
    if record is not None:
        save(Path(record), result.to_dict())
    emit(result.to_dict(), _kinds_text(result), as_json)


def _kinds_text(result: KindsBench) -> str:
    """Figures of each kind, how they were measured, and ratios to other coders."""
    header = ("kind", "use", "goal", "coder", "bytes", "encode s", "decode s", "region ms")
    rows = [(*header, "kept", "PSNR", "gradient", "spectrum", "seams")]
    for case in result.cases:
        for row in case.figures:
            rows.append(
                (
                    case.kind,
                    _use(case.chosen),
                    case.goal,
                    row.coder,
                    f"{row.bytes:,}",
                    number(row.encode_seconds, digits=3),
                    number(row.decode_seconds, digits=3),
                    number(row.region_ms, digits=3),
                    "yes" if row.kept else "NO",
                    number(row.psnr),
                    number(row.gradient_psnr),
                    number(100 * row.spectrum_error, "%", digits=2),
                    number(row.seams, digits=3),
                )
            )
    ratios = [("fhash / other", "use", "figure", "mean", "worst", "where")]
    ratios += [
        (
            row["coder"],
            _use(row["chosen"]),
            row["measure"].replace("_seconds", ""),
            number(row["mean"]),
            number(row["worst"]),
            row["case"],
        )
        for row in result.ratios()
    ]
    refused = [f"not measured: {case}: {reason}" for case, reason in result.refused.items()]
    commits = [f"{coder}: {commit or 'no commit'}" for coder, commit in result.commits.items()]
    lines = [table(rows), "", *result.notes, *refused, *commits, "", table(ratios)]
    return "\n".join(lines)


def _use(chosen: bool) -> str:
    """The part of a kind in decisions about the encoder."""
    return "chosen on" if chosen else "reported"
