"""The choice of effort or epochs by a budget, with predictions that are known."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import time_budget
from fhash_codec.cost.prediction import Prediction
from fhash_codec.cost.time_budget import MAX_EFFORT, MAX_EPOCHS, choose
from fhash_formats.series import ArraySeries

SERIES = ArraySeries(np.zeros((1, 2, 2, 2), np.float32))
PAPER = EncodeConfig(profile="paper")


class _Known:
    """A predictor: the square of the effort, or a second an epoch and 100 besides."""

    def predict(self, config: EncodeConfig) -> Prediction:
        paper = config.profile == "paper"
        seconds = 100.0 + config.epochs if paper else 10.0 * config.effort**2
        return Prediction(seconds=seconds, bytes=1234, psnr=50.0, basis="known")


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def predictor(_: Any) -> Iterator[_Known]:
        yield _Known()

    monkeypatch.setattr(time_budget, "predictor", predictor)


@pytest.mark.parametrize(
    ("seconds", "effort", "fits"),
    [(5, 1, False), (20, 1, True), (60, 2, True), (240, 4, True), (5000, MAX_EFFORT, True)],
)
def test_the_highest_effort_that_fits_is_chosen(seconds: float, effort: int, fits: bool) -> None:
    choice = choose(SERIES, EncodeConfig(psnr=44.0), seconds)
    assert choice.config == EncodeConfig(psnr=44.0, effort=effort)
    assert (choice.fits, choice.option) == (fits, f"--effort {effort}")
    assert f"--effort {effort}" in choice.why
    assert "\n" not in choice.why
    if effort < MAX_EFFORT and fits:
        assert f"--effort {effort + 1} would take" in choice.why


def test_an_effort_that_is_given_is_the_most() -> None:
    assert choose(SERIES, EncodeConfig(effort=3), 5000, capped=True).config.effort == 3
    assert choose(SERIES, EncodeConfig(effort=3), 60, capped=True).config.effort == 2
    assert choose(SERIES, EncodeConfig(effort=3), 5000).config.effort == MAX_EFFORT


@pytest.mark.parametrize(
    ("seconds", "epochs", "fits"), [(10, 1, False), (230, 99, True), (10_000, MAX_EPOCHS, True)]
)
def test_the_most_epochs_that_fit_are_chosen(seconds: float, epochs: int, fits: bool) -> None:
    choice = choose(SERIES, PAPER, seconds)
    assert (choice.config.epochs, choice.fits) == (epochs, fits)
    assert choice.option == f"--epochs {epochs}"


def test_epochs_that_are_given_are_the_most() -> None:
    config = EncodeConfig(profile="paper", epochs=30)
    assert choose(SERIES, config, 10_000, capped=True).config.epochs == 30


def test_a_budget_that_cannot_be_kept_is_told() -> None:
    choice = choose(SERIES, EncodeConfig(), 5)
    assert "time budget of 5 s may not be kept: even --effort 1" in choice.why
    told = choice.to_dict()
    assert (told["fits"], told["chosen"], told["predicted"]["bytes"]) == (False, "--effort 1", 1234)
