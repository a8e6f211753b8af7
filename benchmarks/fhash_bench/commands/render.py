"""The command `fhash bench render`: options, and results as text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fhash_bench.commands import check_plot, one_of, plot_option, save_plot
from fhash_cli.options import (
    BaseCommand,
    force_option,
    json_option,
    quiet_option,
    run_argument,
)
from fhash_cli.output import Progress, emit, extent, number, table

if TYPE_CHECKING:
    from fhash_bench.pictures.results import RenderBench, Switch


def _parts() -> tuple[str, ...]:
    from fhash_bench.pictures.results import PARTS

    return PARTS


@click.command(
    "render",
    cls=BaseCommand,
    short_help="time and quality of pictures, beside VTK",
    epilog="fhash bench render run.fhz --part effects --size 128 --turns 1",
)
@run_argument
@click.option(
    "--scene",
    "scene_file",
    metavar="FILE",
    type=click.Path(),
    help="JSON, TOML or a PNG of fhash render. Default: that of RUN.fhz.",
)
@click.option(
    "--part",
    "parts",
    type=one_of("part", _parts),
    multiple=True,
    help="effects, accelerations, orbit, shell, streams, vtk, exactness, playback or curves;"
    " repeat. Default: all.",
)
@click.option(
    "--size",
    "side",
    type=click.IntRange(16, 4096),
    default=512,
    show_default=True,
    metavar="N",
    help="Pixels along both sides.",
)
@click.option(
    "--turns",
    type=click.IntRange(1, 1000),
    default=5,
    show_default=True,
    metavar="N",
    help="Runs that each median is of.",
)
@plot_option("Draw quality against time, and times beside VTK's.")
@click.option(
    "--ospray",
    metavar="PATH",
    help="OSPRay 2 or 3 as a peer of the part shell: libospray.so, its folder, or a Python module"
    " that holds it.",
)
@force_option
@json_option
@quiet_option
def render(
    run: str,
    scene_file: str | None,
    parts: tuple[str, ...],
    side: int,
    turns: int,
    plot: str | None,
    ospray: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure pictures of RUN.fhz: effects, accelerations, marchers, VTK's ray casters, quality.

    Each effect and acceleration is measured on and off; the variants of a comparison run in turns.
    VTK comes with pip install 'fhash[bench]'; without it the comparisons with VTK are left out.
    """
    check_plot(plot, force, [run])
    from fhash_codec.volume import open as open_volume

    with open_volume(run) as volume, Progress(quiet=quiet) as progress:
        from fhash_bench.pictures.render import bench_render
        from fhash_bench.pictures.results import PARTS
        from fhash_bench.pictures.results import plot as draw
        from fhash_codec.rendering.scenes import Scene

        scene = Scene() if scene_file is None else Scene.load(scene_file)
        result = bench_render(
            volume,
            scene,
            parts=parts or PARTS,
            size=side,
            turns=turns,
            ospray=ospray,
            progress=progress,
        )
    save_plot(plot, force, partial(draw, result))
    emit(result.to_dict(), _render_text(result), as_json)


Rows = list[tuple[str, ...]]


def _render_text(result: RenderBench) -> str:
    """A table for each part that was measured, and notes on how."""
    lines = [table(rows) + "\n" for rows in _tables(result) if len(rows) > 1]
    facts = ", ".join(f"{name} {fact}" for name, fact in result.machine.items())
    lines += [
        f"{result.series}, {extent(result.shape)}, step {result.step:g},"
        f" {result.size} x {result.size}, medians of {result.turns}",
        *result.notes,
        facts,
        *(f"not measured: {part}: {reason}" for part, reason in result.refused.items()),
    ]
    return "\n".join(lines)


def _tables(result: RenderBench) -> Iterator[Rows]:
    """Every table of the bench: a heading, and a row for each measurement."""
    yield _switches("effect", result.effects)
    yield _switches("acceleration", result.accelerations, psnr=True)
    yield _switches("orbit", result.orbit)
    for name, heading, row in TABLES:
        yield [heading, *map(row, getattr(result, name))]


