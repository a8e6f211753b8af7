"""`fhash bench render`: what pictures cost, beside VTK, and their quality against time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import check_writable, force_option, json_option, quiet_option, run_argument
from fhash_cli.output import Progress, emit, extent, number, table

if TYPE_CHECKING:
    from fhash_codec.bench.pictures.results import RenderBench


class PartType(click.ParamType[str]):
    """A part of the bench; they are looked up when one is given, so that --help loads nothing."""

    name = "part"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; refuses one that is unknown."""
        from fhash_codec.bench.pictures.results import PARTS

        if value not in PARTS:
            self.fail(f"'{value}' is no part; allowed: {', '.join(PARTS)}", param, ctx)
        return str(value)


@click.command("render", short_help="time and quality of pictures, beside VTK")
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
    type=PartType(),
    multiple=True,
    help="effects, accelerations, streams, vtk, exactness, playback or curves; repeat. Default: all.",
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
@click.option(
    "--plot",
    metavar="FILE.png",
    type=click.Path(),
    help="Draw quality against time, and times beside VTK's.",
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
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure pictures of RUN.fhz: each effect and acceleration on and off, ways to march, VTK's ray casters, quality against time.

    VTK comes with pip install 'fhash[vtk]'; without it what it is needed for is left out. Every variant of a comparison runs in turns.
    """
    if plot is not None:
        check_writable(plot, force, sources=[run])
    import fhash_codec

    with fhash_codec.open(run) as volume, Progress(quiet=quiet) as progress:
        from fhash_codec.bench.pictures.pictures import bench_render
        from fhash_codec.bench.pictures.plot import plot as draw
        from fhash_codec.bench.pictures.results import PARTS
        from fhash_codec.bench.rate.plot import require_matplotlib
        from fhash_codec.rendering.scene.scene import Scene

        if plot is not None:
            require_matplotlib()
        scene = Scene() if scene_file is None else Scene.load(scene_file)
        result = bench_render(
            volume, scene, parts=parts or PARTS, size=side, turns=turns, progress=progress
        )
    if plot is not None:
        from fhash_formats.support.atomic import replacing

        with replacing(Path(plot), force=force) as temporary:
            draw(result, temporary)
    emit(result.to_dict(), _render_text(result), as_json)


def _render_text(result: RenderBench) -> str:
    """A table for each part, and how they were taken."""
    parts = []

    def add(*rows: tuple[str, ...]) -> None:
        if len(rows) > 1:
            parts.append(table(rows) + "\n")

    def ms(value: float) -> str:
        return number(value, digits=3)

    for title, switches in (("effect", result.effects), ("acceleration", result.accelerations)):
        add(
            (
                title,
                "off ms",
                "on ms",
                "on / off",
                "samples off",
                "samples on",
                *(("PSNR",) if title == "acceleration" else ()),
            ),
            *(
                (
                    each.name,
                    ms(each.off_ms),
                    ms(each.on_ms),
                    number(each.ratio, "x", digits=3),
                    f"{each.counters_off['samples']:,}",
                    f"{each.counters_on['samples']:,}",
                    *((_decibels(each.psnr),) if title == "acceleration" else ()),
                )
                for each in switches
            ),
        )
    add(
        ("march", "ms", "passes", "samples", "evaluations", "PSNR", "largest"),
        *(
            (
                each.mode if each.budget is None else f"{each.mode}, N_r {each.budget:,}",
                ms(each.milliseconds),
                f"{each.passes:,}",
                f"{each.samples:,}",
                f"{each.evaluations:,}",
                _decibels(each.psnr),
                number(each.largest, digits=2),
            )
            for each in result.streams
        ),
    )
    add(
        ("beside VTK", "size", "ours ms", "whole ms", "VTK ms", "VTK / ours", "PSNR", "SSIM"),
        *(
            (
                _lit(each.scene, each.shaded),
                str(each.size),
                ms(each.ours_ms),
                ms(each.whole_ms),
                ms(each.vtk_ms),
                number(each.ratio, "x", digits=3),
                _decibels(each.psnr),
                number(each.ssim),
            )
            for each in result.against
        ),
    )
    add(
        ("VTK on software OpenGL", "size", "step", "PSNR", "SSIM", "largest", "by its rules"),
        *(
            (
                _lit(each.scene, bool(each.gradient))
                + (", central differences" if each.gradient == "central" else ""),
                str(each.size),
                f"{each.step:g}",
                _decibels(each.psnr),
                number(each.ssim),
                str(each.largest),
                _decibels(each.explained),
            )
            for each in result.exactness
        ),
    )
    add(
        ("playback", "size", "steps", "ours ms", "VTK ms", "ours / VTK"),
        *(
            (
                _lit(each.scene, each.shaded),
                str(each.size),
                str(each.steps),
                ms(each.ours_ms),
                ms(each.vtk_ms),
                number(each.ratio, "x", digits=3),
            )
            for each in result.playback
        ),
    )
    add(
        ("knob", "value", "ms", "samples", "PSNR"),
        *(
            (
                each.knob,
                f"{each.value:.4g}",
                ms(each.milliseconds),
                f"{each.samples:,}",
                _decibels(each.psnr),
            )
            for each in result.curves
        ),
    )
    facts = ", ".join(f"{name} {fact}" for name, fact in result.machine.items())
    parts.append(
        f"{result.series}, {extent(result.shape)}, step {result.step:g}, {result.size} x {result.size}, medians of {result.turns}"
    )
    parts += [
        *result.notes,
        facts,
        *(f"not measured: {part}: {reason}" for part, reason in result.refused.items()),
    ]
    return "\n".join(parts)


def _decibels(psnr: float | None) -> str:
    return "equal" if psnr is None else number(psnr, "dB")


def _lit(scene: str, shaded: bool) -> str:
    return f"{scene}, {'lit' if shaded else 'unlit'}"
