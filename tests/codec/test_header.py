"""A header's figures and histories: brief, and never better than they are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.header import brief_history, brief_quality, full_header, history_points
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import CONFIG_DEFAULTS

NOTHING: dict[str, object] = {"per_step": [], "ssim_window": {}}
WRITER = ContainerWriter("unused.fhz")
"""A writer that gets nothing: few steps have their figures in the header."""


def test_figures_in_a_file_are_brief_and_never_better_than_they_are() -> None:
    steps = [
        {"step": 0, "psnr": 45.129876, "rmse": 0.00123456789, "max_abs_error": 0.25},
        dict.fromkeys(("psnr", "rmse", "max_abs_error")),
    ]
    quality = {
        "psnr": 44.9999999,
        "rmse": 1.23456701,
        "max_abs_error": 0.1234561,
        "ssim": None,
        "ssim_window": {"window": 11},
    }
    assert brief_quality(WRITER, {**quality, "per_step": steps}, 1.0, 2) == {
        "psnr": 44.9999,
        "rmse": 1.23457,
        "max_abs_error": 0.123457,
        "ssim": None,
        "ssim_window": {"window": 11},
        "steps": {"rmse": [5816, 0, -2], "max_abs_error": [1204, 0, -2]},
    }


def test_the_bulk_in_a_file_is_its_range_and_its_psnr() -> None:
    bulk = {"psnr": 40.1234567, "rmse": 0.01, "range": [1.0, 2.5]}
    assert brief_quality(WRITER, {**NOTHING, "bulk": bulk}, 1.0, 0)["bulk"] == {
        "psnr": 40.1234,
        "range": [1.0, 2.5],
    }
    assert brief_quality(WRITER, {**NOTHING, "bulk": None}, 1.0, 0)["bulk"] is None


def test_history_in_a_file_is_brief() -> None:
    points = [{"seconds": n * 0.12345, "epoch": n, "psnr": 40.123} for n in range(1, 101)]
    brief = brief_history(points, timings=True)
    assert {name: len(values) for name, values in brief.items()} == {
        **dict.fromkeys(("epoch", "seconds", "psnr"), 24)
    }
    last = {"seconds": 12.345, "epoch": 100, "psnr": 40.12}
    assert history_points(brief)[-1] == last
    assert brief_history(points[:2], timings=False) == {"epoch": [1, 2], "psnr": [40.12, 40.12]}
    assert brief_history([], timings=True) == {}
    assert history_points({"epoch": [1, 2], "psnr": [2.5, 3], "other": 5}) == [
        {"seconds": None, "epoch": 1, "psnr": 2.5},
        {"seconds": None, "epoch": 2, "psnr": 3},
    ]
    assert history_points({}) == []


def test_a_history_with_the_largest_numbers_is_rounded() -> None:
    largest = np.finfo(np.float64).max
    point = {"seconds": largest, "epoch": 1, "psnr": -largest}
    assert history_points(brief_history([point], timings=True)) == [point]


def test_exact_values_have_no_psnr_in_the_history() -> None:
    points = [{"seconds": 0.5, "epoch": n, "psnr": math.inf if n > 1 else 40.0} for n in (1, 2)]
    brief = brief_history(points, timings=False)
    assert brief == {"epoch": [1, 2], "psnr": [40.0, None]}
    assert history_points(brief)[1] == {"seconds": None, "epoch": 2, "psnr": None}


def header(quality: dict[str, Any], value_range: tuple[float, float] = (-1.0, 1.0)) -> Any:
    """A header of one step."""
    return {
        "value_range": list(value_range),
        "domain": {"shape": [1, 2, 3, 4]},
        "model": {"gains": [["start", 9, 0.5], ["end", 7], 5]},
        "history": {"epoch": [3]},
        "quality": quality,
    }


def test_what_follows_from_the_rest_is_left_out_and_comes_back() -> None:
    step = {"step": 0, "psnr": 39.9999999, "rmse": 0.0200000001, "max_abs_error": 0.25}
    window = {"window": 11, "sigma": 1.5, "data_range": 2.0, "steps": [0]}
    brief = brief_quality(WRITER, {"per_step": [step], "ssim_window": window}, 2.0, 1)
    assert brief["ssim_window"] == {"window": 11, "sigma": 1.5}
    assert brief.keys() == {"steps", "ssim_window"}
    full = full_header(header(brief), {})
    assert full["quality"]["ssim_window"] == window
    (entry,) = full["quality"]["per_step"]
    assert 39.98 <= entry["psnr"] <= step["psnr"]
    assert step["rmse"] <= entry["rmse"] <= 1.00125 * step["rmse"]
    assert full["history"] == [{"seconds": None, "psnr": None, "epoch": 3}]
    assert full["model"]["gains"] == [
        {"what": "start", "bytes": 9, "seconds": 0.5},
        {"what": "end", "bytes": 7},
    ]
    other = {**window, "steps": [3], "data_range": 1.9}
    brief = brief_quality(WRITER, {"per_step": [], "ssim_window": other}, 2.0, 1)
    assert brief["ssim_window"] == other


@pytest.mark.parametrize(("level", "ends"), [(-1, (0.0, 1.0)), (5, (3.0, 3.0)), (-2, (0.0, 1.0))])
def test_a_step_without_error_or_range_has_no_psnr(level: int, ends: tuple[float, float]) -> None:
    quality = {"steps": {"rmse": [0, level], "max_abs_error": [0, 0]}}
    full = full_header(header(quality, ends), {})
    assert full["quality"]["per_step"][0]["psnr"] is None


def test_the_settings_left_out_are_settings_of_the_encoder() -> None:
    assert CONFIG_DEFAULTS.keys() <= EncodeConfig().to_dict().keys()


def test_a_file_tells_all_that_was_measured(tmp_path: Path) -> None:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 5, 6, 7)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    report = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=45.0, effort=2))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert "steps" in volume.container.header["quality"]
        info = volume.info
        assert volume.config == EncodeConfig(psnr=45.0, effort=2).to_dict()
        assert info["config"] == volume.config
    assert {"psnr_domain", "rmse_domain", "max_abs_error_domain"} <= info["quality"].keys()
    assert info["quality"]["ssim_window"]["window"] == 11
    assert info["model"]["gains"] == report["gains"]
    assert {"what", "bytes", "seconds"} == report["gains"][0].keys()
    for kept, measured in zip(
        info["quality"]["per_step"], report["quality"]["per_step"], strict=True
    ):
        assert kept["step"] == measured["step"]
        assert kept["rmse"] >= measured["rmse"] * (1 - 1e-12)
        assert math.isclose(kept["rmse"], measured["rmse"], rel_tol=2e-3)
        assert kept["psnr"] <= measured["psnr"]