def _switches(title: str, switches: Sequence[Switch], *, psnr: bool = False) -> Rows:
    """Time and samples of pictures with something off and on; psnr: of one against the other."""
    heading = (title, "off ms", "on ms", "on / off", "samples off", "samples on")
    rows: Rows = [(*heading, "PSNR") if psnr else heading]
    for switch in switches:
        row = (
            switch.name,
            _ms(switch.off_ms),
            _ms(switch.on_ms),
            number(switch.ratio, "x", digits=3),
            f"{switch.counters_off['samples']:,}",
            f"{switch.counters_on['samples']:,}",
        )
        rows.append((*row, _decibels(switch.psnr)) if psnr else row)
    return rows


TABLES: tuple[tuple[str, tuple[str, ...], Callable[[Any], tuple[str, ...]]], ...] = (
    (  # pictures of a large volume beside those of other renderers
        "beside",
        ("beside", "scene", "size", "threads", "ours ms", "peer ms", "peer / ours", "PSNR"),
        lambda pair: (
            pair.peer,
            _lit(pair.scene, pair.shaded),
            str(pair.size),
            str(pair.threads),
            _ms(pair.ours_ms),
            _ms(pair.peer_ms),
            number(pair.ratio, "x", digits=3),
            _decibels(pair.psnr),
        ),
    ),
    (  # the marchers that evaluate the model itself
        "streams",
        ("march", "ms", "samples", "evaluations", "PSNR", "largest"),
        lambda run: (
            run.mode,
            _ms(run.milliseconds),
            f"{run.samples:,}",
            f"{run.evaluations:,}",
            _decibels(run.psnr),
            number(run.largest, digits=2),
        ),
    ),
    (  # the cache and adaptive ray marching by the size of the picture
        "break_even",
        ("pixels", "cache ms", "kept ms", "arm ms", "arm / cache", "arm up to", "auto"),
        lambda pair: (
            str(pair.size),
            _ms(pair.first_ms),
            _ms(pair.kept_ms),
            _ms(pair.arm_ms),
            number(pair.ratio, "x", digits=3),
            "any" if pair.pictures is None else f"{pair.pictures} pictures",
            pair.auto,
        ),
    ),
    (  # pictures beside those of VTK's fixed-point ray caster
        "against",
        ("beside VTK", "size", "ours ms", "whole ms", "VTK ms", "VTK / ours", "PSNR", "SSIM"),
        lambda pair: (
            _lit(pair.scene, pair.shaded),
            str(pair.size),
            _ms(pair.ours_ms),
            _ms(pair.whole_ms),
            _ms(pair.vtk_ms),
            number(pair.ratio, "x", digits=3),
            _decibels(pair.psnr),
            number(pair.ssim),
        ),
    ),
    (  # likeness to pictures of VTK's GPU mapper on software OpenGL
        "exactness",
        ("VTK on software OpenGL", "size", "step", "PSNR", "SSIM", "largest", "by its rules"),
        lambda pair: (
            _lit(pair.scene, bool(pair.gradient))
            + (", central differences" if pair.gradient == "central" else ""),
            str(pair.size),
            f"{pair.step:g}",
            _decibels(pair.psnr),
            number(pair.ssim),
            str(pair.largest),
            _decibels(pair.explained),
        ),
    ),
    (  # all steps played, beside VTK
        "playback",
        ("playback", "size", "steps", "ours ms", "VTK ms", "ours / VTK"),
        lambda run: (
            _lit(run.scene, run.shaded),
            str(run.size),
            str(run.steps),
            _ms(run.ours_ms),
            _ms(run.vtk_ms),
            number(run.ratio, "x", digits=3),
        ),
    ),
    (  # quality against time for each knob: step length, threshold, level of detail
        "curves",
        ("knob", "value", "ms", "samples", "PSNR"),
        lambda point: (
            point.knob,
            f"{point.value:.4g}",
            _ms(point.milliseconds),
            f"{point.samples:,}",
            _decibels(point.psnr),
        ),
    ),
)
"""Tables of single measurements: field of the result, heading, and row of a measurement."""


def _ms(value: float) -> str:
    return number(value, digits=3)


def _decibels(psnr: float | None) -> str:
    return "equal" if psnr is None else number(psnr, "dB")


def _lit(scene: str, shaded: bool) -> str:
    return f"{scene}, {'lit' if shaded else 'unlit'}"
