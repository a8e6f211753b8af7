"""`fhash render`: pictures of a container: one, an animation, an evolution, or tracked features."""

from __future__ import annotations

import dataclasses
import functools
import json
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, NotRequired, TypedDict

import click

from fhash_cli.options import (
    PLANE,
    SIZE,
    SLICE,
    BaseCommand,
    Command,
    IntervalsType,
    RealRange,
    check_writable,
    feature_option,
    force_option,
    json_option,
    numbers_type,
    opacity_type,
    option_group,
    quiet_option,
    run_argument,
    variable_option,
)
from fhash_cli.output import Progress, emit, extent, number, say, table
from fhash_cli.selection import steps_of, time_of
from fhash_formats.errors import InputError, suggestion
from fhash_formats.support.files import file_name

if TYPE_CHECKING:
    from fhash_codec import Volume
    from fhash_codec.rendering.image import Image
    from fhash_codec.rendering.plan import Plan
    from fhash_codec.rendering.scenes import Scene
    from fhash_codec.rendering.tracking import Followed, Tracked


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Values of the options that `scene_options` adds.

    Attributes:
        file: path of a scene to begin from, or None.
        places: places of the scene, such as `camera.view`, with their values.
        effects: names of effects to switch on.
        bare: whether only these are on, and not the usual ones as well.
        isosurfaces: texts VALUE[,COLOUR][,OPACITY].
        settings: texts PLACE=VALUE.
    """

    file: str | None
    places: dict[str, Any]
    effects: tuple[str, ...]
    bare: bool = False
    isosurfaces: tuple[str, ...]
    settings: tuple[str, ...]

    def scene(self, volume: Volume) -> Scene:
        """The scene; raises InputError for what it may not hold."""
        from fhash_codec.rendering.scenes import USUAL_EFFECTS, Scene

        base = Scene() if self.file is None else Scene.load(self.file)
        if self.file is None and not self.bare:
            base = dataclasses.replace(base, effects=USUAL_EFFECTS)
        values = base.to_dict()
        if "step" in self.places or "time" in self.places:
            for name in ("step", "time", "evolution"):
                values.pop(name, None)
        for place, value in self.places.items():
            _put(values, place, value)
        if values.get("step") is not None and float(values["step"]) < 0:
            values["step"] += volume.shape[0]
        for name in map(_effect, self.effects):
            _put(values, f"effects.{name}", True)
            if name.endswith("intensity") and self.file is None and "shading" not in self.effects:
                values["effects"].pop("shading", None)  # light on no surface
        if self.isosurfaces:
            _put(values, "effects.isosurfaces", [_isosurface(text) for text in self.isosurfaces])
        surfaces = values.get("effects", {}).get("isosurfaces", ())
        alone = values.get("transfer_function", {}).get("nothing")
        usual = self.file is None and "colour-bar" not in self.effects
        if alone and usual and all("colour" in each for each in surfaces):
            values["effects"].pop("colour_bar", None)  # nothing has its colours
        for setting in self.settings:
            place, equals, text = setting.partition("=")
            if not equals:
                raise InputError(
                    f"--set {setting}: write PLACE=VALUE, such as effects.shading.ambient=0.3"
                )
            _put(values, place.strip(), _json(text))
        if isinstance(values.get("time"), str):
            values["time"] = time_of(volume, values["time"])
        if self.file is None and "size" not in self.places and 1 in volume.shape[1:]:
            from fhash_codec.rendering.cameras import usual_size
            from fhash_codec.rendering.grid import Grid

            scene = Scene.from_dict(values)
            values["size"] = usual_size(scene.camera, Grid.of_volume(volume, scene.scale))
        return Scene.from_dict(values)


class Setting(NamedTuple):
    """An option that sets one part of a scene.

    Attributes:
        flag: the option.
        place: the part, such as `camera.view`.
        metavar: what stands for the value in the help.
        kind: type of the value; that of the field if None.
        help: in place of the field's own.
    """

    flag: str
    place: str
    metavar: str | None = None
    kind: click.ParamType[Any] | None = None
    help: str | None = None

    @property
    def name(self) -> str:
        """The parameter of the command."""
        return self.flag.strip("-").replace("-", "_")

    def option(self) -> Callable[[Command], Command]:
        """The option, with the type and the help of the scene's field."""
        from fhash_codec.rendering.scenes import Scene

        record: Any = Scene
        *above, last = self.place.split(".")
        for part in above:
            hint = typing.get_type_hints(record)[part]
            record = (*typing.get_args(hint), hint)[0]  # of a record or None
        hint = typing.get_type_hints(record)[last]
        number = next((kind for kind in (int, float) if hint in (kind, kind | None)), None)
        field = next(each for each in dataclasses.fields(record) if each.name == last)
        text = self.help
        if text is None:
            choices = ", ".join(field.metadata["choices"])
            text = field.metadata["help"] + (f": {choices}" if choices else "")
        notes = []
        if isinstance(field.default, str | int | float) and "default" not in text:
            notes.append(f"default: {field.default}")
        if number is not None and field.metadata["high"] < 1e12:  # more is met by nobody
            notes.append(f"{field.metadata['low']:g}<=x<={field.metadata['high']:g}")
        if notes:
            text += f".  [{'; '.join(notes)}]"
        return click.option(
            self.flag,
            self.name,
            metavar=self.metavar or ("N" if number is int else "X" if number is float else None),
            type=self.kind or number,
            multiple=self.kind is PLANE,
            help=text[0].upper() + text[1:] + "." * (text[-1] != "]"),
        )


