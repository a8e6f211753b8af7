"""`fhash bench train`: figures of every engine, and unsuitable requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fhash_codec import EncodeConfig
from fhash_codec.bench import train
from fhash_codec.bench.train import TURNS, bench_train
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

CONFIG = EncodeConfig(profile="paper", width=4)


@pytest.fixture
def series(field: Callable[..., np.ndarray], monkeypatch: pytest.MonkeyPatch) -> ArraySeries:
    """A small series, and a clock that advances by a millisecond whenever it is read."""
    ticks = count()
    clock = SimpleNamespace(perf_counter=lambda: next(ticks) / 1000)
    monkeypatch.setattr(train, "time", clock)
    monkeypatch.setattr(train, "INFER_SECONDS", 0.003)
    return ArraySeries(field())


def test_every_engine_is_measured_in_turns(series: ArraySeries) -> None:
    calls: list[tuple[Any, ...]] = []
    report = bench_train(series, CONFIG, seconds=0.01, progress=lambda *words: calls.append(words))
    (entry,) = report["series"]
    assert entry["features"] == ["all"]
    assert [run["engine"] for run in entry["engines"]] == ["slab", "naive"]
    measured = [words for words in calls if words[0] == "measuring"]
    assert [words[3] for words in measured] == ["slab", "naive"] * TURNS
    assert all(later[1] == before[1] + 1 for before, later in pairwise(measured))
    naive = next(run for run in entry["engines"] if run["engine"] == "naive")
    assert (naive["train_ratio"], naive["infer_ratio"]) == (1.0, 1.0)
    for run in entry["engines"]:
        assert run["train_msamples_s"] > 0
        assert run["infer_msamples_s"] > 0
        assert run["epochs"] > 0
        assert np.isfinite(run["psnr"])
    assert 0 < entry["batch_samples"] <= entry["samples"] == series.values.size
    assert min(entry["decode_msamples_s"], entry["decode_ratio"]) > 0


def test_a_series_with_a_feature_is_measured_whole_too(series: ArraySeries) -> None:
    feature = f"interval:{np.median(series.values)}:{series.values.max()}"
    config = replace(CONFIG, features=(feature,), dilation=0)
    report = bench_train(series, config, engines=("naive",), seconds=0.01)
    sparse, whole = report["series"]
    assert (sparse["features"], whole["features"]) == ([feature], ["all"])
    assert sparse["samples"] < whole["samples"] == series.values.size
    assert sparse["brick_fill"] < whole["brick_fill"]
    for entry in report["series"]:
        assert [run["train_ratio"] for run in entry["engines"]] == [1.0]


@pytest.mark.usefixtures("series")
def test_without_a_series_a_made_one_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "MADE_SHAPE", (2, 8, 16, 16))
    sparse, whole = bench_train(None, CONFIG, engines=("slab",), seconds=0.01)["series"]
    assert (sparse["features"], whole["features"]) == (["interval:0.25:2"], ["all"])
    assert sparse["samples"] < whole["samples"] == 2 * 8 * 16 * 16


def test_there_is_no_ratio_without_the_naive_engine(series: ArraySeries) -> None:
    (entry,) = bench_train(series, CONFIG, engines=("slab",), seconds=0.01)["series"]
    (run,) = entry["engines"]
    assert (run["train_ratio"], run["infer_ratio"]) == (None, None)


@pytest.mark.parametrize("request_", [{"seconds": 0.0}, {"engines": ()}, {"engines": ("fast",)}])
def test_unsuitable_requests_are_refused(series: ArraySeries, request_: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        bench_train(series, CONFIG, **request_)


def test_a_machine_that_stalls_at_the_first_steps_is_measured_all_the_same(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock leaps while an engine warms up; later it crawls, and the schedule runs out."""
    ticks = count()
    clock = SimpleNamespace(
        perf_counter=lambda: 1000.0 * tick if (tick := next(ticks)) < 12 else 1e6 + tick / 1e6
    )
    monkeypatch.setattr(train, "time", clock)
    monkeypatch.setattr(train, "INFER_SECONDS", 1e-5)
    report = bench_train(series, CONFIG, engines=("naive",), seconds=0.01)
    (run,) = report["series"][0]["engines"]
    assert run["train_msamples_s"] > 0
    assert run["train_ratio"] == 1.0
