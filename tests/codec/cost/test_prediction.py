"""Predictions: what is probed, what an effort does, and the effort that fits into a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Coding, Outcome, Tile
from fhash_codec.compact.transform import choose_transform, count_trials
from fhash_codec.config import EncodeConfig
from fhash_codec.cost import prediction as time_budget
from fhash_codec.cost.prediction import (
    LOOKED_AT,
    MAX_EFFORT,
    MAX_EPOCHS,
    Prediction,
    Predictor,
    choose,
    predict,
)
from fhash_codec.cost.probe import PaperProbe, look_at, probe_rates, updates_of
from fhash_formats.series import ArraySeries, Series, StepsSeries
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile_format import TileSettings

SERIES = ArraySeries(np.random.default_rng(0).normal(size=(8, 8, 16, 16)).astype(np.float32))


def test_a_part_stands_for_the_whole_series() -> None:
    config = EncodeConfig(psnr=40.0, effort=1)
    with thread_pool() as workers:
        look = look_at(StepsSeries(SERIES, range(4)), 8, config, workers)
        assert look.share == 0.5
        assert look.shape == SERIES.shape
        assert look.task.blocks.shape == (4, 8, 16, 16)
        rates = probe_rates(look, config)
    assert abs(rates.outcome.psnr(look.task.goal.data_range) - 40) < 2
    assert min(rates.trial, rates.search, rates.final, rates.decode, rates.compare) > 0
    assert rates.fill == rates.predict == rates.fit == 0


def test_a_training_of_twice_the_updates_takes_twice_as_long() -> None:
    once, twice = (updates_of(updates, 0) for updates in (800, 1600))
    assert 800 < once < 1600
    assert 1.9 < twice / once < 2.1
    assert updates_of(800, 400_000) > once


PROBE = PaperProbe(
    stages={"scan": 1.0, "writing": 2.0},
    step=0.5,
    curve=0.25,
    samples=100_000,
    bricks=1000,
    bytes=1000,
)


@pytest.mark.parametrize(
    ("epochs", "points", "steps"), [(1, 1, 20), (30, 30, 600), (150, 75, 3000), (0, 50, 1000)]
)
def test_each_step_and_each_point_of_the_curve_is_counted(
    epochs: int, points: int, steps: int
) -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=epochs)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * steps + 0.25 * points


def test_a_batch_of_another_size_makes_other_steps() -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=10, batch=10_000)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * 100 + 0.25 * 10


@pytest.mark.parametrize("shape", [(4, 8, 24, 24), (1, 1, 40, 40), (3, 1, 1, 30), (2, 150, 8, 8)])
def test_trials_of_a_transform_are_those_that_the_encoder_makes(
    shape: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    series = ArraySeries(np.random.default_rng(0).normal(size=shape).astype(np.float32))
    trials, fitted = [], []
    run_all = Sample.run_all

    def counted(self: Sample, jobs: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        trials.append(len(jobs))
        return run_all(self, jobs)

    with ThreadPoolExecutor(1) as workers:
        config = EncodeConfig(psnr=40.0, tile="whole")
        look = look_at(series, shape[0], config, workers)
        sample = Sample(look.task.blocks, 1 << 20, workers)
        monkeypatch.setattr(Sample, "run_all", counted)
        map_all = Sample.map_all
        monkeypatch.setattr(
            Sample, "map_all", lambda self, work: (fitted.append(work), map_all(self, work))[1]
        )
        choose_transform(sample, look.attempt.settings, look.attempt.coding)
    assert isinstance(sample.tiles[0], Tile)
    assert (sum(trials), len(fitted)) == count_trials(shape, in_memory=True)


def waves(shape: tuple[int, int, int, int] = (6, 8, 24, 24)) -> npt.NDArray[np.float32]:
    t, z, y, x = np.ogrid[tuple(slice(n) for n in shape)]
    return (np.sin(0.3 * x + 0.2 * y + 0.1 * t) * np.cos(0.2 * z)).astype(np.float32)


def only(values: npt.NDArray[np.generic], **settings: object) -> Prediction:
    (prediction,) = predict(ArraySeries(values), [EncodeConfig.from_dict(settings)])
    return prediction


def test_each_setting_has_a_prediction() -> None:
    configs = [EncodeConfig(psnr=psnr, effort=effort) for psnr in (40.0, 60.0) for effort in (1, 2)]
    told: list[tuple[int, int]] = []
    predictions = predict(
        ArraySeries(waves()),
        configs,
        progress=lambda _, done, total, __: told.append((done, total)),
    )
    coarse, _, fine, _ = predictions
    assert coarse.bytes is not None
    assert fine.bytes is not None
    assert 0 < coarse.bytes < fine.bytes
    assert fine.psnr is not None
    assert fine.psnr >= 60
    assert told == [(n, 4) for n in range(5)]
    for prediction in predictions:
        assert prediction.seconds == pytest.approx(sum(prediction.stages.values()))
        assert prediction.basis


def test_only_what_an_effort_does_is_counted() -> None:
    values = waves() + np.random.default_rng(0).normal(0, 0.05, (6, 8, 24, 24)).astype(np.float32)
    stages = {effort: only(values, effort=effort, psnr=50.0).stages for effort in (1, 2, 5)}
    assert {"estimate", "coding", "measuring"} <= set(stages[1])
    assert "transform" not in stages[1]
    assert stages[2]["transform"] > 0
    assert "head trial" not in stages[2]
    assert stages[5]["head trial"] > 0
    without = only(values, effort=5, psnr=50.0, without=["transform", "head"]).stages
    assert without["bases"] == 0 < stages[5]["bases"]
    assert "head trial" not in without


def test_a_bound_counts_the_predictor_and_exact_labels_themselves() -> None:
    bound = only(waves(), effort=2, max_error=1e-3)
    assert bound.stages["predictor"] > 0
    assert bound.psnr is not None
    labels = np.repeat(np.arange(24 * 24).reshape(24, 24) // 96, 48).reshape(6, 8, 24, 24)
    exact = only(labels.astype(np.uint8), max_error=0.0)
    assert exact.psnr is None
    assert exact.stages["labels"] > 0


def test_a_coreset_with_a_mask_counts_its_filling() -> None:
    filled = only(waves(), effort=2, psnr=45.0, features=["interval:0.2:2"])
    assert filled.stages["filling"] > 0
    assert "filling" not in only(waves(), effort=2, psnr=45.0).stages


class _Long(Series):
    """A series of many large frames, which counts those that are read."""

    def __init__(self) -> None:
        like = ArraySeries(np.zeros((4096, 1, 1, 1), np.float32))
        self.source, self.name, self.units, self.attributes = "long", "v", "", {}
        self.dtype, self.shape = np.dtype(np.float32), (4096, 4, 64, 64)
        self.coords = {
            **ArraySeries(np.zeros((1, 4, 64, 64), np.float32)).coords,
            "t": like.coords["t"],
        }
        self.seen: set[int] = set()

    def read(self, step: int) -> npt.NDArray[np.float32]:
        self.seen.add(step)
        z, y, x = np.ogrid[:4, :64, :64]
        return np.asarray(np.sin(0.1 * (x + y + z) + 0.01 * step), dtype=np.float32)


def test_of_a_long_series_a_part_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fhash_codec.cost.prediction.LOOKED_AT", 1 << 18)
    assert LOOKED_AT < 4096 * 4 * 64 * 64
    series = _Long()
    with thread_pool() as workers:
        prediction = Predictor(series, workers).predict(EncodeConfig(effort=1, psnr=40.0))
    assert series.seen == {step for first in (1022, 3066) for step in range(first, first + 8)}
    assert prediction.bytes is not None
    assert "0% of the steps" in prediction.basis


SERIES_PREDICTION = ArraySeries(np.zeros((1, 2, 2, 2), np.float32))
PAPER = EncodeConfig(profile="paper")


class _Known:
    """A predictor: the square of the effort, or a second an epoch and 100 besides."""

    def predict(self, config: EncodeConfig) -> Prediction:
        paper = config.profile == "paper"
        seconds = 100.0 + config.epochs if paper else 10.0 * config.effort**2
        return Prediction(seconds=seconds, bytes=1234, psnr=50.0, basis="known")


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def predictor(_: Any) -> Iterator[_Known]:
        yield _Known()

    monkeypatch.setattr(time_budget, "predictor", predictor)


@pytest.mark.parametrize(
    ("seconds", "effort", "fits"),
    [(5, 1, False), (20, 1, True), (60, 2, True), (240, 4, True), (5000, MAX_EFFORT, True)],
)
@pytest.mark.usefixtures("known")
def test_the_highest_effort_that_fits_is_chosen(seconds: float, effort: int, fits: bool) -> None:
    choice = choose(SERIES_PREDICTION, EncodeConfig(psnr=44.0), seconds)
    assert choice.config == EncodeConfig(psnr=44.0, effort=effort)
    assert (choice.fits, choice.option) == (fits, f"--effort {effort}")
    assert f"--effort {effort}" in choice.why
    assert "\n" not in choice.why
    if effort < MAX_EFFORT and fits:
        assert f"--effort {effort + 1} would take" in choice.why


@pytest.mark.usefixtures("known")
def test_an_effort_that_is_given_is_the_most() -> None:
    assert choose(SERIES_PREDICTION, EncodeConfig(effort=3), 5000, capped=True).config.effort == 3
    assert choose(SERIES_PREDICTION, EncodeConfig(effort=3), 60, capped=True).config.effort == 2
    assert choose(SERIES_PREDICTION, EncodeConfig(effort=3), 5000).config.effort == MAX_EFFORT


@pytest.mark.parametrize(
    ("seconds", "epochs", "fits"), [(10, 1, False), (230, 99, True), (10_000, MAX_EPOCHS, True)]
)
@pytest.mark.usefixtures("known")
def test_the_most_epochs_that_fit_are_chosen(seconds: float, epochs: int, fits: bool) -> None:
    choice = choose(SERIES_PREDICTION, PAPER, seconds)
    assert (choice.config.epochs, choice.fits) == (epochs, fits)
    assert choice.option == f"--epochs {epochs}"


@pytest.mark.usefixtures("known")
def test_epochs_that_are_given_are_the_most() -> None:
    config = EncodeConfig(profile="paper", epochs=30)
    assert choose(SERIES_PREDICTION, config, 10_000, capped=True).config.epochs == 30


@pytest.mark.usefixtures("known")
def test_a_budget_that_cannot_be_kept_is_told() -> None:
    choice = choose(SERIES_PREDICTION, EncodeConfig(), 5)
    assert "time budget of 5 s may not be kept: even --effort 1" in choice.why
    told = choice.to_dict()
    assert (told["fits"], told["chosen"], told["predicted"]["bytes"]) == (False, "--effort 1", 1234)
