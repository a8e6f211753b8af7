"""Opacity by gradient: the units of a scene's gradients."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering.task.grading import factors_at_vertices
from fhash_codec.rendering.task.task import GRADES, Grading

LINEAR = Grading(factors=np.linspace(0.0, 1.0, GRADES + 1), top=2.0)


def test_a_gradient_is_a_share_of_the_range_in_the_distance_of_two_vertices(volume: Volume) -> None:
    scene = {"transfer_function": {"gradient_opacity": [[0.1, 0.2], [0.5, 1]]}}
    for scale in (1.0, 3.0):
        plan = Renderer(volume).plan(Scene.from_dict({**scene, "scale": [scale] * 3}))
        grading = plan.task.grading
        assert grading is not None
        assert grading.top == pytest.approx(
            0.5 * (volume.value_range.high - volume.value_range.low) / scale
        )
        np.testing.assert_allclose(grading.factors[[0, 205, 1024]], [0.2, 0.2, 1.0], atol=1e-3)
    assert Renderer(volume).plan(Scene()).task.grading is None


def test_factors_at_vertices_are_those_of_their_gradients() -> None:
    z, y, x = np.mgrid[:5, :6, :7].astype(np.float32)
    slope = np.ascontiguousarray(0.5 * x - 0.3 * y + 0.4 * z)
    spacing = np.array([1.0, -0.5, 2.0])
    steep = np.sqrt(0.5**2 + 0.6**2 + 0.2**2)
    np.testing.assert_allclose(factors_at_vertices(slope, LINEAR, spacing), steep / 2, atol=1e-5)
    assert np.all(factors_at_vertices(40 * slope, LINEAR, spacing) == 1)
    assert np.all(factors_at_vertices(np.ones((1, 1, 1), np.float32), LINEAR, spacing) == 0)


def test_neighbours_that_are_missing_do_not_count() -> None:
    row = np.array([[[0.0, 1.0, np.nan, 5.0, np.nan, np.nan, 8.0, 9.0]]], dtype=np.float32)
    factors = factors_at_vertices(row, LINEAR, np.ones(3))[0, 0]
    np.testing.assert_allclose(factors, [0.5, 0.5, 0, 0, 0, 0, 0.5, 0.5], atol=1e-6)


def test_gradients_near_zero_are_all_beyond_the_last_factor_or_zero(volume: Volume) -> None:
    """Their inverse would be infinite, and infinity times a gradient of 0 is no number."""
    scene = Scene.from_dict({"transfer_function": {"gradient_opacity": [[0, 0], [5e-324, 1]]}})
    grading = Renderer(volume).plan(scene).task.grading
    assert grading is not None
    assert grading.top > 0
    row = np.array([[[3.0, 3.0, 3.0, 4.0]]], dtype=np.float32)
    for spacing in (np.ones(3), np.full(3, 1e-30)):
        assert factors_at_vertices(row, grading, spacing).tolist() == [[[0, 0, 1, 1]]]
