"""Times of the clock as text: `90s`, `2m`, `1h`."""

from __future__ import annotations

import re
from typing import Any

import click

MAX_BUDGET = 86_400.0
"""Longest budget, in seconds."""


class DurationType(click.ParamType[float]):
    """A time such as 90s, 2m or 1h; a plain number is in seconds."""

    name = "TIME"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Seconds; refuses what is no time, and one outside of 1 s to 24 h."""
        if isinstance(value, float):
            return value
        match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh]?)", str(value).strip())
        if match is None:
            self.fail(f"'{value}' is no time; write one such as 90s, 2m or 1h", param, ctx)
        seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]
        if not 1 <= seconds <= MAX_BUDGET:
            self.fail(f"'{value}' is {seconds:g} s; allowed: 1s to 24h", param, ctx)
        return seconds
