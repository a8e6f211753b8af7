"""The command line on URLs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

Fhash = Callable[..., Result]


@pytest.fixture
def url(run: Path, range_server) -> str:
    return range_server.put("run.fhz", run.read_bytes())


def told(result: Result) -> dict:
    assert (result.exit_code, result.stderr) == (0, ""), result.output
    return json.loads(result.stdout)


def test_info(fhash: Fhash, run: Path, url: str) -> None:
    here, there = told(fhash("info", run, "--json")), told(fhash("info", url, "--json"))
    assert there["path"] == url
    assert {**there, "path": ""} == {**here, "path": ""}
    assert url in fhash("info", url).stdout


def test_decode(fhash: Fhash, run: Path, url: str, tmp_path: Path) -> None:
    for place, name in ((run, "here"), (url, "there")):
        told(fhash("decode", place, "-o", tmp_path / f"{name}.npy", "--json", "--quiet"))
    np.testing.assert_array_equal(np.load(tmp_path / "there.npy"), np.load(tmp_path / "here.npy"))
    assert told(fhash("decode", url, "--t", "1", "--json", "--quiet"))["paths"] == []


def test_a_local_url_is_not_overwritten(fhash: Fhash, run: Path) -> None:
    before = run.read_bytes()
    result = fhash("export", f"file://{run}", "--plain", "-o", run, "--force")
    assert result.exit_code == 2
    assert "is the input itself" in result.stderr
    assert run.read_bytes() == before


@pytest.mark.parametrize("command", ["info", "decode", "render", "verify"])
def test_errors_are_one_line(refused: Callable[..., str], url: str, command: str) -> None:
    missing = url.replace("run", "none")
    assert f"{missing}: no such file" in refused(2, command, missing)
    assert "nowhere" in refused(2, command, "nowhere://run.fhz")
