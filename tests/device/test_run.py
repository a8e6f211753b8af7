"""The script for a machine with a GPU runs, here on the processor and without zarr."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

import fhash_codec

SCRIPT = Path(__file__).parent / "run.py"
WITHOUT_ZARR = """
import runpy, sys
for name in ("zarr", "numcodecs", "xarray", "h5netcdf"):
    sys.modules[name] = None
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_parts_that_need_no_files_run_without_zarr(tmp_path) -> None:
    words = [str(SCRIPT), str(tmp_path), "--device", "cpu", "--quick"]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_ZARR, *words, "--parts", "speed,points,pictures,selftest"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["machine"]["device"] == "cpu"
    models = [result["model"] for result in figures["speed"]["figures"]]
    assert models == ["64x1", "64x2"]
    assert all(result["train_msamples_s"] > 0 for result in figures["speed"]["figures"])
    assert len(figures["points"]["figures"]) == 6
    assert all(result["host_slopes_mpoints_s"] > 0 for result in figures["points"]["figures"])
    for name in ("pictures", "selftest"):
        assert "zarr" in figures[name]["figures"]["left_out"]


def test_a_part_that_fails_is_recorded_and_the_others_run(tmp_path) -> None:
    """A folder in the place of the series' file is an error of that part alone."""
    (tmp_path / "front.npy").mkdir()
    words = [str(tmp_path), "--device", "cpu", "--quick", "--parts", "pictures,speed"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["pictures"]["figures"]["error"].startswith("IsADirectoryError")
    assert figures["speed"]["figures"]


def test_a_working_tree_that_is_not_installed_is_described(tmp_path) -> None:
    folder = runpy.run_path(str(SCRIPT))["described"](tmp_path / "site")
    found = list(distributions(path=[str(folder)]))
    assert {(each.name, each.version) for each in found} == {
        (name, fhash_codec.__version__) for name in ("fhash", "fhash-bench")
    }
    names = {(point.group, point.name) for each in found for point in each.entry_points}
    assert {("zarr.codecs", "fhash.transform"), ("fhash.commands", "bench")} <= names