SETTINGS = (
    Setting("--t", "step", "N", help="step, between two of them too; -1 is the last. Default: of"
            " five steps the one of most structure"),
    Setting("--time", "time", "T", click.STRING, "a time instead of a step: a number, or a date"
            " such as 2001-02-10T06:00"),
    Setting("--size", "size", kind=SIZE, help="pixels across and down.  [default: 1024x1024,"
            " a map as its shape is; 512x512 for each step of an evolution]"),
    Setting("--view", "camera.view", "NAME"),
    Setting("--azimuth", "camera.azimuth", "DEGREES"),
    Setting("--elevation", "camera.elevation", "DEGREES"),
    Setting("--zoom", "camera.zoom"),
    Setting("--projection", "camera.projection", "NAME"),
    Setting("--position", "camera.position", kind=numbers_type(3), help="where the camera stands,"
            " in the coordinates of the series"),
    Setting("--focal-point", "camera.focal_point", kind=numbers_type(3)),
    Setting("--view-up", "camera.view_up", kind=numbers_type(3)),
    Setting("--scale", "scale", kind=numbers_type(3), help="stretch the axes.  [default: one in"
            " other units is as long as the rest]"),
    Setting("--cmap", "transfer_function.colours", "NAME", help="colour map, or a ParaView preset"
            " (JSON)"),
    Setting("--opacity", "transfer_function.opacity", kind=opacity_type(), help="name of a"
            " preset: auto, feature, linear, geom, sigmoid, foreground or opaque; or points"),
    Setting("--range", "transfer_function.range", kind=numbers_type(2)),
    Setting("--density", "transfer_function.density"),
    Setting("--gradient-opacity", "transfer_function.gradient_opacity",
            kind=opacity_type(named=False)),
    Setting("--clip-box", "effects.clip", kind=IntervalsType(float), help="show only this part, in"
            " coordinates; an end may be left out"),
    Setting("--clip-plane", "effects.clip.planes", kind=PLANE, help="show only what lies on"
            " the side of the normal, where it times the place is at least D (or X,Y,Z,NX,NY,NZ);"
            " may be repeated"),
    Setting("--background", "background", "COLOUR"),
    Setting("--antialiasing", "effects.antialiasing"),
    Setting("--march", "march.mode", "NAME"),
    Setting("--device", "march.device", "NAME"),
    Setting("--step", "march.step"),
    Setting("--lod", "march.lod"),
)  # fmt: skip
"""Options that set one part of a scene."""


OPTIONS: tuple[Callable[[Command], Command], ...] = (
    click.option(
        "--scene",
        "file",
        metavar="FILE",
        type=click.Path(),
        help="A scene to begin from: JSON, TOML, or a PNG of fhash render.",
    ),
    *(setting.option() for setting in SETTINGS),
    feature_option,
    click.option(
        "--effect",
        "effects",
        metavar="NAME",
        multiple=True,
        help="shadows, ambient-occlusion, maximum-intensity, minimum-intensity,"
        " average-intensity, attenuated-maximum-intensity or jitter, beside shading, box, axes,"
        " colour-bar and time-label, which are on; may be repeated.",
    ),
    click.option(
        "--bare",
        is_flag=True,
        help="No shading, box, axes, colour bar and time but those of --effect.",
    ),
    click.option(
        "--isosurface",
        "isosurfaces",
        metavar="V[,COLOUR][,OPACITY]",
        multiple=True,
        help="A surface; may be repeated.",
    ),
    click.option("--no-volume", is_flag=True, help="Surfaces alone."),
    click.option(
        "--buffer",
        "buffers",
        metavar="NAME",
        multiple=True,
        help="Write depth or normal too, as NAME.depth.npy; repeat for both.",
    ),
    click.option(
        "--set",
        "settings",
        metavar="PLACE=VALUE",
        multiple=True,
        help="Any part of a scene, such as effects.shading.ambient=0.3.",
    ),
)
"""Every option of a scene."""


