"""Options of `fhash render` for several pictures: animations, evolutions, tracked features."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.intervals import SliceType
from fhash_cli.options import Command, RealRange, check_writable
from fhash_cli.output import Progress, number, table
from fhash_cli.selection import steps_of
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_codec import Volume
    from fhash_codec.rendering.animation.tracking import Tracked
    from fhash_codec.rendering.scene.scene import Scene

__all__ = ["AnimationOptions", "add_animation_options", "run_animation", "tracking"]

OWN = "own"
"""Value of `--track` that stands for the features of the file."""


@dataclass(frozen=True, kw_only=True)
class AnimationOptions:
    """Values of the options that `add_animation_options` adds."""

    animate: str | None
    frames: int | None
    fps: float | None
    pictures: str | None
    processes: int | None
    evolution: slice | None
    columns: int | None
    track: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.animate is not None and self.evolution is not None:
            raise click.UsageError("--animate and --evolution exclude each other")
        for name, given in (
            ("--frames", self.frames),
            ("--fps", self.fps),
            ("--pictures", self.pictures),
            ("--processes", self.processes),
        ):
            if given is not None and self.animate is None:
                raise click.UsageError(f"{name} is of an animation: give --animate too")
        if self.columns is not None and self.evolution is None:
            raise click.UsageError("--columns is of an evolution: give --evolution too")

    def several(self, scene: Scene) -> bool:
        """Whether there is more than one picture to draw; `run_animation` then draws them."""
        return self.animate is not None or scene.evolution is not None

    def over(self, scene: Scene, volume: Volume) -> Scene:
        """The scene with the steps of `--evolution`; itself without the option."""
        from fhash_codec.rendering.scene.scene import Evolution

        if self.evolution is None:
            return scene
        steps = tuple(map(float, steps_of(volume, self.evolution, "--evolution")))
        return dataclasses.replace(
            scene, step=None, time=None, evolution=Evolution(steps=steps, columns=self.columns)
        )

    def tracked(self, volume: Volume, progress: Progress) -> list[Tracked]:
        """The features of `--track`; none without the option."""
        from fhash_codec.rendering.animation.tracking import parse_tracked

        if not self.track:
            return []
        if OWN in self.track and len(self.track) > 1:
            raise InputError(
                f"--track {OWN} stands for the features of the file; leave it out, or the others"
            )
        return parse_tracked([] if OWN in self.track else self.track, volume, progress)


def add_animation_options(command: Command) -> Command:
    """Add the options of AnimationOptions; the command gets them as `several`."""

    @click.option(
        "--animate",
        metavar="SPEC",
        help="steps[=A:B[:EVERY]], time[=A:B[:EVERY]], orbit[=DEGREES], separated by commas,"
        " or a file (TOML, JSON). Times may be dates.",
    )
    @click.option(
        "--frames", type=click.IntRange(1, 100_000), metavar="N", help="Pictures of an animation."
    )
    @click.option(
        "--fps", type=RealRange(0.1, 240), metavar="X", help="Pictures per second of a film."
    )
    @click.option(
        "--pictures",
        metavar="NAME.png",
        type=click.Path(),
        help="Keep the pictures of a film too: NAME.0000.png and so on.",
    )
    @click.option(
        "--processes",
        type=click.IntRange(1, 256),
        metavar="N",
        help="Processes that render at a time, for films of some hundred pictures or more: one uses"
        " all cores too, and each further one takes a second to start.  [default: 1]",
    )
    @click.option(
        "--evolution",
        metavar="A:B:S",
        type=SliceType(),
        help="These steps side by side in one picture.",
    )
    @click.option(
        "--columns",
        type=click.IntRange(1, 1000),
        metavar="N",
        help="Pictures beside each other of an evolution.",
    )
    @click.option(
        "--track",
        metavar="FEATURE[=#RRGGBB]",
        multiple=True,
        help="Draw interval:LO:HI, isosurface:V or segmentation[:T] in a colour of its own; repeat."
        f" '{OWN}': those of the file.",
    )
    @functools.wraps(command)
    def collected(**values: Any) -> None:
        names = [field.name for field in dataclasses.fields(AnimationOptions)]
        command(several=AnimationOptions(**{name: values.pop(name) for name in names}), **values)

    return collected


def tracking(volume: Volume, scene: Scene, options: AnimationOptions, progress: Progress) -> Scene:
    """The scene with the features of `--track` in place of its transfer function.

    Without the option it is the scene itself.
    """
    from fhash_codec.rendering.animation.tracking import tracking_scene

    tracked = options.tracked(volume, progress)
    return tracking_scene(scene, tracked, volume) if tracked else scene


def run_animation(
    volume: Volume,
    scene: Scene,
    options: AnimationOptions,
    output: str,
    *,
    force: bool,
    progress: Progress,
) -> tuple[dict[str, Any], str]:
    """Draw the pictures of `--animate` or of an evolution; the result as JSON values and as text.

    Only for options and a scene that are `several`; applies `--track` itself. Raises InputError
    before any work for outputs that cannot be written.
    """
    if options.animate is not None:
        return _animate(volume, scene, options, output, force=force, progress=progress)
    return _draw_evolution(volume, scene, options, output, force=force, progress=progress)


def _animate(
    volume: Volume,
    scene: Scene,
    options: AnimationOptions,
    output: str,
    *,
    force: bool,
    progress: Progress,
) -> tuple[dict[str, Any], str]:
    """Draw the pictures or the film of `--animate`."""
    from fhash_codec.rendering.animation.animate import animate
    from fhash_codec.rendering.animation.animation import Animation
    from fhash_formats.errors import OutputExistsError

    assert options.animate is not None
    shown = tracking(volume, scene, options, progress)
    animation = Animation.parse(options.animate, volume)
    if options.frames is not None:
        animation = dataclasses.replace(animation, frames=options.frames)
    if options.fps is not None:
        animation = dataclasses.replace(animation, fps=options.fps)
    _check_pictures(volume, output, options.pictures, force)
    try:
        done = animate(
            volume,
            shown,
            animation,
            output,
            pictures=options.pictures,
            force=force,
            progress=progress,
            processes=options.processes or 1,
        )
    except OutputExistsError as error:
        # Only the command line is wrong so far: exit code 2.
        raise InputError(str(error)) from error
    result = done.to_dict()
    first, last = result["paths"][0], result["paths"][-1]
    rows = [
        ("written", first if len(result["paths"]) == 1 else f"{first} to {last}"),
        ("pictures", f"{done.rendered} rendered, {done.kept} kept"),
        ("seconds", number(done.seconds, digits=3)),
    ]
    return result, table(rows)


def _check_pictures(volume: Volume, output: str, pictures: str | None, force: bool) -> None:
    """Refuse outputs of an animation before any work."""
    from pathlib import Path

    from fhash_codec.rendering.animation.animate import numbered

    for path in (output, pictures):
        if path is not None:
            # Numbered pictures that exist may be kept; only their scenes will tell which may not
            # be replaced.
            counted = Path(path).suffix.lower() == ".png"
            first = numbered(Path(path), 1)[0] if counted else path
            check_writable(first, force or counted, sources=[volume.path])


def _draw_evolution(
    volume: Volume,
    scene: Scene,
    options: AnimationOptions,
    output: str,
    *,
    force: bool,
    progress: Progress,
) -> tuple[dict[str, Any], str]:
    """Draw an evolution as one picture, and follow the features of `--track`."""
    from pathlib import Path

    from fhash_codec.rendering import render
    from fhash_codec.rendering.animation.tracking import follow, tracking_scene
    from fhash_codec.rendering.picture.image import check_picture_name

    tracked = options.tracked(volume, progress)
    shown = tracking_scene(scene, tracked, volume) if tracked else scene
    check_picture_name(Path(output), shown.background)
    check_writable(output, force, sources=[volume.path])
    assert shown.evolution is not None
    steps = list(shown.evolution.steps)
    image = render(volume, shown, progress=progress)
    paths = [str(path) for path in image.save(output, force=force)]
    followed = follow(volume, tracked, steps) if tracked else []
    result = {
        "paths": paths,
        "steps": steps,
        "size": list(image.rgba.shape[1::-1]),
        "counters": dict(image.counters),
        "seconds": image.seconds,
        "tracked": followed,
    }
    rows = [
        ("written", paths[0]),
        ("steps", str(len(steps))),
        ("seconds", number(image.seconds, digits=3)),
    ]
    return result, table(rows) + ("\n\n" + _places(followed) if followed else "")


def _places(followed: list[dict[str, Any]]) -> str:
    """Size and centroid of each feature at each step."""
    header = ("step", *(entry["feature"] for entry in followed))
    rows = []
    for places in zip(*(entry["steps"] for entry in followed), strict=True):
        cells = []
        for place in places:
            centroid = place["centroid"]
            middle = "" if centroid is None else " at " + ", ".join(f"{x:.4g}" for x in centroid)
            cells.append(f"{place['vertices']:,}{middle}")
        rows.append((f"{places[0]['step']:g}", *cells))
    return table([header, *rows])
