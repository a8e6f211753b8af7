"""Output and progress of the command line."""

from __future__ import annotations

import errno

import click
import pytest

from fhash_cli import output as progress_bar
from fhash_cli.output import (
    Progress,
    compared,
    describe_error,
    duration,
    factor,
    quality_rows,
    say,
    size,
)
from fhash_formats.errors import DamagedFileError, InputError, QualityError


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (999.4, "999 B"),
        (999.5, "1.00 kB"),
        (1000, "1.00 kB"),
        (9_994, "9.99 kB"),
        (9_996, "10.0 kB"),
        (98_600, "98.6 kB"),
        (13_965_614, "14.0 MB"),
        (999_499, "999 kB"),
        (999_501, "1.00 MB"),
        (4.7e9, "4.70 GB"),
        (2e15, "2,000 TB"),
    ],
)
def test_size(count: float, text: str) -> None:
    assert size(count) == text


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (0.5, "0.500x"),
        (1.0, "1.00x"),
        (9.996, "10.0x"),
        (47.25, "47.2x"),
        (999.6, "1,000x"),
        (52_683.0, "52,700x"),
    ],
)
def test_factor_has_three_digits_and_no_exponent(ratio: float, text: str) -> None:
    assert factor(ratio) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (0.434, "0.43 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (119.4, "119 s"),
        (119.6, "2 min 0 s"),
        (140.2, "2 min 20 s"),
        (3599.4, "59 min 59 s"),
        (3599.6, "1 h 0 min"),
        (11_130, "3 h 5 min"),
    ],
)
def test_duration_is_in_units_that_people_read(seconds: float, text: str) -> None:
    assert duration(seconds) == text


FIGURES = {"bytes": 100_000, "raw_bytes": 4_720_000, "ratio": 47.2}


def test_compared_says_larger_where_it_is() -> None:
    assert compared(FIGURES) == "100 kB: 47.2x smaller than the array (4.72 MB)"
    assert (
        compared({"bytes": 11_800, "raw_bytes": 480, "ratio": 480 / 11_800})
        == "11.8 kB: 24.6x larger than the array (480 B)"
    )


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


@pytest.mark.parametrize(
    ("bulk", "row"),
    [
        ({"psnr": 40, "range": [0, 1]}, ["40 dB, of the 98 % from 0 to 1"]),
        ({"psnr": None, "range": [0, 1]}, ["exact, of the 98 % from 0 to 1"]),
        ({"range": [0, 1]}, []),
        (None, []),
    ],
)
def test_a_bulk_without_a_psnr_has_no_row(bulk: dict[str, object] | None, row: list[str]) -> None:
    figures = dict.fromkeys(("psnr", "psnr_all", "rmse", "max_abs_error", "ssim"), 1.0)
    rows = quality_rows({**figures, "bulk": bulk})
    assert [text for name, text in rows if name == "PSNR, bulk"] == row


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

    def fileno(self) -> int:
        raise OSError("no file")


def reports(
    monkeypatch: pytest.MonkeyPatch, *, seconds: float, terminal: bool = False, quiet: bool = False
) -> str:
    """The text printed for a stage of 40 parts of `seconds` each, after one that took no time."""
    screen, now = Terminal(terminal), [0.0]
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr(progress_bar.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress_bar, "BEAT_SECONDS", 3600)  # the thread does nothing
    with Progress(quiet=quiet) as progress:
        progress("reading", 1, 1, "")
        for part in range(1, 41):
            now[0] += seconds
            progress("training", part, 40, f"{part} dB")
    return screen.text


def test_without_a_terminal_nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reports(monkeypatch, seconds=1.0) == ""
    assert reports(monkeypatch, seconds=1.0, terminal=True, quiet=True) == ""


def test_on_a_terminal_a_bar_is_drawn_in_place_and_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    text = reports(monkeypatch, seconds=1.0, terminal=True)
    assert "\n" not in text
    assert "training   ############------------  50%, 20 dB, 0:20 left" in text
    assert text.endswith("\r\x1b[K")


class Watched:
    """A Progress with a clock that the test moves, and the screen that it writes on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> None:
        self.screen, self.now = Terminal(terminal), 100.0
        monkeypatch.setattr("sys.stderr", self.screen)
        monkeypatch.setattr(progress_bar.time, "monotonic", lambda: self.now)
        self.progress = Progress(quiet=False)

    def after(self, seconds: float, *report: object) -> str:
        """The text that a report writes, or without one a beat, some seconds later."""
        self.now += seconds
        before = len(self.screen.text)
        if report:
            self.progress(*report)  # type: ignore[arg-type]
        else:
            self.progress.beat()
        return self.screen.text[before:]


def test_a_terminal_sees_time_pass_while_no_report_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = Watched(monkeypatch, terminal=True)
    assert bar.after(0.9) == ""
    assert "starting" in bar.after(0.2)
    texts = {bar.after(1.0) for _ in range(5)}
    assert len(texts) == 5
    bar.after(1.0, "coding", 10, 40)
    assert "25%, 0:" in bar.after(1.0)
    first, second = bar.after(1.0), bar.after(1.0)
    assert first.partition(" left")[0] != second.partition(" left")[0]
    bar.progress.erase()


def test_many_reports_draw_ten_times_a_second_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = Watched(monkeypatch, terminal=True)
    bar.after(2.0, "training", 1, 100)
    assert sum(bool(bar.after(0.01, "training", 2 + n, 100)) for n in range(40)) <= 5
    assert bar.after(0.0, "training", 100, 100)
    bar.progress.erase()


def test_a_line_takes_the_place_of_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = Watched(monkeypatch, terminal=True)
    bar.after(2.0, "coding", 1, 4)
    before = len(bar.screen.text)
    say("warning: look")
    assert bar.screen.text[before:] == "\r\x1b[Kfhash: warning: look\n"
    assert bar.after(1.0)
    bar.progress.erase()


@pytest.mark.parametrize("error", [OSError, ValueError])
def test_a_closed_stderr_ends_the_beats(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def fail(self: Progress) -> None:
        raise error

    monkeypatch.setattr("sys.stderr", Terminal(True))
    monkeypatch.setattr(Progress, "beat", fail)
    monkeypatch.setattr(progress_bar, "BEAT_SECONDS", 0.001)
    with Progress(quiet=False) as progress:
        thread = progress._thread
        assert thread is not None
        thread.join(30)
        assert not thread.is_alive()