def scene_options(command: Command) -> Command:
    """Add the options of SceneOptions; the command gets them as `options`."""

    @functools.wraps(command)
    def collected(**values: Any) -> None:
        given = {
            setting.place: value
            for setting in SETTINGS
            if (value := values.pop(setting.name)) not in (None, ())
        }
        if features := values.pop("features"):
            given["features"] = features
        if (box := given.get("effects.clip")) is not None:
            given["effects.clip"] = _clip(box)
        if buffers := values.pop("buffers"):
            given["effects.buffers"] = list(buffers)
        if values.pop("no_volume"):
            given["transfer_function.nothing"] = True
        if "step" in given and "time" in given:
            raise click.UsageError("--t and --time exclude each other")
        names = [field.name for field in dataclasses.fields(SceneOptions) if field.name != "places"]
        options = SceneOptions(places=given, **{name: values.pop(name) for name in names})
        command(options=options, **values)

    decorated: Command = collected
    for option in reversed(OPTIONS):
        decorated = option(decorated)
    return decorated


def _put(values: dict[str, Any], place: str, value: Any) -> None:
    """Set a place such as `effects.shading.ambient` in nested tables.

    A table on the way that is `true`, `false` or absent is made.
    """
    *above, last = place.split(".")
    for part in above:
        inner = values.get(part)
        if inner is None or inner is True or inner is False:
            inner = values[part] = {}
        if not isinstance(inner, dict):
            raise InputError(f"--set {place}: {part} has no settings of its own")
        values = inner
    values[last] = (
        dict(values[last]) if value is True and isinstance(values.get(last), dict) else value
    )


def _effect(name: str) -> str:
    """The field of Effects that a name stands for; raises InputError for an unknown name."""
    from fhash_codec.rendering.scenes import Effects

    names = [
        field.name
        for field in dataclasses.fields(Effects)
        if field.name not in ("isosurfaces", "buffers", "antialiasing", "clip", "legend")
    ]
    plain = name.replace("-", "_").replace("color", "colour")
    if plain not in names:
        effects = [effect.replace("_", "-") for effect in names]
        likely = suggestion(plain.replace("_", "-"), effects)
        known = "" if likely.startswith("known") else f" Known: {', '.join(effects)}"
        raise InputError(f"effect '{name[:60]}' is not known; {likely}{known}")
    return plain


def _clip(box: tuple[tuple[float | None, ...], ...]) -> dict[str, Any]:
    """The settings of a Clip by the ends along z, y and x; axes without an end are left out."""
    ends = {name: list(pair) for name, pair in zip("zyx", box, strict=True)}
    return {name: pair for name, pair in ends.items() if pair != [None, None]}


def _isosurface(text: str) -> dict[str, Any]:
    """The record of a surface from VALUE[,COLOUR][,OPACITY]."""
    first, *rest = text.split(",")
    try:
        surface: dict[str, Any] = {"value": float(first)}
        for part in rest:
            try:
                surface["opacity"] = float(part)
            except ValueError:
                surface["colour"] = part.strip()
    except ValueError as error:
        raise InputError(
            f"--isosurface {text}: write a value, then a colour and an opacity if need be,"
            " such as 1.5,orange,0.5"
        ) from error
    return surface


