"""Tools that effects share: a step, directions and axes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.simulation.effects.effect import (
    Effect,
    axis_last,
    direction_of,
    smooth_step,
    times,
)


def test_a_step_is_half_the_complementary_error_function() -> None:
    distance = np.linspace(-3, 3, 601, dtype=np.float32)
    expected = [math.erfc(each / 0.7) / 2 for each in distance.tolist()]
    np.testing.assert_allclose(smooth_step(distance, 0.7), expected, atol=3e-4)


@pytest.mark.parametrize("width", [1e-6, 1e15])
def test_a_step_is_finite_for_any_width_and_leaves_its_input(width: float) -> None:
    distance = np.float32([-1e7, -1e-7, 0.0, 1e-7, 1e7])
    kept = distance.copy()
    step = smooth_step(distance, width)
    np.testing.assert_array_equal(distance, kept)
    assert np.isfinite(step).all()
    assert ((step >= 0) & (step <= 1)).all()
    assert step[2] == 0.5


def test_directions_are_of_length_one_or_none() -> None:
    assert direction_of((0, 3, 4)) == pytest.approx((0, 0.6, 0.8))
    assert direction_of((0, 0, 0)) is None


def test_axes_turn_in_cyclic_order() -> None:
    turns = {axis: tuple("zyx"[number] for number in axis_last(axis)) for axis in "zyx"}
    assert turns == {"z": ("x", "y", "z"), "y": ("z", "x", "y"), "x": ("y", "z", "x")}


def test_products_leave_out_parts_that_are_zero() -> None:
    z, y, x = (np.full((1, 1, 1), value, dtype=np.float32) for value in (1, np.nan, 3))
    assert times((z, y, x), (2, 0, 5)).item() == 17
    assert times((z, y, x), (0, 0, 0)).item() == 0


def test_an_effect_without_a_term_cannot_be_made() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Effect()  # type: ignore[abstract]
