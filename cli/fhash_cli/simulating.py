"""Simulations of the command line: the options of a scene, and a series written frame by frame."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import check_writable
from fhash_cli.output import duration, extent, listed, number, size
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fhash_codec.simulation.simulate import Simulation

__all__ = [
    "SceneOptions",
    "ShapeType",
    "describe",
    "is_data_file",
    "refuse_scene_options",
    "result_of",
    "scene_options",
    "simulation_rows",
    "write_series",
]

OVERHEAD_BYTES = 2**20
"""Bytes of a file beside its values: header, coordinates, indices of chunks."""


class ShapeType(click.ParamType[dict[str, int]]):
    """Vertices along z, y and x as `Z,Y,X`, or by name as `x=64,y=64,z=32`, with `t` for steps."""

    name = "Z,Y,X"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, int]:
        """Lengths by axis."""
        if isinstance(value, dict):
            return value
        text = str(value)
        try:
            return _shape(text)
        except ValueError:
            self.fail(
                f"'{text[:60]}' is not Z,Y,X such as 54,172,200, nor x=200,y=172,z=54", param, ctx
            )


def _shape(text: str) -> dict[str, int]:
    """Lengths by axis; raises ValueError for a text of another form."""
    if "=" not in text:
        words = text.split(",")
        if len(words) != 3 or not all(
            word.strip().isascii() and word.strip().isdecimal() for word in words
        ):
            raise ValueError
        return dict(zip("zyx", map(int, words), strict=True))
    from fhash_formats import parse_shape

    shape = parse_shape(text)
    if not set("zyx") <= set(shape):
        raise ValueError
    return shape


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options that `scene_options` adds: they say what to simulate."""

    scene: str
    shape: dict[str, int] | None
    steps: int | None
    paper_shape: bool
    seed: int

    @property
    def name(self) -> str:
        """The preset's name, or the file's without folder and suffix."""
        return Path(self.scene).stem

    @property
    def given(self) -> list[str]:
        """Names of the options that change a scene's own settings."""
        return [name for name in ("shape", "steps", "paper_shape", "seed") if getattr(self, name)]

    def open(self) -> Simulation:
        """The simulation; raises InputError for an unsuitable scene or shape."""
        from fhash_codec.simulation.scene import scene_of
        from fhash_codec.simulation.simulate import Simulation

        steps, shape = self.steps, None
        if self.shape is not None:
            if "t" in self.shape and steps is not None:
                raise click.UsageError("--shape t=... and --steps exclude each other")
            steps = self.shape.get("t", steps)
            shape = self.shape["z"], self.shape["y"], self.shape["x"]
        if self.paper_shape and (shape is not None or steps is not None):
            raise click.UsageError("--paper-shape excludes --shape and --steps")
        scene = scene_of(self.scene)
        scene = scene.as_in_paper() if self.paper_shape else scene.resized(shape, steps)
        return Simulation(scene, self.seed)


def scene_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of SceneOptions; the command gets them as `chosen`."""

    @click.option(
        "--scene",
        default="vortex",
        show_default=True,
        metavar="NAME|FILE",
        help="What to simulate: vortex, front, flame, bubble, shell, or a TOML or JSON file with a"
        " list of effects.",
    )
    @click.option(
        "--shape",
        type=ShapeType(),
        help="Vertices along z, y and x, such as 54,172,200 or x=200,y=172,z=54. Default: a small"
        " shape of the scene's own.",
    )
    @click.option("--steps", type=click.IntRange(1), metavar="N", help="Number of steps.")
    @click.option(
        "--paper-shape",
        is_flag=True,
        help="Shape and steps of the paper's data set that flame, bubble or shell resembles.",
    )
    @click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=0,
        show_default=True,
        metavar="S",
        help="Seed of the scene's random numbers.",
    )
    @functools.wraps(command)
    def collected(**values: Any) -> None:
        names = ("scene", "shape", "steps", "paper_shape", "seed")
        command(chosen=SceneOptions(**{name: values.pop(name) for name in names}), **values)

    return collected


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
    path: Path, chosen: SceneOptions, simulation: Simulation, *, force: bool, progress: Progress
) -> tuple[list[str], float]:
    """Write a simulated series frame by frame; complete or absent.

    Returns the paths written, and seconds. Raises InputError for an output that cannot be, and
    OutputError for a disk with too little room.
    """
    from fhash_formats import Region, save_region
    from fhash_formats.support.files import check_space

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


def result_of(
    chosen: SceneOptions, simulation: Simulation, seconds: float, explain: bool
) -> dict[str, Any]:
    """A simulation as JSON values: what was computed, and with `explain` why."""
    from fhash_codec.simulation.simulate import counts, reasons

    result: dict[str, Any] = {
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
    effects = counted.pop("effects")
    rows += [(f"  {name}", f"{value:,}") for name, value in counted.items()]
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
