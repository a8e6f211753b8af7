"""The program as a whole: help, exit codes, and that nothing but one line comes out when something goes wrong."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from click.testing import Result

import fhash_codec
from fhash_cli.main import COMMANDS

Fhash = Callable[..., Result]
MAIN = [sys.executable, "-m", "fhash_cli.main"]


def test_help_lists_every_command(fhash: Fhash) -> None:
    result = fhash("--help")
    assert result.exit_code == 0
    for name, line in COMMANDS.items():
        assert name in result.stdout
        assert line in result.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_file_and_help(fhash: Fhash, name: str) -> None:
    command = importlib.import_module(f"fhash_cli.{name}").command
    assert isinstance(command, click.Command)
    assert command.name == name
    result = fhash(name, "--help")
    assert result.exit_code == 0
    assert result.stdout.startswith(f"Usage: fhash {name}")


def test_version(fhash: Fhash) -> None:
    assert fhash("--version").stdout == f"fhash {fhash_codec.__version__}\n"


def test_without_a_command_help_goes_to_stderr(fhash: Fhash) -> None:
    result = fhash()
    assert (result.exit_code, result.stdout) == (2, "")
    assert "Commands:" in result.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["enode"], "No such command 'enode'"),
        (["encode"], "Missing argument 'DATA' (see 'fhash encode --help')"),
        (["encode", "x"], "Missing option '-o'"),
        (["info", "x", "--jsn"], "No such option"),
        (["info", "x", "y"], "unexpected extra argument"),
        (["bench", "train", "x", "--engines", "slab,fast"], "'fast' is no engine; allowed, separated by commas: slab, naive"),
    ],
)
def test_usage_errors_are_one_line(refused: Callable[..., str], words: list[str], message: str) -> None:
    assert message in refused(2, *words)


def test_ctrl_c_is_one_line_and_130(fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fhash_codec.Volume, "read", stopped)
    result = fhash("decode", run)
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "fhash: error: interrupted\n")


def test_an_error_of_ours_asks_for_a_report_and_shows_its_origin_only_on_request(
    fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setattr(fhash_codec.Volume, "read", broken)
    result = fhash("decode", run)
    assert result.exit_code == 1
    assert result.stderr == (
        "fhash: error: unexpected ZeroDivisionError: by zero; please report this (FHASH_DEBUG=1 shows where it came from)\n"
    )
    monkeypatch.setenv("FHASH_DEBUG", "1")
    assert "Traceback" in fhash("decode", run).stderr


def test_a_pipe_that_closes_ends_quietly(run: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([*MAIN, "info", run], stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_full_stdout_is_one_line(run: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*MAIN, "info", run], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "fhash: error: No space left on device\n")


def test_info_loads_nothing_slow(run: Path) -> None:
    code = (
        "import sys\nfrom fhash_cli.main import program\n"
        "for words in (['info', sys.argv[1]], ['verify', sys.argv[1]], ['decode', sys.argv[1], '--t', '0']):\n"
        "    try:\n        program(words)\n    except SystemExit as end:\n        assert not end.code\n"
        "print([name for name in ('torch', 'xarray', 'zarr', 'h5py', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, run], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
