"""Bytes, speed and access of fhash and other codecs at equal quality: `fhash bench rate`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fhash_bench.rate.measuring import MEASURED, OWN, PEERS, Bench, Point, RateBench, promised
from fhash_bench.rate.peers import PROGRAMS, AnyVariant, all_filters, programs
from fhash_codec.config import PRESETS
from fhash_codec.cost.report import require_matplotlib
from fhash_codec.devices import machine
from fhash_codec.features.scan import scan
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Series

TARGETS = (35.0, 40.0, 45.0, 50.0, 60.0)
"""PSNR in dB."""
BOUNDS = (0.05, 0.02, 0.01, 0.005, 0.001)
"""Largest errors as shares of the range."""
SPEED_AT = 50.0
"""PSNR in dB at which speed and access are measured; the target nearest to it is taken."""
NOTES = (
    "the whole series is held in memory",
    "bytes of a peer are those of its stored chunks alone, the structure of its file is left out;"
    " bytes of fhash are the whole file",
    "of every peer the smallest of its layouts and modes counts, which points name;"
    " for a bound, the coarsest setting whose decoded values keep it",
    "tolerances of ZFP are powers of two and BitRound keeps whole bits:"
    " both may exceed what was asked by up to 6 dB, as their PSNR says",
    "peers run on one thread as HDF5 filters; fhash takes the threads it takes by default",
    "the price of tiles sets the bytes of the default beside those of one tile at the same promise",
    "MB/s of a core are 10^6 bytes of the array for each second that all cores together spent;"
    " a program's own start counts",
    "access reads a file that was just opened, which memory holds; bytes read are those of"
    " whole chunks for a peer, and all that is read of the file, directory included, for fhash;"
    " a program decodes everything",
)


def bench_rate(
    source: Source,
    settings: Mapping[str, Any] | None = None,
    *,
    targets: Sequence[float] = TARGETS,
    bounds: Sequence[float] = BOUNDS,
    names: Sequence[str] = PEERS,
    named: Mapping[str, str] | None = None,
    presets: Sequence[str] = MEASURED,
    speed: bool = True,
    price_tiles: bool = True,
    progress: Progress = silent,
) -> RateBench:
    """Measure presets of fhash and its peers on a series, which is held in memory.

    Everything is measured on decoded values.

    Args:
        source: a file, a Series or an array.
        settings: further settings of fhash by name, as for `EncodeConfig.from_dict`; each preset
            takes those it has. A feature is refused, since the whole domain counts here.
        targets: PSNR in dB over every finite value of all frames, with the range of the series.
        bounds: largest errors as shares of that range.
        names: peers, of PEERS.
        named: paths of programs by their names, of PROGRAMS, which are peers as well.
        presets: of fhash.
        price_tiles: also encode the default preset as one tile.
        speed: also measure encoding, decoding and access, at the target nearest to SPEED_AT.

    Raises InputError for what cannot be measured, or a path without a program;
    MissingDependencyError without hdf5plugin.
    """
    settings = settings or {}
    check(settings, targets, bounds, [*names, *(named or {})], presets)
    variants, refused = all_variants(names, named or {})
    with (
        open_source(source) as series,
        tempfile.TemporaryDirectory(prefix="fhash-bench-") as folder,
    ):
        goals = goals_of(targets, bounds)
        bench = bench_of(series, Path(folder), goals, progress)
        bench.refused.update(refused)
        bench.price_tiles = price_tiles
        chosen = [variant for several in variants.values() for variant in several]
        peer_trials = sum(goal in variant.goals for variant in chosen for goal, _ in goals)
        bench.total = peer_trials + len(goals) * len(presets)
        for variant in chosen:
            bench.search(variant)
        for preset in presets:
            bench.search_preset(settings, preset)
        if speed and targets:
            nearest = min(targets, key=lambda target: (abs(target - SPEED_AT), target))
            bench.measure_speed(nearest, variants)
        return RateBench(
            series=f"{series.source} {series.name}",
            shape=series.shape,
            dtype=series.dtype.name,
            raw_bytes=bench.series.values.nbytes,
            value_range=bench.value_range,
            missing=bench.missing,
            points=tuple(bench.points()),
            speeds=tuple(bench.speeds),
            access=tuple(bench.access),
            tiles=tuple(bench.tiles),
            refused=bench.refused,
            machine=machine(),
            notes=NOTES,
        )


def all_variants(
    names: Sequence[str], named: Mapping[str, str]
) -> tuple[dict[str, Sequence[AnyVariant]], dict[str, str]]:
    """Variants of peers and of programs by codec, and why programs were left out.

    Raises InputError for a path without a program, MissingDependencyError without hdf5plugin.
    """
    filters = all_filters() if names else {}
    found, refused = programs(named)
    return {**{name: filters[name] for name in names}, **found}, refused


def goals_of(targets: Sequence[float], bounds: Sequence[float]) -> list[tuple[str, float]]:
    """Goals and what is asked: PSNR from low to high, then bounds from wide to narrow."""
    goals = [("psnr", target) for target in sorted(targets)]
    return goals + [("bound", bound) for bound in sorted(bounds, reverse=True)]


def bench_of(
    series: Series, folder: Path, goals: list[tuple[str, float]], progress: Progress
) -> Bench:
    """A bench of a series, which it holds in memory; raises InputError for a constant one."""
    scanned = scan(series, progress)
    value_range = (scanned.value_range.low, scanned.value_range.high)
    if value_range[0] == value_range[1]:
        raise InputError(
            f"{series.source}: '{series.name}' is constant; there is no quality to compare"
        )
    values = np.stack(list(series.frames()))
    missing = values.size - scanned.finite_count
    plain = ArraySeries(values, name=series.name, units=series.units, coords=series.coords)
    return Bench(plain, value_range, missing, folder, goals, progress)


def check(
    settings: Mapping[str, Any],
    targets: Sequence[float],
    bounds: Sequence[float],
    names: Sequence[str],
    presets: Sequence[str],
) -> None:
    """Raise InputError for arguments of `bench_rate` that are not allowed."""
    every = (*PEERS, *PROGRAMS)
    for what, given, allowed in (("peer", names, every), ("preset", presets, PRESETS)):
        for name in given:
            if name not in allowed:
                raise InputError(f"{what} is '{name}'; allowed: {', '.join(allowed)}")
    for target in targets:
        if not 5 <= target <= 200:
            raise InputError(f"target is {target:g} dB; allowed: 5 to 200")
    for bound in bounds:
        if not 1e-9 <= bound <= 0.5:
            raise InputError(f"bound is {bound:g} of the range; allowed: 1e-9 to 0.5")
    if not (targets or bounds) or not (names or presets):
        raise InputError(
            "nothing to measure; give at least one target or bound, and one peer or preset"
        )
    if tuple(settings.get("features", ("all",))) != ("all",):
        raise InputError(
            f"feature is {', '.join(settings['features'])};"
            " bench rate compares whole domains, leave it out"
        )
    for preset in presets:
        promised(settings, preset, "psnr", SPEED_AT)


COLOURS = {
    "SZ3": "#4a86c0",
    "SPERR": "#2f9e6e",
    "ZFP": "#b07aa1",
    "BitRound": "#9c8b5a",
    "Blosc": "#8a8f98",
}
OWN_COLOURS = ("#d1604b", "#3b3f46", "#e0a030")


def plot(result: RateBench, path: Path) -> None:
    """Draw a result as a PNG at `path`.

    Each kind of quality has a panel, with bytes on a logarithmic axis; qualities that were not
    reached are left out.
    """
    figure_module = require_matplotlib()
    goals = [
        goal for goal in ("psnr", "bound") if any(point.goal == goal for point in result.points)
    ]
    figure = figure_module.Figure(figsize=(1 + 5.5 * len(goals), 5), layout="constrained", dpi=140)
    for number, (axes, goal) in enumerate(
        zip(figure.subplots(1, len(goals), squeeze=False)[0], goals, strict=True)
    ):
        _panel(
            axes,
            goal,
            [
                point
                for point in result.points
                if point.goal == goal and (point.reached or point.codec.startswith(OWN))
            ],
        )
        if number == 0:
            axes.set_ylabel("bytes")
            axes.legend(frameon=False)
    figure.suptitle(f"{Path(result.series).name}, {result.raw_bytes / 1e6:.1f} MB raw", fontsize=11)
    figure.savefig(path, format="png")


def _panel(axes: Any, goal: str, points: list[Point]) -> None:
    own = sorted({point.codec for point in points if point.codec.startswith(OWN)})
    for codec in dict.fromkeys(point.codec for point in points):
        mine = [point for point in points if point.codec == codec]
        colour = (
            OWN_COLOURS[own.index(codec) % len(OWN_COLOURS)] if codec in own else COLOURS[codec]
        )
        # A lossless codec has no place on the axis of quality, only its bytes.
        places = {
            (point.psnr if goal == "psnr" else 100 * point.max_error, point.bytes)
            for point in mine
            if point.psnr is not None
        }
        style = {"color": colour, "label": codec, "linewidth": 2.4 if codec in own else 1.4}
        if places:
            axes.plot(
                *zip(*sorted(places), strict=True),
                marker="o",
                markersize=5 if codec in own else 3.5,
                **style,
            )
        else:
            axes.axhline(mine[0].bytes, linestyle="--", **style)
    axes.set_yscale("log")
    axes.grid(True, which="major", color="#e3e4e8", linewidth=0.8)
    axes.set_axisbelow(True)
    if goal == "psnr":
        axes.set_xlabel("PSNR over all frames, dB")
    else:
        axes.set_xscale("log")
        axes.invert_xaxis()
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xlabel("largest error, % of the range")
