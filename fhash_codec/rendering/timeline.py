"""Animations: keys of scenes, and the scene at any moment between them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fhash_codec.records import Record, limits
from fhash_codec.rendering.cameras import CameraPath
from fhash_codec.rendering.colours import colour_code, parse_colour
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.scenes import Camera, Effects, Scene, TransferFunctionSpec
from fhash_codec.times import time_range
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.values import Double

TIME_AND_CAMERA = ("camera", "step", "time")
"""Fields of a scene that an animation sets by itself."""


def mixed(first: Any, second: Any, weight: float) -> Any:
    """Mix two settings; numbers and colours are linear in the weight, so ascending points ascend.

    What cannot be mixed, such as names or tuples of different lengths, stays the first's. Time and
    camera of two scenes stay the first's too: an animation sets them by itself.

    Args:
        first: the setting at weight 0.
        second: the setting at weight 1.
        weight: 0..1.
    """
    if weight == 0 or first == second:
        return first
    if weight == 1:
        return second
    if isinstance(first, Record) and type(first) is type(second):
        names = [field.name for field in dataclasses.fields(first)]  # type: ignore[arg-type]
        values = {
            name: mixed(getattr(first, name), getattr(second, name), weight)
            for name in names
            if name not in TIME_AND_CAMERA
        }
        return dataclasses.replace(first, **values)  # type: ignore[type-var]
    if isinstance(first, float) and isinstance(second, float):
        return (1 - weight) * first + weight * second
    if isinstance(first, tuple) and isinstance(second, tuple) and len(first) == len(second):
        return tuple(mixed(*items, weight) for items in zip(first, second, strict=True))
    if isinstance(first, str) and isinstance(second, str):
        return _mixed_colour(first, second, weight)
    return first


def _mixed_colour(first: str, second: str, weight: float) -> str:
    """Mix two colours as '#rrggbb'; the first text if one of them is no colour."""
    try:
        colours = np.array([parse_colour(first), parse_colour(second)])
    except InputError:
        return first
    return colour_code((1 - weight) * colours[0] + weight * colours[1])


STEP_DIGITS = 12
"""Decimals of a step: later ones are rounding, and whole steps need only one decoded frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """Time of the series over an animation, linear between the shares `at`.

    Attributes:
        at: shares (n,) of the animation, ascending.
        values: steps or physical times (n,).
        physical: whether the values are physical times.
    """

    at: Double
    values: Double
    physical: bool

    @classmethod
    def of(
        cls, at: Double, scenes: Sequence[Scene], volume: Volume, *, physical: bool = False
    ) -> Clock:
        """A clock through the steps, or the times, of scenes; raises RegionError outside."""
        steps = [_step(scene, volume) for scene in scenes]
        values = [scene.time for scene in scenes] if physical else steps
        return cls(at=at, values=np.array(values, dtype=np.float64), physical=physical)

    def moment(self, share: float) -> dict[str, float | None]:
        """The fields `step` and `time` of a scene at a share of the animation."""
        value = float(np.interp(share, self.at, self.values))
        if self.physical:
            return {"step": None, "time": value}
        return {"step": round(value, STEP_DIGITS), "time": None}


class Timeline:
    """Scenes between keys: settings are mixed, the camera moves on a path, and time runs."""

    def __init__(
        self,
        keys: Sequence[tuple[float, Scene]],
        volume: Volume,
        *,
        scale: tuple[float, float, float] | None,
        steps: tuple[float, float] | None = None,
        times: tuple[float, float] | None = None,
        orbit: float = 0.0,
    ) -> None:
        """Prepare the scenes between keys; raises RegionError for times outside the series.

        Args:
            keys: (share of the animation, scene), at least one, shares strictly ascending.
            volume: of the scenes.
            scale: factors by which the axes are stretched, as `Scene.scale`.
            steps: first and last step, in place of the steps of the keys.
            times: first and last physical time, in place of the steps of the keys.
            orbit: degrees that the camera turns over the whole animation, besides its path.
        """
        self._at = np.array([share for share, _ in keys])
        self._scenes = [scene for _, scene in keys]
        self._path = CameraPath(
            at=self._at,
            cameras=tuple(scene.camera for scene in self._scenes),
            grid=Grid.of_volume(volume, scale),
            size=self._scenes[0].size,
        )
        # The steps of the keys are checked in any case.
        clock = Clock.of(self._at, self._scenes, volume)
        self._clock = clock if np.ptp(clock.values) else None
        ends = np.array([0.0, 1.0])
        if steps is not None:
            self._clock = Clock.of(ends, [Scene(step=step) for step in steps], volume)
        elif times is not None:
            given = [Scene(time=time) for time in times]
            self._clock = Clock.of(ends, given, volume, physical=True)
        self._orbit = orbit

    def scene(self, share: float) -> Scene:
        """The scene at a share of the animation."""
        camera = self._path.camera(share)
        if self._orbit:
            camera = dataclasses.replace(camera, azimuth=camera.azimuth + self._orbit * share)
        moment: dict[str, Any] = {"step": self._scenes[0].step, "time": self._scenes[0].time}
        if self._clock is not None:
            moment = self._clock.moment(share)
        return dataclasses.replace(self._mixed(share), camera=camera, **moment)

    def _mixed(self, share: float) -> Scene:
        """The settings at a share, but for time and camera; they change smoothly at the keys."""
        last = len(self._at) - 1
        after = int(np.clip(np.searchsorted(self._at, share, side="right"), 1, max(last, 1)))
        first, second = self._scenes[after - 1], self._scenes[min(after, last)]
        if second is first:
            return first
        start, end = self._at[after - 1], self._at[after]
        progress = float(np.clip((share - start) / (end - start), 0, 1))
        scene: Scene = mixed(first, second, progress * progress * (3 - 2 * progress))
        return scene


