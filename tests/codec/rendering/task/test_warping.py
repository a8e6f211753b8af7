"""Frames of uneven axes: values at drawn vertices, regions, levels of detail, missing values."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.camera.axes import Warp
from fhash_codec.rendering.task.task import Frame
from fhash_codec.rendering.task.warping import warped

PLACES = np.array([0, 0.25, 0.5, 1, 1.5, 2, 3, 4.0])
WARP = Warp(counts=(5, 2, 3), places=(PLACES, None, None))


def frame(values: np.ndarray, first: tuple[int, int, int] = (0, 0, 0), stride: int = 1) -> Frame:
    return Frame(values=values.astype(np.float32), first=first, stride=stride)


def test_without_a_warp_nothing_happens() -> None:
    given = frame(np.zeros((2, 2, 2)))
    assert warped(given, None) is given


def test_values_are_linear_between_the_vertices_of_the_series() -> None:
    z, y, x = np.meshgrid(range(3), range(2), range(5), indexing="ij")
    drawn = warped(frame(100 * z + 10 * y + x), WARP)
    assert drawn.values.shape == (3, 2, 8)
    np.testing.assert_allclose(drawn.values[2, 1], 210 + PLACES)
    assert drawn.values.flags.c_contiguous


def test_a_vertex_without_a_value_takes_those_beside_it_along() -> None:
    values = np.arange(5.0)
    values[2] = np.nan
    line = warped(frame(np.broadcast_to(values, (3, 2, 5)).copy()), WARP).values[0, 0]
    np.testing.assert_array_equal(line, [0, 0.25, 0.5, 1, np.nan, np.nan, 3, 4])
    np.testing.assert_array_equal(values, [0, 1, np.nan, 3, 4])


def test_a_region_keeps_its_place() -> None:
    drawn = warped(frame(np.arange(1.0, 4.0)[None, None].repeat(2, axis=1), (1, 0, 1)), WARP)
    assert drawn.first == (1, 0, 3)
    np.testing.assert_allclose(drawn.values[0, 0], [1, 1.5, 2, 3])
    nothing = warped(frame(np.ones((1, 1, 1)), (0, 0, 4)), WARP)
    assert nothing.values.shape == (1, 1, 1)
    assert nothing.first == (0, 0, 7)


def test_a_coarse_frame_reaches_to_the_end() -> None:
    warp = Warp(counts=(6, 1, 1), places=(np.linspace(0, 5, 11), None, None))
    drawn = warped(frame(np.array([0.0, 2, 4])[None, None], stride=2), warp)
    assert drawn.stride == 2
    np.testing.assert_allclose(drawn.values[0, 0], [0, 1, 2, 3, 4, 4])
