"""The choice between the plain quantiser and the trellis."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from fhash_codec.compact.choices.quantiser import (
    allows_trellis,
    is_smaller,
    off_trellis,
    on_trellis,
    plain_step,
    step_after,
)
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.integers import OFFSETS
from fhash_formats.transform.tile.settings import TileSettings

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


def outcome(size: int, psnr: float) -> Outcome:
    return Outcome(size=size, squares=10 ** (-psnr / 10) * 100, count=100, max_error=1.0)


def test_the_way_to_the_trellis_and_back() -> None:
    settings, coding = on_trellis(SETTINGS, Coding())
    assert settings.trellis
    assert settings.step < SETTINGS.step
    assert plain_step(settings) == pytest.approx(plain_step(SETTINGS))
    back, plain = off_trellis(settings, coding)
    assert replace(back, step=0.1) == SETTINGS
    assert plain == Coding()


def test_exact_values_and_the_finest_steps_stay_plain() -> None:
    assert allows_trellis(SETTINGS, GOAL, 2)
    assert not allows_trellis(SETTINGS, GOAL, 1)
    assert not allows_trellis(replace(SETTINGS, double=True), GOAL, 9)
    assert not allows_trellis(SETTINGS, Goal(error=0.0, data_range=1.0), 9)


def test_a_psnr_above_the_promise_makes_the_step_larger() -> None:
    assert step_after(SETTINGS, outcome(1000, 41.0), GOAL) > SETTINGS.step
    assert step_after(SETTINGS, outcome(1000, 40.0), GOAL) == pytest.approx(SETTINGS.step)
    exact = outcome(1000, math.inf)
    assert step_after(SETTINGS, exact, GOAL) == SETTINGS.step
    assert step_after(SETTINGS, outcome(9, 9.0), Goal(error=0.1, data_range=1.0)) == 0.1


def test_bytes_are_compared_at_the_same_quality() -> None:
    # One dB is worth a tenth of the bytes, by what was tried.
    tried = [outcome(1000, 40.0), outcome(1100, 41.0)]
    assert is_smaller(outcome(1000, 40.0), outcome(1010, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(990, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, GOAL)
    assert is_smaller(outcome(1000, 40.0), outcome(1150, 41.0), tried, GOAL)
    bound = Goal(error=0.1, data_range=1.0)
    assert is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, bound)
