"""The timeline of an animation: the scene at any moment between its keys."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.animation.mixing import mixed
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.camera.poses import CameraPath
from fhash_codec.rendering.scene.scene import Scene
from fhash_codec.volume import Volume
from fhash_formats.errors import RegionError

__all__ = ["Clock", "Timeline"]

Floats = npt.NDArray[np.float64]

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

    at: Floats
    values: Floats
    physical: bool

    @classmethod
    def of_steps(cls, steps: tuple[float, float], volume: Volume) -> Clock:
        """A clock from the first step to the last; raises RegionError outside the series."""
        values = np.array([_step(Scene(step=step), volume) for step in steps])
        return cls(at=np.array([0.0, 1.0]), values=values, physical=False)

    @classmethod
    def of_times(cls, times: tuple[float, float], volume: Volume) -> Clock:
        """A clock from the first physical time to the last; raises RegionError outside."""
        for time in times:
            _step(Scene(time=time), volume)
        return cls(at=np.array([0.0, 1.0]), values=np.array(times), physical=True)

    @classmethod
    def of_scenes(cls, at: Floats, scenes: Sequence[Scene], volume: Volume) -> Clock | None:
        """A clock through the steps of scenes; None if they all have the same.

        Raises RegionError for a scene outside the series.
        """
        steps = [_step(scene, volume) for scene in scenes]
        if all(step == steps[0] for step in steps):
            return None
        return cls(at=at, values=np.array(steps), physical=False)

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
            grid=Grid.of(volume.coords, scale),
            size=self._scenes[0].size,
        )
        # The steps of the keys are checked in any case.
        self._clock = Clock.of_scenes(self._at, self._scenes, volume)
        if steps is not None:
            self._clock = Clock.of_steps(steps, volume)
        elif times is not None:
            self._clock = Clock.of_times(times, volume)
        self._orbit = orbit

    def scene(self, share: float) -> Scene:
        """The scene at a share of the animation."""
        camera = self._path.camera(share)
        if self._orbit:
            camera = dataclasses.replace(camera, azimuth=camera.azimuth + self._orbit * share)
        return dataclasses.replace(self._mixed(share), camera=camera, **self._moment(share))

    def _moment(self, share: float) -> dict[str, Any]:
        if self._clock is not None:
            return self._clock.moment(share)
        return {"step": self._scenes[0].step, "time": self._scenes[0].time}

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
