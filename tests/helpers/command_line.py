"""Fixtures: a tiny series, a container made from it, and the command line in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result
from folders import listing
from json_schemas import hold

SHAPE = (3, 6, 7, 8)
SMALL = ["--effort", "1", "--quiet"]
"""Settings that make an encoding of the tiny series a matter of milliseconds."""

Fhash = Callable[..., Result]
Refused = Callable[..., str]


def invoke(*words: object) -> Result:
    from fhash_cli.main import program

    texts = [str(word) for word in words]
    result = CliRunner().invoke(program, texts, prog_name="fhash")
    hold(texts, result)
    return result


def tiny_values() -> np.ndarray:
    """A blob that moves along x, (t, z, y, x) float32; too uneven for labels."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return (
        1 + 9 * np.exp(-((z - 2.48) ** 2 + (y - 3.03) ** 2 + (x - 2.01 - 1.98 * t) ** 2) / 6)
    ).astype(np.float32)


def write_tiny(path: Path) -> None:
    with h5py.File(path, "w") as file:
        data = file.create_dataset("density", data=tiny_values())
        data.attrs["units"] = "kg m-3"
        for number, (name, values) in enumerate(
            {
                "time": [0.0, 1.0, 4.0],
                "z": np.arange(6) * 0.5,
                "y": np.arange(7.0),
                "x": 10 - np.arange(8.0),
            }.items()
        ):
            scale = file.create_dataset(name, data=np.asarray(values, dtype=float))
            scale.make_scale(name)
            data.dims[number].attach_scale(scale)


@pytest.fixture
def fhash() -> Fhash:
    """Runs a command line: fhash("info", path).exit_code, .stdout, .stderr."""
    return invoke


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny series as HDF5, with uneven times and x descending."""
    path = tmp_path_factory.mktemp("data") / "tiny.h5"
    write_tiny(path)
    return path


@pytest.fixture(scope="session")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of part of the tiny series, with vertices outside the coreset."""
    path = tmp_path_factory.mktemp("run") / "tiny.fhz"
    result = invoke(
        "encode", data, "-o", path, "--feature", "interval:4:99", "--dilation", "0", *SMALL
    )
    assert result.exit_code == 0, result.stderr
    return path


@pytest.fixture
def refused(tmp_path: Path) -> Refused:
    """Runs a command line that must fail with an exit code, one line on stderr and no trace.

    The line is returned without 'fhash: error: '.
    """

    def check(code: int, *words: object) -> str:
        before = listing(tmp_path)
        result = invoke(*words)
        assert result.exit_code == code, result.output
        assert result.stdout == ""
        assert len(result.stderr.splitlines()) == 1, result.stderr
        assert result.stderr.startswith("fhash: error: ")
        assert "Traceback" not in result.stderr
        assert "please report" not in result.stderr
        assert listing(tmp_path) == before
        return result.stderr.removeprefix("fhash: error: ").rstrip("\n")

    return check
