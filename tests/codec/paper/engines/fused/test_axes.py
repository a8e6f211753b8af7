"""The tables of the kernels say what those of slab and of Adam's catching up say."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.axes import axis_tables, missed_step_tables
from fhash_codec.paper.engines.upsampling import axis_matrices
from fhash_codec.training.adam import EPSILON, WINDOW, catch_up


@pytest.mark.parametrize("shape", [(3, 9, 20, 35), (1, 1, 33, 2), (2, 5, 1, 1), (5, 16, 8, 64)])
def test_corners_and_weights_are_those_of_the_matrices(noise_coreset, shape) -> None:
    coreset = noise_coreset(shape)
    architecture = Architecture.for_box(coreset.box.shape, shape[0])
    lengths, counts = (1, *coreset.brick_shape), (shape[0], *coreset.brick_grid)
    axes = axis_tables(architecture, coreset)
    for number, (axis, length, count) in enumerate(zip(axes, lengths, counts, strict=True)):
        for level, resolution in enumerate(architecture.levels[1:]):
            start, expected = axis_matrices(
                architecture.sizes[number], resolution[number], length, count
            )
            before, after = axis.before[:, level], axis.after[:, level]
            assert axis.corners[level] == expected.shape[2]
            np.testing.assert_array_equal(axis.start[:, level], start)
            weights = np.zeros((count, length, expected.shape[2] + 1))
            rows, columns = np.ogrid[:count, :length]
            weights[rows, columns, before] = 1 - after
            weights[rows, columns, before + 1] += after
            # No weight lies beyond the last corner.
            assert not weights[..., -1].any()
            np.testing.assert_allclose(weights[..., :-1], expected, atol=1e-7)


@pytest.mark.parametrize("gap", [1, 7, WINDOW, WINDOW + 60])
def test_missed_steps_sum_up_to_what_adam_catches_up_by(gap) -> None:
    rates = np.linspace(0.01, 0.0, 500)
    powers, weights = missed_step_tables(rates)
    visited = np.array([1, 5, 120])
    for number, first in enumerate(visited):
        expected = catch_up(visited[number : number + 1], first + gap, rates)
        i = np.arange(1, min(gap, WINDOW) + 1)
        factor = (powers[i, 0] * weights[first + i, 0]).sum()
        inverse = (powers[i, 1] * weights[first + i, 1]).sum()
        assert factor == pytest.approx(expected.factor[0], rel=1e-5)
        assert EPSILON * factor / inverse == pytest.approx(expected.epsilon[0], rel=1e-5)
