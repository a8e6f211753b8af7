"""Options of `fhash render` that describe a scene: a file, and options that replace parts of it."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import Command, IntervalsType, feature_option
from fhash_cli.selection import time_of
from fhash_formats.errors import InputError, suggestion

if TYPE_CHECKING:
    from fhash_codec import Volume
    from fhash_codec.rendering.scenes import Scene

NUMBERS = {2: "A,B", 3: "X,Y,Z"}
"""Placeholders of options that take so many numbers."""


class NumbersType(click.ParamType[tuple[float, ...]]):
    """A fixed count of numbers with commas between them."""

    def __init__(self, count: int) -> None:
        self.count, self.name = count, NUMBERS[count]

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers; the scene checks later whether their values are allowed."""
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(
                f"'{value}' is not {self.count} numbers with commas between them,"
                f" such as {','.join('123'[: self.count])}",
                param,
                ctx,
            )
        return numbers


class SizeType(click.ParamType[tuple[int, int]]):
    """Pixels across and down, WxH, or one number for both."""

    name = "WxH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """The two numbers."""
        try:
            across, _, down = str(value).lower().partition("x")
            return int(across), int(down or across)
        except ValueError:
            self.fail(f"'{value}' is not a size in pixels such as 800x600", param, ctx)


class OpacityType(click.ParamType[Any]):
    """Points VALUE:OPACITY with commas between them, or the name of an opacity preset.

    named: whether it may be a name.
    """

    def __init__(self, *, named: bool = True) -> None:
        self.named, self.name = named, "NAME|V:O,..." if named else "G:F,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The name, or a list of points."""
        if self.named and ":" not in str(value):
            return value
        try:
            return [[float(end) for end in part.split(":")] for part in str(value).split(",")]
        except ValueError:
            what = "neither the name of an opacity nor" if self.named else "not"
            self.fail(f"'{value}' is {what} points such as 0:0,0.5:0.2,2:1", param, ctx)


class PlaneType(click.ParamType[dict[str, Any]]):
    """A clip plane: its normal and an offset, or a point of it and its normal."""

    name = "NX,NY,NZ,D"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, Any]:
        """The settings of a ClipPlane."""
        try:
            numbers = [float(part) for part in str(value).split(",")]
        except ValueError:
            numbers = []
        if len(numbers) == 4:
            return {"normal": numbers[:3], "offset": numbers[3]}
        if len(numbers) == 6:
            return {"point": numbers[:3], "normal": numbers[3:]}
        self.fail(
            f"'{value}' is neither a normal and an offset, NX,NY,NZ,D, nor a point and a normal,"
            " X,Y,Z,NX,NY,NZ, such as 0,0,1,0.5",
            param,
            ctx,
        )


PLACES = {
    "time": "time",
    "t": "step",
    "size": "size",
    "features": "features",
    "view": "camera.view",
    "azimuth": "camera.azimuth",
    "elevation": "camera.elevation",
    "zoom": "camera.zoom",
    "projection": "camera.projection",
    "position": "camera.position",
    "focal_point": "camera.focal_point",
    "view_up": "camera.view_up",
    "cmap": "transfer_function.colours",
    "opacity": "transfer_function.opacity",
    "range": "transfer_function.range",
    "density": "transfer_function.density",
    "scale": "scale",
    "background": "background",
    "step": "march.step",
    "lod": "march.lod",
    "march": "march.mode",
    "device": "march.device",
    "antialiasing": "effects.antialiasing",
    "gradient_opacity": "transfer_function.gradient_opacity",
    "clip_box": "effects.clip",
    "clip_planes": "effects.clip.planes",
}
"""Places of a scene that an option sets, by the name of the option's parameter."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Values of the options that `scene_options` adds.

    Attributes:
        file: path of a scene to begin from, or None.
        places: places of the scene, such as `camera.view`, with their values.
        effects: names of effects to switch on.
        isosurfaces: texts VALUE[,COLOUR][,OPACITY].
        settings: texts PLACE=VALUE.
    """

    file: str | None
    places: dict[str, Any]
    effects: tuple[str, ...]
    isosurfaces: tuple[str, ...]
    settings: tuple[str, ...]

    def scene(self, volume: Volume) -> Scene:
        """The scene; raises InputError for what it may not hold."""
        from fhash_codec.rendering.scenes import Scene

        base = Scene() if self.file is None else Scene.load(self.file)
        values = base.to_dict()
        if "step" in self.places or "time" in self.places:
            for name in ("step", "time", "evolution"):
                values.pop(name, None)
        for place, value in self.places.items():
            _put(values, place, value)
        if values.get("step") is not None and float(values["step"]) < 0:
            values["step"] += volume.shape[0]
        for name in self.effects:
            _put(values, f"effects.{_effect(name)}", True)
        if self.isosurfaces:
            _put(values, "effects.isosurfaces", [_isosurface(text) for text in self.isosurfaces])
        for setting in self.settings:
            place, equals, text = setting.partition("=")
            if not equals:
                raise InputError(
                    f"--set {setting}: write PLACE=VALUE, such as effects.shading.ambient=0.3"
                )
            _put(values, place.strip(), _json(text))
        if isinstance(values.get("time"), str):
            values["time"] = time_of(volume, values["time"])
        return Scene.from_dict(values)


