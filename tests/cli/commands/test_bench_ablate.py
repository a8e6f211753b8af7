"""`fhash bench ablate`: tables of a series of one's own, kept runs, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

Fhash = Callable[..., Result]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    path = tmp_path / "waves.npy"
    np.save(path, np.sin(np.indices((3, 6, 8, 10))[3] * 0.3).astype("f4"))
    return path


def test_a_table_has_a_row_for_each_variation(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    arguments = ("bench", "ablate", data, "--axis", "fringe", "--epochs", "1", "-q")
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
    refused: Callable[..., str], data: Path, tmp_path: Path
) -> None:
    assert "unknown axis 'tiles'" in refused(2, "bench", "ablate", data, "--axis", "tiles")
    assert "--var is for DATA" in refused(2, "bench", "ablate", "--var", "a")
    missing = tmp_path / "no" / "where"
    assert "give a folder that exists" in refused(
        2, "bench", "ablate", data, "--axis", "fringe", "-o", missing
    )
