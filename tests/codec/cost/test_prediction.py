"""Predictions: what is probed, what an effort does, and the effort that fits into a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.comparison import EncodeReport
from fhash_codec.config import EncodeConfig
from fhash_codec.cost import prediction as time_budget
from fhash_codec.cost import probe as probes
from fhash_codec.cost.prediction import (
    MAX_EFFORT,
    MAX_EPOCHS,
    Prediction,
    Predictor,
    choose,
)
from fhash_codec.cost.probe import (
    CompactProbe,
    PaperProbe,
    part_of,
    promise_of_part,
)
from fhash_codec.encoding import encode
from fhash_codec.paper.train import usual_batches
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Series

SERIES = ArraySeries(np.random.default_rng(0).normal(size=(8, 8, 16, 16)).astype(np.float32))


PART = CompactProbe(
    vertices=1 << 20,
    stages={"opening": 1.0, "plan": 1.0, "predictor": 1.0, "coding": 1.0},
    fixed_bytes=100,
    growing_bytes=1000,
    psnr=50.0,
)


@pytest.mark.parametrize(
    ("larger", "plan", "predictor"),
    [(1, 1.0, 1.0), (2, 2**0.5, 2**0.5), (12, 2**0.5, 12**0.5), (120, 2**0.5, 10 * 12**0.5)],
)
def test_each_stage_grows_by_its_work(larger: int, plan: float, predictor: float) -> None:
    stages = PART.stage_seconds(larger << 20)
    assert (stages["opening"], stages["coding"]) == (1.0, larger)
    assert (stages["plan"], stages["predictor"]) == pytest.approx((plan, predictor))
    assert PART.bytes(larger << 20) == 100 + 1000 * larger


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
    config = EncodeConfig(preset="published", tables="float16", epochs=epochs)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * steps + 0.25 * points


def test_a_batch_of_another_size_makes_other_steps() -> None:
    config = EncodeConfig(preset="published", tables="float16", epochs=10, batch=10_000)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * 100 + 0.25 * 10


def test_a_share_of_a_series_has_its_samples_and_steps_of_their_size() -> None:
    half = PROBE.of_share(0.5)
    assert (half.samples, half.bricks, half.bytes) == (50_000, 500, 500)
    assert half.stages["scan"] == 0.5
    before, after = (usual_batches(each.samples, each.bricks) for each in (PROBE, half))
    per_sample = [each.step * n / each.samples for each, n in ((PROBE, before), (half, after))]
    assert per_sample[0] == pytest.approx(per_sample[1])
    assert PROBE.of_share(1.0) == PROBE


def waves(shape: tuple[int, int, int, int] = (12, 4, 16, 16)) -> npt.NDArray[np.float32]:
    t, z, y, x = np.ogrid[tuple(slice(n) for n in shape)]
    return (np.sin(0.3 * x + 0.2 * y + 0.1 * t) * np.cos(0.2 * z)).astype(np.float32)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of a series is encoded where it can be, and not the whole."""
    monkeypatch.setattr(time_budget, "WHOLE_SECONDS", 0.0)


def only(values: npt.NDArray[np.generic], **settings: object) -> Prediction:
    return Predictor(ArraySeries(values)).predict(EncodeConfig.from_dict(settings))


def made(values: npt.NDArray[np.generic], folder: Path, **settings: object) -> EncodeReport:
    return encode(ArraySeries(values), folder / "made.fhz", EncodeConfig.from_dict(settings))


def encoded_by(cost: Callable[[int, int], Mapping[str, float]]) -> Callable[..., Any]:
    """An encoder that counts its work as seconds: by vertices and effort, of each stage."""

    def encode(series: Series, path: Path, config: EncodeConfig) -> dict[str, Any]:
        vertices = prod(series.shape)
        stages = [
            {"stage": name, "seconds": seconds, "times": 1}
            for name, seconds in cost(vertices, config.effort).items()
        ]
        size = vertices // 50
        return {
            "stages": stages,
            "bytes": size + 500,
            "split": {"field": size, "model": 100, "index": 400},
            "psnr": 50.0,
            "rmse": 0.1,
        }

    return encode


