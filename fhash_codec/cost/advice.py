"""The recommendation of `fhash cost`: the best of what was measured, for each accuracy."""

from __future__ import annotations

from collections.abc import Sequence

from fhash_codec.cost.results import OWN, Advice, Encoded

__all__ = ["TARGETS", "advise", "told"]

TARGETS = (35.0, 40.0, 45.0, 50.0, 55.0, 60.0, 70.0)
"""Accuracies in dB that are asked for."""
UNITS = ("B", "kB", "MB", "GB")
"""Decimal units of sizes."""


def advise(points: Sequence[Encoded], targets: Sequence[float] = TARGETS) -> tuple[Advice, ...]:
    """The best of what was measured for each accuracy, by aim.

    The aims are the smallest and the fastest encoding of this package, and the smallest of the
    peers. Predictions do not count. An accuracy is left out where no encoding reaches it, or where
    the same are the best for a higher one.

    Args:
        points: measured encodings, and predicted ones.
        targets: accuracies in dB over all values.
    """
    rows: list[list[Advice]] = []
    for target in sorted(targets):
        reached = [
            point
            for point in points
            if point.measured and (point.exact or (point.psnr or 0.0) >= target)
        ]
        own = [point for point in reached if point.codec in OWN]
        others = [point for point in reached if point.codec not in OWN]
        row = [
            _advice(min(chosen, key=key), target, aim)
            for aim, chosen, key in (
                ("smallest", own, _size_first),
                ("fastest", own, _time_first),
                ("smallest peer", others, _size_first),
            )
            if chosen
        ]
        if rows and [entry.name for entry in rows[-1]] == [entry.name for entry in row]:
            rows.pop()
        rows.append(row)
    return tuple(
        entry
        for row in rows
        for place, entry in enumerate(row)
        if entry.name not in [before.name for before in row[:place]]
    )


def _size_first(point: Encoded) -> tuple[float, float]:
    return point.bytes or 0, point.seconds or 0.0


def _time_first(point: Encoded) -> tuple[float, float]:
    return point.seconds or 0.0, point.bytes or 0


def _advice(best: Encoded, target: float, aim: str) -> Advice:
    """The advice to take a measured encoding."""
    return Advice(
        psnr=target,
        aim=aim,
        name=best.name,
        options=best.options,
        seconds=best.seconds or 0.0,
        bytes=best.bytes or 0,
        reached=best.psnr,
    )


def told(advice: Advice) -> str:
    """A line such as "45 dB: 1.4 s, 99 kB, the smallest: compact, effort 3, 45 dB"."""
    options = f" ({advice.options})" if advice.options else ""
    return (
        f"{advice.psnr:g} dB: {seconds_text(advice.seconds)}, {bytes_text(advice.bytes)},"
        f" the {advice.aim}: {advice.name}{options}"
    )


def seconds_text(seconds: float) -> str:
    """Seconds in two digits, such as 0.43 s or 54 s."""
    return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"


def bytes_text(count: float) -> str:
    """Bytes in three digits and decimal units."""
    for unit in UNITS:
        if count < 999.5 or unit == UNITS[-1]:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 99.95 else f"{count:.3g} {unit}"
        count /= 1000
    raise AssertionError
