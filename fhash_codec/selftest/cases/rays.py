"""Cases of rays: extreme opacities and steps, rays along faces and edges and through corners,
cameras near and far, volumes of hard shapes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Check
from fhash_codec.selftest.cases.fields import Shape, series, waves
from fhash_codec.selftest.cases.settings import Settings
from fhash_codec.selftest.checks.ray_checks import blocks, closed_form, key_times, scene, scenes
from fhash_formats.series import ArraySeries

__all__ = ["RAY_CASES"]

SHAPE: Shape = (2, 7, 6, 5)
BOUND: Settings = {"bound": EncodeConfig(max_error_rel=1e-3, effort=1)}
EXACT: Settings = {"exact": EncodeConfig(max_error=0.0, effort=1)}
NETWORK: Settings = {"paper": EncodeConfig(profile="paper", width=8, epochs=30)}
FOG: Any = {"opacity": [[0.0, 0.02], [1.0, 0.5]]}
AXES = ("xy", "yx", "xz", "zx", "yz", "zy")
FRONT = {"view": "xy", "projection": "parallel"}


def _waves() -> ArraySeries:
    return series(waves(SHAPE).astype(np.float32))


def _placed(values: Callable[[], np.ndarray[Any, Any]], **axes: Any) -> Callable[[], ArraySeries]:
    return lambda: series(values(), **axes)


def _scaled(
    factor: float, offset: float, dtype: type[np.floating[Any]]
) -> Callable[[], ArraySeries]:
    return lambda: series((waves(SHAPE) * factor + offset).astype(dtype))


def _shaped(shape: Shape) -> Callable[[], ArraySeries]:
    return lambda: series(waves(shape).astype(np.float32))


def _constant() -> ArraySeries:
    """A volume that is 1 everywhere."""
    return series(np.ones((1, 2, 3, 3), np.float32))


def _even(origin: float, spacing: float, length: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return origin + spacing * np.arange(length, dtype=np.float64)


def _stairs() -> ArraySeries:
    """Integer values: every isosurface of an integer passes through vertices and coincides with
    faces of cells."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    return series((np.maximum(np.maximum(z, y), x) + t).astype(np.float32))


def _holes() -> ArraySeries:
    values = waves(SHAPE).astype(np.float32)
    values[:, 2:4, 1:4, 1:3] = np.nan
    values[0, 0, 0, 0] = values[1, -1, -1, -1] = np.inf
    values[:, :, 5, :] = np.nan
    return series(values)


def _case(
    name: str,
    about: str,
    *checks: Check,
    make: Callable[[], ArraySeries] = _waves,
    settings: Settings = BOUND,
    **rest: Any,
) -> Case:
    return Case(
        name=name, group="rays", about=about, make=make, settings=settings, checks=checks, **rest
    )


