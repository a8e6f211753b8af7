"""`fhash render`: a picture of a container, as a PNG that holds its scene, or as a JPEG."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fhash_cli.animation_options import (
    AnimationOptions,
    add_animation_options,
    run_animation,
    tracking,
)
from fhash_cli.base_command import BaseCommand
from fhash_cli.options import (
    check_writable,
    force_option,
    json_option,
    quiet_option,
    run_argument,
    variable_option,
)
from fhash_cli.output import Progress, emit, extent, number, table
from fhash_cli.scene_options import SceneOptions, scene_options
from fhash_formats.errors import InputError
from fhash_formats.support.locations import file_name

if TYPE_CHECKING:
    from fhash_codec.rendering.picture.image import Image
    from fhash_codec.rendering.picture.plan import Plan
    from fhash_codec.rendering.scene.scene import Scene


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
def command(
    run: str,
    variable: str | None,
    output: str | None,
    options: SceneOptions,
    several: AnimationOptions,
    save_scene: str | None,
    explain: bool,
    force: bool,
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

    path = Path(output) if output is not None else Path(Path(file_name(run)).stem + ".png")
    with open_volume(run, variable=variable) as volume, Progress(quiet=quiet) as progress:
        scene = several.over(options.scene(volume), volume)
        if several.several(scene):
            if explain or save_scene is not None:
                raise click.UsageError(
                    "--explain and --save-scene are for one picture;"
                    " leave them out of an animation or evolution"
                )
            result, text = run_animation(
                volume, scene, several, str(path), force=force, progress=progress
            )
            emit(result, text, as_json)
            return
        scene = tracking(volume, scene, several, progress)
        _check_outputs(path, save_scene, scene, force, run)
        renderer = Renderer(volume)
        plan = renderer.plan(scene)
        image = renderer.render(plan=plan, progress=progress)
        time = time_text(volume.coords["t"], plan.time)
    paths = [str(written) for written in _save(image, path, save_scene, force)]
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
    if explain:
        result["plan"] = plan.to_dict()
    emit(result, _text(plan, image, time, paths, explain), as_json)


def _check_outputs(path: Path, save_scene: str | None, scene: Scene, force: bool, run: str) -> None:
    """Refuse outputs before any work."""
    from fhash_codec.rendering.picture.image import check_picture_name

    check_picture_name(path, scene.background)
    outputs = [path, *(path.with_name(f"{path.stem}.{name}.npy") for name in scene.effects.buffers)]
    if save_scene is not None:
        if Path(save_scene).suffix.lower() != ".json":
            raise InputError(f"{save_scene}: scenes are written as .json; use such a name")
        outputs.append(Path(save_scene))
    for output in outputs:
        check_writable(output, force, sources=[run])


def _save(image: Image, path: Path, save_scene: str | None, force: bool) -> list[Path]:
    """Write the picture, after its scene where one is asked for; the paths written."""
    from fhash_formats.support.atomic import replacing

    if save_scene is None:
        return image.save(path, force=force)
    with replacing(Path(save_scene), force=force) as temporary:
        temporary.write_text(json.dumps(dict(image.scene), indent=2) + "\n", encoding="utf-8")
        paths = image.save(path, force=force)
    return [Path(save_scene), *paths]


def _text(plan: Plan, image: Image, time: str, paths: list[str], explain: bool) -> str:
    from fhash_codec.rendering.task.task import rows

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
