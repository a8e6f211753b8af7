"""`fhash verify` and `fhash diff`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import Result

Fhash = Callable[..., Result]


@pytest.mark.parametrize("place", [0.02, 0.3, 0.5, 0.7, 0.9])
def test_a_flipped_bit_is_found(
    refused: Callable[..., str], run: Path, tmp_path: Path, place: float
) -> None:
    damaged = bytearray(run.read_bytes())
    damaged[int(len(damaged) * place)] ^= 16
    (tmp_path / "bad.fhz").write_bytes(damaged)
    assert str(tmp_path / "bad.fhz") in refused(4, "verify", tmp_path / "bad.fhz")


SMALL = ["--effort", "1", "--quiet"]


@pytest.fixture(scope="module")
def report(data: Path, run: Path) -> dict[str, float]:
    from click.testing import CliRunner

    from fhash_cli.main import program

    result = CliRunner().invoke(program, ["diff", str(data), str(run), "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def test_diff_agrees_with_what_the_encoder_measured(
    fhash: Fhash, run: Path, report: dict[str, float]
) -> None:
    stored = json.loads(fhash("info", run, "--json").stdout)["quality"]
    for name in ("psnr", "rmse", "max_abs_error", "psnr_domain"):
        # The file has six digits of the figure, rounded to the worse side.
        assert report[name] == pytest.approx(stored[name], rel=1e-5)
        assert (report[name] >= stored[name]) == name.startswith("psnr")


@pytest.mark.parametrize(
    ("gate", "figure", "sign"), [("--min-psnr", "psnr", 1), ("--max-error", "max_abs_error", -1)]
)
def test_a_gate_closes_just_beyond_the_figure(
    fhash: Fhash, data: Path, run: Path, report: dict[str, float], gate: str, figure: str, sign: int
) -> None:
    assert fhash("diff", data, run, gate, report[figure] - sign * 1e-6).exit_code == 0
    missed = fhash("diff", data, run, gate, report[figure] + sign * 1e-6, "--json")
    assert missed.exit_code == 3
    assert json.loads(missed.stdout)[figure] == report[figure]
    assert len(missed.stderr.splitlines()) == 1


def test_an_exact_file_passes_every_gate(fhash: Fhash, tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.full((2, 3, 4, 5), 7.0, dtype=np.float32))
    assert fhash("encode", tmp_path / "flat.npy", "-o", tmp_path / "run.fhz", *SMALL).exit_code == 0
    result = fhash(
        "diff", tmp_path / "flat.npy", tmp_path / "run.fhz", "--min-psnr", "200", "--max-error", "0"
    )
    assert (result.exit_code, result.stderr) == (0, "")
    assert "PSNR, coreset   exact" in result.stdout


@pytest.mark.parametrize(
    ("figures", "words", "missed"),
    [
        (
            {"psnr": None, "rmse": 0.0, "max_abs_error": 0.0},
            ["--min-psnr", "200", "--max-error", "0"],
            "",
        ),
        (
            {"psnr": None, "rmse": 0.1, "max_abs_error": 0.1},
            ["--min-psnr", "1"],
            "no PSNR is defined in the coreset; at least 1 dB",
        ),
        (
            {"psnr": None, "rmse": None, "max_abs_error": None},
            ["--min-psnr", "1"],
            "no PSNR is defined in the coreset",
        ),
        (
            {"psnr": None, "rmse": None, "max_abs_error": None},
            ["--max-error", "1"],
            "no value can be compared in the coreset; at most 1",
        ),
    ],
)
def test_a_figure_that_is_not_defined_meets_no_gate(
    fhash: Fhash,
    data: Path,
    run: Path,
    report: dict[str, float],
    monkeypatch: pytest.MonkeyPatch,
    figures: dict[str, float | None],
    words: list[str],
    missed: str,
) -> None:
    monkeypatch.setattr("fhash_codec.diff", lambda *_, **__: {**report, **figures})
    result = fhash("diff", data, run, *words)
    assert result.exit_code == (3 if missed else 0)
    assert missed in result.stderr
    assert len(result.stderr.splitlines()) == bool(missed)


def test_a_missing_value_is_told_of_where_it_is_forgotten(fhash: Fhash, tmp_path: Path) -> None:
    values = np.arange(60.0, dtype=np.float32).reshape(1, 3, 4, 5)
    values[0, 0, 0, 0] = -999
    np.save(tmp_path / "a.npy", values)
    data, run = tmp_path / "a.npy", tmp_path / "a.fhz"
    words = ["--effort", "1", "--max-error", "1"]
    result = fhash("encode", data, "-o", run, *words, "--missing", "-999", "--missing", "5.5")
    assert result.exit_code == 0
    assert f"--missing 5.5: {data} holds no such value" in result.stderr
    assert "-999" not in result.stderr
    assert "missing where the source had -999" in fhash("info", run).stdout
    said = f"{run} was encoded with --missing -999"
    assert said in fhash("diff", data, run).stderr
    assert said not in fhash("diff", data, run, "--missing", "-999").stderr
    assert said not in fhash("diff", data, run, "--quiet").stderr


def both(path: Path, **changes: dict[str, str]) -> Path:
    with h5py.File(path, "w") as file:
        for number, name in enumerate(["flow/u", "flow/w"]):
            data = file.create_dataset(name, data=np.full((2, 3, 4, 5), number, "f4"))
            data.attrs["units"] = changes.get("units", "m/s")
        scale = file.create_dataset("flow/x", data=changes.get("x", np.arange(5.0) + 2))
        file["flow/u"].dims[3].attach_scale(scale)
        file["flow/w"].dims[3].attach_scale(scale)
    return path


def test_the_variable_is_that_of_the_container(fhash: Fhash, tmp_path: Path) -> None:
    data, run = both(tmp_path / "a.h5"), tmp_path / "w.fhz"
    assert fhash("encode", data, "--var", "w", "-o", run, *SMALL).exit_code == 0
    result = fhash("diff", data, run, "--max-error", "0", "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert json.loads(result.stdout)["differences"] == []


def test_differences_beside_the_values_are_told(
    fhash: Fhash, refused: Callable[..., str], tmp_path: Path
) -> None:
    data, run = both(tmp_path / "a.h5"), tmp_path / "w.fhz"
    assert fhash("encode", data, "--var", "w", "-o", run, *SMALL).exit_code == 0
    result = fhash("diff", data, run, "--var", "u")
    assert result.exit_code == 0
    assert "are of the variable u" in result.stderr
    other = both(tmp_path / "b.h5", units="km/h", x=np.arange(5.0))
    assert fhash("diff", other, run).stderr.splitlines() == [
        f"fhash: {other}: the data are in km/h, {run} in m/s"
    ]
    moved = both(tmp_path / "c.h5", x=np.arange(5.0) + 1)
    lines = json.loads(fhash("diff", moved, run, "--json").stdout)["differences"]
    assert lines == [f"the data have other positions along x than {run} (1 to 5, not 2 to 6)"]
    np.save(tmp_path / "named.npy", np.full((2, 3, 4, 5), 1, "f4"))
    assert fhash("diff", tmp_path / "named.npy", run).stderr == ""
    with h5py.File(data, "a") as file:
        file["other/w"] = file["flow/w"][...]
    assert "choose one with --var" in refused(2, "diff", data, run)
