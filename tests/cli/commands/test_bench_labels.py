"""`fhash bench labels`: a table of sizes for made series and for data of one's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from click.testing import Result

Fhash = Callable[..., Result]


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
