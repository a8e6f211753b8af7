"""The promise: one of the settings, by default a PSNR."""

from __future__ import annotations

import pytest

from fhash_codec import EncodeConfig
from fhash_codec.compact.goal import DEFAULT_PSNR, Goal, goal_of, promise
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.measure.value_range import ValueRange


@pytest.mark.parametrize(
    ("options", "name", "expected"),
    [
        ({}, "psnr", DEFAULT_PSNR),
        ({"psnr": 40.0}, "psnr", 40.0),
        ({"max_error": 0.25}, "error", 0.25),
        ({"max_error_rel": 0.01}, "error", 0.04),
        ({"ratio": 8.0}, "size", 125.0),
    ],
    ids=str,
)
def test_a_goal_is_one_promise_in_units_of_the_data(
    options: dict[str, float], name: str, expected: float
) -> None:
    config = EncodeConfig(**options)
    goal = goal_of(config, ValueRange(low=-1.0, high=3.0), 1000, 50)
    assert goal.data_range == 4.0
    goals = {"psnr": goal.psnr, "error": goal.error, "size": goal.size}
    assert {key: value for key, value in goals.items() if value is not None} == {name: expected}
    assert promise(config) == (options or {"psnr": DEFAULT_PSNR})


def test_only_a_bound_changes_the_coding() -> None:
    coding = Coding(rounds=2)
    assert Goal(psnr=50.0, data_range=1.0).bounded(coding) is coding
    assert Goal(error=0.5, data_range=1.0).bounded(coding) == Coding(rounds=2, error=0.5)


def test_the_expected_error_of_a_psnr_is_that_of_its_definition() -> None:
    assert Goal(psnr=40.0, data_range=5.0).expected_error == pytest.approx(0.05)
