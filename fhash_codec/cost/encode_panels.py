"""Plots of encodings: accuracy against time and size, trainings, predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from fhash_codec.cost.advice import bytes_text, seconds_text
from fhash_codec.cost.panel import Axis, Panel, Trace, single, style_of
from fhash_codec.cost.results import CostReport, Encoded

__all__ = ["encode_panels"]

Pick = Callable[[Encoded, bool], float | None]
"""Figure of an encoding, as measured or as predicted."""


def encode_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the encodings, empty ones included."""

    def seconds(point: Encoded, measured: bool) -> float | None:
        return point.seconds if measured else point.predicted_seconds

    def size(point: Encoded, measured: bool) -> float | None:
        return point.bytes if measured else point.predicted_bytes

    def psnr(point: Encoded, measured: bool) -> float | None:
        return point.psnr if measured else point.predicted_psnr

    def bulk(point: Encoded, measured: bool) -> float | None:
        return point.psnr_bulk if measured else None

    def largest(point: Encoded, measured: bool) -> float | None:
        return point.max_abs_error if measured else None

    units = f", {report.units}" if report.units not in ("", "1") else ", in the units of the data"
    second, byte = (
        Axis(label="seconds of encoding", log=True),
        Axis(label="size of the file, bytes", unit="B", log=True),
    )
    decibel = Axis(label="PSNR of all values, dB")
    for key, title, x, y, x_of, y_of in (
        ("encode-seconds", "Accuracy against time", second, decibel, seconds, psnr),
        ("encode-bytes", "Accuracy against size", byte, decibel, size, psnr),
        (
            "encode-bulk",
            "Accuracy of the bulk against size",
            byte,
            Axis(label="PSNR of the middle 98 %, dB"),
            size,
            bulk,
        ),
        (
            "encode-error",
            "Largest error against size",
            byte,
            Axis(label=f"largest error{units}", log=True, reversed=True),
            size,
            largest,
        ),
    ):
        traces = tuple(_frontier(report.encodings, x_of, y_of))
        if key == "encode-seconds":
            traces += tuple(trace for trace in _trainings(report) if trace.name.startswith("paper"))
        if len(report.encodings) > 1:
            yield Panel(key=key, section="encode", title=title, x=x, y=y, traces=traces)
    yield from _courses(report)
    yield _foretold(report.encodings)


def _frontier(points: Sequence[Encoded], x_of: Pick, y_of: Pick) -> Iterator[Trace]:
    """A curve of measured points for each group, and one of hollow points for the rest."""
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        colour, symbol = style_of(group, place)
        for measured in (True, False):
            mine = [
                (x, y, _hover(point, measured))
                for point in points
                if point.group == group
                and (point.measured if measured else point.predicted_seconds is not None)
                and (x := x_of(point, measured)) is not None
                and (y := y_of(point, measured)) is not None
                and x > 0
            ]
            if mine:
                mine.sort(key=lambda place: (place[1], place[0]))
                xs, ys, texts = zip(*mine, strict=True)
                yield Trace(
                    name=group if measured else f"{group}, predicted",
                    colour=colour,
                    symbol=symbol,
                    x=xs,
                    y=ys,
                    text=texts,
                    hollow=not measured,
                    line=measured,
                )


def _hover(point: Encoded, measured: bool) -> str:
    """Text that the mouse shows at an encoding."""
    seconds, count, psnr = (
        (point.seconds, point.bytes, point.psnr)
        if measured
        else (point.predicted_seconds, point.predicted_bytes, point.predicted_psnr)
    )
    parts = [
        point.name if measured else f"{point.name}, predicted",
        "" if seconds is None else seconds_text(seconds),
        "" if count is None else bytes_text(count),
        "" if psnr is None else f"{psnr:.2f} dB",
        "misses its promise" if measured and point.missed else "",
    ]
    return "<br>".join(part for part in parts if part)


def _trainings(report: CostReport) -> Iterator[Trace]:
    """A curve of accuracy on samples against seconds for each training."""
    for place, curve in enumerate(report.curves):
        points = [
            (point["seconds"], point["psnr"], point["epoch"])
            for point in curve.points
            if point["seconds"] and point["psnr"] is not None
        ]
        colour, symbol = style_of("paper" if curve.name.startswith("paper") else curve.name, place)
        if points:
            yield Trace(
                name=f"{curve.name}, in training",
                colour=colour,
                symbol="cross" if curve.name.startswith("paper") else symbol,
                x=tuple(float(seconds) for seconds, _, _ in points),
                y=tuple(float(psnr) for _, psnr, _ in points),
                text=tuple(f"{curve.name}<br>epoch or update {epoch:g}" for *_, epoch in points),
            )


def _courses(report: CostReport) -> Iterator[Panel]:
    """The trainings, and what the stages and steps of one encoding have."""
    yield Panel(
        key="training",
        section="encode",
        title="Course of the trainings",
        x=Axis(label="seconds of training", log=True),
        y=Axis(label="PSNR on samples, dB"),
        traces=tuple(_trainings(report)),
    )
    stages = [stage for stage in reversed(report.stages) if stage.times]
    yield single(
        Panel(
            key="stages",
            section="encode",
            title="Seconds of each stage",
            x=Axis(label="seconds"),
            y=Axis(label=""),
            traces=(),
            bars=True,
        ),
        [stage.seconds for stage in stages],
        [stage.stage for stage in stages],
    )
    steps = [step for step in report.per_step if step["psnr"] is not None]
    yield single(
        Panel(
            key="per-step",
            section="encode",
            title="Accuracy of each step",
            x=Axis(label="step"),
            y=Axis(label="PSNR, dB"),
            traces=(),
        ),
        [float(step["step"]) for step in steps],
        [step["psnr"] for step in steps],
    )


def _foretold(points: Sequence[Encoded]) -> Panel:
    """Seconds that were predicted beside those measured."""
    traces = []
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        colour, symbol = style_of(group, place)
        mine = sorted(
            (point.predicted_seconds, point.seconds, point.name)
            for point in points
            if point.group == group and point.seconds and point.predicted_seconds
        )
        if mine:
            traces.append(
                Trace(
                    name=group,
                    colour=colour,
                    symbol=symbol,
                    x=tuple(predicted for predicted, _, _ in mine),
                    y=tuple(seconds for _, seconds, _ in mine),
                    text=tuple(
                        f"{name}<br>predicted {a:.3g} s, took {b:.3g} s ({b / a:.2f} x)"
                        for a, b, name in mine
                    ),
                    line=False,
                )
            )
    return Panel(
        key="predicted",
        section="encode",
        title="Predicted and measured time",
        x=Axis(label="seconds predicted", log=True),
        y=Axis(label="seconds measured", log=True),
        traces=tuple(traces),
        diagonal=True,
    )
