"""The program: help, exit codes, and one line on stderr for any error."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import click
import numpy as np
import pytest
import xarray as xr
from command_line import Fhash

import fhash_codec
from fhash_cli.main import COMMANDS, program

MAIN = [sys.executable, "-m", "fhash_cli.main"]


def test_help_lists_every_command(fhash: Fhash) -> None:
    result = fhash("--help")
    assert result.exit_code == 0
    for name, line in COMMANDS.items():
        assert name in result.stdout
        assert line in " ".join(result.stdout.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_file_and_help(fhash: Fhash, name: str) -> None:
    command = program.get_command(click.Context(program), name)
    assert isinstance(command, click.Command)
    assert command.name == name
    result = fhash(name, "--help")
    assert result.exit_code == 0
    assert result.stdout.startswith(f"Usage: fhash {name}")


def test_a_command_of_a_distribution_that_is_missing_says_what_to_install(
    fhash: Fhash, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line, whatever the words; the shell still completes the name."""
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    for words in ([], ["--help"], ["rate", "run.npy", "--target", "40"]):
        result = fhash("bench", *words)
        assert (result.exit_code, result.stdout) == (2, "")
        assert len(result.stderr.splitlines()) == 1
        assert "pip install 'fhash[bench]'" in result.stderr
    found = program.shell_complete(click.Context(program), "b")
    assert [item.value for item in found] == ["bench"]


def test_version(fhash: Fhash) -> None:
    assert fhash("--version").stdout == f"fhash {fhash_codec.__version__}\n"


def test_without_a_command_help_goes_to_stderr(fhash: Fhash) -> None:
    result = fhash()
    assert (result.exit_code, result.stdout) == (2, "")
    assert "Start here:" in result.stderr


def test_ctrl_c_is_one_line_and_130(
    fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fhash_codec.Volume, "read_steps", stopped)
    result = fhash("decode", run)
    assert (result.exit_code, result.stdout, result.stderr) == (
        130,
        "",
        "fhash: error: interrupted\n",
    )


def test_an_error_of_ours_asks_for_a_report_and_shows_its_origin_only_on_request(
    fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setattr(fhash_codec.Volume, "read_steps", broken)
    result = fhash("decode", run)
    assert result.exit_code == 1
    assert result.stderr == (
        "fhash: error: unexpected ZeroDivisionError: by zero; please report this"
        " (FHASH_DEBUG=1 shows where it came from)\n"
    )
    monkeypatch.setenv("FHASH_DEBUG", "1")
    assert "Traceback" in fhash("decode", run).stderr


def test_a_pipe_that_closes_ends_quietly(run: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*MAIN, "info", run], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_full_stdout_is_one_line(run: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*MAIN, "info", run], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (1, "fhash: error: No space left on device\n")


SLOW = {"torch", "xarray", "pandas", "scipy", "zarr", "dask", "matplotlib", "asyncio", "http"}
"""Libraries and modules that cost more time than a command that has no need of them."""
NEVER = {
    "--help": {*SLOW, "h5py", "PIL", "numpy"},
    "info run.fhz": {*SLOW, "h5py", "PIL", "fhash_codec.paper", "fhash_formats.readers"},
    "verify run.fhz": {*SLOW, "h5py", "PIL", "fhash_formats.readers"},
    "decode run.fhz --t 0 -o step.npy": {*SLOW, "h5py", "PIL", "fhash_formats.readers"},
    "render run.fhz -o picture.png --size 16x16": {*SLOW, "h5py", "fhash_formats.readers"},
    "info classic.nc": {*SLOW, "h5netcdf", "PIL"},
    "info new.nc": {*SLOW, "PIL"},
}
"""Modules that a command never imports."""


def test_commands_load_nothing_that_they_do_not_need(run: Path, tmp_path: Path) -> None:
    dataset = xr.Dataset({"v": (tuple("tzyx"), np.zeros((2, 3, 4, 5), np.float32))})
    dataset.to_netcdf(tmp_path / "classic.nc", format="NETCDF3_64BIT", engine="scipy")
    dataset.to_netcdf(tmp_path / "new.nc", engine="h5netcdf")
    shutil.copy(run, tmp_path / "run.fhz")
    code = (
        "import sys\nfrom fhash_cli.main import program\ntry:\n    program(sys.argv[1:])\n"
        "except SystemExit as end:\n    assert not end.code\nprint(*sys.modules)"
    )
    for command, never in NEVER.items():
        words = [sys.executable, "-c", code, *command.split()]
        done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
        assert never.isdisjoint(done.stdout.splitlines()[-1].split()), command


SIGNALS = ("SIGTERM", "SIGHUP", "SIGINT")
"""Signals that ask the program to stop."""

SLOW_DISK = """
import sys
import warnings
from fhash_cli import main
if sys.argv[1] == "decode":
    from fhash_codec.volume import Volume as Slow
    name = "read_steps"
else:
    from fhash_formats.container import ContainerWriter as Slow
    name = "add_array"  # of a paper file, and of a compact one of a single tile
def sleeping(*_, **__):
    print("ready", file=sys.stderr, flush=True)
    sys.stdin.read()  # frames are read in a thread, which is waited for
setattr(Slow, name, sleeping)
main.main()
"""


@pytest.mark.skipif(os.name == "nt", reason="no SIGHUP there")
@pytest.mark.parametrize(
    ("command", "name"),
    [
        *((command, name) for command in ("encode", "decode") for name in SIGNALS),
        ("encode paper", "SIGTERM"),  # which loads torch, and heeds signals as "encode" does
    ],
)
def test_a_signal_leaves_nothing_half_written(
    data: Path, run: Path, tmp_path: Path, command: str, name: str
) -> None:
    words = {
        "encode": ["encode", data, "-o", tmp_path / "out.fhz", "--effort", "1"],
        "encode paper": [
            "encode",
            data,
            "-o",
            tmp_path / "out.fhz",
            *["--preset", "published", "--tables", "uint8", "--epochs", "1", "--width", "4"],
        ],
        "decode": ["decode", run, "-o", tmp_path / "out.npy"],
    }[command]
    with subprocess.Popen(
        [sys.executable, "-c", SLOW_DISK, *words],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        lines = iter(process.stderr)
        assert "ready\n" in lines
        process.send_signal(getattr(signal, name))
        process.stdin.close()
        rest = "".join(lines)
    assert process.returncode == 130
    assert len(rest.splitlines()) == 1
    assert rest.startswith("fhash: error: interrupted")
    if command == "encode":
        assert "is not written, and the same command starts again" in rest
    assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".checkpoint")] == []


