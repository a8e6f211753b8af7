"""Progress: a bar that never stands still, lines now and then, silence where nothing is to say."""

from __future__ import annotations

import threading

import pytest

from fhash_cli import progress_bar
from fhash_cli.progress_bar import BEAT_SECONDS, Progress, clock, say


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


def test_short_stages_are_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reports(monkeypatch, seconds=0.02) == ""
    assert reports(monkeypatch, seconds=0.02, terminal=True) == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_quiet_is_silent(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    assert reports(monkeypatch, seconds=9.0, terminal=terminal, quiet=True) == ""


def test_without_a_terminal_there_is_a_line_every_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = reports(monkeypatch, seconds=1.0).splitlines()
    assert len(lines) == 10
    assert lines[0] == "fhash: training 10%, 4 dB, 0:36 left"
    assert lines[-1] == "fhash: training 100%, 40 dB"


def test_what_passed_before_the_first_report_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = reports(monkeypatch, seconds=120.0).splitlines()
    assert lines[0] == "fhash: training 2%, 1 dB, 1:18:00 left"
    assert lines[3] == "fhash: training 10%, 4 dB, 1:12:00 left"


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


def test_a_stage_of_one_part_has_no_share(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = Watched(monkeypatch, terminal=True)
    assert bar.after(2.0, "opening", 0, 1, "run_*.raw").startswith("\ropening    run_*.raw [0:02]")
    bar.progress.erase()


def test_planning_foretells_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = Watched(monkeypatch, terminal=True)
    assert "left" not in bar.after(5.0, "planning", 3, 6, "head")
    assert "left" in bar.after(5.0, "coding", 3, 6)
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


def test_a_long_stage_without_reports_prints_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log = Watched(monkeypatch, terminal=False)
    assert log.after(1.0, "planning", 2, 6, "tiles") == ""
    assert [bool(log.after(1.0)) for _ in range(25)].count(True) == 2
    assert log.after(10.0) == "fhash: planning 33%, tiles\n"
    assert log.after(10.0, "planning", 2, 6, "tiles, 9 tiles tried").endswith("9 tiles tried\n")


def test_the_thread_beats_without_any_report(monkeypatch: pytest.MonkeyPatch) -> None:
    beaten = threading.Event()
    monkeypatch.setattr(Progress, "beat", lambda self: beaten.set())
    monkeypatch.setattr(progress_bar, "BEAT_SECONDS", 0.001)
    with Progress(quiet=False):
        assert beaten.wait(30)
    assert all(thread.name != "fhash-progress" for thread in threading.enumerate())


@pytest.mark.parametrize("error", [OSError, ValueError])
def test_a_closed_stderr_ends_the_beats(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def fail(self: Progress) -> None:
        raise error

    monkeypatch.setattr(Progress, "beat", fail)
    monkeypatch.setattr(progress_bar, "BEAT_SECONDS", 0.001)
    with Progress(quiet=False) as progress:
        thread = progress._thread
        assert thread is not None
        thread.join(30)
        assert not thread.is_alive()


def test_the_pause_between_two_beats_is_short() -> None:
    assert BEAT_SECONDS <= 1
    assert progress_bar.QUIET_SECONDS + BEAT_SECONDS < 2


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (140, "2:20"), (3740, "1:02:20")]
)
def test_clock(seconds: float, text: str) -> None:
    assert clock(seconds) == text
