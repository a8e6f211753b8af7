"""Buoyancy: the thermal rises by its law, and volumes stay."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.simulation.effects.buoyancy import Buoyancy

EFFECT = Buoyancy(strength=2.0, radius=0.25, centre=(0.5, 0.5, 0.5))


def carry(places: np.ndarray, stop: float, effect: Buoyancy = EFFECT) -> np.ndarray:
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = (part.astype(np.float32)[:, None, None] for part in places.T)
    return np.stack([part[:, 0, 0] for part in flow.carry((z, y, x), 0.0, stop)], axis=-1)


def test_it_falls_upwards_first_and_then_keeps_its_speed() -> None:
    assert EFFECT.height(0.0) == 0
    assert EFFECT.height(0.01) == pytest.approx(2.0 * 0.01**2 / 2, rel=1e-2)
    assert EFFECT.height(9.0) - EFFECT.height(8.0) == pytest.approx(math.sqrt(2.0 * 0.25), rel=1e-3)
    assert Buoyancy(strength=-2.0).height(1.0) == -Buoyancy(strength=2.0).height(1.0)
    assert math.isfinite(Buoyancy(strength=1e3, radius=1e-3).height(1e6))


def test_the_middle_came_from_below_and_what_is_far_away_stayed() -> None:
    came = carry(np.array([[0.9, 0.5, 0.5], [0.5, 0.5, 2.5]]), 0.4)
    assert came[0, 0] == pytest.approx(0.9 - EFFECT.height(0.4), abs=1e-3)
    np.testing.assert_allclose(came[1], [0.5, 0.5, 2.5], atol=1e-6)


@pytest.mark.parametrize("place", [(0.55, 0.5, 0.7), (0.45, 0.65, 0.6), (0.7, 0.4, 0.45)])
def test_volumes_stay(place: tuple[float, float, float]) -> None:
    edge = 2e-3
    corners = np.array(place) + np.concatenate([np.eye(3) * edge, -np.eye(3) * edge])
    came = carry(corners, 0.3)
    jacobian = ((came[:3] - came[3:]) / (2 * edge)).astype(np.float64)
    assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=5e-3)
