"""`fhash demo`: simulates a scene, encodes it, compares and draws it; or streams it to a file."""

from __future__ import annotations

import contextlib
import io
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, TypedDict

import click

from fhash_cli.options import (
    BaseCommand,
    TextType,
    check_writable,
    force_option,
    json_option,
    make_folder,
    option_group,
    quiet_option,
)
from fhash_cli.output import (
    Progress,
    compared,
    duration,
    emit,
    extent,
    listed,
    number,
    quality_rows,
    say,
    size,
    table,
)
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image

    from fhash_codec import Volume
    from fhash_codec.comparison import Compared
    from fhash_codec.progress import Progress as Callback
    from fhash_codec.simulation.simulate import Counts, Simulation
    from fhash_formats.series import Series

OVERHEAD_BYTES = 2**20
"""Bytes of a file beside its values: header, coordinates, indices of chunks."""


PAPER: dict[str, int] = {}
"""The shape of the paper's data."""


def _shape(text: str) -> dict[str, int]:
    from fhash_formats.readers.file_series import parse_shape

    words = [word.strip() for word in text.split(",")]
    if len(words) == 3 and all(word.isascii() and word.isdecimal() for word in words):
        return dict(zip("zyx", map(int, words), strict=True))
    if text == "paper":
        return PAPER
    shape: dict[str, int] = {}
    with contextlib.suppress(ValueError):
        shape = parse_shape(text)
    if not set("zyx") <= set(shape):
        raise ValueError(f"'{text[:60]}' is not Z,Y,X such as 54,172,200, nor x=200,y=172,z=54")
    return shape


SHAPE = TextType("Z,Y,X|paper", _shape)
"""Vertices along z, y and x as `Z,Y,X`, or by name as `x=64,y=64,z=32`, with `t` for steps."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options that `scene_options` adds: they say what to simulate."""

    scene: str
    shape: dict[str, int] | None
    steps: int | None
    seed: int

    @property
    def name(self) -> str:
        """The preset's name, or the file's without folder and suffix."""
        return Path(self.scene).stem

    @property
    def given(self) -> list[str]:
        """Names of the options that change a scene's own settings."""
        return [name for name in ("shape", "steps", "seed") if getattr(self, name)]

    def open(self) -> Simulation:
        """The simulation; raises InputError for an unsuitable scene or shape."""
        from fhash_codec.simulation.scene import scene_of
        from fhash_codec.simulation.simulate import Simulation

        steps, shape = self.steps, None
        if self.shape == PAPER:
            if steps is not None:
                raise click.UsageError("--shape paper excludes --steps")
            return Simulation(scene_of(self.scene).as_in_paper(), self.seed)
        if self.shape is not None:
            if "t" in self.shape and steps is not None:
                raise click.UsageError("--shape t=... and --steps exclude each other")
            steps = self.shape.get("t", steps)
            shape = self.shape["z"], self.shape["y"], self.shape["x"]
        return Simulation(scene_of(self.scene).resized(shape, steps), self.seed)


scene_options = option_group(
    SceneOptions,
    "chosen",
    click.option(
        "--scene",
        default="vortex",
        show_default=True,
        metavar="NAME|FILE",
        help="What to simulate: vortex, front, flame, bubble, shell, or a TOML or JSON file with a"
        " list of effects.",
    ),
    click.option(
        "--shape",
        type=SHAPE,
        help="Vertices along z, y and x, such as 54,172,200 or x=200,y=172,z=54; paper for shape"
        " and steps of the paper's data that flame, bubble or shell resembles. Default: a small"
        " shape of the scene's own.",
    ),
    click.option(
        "--steps",
        type=click.IntRange(1),
        metavar="N",
        help="Number of steps. Default: a small number of the scene's own.",
    ),
    click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=0,
        show_default=True,
        metavar="S",
        help="Seed of the scene's random numbers.",
    ),
)
"""Options that say what to simulate; the command gets them as `chosen`."""


def is_data_file(path: Path) -> bool:
    """Whether a name is that of a file of values, by its suffix, and not that of a folder."""
    from fhash_formats.writers.registry import WRITERS

    return any(path.suffix.lower() in writer.suffixes for writer in WRITERS)


def describe(chosen: SceneOptions, simulation: Simulation) -> str:
    """One line that says what is simulated and how large it is."""
    helped = f", {simulation.scene.help}" if simulation.scene.help else ""
    values = f"{extent(simulation.shape)} values, {size(raw_bytes(simulation))}"
    return f"simulating '{chosen.name}'{helped}: {values}"