OPTIONS: tuple[Callable[[Command], Command], ...] = (
    click.option(
        "--scene",
        "file",
        metavar="FILE",
        type=click.Path(),
        help="A scene to begin from: JSON, TOML, or a PNG of fhash render.",
    ),
    click.option(
        "--t",
        type=float,
        metavar="N",
        help="Step, between two of them too; -1 is the last. Default: the first.",
    ),
    click.option(
        "--time",
        metavar="T",
        help="A time instead of a step: a number, or a date such as 2001-02-10T06:00.",
    ),
    click.option("--size", type=SizeType(), help="Pixels across and down.  [default: 512x512]"),
    click.option(
        "--view",
        metavar="NAME",
        help="Direction to look from: auto, iso, xy, xz, yz, yx, zx, zy.",
    ),
    click.option(
        "--azimuth",
        type=float,
        metavar="DEGREES",
        help="Turn the camera about the upward direction.",
    ),
    click.option("--elevation", type=float, metavar="DEGREES", help="Raise the camera."),
    click.option("--zoom", type=float, metavar="X", help="Magnification."),
    click.option("--projection", metavar="NAME", help="perspective or parallel."),
    click.option(
        "--position",
        type=NumbersType(3),
        help="Where the camera stands, in the coordinates of the series.",
    ),
    click.option("--focal-point", type=NumbersType(3), help="What the camera looks at."),
    click.option("--view-up", type=NumbersType(3), help="What is upwards in the picture."),
    click.option(
        "--scale",
        type=NumbersType(3),
        help="Stretch the axes.  [default: one in other units is as long as the rest]",
    ),
    feature_option,
    click.option("--cmap", metavar="NAME", help="Colour map, or a ParaView preset (JSON)."),
    click.option(
        "--opacity",
        type=OpacityType(),
        help="auto, feature, linear, geom, sigmoid, foreground, opaque, or points.",
    ),
    click.option("--range", type=NumbersType(2), help="Values that the colours reach from and to."),
    click.option("--density", type=float, metavar="X", help="Factor of the extinction."),
    click.option(
        "--effect",
        "effects",
        metavar="NAME",
        multiple=True,
        help="shading, shadows, ambient-occlusion, maximum-intensity, minimum-intensity,"
        " average-intensity, attenuated-maximum-intensity, jitter, box, axes, colour-bar or"
        " time-label; may be repeated.",
    ),
    click.option(
        "--gradient-opacity",
        type=OpacityType(named=False),
        help="Points GRADIENT:FACTOR that opacity is multiplied by; gradients are shares of the"
        " value range from vertex to vertex.",
    ),
    click.option(
        "--clip-box",
        type=IntervalsType(float),
        help="Show only this part, in coordinates; an end may be left out.",
    ),
    click.option(
        "--clip-plane",
        "clip_planes",
        type=PlaneType(),
        multiple=True,
        help="Show only what lies on the side of the normal, where it times the place is at least D"
        " (or X,Y,Z,NX,NY,NZ); may be repeated.",
    ),
    click.option(
        "--isosurface",
        "isosurfaces",
        metavar="V[,COLOUR][,OPACITY]",
        multiple=True,
        help="A surface; may be repeated.",
    ),
    click.option("--no-volume", is_flag=True, help="Surfaces alone."),
    click.option("--background", metavar="COLOUR", help="'#rrggbb', a name, or transparent."),
    click.option("--antialiasing", type=int, metavar="N", help="Rays along a pixel's side."),
    click.option("--depth", is_flag=True, help="Write the depth too, as NAME.depth.npy."),
    click.option("--normal", is_flag=True, help="Write normals too, as NAME.normal.npy."),
    click.option(
        "--march",
        metavar="NAME",
        help="Way to march: auto or cache, and through a network arm or stream.",
    ),
    click.option("--device", metavar="NAME", help="Where a network is marched: auto, cpu or cuda."),
    click.option("--step", type=float, metavar="X", help="Length of a step in vertex spacings."),
    click.option(
        "--lod", type=int, metavar="N", help="Level of detail; by the size of a pixel if left out."
    ),
    click.option(
        "--set",
        "settings",
        metavar="PLACE=VALUE",
        multiple=True,
        help="Any part of a scene, such as effects.shading.ambient=0.3.",
    ),
)
"""Every option of a scene, in the order of `--help`."""


def scene_options(command: Command) -> Command:
    """Add the options of SceneOptions; the command gets them as `options`."""

    @functools.wraps(command)
    def collected(**values: Any) -> None:
        given = {
            place: value
            for name, place in PLACES.items()
            if (value := values.pop(name)) not in (None, ())
        }
        if (box := given.get("effects.clip")) is not None:
            given["effects.clip"] = _clip(box)
        buffers = [name for name in ("depth", "normal") if values.pop(name)]
        if buffers:
            given["effects.buffers"] = buffers
        if values.pop("no_volume"):
            given["transfer_function.nothing"] = True
        if "step" in given and "time" in given:
            raise click.UsageError("--t and --time exclude each other")
        names = [field.name for field in dataclasses.fields(SceneOptions) if field.name != "places"]
        command(
            options=SceneOptions(places=given, **{name: values.pop(name) for name in names}),
            **values,
        )

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
