"""Dates on the command line: `--time DATE`, the rows of `info` and `decode`, and their errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import Result

Fhash = Callable[..., Result]


@pytest.fixture(scope="module")
def dated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of four steps of six hours, made of four files that count from their own day."""
    import fhash_codec
    from fhash_formats import open_series

    folder = tmp_path_factory.mktemp("dated")
    for step in range(4):
        with h5py.File(folder / f"s{step}.h5", "w") as file:
            file["u"] = np.full((3, 4, 5), step, "f4") + np.arange(5, dtype="f4")
            file["time"] = [0.25 * step - (0 if step < 2 else 0.5)]
            start = "2001-02-10" if step < 2 else "2001-02-10 12:00"
            file["time"].attrs["units"] = f"days since {start}"
    with open_series(folder / "s*.h5") as series:
        fhash_codec.encode(series, folder / "run.fhz", fhash_codec.EncodeConfig(effort=1))
    return folder / "run.fhz"


def test_info_prints_dates(fhash: Fhash, dated: Path) -> None:
    text = fhash("info", dated).stdout
    assert "time 2001-02-10 to 2001-02-10T18:00 (0 to 0.75 days since 2001-02-10)" in text


@pytest.mark.parametrize(
    ("time", "step"), [("2001-02-10T06:00", 1), ("2001-02-10 09:00", 1.5), ("2001-02-10", 0)]
)
def test_decode_takes_dates(fhash: Fhash, dated: Path, time: str, step: float) -> None:
    text = fhash("decode", dated, "--time", time).stdout
    rows = dict(line.split(None, 1) for line in text.splitlines())
    assert rows["steps"] == f"{step:g}"
    assert rows["dates"] == f"2001-02-10T{6 * step:02.0f}:00".replace("T00:00", "")


def test_render_takes_dates(fhash: Fhash, dated: Path, tmp_path: Path) -> None:
    words: list[Any] = ["--size", "64x64", "-o", tmp_path / "a.png", "--time", "2001-02-10T06:00"]
    result = fhash("render", dated, *words)
    assert "1, t = 2001-02-10T06:00" in result.stdout
    assert (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ("2001-02-11", "time 2001-02-11 is outside the series, 2001-02-10 to 2001-02-10T18:00"),
        ("7", "time 7 is outside the series, 2001-02-10 to 2001-02-10T18:00 (0 to 0.75 days"),
        ("2001-02-30", "'2001-02-30' is no date of the calendar standard"),
        ("noon", "'noon' is no date; write it as 2001-02-10, 2001-02-10T06:00 or 2001-02"),
    ],
)
@pytest.mark.parametrize("command", ["decode", "render"])
def test_errors_name_the_range_in_dates(
    fhash: Fhash, command: str, time: str, message: str, dated: Path, tmp_path: Path
) -> None:
    output = tmp_path / ("a.png" if command == "render" else "a.npy")
    result = fhash(command, dated, "--time", time, "-o", output)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not output.exists()
