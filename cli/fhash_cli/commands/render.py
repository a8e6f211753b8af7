"""`fhash render`: pictures of a container: one, an animation, an evolution, or tracked features."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    BaseCommand,
    RealRange,
    SliceType,
    check_writable,
    force_option,
    json_option,
    option_group,
    quiet_option,
    run_argument,
    variable_option,
)
from fhash_cli.output import Progress, emit, extent, number, table
from fhash_cli.scene_options import SceneOptions, scene_options
from fhash_cli.selection import steps_of
from fhash_formats.errors import InputError
from fhash_formats.support.files import file_name

if TYPE_CHECKING:
    from fhash_codec import Volume
    from fhash_codec.rendering.image import Image
    from fhash_codec.rendering.plan import Plan
    from fhash_codec.rendering.scenes import Scene
    from fhash_codec.rendering.tracking import Tracked

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
        from fhash_codec.rendering.scenes import Evolution

        if self.evolution is None:
            return scene
        steps = tuple(map(float, steps_of(volume, self.evolution, "--evolution")))
        return dataclasses.replace(
            scene, step=None, time=None, evolution=Evolution(steps=steps, columns=self.columns)
        )

    def tracked(self, volume: Volume, progress: Progress) -> list[Tracked]:
        """The features of `--track`; none without the option."""
        from fhash_codec.rendering.tracking import parse_tracked

        if not self.track:
            return []
        if OWN in self.track and len(self.track) > 1:
            raise InputError(
                f"--track {OWN} stands for the features of the file; leave it out, or the others"
            )
        return parse_tracked([] if OWN in self.track else self.track, volume, progress)


add_animation_options = option_group(
    AnimationOptions,
    "several",
    click.option(
        "--animate",
        metavar="SPEC",
        help="steps[=A:B[:EVERY]], time[=A:B[:EVERY]], orbit[=DEGREES], separated by commas,"
        " or a file (TOML, JSON). Times may be dates.",
    ),
    click.option(
        "--frames", type=click.IntRange(1, 100_000), metavar="N", help="Pictures of an animation."
    ),
    click.option(
        "--fps", type=RealRange(0.1, 240), metavar="X", help="Pictures per second of a film."
    ),
    click.option(
        "--pictures",
        metavar="NAME.png",
        type=click.Path(),
        help="Keep the pictures of a film too: NAME.0000.png and so on.",
    ),
    click.option(
        "--processes",
        type=click.IntRange(1, 256),
        metavar="N",
        help="Processes that render at a time, for films of some hundred pictures or more: one uses"
        " all cores too, and each further one takes a second to start.  [default: 1]",
    ),
    click.option(
        "--evolution",
        metavar="A:B:S",
        type=SliceType(),
        help="These steps side by side in one picture.",
    ),
    click.option(
        "--columns",
        type=click.IntRange(1, 1000),
        metavar="N",
        help="Pictures beside each other of an evolution.",
    ),
    click.option(
        "--track",
        metavar="FEATURE[=#RRGGBB]",
        multiple=True,
        help="Draw interval:LO:HI, isosurface:V or segmentation[:T] in a colour of its own; repeat."
        f" '{OWN}': those of the file.",
    ),
)
"""Options of several pictures; the command gets them as `several`."""


def tracking(volume: Volume, scene: Scene, options: AnimationOptions, progress: Progress) -> Scene:
    """The scene with the features of `--track` in place of its transfer function.

    Without the option it is the scene itself.
    """
    from fhash_codec.rendering.tracking import tracking_scene

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
    from fhash_codec.rendering.film import Target, animate
    from fhash_codec.rendering.timeline import Animation
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
            Target(
                output=output,
                pictures=options.pictures,
                force=force,
                processes=options.processes or 1,
            ),
            progress=progress,
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

    from fhash_codec.rendering.film import numbered

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
    from fhash_codec.rendering.image import check_picture_name
    from fhash_codec.rendering.tracking import follow, tracking_scene

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


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Options of `fhash render` about the files of one picture, and what is said of it."""

    output: str | None
    save_scene: str | None
    explain: bool
    force: bool


