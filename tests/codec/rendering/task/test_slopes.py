"""Scales of gradients: noise of rounding is not lit, and squares stay within float32."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.task.slopes import FLATTEST, STEEPEST, flatness, slope_scale
from fhash_formats.series import Coordinate


def grid(*spacing: float) -> Grid:
    """A grid of 5 vertices along x, y and z with these spacings."""
    axes = zip("xyz", spacing, strict=True)
    coords = {axis: Coordinate(name=axis, values=step * np.arange(5.0)) for axis, step in axes}
    return Grid.of({"t": Coordinate(name="t", values=np.zeros(1)), **coords})


def test_the_range_is_that_of_the_table() -> None:
    assert flatness(1.0, 3.0, 0.0, 9.0) == (2.0, max(FLATTEST, 4 * 2.0**-23 * 9 / 2))


def test_values_with_a_large_offset_have_a_higher_floor() -> None:
    _, plain = flatness(0.0, 1.0, 0.0, 1.0)
    _, offset = flatness(1e4, 1e4 + 1, 1e4, 1e4 + 1)
    assert plain == FLATTEST
    # The noise of rounding is 1e4 * 2**-23, four times over.
    assert offset == 4 * 2.0**-23 * (1e4 + 1)


def test_a_constant_table_has_a_range_all_the_same() -> None:
    assert flatness(2.0, 2.0, 2.0, 2.0)[0] == 1.0


def test_gradients_are_shares_of_the_range_per_vertex_spacing() -> None:
    scale = slope_scale(grid(1.0, 1.0, 1.0), 4.0, 0.0, 4.0)
    np.testing.assert_allclose(scale, 0.25)


def test_the_largest_gradient_does_not_overflow() -> None:
    scale = slope_scale(grid(1e-5, 1.0, 1e5), 1e-20, 0.0, 1e10)
    assert np.isfinite(scale).all()
    assert np.abs(scale).max() * 1e10 <= STEEPEST * (1 + 1e-12)
