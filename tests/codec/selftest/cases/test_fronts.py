"""Fronts, spikes and steps lie where their names say."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.selftest.cases import fronts

CASES = {case.name: case for case in fronts.CASES}


def values_of(name: str) -> np.ndarray:
    return np.stack(list(CASES[name].make().frames()))


@pytest.mark.parametrize("name", ["checkerboard", "checkerboard-uint8"])
def test_the_checkerboard_alternates_along_every_axis(name: str) -> None:
    values = values_of(name).astype(int)
    for axis in range(4):
        assert set(np.abs(np.diff(values, axis=axis)).ravel()) == {1}


def test_flicker_changes_the_sign_with_every_step() -> None:
    values = values_of("flicker")
    assert (values[1:] * values[:-1] < 0).all()


def test_spikes_are_single_vertices() -> None:
    assert np.count_nonzero(values_of("spike")) == 1
    for axis in range(1, 4):
        nonzero = np.moveaxis(values_of("spikes") != 0, axis, 0)
        assert nonzero.any()
        assert not (nonzero[1:] & nonzero[:-1]).any()


@pytest.mark.parametrize(
    ("name", "levels"), [("step-on-vertex", {0.0, 0.5, 1.0}), ("step-between", {0.0, 1.0})]
)
def test_a_step_has_its_middle_on_a_vertex_or_between_two(name: str, levels: set[float]) -> None:
    assert set(values_of(name).ravel().tolist()) == levels


@pytest.mark.parametrize(
    ("name", "share"), [("creeping-front", 1e-3), ("slow-front", 0.15), ("fast-front", 1.0)]
)
def test_a_front_moves_as_fast_as_its_name_says(name: str, share: float) -> None:
    """A share of the vertices, at most, changes its side from one step to the next."""
    ahead = values_of(name) > 0
    changed = (ahead[1:] != ahead[:-1]).mean()
    assert changed <= share
    if name != "creeping-front":
        assert changed > 0
