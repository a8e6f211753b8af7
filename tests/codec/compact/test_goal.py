"""The promise: one of the settings, by default a PSNR."""

from __future__ import annotations

import pytest

from fhash_codec import EncodeConfig
from fhash_codec.compact.goal import DEFAULT_PSNR, Goal, goal_of, promise
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.measure.bulk import MIN_SHARE
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError


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


RANGE = ValueRange(low=0.0, high=100.0)


def test_the_default_promises_a_wide_bulk_too() -> None:
    wide = ValueRange(0.0, 100.0 * MIN_SHARE)
    assert promise(EncodeConfig(), RANGE, wide) == {"psnr": 50.0, "psnr_bulk": 40.0}
    narrow = ValueRange(0.0, 99.9 * MIN_SHARE)
    assert promise(EncodeConfig(), RANGE, narrow) == {"psnr": 50.0}
    assert promise(EncodeConfig(), RANGE, None) == {"psnr": 50.0}
    assert promise(EncodeConfig(psnr_bulk=30.0), RANGE, narrow) == {"psnr_bulk": 30.0}
    # What is promised explicitly is all that is promised.
    for options in ({"psnr": 50.0}, {"max_error": 1.0}, {"ratio": 3.0}):
        assert promise(EncodeConfig(**options), RANGE, wide) == options


def test_a_promised_bulk_that_is_not_there_is_refused_unless_all_is_constant() -> None:
    config = EncodeConfig(psnr_bulk=40.0)
    with pytest.raises(InputError, match="psnr-bulk has nothing to measure"):
        goal_of(config, RANGE, 1000, 0, None)
    assert goal_of(config, ValueRange(1.0, 1.0), 1000, 0, None).data_range == 0


@pytest.mark.parametrize("bulk_rmse", [0.09, 0.11])
@pytest.mark.parametrize("rmse", [0.3, 0.33])
def test_both_promises_are_kept_where_the_psnr_of_an_outcome_is(
    rmse: float, bulk_rmse: float
) -> None:
    """Allowed are 100 / 10^2.5 = 0.316 of all values and 10 / 10^2 = 0.1 of the bulk."""
    goal = goal_of(EncodeConfig(), RANGE, 1000, 0, ValueRange(20.0, 30.0))
    assert goal.bulk is not None
    outcome = Outcome(
        size=1,
        squares=100 * rmse**2,
        count=100,
        max_error=1.0,
        bulk_squares=50 * bulk_rmse**2 * goal.bulk.weight,
        bulk_count=50,
    )
    assert goal.psnr == 50.0
    assert (outcome.psnr(100.0) >= 50.0) == (rmse < 0.316 and bulk_rmse < 0.1)
    assert goal.expected_error == pytest.approx(0.1)


def test_a_bulk_alone_stands_for_all() -> None:
    goal = goal_of(EncodeConfig(psnr_bulk=40.0), RANGE, 1000, 0, ValueRange(20.0, 30.0))
    assert goal.psnr == goal.even_psnr == pytest.approx(60.0)
    assert goal.bulk is not None
    assert goal.bulk.alone


def test_only_a_bound_changes_the_coding() -> None:
    coding = Coding(rounds=2)
    assert Goal(psnr=50.0, data_range=1.0).bounded(coding) is coding
    assert Goal(error=0.5, data_range=1.0).bounded(coding) == Coding(rounds=2, error=0.5)


def test_the_expected_error_of_a_psnr_is_that_of_its_definition() -> None:
    assert Goal(psnr=40.0, data_range=5.0).expected_error == pytest.approx(0.05)
