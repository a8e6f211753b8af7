"""JSON of every benchmark is what docs/json.md says, key by key and in both directions."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import Fhash
from documented_json import check, parsed

from fhash_bench import engines, train
from fhash_bench.pictures.results import RenderBench
from fhash_bench.rate.measuring import Access, Point, RateBench, Speed, TilePrice


def test_bench_train(fhash: Fhash, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = count()
    read = lambda: next(ticks) / 100  # noqa: E731
    monkeypatch.setattr(engines, "time", SimpleNamespace(perf_counter=read, process_time=read))
    monkeypatch.setattr(train, "INFER_SECONDS", 0.01)
    words = ["bench", "train", data, "--seconds", "0.1", "--width", "4", "--engines", "slab"]
    check("bench train", parsed(fhash(*words, "--json", "-q")))


def test_bench_rate() -> None:
    point = Point(
        codec="SZ3", goal="psnr", asked=40.0, reached=True, bytes=9, psnr=None, max_error=0.0,
        setting="", as_asked=None,
    )  # fmt: skip
    speed = Speed(
        codec="SZ3", setting="", psnr=40.0, encode_mb_s=1.0, decode_mb_s=2.0,
        encode_core_mb_s=1.0, decode_core_mb_s=2.0, encode_runs=3,
    )  # fmt: skip
    tiles = TilePrice(goal="psnr", asked=40.0, bytes=9, one_tile_bytes=8, price=1.125, steps=1)
    access = Access(
        codec="SZ3", setting="", region=(1, 2, 3), bytes=9, psnr=None, milliseconds=0.5,
        core_milliseconds=0.5, bytes_read=9,
    )  # fmt: skip
    result = RateBench(
        series="a", shape=(1, 2, 3, 4), dtype="float32", raw_bytes=96, value_range=(0.0, 1.0),
        missing=0, points=(point, replace(point, codec="fhash compact")), speeds=(speed,),
        access=(access,), tiles=(tiles,), refused={"ZFP": "no"}, machine={}, notes=("a",),
    )  # fmt: skip
    check("bench rate", json.loads(json.dumps(result.to_dict())))


def test_bench_table(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "table", data, "--target", "40", "--peer", "SZ3", "--effort", "1"]
    check("bench table", parsed(fhash(*words, "-o", tmp_path, "--json", "-q")))


def test_bench_ablate(fhash: Fhash, data: Path) -> None:
    words = ["bench", "ablate", data, "--axis", "samples", "--epochs", "1"]
    check("bench ablate", parsed(fhash(*words, "--json", "-q")))


def test_bench_labels(fhash: Fhash) -> None:
    words = ["bench", "labels", "--kind", "tiny grid", "--effort", "1"]
    check("bench labels", parsed(fhash(*words, "--json", "-q")))


def test_bench_paper(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "paper", data, "--quick", "--epochs", "1", "--protocol", "equal", "--feature"]
    words += ["interval:6:99", "--encoding", "fhash", "-o", tmp_path, "--no-latency"]
    results = [parsed(fhash(*words, "--json", "-q"))]
    results.append(parsed(fhash("bench", "paper", "--parameters", "--json")))
    check("bench paper", *results)


def test_bench_render() -> None:
    result = RenderBench(
        series="a", shape=(1, 2, 3, 4), step=0.0, size=16, turns=1, effects=(), accelerations=(),
        streams=(), against=(), exactness=(), playback=(), curves=(), refused={"vtk": "no"},
        machine={}, notes=(),
    )  # fmt: skip
    check("bench render", json.loads(json.dumps(result.to_dict())))
