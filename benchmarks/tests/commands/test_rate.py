"""`fhash bench rate`: one object, tables, a picture, and unknown names."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import Result

from fhash_bench.commands.rate import Peer, PeerType, filters_of, opened, programs_of
from fhash_bench.rate.measuring import PEERS
from fhash_codec.progress import silent

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


def test_made_series_make_a_table(fhash: Fhash) -> None:
    result = fhash("bench", "labels", "--kind", "tiny grid", "--effort", "1", "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    header, row, *_ = result.stdout.splitlines()
    assert header.startswith("labels")
    assert row.startswith("tiny grid  int16 200 x 6 x 7 x 8")


def test_data_are_measured_by_the_options_of_a_series(fhash: Fhash, tmp_path: Path) -> None:
    path = tmp_path / "labels.npy"
    np.save(path, (np.indices((4, 3, 16, 20))[2] // 5).astype("u1"))
    result = fhash("bench", "labels", path, "--t", ":2", "--effort", "1", "-q")
    assert result.exit_code == 0, result.stderr
    assert "uint8 2 x 3 x 16 x 20" in result.stdout


def test_an_unknown_kind_is_refused(refused: Callable[..., str]) -> None:
    assert "kind is 'foo'; allowed: " in refused(2, "bench", "labels", "--kind", "foo")


def test_bench_table_prints_markdown_and_goes_on(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "table", data, "--target", "40", "--bound", "0.05", "--peer", "SZ3"]
    words += ["--effort", "1", "-o", tmp_path / "cells", "-q"]
    first = fhash(*words)
    assert (first.exit_code, first.stderr) == (0, "")
    header, line, *rows = first.stdout.splitlines()
    assert header.startswith("| series | quality | fhash, bytes | one tile | tiles cost |")
    assert set(line) == set("| -")
    assert [row.split(" | ")[1] for row in rows] == ["40 dB", "5 %"]
    assert len(list((tmp_path / "cells").glob("*.json"))) == 4
    again = json.loads(fhash(*words, "--json").stdout)
    assert again["measured"] == 0
    assert again["table"] == first.stdout.rstrip("\n")
    assert {cell["codec"] for cell in again["cells"]} == {"fhash compact", "SZ3"}


def test_bench_table_needs_data(refused: Callable[..., str], data: Path) -> None:
    assert "Missing DATA; or give --generated" in refused(2, "bench", "table")
    assert "is no program that can be run" in refused(
        2, "bench", "table", data, "--peer", "tthresh=/nowhere/tthresh"
    )
    assert "and as NAME=PATH tthresh, qoz" in refused(2, "bench", "table", data, "--peer", "zip=a")
    assert "is no peer" in refused(2, "bench", "table", data, "--peer", "tthresh")


def test_filters_are_all_unless_some_are_named() -> None:
    program = Peer(name="vvc", path="/usr/bin/ffmpeg")
    assert filters_of([]) == filters_of([program]) == list(PEERS)
    assert filters_of([Peer(name="SZ3"), program, Peer(name="SZ3")]) == ["SZ3"]
    assert filters_of([Peer(name="none"), program]) == []
    assert programs_of([Peer(name="SZ3"), program]) == {"vvc": "/usr/bin/ffmpeg"}


def test_a_peer_is_a_name_or_a_program() -> None:
    kind = PeerType()
    assert kind.convert("SZ3", None, None) == Peer(name="SZ3")
    assert kind.convert("tthresh=a=b", None, None) == Peer(name="tthresh", path="a=b")
    assert kind.convert(Peer(name="none"), None, None) == Peer(name="none")
    for wrong in ("SZ3=/bin/true", "tthresh", "", "=x"):
        with pytest.raises(click.BadParameter, match="is no peer; allowed: SZ3"):
            kind.convert(wrong, None, None)


def test_a_generated_series_has_no_options() -> None:
    with opened("generated:long", None, silent) as series:
        assert series.shape == (600, 6, 10, 14)
