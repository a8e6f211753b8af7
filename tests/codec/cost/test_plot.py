"""The PNG of a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from fhash_codec.cost.plot import plot
from fhash_codec.cost.results import CostReport


def test_the_plots_are_drawn_in_colours(report: CostReport, tmp_path: Path) -> None:
    less = replace(report, reads=(), pictures=(), per_step=(), stages=(), curves=())
    plot(less, tmp_path / "cost.png")
    with Image.open(tmp_path / "cost.png") as picture:
        assert len(picture.convert("RGB").getcolors(2**24)) > 50
