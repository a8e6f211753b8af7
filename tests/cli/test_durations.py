"""Times as text: `90s`, `2m`, `1h`, or seconds."""

from __future__ import annotations

import click
import pytest

from fhash_cli.durations import DurationType


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("2m", 120), ("1.5h", 5400), ("45", 45), (" 3 m", 180)]
)
def test_a_time_is_a_number_of_seconds(text: str, seconds: float) -> None:
    assert DurationType().convert(text, None, None) == seconds


@pytest.mark.parametrize("text", ["soon", "2d", "-3s", "0s", "48h", ""])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match=r"is no time|allowed: 1s to 24h"):
        DurationType().convert(text, None, None)
