"""Output of the command line: results (a table or JSON) on stdout, all else on stderr."""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
import unicodedata
from collections.abc import Mapping, Sequence
from contextvars import ContextVar
from typing import Annotated, Any, TextIO, TypedDict

import click

from fhash_formats.errors import (
    DamagedFileError,
    FhashError,
    InputError,
    InterruptedEncodingError,
    MissingDependencyError,
    MissingInputError,
    OutputError,
    OutputExistsError,
    QualityError,
    RegionError,
    UnsupportedFileError,
)

QUIET_SECONDS = 1.0
"""Seconds of a command that show no progress, so that short commands stay silent."""
BEAT_SECONDS = 0.5
"""Seconds between two looks at the clock while no report comes."""
DRAW_SECONDS = 0.1
"""Seconds between two drawings of the bar at least."""
BAR_CELLS = 24
"""Characters of a full bar."""
UNEVEN_STAGES = frozenset({"planning"})
"""Stages whose parts take different times, so that no time left is foretold."""


def one_line(text: str) -> str:
    """The text with an escape such as "\\n" for each character that a terminal would obey.

    Names and texts of a file could otherwise forge lines, and clear or colour the screen.
    """
    if text.isprintable():
        return text
    return "".join(
        char
        if char.isprintable() or unicodedata.category(char) == "Zs"
        else char.encode("unicode_escape").decode("ascii")
        for char in text
    )


def say(message: str) -> None:
    """One line on stderr, in place of a bar that is drawn there."""
    for bar in tuple(_drawn):
        bar.erase()
    click.echo(f"fhash: {one_line(message)}", err=True)


def clock(seconds: float) -> str:
    """Seconds as minutes and seconds, such as 2:20 or 1:02:20."""
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"
    )


