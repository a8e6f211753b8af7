"""Shell: the law of Sedov and Taylor, and its profile."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.shell import Shell


def test_the_radius_grows_as_time_to_the_two_fifths() -> None:
    shell = Shell(radius=0.4, age=0.1)
    assert shell.grown(1.0) == pytest.approx(0.4)
    ratio = (0.5 + 0.1) / (0.2 + 0.1)
    assert shell.grown(0.5) / shell.grown(0.2) == pytest.approx(ratio**0.4)


def test_it_is_densest_at_its_edge_and_weakens() -> None:
    shell = Shell(strength=2.0, radius=0.4, thickness=0.05, centre=(0, 0, 0))
    body = shell.term(np.random.default_rng(0), (0.01, 0.01, 0.01))
    radius = np.linspace(0, 0.6, 601, dtype=np.float32)[None, None]
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    profile = body.value(body.surface((zero, zero, radius), 1.0).distance, 0.0, 1.0).ravel()
    assert profile.argmax() == pytest.approx(385, abs=12)
    assert profile[350] / profile[300] == pytest.approx(np.exp(1), rel=0.02)
    assert profile[-1] == 0
    assert shell.level(0.0) > shell.level(1.0) == 2.0
    assert Shell(weakening=0, strength=2.0).level(0.0) == 2.0
