"""Scenes that come with fhash: nothing but lists of effects, as a file could hold them.

`flame`, `bubble` and `shell` resemble the three data sets of the F-Hash paper (its Table 2, which
writes X x Y x Z): Combustion 200 x 172 x 54 with 136 steps, Argon Bubble 128 x 128 x 256 with 241,
Supernova 216 x 216 x 216 with 136. Shapes here are (z, y, x).
"""

from __future__ import annotations

from typing import Any

__all__ = ["PRESETS"]

Scene = dict[str, Any]

VORTEX: Scene = {
    "help": "two blobs of a tracer carried and mixed by a swirl",
    "name": "tracer",
    "feature": "interval:0.08:2",
    "shape": (32, 48, 48),
    "effects": [
        {"effect": "blob", "centre": (0.36, 0.5, 0.27), "radius": 0.13, "edge": 0.1,
         "jitter": 0.03},
        {"effect": "blob", "centre": (0.52, 0.5, 0.72), "radius": 0.13, "edge": 0.1,
         "jitter": 0.03, "strength": 0.75},
        {"effect": "vortex", "strength": 1.4, "radius": 0.16},
        {"effect": "advection", "strength": 0.15, "direction": (1, 0, 0)},
        {"effect": "diffusion", "strength": 7e-4},
    ],
}  # fmt: skip
"""A tracer in a vortex."""

FRONT: Scene = {
    "help": "a blast's shell that expands and grows fingers",
    "name": "density",
    "units": "kg m-3",
    "feature": "interval:0.25:2",
    "shape": (32, 48, 48),
    "background": 0.1,
    "effects": [
        {"effect": "shell", "strength": 0.75, "radius": 0.38, "age": 0.13, "thickness": 0.07},
        {"effect": "fingers", "strength": 0.5, "count": 14, "growth": 0.8},
    ],
}
"""A blast wave."""

FLAME: Scene = {
    "help": "a plane jet of fuel, wrinkled by eddies (after the paper's Combustion)",
    "name": "mixture_fraction",
    "feature": "interval:0.35:0.65",
    "shape": (14, 43, 50),
    "steps": 34,
    "size": (0.27, 0.86, 1.0),
    "splits": 3,
    "paper_shape": (54, 172, 200),
    "paper_steps": 136,
    "effects": [
        {"effect": "front", "direction": (0, 1, 0), "start": 0.53, "depth": 0.2, "speed": 0,
         "width": 0.02},
        {"effect": "vortex", "strength": 0.25, "radius": 0.1, "centre": (0, 0.54, 0.2)},
        {"effect": "vortex", "strength": 0.25, "radius": 0.1, "centre": (0, 0.54, 0.7)},
        {"effect": "vortex", "strength": -0.25, "radius": 0.1, "centre": (0, 0.32, 0.45)},
        {"effect": "vortex", "strength": -0.25, "radius": 0.1, "centre": (0, 0.32, 0.95)},
        {"effect": "turbulence", "strength": 0.07, "scale": 0.35, "octaves": 4},
        {"effect": "diffusion", "strength": 2e-4},
    ],
}  # fmt: skip
"""A turbulent plane jet flame."""

BUBBLE: Scene = {
    "help": "a bubble of gas that rises, rolls up and breaks, behind a shock"
    " (after the paper's Argon Bubble)",
    "name": "intensity",
    "feature": "interval:0.3:2",
    "shape": (64, 32, 32),
    "steps": 30,
    "size": (2.0, 1.0, 1.0),
    "splits": 5,
    "paper_shape": (256, 128, 128),
    "paper_steps": 241,
    "effects": [
        {"effect": "blob", "centre": (0.5, 0.5, 0.5), "radius": 0.24, "edge": 0.02},
        {"effect": "front", "direction": (1, 0, 0), "start": 0.1, "speed": 2.5, "strength": 0.08,
         "depth": 0.25, "width": 0.03},
        {"effect": "buoyancy", "strength": 3.0, "radius": 0.2, "centre": (0.5, 0.5, 0.5)},
        {"effect": "turbulence", "strength": 0.05, "scale": 0.3, "octaves": 4},
        {"effect": "diffusion", "strength": 2e-4},
    ],
}  # fmt: skip
"""A rising bubble."""

SHELL: Scene = {
    "help": "a shell of a supernova with fingers, turbulent and turning (after the paper's"
    " Supernova)",
    "name": "angular_momentum",
    "feature": "interval:0.3:2",
    "shape": (54, 54, 54),
    "steps": 34,
    "splits": 2,
    "paper_shape": (216, 216, 216),
    "paper_steps": 136,
    "effects": [
        {"effect": "shell", "strength": 0.8, "radius": 0.38, "age": 0.2, "thickness": 0.05},
        {"effect": "shell", "strength": 0.4, "radius": 0.22, "age": 0.2, "thickness": 0.06},
        {"effect": "fingers", "strength": 0.22, "count": 16, "growth": 0.5},
        {"effect": "turbulence", "strength": 0.04, "scale": 0.25, "octaves": 3},
        {"effect": "rotation", "strength": 0.8},
        {"effect": "diffusion", "strength": 2e-5},
    ],
}
"""A supernova remnant."""

PRESETS: dict[str, Scene] = {
    "vortex": VORTEX,
    "front": FRONT,
    "flame": FLAME,
    "bubble": BUBBLE,
    "shell": SHELL,
}
"""Scenes by name."""