def counted(vertices: int, effort: int) -> dict[str, float]:
    """Work of an encoder, in seconds, that plans up to 2 million vertices and codes all."""
    planned, searched = min(vertices, 2_000_000), min(vertices, 12_000_000)
    stages = {"scan": 1e-8 * vertices, "plan": effort * (0.05 + 2e-7 * planned)}
    if effort >= 5:
        stages["head"] = 0.5 + 2e-7 * searched
    return {**stages, "coding": 1e-7 * effort * vertices}


@pytest.mark.parametrize("effort", [1, 5])
@pytest.mark.parametrize("shape", [(16, 8, 48, 48), (64, 16, 64, 64), (400, 16, 64, 64)])
def test_seconds_are_those_of_the_whole_within_a_factor(
    shape: tuple[int, int, int, int], effort: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probes, "reported", encoded_by(counted))
    series = _Long(shape)
    prediction = Predictor(series).predict(EncodeConfig(effort=effort))
    true = sum(counted(prod(shape), effort).values())
    assert true / 2 < prediction.seconds < 2 * true
    assert prediction.seconds == pytest.approx(sum(prediction.stages.values()))
    assert prediction.bytes == pytest.approx(prod(shape) / 50 + 500, rel=0.01)


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize("effort", [1, 3])
def test_bytes_are_those_of_the_whole_within_30_percent(effort: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (16, 8, 32, 32)).astype(np.float32)
    values = waves((16, 8, 32, 32)) + noise
    prediction = only(values, psnr=45.0, effort=effort)
    report = made(values, tmp_path, psnr=45.0, effort=effort)
    assert prediction.bytes == pytest.approx(report["bytes"], rel=0.3)
    assert prediction.psnr == pytest.approx(45.0, abs=0.5)
    assert prediction.basis.startswith("an encoding of 4 of 16 steps, in ")


PROMISES: list[dict[str, object]] = [
    {},
    {"psnr": 40.0, "psnr_bulk": 30.0},
    {"psnr_bulk": 30.0},
    {"max_error": 1e-2},
    {"max_error_rel": 1e-3},
    {"ratio": 4.0},
    {"psnr": 45.0, "features": ["interval:0.2:2"]},
    {"psnr": 45.0, "effort": 5},
]


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize("settings", PROMISES)
def test_every_promise_has_a_prediction(settings: dict[str, object], tmp_path: Path) -> None:
    smooth = np.tile(waves(), (1, 2, 1, 1))
    values = smooth + np.random.default_rng(0).normal(0, 0.05, smooth.shape).astype(np.float32)
    prediction = only(values, **{"effort": 2, **settings})
    report = made(values, tmp_path, **{"effort": 2, **settings})
    assert prediction.seconds > 0
    assert prediction.bytes is not None
    assert report["bytes"] / 2 < prediction.bytes < 2 * report["bytes"]
    # of so few bytes, the header takes a larger share in the part
    assert prediction.psnr == pytest.approx(report["psnr"], abs=20 if "ratio" in settings else 3)


@pytest.mark.usefixtures("parts")
def test_exact_labels_have_no_psnr() -> None:
    labels = np.repeat(np.arange(24 * 24).reshape(24, 24) // 96, 48).reshape(6, 8, 24, 24)
    exact = only(labels.astype(np.uint8), max_error=0.0)
    assert exact.psnr is None
    assert exact.stages["labels"] > 0


@pytest.mark.usefixtures("parts")
def test_a_part_may_err_as_much_as_the_whole() -> None:
    """The range of the middle steps is a tenth of that of the series."""
    values = waves()
    values[0] *= 10
    series = ArraySeries(values)
    part = part_of(series, 0.25)
    for asked, moved in (
        (EncodeConfig(psnr=60.0), EncodeConfig(psnr=40.0)),
        (EncodeConfig(max_error_rel=1e-3), EncodeConfig(max_error_rel=1e-2)),
        (EncodeConfig(max_error=1e-3), EncodeConfig(max_error=1e-3)),
        (EncodeConfig(), EncodeConfig()),
    ):
        found = promise_of_part(asked, part, series)
        for name in ("psnr", "max_error", "max_error_rel"):
            expected = getattr(moved, name)
            assert getattr(found, name) == (expected and pytest.approx(expected, rel=0.1))
        assert promise_of_part(asked, series, series) == asked


@pytest.mark.usefixtures("parts")
def test_what_no_part_has_is_predicted_by_the_whole() -> None:
    values = waves()
    values[0, 0, 0, 0] = 9.0
    prediction = only(values, effort=1, psnr=30.0, features=["interval:5:10"])
    assert prediction.basis.startswith("an encoding of the whole series")
    with pytest.raises(InputError, match="interval:50:60"):
        only(values, effort=1, features=["interval:50:60"])


def test_a_series_that_takes_no_time_is_encoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_budget, "WHOLE_SECONDS", 1e9)
    prediction = only(waves(), effort=2, psnr=40.0)
    report = made(waves(), tmp_path, effort=2, psnr=40.0)
    # the header has timings in it
    assert prediction.bytes == pytest.approx(report["bytes"], abs=100)
    assert prediction.basis.startswith("an encoding of the whole series")


