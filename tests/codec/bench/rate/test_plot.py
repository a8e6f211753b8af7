"""The plot of `fhash bench rate`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fhash_codec.bench.rate.plot import plot
from fhash_codec.bench.rate.results import RateBench
from fhash_formats.errors import MissingDependencyError


def test_the_plot_needs_matplotlib(
    monkeypatch: pytest.MonkeyPatch, result: RateBench, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        plot(result, tmp_path / "rate.png")


def test_the_plot_has_a_panel_for_each_kind_of_quality(result: RateBench, tmp_path: Path) -> None:
    from PIL import Image

    plot(result, tmp_path / "both.png")
    plot(
        replace(result, points=tuple(point for point in result.points if point.goal == "psnr")),
        tmp_path / "one.png",
    )
    with Image.open(tmp_path / "both.png") as both, Image.open(tmp_path / "one.png") as one:
        assert both.width > 1.5 * one.width
        assert len(both.convert("RGB").getcolors(2**24)) > 50
