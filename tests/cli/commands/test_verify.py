"""`fhash verify`: counts the arrays of a sound file, and finds a damaged one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

PAPER = ["--profile", "paper", "--epochs", "1", "--width", "4", "--quiet"]
Fhash = Callable[..., Result]


def test_verify_counts_the_arrays(fhash: Fhash, run: Path) -> None:
    result = fhash("verify", run, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    arrays = json.loads(fhash("info", run, "--json").stdout)["arrays"]
    assert json.loads(result.stdout) == {"path": str(run), "sound": True, "arrays": len(arrays)}
    assert fhash("verify", run).stdout == f"{run}: sound, {len(arrays)} arrays checked\n"


@pytest.mark.parametrize("place", [0.02, 0.3, 0.5, 0.7, 0.9])
def test_a_flipped_bit_is_found(
    refused: Callable[..., str], run: Path, tmp_path: Path, place: float
) -> None:
    damaged = bytearray(run.read_bytes())
    damaged[int(len(damaged) * place)] ^= 16
    (tmp_path / "bad.fhz").write_bytes(damaged)
    assert str(tmp_path / "bad.fhz") in refused(4, "verify", tmp_path / "bad.fhz")
