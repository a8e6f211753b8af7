"""Plans of growing files: a bound, and tiles of the first steps."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import EncodeConfig, InputError
from fhash_codec.appending.planning import bound_of, plan_layers
from fhash_codec.measure.value_range import ValueRange

RANGE = ValueRange(-1.0, 3.0)


def test_the_bound_is_absolute_or_of_a_known_range() -> None:
    assert bound_of(EncodeConfig(max_error=0.5), None) == 0.5
    assert bound_of(EncodeConfig(max_error_rel=0.01), RANGE) == 0.04
    with pytest.raises(InputError, match="give value_range"):
        bound_of(EncodeConfig(max_error_rel=0.01), None)
    for other in ({}, {"psnr": 50}, {"ratio": 5}):
        with pytest.raises(InputError, match="promises a bound"):
            bound_of(EncodeConfig(**other), RANGE)


def test_the_plan_covers_the_expected_range_and_the_frames() -> None:
    frames = list(np.linspace(0, 2, 3 * 4 * 5 * 6, dtype=np.float32).reshape(3, 4, 5, 6))
    found = plan_layers(frames, EncodeConfig(max_error=0.1, effort=1), 0.1, ValueRange(-7.0, 1.0))
    assert found.coder.settings.low <= -7
    assert found.coder.settings.high >= 2
    assert found.coder.coding.error == 0.1
    assert found.coder.tile[0] <= 3
    assert found.header["config"]["max_error"] == 0.1
    assert found.header["feature_bounding_box"] == [[0, 4], [0, 5], [0, 6]]


def test_integers_have_a_bound_of_whole_numbers() -> None:
    frames = list(np.arange(2 * 3 * 4 * 5).reshape(2, 3, 4, 5))
    found = plan_layers(frames, EncodeConfig(max_error=1.7, effort=1), 1.7, None)
    assert found.coder.coding.error == 1.5
