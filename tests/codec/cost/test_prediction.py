"""Predictions: what is probed, what an effort does, and the effort that fits into a time."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.comparison import EncodeReport
from fhash_codec.config import EncodeConfig
from fhash_codec.cost import encodings as own
from fhash_codec.cost import prediction as time_budget
from fhash_codec.cost import probe as probes
from fhash_codec.cost.encodings import OwnEncodings
from fhash_codec.cost.peers import EXACT, LADDER, PeerEncodings, Search, Trial
from fhash_codec.cost.plan import (
    MIN_STEPS,
    OVERRUN,
    PEERS,
    Allowance,
    BudgetSpentError,
    CroppedSeries,
    Wish,
    cropped,
    described,
    facts_of,
    options_of,
    wishes,
)
from fhash_codec.cost.prediction import (
    MAX_EFFORT,
    MAX_EPOCHS,
    Prediction,
    Predictor,
    choose,
)
from fhash_codec.cost.probe import CompactProbe, PaperProbe, part_of, promise_of_part
from fhash_codec.cost.results import (
    DEFAULT,
    NETWORK,
    TRAINING,
    CostReport,
    Encoded,
    advise,
    bytes_text,
    seconds_text,
)
from fhash_codec.encoding import encode
from fhash_codec.paper.train import usual_batches
from fhash_codec.progress import silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, InterruptedEncodingError, RegionError
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


class Clock:
    """A clock that stands until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_part_ends_at_its_share_and_what_does_not_fit_is_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 20.0
    assert allowance.left == 30.0
    assert allowance.has("short", 30.0)
    assert not allowance.has("long", 31.0)
    assert not allowance.has("half", 16.0, share=0.5)
    clock.now = 70.0
    assert allowance.left == 0.0
    allowance.part(0.5)
    assert allowance.left == 15.0
    entry, _ = allowance.left_out
    assert (entry.what, entry.late) == ("long", True)
    assert "31 s" in entry.why
    assert "30 s" in entry.why


def test_work_that_overruns_is_ended_and_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 10.0
    guarded = allowance.guard(silent, share=0.5)
    clock.now = 10.0 + 20 * (1 + OVERRUN)
    guarded("stage", 1, 2, "")
    clock.now += 0.1
    with allowance.work("an encoding"):
        guarded("stage", 2, 2, "")
        pytest.fail("it went on")
    assert [entry.what for entry in allowance.left_out] == ["an encoding"]
    with pytest.raises(BudgetSpentError):
        guarded("stage", 2, 2, "")


def test_ctrl_c_ends_the_work_and_everything_after_it() -> None:
    allowance = Allowance(100.0)
    with allowance.work("a picture"):
        raise KeyboardInterrupt
    assert allowance.interrupted
    assert not allowance.has("another", 0.0)
    assert {entry.why for entry in allowance.left_out} == {"interrupted"}


def array(shape: tuple[int, ...]) -> ArraySeries:
    return ArraySeries(np.arange(prod(shape), dtype=np.float32).reshape(shape))


def test_a_series_that_is_small_enough_stays_whole() -> None:
    series = array((3, 4, 5, 6))
    assert cropped(series, prod(series.shape)) is series
    assert described(series) == "the whole series"


@pytest.mark.parametrize("vertices", [20_000, 3000, 200, 1])
def test_a_crop_has_about_the_vertices_asked_for(vertices: int) -> None:
    series = array((20, 1, 30, 40))
    crop = cropped(series, vertices)
    assert isinstance(crop, CroppedSeries)
    assert prod(crop.shape) <= 1.3 * vertices + 2 * MIN_STEPS
    assert crop.shape[0] >= MIN_STEPS
    assert crop.shape[1] == 1
    (t, *_), (_, y, x) = (crop.steps[0],), crop.region
    expected = series.values[t : t + crop.shape[0], :, slice(*y), slice(*x)]
    np.testing.assert_array_equal(np.stack(list(crop.frames())), expected)
    assert crop.coords["x"].values[0] == x[0]
    assert "a crop, " in described(crop)
    assert f"x {x[0]}:{x[1]}" in described(crop)
    with pytest.raises(RegionError):
        crop.read(crop.shape[0])


