"""Levels of masks from decoded values: what they are, and the settings that are refused."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from reference.masks import BOUNDS, mask_levels

from fhash_formats.errors import InputError
from fhash_formats.transform.entropy.mask_levels import MAX_SCORE, MaskLevels


def test_levels_rise_with_the_value_and_reach_as_far_as_the_feature_grew() -> None:
    values = np.zeros((1, 1, 3, 9), np.float32)
    values[0, 0, 1, 4] = 5.0
    levels, others = MaskLevels(edges=(1.0, 4.0), scores=(0, 128, 2000), reach=2).levels(values)
    np.testing.assert_array_equal(
        levels[0, 0, 1] > 0, [False, False, True, True, True, True, True, False, False]
    )
    assert levels.max() == sum(bound <= 2000 for bound in BOUNDS)
    np.testing.assert_array_equal(np.argwhere(others), [[0, 0, 1, 4]])
    rising = MaskLevels(edges=(1.0, 4.0), scores=(0, 128, 2000)).levels(
        np.array([0, 1, 3.9, 4], np.float64).reshape(1, 1, 1, 4)
    )[0]
    assert list(rising.ravel()) == [0, 16, 16, levels.max()]
    assert all(low < high <= MAX_SCORE for low, high in pairwise(BOUNDS))


@pytest.mark.parametrize("reach", [0, 1, 3, 64])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (2, 3, 5, 17), (1, 9, 1, 40), (3, 1, 70, 2)])
def test_levels_are_those_of_the_reference(shape: tuple[int, ...], dtype: str, reach: int) -> None:
    random = np.random.default_rng(reach)
    values = random.normal(size=shape).astype(dtype)
    values.flat[::5] = 0.5
    for others in ((), (9, 0, 4095, 30)):
        scores = MaskLevels(
            edges=(-1.0, 0.5, 1e300), scores=(0, 3, 900, 4095), others=others, reach=reach
        )
        found = scores.levels(values)
        both = [scores.scores, *([others] if others else [])]
        expected = mask_levels(values, {"edges": scores.edges, "reach": reach, "scores": both})
        for one, other in zip(found, expected, strict=True):
            assert one.dtype == np.uint8
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "change",
    [
        {"edges": (1.0,)},
        {"edges": (1.0, 1.0), "scores": (0, 1, 2)},
        {"edges": (float("nan"),), "scores": (0, 1)},
        {"edges": (10**400,), "scores": (0, 1)},
        {"edges": tuple(range(16)), "scores": (0,) * 17},
        {"scores": (-1,)},
        {"scores": (4096,)},
        {"scores": (1.5,)},
        {"others": (1, 2)},
        {"reach": 65},
        {"reach": True},
    ],
    ids=str,
)
def test_settings_that_are_not_allowed(change: Any) -> None:
    with pytest.raises(InputError):
        MaskLevels(**change)