def raw_bytes(simulation: Simulation) -> int:
    """Bytes of all values."""
    return math.prod(simulation.shape) * simulation.dtype.itemsize


def write_series(
    path: Path, chosen: SceneOptions, simulation: Simulation, *, force: bool, progress: Callback
) -> tuple[list[str], float]:
    """Write a simulated series frame by frame; complete or absent.

    Returns the paths written, and seconds. Raises InputError for an output that cannot be, and
    OutputError for a disk with too little room.
    """
    from fhash_formats.support.files import check_space
    from fhash_formats.writers.common import Region
    from fhash_formats.writers.registry import save_region

    check_writable(path, force, region=True, sources=_sources(chosen))
    check_space(path, raw_bytes(simulation) + OVERHEAD_BYTES)
    region = Region.of(simulation)
    start = time.perf_counter()

    def frames() -> Iterator[npt.NDArray[np.float32]]:
        total = simulation.shape[0]
        for step in range(total):
            yield simulation.read(step)
            progress("simulating", step + 1, total, "")

    written = save_region(path, region, frames(), force=force, sources=_sources(chosen))
    return [str(each) for each in written], time.perf_counter() - start


def _sources(chosen: SceneOptions) -> list[str]:
    """The file of the scene, which no output may replace."""
    from fhash_codec.simulation.scene import SUFFIXES

    return [chosen.scene] if Path(chosen.scene).suffix.lower() in SUFFIXES else []


class Simulated(TypedDict):
    """A simulation."""

    scene: Annotated[str, "name of the preset, or of the scene's file without its suffix"]
    seed: Annotated[int, "seed of the random numbers"]
    shape: Annotated[list[int], "of the series, (t, z, y, x)"]
    simulate_seconds: Annotated[float, "of the simulation, writing included"]
    counters: Annotated[Counts, "what the simulation took"]
    explain: NotRequired[Annotated[list[list[str]], "`--explain`: topic and reason"]]


class SimulatedFile(Simulated):
    """A simulation that was written to a file."""

    paths: Annotated[list[str], "the files written"]


class Demonstrated(Simulated):
    """A simulation that was encoded and compared."""

    seconds: Annotated[float, "of the encoding"]
    diff_seconds: Annotated[float, "of the comparison"]
    data: Annotated[str, "the simulated series"]
    picture: Annotated[str, "the comparison"]
    settings: Annotated[str, "options of the encoding"]


class Gallery(TypedDict):
    """A gallery that was made."""

    page: Annotated[str, "the page"]
    pictures: Annotated[list[str], "the pictures"]


def result_of(
    chosen: SceneOptions, simulation: Simulation, seconds: float, explain: bool
) -> Simulated:
    """A simulation as JSON values: what was computed, and with `explain` why."""
    from fhash_codec.simulation.simulate import counts, reasons

    result: Simulated = {
        "scene": chosen.name,
        "seed": simulation.seed,
        "shape": list(simulation.shape),
        "simulate_seconds": seconds,
        "counters": counts(simulation),
    }
    if explain:
        result["explain"] = [list(line) for line in reasons(simulation)]
    return result


def simulation_rows(simulation: Simulation, seconds: float, explain: bool) -> list[tuple[str, str]]:
    """Rows of a table about a simulation; with `explain` what was computed, and why."""
    from fhash_codec.simulation.simulate import counts, reasons

    vertices = max(simulation.counters.vertices, 1)
    speed = f"{number(seconds / vertices * 1e9, digits=3)} ns a value"
    rows = [("simulating", f"{duration(seconds)}, {speed}, writing included")]
    if not explain:
        return rows
    rows += [(f"  {topic}", text) for topic, text in reasons(simulation)]
    counted = counts(simulation)
    effects = counted["effects"]
    rows += [(f"  {name}", f"{n:,}") for name, n in counted.items() if isinstance(n, int)]
    zero = [kind for kind, values in effects.items() if not values["places"]]
    rows += [
        (f"  {kind}", f"{values['places']:,} places")
        for kind, values in effects.items()
        if values["places"]
    ]
    return [*rows, ("  0 places", listed(zero))] if zero else rows