@pytest.mark.usefixtures("parts")
def test_each_setting_is_encoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, asked = encoded_by(counted), []

    def noted(series: Series, path: Path, config: EncodeConfig) -> dict[str, Any]:
        asked.append(config.effort)
        result: dict[str, Any] = encoder(series, path, config)
        return result

    monkeypatch.setattr(probes, "reported", noted)
    one = Predictor(ArraySeries(waves()))
    for effort in (1, 3, 1, 3):
        one.predict(EncodeConfig(effort=effort))
    assert asked == [1, 3]


class _Long(Series):
    """A series of many frames, which counts those that are read."""

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        steps, *space = shape
        like = ArraySeries(np.zeros((steps, 1, 1, 1), np.float32))
        self.source, self.name, self.units, self.attributes = "long", "v", "", {}
        self.dtype, self.shape = np.dtype(np.float32), shape
        self.coords = {
            **ArraySeries(np.zeros((1, *space), np.float32)).coords,
            "t": like.coords["t"],
        }
        self.seen: set[int] = set()

    def read(self, step: int) -> npt.NDArray[np.float32]:
        self.seen.add(step)
        z, y, x = np.ogrid[tuple(slice(n) for n in self.shape[1:])]
        return np.asarray(np.sin(0.1 * (x + y + z) + 0.01 * step), dtype=np.float32)


def test_of_a_long_series_a_part_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "PLANNED_VERTICES", 1 << 18)
    series = _Long((4096, 4, 64, 64))
    prediction = Predictor(series).predict(EncodeConfig(effort=1))
    assert series.seen == {step for first in (1022, 3066) for step in range(first, first + 8)}
    assert prediction.bytes is not None
    assert "16 of 4096 steps" in prediction.basis


def test_of_large_frames_a_crop_is_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "PLANNED_VERTICES", 1 << 14)
    series = _Long((64, 4, 128, 128))
    prediction = Predictor(series).predict(EncodeConfig(effort=1, psnr=40.0))
    assert "8 of 64 steps cropped in space" in prediction.basis
    assert prod(part_of(series, 0.25).shape) <= 1.3 * (1 << 14)


SERIES_PREDICTION = ArraySeries(np.zeros((1, 2, 2, 2), np.float32))
PAPER = EncodeConfig(preset="published", tables="float16")


class _Known:
    """A predictor: the square of the effort, or a second an epoch and 100 besides."""

    def predict(self, config: EncodeConfig) -> Prediction:
        paper = config.published
        seconds = 100.0 + config.epochs if paper else 10.0 * config.effort**2
        return Prediction(seconds=seconds, bytes=1234, psnr=50.0, basis="known")


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_budget, "Predictor", lambda series: _Known())


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


def test_more_time_allows_no_less_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "reported", encoded_by(counted))
    series = _Long((64, 16, 64, 64))
    choices = [choose(series, EncodeConfig(), seconds) for seconds in (0.01, 5, 10, 60, 600)]
    efforts = [choice.config.effort for choice in choices]
    assert efforts == sorted(efforts)
    assert (efforts[0], efforts[-1]) == (1, MAX_EFFORT)
    assert [choice.fits for choice in choices] == [False, True, True, True, True]


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
    config = EncodeConfig(preset="published", tables="float16", epochs=30)
    assert choose(SERIES_PREDICTION, config, 10_000, capped=True).config.epochs == 30


@pytest.mark.usefixtures("known")
def test_a_budget_that_cannot_be_kept_is_told() -> None:
    choice = choose(SERIES_PREDICTION, EncodeConfig(), 5)
    assert "time budget of 5 s may not be kept: even --effort 1" in choice.why
    told = choice.to_dict()
    assert (told["fits"], told["chosen"], told["predicted"]["bytes"]) == (False, "--effort 1", 1234)
