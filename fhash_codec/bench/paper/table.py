"""A table of results: values, as text, Markdown and JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

__all__ = ["NR", "QUOTED", "PaperTable", "Spread", "Value", "shown"]

NR = "NR"
"""Text of a quality that was not reached."""
QUOTED = "quoted"
"""Mark of a figure that the paper prints and nobody measured here."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over seeds; infinite where a seed did not reach what was asked.

    Attributes:
        median, low, high: over the seeds.
        seeds: number of seeds.
        digits: significant digits as text.
    """

    median: float
    low: float
    high: float
    seeds: int
    digits: int = 3

    @classmethod
    def of(cls, figures: Sequence[float | None], digits: int = 3) -> Spread | None:
        """The spread of the figures of some seeds, None for not reached; None without a seed."""
        numbers = sorted(math.inf if figure is None else float(figure) for figure in figures)
        if not numbers:
            return None
        return cls(
            median=median(numbers),
            low=numbers[0],
            high=numbers[-1],
            seeds=len(numbers),
            digits=digits,
        )

    def __str__(self) -> str:
        """The median; with several seeds the smallest and the largest in brackets as well."""
        middle = _number(self.median, self.digits)
        if self.seeds == 1 or self.low == self.high:
            return middle
        return f"{middle} ({_number(self.low, self.digits)}-{_number(self.high, self.digits)})"

    def to_dict(self) -> dict[str, Any]:
        """JSON values; a figure that is not reached is "NR"."""
        figures = {"median": self.median, "low": self.low, "high": self.high}
        return {
            **{name: x if math.isfinite(x) else NR for name, x in figures.items()},
            "seeds": self.seeds,
        }


Value = Spread | float | int | str | None
"""A cell of a table; None where nothing was measured."""


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of results beside the paper's.

    Attributes:
        name: for files and JSON, such as "table-3-equal".
        title: one line.
        columns: headings; those of quoted figures say so.
        rows: values.
        notes: lines under the table.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    notes: tuple[str, ...] = ()

    def lines(self) -> list[list[str]]:
        """The heading and the rows as text, all of equal length."""
        return [list(self.columns), *([shown(value) for value in row] for row in self.rows)]

    def markdown(self) -> str:
        """The table as Markdown, with its title and its notes."""
        heading, *rows = ([cell.replace("|", "\\|") for cell in line] for line in self.lines())
        lines = [f"### {self.title}", "", _line(heading), _line(["---"] * len(heading))]
        lines += [_line(row) for row in rows]
        lines += ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join(lines) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """JSON values: each row by its headings."""
        return {
            "name": self.name,
            "title": self.title,
            "rows": [
                {
                    column: value.to_dict() if isinstance(value, Spread) else value
                    for column, value in zip(self.columns, row, strict=True)
                }
                for row in self.rows
            ],
            "notes": list(self.notes),
        }


def shown(value: Value) -> str:
    """A value as text: a dash where nothing was measured, numbers with at most four digits."""
    if value is None:
        return "-"
    if isinstance(value, str | Spread):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else _number(value, 4, least=1)


def _number(value: float, digits: int, least: int = 0) -> str:
    """A number with some significant digits, no exponent and no idle zeros; NR if infinite.

    least: decimals that are kept of large numbers too.
    """
    if not math.isfinite(value):
        return NR
    if value == 0:
        return "0"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), least)
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
