"""Tables, numbers for people, and progress, which is quiet when there is nothing to say."""

from __future__ import annotations

import errno

import click
import pytest

from fhash_cli import output
from fhash_cli.output import (
    Progress,
    apart,
    compared,
    describe_error,
    listed,
    number,
    size,
    table,
)
from fhash_formats.errors import DamagedFileError, InputError, QualityError


class Terminal:
    """A stderr that is a terminal or is not."""

    def __init__(self, terminal: bool) -> None:
        self.terminal = terminal
        self.text = ""

    def isatty(self) -> bool:
        return self.terminal

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


def reports(
    monkeypatch: pytest.MonkeyPatch, *, seconds: float, terminal: bool = False, quiet: bool = False
) -> str:
    """The text printed for a stage of 40 parts of `seconds` each, after one that took no time."""
    screen, now = Terminal(terminal), [0.0]
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr(output.time, "monotonic", lambda: now[0])
    with Progress(quiet=quiet) as progress:
        progress("reading", 1, 1, "")
        for part in range(1, 41):
            now[0] += seconds
            progress("training", part, 40, f"{part} dB")
    return screen.text


def test_short_stages_are_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reports(monkeypatch, seconds=0.04) == ""
    assert reports(monkeypatch, seconds=0.04, terminal=True) == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_quiet_is_silent(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    assert reports(monkeypatch, seconds=9.0, terminal=terminal, quiet=True) == ""


def test_without_a_terminal_there_is_a_line_every_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = reports(monkeypatch, seconds=1.0).splitlines()
    assert len(lines) == 10
    assert lines[0] == "fhash: training 10%, 4 dB, 0:36 left"
    assert lines[-1] == "fhash: training 100%, 40 dB"


def test_what_passed_before_the_first_report_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        reports(monkeypatch, seconds=120.0).splitlines()[0]
        == "fhash: training 10%, 4 dB, 1:12:00 left"
    )


def test_on_a_terminal_a_bar_is_drawn_in_place_and_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    text = reports(monkeypatch, seconds=1.0, terminal=True)
    assert "\n" not in text
    assert "training   ############------------  50%, 20 dB, 0:20 left" in text
    assert text.endswith("\r\x1b[K")


def test_table_aligns_its_columns() -> None:
    assert table([("a", "one"), ("long", "two")]) == "a     one\nlong  two"
    assert table([("a", "1", "22"), ("b", "333", "4")]) == "a    1  22\nb  333   4"


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1 kB"),
        (98_600, "98.6 kB"),
        (4.7e9, "4.7 GB"),
        (2e15, "2e+03 TB"),
    ],
)
def test_size(count: float, text: str) -> None:
    assert size(count) == text


def test_number_has_its_unit_or_is_a_dash() -> None:
    assert [number(45.218, "dB"), number(None, "dB"), number(0.5), number(0.5, "1")] == [
        "45.22 dB",
        "-",
        "0.5",
        "0.5",
    ]


def test_compared_says_larger_where_it_is() -> None:
    assert (
        compared({"bytes": 100_000, "raw_bytes": 4_720_000, "ratio": 47.2})
        == "100 kB of 4.72 MB, 47.2x smaller"
    )
    assert (
        compared({"bytes": 11_800, "raw_bytes": 480, "ratio": 480 / 11_800})
        == "11.8 kB of 480 B, 24.6x larger"
    )


def test_listed_leaves_out_the_middle() -> None:
    assert listed(["1", "2"]) == "1, 2"
    assert listed([str(n) for n in range(20)]) == "0, 1, 2, 3, 4, 5, ..., 19"


def test_json_holds_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    output.emit({"psnr": float("nan"), "range": [float("inf"), 1.5]}, "", as_json=True)
    assert capsys.readouterr().out == '{"psnr": null, "range": [null, 1.5]}\n'


class OutOfMemoryError(RuntimeError):
    """Named like torch's own."""


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (InputError("two\n  lines"), "two lines", 2),
        (QualityError("missed"), "missed", 3),
        (DamagedFileError("broken"), "broken", 4),
        (MemoryError(), "out of memory; take fewer", 1),
        (OutOfMemoryError("CUDA"), "out of memory; take fewer", 1),
        (
            RuntimeError(
                "[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator:"
                " can't allocate memory: 8 bytes"
            ),
            "out of memory; take",
            1,
        ),
        (
            RuntimeError("Can't decrement id ref count (memory allocation failed for pipeline)"),
            "out of memory; take fewer",
            1,
        ),
        (
            RuntimeError("can't start new thread"),
            "no thread can be started: no memory is left, or no process (ulimit -u)",
            1,
        ),
        (
            RuntimeError("no memory of it"),
            "unexpected RuntimeError: no memory of it; please report",
            1,
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "x.npy"),
            "No space left on device: x.npy",
            1,
        ),
        (click.UsageError("Bad."), "Bad", 2),
        (KeyError("k"), "unexpected KeyError: 'k'; please report this", 1),
    ],
)
def test_every_error_is_one_line_with_an_exit_code(error: Exception, line: str, code: int) -> None:
    text, got = describe_error(error)
    assert text.startswith(line)
    assert "\n" not in text
    assert got == code


def test_numbers_have_as_many_digits_as_tell_them_apart() -> None:
    assert apart(0.0, 4.0) == ["0", "4"]
    assert apart(347921.0, 347921.002) == ["347921", "347921.002"]
    assert apart(7.0, 7.0) == ["7", "7"]
    assert apart(1.0, 1.0 + 1e-15) == ["1", "1"]
