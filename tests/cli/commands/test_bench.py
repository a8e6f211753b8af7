"""`fhash bench`: figures of the engines or codecs asked for, and of the machine."""

from __future__ import annotations

import json
import sys
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


RATE = ["--profile", "paper", "--epochs", "1", "--width", "4", "-q"]


def test_bench_rate_prints_one_json_object(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        "--target",
        "40",
        "--bound",
        "0.02",
        "--peer",
        "SZ3",
        "--peer",
        "Blosc",
        *RATE,
        "--json",
    )
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    asked = {(point["codec"], point["goal"], point["asked"]) for point in report["points"]}
    assert asked == {
        (codec, *goal)
        for codec in ("SZ3", "Blosc", "fhash paper")
        for goal in (("psnr", 40.0), ("bound", 0.02))
    }
    assert [row["peer"] for row in report["best_peers"]] == ["SZ3", "SZ3"]
    assert len(report["speeds"]) == 3
    assert report["shape"] == [3, 6, 7, 8]
    assert {"cores", "device"} <= set(report["machine"])


def test_bench_rate_prints_tables(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        "--t",
        ":2",
        "--target",
        "40",
        "--bound",
        "0.05",
        "--peer",
        "SZ3",
        *RATE,
    )
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].split("  ")[0] == "bytes"
    assert lines[0].endswith("best / fhash paper")
    assert [line.split("  ")[0] for line in lines[1:3]] == ["40 dB", "within 5 %"]
    assert any(line.startswith("speed") for line in lines)
    assert any(line.startswith("6 x 7 x 8 of a step") for line in lines)
    assert any("float32 2 x 6 x 7 x 8" in line for line in lines)


def test_bench_rate_measures_size_alone_and_no_profile(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        "--target",
        "40",
        "--peer",
        "ZFP",
        "--profile",
        "none",
        "--no-speed",
        "-q",
        "--json",
    )
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert [point["codec"] for point in report["points"]] == ["ZFP"]
    assert report["speeds"] == report["access"] == []


def test_bench_rate_draws(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    picture = tmp_path / "rate.png"
    words = [
        "bench",
        "rate",
        data,
        "--target",
        "40",
        "--peer",
        "SZ3",
        "--profile",
        "none",
        "--no-speed",
        "-q",
        "--plot",
        picture,
    ]
    assert fhash(*words).exit_code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = fhash(*words)
    assert again.exit_code == 2
    assert "exists; use --force" in again.stderr


def test_bench_rate_refuses_what_is_unknown(
    refused: Callable[..., str], data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "'zip' is no peer; allowed: SZ3, SPERR" in refused(
        2, "bench", "rate", data, "--peer", "zip"
    )
    assert "'tiny' is no profile; allowed: " in refused(
        2, "bench", "rate", data, "--profile", "tiny"
    )
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    assert "fhash[bench]" in refused(2, "bench", "rate", data, "--target", "40")
