"""Front: where it is, what is behind it, and a sheet of some depth."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.front import Front

LINE = np.linspace(0, 1, 101, dtype=np.float32)[None, None]
ZERO = np.zeros((1, 1, 1), dtype=np.float32)


def values(front: Front, time: float, widening: float = 0.0) -> np.ndarray:
    body = front.term(np.random.default_rng(0), (0.01, 0.01, 0.01))
    surface = body.surface((ZERO, ZERO, LINE), time)
    return body.value(surface.distance, widening, time).ravel()


def test_it_moves_at_its_speed_and_leaves_its_value_behind() -> None:
    front = Front(strength=-3.0, start=0.2, speed=0.5, width=0.01)
    early, late = values(front, 0.0), values(front, 1.0)
    assert early[20] == pytest.approx(-1.5)
    assert late[70] == pytest.approx(-1.5, abs=1e-4)
    assert (late[0], late[-1]) == (-3.0, 0.0)


def test_a_depth_makes_a_sheet_that_keeps_its_amount_as_it_spreads() -> None:
    front = Front(start=0.6, speed=0.0, depth=0.2, width=0.01)
    sharp, wide = values(front, 0.0), values(front, 0.0, 0.005)
    assert sharp[50] == pytest.approx(1.0, abs=1e-6)
    assert (sharp[30], sharp[70]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert wide.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    assert wide.max() < 0.99


def test_what_does_not_depend_on_an_axis_has_length_one_along_it() -> None:
    body = Front(direction=(0, 2, 0)).term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    column = np.zeros((1, 7, 1), dtype=np.float32)
    assert body.surface((ZERO, column, LINE), 0.0).distance.shape == (1, 7, 1)


def test_no_direction_is_idle() -> None:
    assert Front(direction=(0, 0, 0)).idle == "its direction is 0"
    assert Front(strength=0).idle == "its strength is 0"
