"""The light of a picture: lamp, shading, shadows and occlusion that a scene asks for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Effects, Scene, Shading, Shadows
from fhash_codec.rendering.task.task import Lighting
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["coding_noise", "lamp_of", "lighting_of", "secondary_light", "shading_of"]

Floats = npt.NDArray[np.float64]

SHOULDER = (-0.7, 1.0, 1.0)
"""Default direction towards the light of shadows: components right, up and towards the camera."""


def secondary_light(scene: Scene, grid: Grid) -> tuple[Shadows | None, AmbientOcclusion | None]:
    """The shadows and the ambient occlusion of a scene, None where they would change nothing."""
    effects = scene.effects
    if effects.projections or scene.transfer_function.nothing or grid.flat:
        # Only the volume takes light away, and only from what is drawn of it or in it. A plane is
        # drawn in its colours.
        return None, None
    shadows, occlusion = effects.shadows, effects.ambient_occlusion
    return (
        shadows if shadows and shadows.strength > 0 else None,
        occlusion if occlusion and occlusion.strength > 0 else None,
    )


def lamp_of(rays: Rays, shading: Shading | None, shadows: Shadows | None) -> Floats | None:
    """The unit vector (x, y, z) towards the light, in the coordinates.

    None for the camera's light: it lies behind the camera, and its shadows cannot be seen.
    """
    light = shading.light if shading is not None and shading.light is not None else None
    if shadows is not None and shadows.light is not None:
        if light is not None and light != shadows.light:
            raise InputError(
                "shading and shadows name different lights; there is one lamp: "
                "leave 'light' out of one of them"
            )
        light = shadows.light
    if light is not None:
        direction = np.array(light)
        largest = float(np.abs(direction).max())
        if not largest > 0:
            raise InputError("light has no length; give a direction such as 1, 1, 2")
        # Scaled first, since the squares of the largest numbers are beyond float64.
        direction = direction / largest
        return np.asarray(direction / np.linalg.norm(direction), dtype=np.float64)
    return None if shadows is None else _shoulder_lamp(rays)


def _shoulder_lamp(rays: Rays) -> Floats:
    """The unit vector (x, y, z) towards the default light of shadows, beside the camera."""
    spacing = rays.grid.spacing
    right, up, away = (
        axis / np.linalg.norm(axis)
        for axis in (rays.right * spacing, rays.up * spacing, -rays.forward * spacing)
    )
    lamp = SHOULDER[0] * right + SHOULDER[1] * up + SHOULDER[2] * away
    return np.asarray(lamp / np.linalg.norm(lamp), dtype=np.float64)


def coding_noise(volume: Volume) -> float:
    """The difference of two neighbouring vertices that the errors of a bounded file can make.

    Both vertices may be wrong by the largest error, in opposite directions. The noise is 0 for a
    file without a bound: its errors are small where the values are smooth.
    """
    config = volume.container.header.get("config", {})
    if config.get("max_error") is None and config.get("max_error_rel") is None:
        return 0.0
    largest = volume.container.header["quality"].get("max_abs_error")
    return 0.0 if largest is None else 2 * float(largest)


def shading_of(effects: Effects) -> Shading | None:
    """The shading of what is lit, None if nothing is; isosurfaces are always lit."""
    if effects.isosurfaces:
        return effects.shading or Shading()
    return None if effects.projections else effects.shading


def lighting_of(shading: Shading, lamp: Floats | None) -> Lighting:
    """The coefficients of a shading, with its lamp; the camera's light if that is None."""
    return Lighting(
        ambient=shading.ambient,
        diffuse=shading.diffuse,
        specular=shading.specular,
        specular_power=shading.specular_power,
        lamp=lamp,
        central=shading.gradient == "central",
    )
