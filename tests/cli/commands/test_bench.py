"""`fhash bench`: figures of the engines or codecs asked for, and of the machine."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import Result

from fhash_codec.bench import train

Fhash = Callable[..., Result]


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock for `bench train` that advances by 10 ms whenever it is read."""
    ticks = count()
    clock = SimpleNamespace(perf_counter=lambda: next(ticks) / 100)
    monkeypatch.setattr(train, "time", clock)
    monkeypatch.setattr(train, "INFER_SECONDS", 0.03)


@pytest.mark.usefixtures("steady")
def test_bench_train_measures_each_engine(fhash: Fhash, data: Path) -> None:
    result = fhash("bench", "train", data, "--seconds", "0.1", "--width", "4", "--json", "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    (series,) = report["series"]
    assert sorted(entry["engine"] for entry in series["engines"]) == ["naive", "slab"]
    for entry in series["engines"]:
        assert entry["train_msamples_s"] > 0
        assert entry["infer_msamples_s"] > 0
        assert 0 < entry["fraction_of_peak"] < 1
    assert {"cores", "device"} <= set(report["machine"])


@pytest.mark.usefixtures("steady")
def test_bench_train_prints_a_table(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench", "train", data, "--seconds", "0.1", "--engines", "slab", "--width", "4", "-q"
    )
    assert result.exit_code == 0
    header, row, fill, _ = result.stdout.splitlines()
    assert header.split()[:2] == ["features", "engine"]
    assert row.split()[:2] == ["all", "slab"]
    assert "times as fast as by whole blocks" in fill


@pytest.mark.usefixtures("steady")
def test_bench_train_makes_a_series_where_none_is_given(
    fhash: Fhash, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "MADE_SHAPE", (2, 8, 16, 16))
    words = ["bench", "train", "--seconds", "0.1", "--width", "4", "--json", "-q"]
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    features = [entry["features"] for entry in json.loads(result.stdout)["series"]]
    assert features == [["interval:0.25:2"], ["all"]]
    refused = fhash(*words[:2], "--var", "velocity", "-q")
    assert refused.exit_code == 2
    assert refused.stderr == "fhash: error: --var is for DATA that are read; name them\n"
