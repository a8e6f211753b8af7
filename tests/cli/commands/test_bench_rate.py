"""`fhash bench rate`: one object, tables, a picture, and unknown names."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

Fhash = Callable[..., Result]

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
    assert report["speeds"] == report["access"] == report["tiles"] == []


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


def test_bench_rate_prices_tiles_and_takes_generated_series(fhash: Fhash) -> None:
    words = ("bench", "rate", "generated:long", "--target", "35", "--peer", "none", "--effort", "1")
    result = fhash(*words, "--profile", "compact", "--no-speed", "-q", "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    (price,) = report["tiles"]
    assert price["steps"] == 600
    assert price["price"] == price["bytes"] / price["one_tile_bytes"]
    assert price["bytes"] == report["points"][0]["bytes"]
    assert "is no generated series" in fhash("bench", "rate", "generated:no").stderr
    assert "--var is for DATA" in fhash("bench", "rate", "generated:long", "--var", "a").stderr
