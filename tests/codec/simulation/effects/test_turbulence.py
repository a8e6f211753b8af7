"""Turbulence: volumes stay, and waves that the lattice cannot show are left out."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.effect import Place, Vector
from fhash_codec.simulation.effects.turbulence import Turbulence

FINE: Vector = (1e-4, 1e-4, 1e-4)


def carried(place: np.ndarray, spacing: Vector = FINE, seed: int = 0, **settings: float) -> Place:
    flow = Turbulence(**settings).term(np.random.default_rng(seed), spacing)
    z, y, x = (part.astype(np.float32)[:, None, None] for part in place.T)
    return flow.carry((z, y, x), 0.0, 0.5)


def test_volumes_stay() -> None:
    """A small cube and its image have the same volume, by differences in float32."""
    edge, corner = 2e-3, np.array([0.3, 0.6, 0.1])
    corners = corner + np.concatenate([np.zeros((1, 3)), np.eye(3) * edge, -np.eye(3) * edge])
    came = np.stack(
        [part[:, 0, 0] for part in carried(corners, strength=0.1, scale=0.5, octaves=2)]
    )
    jacobian = (came[:, 1:4] - came[:, 4:7]) / (2 * edge)
    assert np.linalg.det(jacobian.astype(np.float64)) == pytest.approx(1.0, abs=2e-3)


def test_the_way_is_bounded_by_speed_and_time() -> None:
    places = np.random.default_rng(5).uniform(size=(50, 3))
    came = np.stack([part[:, 0, 0] for part in carried(places, strength=0.4, octaves=3)], axis=-1)
    sizes = 0.4 * 0.5 * sum(2 ** (-octave / 3) for octave in range(3))
    moved = np.abs(came - places)
    assert 0.01 < moved.max() <= sizes + 1e-5


@pytest.mark.parametrize(
    ("step", "left"),
    [(0.3 / 8 / 3 / 1.01, 12), (0.3 / 3 * 1.5, 0)],
)
def test_waves_of_fewer_than_three_vertices_are_left_out(step: float, left: int) -> None:
    flow = Turbulence(scale=0.3, octaves=4).term(np.random.default_rng(0), (step, step, step))
    shown = int(flow.note.split()[0])
    assert shown == left if left else shown <= 3
    assert ("left out" in flow.note) == (left < 12)


def test_an_axis_of_one_vertex_leaves_nothing_out() -> None:
    flow = Turbulence(octaves=4).term(np.random.default_rng(0), (0.0, 1e-3, 1e-3))
    assert "left out" not in flow.note


def test_other_random_numbers_are_another_flow() -> None:
    places = np.array([[0.2, 0.4, 0.6]])
    first, again, other = (carried(places, seed=seed) for seed in (1, 1, 2))
    assert first[0].item() == again[0].item() != other[0].item()
