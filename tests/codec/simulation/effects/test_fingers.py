"""Fingers: they grow, are bounded, and stand where their random numbers say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.simulation.effects.effect import Place
from fhash_codec.simulation.effects.fingers import MEAN, Fingers


def directions() -> Place:
    vectors = np.random.default_rng(3).normal(size=(3, 4000, 1, 1))
    z, y, x = (vectors / np.linalg.norm(vectors, axis=0)).astype(np.float32)
    return z, y, x


def test_they_grow_to_their_strength_and_stay() -> None:
    effect = Fingers(strength=0.5, growth=0.2, count=20, waves=16)
    bend = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    early, late, later = (bend(directions(), True, time) for time in (0.1, 3.0, 30.0))
    np.testing.assert_allclose(early, late * math.tanh(0.5), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(late, later, atol=1e-6)
    assert late.max() == pytest.approx(0.5 * (1 - MEAN), rel=0.1)
    assert late.min() >= -0.5 * MEAN - 1e-6


def test_few_places_have_one_and_the_surface_stays_in_its_mean() -> None:
    bend = Fingers(strength=1.0, count=20, waves=16).term(np.random.default_rng(0), (0, 0, 0))
    shift = bend(directions(), True, 100.0)
    assert 0.05 < (shift > 0.25).mean() < 0.4
    assert abs(shift.mean()) < 0.12


def test_the_count_is_that_of_waves_in_a_metre_of_a_front() -> None:
    """A single direction along x: the shift repeats after 1 / count m."""
    bend = Fingers(count=5.0, waves=3).term(np.random.default_rng(0), (0, 0, 0))
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    line = np.linspace(0, 1, 400, dtype=np.float32)[None, None]
    shift = bend((zero, zero, line), False, 9.0).ravel()
    assert np.abs(np.diff(np.sign(shift - shift.mean()))).sum() / 2 <= 2 * 5
