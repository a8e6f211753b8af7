"""A plot of a cost report, described once for the page and for the PNG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

__all__ = ["CYCLE", "SYMBOLS", "Axis", "Panel", "Trace", "single", "style_of"]

STYLES: dict[str, tuple[str, str]] = {
    "compact, effort 1": ("#56B4E9", "circle"),
    "compact, effort 2": ("#56B4E9", "diamond"),
    "compact, effort 3": ("#2583C4", "circle"),
    "compact, effort 5": ("#D55E00", "circle"),
    "compact, effort 7": ("#D55E00", "diamond"),
    "compact, effort 9": ("#D55E00", "star"),
    "paper": ("#CC79A7", "star"),
    "SZ3": ("#009E73", "square"),
    "SPERR": ("#E69F00", "triangle-up"),
    "ZFP": ("#8A8F98", "x"),
}
"""Colour, after Okabe and Ito (told apart by colour-blind people), and symbol of each curve."""
CYCLE = ("#2583C4", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A8F98")
"""Colours of curves that have none of their own."""
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "x", "star", "cross")
"""Symbols of curves that have none of their own."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """An axis.

    Attributes:
        label: what it shows, with its unit.
        log: whether it is logarithmic. reversed: whether small values lie above.
        unit: "B" for bytes, which are shown as kB and MB; empty for plain numbers.
    """

    label: str
    unit: str = ""
    log: bool = False
    reversed: bool = False


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A curve, or bars where its panel has bars.

    Attributes:
        x, y: numbers; x of bars are lengths, y their names.
        text: what the mouse shows at each point.
        hollow: whether the points are predictions.
        line: whether the points are joined.
    """

    name: str
    colour: str
    symbol: str
    x: tuple[float, ...]
    y: tuple[float | str, ...]
    text: tuple[str, ...]
    hollow: bool = False
    line: bool = True


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A plot.

    Attributes:
        section: "encode", "read" or "picture".
        bars: whether the traces are horizontal bars.
        diagonal: whether a line shows where x equals y.
    """

    key: str
    section: str
    title: str
    x: Axis
    y: Axis
    traces: tuple[Trace, ...]
    bars: bool = False
    diagonal: bool = False

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return asdict(self)


def style_of(name: str, place: int) -> tuple[str, str]:
    """Colour and symbol of a curve, by its name or its place."""
    return STYLES.get(name, (CYCLE[place % len(CYCLE)], SYMBOLS[place % len(SYMBOLS)]))


def single(panel: Panel, x: Sequence[float], y: Sequence[Any]) -> Panel:
    """A panel with one curve, or with bars of one colour."""
    text = tuple(
        f"{b}<br>{a:.4g} {panel.x.label}" if panel.bars else f"{a:.6g}: {b:.4g}"
        for a, b in zip(x, y, strict=True)
    )
    trace = Trace(name="", colour=CYCLE[0], symbol=SYMBOLS[0], x=tuple(x), y=tuple(y), text=text)
    return replace(panel, traces=(trace,))
