"""Plots of reads and pictures: accuracy against milliseconds and bytes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fhash_codec.cost.advice import bytes_text
from fhash_codec.cost.panel import CYCLE, SYMBOLS, Axis, Panel, Trace, single, style_of
from fhash_codec.cost.results import CostReport, Picture

__all__ = ["picture_panels", "read_panels"]

KNOBS = ("step length", "level of detail", "level of detail, first picture", "threshold")
"""Groups of pictures that trade time for likeness."""


def read_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the reads, empty ones included."""
    kinds = dict.fromkeys(read.what for read in report.reads)
    for key, title, x, pick in (
        ("read-ms", "Accuracy of reads against time", Axis(label="milliseconds", log=True), 0),
        (
            "read-bytes",
            "Accuracy of reads against bytes",
            Axis(label="bytes read", unit="B", log=True),
            1,
        ),
    ):
        traces = []
        for place, kind in enumerate(kinds):
            points = sorted(
                (
                    (read.milliseconds, float(read.bytes_read))[pick],
                    read.psnr,
                    f"{read.what}<br>{read.file}<br>{read.milliseconds:.3g} ms,"
                    f" {bytes_text(read.bytes_read)}<br>{read.psnr:.2f} dB",
                )
                for read in report.reads
                if read.what == kind and read.psnr is not None
            )
            traces.append(
                Trace(
                    name=kind,
                    colour=CYCLE[place % len(CYCLE)],
                    symbol=SYMBOLS[place % len(SYMBOLS)],
                    x=tuple(x for x, _, _ in points),
                    y=tuple(y for _, y, _ in points),
                    text=tuple(text for *_, text in points),
                    line=False,
                )
            )
        yield Panel(
            key=key,
            section="read",
            title=title,
            x=x,
            y=Axis(label="PSNR of what was read, dB"),
            traces=tuple(trace for trace in traces if trace.x),
        )


def picture_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the pictures, empty ones included."""
    for key, title, y, pick in (
        ("picture-psnr", "Pictures: likeness against time", "PSNR to the finest picture, dB", 0),
        ("picture-ssim", "Pictures: SSIM against time", "SSIM to the finest picture", 1),
    ):
        yield Panel(
            key=key,
            section="picture",
            title=title,
            x=Axis(label="milliseconds", log=True),
            y=Axis(label=y),
            traces=tuple(_knobs(report.pictures, pick)),
        )
    effects = [picture for picture in report.pictures if picture.group == "effect"]
    yield single(
        Panel(
            key="effects",
            section="picture",
            title="Effects, each alone",
            x=Axis(label="milliseconds"),
            y=Axis(label=""),
            traces=(),
            bars=True,
        ),
        [picture.milliseconds for picture in reversed(effects)],
        [picture.setting for picture in reversed(effects)],
    )
    yield _pictures_by_size(report)


def _knobs(pictures: Iterable[Picture], pick: int) -> Iterator[Trace]:
    """A curve of time and likeness for each knob."""
    groups = dict.fromkeys(each.group for each in pictures if each.group in KNOBS)
    for place, group in enumerate(groups):
        points = [  # in the order of the settings: times alone may go up and down
            (each.milliseconds, value, f"{group} {each.setting}<br>{each.milliseconds:.3g} ms")
            for each in pictures
            if each.group == group
            and not each.best
            and (value := (each.psnr, each.ssim)[pick]) is not None
        ]
        if points:
            yield Trace(
                name=group,
                colour=CYCLE[place],
                symbol=SYMBOLS[place],
                x=tuple(x for x, _, _ in points),
                y=tuple(y for _, y, _ in points),
                text=tuple(text for *_, text in points),
            )


def _pictures_by_size(report: CostReport) -> Panel:
    """Likeness of the pictures of files to that of the source, against the size of the files."""
    sizes = {point.name: point for point in report.encodings if point.bytes}
    shown = [
        (sizes[each.setting], each)
        for each in report.pictures
        if each.group == "encoding" and each.setting in sizes and each.psnr is not None
    ]
    traces = []
    for place, group in enumerate(dict.fromkeys(point.group for point, _ in shown)):
        colour, symbol = style_of(group, place)
        mine = sorted(
            (
                float(point.bytes or 0),
                float(each.psnr or 0.0),
                f"{each.setting}<br>{bytes_text(point.bytes or 0)}"
                f"<br>picture {each.psnr:.1f} dB, SSIM {each.ssim:.4f}",
            )
            for point, each in shown
            if point.group == group
        )
        traces.append(
            Trace(
                name=group,
                colour=colour,
                symbol=symbol,
                x=tuple(x for x, _, _ in mine),
                y=tuple(y for _, y, _ in mine),
                text=tuple(text for *_, text in mine),
            )
        )
    return Panel(
        key="picture-bytes",
        section="picture",
        title="Likeness to the source's picture against size",
        x=Axis(label="size of the file, bytes", unit="B", log=True),
        y=Axis(label="PSNR of the picture, dB"),
        traces=tuple(traces),
    )
