"""What changes from picture to picture: time, a turn of the camera, and scenes that an animation comes through."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.camera.poses import CameraPath
from fhash_codec.rendering.colour.colours import parse_colour
from fhash_codec.rendering.scene.record import Record, limits
from fhash_codec.rendering.scene.scene import Camera, Effects, Scene, TransferFunctionSpec
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError, RegionError

__all__ = ["Animation", "Key", "mixed"]

Floats = npt.NDArray[np.float64]

MOVING, RESTING = 24.0, 8.0
"""Pictures per second where the camera moves or time runs between steps, and where each picture is a step of its own."""
MOST = 100_000
"""Pictures of an animation."""
FORMS = "steps, steps=FIRST:LAST, time=FIRST:LAST, orbit, orbit=DEGREES"


@dataclass(frozen=True, kw_only=True)
class Key(Record):
    """A scene that an animation comes through: that of a file, or the one rendered, with the parts that are given in place of its own."""

    at: float | None = limits(
        None,
        "when, as a share of the animation; keys are spread evenly if it is left out in all",
        low=0,
        high=1,
    )
    scene: str | None = limits(
        None, "file of a scene: JSON, TOML or a PNG of fhash render; paths are those of the process"
    )
    camera: Camera | None = None
    transfer_function: TransferFunctionSpec | None = None
    effects: Effects | None = None
    background: str | None = limits(None, "'#rrggbb', a name, or 'transparent'")
    step: float | None = limits(
        None, "step of the series, between two of them too", low=0, high=1e15
    )
    time: float | None = limits(
        None, "physical time, instead of a step", low=-1.7e308, high=1.7e308
    )

    def over(self, scene: Scene) -> Scene:
        """The scene it stands for; raises InputError for a file that is none."""
        base = (
            scene
            if self.scene is None
            else dataclasses.replace(Scene.load(self.scene), size=scene.size, march=scene.march)
        )
        parts = {
            name: getattr(self, name)
            for name in ("camera", "transfer_function", "effects", "background")
        }
        moment: dict[str, Any] = (
            {}
            if self.step is None and self.time is None
            else {"step": self.step, "time": self.time}
        )
        return dataclasses.replace(
            base, **{name: part for name, part in parts.items() if part is not None}, **moment
        )


@dataclass(frozen=True, kw_only=True)
class Animation(Record):
    """How a scene becomes many: picture i of n is at the share i / (n - 1), or i / n where the last is followed by the first."""

    frames: int | None = limits(
        None, "pictures; one for each step if only whole steps pass, else 96", low=1, high=MOST
    )
    fps: float | None = limits(
        None,
        f"pictures per second of a film; {MOVING:g}, or {RESTING:g} where each is a step",
        low=0.1,
        high=240,
    )
    steps: tuple[float, float] | None = limits(
        None, "first and last step of the series, evenly passed", low=0, high=1e15
    )
    times: tuple[float, float] | None = limits(
        None, "first and last physical time, instead of steps", low=-1.7e308, high=1.7e308
    )
    orbit: float = limits(
        0.0, "degrees that the camera turns about the upward direction", low=-36000, high=36000
    )
    keys: tuple[Key, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps is not None and self.times is not None:
            raise InputError("animation: steps and times exclude each other")
        given = [key.at for key in self.keys if key.at is not None]
        if given and (
            len(given) != len(self.keys)
            or any(low >= high for low, high in itertools.pairwise(given))
        ):
            raise InputError(
                "animation: 'at' of the keys must ascend, each above the one before, and be given for all of them or none"
            )
        if (self.steps or self.times) and any(
            key.step is not None or key.time is not None for key in self.keys
        ):
            raise InputError(
                "animation: time is given by 'steps' or 'times', or by the keys, not by both"
            )

    @classmethod
    def load(cls, path: str | Path) -> Animation:
        """From a file: TOML by its suffix .toml, else JSON. Raises InputError."""
        return cls.read(
            Path(path),
            "an animation",
            f"no such animation; write a file's name or {FORMS}, separated by commas",
        )

    @classmethod
    def parse(cls, text: str, volume: Volume) -> Animation:
        """From words such as "steps,orbit=180", whole series if no steps are given; any other text is the name of a file."""
        words = [word.strip().partition("=") for word in text.split(",")]
        if not all(name in ("steps", "time", "orbit") for name, _, _ in words):
            return cls.load(text)
        values: dict[str, Any] = {}
        for name, _, value in words:
            try:
                if name == "orbit":
                    values["orbit"] = float(value) if value else 360.0
                elif value:
                    first, last = value.split(":")
                    values["steps" if name == "steps" else "times"] = (float(first), float(last))
                elif name == "steps":
                    values["steps"] = (0.0, float(volume.shape[0] - 1))
                else:
                    times = volume.coords["t"].values
                    values["times"] = (float(times[0]), float(times[-1]))
            except ValueError:
                raise InputError(
                    f"animation '{text[:60]}': '{name}={value}' is malformed; write {FORMS}, separated by commas"
                ) from None
        return cls(**values)

    @property
    def closed(self) -> bool:
        """Whether the last picture is followed by the first: whole turns and nothing else."""
        return (
            self.orbit != 0
            and self.orbit % 360 == 0
            and not (self.keys or self.steps or self.times)
        )

    @property
    def count(self) -> int:
        """How many pictures there are."""
        if self.frames is not None:
            return self.frames
        if self.steps is not None and not self.orbit and not self.keys:
            return min(round(abs(self.steps[1] - self.steps[0])) + 1, MOST)
        return 96

    @property
    def rate(self) -> float:
        """Pictures per second."""
        if self.fps is not None:
            return self.fps
        whole = self.steps is not None and not self.orbit and not self.keys
        return (
            RESTING
            if whole
            and self.steps is not None
            and self.count <= abs(self.steps[1] - self.steps[0]) + 1
            else MOVING
        )

    def scenes(self, scene: Scene, volume: Volume) -> list[Scene]:
        """The scene of every picture.

        Raises InputError where nothing would change, and for keys that name no scene; RegionError for steps and times outside the series.
        """
        if not (self.steps or self.times or self.orbit or len(self.keys) > 1):
            raise InputError(
                f"animation: nothing changes; give {FORMS}, or a file with two keys or more"
            )
        shares = np.arange(self.count) / max(self.count if self.closed else self.count - 1, 1)
        way = _Way(self, scene, volume)
        return [way.scene(float(share)) for share in shares]


class _Way:
    """The scenes of the keys, and what lies between them."""

    def __init__(self, animation: Animation, scene: Scene, volume: Volume) -> None:
        keys, self.orbit = animation.keys, animation.orbit
        self.scenes = [key.over(scene) for key in keys] or [scene]
        given = [float(key.at) for key in keys if key.at is not None]
        self.at = np.array(given or np.linspace(0, 1, len(self.scenes)))
        cameras = tuple(each.camera for each in self.scenes)
        self.path = CameraPath(
            at=self.at, cameras=cameras, grid=Grid.of(volume.coords, scene.scale), size=scene.size
        )
        steps = [_step(each, volume) for each in self.scenes]
        self.moments, self.steps = self.at, np.array(steps)
        self.moving = any(step != steps[0] for step in steps)
        if animation.steps is not None or animation.times is not None:
            ends = animation.steps or animation.times
            assert ends is not None
            field = "step" if animation.steps is not None else "time"
            self.moments, self.moving = np.array([0.0, 1.0]), True
            if animation.steps is not None:
                self.steps = np.array([_step(Scene(step=end), volume) for end in ends])
            else:
                for end in ends:
                    _step(Scene(time=end), volume)
            self.times = np.array(ends) if field == "time" else None
        else:
            self.times = None

    def scene(self, share: float) -> Scene:
        """The scene at a share of the animation."""
        later = int(
            np.clip(np.searchsorted(self.at, share, side="right"), 1, max(len(self.at) - 1, 1))
        )
        first, second = self.scenes[later - 1], self.scenes[min(later, len(self.scenes) - 1)]
        weight = 0.0
        if second is not first:
            part = float(
                np.clip((share - self.at[later - 1]) / (self.at[later] - self.at[later - 1]), 0, 1)
            )
            weight = part * part * (3 - 2 * part)
        found: Scene = mixed(first, second, weight)
        camera = self.path.camera(share)
        moment: dict[str, Any]
        if self.times is not None:
            moment = {"step": None, "time": float(np.interp(share, self.moments, self.times))}
        elif self.moving:
            # The 12th digit of a step is nothing; a whole step is one that was encoded and needs no other.
            moment = {
                "step": round(float(np.interp(share, self.moments, self.steps)), 12),
                "time": None,
            }
        else:
            moment = {"step": self.scenes[0].step, "time": self.scenes[0].time}
        turned = (
            dataclasses.replace(camera, azimuth=camera.azimuth + self.orbit * share)
            if self.orbit
            else camera
        )
        return dataclasses.replace(found, camera=turned, **moment)


def _step(scene: Scene, volume: Volume) -> float:
    """The step of a scene; raises RegionError outside the series."""
    if scene.time is not None:
        return float(volume.step_of_time(scene.time))
    step, last = scene.step or 0.0, volume.shape[0] - 1
    if not 0 <= step <= last:
        raise RegionError(f"{volume.path}: step {step:g} is outside 0..{last}")
    return step


def mixed(first: Any, second: Any, weight: float) -> Any:
    """Settings between two: numbers and colours by weight 0..1, so that what ascends still does; what cannot be mixed is the first's.

    Time and camera of two scenes are left as the first has them: they follow ways of their own.
    """
    if weight == 0 or first == second:
        return first
    if weight == 1:
        return second
    if isinstance(first, Record) and type(first) is type(second):
        names = [field.name for field in dataclasses.fields(first)]  # type: ignore[arg-type]
        changed = {
            name: mixed(getattr(first, name), getattr(second, name), weight)
            for name in names
            if name not in ("camera", "step", "time")
        }
        return dataclasses.replace(first, **changed)  # type: ignore[type-var]
    if isinstance(first, float) and isinstance(second, float):
        return (1 - weight) * first + weight * second
    if isinstance(first, tuple) and isinstance(second, tuple) and len(first) == len(second):
        return tuple(mixed(one, other, weight) for one, other in zip(first, second, strict=True))
    if isinstance(first, str) and isinstance(second, str):
        try:
            colours = np.array([parse_colour(first), parse_colour(second)])
        except InputError:
            return first
        return "#" + "".join(
            f"{round(255 * float(part)):02x}"
            for part in (1 - weight) * colours[0] + weight * colours[1]
        )
    return first