def _step(scene: Scene, volume: Volume) -> float:
    """The step of a scene; raises RegionError outside the series."""
    if scene.time is not None:
        return float(volume.step_of_time(scene.time))
    step, last = scene.step or 0.0, volume.shape[0] - 1
    if not 0 <= step <= last:
        raise RegionError(f"{volume.path}: step {step:g} is outside 0..{last}")
    return step


MOVING = 24.0
"""Pictures per second where the camera moves or time runs between steps."""
RESTING = 8.0
"""Pictures per second where each picture is a step of its own."""
MAX_FRAMES = 100_000
"""Most pictures of an animation."""
DEFAULT_FRAMES = 96
"""Pictures of an animation that does not consist of whole steps alone."""
FORMS = "steps, steps=FIRST:LAST, steps=FIRST:LAST:EVERY, time=FIRST:LAST, orbit, orbit=DEGREES"
"""Words that an animation is written in on the command line."""


@dataclass(frozen=True, kw_only=True)
class Key(Record):
    """A scene that an animation passes through.

    It is the scene of a file, or the scene being rendered, with the settings of the key in place of
    its own.
    """

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
        """Apply the key to the scene being rendered; raises InputError for an unreadable file."""
        base = scene
        if self.scene is not None:
            base = dataclasses.replace(Scene.load(self.scene), size=scene.size, march=scene.march)
        settings = {
            name: getattr(self, name)
            for name in ("camera", "transfer_function", "effects", "background")
        }
        given = {name: value for name, value in settings.items() if value is not None}
        if self.step is not None or self.time is not None:
            given |= {"step": self.step, "time": self.time}
        return dataclasses.replace(base, **given)