def test_range_bulk_size_and_missing_values() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    values[0, 0, 0, :3] = np.nan
    facts = facts_of(ArraySeries(values), silent)
    assert facts.missing == 3
    assert facts.raw_bytes == values.nbytes
    assert facts.width == pytest.approx(1, abs=0.01)
    assert facts.bulk is not None
    assert 0.97 < facts.bulk.high - facts.bulk.low < facts.width
    errors = facts.errors()
    errors.add(0, values[0], values[0] + np.float32(0.1))
    assert errors.psnr == pytest.approx(20, abs=0.1)


def test_a_constant_series_has_no_width() -> None:
    facts = facts_of(ArraySeries(np.ones((2, 3, 4, 5))), silent)
    assert (facts.width, facts.bulk) == (0.0, None)


def test_errors_count_in_the_features_alone(series: ArraySeries, tmp_path: Path) -> None:
    features = ("interval:1:9",)
    facts = facts_of(series, silent, features)
    report = encode(series, tmp_path / "a.fhz", EncodeConfig(effort=1, features=features))
    with open_volume(report["path"]) as volume:
        for step in range(len(series.values)):
            np.testing.assert_array_equal(facts.mask(step), volume.occupancy(step))
        assert facts.bulk is not None
        assert [facts.bulk.low, facts.bulk.high] == report["quality"]["bulk"]["range"]
    peers = PeerEncodings(series, facts, tmp_path, Allowance(1000.0), silent)
    peers.measure(wish("SPERR", 40.0))
    (point,) = peers.points
    assert point.psnr is not None
    everything = encodings(series, tmp_path, Allowance(1000.0))
    everything.measure(wish("SPERR", 40.0))
    assert point.psnr != everything.points[0].psnr


def test_the_default_and_the_network_come_first_and_every_name_once() -> None:
    every = list(wishes())
    assert [wish.config for wish in every[:2]] == [EncodeConfig(), EncodeConfig(preset="published")]
    assert [wish.always for wish in every] == [True, True, *[False] * (len(every) - 2)]
    assert [wish.codec for wish in every[3:6]] == list(PEERS)
    names = [wish.name for wish in every]
    assert len(names) == len(set(names))


def test_options_give_the_encoding_again() -> None:
    config = EncodeConfig(effort=3, psnr=45.0)
    wish = Wish(codec="default", group="effort 3", config=config)
    assert options_of(config) == "--psnr 45 --effort 3"
    assert wish.name == "effort 3, 45 dB"
    assert options_of(EncodeConfig()) == ""
    (_, network, *_) = wishes(("mask:a b.npy", "isosurface:5"))
    assert network.name == NETWORK
    assert network.config is not None
    assert (
        options_of(network.config)
        == "--preset published --feature 'mask:a b.npy' --feature isosurface:5"
    )
    assert options_of(EncodeConfig(timings=True)) == "--timings"


def point(name: str, codec: str, seconds: float | None, size: int, psnr: float | None) -> Encoded:
    return Encoded(
        name=name, codec=codec, group=codec, seconds=seconds, bytes=size, psnr=psnr,
        exact=psnr is None,
    )  # fmt: skip


POINTS = [
    point("fast", "default", 1.0, 2000, 46.0),
    point("faster", "default", 0.9, 9900, 51.0),
    point("small", "default", 9.0, 1000, 45.0),
    point("as small", "default", 8.0, 1005, 45.0),
    point("peer", "SZ3", 0.1, 300, 46.0),
    point(DEFAULT, "default", 5.0, 9000, 61.0),
    point("only predicted", "default", None, 1, 99.0),
]


def told(points: Sequence[Encoded]) -> list[tuple[str, str, str]]:
    return [(entry.goal, entry.aim, entry.name) for entry in advise(points, 10.0)]


def test_fastest_smallest_and_default_of_what_reaches_an_accuracy() -> None:
    points = [replace(each, group=each.name if each.name != DEFAULT else "a") for each in POINTS]
    assert told(points)[3:7] == [
        ("45 dB", "fastest", "fast"),
        ("45 dB", "smallest", "as small"),
        ("45 dB", "default", DEFAULT),
        ("50 dB", "fastest", "faster"),
    ]
    assert told(points)[-1] == ("60 dB", "default", DEFAULT)
    # Without one at the default effort there is no advice to take it.
    assert {aim for _, aim, _ in told(POINTS[:4])} == {"fastest", "smallest"}


