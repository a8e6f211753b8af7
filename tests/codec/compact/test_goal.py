"""Promises, and the searches for the step that keeps one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec import EncodeConfig
from fhash_codec.compact.goal import (
    DECIDED,
    FAR_BELOW,
    Bracket,
    Goal,
    PsnrSearch,
    arithmetic_mean,
    cheapest,
    decided_by_bulk,
    exchange,
    geometric_mean,
    goal_of,
    missed_promise,
    promise,
    remarks,
    secant,
)
from fhash_codec.compact.step import is_smaller, off_trellis, on_trellis, plain_step, with_step
from fhash_codec.compact.tiles import Coding, Outcome
from fhash_codec.compact.transform import usual_transform
from fhash_codec.measure.errors import MIN_SHARE
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError
from fhash_formats.transform.encoding import OFFSETS, encode_tile
from fhash_formats.transform.encoding import Coding as Coding_step
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings


def test_two_points_take_their_own_slope_within_reason() -> None:
    assert secant([(0.0, 50.0), (1.0, 44.0)], 41.0, 5.0) == pytest.approx(1.5)
    assert secant([(0.0, 44.1), (1.0, 44.0)], 42.0, 5.0) == pytest.approx(1.0 + 2.0 / 2.0)
    assert secant([(0.0, 90.0), (1.0, 44.0)], 32.0, 5.0) == pytest.approx(2.0)
    assert secant([(1.0, 44.0), (1.0, 44.0)], 42.0, 5.0) == pytest.approx(1.0 + 2.0 / 5.0)


def test_a_psnr_of_uniform_rounding_is_found_in_a_few_steps() -> None:
    """The PSNR of step^2 / 12 falls by 20 / ln 10 dB for each factor of e."""
    search, step = PsnrSearch(1e-9, 1e9), 1.0
    for _ in range(3):
        search.add(step, -10 * math.log10(step**2 / 12))
        step = search.step_for(60.0)
    assert -10 * math.log10(step**2 / 12) == pytest.approx(60.0, abs=1e-6)
    search.add(step, -1e9)
    assert search.step_for(60.0) == pytest.approx(1e-9)


@pytest.mark.parametrize("mean", [arithmetic_mean, geometric_mean])
@pytest.mark.parametrize("target", [1.5, 40.0, 99.0])
def test_bisection_in_a_bracket_converges(
    mean: Callable[[float, float], float], target: float
) -> None:
    bracket = Bracket(1.0, 100.0, middle=mean)
    for _ in range(60):
        number = bracket.inside(math.inf)
        bracket = bracket.narrowed(number, too_low=number < target)
    assert bracket.low == pytest.approx(target, rel=1e-9)
    assert bracket.high == pytest.approx(target, rel=1e-9)


def test_an_exchange_rate_is_that_of_the_last_points_some_way_apart() -> None:
    points = [(10.0, 40.0), (11.0, 42.3), (11.0, 42.31)]
    assert exchange(points, 4.5) == pytest.approx(2.3)
    assert exchange(points[:1], 4.5) == exchange([], 4.5) == 4.5
    # More bytes and less quality: no rate.
    assert exchange([(10.0, 40.0), (11.0, 39.0)], 4.5) == 4.5


@pytest.mark.parametrize("start", [0, 3, 9, 12])
@pytest.mark.parametrize("lowest", [0, 5, 7, 12])
def test_the_cheapest_is_found_from_everywhere(start: int, lowest: int) -> None:
    asked: list[int] = []

    def run(numbers: Sequence[int]) -> list[tuple[float, str]]:
        asked.extend(numbers)
        return [(float((number - lowest) ** 2), f"at {number}") for number in numbers]

    assert cheapest(run, start, 12, strides=(2, 1)) == f"at {lowest}"
    assert len(asked) == len(set(asked))
    assert all(0 <= number <= 12 for number in asked)


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


def figures(**others):
    """Figures of a file; by default its promise is kept."""
    psnr_bulk = others.pop("psnr_bulk", 42.0)
    bulk = None if psnr_bulk is None else {"psnr": psnr_bulk, "rmse": 0.1, "range": [1.0, 2.0]}
    usual = {"psnr": 50.0, "rmse": 0.1, "max_abs_error": 0.5, "ratio": 30.0, "data_range": 10.0}
    return {**usual, "promised": {}, "quality": {"bulk": bulk}, "psnr_bulk": psnr_bulk, **others}


@pytest.mark.parametrize(
    ("config", "kept", "missed", "text"),
    [
        ({"max_error": 0.5}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"max_error_rel": 0.05}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"psnr": 50.0}, {}, {"psnr": 49.99}, "49.99 dB over the coreset, 50 dB were asked for"),
        ({"psnr": 50.0}, {"psnr": None, "rmse": 0.0}, {"psnr": None}, "an unknown PSNR"),
        ({"psnr_bulk": 42.0}, {}, {"psnr_bulk": 41.99}, "41.99 dB over the bulk"),
        (
            {"psnr_bulk": 42.0},
            {"psnr_bulk": None, "rmse": 0.0},
            {"psnr_bulk": None},
            "all the same",
        ),
        ({"ratio": 30.0}, {}, {"ratio": 29.99}, "29.99 times smaller than the data"),
    ],
    ids=str,
)
def test_a_promise_is_missed_on_one_side_of_its_number(config, kept, missed, text) -> None:
    promised, settings = dict(config), EncodeConfig(**config)
    assert missed_promise(settings, figures(promised=promised, **kept)) is None
    assert text in (missed_promise(settings, figures(promised=promised, **missed)) or "")


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "remarked"),
    [
        ({"psnr": 50.0}, 50.0, 50.0 - FAR_BELOW, False),
        ({"psnr": 50.0}, 50.0, 49.9 - FAR_BELOW, True),
        ({"psnr": 80.0}, 80.0, 40.0, False),
        ({"psnr": 80.0}, 80.0, 39.9, True),
        ({"max_error": 1.0}, 50.0, 20.0, True),
        ({"psnr": 50.0, "psnr_bulk": 20.0}, 50.0, 20.0, False),
        ({}, 50.0, 20.0, True),
        ({}, 50.0, None, False),
        ({"psnr": 50.0}, None, 20.0, False),
    ],
)
def test_a_bulk_far_below_the_whole_is_remarked(config, psnr, psnr_bulk, remarked) -> None:
    lines = list(remarks(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk)))
    assert bool(lines) == remarked
    assert all("--psnr-bulk 40" in line and "from 1 to 2" in line for line in lines)


def test_the_remark_names_the_promise_that_the_option_stands_beside_or_replaces() -> None:
    def line(config):
        return "".join(remarks(EncodeConfig(**config), figures(psnr_bulk=10.0)))

    assert line({"psnr": 50.0}).endswith("--psnr-bulk 40 beside --psnr keeps them")
    assert line({"max_error_rel": 0.1}).endswith(
        "--psnr-bulk 40 instead of --max-error-rel keeps them"
    )
    assert line({}).endswith("whole; --psnr-bulk 40 keeps them")


@pytest.mark.parametrize(("ratio", "count"), [(31.5, 0), (31.6, 1)])
@pytest.mark.parametrize(("rmse", "why"), [(0.0, "exact already"), (0.1, "no step")])
def test_a_file_much_smaller_than_asked_for_is_remarked(ratio, count, rmse, why) -> None:
    lines = list(remarks(EncodeConfig(ratio=30.0), figures(ratio=ratio, rmse=rmse)))
    assert len(lines) == count
    assert all(why in line and "30 times were asked for" in line for line in lines)


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "decided"),
    [
        ({}, 54.5, 40.0, True),
        ({}, 50.1, 40.0, False),
        ({}, 54.5, 40.1 + DECIDED, False),
        ({"psnr": 45.0, "psnr_bulk": 41.0}, 49.5, 41.0, True),
        ({"psnr": 45.0}, 49.5, 40.0, False),
        ({"psnr_bulk": 41.0}, 49.5, 41.0, False),
        ({"max_error": 1.0}, 54.5, 40.0, False),
        ({}, 54.5, None, False),
    ],
)
def test_a_bulk_that_decided_says_what_it_took(config, psnr, psnr_bulk, decided) -> None:
    line = decided_by_bulk(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk))
    assert (line is not None) == decided
    if line is not None:
        asked = config.get("psnr", 50)
        assert f"--psnr {asked:g} alone leaves it out" in line
        assert "about 50 % of the file" in line.replace("50%", "50 %")
        assert "from 1 to 2" in line


def outcome(size: int, psnr: float) -> Outcome:
    return Outcome(size=size, squares=10 ** (-psnr / 10) * 100, count=100, max_error=1.0)


NONE = AxisTransform(kind="none")
SETTINGS = TileSettings(
    transform=TransformSpec(axes=(NONE,) * 4),
    step=0.1,
    center=0.0,
    low=0.0,
    high=1.0,
    offsets=OFFSETS,
)
GOAL = Goal(psnr=40.0, data_range=1.0)


def test_the_way_to_the_trellis_and_back() -> None:
    settings, coding = on_trellis(SETTINGS, Coding())
    assert settings.trellis
    assert settings.step < SETTINGS.step
    assert plain_step(settings) == pytest.approx(plain_step(SETTINGS))
    back, plain = off_trellis(settings, coding)
    assert replace(back, step=0.1) == SETTINGS
    assert plain == Coding()


def test_bytes_are_compared_at_the_same_quality() -> None:
    # One dB is worth a tenth of the bytes, by what was tried.
    tried = [outcome(1000, 40.0), outcome(1100, 41.0)]
    assert is_smaller(outcome(1000, 40.0), outcome(1010, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(990, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, GOAL)
    assert is_smaller(outcome(1000, 40.0), outcome(1150, 41.0), tried, GOAL)
    bound = Goal(error=0.1, data_range=1.0)
    assert is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, bound)


SHAPE = (2, 16, 32, 32)


@pytest.mark.parametrize(("rounding", "exact"), [(2.0**-24, False), (0.0, True)])
def test_rounding_to_the_type_of_the_source_stores_no_tile_exactly(
    rounding: float, exact: bool
) -> None:
    """A float32 near 1000 is 3e-5 off at most: a residual must leave room for that."""
    source = (1000 + np.random.default_rng(0).normal(size=SHAPE).cumsum(axis=3)).astype(np.float32)
    low, high, error = float(source.min()), float(source.max()), 0.002
    begun = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=1000.0, low=low, high=high
    )
    coded = encode_tile(
        source,
        with_step(begun, 4 * error, Goal(error=error, data_range=high - low), rounding),
        Coding_step(error=error),
    )
    assert np.abs(coded.decoded.astype(np.float64) - source).max() <= error
    assert np.array_equal(coded.decoded, source) == exact


@pytest.mark.parametrize(("step", "double"), [(1e-3, False), (1e-7, True), (0.0, True)])
def test_a_fine_step_is_computed_in_float64_and_never_too_fine(step: float, double: bool) -> None:
    settings = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=0.0, low=-1.0, high=1.0
    )
    chosen = with_step(settings, step, Goal(psnr=50.0, data_range=2.0))
    assert chosen.double == double
    assert chosen.quantum == 0.0
    assert chosen.step >= step
    assert 2.0 / chosen.step < 2.0**30
