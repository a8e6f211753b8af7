"""Diffusion: the equation of heat, in a medium at rest and in one that is drawn out."""

from __future__ import annotations

import math

import numpy as np

from fhash_codec.simulation.effects.diffusion import Diffusion
from fhash_codec.simulation.simulate import simulate

DIFFUSIVITY = 4e-3


def test_its_term_is_the_diffusivity() -> None:
    assert Diffusion(strength=0.25).term(np.random.default_rng(0), (0, 0, 0)) == 0.25
    assert Diffusion(strength=0).idle


def test_a_front_becomes_an_error_function_of_width_sqrt_4dt() -> None:
    scene = {
        "shape": (1, 1, 512),
        "effects": [
            {"effect": "front", "start": 0.5, "speed": 0, "width": 0},
            {"effect": "diffusion", "strength": DIFFUSIVITY},
        ],
    }
    series = simulate(scene)
    x, time = series.coords["x"].values, series.coords["t"].values
    for step in (8, 15):
        width = math.sqrt(4 * DIFFUSIVITY * time[step])
        expected = [math.erfc((place - 0.5) / width) / 2 for place in x]
        np.testing.assert_allclose(series.read(step).ravel(), expected, atol=2e-3)


def test_a_medium_that_is_drawn_out_mixes_sooner() -> None:
    """The share of the contrast that diffusion takes is larger in a vortex than at rest."""
    sheet = {"effect": "front", "start": 0.55, "speed": 0, "depth": 0.1, "direction": (0, 1, 0)}
    vortex = {"effect": "vortex", "strength": 1.0}
    diffusion = {"effect": "diffusion", "strength": 1e-4}

    def contrast(*effects: dict[str, object]) -> float:
        frame = simulate({"effects": effects}, (2, 1, 128, 128)).read(1)
        return float(frame[:, 40:88, 40:88].std())

    at_rest = 1 - contrast(sheet, diffusion) / contrast(sheet)
    wound = 1 - contrast(sheet, vortex, diffusion) / contrast(sheet, vortex)
    assert wound > 2 * at_rest > 0
