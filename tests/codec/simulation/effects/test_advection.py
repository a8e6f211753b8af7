"""Advection: the medium came from where the wind brought it."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.simulation.effects.advection import Advection

PLACE = (np.float32([[[0.5]]]), np.float32([[[0.25]]]), np.float32([[[0.75]]]))


def test_a_parcel_came_from_upwind() -> None:
    effect = Advection(strength=2.0, direction=(0, 3, 4))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = flow.carry(PLACE, 1.0, 1.25)
    assert z is PLACE[0]
    assert y.item() == pytest.approx(0.25 - 0.5 * 0.6)
    assert x.item() == pytest.approx(0.75 - 0.5 * 0.8)
    assert flow.rigid
    assert flow.exact


@pytest.mark.parametrize("settings", [{"strength": 0.0}, {"direction": (0, 0, 0)}])
def test_no_speed_or_direction_is_idle(settings: dict[str, object]) -> None:
    assert "0" in Advection(**settings).idle
    assert not Advection().idle