def test_a_largest_error_must_be_promised() -> None:
    close = replace(POINTS[0], psnr=30.0, max_abs_error=0.1)
    bound = replace(close, name="bound", options="--max-error-rel 0.01")
    finer = replace(bound, name="finer", seconds=0.1, bytes=9000, max_abs_error=0.02)
    assert told([close, bound, finer]) == [
        ("within 1 %", aim, "bound") for aim in ("fastest", "smallest")
    ]
    assert told([replace(bound, max_abs_error=0.1001)]) == []
    assert told([replace(bound, max_abs_error=None)]) == []


def test_exact_values_reach_every_accuracy() -> None:
    entries = advise([point("exact", "default", 2.0, 5000, None)], 10.0)
    goals = {entry.goal for entry in entries}
    assert goals == {"40 dB", "45 dB", "50 dB", "60 dB", "within 1 %", "within 0.1 %"}
    assert {(entry.psnr, entry.max_error_rel) for entry in entries} >= {(40.0, None), (None, 0.01)}
    assert {entry.reached for entry in entries} == {None}


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (1234, "1.23 kB"), (99_000, "99 kB"), (999_600, "1 MB"), (5e9, "5 GB")],
)
def test_sizes_in_three_digits(count: float, text: str) -> None:
    assert bytes_text(count) == text


def test_times_are_never_powers_of_ten() -> None:
    assert [seconds_text(ms, "ms") for ms in (0.834, 12.4, 1234.0)] == [
        "0.83 ms",
        "12 ms",
        "1234 ms",
    ]


def test_a_report_is_json_with_every_field(report: CostReport) -> None:
    values = json.loads(json.dumps(report.to_dict()))
    assert list(values) == [field.name for field in fields(CostReport)]
    assert [entry["measured"] for entry in values["encodings"]] == [True, True, True, False]
    assert values["pictures"][0]["counters"]["secondary_rays"] == 0


def codec(slope: float, offset: float, noise: float = 0.0) -> Callable[[float], Trial]:
    """A made-up codec whose PSNR follows the level along a line, or nearly so."""

    def measure(level: float) -> Trial:
        psnr = slope * level + offset + noise * np.sin(40 * level)
        return Trial(
            level=level, bytes=round(100 * 2 ** (psnr / 6)), psnr=psnr, max_error=10 ** (-psnr / 20)
        )

    return measure


@pytest.mark.parametrize(
    ("slope", "offset", "noise"), [(1, 4.8, 0), (0.5, 20, 0), (2.5, -30, 0), (1, 0, 0.03)]
)
@pytest.mark.parametrize("goal", ["psnr", "bound"])
def test_search_ends_just_above_what_is_asked(
    slope: float, offset: float, noise: float, goal: str
) -> None:
    search = Search(codec(slope, offset, noise))
    for asked in (35.0, 45.0, 40.0):
        before = len(search.trials)
        found = search.find(goal, asked, first=asked - 4.8, slack=0.05, most=8)
        assert found is not None
        assert asked <= found.quality(goal) <= asked + 0.05
        assert len(search.trials) - before <= 8


def test_search_on_a_ladder_ends_at_the_first_step_that_reaches_it() -> None:
    for asked in (30.0, 42.0, 55.0):
        found = Search(codec(1, 2), step=LADDER).find("psnr", asked, first=50.0, slack=0.05, most=8)
        assert found is not None
        assert asked <= found.psnr < asked + LADDER


def test_search_of_what_cannot_be_set_tries_once() -> None:
    search = Search(
        lambda level: Trial(level=level, bytes=9, psnr=EXACT, max_error=0.0), fixed=True
    )
    assert [
        search.find(goal, 40.0, first=30.0, slack=0.05, most=8) for goal in ("psnr", "bound")
    ] == list(search.trials.values()) * 2


def test_search_says_that_nothing_reached_it() -> None:
    search = Search(lambda level: Trial(level=level, bytes=9, psnr=20.0, max_error=0.1))
    assert search.find("psnr", 40.0, first=30.0, slack=0.05, most=8) is None
    assert len(search.trials) == 8


def wish(name: str, target: float) -> Wish:
    return Wish(codec=name, group=name, target=target)


def encodings(series: ArraySeries, folder: Path, allowance: Allowance) -> PeerEncodings:
    return PeerEncodings(series, facts_of(series, silent), folder, allowance, silent)