class Progress:
    """The codec's progress callback (stage, done, total, note), as a context manager.

    On a terminal it draws a bar from QUIET_SECONDS on. The bar shows the time that passed, so that
    it moves even while no report comes. Elsewhere, and with `quiet`, it shows nothing. Leaving the
    context removes the bar.
    """

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet or sys.stderr is None or not sys.stderr.isatty()
        self._stage, self._done, self._total, self._note = "", 0, 1, ""
        self._begun = self._stage_begun = self._last = time.monotonic()
        self._shown = self._begun
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Progress:
        if not self.quiet:
            self._thread = threading.Thread(target=self._watch, name="fhash-progress", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self.erase()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Report that `done` of `total` parts of a stage are done.

        note: a remark such as "41.2 dB".
        """
        if self.quiet:
            return
        with self._lock:
            now = time.monotonic()
            if stage != self._stage:
                # The first report may follow the first part: the stage began after the last.
                self._stage, self._stage_begun = stage, self._last
            self._last = now
            self._done, self._total, self._note = done, max(total, 1), note
            self._draw(now, whole=done == total)

    def beat(self) -> None:
        """Show that time passes, where no report came."""
        with self._lock:
            self._draw(time.monotonic())

    def erase(self) -> None:
        """Remove the bar; the next report draws it again."""
        with self._lock:
            if self in _drawn:
                _drawn.remove(self)
                click.echo("\r\x1b[K", err=True, nl=False)

    def _watch(self) -> None:
        while not self._ended.wait(BEAT_SECONDS):
            try:
                self.beat()
            except (OSError, ValueError):  # stderr was closed
                return

    def _draw(self, now: float, *, whole: bool = False) -> None:
        """Draw the bar, unless it was drawn a moment ago."""
        if now - self._begun < QUIET_SECONDS:
            return
        if self in _drawn and now - self._shown < DRAW_SECONDS and not whole:
            return
        remarks = self._remarks(now)
        if self._total == 1:
            bar, remarks = "", remarks.replace(", ", " ", 1)
        else:
            filled = round(BAR_CELLS * self._done / self._total)
            bar = f" {'#' * filled}{'-' * (BAR_CELLS - filled)} {self._done / self._total:4.0%}"
        stage = self._stage or "starting"
        passed = clock(now - self._begun)
        text = f"{stage:10}{bar}{remarks} [{passed}]"
        click.echo(f"\r{text[: _columns()]}\x1b[K", err=True, nl=False)
        self._shown = now
        if self not in _drawn:
            _drawn.append(self)

    def _remarks(self, now: float) -> str:
        """The note, and the time left where the parts of the stage take equally long."""
        share = self._done / self._total
        passed = now - self._stage_begun
        note = f", {one_line(self._note)}" if self._note else ""
        if not 0 < share < 1 or self._stage in UNEVEN_STAGES:
            return note
        # Reckoned to the last report, and less what passed since then: it counts down.
        reported = self._last - self._stage_begun
        return f"{note}, {clock(max(reported / share - passed, 0))} left"


def _columns() -> int:
    """Characters that fit into a line of the terminal: a longer line could not be drawn anew."""
    try:
        columns = os.get_terminal_size(sys.stderr.fileno()).columns
    except (OSError, ValueError):
        columns = 0
    return columns - 1 if columns > 1 else 120


_drawn: list[Progress] = []
"""Bars that are drawn on the terminal: one at most, but tests may run several commands."""


KINDS: dict[str, tuple[type[Exception], ...]] = {
    "usage": (click.ClickException,),
    "missing-input": (MissingInputError,),
    "missing-dependency": (MissingDependencyError,),
    "output-exists": (OutputExistsError,),
    "region": (RegionError,),
    "quality": (QualityError,),
    "unsupported": (UnsupportedFileError,),
    "damaged": (DamagedFileError,),
    "interrupted": (InterruptedEncodingError,),
    "input": (InputError,),
    "output": (OutputError,),
}
"""Errors by kind, the first that fits; others are `memory` or `failure`."""
printed: ContextVar[bool] = ContextVar("printed", default=False)
"""Whether the JSON object of the present command line was printed."""
NO_MEMORY = ("can't allocate memory", "memory allocation failed")
"""Words of the RuntimeErrors by which torch and HDF5 report that memory ran out."""


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


def emit(
    result: Mapping[str, Any], text: str, as_json: bool, missed: FhashError | None = None
) -> None:
    """Print a result on stdout, as one line of JSON or as text, and raise what was missed.

    missed: a gate or promise that the result misses; JSON holds it beside the result, see
        `error_object`.

    Figures that JSON cannot hold become null.

    Raises OutputError where stdout is closed.
    """
    from fhash_formats.support.values import plain_text

    if sys.stdout is None:
        raise OutputError(
            "the result cannot be printed, stdout is closed; files named as outputs are written"
        )
    if as_json:
        print_json({**result, **({} if missed is None else error_object(missed))})
    else:
        click.echo("\n".join(map(one_line, plain_text(text).split("\n"))))
    if missed is not None:
        raise missed


def print_json(values: Mapping[str, Any]) -> None:
    """Print the one JSON object of a command on stdout."""
    from fhash_formats.support.values import plain_json

    click.echo(json.dumps(plain_json(values), allow_nan=False))
    printed.set(True)


class ErrorObject(TypedDict):
    """An error as JSON."""

    error: Annotated[str, "one line, as on stderr"]
    kind: Annotated[str, "a word for it, see Errors"]
    exit_code: Annotated[int, "exit code of the process"]


def error_object(error: Exception) -> ErrorObject:
    """An error as JSON."""
    line, code = describe_error(error)
    return {"error": line, "kind": _kind(error, code), "exit_code": code}


def _kind(error: Exception, code: int) -> str:
    """A word for an error that scripts can rely on, see docs/json.md."""
    for kind, errors in KINDS.items():
        if isinstance(error, errors):
            return kind
    if _is_no_memory(error):
        return "memory"
    return "input" if code == 2 else "failure"


def table(rows: Sequence[Sequence[str]], *, left: bool = False) -> str:
    """Rows of equal length as aligned columns.

    The first column is aligned to the left; where there are more than two, the others to the right
    unless `left`. Each cell is one line, whatever a file has for a name.
    """
    rows = [[one_line(cell) for cell in row] for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]

    def line(row: Sequence[str]) -> str:
        first, *rest = row
        others = (
            rest
            if len(row) == 2
            else [
                cell.ljust(width) if left else cell.rjust(width)
                for cell, width in zip(rest, widths[1:], strict=True)
            ]
        )
        return "  ".join([first.ljust(widths[0]), *others]).rstrip()

    return "\n".join(line(row) for row in rows)


def size(count: float) -> str:
    """Bytes for people, in decimal units."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} B" if unit == "B" else f"{_three_digits(count)} {unit}"
        count /= 1000
    return f"{_three_digits(count)} TB"


def factor(ratio: float) -> str:
    """A ratio of sizes with three digits, such as 1.97x, 197x or 52,700x."""
    return f"{_three_digits(ratio)}x"


def duration(seconds: float) -> str:
    """Seconds for people, such as 0.43 s, 54 s, 2 min 20 s or 3 h 5 min."""
    if seconds < 9.95:
        return f"{seconds:.2g} s"
    if seconds < 119.5:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _three_digits(value: float) -> str:
    """A positive number with three significant digits and no exponent, such as 14.0 or 52,700."""
    decimals = 2 - math.floor(math.log10(value)) if value > 0 else 0
    rounded = round(value, decimals)
    # 9.999 has two decimals, but 10.0, to which it is rounded, has one.
    decimals = 2 - math.floor(math.log10(rounded)) if rounded > 0 else 0
    return f"{rounded:,.{max(decimals, 0)}f}"


def compared(report: Mapping[str, Any], *, part: bool = False) -> str:
    """The size of a container beside the array, and beside the files that it was read from.

    part: whether options chose a part of what the files hold.
    """
    array = f"{_smaller(report['ratio'])} than the array ({size(report['raw_bytes'])})"
    text = f"{size(report['bytes'])}: {array}"
    if not report.get("source_bytes"):
        return text
    source = "the whole source" if part else "the source"
    ratio = _smaller(report["source_ratio"])
    return f"{text}, {ratio} than {source} on disk ({size(report['source_bytes'])})"


def split_row(report: Mapping[str, Any]) -> tuple[str, str]:
    """The row of a file's bytes by what they hold, without what takes none."""
    parts = [f"{name} {size(count)}" for name, count in report["split"].items() if count]
    return "split", ", ".join(parts)


def model_name(*, published: bool) -> str:
    """The model of a file, for people."""
    return "F-Hash, the published network" if published else "F-Hash"


def _smaller(ratio: float) -> str:
    return f"{factor(ratio)} smaller" if ratio >= 1 else f"{factor(1 / ratio)} larger"


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


def feature_rows(
    report: Mapping[str, Any], features: Sequence[str] = (), dilation: int = 0
) -> list[tuple[str, str]]:
    """Rows of the features and of the coreset; none where that is the whole domain."""
    if report["coreset_fraction"] == 1:
        return []
    share = f"{report['coreset_fraction']:.3%} of the domain"
    rows = [("features", f"{', '.join(features)}; grown by {dilation}")] if features else []
    return [*rows, ("coreset", f"{share}, in {spans(report['feature_bounding_box'])}")]


def quality_rows(report: Mapping[str, Any], units: str = "") -> list[tuple[str, str]]:
    """Rows of the quality, for `encode`, `diff`, `demo` and `info`.

    A container of another writer may lack some figures.
    """
    domain = report.get("psnr_domain")
    psnr = "exact" if report.get("rmse") == 0 else number(report.get("psnr"), "dB")
    whole = domain in (None, report.get("psnr"))
    return [
        ("PSNR" if whole else "PSNR, coreset", psnr),
        *_bulk_rows(report),
        *_between_rows(report),
        *([] if whole else [("PSNR, domain", number(domain, "dB"))]),
        ("RMSE", number(report.get("rmse"), units)),
        ("largest error", _largest_error(report.get("max_abs_error"), units)),
        ("SSIM", number(report.get("ssim"), digits=5)),
    ]


def _bulk_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The row of the PSNR within the middle 98 % of the values; none where it is not known."""
    bulk = report.get("quality", report).get("bulk")
    if bulk is None or "psnr" not in bulk:
        return []
    low, high = apart(*bulk["range"])
    psnr = "exact" if bulk["psnr"] is None else number(bulk["psnr"], "dB")
    return [("PSNR, bulk", f"{psnr}, of the 98 % from {low} to {high}")]


def _between_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The rows of the PSNR at key frames and between them; none where every step is one."""
    between = report.get("quality", report).get("between")
    if between is None:
        return []

    def beside_linear(name: str) -> str:
        linear = number(between.get(f"{name}_linear"), "dB")
        return f"{number(between.get(name), 'dB')}; the source, interpolated, {linear}"

    rows = [
        ("  key frames", number(between.get("psnr_key_frames"), "dB")),
        ("  between them", beside_linear("psnr")),
    ]
    share = between.get("fringe_fraction") or 0
    if share:
        rows.append(("  in one only", f"{beside_linear('psnr_fringe')}, {share:.1%} of these"))
    return rows


def loss_rows(model: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The row of the PSNR that coded tables cost; none for other tables."""
    loss = model.get("tables_loss_db")
    return [] if loss is None else [("tables", f"coded, for {loss:.2f} dB of the PSNR")]


def describe_error(error: Exception) -> tuple[str, int]:
    """One line that says what went wrong, and the exit code."""
    if isinstance(error, FhashError):
        line, code = str(error).replace(" (force=True)", ""), error.exit_code
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
    return one_line(" ".join(line.split())), code


def _is_no_memory(error: Exception) -> bool:
    """Whether an error means that memory ran out, also in the words of torch and HDF5."""
    if isinstance(error, RuntimeError):
        return type(error).__name__ == "OutOfMemoryError" or any(
            words in str(error) for words in NO_MEMORY
        )
    return isinstance(error, MemoryError)
