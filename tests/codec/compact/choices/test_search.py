"""Searches for a step: secants, brackets, exchange rates and the cheapest number."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest

from fhash_codec.compact.choices.search import (
    SLOPE,
    Bracket,
    PsnrSearch,
    arithmetic_mean,
    cheapest,
    exchange,
    geometric_mean,
    secant,
    step_after_gain,
)


def test_a_single_point_takes_the_usual_slope() -> None:
    assert secant([(1.0, 40.0)], 42.0, 5.0) == pytest.approx(1.0 - 2.0 / 5.0)


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


def test_a_gain_moves_the_step_by_the_usual_slope() -> None:
    assert step_after_gain(0.5, 0.0) == 0.5
    assert step_after_gain(0.5, SLOPE) == pytest.approx(0.5 * math.e)
    assert secant([(math.log(0.5), 40.0)], 40.0 - 2.0, SLOPE) == pytest.approx(
        math.log(step_after_gain(0.5, 2.0))
    )


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


def test_a_prediction_inside_a_bracket_is_taken() -> None:
    bracket = Bracket(1.0, math.inf, middle=geometric_mean)
    assert bracket.inside(7.0) == 7.0
    assert bracket.narrowed(4.0, too_low=False).inside(7.0) == 2.0
    # A trial outside the bracket does not widen it.
    assert bracket.narrowed(0.5, too_low=True).low == 1.0


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


def test_numbers_that_cannot_be_run_are_avoided() -> None:
    def run(numbers: Sequence[int]) -> list[tuple[float, int] | None]:
        return [(float(number), number) if number > 2 else None for number in numbers]

    assert cheapest(run, 7, 12, strides=(2, 1)) == 3
