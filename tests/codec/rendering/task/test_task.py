"""The task of a marcher."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.task.task import COUNTERS, DENSEST, Frame, complete, extinctions_in, rows

GRID = Grid(counts=(11, 9, 1), origin=np.zeros(3), spacing=np.ones(3))


@pytest.mark.parametrize(
    ("first", "shape", "stride", "bounds"),
    [
        ((0, 0, 0), (1, 9, 11), 1, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 2, 3), (1, 4, 5), 1, [[3, 7], [2, 5], [-0.5, 0.5]]),
        # No further vertex would fit: the last values stand up to the end.
        ((0, 0, 0), (1, 3, 4), 3, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 0, 0), (1, 2, 3), 3, [[0, 6], [0, 3], [-0.5, 0.5]]),
    ],
)
def test_the_bounds_of_a_frame_reach_to_where_it_has_values(
    first: tuple[int, int, int], shape: tuple[int, ...], stride: int, bounds: list[list[float]]
) -> None:
    frame = Frame(values=np.zeros(shape, dtype=np.float32), first=first, stride=stride)
    np.testing.assert_array_equal(frame.bounds(GRID), bounds)


def test_extinctions_in_another_length_stay_finite() -> None:
    extinctions = np.array([0.0, 2.0, 1e300])
    np.testing.assert_array_equal(extinctions_in(extinctions, 1e20), [0.0, 2e20, DENSEST])


def test_counters_are_summed_in_one_order() -> None:
    total = complete({"samples": 3, "rays": 1}, {"samples": 4})
    assert list(total) == list(COUNTERS)
    assert total == {**dict.fromkeys(COUNTERS, 0), "rays": 1, "samples": 7}
    with pytest.raises(KeyError):
        complete({"photons": 1})


def test_every_counter_has_a_row() -> None:
    assert [name for name, _, _ in rows({})] == [name.replace("_", " ") for name in COUNTERS]
    assert ("secondary rays", "1,234", COUNTERS["secondary_rays"]) in rows({"secondary_rays": 1234})
