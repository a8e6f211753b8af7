"""The picture of an ablation."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from fhash_codec.bench.ablate.plot import plot
from fhash_codec.bench.ablate.results import AblateBench, Run

pytest.importorskip("matplotlib")


def run(axis: str, number: int, curve: bool) -> Run:
    points = tuple({"epoch": n, "seconds": n, "psnr": 10.0 * n} for n in (1, 2)) if curve else ()
    return Run(
        axis=axis,
        settings={"effort": number},
        reference=number == 0,
        seed=0,
        seconds=1.0 + number,
        training_seconds=None,
        epochs=2,
        bytes=1000 + number,
        parameters=10,
        points_per_second=3e6,
        psnr=None if number == 1 else 40.0,
        psnr_domain=None,
        max_abs_error=None,
        curve=points,
    )


def test_every_axis_has_a_panel(tmp_path: Path) -> None:
    widths = []
    for axes in (["a"], ["a", "b", "c", "d"]):
        runs = tuple(run(axis, number, axis == "a") for axis in axes for number in range(10))
        result = AblateBench(
            series="s", shape=(1, 2, 3, 4), features=("all",), common={}, runs=runs, left_out=()
        )
        plot(result, tmp_path / "p.png")
        with Image.open(tmp_path / "p.png") as image:
            widths.append(image.size)
    assert widths[1][0] > 2 * widths[0][0]
    assert widths[1][1] > widths[0][1]
