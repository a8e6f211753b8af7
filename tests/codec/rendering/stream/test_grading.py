"""Factors of the extinction by gradient, at places of a field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from frame_field import FrameField

from fhash_codec.rendering.stream.grading import Factors
from fhash_codec.rendering.task.task import GRADES, Grading, Task

FrameTask = Callable[..., tuple[FrameField, Task]]


@pytest.mark.parametrize(("slope", "factor"), [(0.0, 0.1), (0.5, 0.35), (1.0, 0.6), (9.0, 0.6)])
def test_a_ramp_has_the_factor_of_its_gradient(
    frame_task: FrameTask, slope: float, factor: float
) -> None:
    z, y, x = np.meshgrid(*(np.arange(6.0),) * 3, indexing="ij")
    field, task = frame_task(slope * (0.6 * y + 0.8 * z) + 0 * x)
    assert Factors.of(task, field) is None
    grading = Grading(factors=np.linspace(0.1, 0.6, GRADES + 1), top=1.0)
    factors = Factors.of(replace(task, grading=grading), field)
    assert factors is not None
    places = np.random.default_rng(3).uniform(0, 5, (20, 3))
    np.testing.assert_allclose(factors(places), factor, atol=1e-6)
