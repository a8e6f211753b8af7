"""`fhash bench ablate`: tables of a series of one's own, kept runs, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import Result

from fhash_bench import engines as clock
from fhash_bench import train as bench
from fhash_bench.rate import generated as made
from fhash_codec.native.network import machine_paths

Fhash = Callable[..., Result]


@pytest.fixture
def data_bench_ablate(tmp_path: Path) -> Path:
    path = tmp_path / "waves.npy"
    np.save(path, np.sin(np.indices((3, 6, 8, 10))[3] * 0.3).astype("f4"))
    return path


def test_a_table_has_a_row_for_each_variation(
    fhash: Fhash, data_bench_ablate: Path, tmp_path: Path
) -> None:
    arguments = ("bench", "ablate", data_bench_ablate, "--axis", "fringe", "--epochs", "1", "-q")
    result = fhash(*arguments, "-o", tmp_path / "runs", "--plot", tmp_path / "p.png")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert lines[0].startswith("fringe: ")
    assert [line.split()[1] for line in lines[2:4]] == ["trained", "untrained"]
    assert "--fringe trained *" in lines[2]
    assert (tmp_path / "p.png").stat().st_size > 1000
    kept = list((tmp_path / "runs").iterdir())
    assert len(kept) == 2
    again = fhash(*arguments, "-o", tmp_path / "runs", "--json")
    assert [row["settings"]["fringe"] for row in json.loads(again.stdout)["rows"]] == [
        "trained",
        "untrained",
    ]


def test_unsuitable_options_are_refused(
    refused: Callable[..., str], data_bench_ablate: Path, tmp_path: Path
) -> None:
    assert "unknown axis 'tiles'" in refused(
        2, "bench", "ablate", data_bench_ablate, "--axis", "tiles"
    )
    assert "--var is for DATA" in refused(2, "bench", "ablate", "--var", "a")
    missing = tmp_path / "no" / "where"
    assert "give a folder that exists" in refused(
        2, "bench", "ablate", data_bench_ablate, "--axis", "fringe", "-o", missing
    )


WORDS = ("bench", "train", "--seconds", "0.1", "--width", "4", "--hidden-layers", "1", "-q")


@pytest.fixture(autouse=True)
def steady(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clocks that advance by 10 ms whenever they are read."""
    ticks = count()
    read = lambda: next(ticks) / 100  # noqa: E731
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=read, process_time=read))
    monkeypatch.setattr(bench, "INFER_SECONDS", 0.03)


def test_it_measures_each_engine(fhash: Fhash, data: Path) -> None:
    result = fhash(*WORDS, data, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    (series,) = report["series"]
    expected = {"slab"} | ({"native"} if machine_paths() else set())
    assert {entry["engine"] for entry in series["engines"]} == expected
    assert {"cores", "device"} <= set(report["machine"])


def test_it_prints_a_row_for_each_engine_and_draws_curves(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "curves.png"
    words = (*WORDS, data, "--engines", "native,slab", "--bricks-per-step", "1", "--plot", picture)
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    facts, header, *rows = result.stdout.splitlines()
    assert facts.startswith("all: ")
    assert "1 bricks a step" in facts
    assert header.split()[:2] == ["engine", "threads"]
    assert "CPU s to 50 dB" in header
    engines = [row.split()[0] for row in rows if row]
    assert list(dict.fromkeys(engines))[:2] == ["native", "slab"]
    assert any(row.startswith("points, M per CPU s: rays ") for row in rows)
    assert any("times as fast as the whole box" in row for row in rows)
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = fhash(*words)
    assert again.exit_code != 0
    assert "--force" in again.stderr


def test_a_series_is_made_where_none_is_given(
    fhash: Fhash, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {key: replace(it, shape=(2, 8, 16, 16)) for key, it in made.MADE.items()}
    monkeypatch.setattr(made, "MADE", small)
    words = (*WORDS, "--engines", "slab", "--json")
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    features = [entry["features"] for entry in json.loads(result.stdout)["series"]]
    assert features == [["interval:0.25:2"], ["all"]]
    argon = json.loads(fhash(*words, "generated:argon").stdout)["series"]
    assert [entry["features"] for entry in argon] == [["all"]]
    refused = fhash(*words, "--var", "velocity")
    assert refused.exit_code == 2
    assert refused.stderr == "fhash: error: --var is for DATA that are read; name them\n"


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--engines", "fast"), "'fast' is no engine"),
        (("--bricks-per-step", "64,x"), "'x' is no number of bricks"),
        (("--bricks-per-step", "0"), "'0' is no number of bricks"),
    ],
)
def test_unsuitable_options_are_refused_bench_train(
    fhash: Fhash, option: tuple[str, str], message: str
) -> None:
    refused = fhash(*WORDS, *option)
    assert refused.exit_code == 2
    assert message in refused.stderr
