"""AddressSanitizer watches the emulated kernels: none reads or writes beyond an array."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.torch, pytest.mark.every]

TRIAL = Path(__file__).parent / "bounds_trial.py"


@pytest.fixture
def trial(library_folder):
    """A function of the trial's arguments: the finished process."""
    found = subprocess.run(
        ["g++", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True
    )
    sanitizer = found.stdout.strip()
    if not Path(sanitizer).is_absolute():
        pytest.skip("g++ has no AddressSanitizer here")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        paths = [str(TRIAL.parent), *filter(None, sys.path)]
        return subprocess.run(
            [sys.executable, str(TRIAL), str(library_folder), *arguments],
            capture_output=True,
            text=True,
            check=False,
            env={
                **os.environ,
                "LD_PRELOAD": sanitizer,
                "ASAN_OPTIONS": "detect_leaks=0",
                "PYTHONPATH": os.pathsep.join(paths),
            },
        )

    return run


@pytest.mark.parametrize("kernels", ["bricks", "between", "points"])
def test_kernels_stay_within_their_arrays(trial, kernels) -> None:
    done = trial(kernels, "2")
    assert done.stdout.strip() == "done", done.stderr[-3000:]


@pytest.mark.parametrize(
    ("kernels", "old", "new"),
    [
        ("bricks", "model.fine_square[place] = square", "model.fine_square[place + 2] = square"),
        (
            "bricks",
            "at.slopes[LATTICE_AT[level] + i] += sum",
            "at.slopes[AT_END - AT_SLOPES + i % 4] += sum",
        ),
        ("points", "level.scale[a] - 1. : 0.", "level.scale[a] : 0."),
        ("points", "level.words[bit >> 6]", "level.words[(bit >> 6) + 1]"),
        (
            "points",
            "tile.parts[(share * 3 + a) * COLUMNS + own]",
            "tile.parts[AT_END - AT_PARTS + a]",
        ),
    ],
    ids=["the device's memory", "shared memory", "a table", "a bitmap", "shared memory of points"],
)
def test_an_access_beyond_an_array_is_seen(trial, kernels, old, new) -> None:
    done = trial(kernels, "1", old, new)
    assert done.returncode != 0
    assert "AddressSanitizer: heap-buffer-overflow" in done.stderr
