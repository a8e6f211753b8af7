"""JSON of every benchmark is what its schema says, key by key and in both directions."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import Fhash
from json_schemas import check, example, parsed

from fhash_bench.pictures.results import RenderBench
from fhash_bench.rate.measuring import RateBench


@pytest.mark.torch
def test_bench_train(fhash: Fhash, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fhash_bench import engines, train

    ticks = count()
    read = lambda: next(ticks) / 100  # noqa: E731
    monkeypatch.setattr(engines, "time", SimpleNamespace(perf_counter=read, process_time=read))
    monkeypatch.setattr(train, "INFER_SECONDS", 0.01)
    words = ["bench", "train", data, "--seconds", "0.1", "--width", "4", "--engines", "native"]
    check("bench train", parsed(fhash(*words, "--json", "-q")))


def test_bench_rate() -> None:
    result = example(RateBench)
    own = replace(result.points[0], codec="fhash default")
    result = replace(result, points=(*result.points, own))
    check("bench rate", json.loads(json.dumps(result.to_dict())))


def test_bench_table(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "table", data, "--target", "40", "--peer", "SZ3", "--effort", "1"]
    check("bench table", parsed(fhash(*words, "-o", tmp_path, "--json", "-q")))


@pytest.mark.torch
def test_bench_ablate(fhash: Fhash, data: Path) -> None:
    words = ["bench", "ablate", data, "--axis", "samples", "--epochs", "1"]
    check("bench ablate", parsed(fhash(*words, "--json", "-q")))


def test_bench_kinds(fhash: Fhash) -> None:
    check("bench kinds", parsed(fhash("bench", "kinds", "--only", "single", "--json", "-q")))


def test_bench_labels(fhash: Fhash) -> None:
    words = ["bench", "labels", "--kind", "tiny grid", "--effort", "1"]
    check("bench labels", parsed(fhash(*words, "--json", "-q")))


@pytest.mark.torch
def test_bench_paper(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "paper", data, "--quick", "--epochs", "1", "--protocol", "equal", "--feature"]
    words += ["interval:6:99", "--encoding", "fhash", "-o", tmp_path, "--no-latency"]
    check("bench paper", parsed(fhash(*words, "--json", "-q")))
    check("bench paper --parameters", parsed(fhash("bench", "paper", "--parameters", "--json")))


def test_bench_render() -> None:
    check("bench render", json.loads(json.dumps(example(RenderBench).to_dict())))
