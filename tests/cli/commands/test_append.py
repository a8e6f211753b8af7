"""`fhash append`: further steps behind those of a container."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

Fhash = Callable[..., Result]
BOUNDED = ["--max-error", "0.01", "--tile", "2x6x7x8", "--effort", "1", "-q"]


@pytest.fixture
def halves(tmp_path: Path, fhash: Fhash) -> tuple[Path, Path, np.ndarray]:
    """A file of the first 4 steps of a series, the data of the 3 others, and all of it."""
    values = np.cumsum(np.random.default_rng(0).random((7, 6, 7, 8)), axis=3).astype(np.float32)
    np.save(tmp_path / "first.npy", values[:4])
    np.save(tmp_path / "more.npy", values[4:])
    run = tmp_path / "run.fhz"
    assert fhash("encode", tmp_path / "first.npy", "-o", run, *BOUNDED).exit_code == 0
    return run, tmp_path / "more.npy", values


def test_append_and_read(fhash: Fhash, halves: tuple[Path, Path, np.ndarray]) -> None:
    run, more, values = halves
    result = fhash("append", run, more, "-q")
    assert result.exit_code == 0, result.stderr
    assert "7: 4 kept, 3 appended" in result.stdout
    np.save(more.with_name("all.npy"), values)
    assert fhash("diff", more.with_name("all.npy"), run, "--max-error", "0.01").exit_code == 0
    assert fhash("verify", run).exit_code == 0
    assert "7" in fhash("info", run).stdout


def test_steps_are_replaced(fhash: Fhash, halves: tuple[Path, Path, np.ndarray]) -> None:
    run, more, _ = halves
    result = json.loads(fhash("append", run, more, "--keep", "2", "--json", "-q").stdout)
    assert (result["steps"], result["kept"], result["appended"]) == (5, 2, 3)


def test_unsuitable_files_are_refused(
    refused: Callable[..., str], run: Path, halves: tuple[Path, Path, np.ndarray]
) -> None:
    _, more, values = halves
    np.save(run.with_name("other.npy"), values[:, :5])
    assert "shape (z, y, x)" in refused(2, "append", halves[0], run.with_name("other.npy"), "-q")
    assert "no such file" in refused(2, "append", run.with_name("none.fhz"), more, "-q")
