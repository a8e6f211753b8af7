"""`fhash info`: the description of a sound file; every command refuses a damaged one."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import Result

PAPER = ["--profile", "paper", "--epochs", "1", "--width", "4", "--quiet"]
Fhash = Callable[..., Result]


def test_info_says_what_the_file_holds(fhash: Fhash, run: Path) -> None:
    result = fhash("info", run)
    assert (result.exit_code, result.stderr) == (0, "")
    for text in (
        str(run),
        "density, float32, in kg m-3",
        "3 x 6 x 7 x 8",
        "time 0 to 4",
        "x 10 to 3",
        "interval:6:99",
        "compact",
    ):
        assert text in result.stdout


def test_info_of_a_paper_file_says_how_it_was_trained(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    assert fhash("encode", data, "-o", tmp_path / "run.fhz", *PAPER).exit_code == 0
    result = fhash("info", tmp_path / "run.fhz")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "paper" in result.stdout
    assert "1 epochs" in result.stdout


@pytest.mark.filterwarnings("ignore:training diverged")
def test_info_says_that_a_training_diverged(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    wild = [
        "--profile",
        "paper",
        "--epochs",
        "3",
        "--width",
        "64",
        "--hidden-layers",
        "2",
        "--learning-rate",
        "1",
        "--quiet",
    ]
    assert fhash("encode", data, "-o", tmp_path / "run.fhz", *wild).exit_code == 0
    assert (
        "it diverged, and came to its end at a learning rate of 0."
        in fhash("info", tmp_path / "run.fhz").stdout
    )
    assert (
        json.loads(fhash("info", tmp_path / "run.fhz", "--json").stdout)["training"]["restarts"] > 0
    )


def test_info_as_json_is_one_object(fhash: Fhash, run: Path) -> None:
    info = json.loads(fhash("info", run, "--json").stdout)
    assert info["domain"]["shape"] == [3, 6, 7, 8]
    assert info["bytes"] == run.stat().st_size
    assert info["quality"]["rmse"] > 0


@pytest.mark.parametrize("command", ["info", "verify", "decode"])
@pytest.mark.parametrize("kept", [0, 1, 30, 1000, -1])
def test_a_cut_file_is_found(
    refused: Callable[..., str], run: Path, tmp_path: Path, command: str, kept: int
) -> None:
    (tmp_path / "cut.fhz").write_bytes(run.read_bytes()[:kept])
    refused(4, command, tmp_path / "cut.fhz")


@pytest.mark.parametrize("command", ["verify", "decode"])
def test_what_is_no_container_is_refused(
    refused: Callable[..., str], data: Path, tmp_path: Path, command: str
) -> None:
    refused(4, command, data)
    refused(2, command, tmp_path / "missing.fhz")


def test_info_of_data_lists_variables_and_their_commands(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    result = fhash("info", data)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "density: float32, time=3 (t), z=6, y=7, x=8, in kg m-3" in result.stdout
    with h5py.File(tmp_path / "flow data.h5", "w") as file:
        file["flow"] = np.ones((16, 12, 12, 3), "f4")
        file["ensemble"] = np.ones((2, 3, 4, 5, 6), "f4")
    listed = json.loads(fhash("info", tmp_path / "flow data.h5", "--json").stdout)
    ensemble, flow = listed["variables"]
    assert ensemble["dimensions"][0] == {"name": "dim0", "length": 2, "axis": "select"}
    assert [variable["problem"] for variable in (ensemble, flow)] == ["", ""]
    commands = ensemble["commands"] + flow["commands"]
    assert len(commands) == 3
    shapes = []
    for number, command in enumerate(commands):
        words = shlex.split(command)[1:]
        words[words.index("-o") + 1] = str(tmp_path / f"{number}.fhz")
        result = fhash(*words, "--effort", "1", "--quiet", "--json")
        assert result.exit_code == 0, result.stderr
        shapes.append(json.loads(result.stdout)["shape"])
    assert shapes == [[3, 4, 5, 6], [16, 12, 12, 3], [1, 16, 12, 12]]


def test_info_of_data_repeats_what_the_user_said(fhash: Fhash, tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(4 * 5 * 6 * 2))
    said = ["--shape", "x=4,y=5,z=6", "--dtype", "u2", "--missing", "-9", "--missing", "1e20"]
    listed = json.loads(fhash("info", tmp_path / "a.bin", *said, "--json").stdout)
    words = shlex.split(listed["variables"][0]["commands"][0])
    assert words[-8:] == [*said[:-1], "1e+20"]


def test_info_of_data_says_what_cannot_be_encoded(fhash: Fhash, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["line"] = np.ones(4)
        file["bad"] = np.ones((3, 4, 5), "i2")
        file["bad"].attrs["_FillValue"] = "none"
        file["good"] = np.ones((3, 4, 5), "i2")
        file["good"].attrs.update({"_FillValue": np.int16(-9), "valid_min": h5py.Empty("f4")})
        file["good"].attrs["missing_value"] = h5py.Empty("f4")
    assert fhash("info", tmp_path / "a.h5").stdout == (
        f"{tmp_path / 'a.h5'} holds 1 variable to encode\n\n"
        "good: int16, dim0=3 (z), dim1=4 (y), dim2=5 (x), missing where -9\n"
        f"  fhash encode {tmp_path / 'a.h5'} -o good.fhz --var good\n\n"
        "not to be encoded:\n"
        "  bad: the fill value 'none' is not a number; --raw-values reads the numbers as they are"
        " stored\n"
        "\nbelow 3 dimensions: line (4,)\n"
    )


def test_info_of_no_data_is_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "does not exist" in refused(2, "info", tmp_path / "missing.h5")
    (tmp_path / "a.txt").write_text("words")
    assert "no format that can be read" in refused(2, "info", tmp_path / "a.txt")


def test_options_for_data_are_refused_for_a_run(refused: Callable[..., str], run: Path) -> None:
    for words, name in ((["--var", "q"], "--var"), (["--missing", "-9"], "--missing")):
        assert f"is encoded already; {name} is for data" in refused(2, "info", run, *words)
    assert "--raw-values is for data" in refused(2, "info", run, "--raw-values")
