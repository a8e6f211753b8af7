"""Encodings and peers of `fhash cost`: plan, time that is left, trials, and advice."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from math import prod
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import encodings as own
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
    machine,
    paper_config,
    wishes,
)
from fhash_codec.cost.prediction import Prediction
from fhash_codec.cost.results import CostReport, Encoded, advise, bytes_text, told
from fhash_codec.progress import silent
from fhash_formats.errors import InterruptedEncodingError, MissingDependencyError, RegionError
from fhash_formats.series import ArraySeries


def test_the_machine_is_described_by_json_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    described = machine()
    assert described["device"] == "cpu"
    assert described["processor"]
    assert described["cores"] == os.cpu_count()
    assert described["threads"] == 3
    assert json.loads(json.dumps(described)) == described


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


def test_the_default_and_the_peers_come_early_and_every_name_once() -> None:
    every = list(wishes())
    assert EncodeConfig() in [wish.config for wish in every[:6]]
    assert [wish.codec for wish in every[1:4]] == list(PEERS)
    names = [wish.name for wish in every]
    assert len(names) == len(set(names))
    assert {wish.codec for wish in every} == {"compact", "paper", *PEERS}


def test_options_give_the_encoding_again() -> None:
    config = EncodeConfig(effort=3, psnr=45.0)
    wish = Wish(codec="compact", group="compact, effort 3", config=config)
    assert wish.options == "--psnr 45 --effort 3"
    assert wish.name == "compact, effort 3, 45 dB"
    assert Wish(codec="compact", group="g", config=EncodeConfig()).options == ""
    paper = Wish(codec="paper", group="paper", config=paper_config(1))
    assert (paper.name, paper.options) == ("paper, 1 epoch", "--profile paper --epochs 1")


def point(name: str, codec: str, seconds: float | None, size: int, psnr: float | None) -> Encoded:
    return Encoded(
        name=name, codec=codec, group=codec, seconds=seconds, bytes=size, psnr=psnr,
        exact=psnr is None,
    )  # fmt: skip


POINTS = [
    point("fast", "compact", 1.0, 2000, 46.0),
    point("small", "compact", 9.0, 1000, 45.0),
    point("peer", "SZ3", 0.1, 3000, 46.0),
    point("good", "compact", 5.0, 9000, 61.0),
    point("only predicted", "compact", None, 1, 99.0),
]


def test_smallest_and_fastest_of_what_reaches_an_accuracy() -> None:
    advice = advise(POINTS, (35.0, 45.0, 50.0, 60.0, 70.0))
    assert [(entry.psnr, entry.aim, entry.name) for entry in advice] == [
        (45.0, "smallest", "small"),
        (45.0, "fastest", "fast"),
        (45.0, "smallest peer", "peer"),
        (60.0, "smallest", "good"),
    ]


def test_exact_values_reach_every_accuracy() -> None:
    (entry,) = advise([point("exact", "compact", 2.0, 5000, None)], (40.0, 70.0))
    assert (entry.psnr, entry.reached) == (70.0, None)
    assert advise([POINTS[-1]]) == ()


def test_a_line_of_advice() -> None:
    (first, *_) = advise(POINTS[:1], (45.0,))
    assert told(first) == "45 dB: 1 s, 2 kB, the smallest: fast"


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (1234, "1.23 kB"), (99_000, "99 kB"), (999_600, "1 MB"), (5e9, "5 GB")],
)
def test_sizes_in_three_digits(count: float, text: str) -> None:
    assert bytes_text(count) == text


def test_a_report_is_json_with_every_field(report: CostReport) -> None:
    values = json.loads(json.dumps(report.to_dict()))
    assert list(values) == [field.name for field in fields(CostReport)]
    assert [entry["measured"] for entry in values["encodings"]] == [True, True, False]
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


FAST = Wish(codec="compact", group="compact, effort 1", config=EncodeConfig(effort=1, psnr=40.0))


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


def test_paper_needs_torch(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(what: str) -> None:
        raise MissingDependencyError(f"{what} needs torch")

    monkeypatch.setattr(own, "need_torch", missing)
    allowance = Allowance(1000.0)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    encodings.measure(Wish(codec="paper", group="paper"))
    assert encodings.points == []
    assert allowance.left_out[0].why == "profile paper needs torch"


def test_paper_trains_one_epoch_and_then_as_many_as_fit(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own, "EPOCHS", (2, 10**6))
    encodings = OwnEncodings(series, tmp_path, Allowance(1000.0), foretold, silent)
    encodings.measure(Wish(codec="paper", group="paper"))
    assert [point.name for point in encodings.points] == ["paper, 1 epoch", "paper, 2 epochs"]
    assert [len(curve.points) for curve in encodings.curves] == [1, 2]
    assert list(tmp_path.glob("*.checkpoint")) == []


def test_ctrl_c_in_a_training_ends_the_measurements(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise InterruptedEncodingError("interrupted, a checkpoint is saved")

    monkeypatch.setattr(own, "encode", interrupted)
    allowance = Allowance(1000.0)
    OwnEncodings(series, tmp_path, allowance, foretold, silent).measure(FAST)
    assert allowance.interrupted
