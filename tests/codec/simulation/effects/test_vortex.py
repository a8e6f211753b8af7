"""Vortex: parcels circle, fastest at the core's edge."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.vortex import Vortex

RADIUS = 0.2


def speed(distance: float) -> float:
    """Speed along y of a parcel beside the middle, from where it came a moment ago."""
    effect = Vortex(strength=3.0, radius=RADIUS, centre=(0, 0, 0))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    _, y, _ = flow.carry((zero, zero, zero + np.float32(distance)), 0.0, 1e-3)
    return float(-y.item() / 1e-3)


def test_the_largest_speed_is_the_strength_at_the_radius() -> None:
    assert speed(RADIUS) == pytest.approx(3.0, rel=1e-3)
    assert speed(0.9 * RADIUS) < speed(RADIUS) > speed(1.1 * RADIUS)


def test_far_away_the_speed_falls_off_as_the_inverse_of_the_distance() -> None:
    assert speed(2.0) / speed(4.0) == pytest.approx(2.0, rel=1e-2)


def test_near_the_middle_it_turns_as_a_solid() -> None:
    assert speed(0.02) / speed(0.01) == pytest.approx(2.0, rel=2e-2)


def test_the_distance_to_the_axis_stays_and_what_is_even_along_it_is_computed_once() -> None:
    flow = Vortex(strength=8.0).term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = np.ix_(*(np.linspace(0, 1, 5, dtype=np.float32),) * 3)
    _, v, u = flow.carry((z, y, x), 0.0, 1.0)
    assert v.shape == u.shape == (1, 5, 5)
    before = np.hypot(y - 0.5, x - 0.5)
    np.testing.assert_allclose(np.hypot(v - 0.5, u - 0.5), before, atol=1e-5)
    assert not flow.rigid
