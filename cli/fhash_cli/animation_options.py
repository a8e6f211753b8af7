"""The options of `fhash render` that make several pictures: animations, evolution, and features in colours of their own."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import Command, RealRange, SliceType, check_writable
from fhash_cli.output import Progress, number, table
from fhash_cli.selection import steps_of
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_codec import Volume
    from fhash_codec.rendering.animation.tracking import Tracked
    from fhash_codec.rendering.scene.scene import Scene

__all__ = ["AnimationOptions", "add_animation_options", "run_animation", "tracking"]

OWN = "own"
"""What `--track` takes for the features of the file."""


@dataclass(frozen=True, kw_only=True)
class AnimationOptions:
    """What the options of `add_animation_options` came to."""

    animate: str | None
    frames: int | None
    fps: float | None
    pictures: str | None
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
        ):
            if given is not None and self.animate is None:
                raise click.UsageError(f"{name} is of an animation: give --animate too")
        if self.columns is not None and self.evolution is None:
            raise click.UsageError("--columns is of an evolution: give --evolution too")

    def several(self, scene: Scene) -> bool:
        """Whether there is more than one picture to make, which `run_animation` does."""
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
        """The features of `--track`, none without it."""
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
        help="steps[=A:B], time[=A:B], orbit[=DEGREES], separated by commas, or a file (TOML, JSON).",
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
        help="Of a film, keep the pictures too: NAME.0000.png and so on.",
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
        help=f"Draw interval:LO:HI, isosurface:V or segmentation[:T] in a colour of its own; repeat. '{OWN}': those of the file.",
    )
    @functools.wraps(command)
    def collected(**values: Any) -> None:
        names = [field.name for field in dataclasses.fields(AnimationOptions)]
        command(several=AnimationOptions(**{name: values.pop(name) for name in names}), **values)

    return collected


def tracking(volume: Volume, scene: Scene, options: AnimationOptions, progress: Progress) -> Scene:
    """The scene with the features of `--track` instead of its transfer function; itself without the option."""
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
    """Make the pictures of `--animate`, or of a scene that is an evolution, at `output`; the result as JSON values and as text.

    Only for options and a scene that are `several`; applies `--track` itself. Raises InputError before any work for outputs that cannot
    be written.
    """
    from pathlib import Path

    from fhash_codec.rendering import render
    from fhash_codec.rendering.animation.animate import animate, numbered
    from fhash_codec.rendering.animation.animation import Animation
    from fhash_codec.rendering.animation.tracking import follow, tracking_scene
    from fhash_formats.errors import OutputExistsError

    tracked = options.tracked(volume, progress)
    shown = tracking_scene(scene, tracked, volume) if tracked else scene
    if options.animate is not None:
        changes = {
            name: value
            for name, value in (("frames", options.frames), ("fps", options.fps))
            if value is not None
        }
        animation = dataclasses.replace(Animation.parse(options.animate, volume), **changes)  # type: ignore[arg-type]
        for path in (output, options.pictures):
            if path is not None:
                # Numbered pictures that are there may be kept: which must not be replaced is seen when their scenes are known.
                counted = Path(path).suffix.lower() == ".png"
                check_writable(
                    numbered(Path(path), 1)[0] if counted else path,
                    force or counted,
                    sources=[volume.path],
                )
        try:
            done = animate(
                volume,
                shown,
                animation,
                output,
                pictures=options.pictures,
                force=force,
                progress=progress,
            )
        except OutputExistsError as error:
            # Nothing has failed yet but the command as it was written.
            raise InputError(str(error)) from error
        result = done.to_dict()
        rows = [
            (
                "written",
                result["paths"][0]
                if len(result["paths"]) == 1
                else f"{result['paths'][0]} to {result['paths'][-1]}",
            ),
            ("pictures", f"{done.rendered} rendered, {done.kept} kept"),
            ("seconds", number(done.seconds, digits=3)),
        ]
        return result, table(rows)
    if Path(output).suffix.lower() != ".png":
        raise InputError(
            f"{output}: an evolution is one picture and is written as .png; use such a name"
        )
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
    text = table(
        [
            ("written", paths[0]),
            ("steps", str(len(steps))),
            ("seconds", number(image.seconds, digits=3)),
        ]
    )
    if followed:
        text += "\n\n" + _places(followed)
    return result, text


def _places(followed: list[dict[str, Any]]) -> str:
    """How large each feature is at each step, and where its middle is."""
    header = ("step", *(entry["feature"] for entry in followed))
    rows = []
    for number_, place in enumerate(followed[0]["steps"]):
        cells = []
        for entry in followed:
            here = entry["steps"][number_]
            middle = (
                ""
                if here["centroid"] is None
                else " at " + ", ".join(f"{part:.4g}" for part in here["centroid"])
            )
            cells.append(f"{here['vertices']:,}{middle}")
        rows.append((f"{place['step']:g}", *cells))
    return table([header, *rows])
