"""The plot of `fhash bench rate`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_bench.rate.measuring import PEERS, RateBench
from fhash_bench.rate.rate import bench_rate, plot
from fhash_formats.errors import InputError, MissingDependencyError


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


Field = Callable[..., np.ndarray]


def test_every_codec_has_a_point_for_everything_asked(result: RateBench) -> None:
    expected = {
        (codec, *goal)
        for codec in (*PEERS, "fhash paper")
        for goal in (("psnr", 35.0), ("psnr", 50.0), ("bound", 0.02))
    }
    assert {(point.codec, point.goal, point.asked) for point in result.points} == expected
    assert len(result.points) == len(expected)
    assert result.refused == {}


def test_missing_values_do_not_count(field: Field) -> None:
    values = field()
    values[1, :, 3:9, 4:11] = np.nan
    values[2, 0, 0, 0] = -np.inf
    config = {"epochs": 1, "width": 4}
    result = bench_rate(
        values, config, targets=(40.0,), bounds=(0.01,), profiles=("paper",), speed=False
    )
    assert result.missing == 6 * 6 * 7 + 1
    assert all(point.reached for point in result.points if point.codec in PEERS)
    assert result.refused == {}
    assert (result.speeds, result.access) == ((), ())


def test_integers_are_compared_as_they_are(field: Field) -> None:
    values = np.round(100 * field()).astype(np.int16)
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.05,), names=("SZ3", "Blosc"), profiles=(), speed=False
    )
    assert result.raw_bytes == values.nbytes
    assert all(point.reached for point in result.points)
    assert all(point.bytes < values.nbytes for point in result.points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ("TTHRESH",)}, "peer is 'TTHRESH'; allowed: SZ3, "),
        ({"profiles": ("small",)}, "profile is 'small'; allowed: "),
        ({"targets": (3.0,)}, "target is 3 dB; allowed: 5 to 200"),
        ({"bounds": (0.0,)}, "bound is 0 of the range"),
        ({"targets": (), "bounds": ()}, "nothing to measure"),
        ({"names": (), "profiles": ()}, "nothing to measure"),
        ({"settings": {"efort": 1}}, "did you mean 'effort'"),
        ({"settings": {"features": ("interval:0:1",)}}, "feature is interval:0:1"),
    ],
)
def test_unsuitable_arguments_are_refused(
    arguments: dict[str, Any], message: str, field: Field
) -> None:
    with pytest.raises(InputError, match=message):
        bench_rate(field(), **arguments)


def test_a_constant_series_has_no_quality_to_compare() -> None:
    with pytest.raises(InputError, match="is constant"):
        bench_rate(np.ones((2, 3, 4, 5)))


def test_peers_need_hdf5plugin(monkeypatch: pytest.MonkeyPatch, field: Field) -> None:
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        bench_rate(field())
