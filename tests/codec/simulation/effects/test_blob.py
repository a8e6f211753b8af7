"""Blob: its value, its amount as it spreads, and its place."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.blob import Blob, round_surface

SPACING = (0.02, 0.02, 0.02)


def amount(blob: Blob, widening: float) -> float:
    """The integral of the value over all space."""
    radius = np.linspace(0, 3, 20001, dtype=np.float32)[None, None]
    body = blob.term(np.random.default_rng(0), SPACING)
    values = body.value(radius - np.float32(blob.radius), widening, 1.0)
    return float((values * 4 * np.pi * radius.astype(np.float64) ** 2).sum() * 3 / 20000)


def test_a_sharp_ball_holds_its_volume() -> None:
    blob = Blob(strength=2.0, radius=0.5, edge=0.0)
    assert amount(blob, 0.0) == pytest.approx(2.0 * 4 / 3 * np.pi * 0.5**3, rel=1e-3)


@pytest.mark.parametrize("widening", [1e-4, 1e-2, 0.05])
def test_the_amount_stays_as_it_spreads(widening: float) -> None:
    blob = Blob(radius=0.5, edge=0.05)
    assert amount(blob, widening) == pytest.approx(amount(blob, 0.0), rel=5e-3)


def test_the_seed_moves_it_by_its_jitter_at_most() -> None:
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    distances = [
        Blob(centre=(0, 0, 0), radius=0.1, jitter=0.2)
        .term(np.random.default_rng(seed), SPACING)
        .surface((zero, zero, zero), 0.0)
        .distance.item()
        for seed in range(20)
    ]
    assert len(set(distances)) == 20
    assert max(distances) <= 0.2 * 3**0.5 - 0.1 + 1e-6


def test_directions_are_unit_vectors_and_finite_in_the_middle() -> None:
    line = np.linspace(-1, 1, 3, dtype=np.float32)
    surface = round_surface(np.ix_(line, line, line), (0, 0, 0), 0.5)
    z, y, x = surface.waves()
    lengths = np.sqrt(z * z + y * y + x * x)
    assert lengths[1, 1, 1] == 0
    np.testing.assert_allclose(np.delete(lengths.ravel(), 13), 1, atol=1e-4)
    assert surface.distance[1, 1, 1] == np.float32(-0.5)
