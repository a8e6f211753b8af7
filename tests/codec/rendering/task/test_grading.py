"""Opacity by gradient: the units of a scene's gradients."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Renderer, Scene, Volume


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
