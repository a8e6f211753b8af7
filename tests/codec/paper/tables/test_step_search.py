"""The search for a quantiser step: it ends in its window, whatever course the error takes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from fhash_codec.paper.tables.step_search import StepSearch, Window

TRIALS = 12


def searched(
    window: Window, error: Callable[[float], float], step: float, min_step: float = 1e-12
) -> tuple[StepSearch, int]:
    search = StepSearch(window, step, min_step)
    trials = 0
    while not search.done and trials < TRIALS:
        search.add(error(search.step))
        trials += 1
    return search, trials


@pytest.mark.parametrize("start", [1e-6, 1e-2, 1.0, 1e5])
@pytest.mark.parametrize("power", [1.0, 1.7, 2.0, 3.0])
@pytest.mark.parametrize("room", [0.1, 1.0, 20.0])
def test_the_search_ends_in_the_window(start, power, room) -> None:
    exact = 1e-5
    window = Window.of(exact, exact * 10 ** (room / 10), 0.05)
    search, trials = searched(window, lambda step: exact + 1e-4 * step**power, start)
    assert search.done
    assert search.best is not None
    error = exact + 1e-4 * search.best**power
    assert window.allowed * 10 ** (-0.05 / 10) <= error <= window.allowed
    assert trials <= TRIALS


def test_a_course_that_is_no_power_takes_a_few_more_trials() -> None:
    window = Window.of(1e-6, 3e-5, 0.05)
    # The error bends twice, as that of tables does in which whole levels become zero.
    search, _ = searched(
        window,
        lambda step: 1e-6 + 2e-5 * math.tanh(step) ** 2 + 1e-5 * max(step - 2, 0.0) ** 3,
        1e-3,
    )
    assert search.done
    assert search.best is not None
    assert search.best > 2


def test_a_jump_over_the_window_keeps_the_allowed_side() -> None:
    window = Window.of(1e-6, 1e-5, 0.05)
    search, _ = searched(window, lambda step: 1e-6 + (1e-6 if step < 3 else 1e-3), 1.0)
    assert search.best is not None
    assert 2.0 < search.best < 3.0


def test_nothing_below_the_smallest_step_is_tried() -> None:
    window = Window.of(1e-6, 1e-5, 0.05)
    search, trials = searched(window, lambda step: 1.0, 1.0, min_step=0.5)
    assert search.best is None
    assert search.done
    assert search.step == 0.5
    assert trials < TRIALS


@pytest.mark.parametrize(("exact", "width"), [(0.0, 0.05), (9.99e-6, 0.00217), (1e-6, 0.05)])
def test_a_window_leaves_room_for_what_coding_adds(exact, width) -> None:
    window = Window.of(exact, 1e-5, 0.05)
    assert exact < window.least < window.allowed == 1e-5
    assert 10 * math.log10(window.allowed / window.least) == pytest.approx(width, rel=0.01)
    assert 0 < window.aim < window.allowed - exact
