"""Encodings of `fhash cost`: the plan, samples, peers, and the advice drawn from them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.boxes import Box
from fhash_codec.comparison import EncodeReport
from fhash_codec.config import DEFAULT_PSNR, EncodeConfig
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
    options_of,
    wishes,
)
from fhash_codec.cost.probe import (
    WITHIN,
    growth_factors,
    growth_powers,
    sample_of,
)
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
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InterruptedEncodingError, RegionError
from fhash_formats.series import ArraySeries


def waves(shape: tuple[int, int, int, int] = (12, 4, 16, 16)) -> npt.NDArray[np.float32]:
    t, z, y, x = np.ogrid[tuple(slice(n) for n in shape)]
    return (np.sin(0.3 * x + 0.2 * y + 0.1 * t) * np.cos(0.2 * z)).astype(np.float32)


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
    with pytest.raises(BudgetSpentError, match="stopped after 25 s"):
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
    assert "a sample, " in described(crop)
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


def test_the_default_comes_first_and_every_name_once() -> None:
    every = list(wishes())
    assert every[0].config == EncodeConfig()
    assert [wish.always for wish in every] == [True, *[False] * (len(every) - 1)]
    assert [wish.codec for wish in every[3:6]] == list(PEERS)
    names = [wish.name for wish in every]
    assert len(names) == len(set(names))


def test_options_give_the_encoding_again() -> None:
    config = EncodeConfig(effort=3, psnr=45.0)
    wish = Wish(codec="default", group="effort 3", config=config)
    assert options_of(config) == "--psnr 45 --effort 3"
    assert wish.name == "effort 3, 45 dB"
    assert options_of(EncodeConfig()) == ""
    every = wishes(("mask:a b.npy", "isosurface:5"))
    (network,) = [wish for wish in every if wish.name == NETWORK]
    assert network.config is not None
    assert (
        options_of(network.config)
        == "--preset published --feature 'mask:a b.npy' --feature isosurface:5"
    )
    assert options_of(EncodeConfig(timings=True)) == "--timings"


def point(name: str, codec: str, seconds: float, size: int, psnr: float | None) -> Encoded:
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
]


def told(points: Sequence[Encoded]) -> list[tuple[str, str, str]]:
    return [(entry.goal, entry.aim, entry.name) for entry in advise(points, 10.0)]


def test_fastest_smallest_and_default_of_what_reaches_an_accuracy() -> None:
    points = [replace(each, group=each.name if each.name != DEFAULT else "a") for each in POINTS]
    assert told(points)[:6] == [
        ("40 dB", "fastest", "faster"),
        ("40 dB", "smallest", "as small"),
        ("40 dB", "default", DEFAULT),
        ("50 dB", "fastest", "faster"),
        ("50 dB", "smallest", DEFAULT),
        ("50 dB", "default", DEFAULT),
    ]
    assert told(points)[-1] == ("60 dB", "default", DEFAULT)
    # Without one at the default effort there is no advice to take it.
    assert {aim for _, aim, _ in told(POINTS[:4])} == {"fastest", "smallest"}


def test_the_fastest_is_never_slower_than_one_of_a_higher_accuracy() -> None:
    noisy = [point("40", "default", 0.24, 900, 40.1), point("50", "default", 0.19, 2000, 50.1)]
    assert [name for _, aim, name in told(noisy) if aim == "fastest"] == ["50", "50"]
    # Of the same time in the table, the smaller one counts.
    alike = [replace(noisy[0], seconds=0.1904), noisy[1]]
    assert [name for _, aim, name in told(alike) if aim == "fastest"] == ["40", "50"]


def test_figures_of_a_sample_become_intervals_of_the_whole() -> None:
    grown = point("a", "default", 2.0, 1000, 50.0).grown((3.0, 5.0), (2.0, 4.0), 30_000)
    assert (grown.seconds, grown.seconds_range) == (8.0, (6.0, 10.0))
    assert (grown.bytes, grown.bytes_range, grown.ratio) == (3000, (2000, 4000), 10.0)
    assert (grown.seconds_text, grown.bytes_text) == ("6 to 10 s", "2 to 4 kB")
    wide = replace(grown, bytes_range=(900, 4000))
    assert wide.bytes_text == "900 B to 4 kB"


def test_a_sample_grows_at_most_in_proportion_and_at_least_as_before() -> None:
    seconds, sizes = growth_factors((0.25, 0.5), 16.0)
    assert seconds == (2.0, 16 * WITHIN)
    assert sizes == (4.0, 16.0)
    assert growth_factors((1.0, 1.0), 16.0)[1] == (16 / WITHIN, 16.0)


def test_the_interval_of_a_sample_holds_the_size_of_the_whole(tmp_path: Path) -> None:
    values = waves((32, 12, 48, 48))
    values += np.random.default_rng(1).normal(scale=0.01, size=values.shape).astype(np.float32)
    whole, config = ArraySeries(values), EncodeConfig(effort=1, psnr=50.0)
    sample = sample_of(whole, values.size // 2, Box.of_shape(whole.shape[1:]))
    assert sample.shape[0] == 16
    facts = replace(facts_of(sample, silent), value_range=facts_of(whole, silent).value_range)
    powers = growth_powers(sample, facts, config)
    figures = [encode(each, tmp_path / f"{each.shape[0]}.fhz", config) for each in (whole, sample)]
    low, high = growth_factors(powers, 2.0)[1]
    assert low <= figures[0]["bytes"] / figures[1]["bytes"] <= high


def test_errors_of_a_sample_are_those_of_the_whole(series: ArraySeries, tmp_path: Path) -> None:
    facts = facts_of(series, silent)
    wider = ValueRange(facts.value_range.low, facts.value_range.low + 10 * facts.width)
    sample = replace(facts, value_range=wider, sample=True, decibels=20.0)
    encodings = OwnEncodings(series, sample, tmp_path, Allowance(1000.0), silent)
    encodings.measure(Wish(codec="default", group="a", config=EncodeConfig(effort=1, psnr=60.0)))
    (point,) = encodings.points
    assert point.options == "--psnr 60 --effort 1"
    assert point.psnr == pytest.approx(60.0, abs=2.0)
    assert point.max_abs_error is not None
    assert point.max_abs_error > 0.001 * wider.high / 2


def test_a_largest_error_must_be_promised() -> None:
    close = replace(POINTS[0], psnr=30.0, max_abs_error=0.1)
    bound = replace(close, name="bound", options="--max-error-rel 0.01")
    finer = replace(bound, name="finer", seconds=0.1, bytes=9000, max_abs_error=0.02)
    assert told([close, bound, finer]) == [
        ("within 1 %", "fastest", "finer"),
        ("within 1 %", "smallest", "bound"),
    ]
    assert told([replace(bound, max_abs_error=0.1001)]) == []
    assert told([replace(bound, max_abs_error=None)]) == []


def test_exact_values_reach_every_accuracy() -> None:
    entries = advise([point("exact", "default", 2.0, 5000, None)], 10.0)
    goals = {entry.goal for entry in entries}
    assert goals == {"40 dB", "50 dB", "60 dB", "within 1 %", "within 0.1 %"}
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
    assert [entry["bytes"] for entry in values["encodings"]] == [900, 1000, 2000]
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


def of(series: ArraySeries, folder: Path, allowance: Allowance) -> OwnEncodings:
    return OwnEncodings(series, facts_of(series, silent), folder, allowance, silent)


def test_an_encoding_has_its_figures(series: ArraySeries, tmp_path: Path) -> None:
    encodings = of(series, tmp_path, Allowance(1000.0))
    encodings.measure(FAST)
    encodings.measure(FAST)
    (point,), (file,) = encodings.points, encodings.files
    assert point.bytes == file.path.stat().st_size
    assert point.psnr is not None
    assert point.psnr >= 40


@pytest.mark.parametrize(
    ("times", "shown"),
    [((0.19, 0.05, 0.1, 0.3, 0.4, 0.5), (0.05, 0.05)), ((0.5, 0.7, 0.45, 9.0), (0.5, 0.45)),
     ((0.5, 0.7, 0.8, 0.6, 9.0), (0.5, 0.5))],
)  # fmt: skip
def test_quick_and_noisy_encodings_are_the_fastest_of_several(
    series: ArraySeries,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    times: tuple[float, ...],
    shown: tuple[float, ...],
) -> None:
    measured = iter(times)

    def timed(*arguments: Any, **named: Any) -> EncodeReport:
        report = encode(*arguments, **named)
        report["seconds"] = next(measured)
        return report

    monkeypatch.setattr(own, "encode", timed)
    encodings = of(series, tmp_path, Allowance(1000.0))
    encodings.measure(replace(FAST, config=EncodeConfig(effort=1, psnr=60.0)))
    encodings.measure(FAST)
    assert tuple(point.seconds for point in encodings.points) == shown


def test_an_encoding_that_overruns_is_no_point(series: ArraySeries, tmp_path: Path) -> None:
    now = 0.0
    allowance = Allowance(1000.0, lambda: now)

    def advance(stage: str, done: int, total: int, note: str) -> None:
        nonlocal now
        now += 500.0

    encodings = OwnEncodings(series, facts_of(series, silent), tmp_path, allowance, advance)
    encodings.measure(FAST)
    assert encodings.points == []
    assert "stopped after 750 s" in allowance.left_out[0].why
    assert list(tmp_path.iterdir()) == []


def test_the_default_needs_no_time_left(series: ArraySeries, tmp_path: Path) -> None:
    allowance = Allowance(1e-9)
    encodings = of(series, tmp_path, allowance)
    for wish in (*wishes(), *wishes()):
        if wish.codec not in PEERS:
            encodings.measure(wish)
    assert [point.name for point in encodings.points] == [DEFAULT]
    assert (encodings.points[0].region_ms or 0) > 0
    (network,) = [entry for entry in allowance.left_out if entry.what == NETWORK]
    assert network.late


def test_the_network_is_measured_at_the_promise_of_the_default(
    series: ArraySeries, tmp_path: Path
) -> None:
    encodings = of(series, tmp_path, Allowance(1000.0))
    (network,) = [wish for wish in wishes() if wish.name == NETWORK]
    encodings.measure(network)
    (point,) = encodings.points
    assert point.missed or (point.psnr or 0.0) >= DEFAULT_PSNR
    assert [curve.name for curve in encodings.curves] == [NETWORK]
    assert list(tmp_path.glob("*.checkpoint")) == []


def test_no_training_is_tried_where_the_default_trains_nothing(
    series: ArraySeries, tmp_path: Path
) -> None:
    allowance = Allowance(1000.0)
    encodings = of(series, tmp_path, allowance)
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
    of(series, tmp_path, allowance).measure(FAST)
    assert allowance.interrupted
