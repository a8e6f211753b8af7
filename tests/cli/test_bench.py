"""`fhash bench train`: figures for the engines asked for, and the machine they were taken on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from click.testing import Result

Fhash = Callable[..., Result]


def test_bench_train_measures_each_engine(fhash: Fhash, data: Path) -> None:
    result = fhash("bench", "train", data, "--seconds", "0.3", "--width", "4", "--json", "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert sorted(entry["engine"] for entry in report["engines"]) == ["naive", "slab"]
    for entry in report["engines"]:
        assert entry["train_msamples_s"] > 0
        assert entry["infer_msamples_s"] > 0
        assert 0 < entry["fraction_of_peak"] < 1
    assert {"cores", "torch", "device"} <= set(report["machine"])


def test_bench_train_prints_a_table(fhash: Fhash, data: Path) -> None:
    result = fhash("bench", "train", data, "--seconds", "0.2", "--engines", "slab", "--width", "4", "-q")
    assert result.exit_code == 0
    header, row, _ = result.stdout.splitlines()
    assert header.startswith("engine")
    assert row.startswith("slab")
