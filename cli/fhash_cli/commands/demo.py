"""`fhash demo`: simulates a small series, encodes it, compares and draws it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import check_writable, force_option, json_option, quiet_option
from fhash_cli.output import (
    Progress,
    compared,
    duration,
    emit,
    extent,
    number,
    quality_rows,
    say,
    size,
    table,
)
from fhash_codec.demo.simulate import SCENES, simulate
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from PIL import Image

    from fhash_codec import Volume
    from fhash_formats.series import Series

COLUMNS = 4
"""Steps that the picture shows side by side."""


@click.command("demo", cls=BaseCommand)
@click.option(
    "--scene",
    type=click.Choice(tuple(SCENES)),
    default="vortex",
    show_default=True,
    help="What to simulate.",
)
@click.option(
    "-o",
    "folder",
    metavar="DIR",
    type=click.Path(),
    default="demo",
    show_default=True,
    help="Folder for the three files.",
)
@click.option(
    "--gallery",
    metavar="DIR",
    type=click.Path(),
    help="Make the gallery instead: pictures in DIR, and the page DIR.md with their commands.",
)
@force_option
@json_option
@quiet_option
def command(
    scene: str, folder: str, gallery: str | None, force: bool, as_json: bool, quiet: bool
) -> None:
    """Simulate a small series, encode, decode, compare and draw it: DIR/SCENE.h5, .fhz and .png."""
    if gallery is not None:
        from fhash_cli.commands import encode, render
        from fhash_cli.gallery import make_gallery

        made = make_gallery(
            Path(gallery),
            {"encode": encode.command, "render": render.command},
            force=force,
            quiet=quiet,
        )
        emit(
            made, table([("page", made["page"]), ("pictures", str(len(made["pictures"])))]), as_json
        )
        return
    from fhash_codec.config import EncodeConfig
    from fhash_formats import Region, open_series, save_region
    from fhash_formats.support.atomic import replacing

    data, run, picture = (Path(folder) / f"{scene}.{suffix}" for suffix in ("h5", "fhz", "png"))
    try:
        Path(folder).mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: {error.strerror}; give a folder that exists or whose parent does"
        ) from error
    for output in (data, run, picture):
        check_writable(
            output, force, sources=[other for other in (data, run, picture) if other != output]
        )
    if not quiet:
        say(f"simulating '{scene}', {SCENES[scene].help}")
    simulated = simulate(scene)
    save_region(data, Region.of(simulated), simulated.frames(), force=force)

    import fhash_codec

    config = EncodeConfig(features=(SCENES[scene].feature,))
    with Progress(quiet=quiet) as progress:
        encoded = fhash_codec.encode(data, run, config, force=force, progress=progress)
        start = time.perf_counter()
        report = fhash_codec.diff(data, run, progress=progress)
        seconds = time.perf_counter() - start
    with (
        open_series(data) as series,
        fhash_codec.open(run) as volume,
        replacing(picture, force=force) as temporary,
    ):
        _draw(scene, series, volume, report).save(temporary, format="PNG", optimize=True)
    settings = f"--feature {config.features[0]}"
    made = {
        "scene": scene,
        "data": str(data),
        "path": str(run),
        "picture": str(picture),
        "settings": settings,
    }
    result = {**report, "seconds": encoded["seconds"], "diff_seconds": seconds, **made}
    emit(result, table(_rows(result, series)), as_json)


def _draw(scene: str, series: Series, volume: Volume, report: dict[str, Any]) -> Image.Image:
    """Draw the slice of constant z with the most of the coreset, at evenly spread steps."""
    from fhash_codec.demo.comparison_picture import Pair, compare

    steps = [round((index + 0.5) * series.shape[0] / COLUMNS) for index in range(COLUMNS)]
    layer = int(sum(volume.occupancy(step).sum(axis=(1, 2), dtype=int) for step in steps).argmax())
    times, heights = series.coords["t"].values, series.coords["z"].values
    window = ((layer, layer + 1), (0, series.shape[2]), (0, series.shape[3]))
    pairs = [
        Pair(
            label=f"t = {times[step]:.2g} s",
            original=series.read(step)[layer].astype(float),
            decoded=volume.read(step, window)[0].astype(float),
        )
        for step in steps
    ]
    ratio = number(report["ratio"], digits=3)
    saved = f"{size(report['raw_bytes'])} in {size(report['bytes'])} ({ratio}x)"
    largest = number(report["max_abs_error"], digits=2)
    psnr = number(report["psnr"], "dB", digits=3)
    quality = f"{psnr} in the coreset, largest error {largest}"
    return compare(
        pairs,
        title=f"fhash demo: {scene}",
        subtitle=f"{extent(series.shape)} values, {saved}, {quality}",
        quantity=series.name if series.units == "1" else f"{series.name} ({series.units})",
        footer=f"outside the coreset, not kept.   Slice z = {heights[layer]:.2g} m;"
        " error = decoded - original",
    )


def _rows(result: dict[str, Any], series: Series) -> list[tuple[str, str]]:
    return [
        ("data", f"{result['data']}, {extent(series.shape)} {series.dtype}"),
        ("container", f"{result['path']}, by fhash encode {result['settings']}"),
        ("picture", result["picture"]),
        ("size", compared(result)),
        ("coreset", f"{result['coreset_fraction']:.3%} of the domain"),
        *quality_rows(result),
        ("encoding", f"{duration(result['seconds'])} on {result['device']}"),
        ("comparing", duration(result["diff_seconds"])),
    ]