@dataclass(frozen=True, kw_only=True)
class Animation(Record):
    """An animation: how a scene changes over many pictures.

    Picture i of n lies at the share i / (n - 1) of the animation. In an animation that ends where
    it begins it lies at i / n.
    """

    frames: int | None = limits(
        None,
        "pictures; one for each step if only whole steps pass, else 96",
        low=1,
        high=MAX_FRAMES,
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
    every: float | None = limits(
        None,
        "steps (or times) from one picture to the next, instead of 'frames'; the last picture is "
        "the last one within the range",
        low=1e-100,
        high=1e15,
    )
    orbit: float = limits(
        0.0, "degrees that the camera turns about the upward direction", low=-36000, high=36000
    )
    keys: tuple[Key, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and the keys; raises InputError."""
        super().__post_init__()
        if self.steps is not None and self.times is not None:
            raise InputError("animation: steps and times exclude each other")
        if self.every is not None and self._range is None:
            raise InputError("animation: 'every' is of steps or times; give one of them too")
        if self.every is not None and self.frames is not None:
            raise InputError("animation: 'frames' and 'every' exclude each other")
        given = [key.at for key in self.keys if key.at is not None]
        ascending = all(low < high for low, high in itertools.pairwise(given))
        if given and (len(given) != len(self.keys) or not ascending):
            raise InputError(
                "animation: 'at' of the keys must ascend, each above the one before, and be given "
                "for all of them or none"
            )
        timed = any(key.step is not None or key.time is not None for key in self.keys)
        if (self.steps or self.times) and timed:
            raise InputError(
                "animation: time is given by 'steps' or 'times', or by the keys, not by both"
            )

    @classmethod
    def load(cls, path: str | Path) -> Animation:
        """Read an animation from a file: TOML if its suffix is .toml, else JSON.

        Raises InputError.
        """
        return cls.read(
            Path(path),
            "an animation",
            f"no such animation; write a file's name or {FORMS}, separated by commas",
        )

    @classmethod
    def parse(cls, text: str, volume: Volume) -> Animation:
        """Read an animation from words such as "steps,orbit=180", or from the file of that name.

        Without a range, "steps" and "time" mean the whole series of `volume`; an end that is left
        out is that of the series. A third number is `every`. Raises InputError.
        """
        words = [word.strip().partition("=") for word in text.split(",")]
        if not all(name in ("steps", "time", "orbit") for name, _, _ in words):
            return cls.load(text)
        values: dict[str, Any] = {}
        for name, _, value in words:
            try:
                values |= _field(name, value, volume)
            except (InputError, RegionError):
                raise  # they are ValueErrors, too, and say more
            except ValueError:
                raise InputError(
                    f"animation '{text[:60]}': '{name}={value}' is malformed; "
                    f"write {FORMS}, separated by commas"
                ) from None
        return cls(**values)

    @property
    def closed(self) -> bool:
        """Whether the first picture follows the last: the camera alone moves, in whole turns."""
        return (
            self.orbit != 0
            and self.orbit % 360 == 0
            and not (self.keys or self.steps or self.times)
        )

    @property
    def count(self) -> int:
        """Number of pictures."""
        if self.frames is not None:
            return self.frames
        if self.every is not None and self._range is not None:
            # What is within rounding of a whole number of pictures is that number.
            whole = abs(self._range[1] - self._range[0]) / self.every * (1 + 1e-12)
            return min(math.floor(whole) + 1, MAX_FRAMES)
        passed = self._steps_alone
        return DEFAULT_FRAMES if passed is None else min(round(passed) + 1, MAX_FRAMES)

    @property
    def rate(self) -> float:
        """Pictures per second."""
        if self.fps is not None:
            return self.fps
        passed = self._steps_alone
        return RESTING if passed is not None and self.count <= passed + 1 else MOVING

    @property
    def _range(self) -> tuple[float, float] | None:
        """First and last step or time; None where time stands still or is that of keys."""
        return self.steps if self.steps is not None else self.times

    def _ends(self, given: tuple[float, float] | None) -> tuple[float, float] | None:
        """Steps or times of the first and the last picture."""
        if given is None or self.every is None:
            return given
        way = self.every if given[1] >= given[0] else -self.every
        return given[0], given[0] + (self.count - 1) * way

    @property
    def _steps_alone(self) -> float | None:
        """Steps that pass, if nothing else changes; None otherwise."""
        if self.steps is None or self.orbit or self.keys:
            return None
        return abs(self.steps[1] - self.steps[0])

    def scenes(self, scene: Scene, volume: Volume) -> list[Scene]:
        """The scene of every picture.

        Args:
            scene: what is shown where the animation changes nothing.
            volume: the volume being rendered.

        Raises InputError if nothing changes, and for keys whose file is no scene; RegionError for
        steps and times outside the series.
        """
        if not (self.steps or self.times or self.orbit or len(self.keys) > 1):
            raise InputError(
                f"animation: nothing changes; give {FORMS}, or a file with two keys or more"
            )
        if self.orbit and scene.camera.view == "auto":
            # A plane seen from above would be seen from its edge in the middle of its orbit.
            scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, view="iso"))
        key_scenes = [key.over(scene) for key in self.keys] or [scene]
        given = [float(key.at) for key in self.keys if key.at is not None]
        at = given or np.linspace(0, 1, len(key_scenes)).tolist()
        timeline = Timeline(
            list(zip(at, key_scenes, strict=True)),
            volume,
            scale=scene.scale,
            steps=self._ends(self.steps),
            times=self._ends(self.times),
            orbit=self.orbit,
        )
        if self.every is not None:  # the last picture may lie before the end of the range
            ends = [Scene(step=step) for step in self.steps or ()]
            Clock.of(np.empty(0), [*ends, *(Scene(time=time) for time in self.times or ())], volume)
        shares = np.arange(self.count) / max(self.count if self.closed else self.count - 1, 1)
        return [timeline.scene(float(share)) for share in shares]


def _field(name: str, value: str, volume: Volume) -> dict[str, Any]:
    """The fields of an Animation that a word such as "steps=0:9" gives.

    Raises ValueError for a word that is malformed, InputError and RegionError for its times.
    """
    if name == "orbit":
        return {"orbit": float(value) if value else 360.0}
    field = "steps" if name == "steps" else "times"
    times = volume.coords["t"].values
    whole = (0.0, float(len(times) - 1)) if name == "steps" else (float(times[0]), float(times[-1]))
    if not value:
        return {field: whole}
    if name == "time":
        begin, end, gap = time_range(volume.coords["t"], value, str(volume.path))
        return {field: (begin, end)} | ({} if gap is None else {"every": gap})
    first, last, *every = value.split(":")
    if len(every) > 1:
        raise ValueError(value)
    ends = float(first) if first.strip() else whole[0], float(last) if last.strip() else whole[1]
    return {field: ends} | ({"every": float(every[0])} if every else {})
