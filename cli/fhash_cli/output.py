"""Output of the command line: results on stdout (a table or JSON), everything else on stderr."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, TextIO

import click

from fhash_formats.errors import FhashError, OutputError
from fhash_formats.support.plain_json import plain_json, plain_text

NO_MEMORY = ("can't allocate memory", "memory allocation failed")
"""Words of the RuntimeErrors by which torch and HDF5 report that memory ran out."""
QUIET_SECONDS = 2.0
"""Stages shorter than this show no progress."""


def say(message: str) -> None:
    """One line on stderr."""
    click.echo(f"fhash: {message}", err=True)


def warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """A Python warning as one line on stderr; the signature is that of `warnings.showwarning`."""
    say(f"warning: {' '.join(str(message).split())}")


def emit(result: Mapping[str, Any], text: str, as_json: bool) -> None:
    """Print a result on stdout: as one line of JSON, or as text.

    Figures that JSON cannot hold become null.

    Raises OutputError where stdout is closed.
    """
    if sys.stdout is None:
        raise OutputError(
            "the result cannot be printed, stdout is closed; files named as outputs are written"
        )
    click.echo(json.dumps(plain_json(result), allow_nan=False) if as_json else plain_text(text))


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of equal length as aligned columns.

    The first column is aligned to the left; where there are more than two, the others to the right.
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]

    def line(row: Sequence[str]) -> str:
        first, *rest = row
        others = (
            rest
            if len(row) == 2
            else [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
        )
        return "  ".join([first.ljust(widths[0]), *others]).rstrip()

    return "\n".join(line(row) for row in rows)


def size(count: float) -> str:
    """Bytes for people, in decimal units."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def compared(report: Mapping[str, Any]) -> str:
    """The size of a container beside that of the data."""
    ratio = report["ratio"]
    word = (
        f"{number(ratio, digits=3)}x smaller"
        if ratio >= 1
        else f"{number(1 / ratio, digits=3)}x larger"
    )
    return f"{size(report['bytes'])} of {size(report['raw_bytes'])}, {word}"


def number(value: float | None, unit: str = "", *, digits: int = 4) -> str:
    """A measured value with its unit ("1" stands for none); a dash for None (not defined)."""
    return "-" if value is None else f"{value:.{digits}g} {'' if unit == '1' else unit}".rstrip()


def apart(*values: float) -> list[str]:
    """Numbers with 6 digits, or with up to 12 where different numbers would look equal."""
    for digits in range(6, 13):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len(set(values)):
            break
    return texts


def _largest_error(error: float | None, units: str) -> str:
    """The largest error; one of 0 says that nothing is lost."""
    return "none, lossless" if error == 0 else number(error, units)


def extent(shape: Sequence[int]) -> str:
    """A shape such as 16 x 32 x 48 x 48."""
    return " x ".join(map(str, shape))


def spans(region: Sequence[Sequence[int]]) -> str:
    """A region in space such as z 0:32, y 4:40, x 0:48."""
    return ", ".join(
        f"{axis} {low}:{high}" for axis, (low, high) in zip("zyx", region, strict=True)
    )


def listed(names: Sequence[str]) -> str:
    """Names separated by commas; of more than 8 those in the middle are left out."""
    return ", ".join(names if len(names) <= 8 else [*names[:6], "...", names[-1]])


def quality_rows(report: Mapping[str, Any], units: str = "") -> list[tuple[str, str]]:
    """Rows of the quality, for `encode`, `diff`, `demo` and `info`.

    A container of another writer may lack some figures.
    """
    exact = report.get("rmse") == 0
    return [
        ("PSNR, coreset", "exact" if exact else number(report.get("psnr"), "dB")),
        ("PSNR, domain", number(report.get("psnr_domain"), "dB")),
        ("RMSE", number(report.get("rmse"), units)),
        ("largest error", _largest_error(report.get("max_abs_error"), units)),
        ("SSIM", number(report.get("ssim"), digits=5)),
    ]


def loss_rows(model: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The row of the PSNR that coded tables cost; none for other tables."""
    loss = model.get("tables_loss_db")
    return [] if loss is None else [("tables", f"coded, for {loss:.2f} dB of the PSNR")]


def describe_error(error: Exception) -> tuple[str, int]:
    """One line that says what went wrong, and the exit code."""
    if isinstance(error, FhashError):
        line, code = str(error), error.exit_code
    elif isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        hint = f" (see '{context.command_path} --help')" if context is not None else ""
        line, code = error.format_message().rstrip(".") + hint, error.exit_code
    elif _is_no_memory(error):
        line, code = (
            "out of memory; take fewer steps (--t), a smaller region or a smaller network",
            1,
        )
    elif isinstance(error, RuntimeError) and str(error) == "can't start new thread":
        line, code = (
            "no thread can be started: no memory is left, or no process (ulimit -u);"
            " FHASH_THREADS=1 takes fewer",
            1,
        )
    elif isinstance(error, OSError) and error.strerror:
        line, code = f"{error.strerror}: {error.filename}" if error.filename else error.strerror, 1
    else:
        line, code = (
            f"unexpected {type(error).__name__}: {error}; please report this"
            " (FHASH_DEBUG=1 shows where it came from)",
            1,
        )
    return " ".join(line.split()), code


def _is_no_memory(error: Exception) -> bool:
    """Whether an error means that memory ran out, also in the words of torch and HDF5."""
    if isinstance(error, RuntimeError):
        return type(error).__name__ == "OutOfMemoryError" or any(
            words in str(error) for words in NO_MEMORY
        )
    return isinstance(error, MemoryError)


class Progress:
    """The codec's progress callback (stage, done, total, note), as a context manager.

    It draws a bar on a terminal, and prints a line every 10 % elsewhere. The first QUIET_SECONDS of
    a stage show nothing; `quiet` shows nothing at all. Leaving the context removes the bar.
    """

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet
        self.terminal = sys.stderr is not None and sys.stderr.isatty()
        self.stage = ""
        self.start = self.last = time.monotonic()
        self.shown = 0.0
        self.tenth = 0
        self.drawn = False

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._erase()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Report that `done` of `total` parts of a stage are done.

        note: a remark such as "41.2 dB".
        """
        if self.quiet:
            return
        now = time.monotonic()
        if stage != self.stage:
            # The first report follows the first part: the stage began at the end of the last.
            self._erase()
            self.stage, self.start, self.tenth = stage, self.last, 0
        self.last = now
        share = done / total if total else 1.0
        passed = now - self.start
        if passed < QUIET_SECONDS:
            self.tenth = math.floor(10 * share)
            return
        left = f", {_clock(passed / share - passed)} left" if 0 < share < 1 else ""
        remark = f", {note}" if note else ""
        if self.terminal and (now - self.shown > 0.1 or share == 1):
            filled = round(24 * share)
            click.echo(
                f"\r{stage:10} {'#' * filled}{'-' * (24 - filled)} {share:4.0%}"
                f"{remark}{left}\x1b[K",
                err=True,
                nl=False,
            )
            self.drawn, self.shown = True, now
        elif not self.terminal and math.floor(10 * share) > self.tenth:
            self.tenth = math.floor(10 * share)
            say(f"{stage} {share:.0%}{remark}{left}")

    def _erase(self) -> None:
        if self.drawn:
            click.echo("\r\x1b[K", err=True, nl=False)
            self.drawn = False


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"
    )
