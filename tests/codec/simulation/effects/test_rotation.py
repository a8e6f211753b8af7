"""Rotation: a solid turns, with the sense of a right hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.simulation.effects.rotation import Rotation


@pytest.mark.parametrize(
    ("axis", "here", "before"),
    [
        ("z", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),  # y was x
        ("x", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # z was y
        ("y", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),  # x was z
    ],
)
def test_a_quarter_turn_brings_x_to_y_to_z_to_x(
    axis: str, here: tuple[float, ...], before: tuple[float, ...]
) -> None:
    effect = Rotation(strength=math.pi / 2, axis=axis, centre=(0, 0, 0))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = (np.full((1, 1, 1), part, dtype=np.float32) for part in here)
    came = [part.item() for part in flow.carry((z, y, x), 2.0, 3.0)]
    np.testing.assert_allclose(came, before, atol=1e-6)


def test_distances_stay() -> None:
    flow = Rotation(strength=5.0).term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    places = np.random.default_rng(1).uniform(size=(3, 2, 1, 1)).astype(np.float32)
    came = np.stack(flow.carry((places[0], places[1], places[2]), 0.0, 0.7))
    before, after = (np.linalg.norm(each[:, 0] - each[:, 1]) for each in (places, came))
    assert after == pytest.approx(before, rel=1e-5)
    assert flow.rigid
