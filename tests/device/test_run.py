"""The script for a machine with a GPU runs, here on the processor."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

import pytest

import fhash_codec

SCRIPT = Path(__file__).parent / "run.py"
ROOT = SCRIPT.parents[2]
HANGS = """    yield {"done": 1}
    time.sleep(60)
    random, batches ="""


@pytest.mark.torch
def test_the_parts_run_without_zarr(tmp_path) -> None:
    words = [str(SCRIPT), str(tmp_path), "--device", "cpu", "--quick"]
    done = subprocess.run(
        [sys.executable, *words, "--parts", "pictures,oracle,head,speed,curve,card"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(without_zarr(tmp_path))},
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    rates = [rate for row in figures["speed"]["figures"] for rate in row["train"].values()]
    assert len(rates) == 5
    assert min(rates) > 0
    assert all(row["epochs"] == 1 for row in figures["curve"]["figures"])
    commands = [row["command"] for row in figures["card"]["figures"]]
    encodes = ["encode, default", "encode, sparse keys", "encode"]
    assert commands == [*encodes, "diff", "arm", "stream", "arm", "film"]
    drawn = figures["pictures"]["figures"]
    assert len([row for row in drawn if "scene" in row]) == 20
    assert len([row for row in drawn if "film_pictures_s" in row]) == 2
    assert {row["keys"] for row in figures["oracle"]["figures"]} == {"all", "0,3"}
    assert all(row["cpu_updates_s"] > 0 for row in figures["head"]["figures"])


def without_zarr(folder: Path) -> Path:
    """Return a folder whose zarr cannot be imported."""
    modules = folder / "modules"
    modules.mkdir()
    (modules / "zarr.py").write_text("raise ModuleNotFoundError('no zarr', name='zarr')")
    return modules


def test_a_part_that_hangs_is_stopped_and_keeps_what_it_has(tmp_path) -> None:
    """The result before the hang stays; a part for which no time is left says so."""
    script = tmp_path / "run.py"
    lines = SCRIPT.read_text().replace("parents[2]", f"parents[2] and Path({str(ROOT)!r})")
    lines = lines.replace("    random, batches =", HANGS)
    lines = lines.replace("(head, 30.0)", "(head, 3.0)").replace(
        "(selftest, 150.0)", "(selftest, 0)"
    )
    script.write_text(lines)
    words = [str(tmp_path), "--device", "cpu", "--quick", "--parts", "head,selftest"]
    done = subprocess.run([sys.executable, str(script), *words], capture_output=True, check=False)
    assert done.returncode == 1
    figures = json.loads((tmp_path / "figures.json").read_text())
    first, last = figures["head"]["figures"]
    assert first == {"done": 1}
    assert last["failed"] == "stopped after 3 seconds"
    assert "left out" in figures["selftest"]["figures"][0]["failed"]


def test_a_working_tree_that_is_not_installed_is_described(tmp_path) -> None:
    folder = runpy.run_path(str(SCRIPT))["described"](tmp_path / "site")
    found = list(distributions(path=[str(folder)]))
    assert {(each.name, each.version) for each in found} == {
        (name, fhash_codec.__version__) for name in ("fhash", "fhash-bench")
    }
    names = {(point.group, point.name) for each in found for point in each.entry_points}
    assert {("zarr.codecs", "fhash.transform"), ("fhash.commands", "bench")} <= names