def refuse_scene_options(chosen: SceneOptions, instead: str) -> None:
    """Raise InputError if an option changes the scene, where none is simulated."""
    if chosen.given:
        name = chosen.given[0].replace("_", "-")
        raise InputError(f"--{name} is for a scene; leave it out with {instead}")


Rows = list[tuple[str, str]]

COLUMNS = 4
"""Steps that the picture shows side by side."""


@click.command(
    "demo",
    cls=BaseCommand,
    epilog="fhash demo\nfhash demo --scene flame --shape 16,32,32 --steps 8 -o flame.h5",
)
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
) -> tuple[Mapping[str, object], Rows]:
    """Write the series to a file; the result as JSON values, and as rows."""
    check_writable(path, force, region=True)
    if not progress.quiet:
        say(describe(chosen, simulation))
    paths, seconds = write_series(path, chosen, simulation, force=force, progress=progress)
    result: SimulatedFile = {"paths": paths, **result_of(chosen, simulation, seconds, explain)}
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
) -> tuple[Mapping[str, object], Rows]:
    """Simulate, encode, compare and draw; the result as JSON values, and as rows."""
    import fhash_codec
    from fhash_codec.config import EncodeConfig
    from fhash_codec.features.features import parse_feature
    from fhash_codec.volume import open as open_volume
    from fhash_formats.readers.registry import open_series
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
    made: Demonstrated = {
        "seconds": encoded["seconds"],
        "diff_seconds": seconds,
        "data": str(data),
        "picture": str(picture),
        "settings": f"--feature {config.features[0]}",
        **result_of(chosen, simulation, simulating, explain),
    }
    result = {**report, **made}
    return result, [*_rows(result, series), *simulation_rows(simulation, simulating, explain)]


def _draw(scene: str, series: Series, volume: Volume, report: Compared) -> Image.Image:
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


def _rows(result: Mapping[str, Any], series: Series) -> list[tuple[str, str]]:
    return [
        ("data", f"{result['data']}, {extent(series.shape)} {series.dtype}"),
        ("container", f"{result['path']}, by fhash encode {result['settings']}"),
        ("picture", result["picture"]),
        ("size", compared(result)),
        ("coreset", f"{result['coreset_fraction']:.3%} of the domain"),
        *quality_rows(result),
        ("encoding", f"{duration(result['seconds'])} of wall time, on {result['device']}"),
        ("comparing", duration(result["diff_seconds"])),
    ]


def make_gallery(
    folder: Path, run: dict[str, click.Command], *, force: bool, quiet: bool
) -> Gallery:
    """Simulate the series, encode and draw them: FOLDER/*.png, FOLDER/series and FOLDER.md.

    run: the commands `encode` and `render` by name. Returns the written files as JSON values.
    Raises InputError for a folder that cannot be, and for files that exist, unless `force`.
    """
    from fhash_codec.gallery import GALLERY_SERIES, PICTURES, page
    from fhash_formats.support.files import replacing
    from fhash_formats.writers.common import Region
    from fhash_formats.writers.registry import save_region

    data, text = folder / "series", folder.with_name(f"{folder.name}.md")
    try:
        data.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; give a folder that can be made") from error
    pictures = [folder / f"{picture.name}.png" for picture in PICTURES]
    files = [data / f"{name}.{suffix}" for name in GALLERY_SERIES for suffix in ("h5", "fhz")]
    for path in (*pictures, *files, text):
        check_writable(path, force)
    for name, made in GALLERY_SERIES.items():
        if not quiet:
            say(f"simulating and encoding '{name}'")
        series = made.make()
        save_region(data / f"{name}.h5", Region.of(series), series.frames(), force=True)
        paths = str(data / f"{name}.h5"), "-o", str(data / f"{name}.fhz")
        _run(run["encode"], [*paths, *made.options, "--force", "-q"])
    for picture, path in zip(PICTURES, pictures, strict=True):
        if not quiet:
            say(f"drawing '{picture.name}'")
        container = str(data / f"{picture.series}.fhz")
        _run(run["render"], [container, "-o", str(path), *picture.options, "--force", "-q"])
    with replacing(text, force=force) as temporary:
        temporary.write_text(page(folder.name), encoding="utf-8")
    return {"page": str(text), "pictures": [str(path) for path in pictures]}


def _run(command: click.Command, words: list[str]) -> None:
    """Run a command without its output."""
    with contextlib.redirect_stdout(io.StringIO()):
        command.main(words, standalone_mode=False)