def test_each_peer_reaches_what_it_is_set_to(series: ArraySeries, tmp_path: Path) -> None:
    peers = encodings(series, tmp_path, Allowance(1000.0))
    for target in (40.0, 50.0):
        for name in PEERS:
            peers.measure(wish(name, target))
    assert [point.codec for point in peers.points] == [*PEERS, *PEERS]
    for point, target in zip(peers.points, [40.0] * 3 + [50.0] * 3, strict=True):
        assert point.psnr is not None
        assert target <= point.psnr < target + 25
        assert point.measured
        assert point.psnr_bulk is not None
        assert point.max_abs_error is not None


def test_without_time_or_package_they_are_left_out(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    allowance = Allowance(1e-9)
    peers = encodings(series, tmp_path, allowance)
    peers.measure(wish("SZ3", 40.0))
    assert [entry.late for entry in allowance.left_out] == [True]
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    allowance = Allowance(1000.0)
    peers = encodings(series, tmp_path, allowance)
    for name in PEERS:
        peers.measure(wish(name, 40.0))
    assert peers.points == []
    (entry,) = allowance.left_out
    assert "fhash[bench]" in entry.why


FAST = Wish(codec="default", group="effort 1", config=EncodeConfig(effort=1, psnr=40.0))


def foretold(config: EncodeConfig) -> Prediction:
    """A prediction of 2 s."""
    return Prediction(seconds=2.0, bytes=99, psnr=40.0, basis="none")


def test_an_encoding_has_its_figures_and_its_prediction(
    series: ArraySeries, tmp_path: Path
) -> None:
    encodings = OwnEncodings(series, tmp_path, Allowance(1000.0), foretold, silent)
    encodings.measure(FAST)
    (point,), (file,) = encodings.points, encodings.files
    assert point.measured
    assert point.bytes == file.path.stat().st_size
    assert point.psnr is not None
    assert point.psnr >= 40
    assert (point.predicted_seconds, point.predicted_bytes) == (2.0, 99)


def test_where_time_is_wanting_the_prediction_stays(series: ArraySeries, tmp_path: Path) -> None:
    allowance = Allowance(1.0)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    encodings.measure(FAST)
    (point,) = encodings.points
    assert not point.measured
    assert point.predicted_seconds == 2.0
    assert [entry.what for entry in allowance.left_out] == [FAST.name]
    assert list(tmp_path.iterdir()) == []


def test_an_encoding_that_overruns_is_no_point(series: ArraySeries, tmp_path: Path) -> None:
    now = 0.0
    allowance = Allowance(1000.0, lambda: now)

    def advance(stage: str, done: int, total: int, note: str) -> None:
        nonlocal now
        now += 0.0 if stage == "predicting" else 500.0

    encodings = OwnEncodings(series, tmp_path, allowance, foretold, advance)
    encodings.measure(FAST)
    assert not any(point.measured for point in encodings.points)
    assert "took longer" in allowance.left_out[0].why
    assert list(tmp_path.iterdir()) == []


def test_the_default_and_the_network_need_no_time_left(series: ArraySeries, tmp_path: Path) -> None:
    allowance = Allowance(1e-9)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    for wish in (*wishes(), *wishes()):
        if wish.codec not in PEERS:
            encodings.measure(wish)
    measured = [point for point in encodings.points if point.measured]
    assert [point.name for point in measured] == [DEFAULT, NETWORK]
    assert all((point.region_ms or 0) > 0 for point in measured)
    assert [curve.name for curve in encodings.curves][-1] == NETWORK
    assert not {DEFAULT, NETWORK} & {entry.what for entry in allowance.left_out}
    assert list(tmp_path.glob("*.checkpoint")) == []


def test_no_training_is_tried_where_the_default_trains_nothing(
    series: ArraySeries, tmp_path: Path
) -> None:
    allowance = Allowance(1000.0)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    trainings = [wish for wish in wishes() if wish.group == TRAINING]
    assert [wish.name for wish in trainings] == ["training none", "training 2s", "training 10s"]
    for wish in (next(wishes()), *trainings):
        encodings.measure(wish)
    assert [point.name for point in encodings.points] == [DEFAULT]
    assert [entry.what for entry in allowance.left_out] == [wish.name for wish in trainings]
    assert "no gain from an MLP" in allowance.left_out[0].why


def test_ctrl_c_in_a_training_ends_the_measurements(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise InterruptedEncodingError("interrupted, a checkpoint is saved")

    monkeypatch.setattr(own, "encode", interrupted)
    allowance = Allowance(1000.0)
    OwnEncodings(series, tmp_path, allowance, foretold, silent).measure(FAST)
    assert allowance.interrupted
