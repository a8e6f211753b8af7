"""The tables of a cost report, for the page and for the command line."""

from __future__ import annotations

from dataclasses import dataclass

from fhash_codec.cost.results import CostReport, Encoded
from fhash_codec.rendering.march_task import COUNTERS

__all__ = ["Table", "tables"]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of texts; the first column names the row.

    Attributes:
        section: "encode", "read", "picture" or "about".
    """

    section: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(report: CostReport) -> list[Table]:
    """Every table that has rows."""
    made = [
        _advice(report),
        _encodings(report),
        _stages(report),
        _gains(report),
        _reads(report),
        _pictures(report),
        _left_out(report),
    ]
    return [table for table in made if table.rows]


def _advice(report: CostReport) -> Table:
    return Table(
        section="encode",
        title="Recommendation: the best of what was measured",
        header=("for dB", "aim", "encoding", "options", "seconds", "bytes", "reached dB"),
        rows=tuple(
            (
                f"{entry.psnr:g}",
                entry.aim,
                entry.name,
                entry.options,
                f"{entry.seconds:.3g}",
                f"{entry.bytes}",
                _number(entry.reached, ".2f", "exact"),
            )
            for entry in report.advice
        ),
    )


def _encodings(report: CostReport) -> Table:
    units = f" {report.units}" if report.units not in ("", "1") else ""
    return Table(
        section="encode",
        title="Encodings",
        header=(
            "encoding", "seconds", "predicted s", "bytes", "predicted bytes", "ratio", "PSNR dB",
            "predicted dB", "PSNR bulk dB", f"largest error{units}", "options",
        ),
        rows=tuple(
            (
                point.name + (" (misses its promise)" if point.missed else ""),
                _number(point.seconds, ".3g"),
                _number(point.predicted_seconds, ".3g"),
                _number(point.bytes, "d"),
                _number(point.predicted_bytes, "d"),
                _number(point.ratio, ".4g"),
                _psnr(point),
                _number(point.predicted_psnr, ".2f"),
                _number(point.psnr_bulk, ".2f"),
                _number(point.max_abs_error, ".4g"),
                point.options,
            )
            for point in report.encodings
        ),
    )  # fmt: skip


def _psnr(point: Encoded) -> str:
    return "exact" if point.exact else _number(point.psnr, ".2f")


def _stages(report: CostReport) -> Table:
    return Table(
        section="encode",
        title="Stages of the encoding",
        header=("stage", "seconds", "times", "why"),
        rows=tuple(
            (stage.stage, f"{stage.seconds:.3g}", f"{stage.times}", stage.why)
            for stage in report.stages
        ),
    )


def _gains(report: CostReport) -> Table:
    return Table(
        section="encode",
        title="Size of the file in the course of the search, estimated but for the last",
        header=("after", "bytes", "seconds since the search began"),
        rows=tuple(
            (gain.what, f"{gain.bytes}", _number(gain.seconds, ".3g")) for gain in report.gains
        ),
    )


def _reads(report: CostReport) -> Table:
    return Table(
        section="read",
        title="Reads",
        header=("read", "from", "milliseconds", "bytes read", "values", "PSNR dB", "largest error"),
        rows=tuple(
            (
                read.what,
                read.file,
                f"{read.milliseconds:.3g}",
                f"{read.bytes_read}",
                f"{read.values}",
                _number(read.psnr, ".2f"),
                _number(read.max_abs_error, ".4g"),
            )
            for read in report.reads
        ),
    )


def _pictures(report: CostReport) -> Table:
    counters = tuple(COUNTERS)
    return Table(
        section="picture",
        title="Pictures, with everything that was counted",
        header=("varied", "setting", "milliseconds", "PSNR dB", "SSIM", *map(_spaced, counters)),
        rows=tuple(
            (
                picture.group,
                picture.setting + (" (the best)" if picture.best else ""),
                f"{picture.milliseconds:.3g}" if picture.milliseconds else "-",
                "equal"
                if picture.psnr is None and picture.ssim is not None and not picture.best
                else _number(picture.psnr, ".1f"),
                _number(picture.ssim, ".5f"),
                *(f"{picture.counters[name]}" for name in counters),
            )
            for picture in report.pictures
        ),
    )


def _left_out(report: CostReport) -> Table:
    return Table(
        section="about",
        title="Left out",
        header=("what", "why"),
        rows=tuple((entry.what, entry.why) for entry in report.left_out),
    )


def _number(value: float | None, form: str, none: str = "-") -> str:
    return none if value is None else format(value, form)


def _spaced(name: str) -> str:
    return name.replace("_", " ")
