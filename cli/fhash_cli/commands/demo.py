"""`fhash demo`: simulates a scene, encodes it, compares and draws it; or streams it to a file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    BaseCommand,
    check_writable,
    force_option,
    json_option,
    make_folder,
    quiet_option,
)
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
from fhash_cli.simulating import (
    SceneOptions,
    describe,
    is_data_file,
    refuse_scene_options,
    result_of,
    scene_options,
    simulation_rows,
    write_series,
)

if TYPE_CHECKING:
    from PIL import Image

    from fhash_codec import Volume
    from fhash_codec.simulation.simulate import Simulation
    from fhash_formats.series import Series

Rows = list[tuple[str, str]]

COLUMNS = 4
"""Steps that the picture shows side by side."""


@click.command("demo", cls=BaseCommand)
@scene_options
@click.option(
    "-o",
    "output",
    metavar="OUT",
    type=click.Path(),
    default="demo",
    show_default=True,
    help="Folder for the three files; or the name of a file of the series alone, which is then"
    " streamed to disk: .h5, .nc, .zarr, .npy, .raw, .vti, .vtr, .pvd, .vtkhdf.",
)
@click.option(
    "--gallery",
    metavar="DIR",
    type=click.Path(),
    help="Make the gallery instead: pictures in DIR, and the page DIR.md with their commands.",
)
@click.option(
    "--explain", is_flag=True, help="Print what was computed and why, what was not, and counters."
)
@force_option
@json_option
@quiet_option
def command(
    chosen: SceneOptions,
    output: str,
    gallery: str | None,
    explain: bool,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Simulate a scene, encode, decode, compare and draw it: OUT/SCENE.h5, .fhz and .png.

    With a file as OUT, such as run.h5, only simulate, and write the series.
    """
    if gallery is not None:
        refuse_scene_options(chosen, "--gallery")
        _make_gallery(gallery, force, as_json, quiet)
        return
    simulation = chosen.open()
    run = _simulate_only if is_data_file(Path(output)) else _demonstrate
    with Progress(quiet=quiet) as progress:
        result, rows = run(Path(output), chosen, simulation, explain, force, progress)
    emit(result, table(rows), as_json)


def _make_gallery(folder: str, force: bool, as_json: bool, quiet: bool) -> None:
    from fhash_cli.commands import encode, render
    from fhash_cli.gallery import make_gallery

    commands: dict[str, click.Command] = {"encode": encode.command, "render": render.command}
    made = make_gallery(Path(folder), commands, force=force, quiet=quiet)
    emit(made, table([("page", made["page"]), ("pictures", str(len(made["pictures"])))]), as_json)


def _simulate_only(
    path: Path,
    chosen: SceneOptions,
    simulation: Simulation,
    explain: bool,
    force: bool,
    progress: Progress,
) -> tuple[dict[str, Any], Rows]:
    """Write the series to a file; the result as JSON values, and as rows."""
    check_writable(path, force, region=True)
    if not progress.quiet:
        say(describe(chosen, simulation))
    paths, seconds = write_series(path, chosen, simulation, force=force, progress=progress)
    result = {"paths": paths, **result_of(chosen, simulation, seconds, explain)}
    rows = [
        *(("written", written) for written in paths),
        ("t, z, y, x", f"{extent(simulation.shape)}, {simulation.dtype}"),
        *simulation_rows(simulation, seconds, explain),
    ]
    return result, rows


def _demonstrate(
    folder: Path,
    chosen: SceneOptions,
    simulation: Simulation,
    explain: bool,
    force: bool,
    progress: Progress,
) -> tuple[dict[str, Any], Rows]:
    """Simulate, encode, compare and draw; the result as JSON values, and as rows."""
    import fhash_codec
    from fhash_codec.config import EncodeConfig
    from fhash_codec.features.features import parse_feature
    from fhash_codec.volume import open as open_volume
    from fhash_formats import open_series
    from fhash_formats.support.files import replacing

    data, run, picture = (folder / f"{chosen.name}.{suffix}" for suffix in ("h5", "fhz", "png"))
    parse_feature(simulation.scene.feature)
    config = EncodeConfig(features=(simulation.scene.feature,))
    make_folder(folder)
    for output in (data, run, picture):
        check_writable(
            output, force, sources=[other for other in (data, run, picture) if other != output]
        )
    if not progress.quiet:
        say(describe(chosen, simulation))
    _, simulating = write_series(data, chosen, simulation, force=force, progress=progress)
    encoded = fhash_codec.encode(data, run, config, force=force, progress=progress)
    start = time.perf_counter()
    report = fhash_codec.diff(data, run, progress=progress)
    seconds = time.perf_counter() - start
    with (
        open_series(data) as series,
        open_volume(run) as volume,
        replacing(picture, force=force) as temporary,
    ):
        _draw(chosen.name, series, volume, report).save(temporary, format="PNG", optimize=True)
    result = {
        **report,
        "seconds": encoded["seconds"],
        "diff_seconds": seconds,
        "data": str(data),
        "path": str(run),
        "picture": str(picture),
        "settings": f"--feature {config.features[0]}",
        **result_of(chosen, simulation, simulating, explain),
    }
    return result, [*_rows(result, series), *simulation_rows(simulation, simulating, explain)]


def _draw(scene: str, series: Series, volume: Volume, report: dict[str, Any]) -> Image.Image:
    """Draw the slice of constant z with the most of the coreset, at evenly spread steps."""
    from fhash_codec.gallery import Pair, compare

    count = series.shape[0]
    columns = min(COLUMNS, count)
    steps = [int((index + 0.5) * count / columns) for index in range(columns)]
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