@click.command("render", cls=BaseCommand)
@run_argument
@variable_option
@click.option(
    "-o",
    "output",
    metavar="VIEW.png",
    type=click.Path(),
    help="The picture to write, .png or .jpg; only a .png holds its scene."
    "  [default: RUN.png in this folder]",
)
@scene_options
@add_animation_options
@click.option(
    "--save-scene",
    metavar="FILE.json",
    type=click.Path(),
    help="Write the scene, to be used again by --scene.",
)
@click.option("--explain", is_flag=True, help="Print the plan, and what the picture took.")
@force_option
@json_option
@quiet_option
@option_group(PictureOptions, "picture")
def command(
    run: str,
    variable: str | None,
    options: SceneOptions,
    several: AnimationOptions,
    picture: PictureOptions,
    as_json: bool,
    quiet: bool,
) -> None:
    """Draw RUN.fhz at one time; unless options say more, the file's features decide what is shown.

    A volume with an axis of one vertex is drawn as an opaque plane, seen from above.
    With --animate the output is NAME.png for numbered pictures, of which only missing ones are
    drawn, or a film NAME.mp4 or NAME.gif.
    """
    from fhash_codec.rendering.renderer import Renderer
    from fhash_codec.times import time_text
    from fhash_codec.volume import open as open_volume

    output = picture.output if picture.output is not None else Path(file_name(run)).stem + ".png"
    path = Path(output)
    with open_volume(run, variable=variable) as volume, Progress(quiet=quiet) as progress:
        scene = several.over(options.scene(volume), volume)
        if several.several(scene):
            if picture.explain or picture.save_scene is not None:
                raise click.UsageError(
                    "--explain and --save-scene are for one picture;"
                    " leave them out of an animation or evolution"
                )
            result, text = run_animation(
                volume, scene, several, str(path), force=picture.force, progress=progress
            )
            emit(result, text, as_json)
            return
        scene = tracking(volume, scene, several, progress)
        _check_outputs(path, picture, scene, run)
        renderer = Renderer(volume)
        plan = renderer.plan(scene)
        image = renderer.render(plan=plan, progress=progress)
        time = time_text(volume.coords["t"], plan.time)
    paths = [str(written) for written in _save(image, path, picture)]
    result = {
        "paths": paths,
        "size": list(scene.size),
        "step": plan.step,
        "time": plan.time,
        "march": plan.mode,
        "lod": plan.lod,
        "counters": dict(image.counters),
        "seconds": image.seconds,
    }
    if picture.explain:
        result["plan"] = plan.to_dict()
    emit(result, _text(plan, image, time, paths, picture.explain), as_json)


def _check_outputs(path: Path, picture: PictureOptions, scene: Scene, run: str) -> None:
    """Refuse outputs before any work."""
    from fhash_codec.rendering.image import check_picture_name

    check_picture_name(path, scene.background)
    outputs = [path, *(path.with_name(f"{path.stem}.{name}.npy") for name in scene.effects.buffers)]
    if (scene_file := picture.save_scene) is not None:
        if Path(scene_file).suffix.lower() != ".json":
            raise InputError(f"{scene_file}: scenes are written as .json; use such a name")
        outputs.append(Path(scene_file))
    for output in outputs:
        check_writable(output, picture.force, sources=[run])


def _save(image: Image, path: Path, picture: PictureOptions) -> list[Path]:
    """Write the picture, after its scene where one is asked for; the paths written."""
    from fhash_formats.support.files import replacing

    if picture.save_scene is None:
        return image.save(path, force=picture.force)
    scene = Path(picture.save_scene)
    with replacing(scene, force=picture.force) as temporary:
        temporary.write_text(json.dumps(dict(image.scene), indent=2) + "\n", encoding="utf-8")
        paths = image.save(path, force=picture.force)
    return [scene, *paths]


def _text(plan: Plan, image: Image, time: str, paths: list[str], explain: bool) -> str:
    from fhash_codec.rendering.march_task import rows

    lines = [("written", path) for path in paths]
    if not explain:
        height, width = image.rgba.shape[:2]
        lines += [
            ("size", extent((width, height))),
            ("step", f"{plan.step:g}, t = {time}"),
        ]
    if Path(paths[-1]).suffix.lower() != ".png" and len(paths) == 1:
        lines.append(("scene", "not in a JPEG; --save-scene FILE.json keeps it"))
    lines.append(("seconds", number(image.seconds, digits=3)))
    if not explain:
        return table(lines)
    counted = [(name, f"{count:>13}  {text}") for name, count, text in rows(image.counters)]
    return "\n\n".join((table(list(plan.reasons)), table(counted), table(lines)))