LOSING = """
import signal, time, weakref
from fhash_cli import main
from fhash_formats.container import ContainerWriter
add_array = ContainerWriter.add_array
def losing(*given, **more):
    thing = weakref.WeakSet()
    watch = weakref.ref(thing, lambda _: signal.raise_signal(signal.NAME))
    del thing  # Python ignores what the callback raises
    time.sleep(10)
    return add_array(*given, **more)
ContainerWriter.add_array = losing
main.main()
"""


@pytest.mark.skipif(os.name == "nt", reason="no SIGHUP there")
@pytest.mark.parametrize("name", SIGNALS)
def test_a_signal_that_python_ignores_comes_again(data: Path, tmp_path: Path, name: str) -> None:
    words = ["encode", data, "-o", tmp_path / "out.fhz", "--effort", "1"]
    code = [sys.executable, "-c", LOSING.replace("NAME", name)]
    done = subprocess.run([*code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("fhash: error: interrupted")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="no SIGHUP there")
def test_a_signal_that_is_ignored_stays_ignored(run: Path) -> None:
    code = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from fhash_cli import main\nmain._heed_signals()\n"
        "print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN,"
        " signal.getsignal(signal.SIGTERM) is main._interrupt)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True True\n"


def closed(words: list[object], streams: str) -> subprocess.CompletedProcess[str]:
    """The program run with some streams closed, as a shell's `>&-` does."""
    shell = ["sh", "-c", f'exec "$@" {streams}', "sh"]
    return subprocess.run(
        [*shell, *map(str, [*MAIN, *words])], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("json_or_not", [[], ["--json"]])
def test_a_closed_stdout_is_one_line(run: Path, tmp_path: Path, json_or_not: list[str]) -> None:
    done = closed(["info", run, *json_or_not], ">&-")
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1), done.stderr
    assert "stdout is closed" in done.stderr
    done = closed(["decode", run, "-o", tmp_path / "out.npy", *json_or_not], ">&-")
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1), done.stderr
    assert np.load(tmp_path / "out.npy").shape == (3, 6, 7, 8)


def test_closed_streams_do_not_end_up_in_outputs(run: Path, tmp_path: Path) -> None:
    for number, streams in enumerate(["2>&-", ">&- 2>&-", "<&- >&- 2>&-"]):
        done = closed(["decode", run, "-o", tmp_path / f"{number}.npy"], streams)
        assert done.returncode == (0 if number == 0 else 1)
        assert np.load(tmp_path / f"{number}.npy").shape == (3, 6, 7, 8)


def test_no_filter_of_warnings_hides_lines_of_a_command(fhash: Fhash, tmp_path: Path) -> None:
    values = np.arange(24, dtype="f4").reshape(1, 2, 3, 4)
    data = xr.Dataset({"v": (("time", "z", "y", "x"), values, {"valid_max": np.float32(20)})})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        done = fhash("encode", tmp_path / "a.nc", "-o", tmp_path / "a.fhz", "--max-error", "0.1")
    assert "12.5 % of the values of 'v' (3) are outside the valid range" in done.stderr