def _grid_camera(view: str) -> dict[str, Any]:
    """A parallel camera along an axis with 9 x 9 pixels, one vertex apart: rays hit vertices, edges
    and faces."""
    across = {"x": 5, "y": 6, "z": 7}
    return {
        "view": view,
        "projection": "parallel",
        "parallel_scale": 4.5,
        "focal_point": [(across[axis] - 1) // 2 for axis in "xyz"],
    }


def _towards(
    position: tuple[float, float, float], focal: tuple[float, float, float], **more: Any
) -> dict[str, Any]:
    return {
        "position": list(position),
        "focal_point": list(focal),
        "view_up": [0.3, 0.1, 1.0],
        **more,
    }


FAR = 1e6 * 10.0
"""A distance of a million times the size of the volume."""
CAMERAS = {
    "inside": _towards((2.1, 2.7, 3.2), (4.0, 1.0, 6.0)),
    "on-a-vertex": _towards((2.0, 3.0, 3.0), (4.0, 1.0, 6.0)),
    "on-a-face": _towards((0.0, 2.5, 3.2), (4.0, 2.0, 3.0)),
    "on-a-face-looking-along": _towards((0.0, 2.5, -4.0), (0.0, 2.5, 3.0)),
    "on-an-edge": _towards((0.0, 0.0, 3.0), (4.0, 5.0, 3.0)),
    "on-a-corner": _towards((4.0, 5.0, 6.0), (0.0, 0.0, 0.0)),
    "far": _towards((FAR, FAR, FAR), (2.0, 2.5, 3.0), zoom=1e6),
    "far-parallel": _towards(
        (FAR, -FAR, FAR), (2.0, 2.5, 3.0), projection="parallel", parallel_scale=5.0
    ),
    "wide": _towards((2.1, 2.7, 3.2), (4.0, 1.0, 6.0), view_angle=170.0),
}
CORNERS = {
    "corner-to-corner": _towards((-4.0, -5.0, -6.0), (4.0, 5.0, 6.0)),
    "through-a-corner": _towards((8.0, -4.0, 2.0), (4.0, 0.0, 6.0)),
    "through-an-edge": _towards((8.0, -4.0, 3.0), (4.0, 0.0, 3.0)),
    "along-a-diagonal-of-a-face": _towards((-4.0, -5.0, 0.0), (4.0, 5.0, 0.0)),
    "along-an-edge": _towards((0.0, 0.0, -5.0), (0.0, 0.0, 3.0), view_up=[1.0, 0.3, 0.0]),
}
SURFACES = {
    name: scene(
        transfer_function={"nothing": True},
        effects={"isosurfaces": [{"value": value, "opacity": opacity, "colour": "#ff8000"}]},
    )
    for name, value, opacity in (
        ("nothing-below-the-least", 0.0, 1.0),
        ("2", 2.0, 1.0),
        ("3-half", 3.0, 0.5),
        ("nothing-above", 7.0, 1.0),
    )
}
RANGE = {
    "iso": scene(),
    "front": scene(camera=FRONT),
    "opaque": scene(transfer_function={"opacity": "opaque"}),
    "linear": scene(transfer_function={"opacity": "linear"}),
}

RAY_CASES = (
    _case(
        "opacity-1",
        "opaque values, alone and beside transparent ones",
        scenes(
            {
                "everywhere": scene(transfer_function={"opacity": [[0.0, 1.0]]}),
                "a-step": scene(
                    transfer_function={"opacity": [[0.0, 0.0], [0.5, 0.0], [0.6, 1.0], [1.0, 1.0]]}
                ),
                "dense": scene(
                    transfer_function={"opacity": [[0.0, 0.9], [1.0, 1.0]], "density": 1e6}
                ),
            }
        ),
    ),
    _case(
        "opacity-0",
        "volumes that are hardly visible, and a fully transparent surface",
        scenes(
            {
                "thin": scene(transfer_function={"opacity": [[0.0, 0.0], [1.0, 1e-9]]}),
                "rare": scene(
                    transfer_function={"opacity": [[0.0, 0.0], [1.0, 1.0]], "density": 1e-6}
                ),
                "clear-surface": scene(
                    transfer_function=FOG, effects={"isosurfaces": [{"value": 0.5, "opacity": 0.0}]}
                ),
            }
        ),
    ),
    _case(
        "tiny-steps",
        "a million samples of each ray add up to the closed form",
        closed_form(
            {
                "step-1e-6": scene(
                    size=[2, 2],
                    camera=FRONT,
                    transfer_function={"opacity": [[0.0, 0.5]]},
                    march={"step": 1e-6},
                ),
                "step-1e-6-thin": scene(
                    size=[2, 2],
                    camera=FRONT,
                    transfer_function={"opacity": [[0.0, 1e-3]]},
                    march={"step": 1e-6},
                ),
                "step-64": scene(
                    size=[4, 4], transfer_function={"opacity": [[0.0, 0.5]]}, march={"step": 64.0}
                ),
            },
            1.0,
        ),
        make=_constant,
    ),
    _case(
        "rays-along-faces",
        "rays parallel to an axis, through vertices, along edges and faces",
        scenes(
            {
                view: scene(size=[9, 9], camera=_grid_camera(view), transfer_function=FOG)
                for view in AXES
            }
        ),
    ),
    _case(
        "rays-through-corners",
        "rays through corners and edges, and along diagonals",
        scenes(
            {
                name: scene(size=[9, 9], camera=camera, transfer_function=FOG)
                for name, camera in CORNERS.items()
            }
        ),
    ),
    _case(
        "cameras",
        "a camera inside the volume, on a face, edge or corner, and a million sizes away",
        scenes(
            {name: scene(camera=camera, transfer_function=FOG) for name, camera in CAMERAS.items()}
        ),
    ),
    *(
        _case(
            f"spacing-{name}",
            "cells of extreme shape",
            # An odd number of pixels, so that a ray through the middle hits the thinnest side. Long
            # steps, since a needle takes 10^7 of the usual ones.
            scenes(
                {
                    view: scene(
                        size=[15, 15],
                        camera={"view": view, "projection": "parallel"},
                        transfer_function=FOG,
                        march={"step": step},
                    )
                    for view in ("xy", "xz", "yz", "iso")
                }
            ),
            make=_placed(
                lambda: waves(SHAPE).astype(np.float32),
                z=_even(0, dz, 7),
                y=_even(0, dy, 6),
                x=_even(0, dx, 5),
            ),
            quick=name != "needles",
        )
        for name, dz, dy, dx, step in (
            ("needles", 1e6, 1.0, 1e-6, 64.0),
            ("small", 1e-6, 1e-6, 1e-6, 0.5),
            ("large", 1e6, -1e6, 1e6, 0.5),
            ("plates", 1e-3, 1e3, 1e3, 0.5),
        )
    ),
    _case(
        "far-origin",
        "positions far from the origin compared with the size of the volume",
        scenes({"iso": scene(transfer_function=FOG)}),
        make=_placed(
            lambda: waves(SHAPE).astype(np.float32),
            z=_even(1e8, 1.0, 7),
            y=_even(-1e8, 0.5, 6),
            x=_even(1e8, -1.0, 5),
        ),
    ),
    *(
        _case(
            f"drawn-range-{name}",
            "a range of values at the ends of float32, or small compared with its offset",
            scenes(RANGE),
            make=_scaled(factor, offset, dtype),
        )
        for name, factor, offset, dtype in (
            ("tiny", 1e-38, 0.0, np.float32),
            ("huge", 3e38, -1e38, np.float32),
            ("offset-float64", 1e-3, 1e8, np.float64),
            ("offset-float32", 64.0, 1e8, np.float32),
            ("float64-tiny", 1e-300, 0.0, np.float64),
            ("float64-huge", 1e300, 0.0, np.float64),
        )
    ),
    _case(
        "surfaces-on-vertices",
        "isosurfaces at exactly the values of vertices, from the smallest to above the largest",
        scenes(SURFACES),
        make=_stairs,
        settings=EXACT,
    ),
    _case(
        "surface-on-a-face",
        "an isosurface that coincides with a face of the volume",
        scenes(
            {
                "6": scene(
                    transfer_function={"nothing": True},
                    effects={"isosurfaces": [{"value": 6.0, "colour": "#ff8000"}]},
                )
            }
        ),
        make=_stairs,
        settings=EXACT,
    ),
    _case(
        "holes",
        "regions, a slab and single vertices without values",
        scenes(
            {
                "iso": scene(transfer_function=FOG),
                "other-side": scene(
                    camera={"azimuth": 190.0, "elevation": -20.0}, transfer_function=FOG
                ),
                "surface": scene(
                    transfer_function={"nothing": True}, effects={"isosurfaces": [{"value": 0.5}]}
                ),
            }
        ),
        make=_holes,
    ),
    *(
        _case(
            f"thin-{axis}",
            "a volume of one vertex along an axis",
            scenes(
                {
                    "iso": scene(transfer_function=FOG),
                    "side": scene(camera={"view": "xz"}, transfer_function=FOG),
                }
            ),
            make=_shaped(shape),
        )
        for axis, shape in {
            "z": (2, 1, 6, 5),
            "y": (2, 7, 1, 5),
            "x": (2, 7, 6, 1),
            "all": (2, 1, 1, 1),
        }.items()
    ),
    _case("blocks", "a volume cut in two at every layer, and put together again", blocks),
    _case(
        "pictures-at-key-times",
        "pictures at key times, given by step and by time",
        key_times,
        settings={**BOUND, **NETWORK},
    ),
)