def _json(text: str) -> Any:
    """A value as JSON, or the text itself where it is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


PANEL = (512, 512)
"""Pixels of each step of an evolution, unless more are asked for."""
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
        for name in ("frames", "fps", "pictures", "processes"):
            if getattr(self, name) is not None and self.animate is None:
                raise click.UsageError(f"--{name} is of an animation: give --animate too")
        if self.columns is not None and self.evolution is None:
            raise click.UsageError("--columns is of an evolution: give --evolution too")

    def several(self, scene: Scene) -> bool:
        """Whether there is more than one picture to draw."""
        return self.animate is not None or scene.evolution is not None

    def over(self, scene: Scene, volume: Volume) -> Scene:
        """The scene with the steps of `--evolution`; itself without the option."""
        from fhash_codec.rendering.scenes import Evolution

        if self.evolution is None:
            return scene
        steps = tuple(map(float, steps_of(volume, self.evolution, "--evolution")))
        return dataclasses.replace(
            scene,
            step=None,
            time=None,
            size=PANEL if scene.size == type(scene)().size else scene.size,
            evolution=Evolution(steps=steps, columns=self.columns),
        )


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
        "--frames",
        type=click.IntRange(1, 100_000),
        metavar="N",
        help="Pictures of an animation. Default: one for each step if whole steps pass, else 96.",
    ),
    click.option(
        "--fps",
        type=RealRange(0.1, 240),
        metavar="X",
        help="Pictures per second of a film. Default: 24, or 8 where each is a step.",
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
        type=SLICE,
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

    tracked = _tracked(volume, options, progress)
    return tracking_scene(scene, tracked, volume) if tracked else scene


def _tracked(volume: Volume, options: AnimationOptions, progress: Progress) -> list[Tracked]:
    """The features of `--track`; none without the option."""
    from fhash_codec.rendering.tracking import parse_tracked

    names = options.track
    if OWN in names and len(names) > 1:
        raise InputError(
            f"--track {OWN} stands for the features of the file; leave it out, or the others"
        )
    return parse_tracked([] if OWN in names else names, volume, progress) if names else []


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
    from fhash_codec.rendering.film import numbered

    for path in (output, pictures):
        if path is not None:
            # Numbered pictures that exist may be kept; only their scenes will tell which may not
            # be replaced.
            counted = Path(path).suffix.lower() == ".png"
            first = numbered(Path(path), 1)[0] if counted else path
            check_writable(first, force or counted, sources=[volume.path])


class Evolved(TypedDict):
    """Several steps in one picture."""

    paths: Annotated[list[str], "files written"]
    steps: Annotated[list[float], "steps of the panels"]
    size: Annotated[list[int], "width and height"]
    counters: Annotated[dict[str, int], "rays, passes, samples, evaluations, gradients, and more"]
    seconds: Annotated[float, "of drawing"]
    tracked: Annotated[list[Followed], "`--track`: the features that were followed"]


def _draw_evolution(
    volume: Volume,
    scene: Scene,
    options: AnimationOptions,
    output: str,
    *,
    force: bool,
    progress: Progress,
) -> tuple[Evolved, str]:
    """Draw an evolution as one picture, and follow the features of `--track`."""
    from fhash_codec.rendering import render
    from fhash_codec.rendering.image import check_picture_name
    from fhash_codec.rendering.tracking import follow, tracking_scene

    tracked = _tracked(volume, options, progress)
    shown = tracking_scene(scene, tracked, volume) if tracked else scene
    check_picture_name(Path(output), shown.background)
    check_writable(output, force, sources=[volume.path])
    assert shown.evolution is not None
    steps = list(shown.evolution.steps)
    image = render(volume, shown, progress=progress)
    paths = [str(path) for path in image.save(output, force=force)]
    followed = follow(volume, tracked, steps) if tracked else []
    result: Evolved = {
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
    return result, table(rows) + ("\n\n" + _followed(followed) if followed else "")


def _followed(followed: Sequence[Followed]) -> str:
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


class Rendered(TypedDict):
    """One picture."""

    paths: Annotated[list[str], "files written"]
    size: Annotated[list[int], "width and height"]
    step: Annotated[float, "step that it shows"]
    time: Annotated[float, "its physical time"]
    march: Annotated[str, "way to march"]
    lod: Annotated[int, "level of detail"]
    counters: Annotated[dict[str, int], "rays, passes, samples, evaluations, gradients, and more"]
    seconds: Annotated[float, "of drawing"]
    plan: NotRequired[Annotated[dict[str, str], "`--explain`: what was decided, and why"]]


@click.command(
    "render", cls=BaseCommand, epilog="fhash render run.fhz -o last.png --t -1 --effect shadows"
)
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

    A volume with an axis of one vertex is drawn as an opaque plane, seen from above as a thin one
    is. With --animate the output is NAME.png for numbered pictures, of which only missing ones are
    drawn, or a film NAME.mp4 or NAME.gif.
    """
    from fhash_codec.rendering.renderer import Renderer, faint_text
    from fhash_codec.times import is_static, time_text
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
            draw = _draw_evolution if several.animate is None else _animate
            found = draw(volume, scene, several, str(path), force=picture.force, progress=progress)
            return emit(found[0], found[1], as_json)
        scene = tracking(volume, scene, several, progress)
        _check_outputs(path, picture, scene, run)
        renderer = Renderer(volume)
        plan = renderer.plan(scene)
        image = renderer.render(plan=plan, progress=progress)
        times = volume.coords["t"]
        time = "" if is_static(times) else f"{plan.step:g}, t = {time_text(times, plan.time)}"
        time += "" if plan.scene == scene else ", of five steps the one of most structure"
        if faint := faint_text(image, plan, volume):
            say(faint)
    paths = [str(written) for written in _save(image, path, picture)]
    result: Rendered = {
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
        lines.append(("size", extent((width, height))))
        lines += [("step", time)] if time else []
    if Path(paths[-1]).suffix.lower() != ".png" and len(paths) == 1:
        lines.append(("scene", "not in a JPEG; --save-scene FILE.json keeps it"))
    lines.append(("seconds", number(image.seconds, digits=3)))
    if not explain:
        return table(lines)
    counted = [(name, f"{count:>13}  {text}") for name, count, text in rows(image.counters)]
    return "\n\n".join((table(list(plan.reasons)), table(counted), table(lines)))
