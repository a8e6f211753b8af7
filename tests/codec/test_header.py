"""A header's figures and histories: brief, and never better than they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.header import (
    brief_history,
    brief_quality,
    full_config,
    full_header,
    history_columns,
    history_points,
)

NOTHING: dict[str, object] = {"per_step": [], "ssim_window": {}}


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
    assert brief_quality({**quality, "per_step": steps}, 1.0, 2) == {
        "psnr": 44.9999,
        "rmse": 1.23457,
        "max_abs_error": 0.123457,
        "ssim": None,
        "ssim_window": {"window": 11},
        "per_step": {
            "rmse": [0.0012346, None],
            "max_abs_error": [0.25, None],
        },
    }


def test_the_bulk_in_a_file_is_its_range_and_its_psnr() -> None:
    bulk = {"psnr": 40.1234567, "rmse": 0.01, "range": [1.0, 2.5]}
    assert brief_quality({**NOTHING, "bulk": bulk}, 1.0, 0)["bulk"] == {
        "psnr": 40.1234,
        "range": [1.0, 2.5],
    }
    assert brief_quality({**NOTHING, "bulk": None}, 1.0, 0)["bulk"] is None


def test_history_in_a_file_is_brief() -> None:
    points = [{"seconds": n * 0.12345, "epoch": n, "psnr": 40.123} for n in range(1, 101)]
    brief = brief_history(points, timings=True)
    assert len(brief) == 24
    assert brief[-1] == {"seconds": 12.345, "epoch": 100, "psnr": 40.12}
    assert brief_history(points[:2], timings=False) == [
        {"epoch": 1, "psnr": 40.12},
        {"epoch": 2, "psnr": 40.12},
    ]
    assert brief_history([], timings=True) == []
    expected = [
        {"seconds": None, "epoch": 1, "psnr": 2.5},
        {"seconds": None, "epoch": 2, "psnr": 3},
    ]
    assert (
        history_points({"epoch": [1, 2], "psnr": [2.5, 3]})
        == history_points([{"epoch": 1, "psnr": 2.5}, {"epoch": 2, "psnr": 3}])
        == expected
    )


def test_a_history_with_the_largest_numbers_is_rounded() -> None:
    largest = np.finfo(np.float64).max
    point = {"seconds": largest, "epoch": 1, "psnr": -largest}
    assert brief_history([point], timings=True) == [point]


def test_exact_values_have_no_psnr_in_the_history() -> None:
    points = [{"seconds": 0.5, "epoch": n, "psnr": math.inf if n > 1 else 40.0} for n in (1, 2)]
    brief = brief_history(points, timings=False)
    assert brief == [{"epoch": 1, "psnr": 40.0}, {"epoch": 2}]
    assert history_columns(brief) == brief
    assert history_columns(brief[:1]) == {"epoch": [1], "psnr": [40.0]}
    assert history_columns([]) == {}
    assert history_points(brief)[1] == {"seconds": None, "epoch": 2, "psnr": None}


STEPS = [
    {"step": 0, "psnr": 45.0, "rmse": 0.5, "max_abs_error": 1.0},
    {"step": 1, "psnr": None, "rmse": 0.0, "max_abs_error": 0.0},
]


@pytest.mark.parametrize(
    "per_step",
    [STEPS, {"psnr": [45.0, None], "rmse": [0.5, 0.0], "max_abs_error": [1.0, 0.0]}],
)
def test_figures_of_steps_have_one_shape_whatever_the_file_has(per_step: object) -> None:
    header = {"quality": {"psnr": 45.0, "per_step": per_step}, "history": {"epoch": [3]}}
    full = full_header(header)
    assert full.pop("config") == EncodeConfig().to_dict()
    assert full == {
        "quality": {"psnr": 45.0, "per_step": STEPS},
        "history": [{"seconds": None, "psnr": None, "epoch": 3}],
    }


@pytest.mark.parametrize("per_step", [[], {}, {"psnr": 3}, [7], {"psnr": []}, 0.5, None, "x", True])
def test_figures_of_steps_that_another_writer_misshaped_are_left_out(per_step: object) -> None:
    assert full_header({"quality": {"per_step": per_step}})["quality"]["per_step"] == []


def test_steps_without_some_figures_keep_the_others() -> None:
    full = full_header({"quality": {"per_step": {"psnr": [1.0, 2.0], "rmse": [3.0]}}})
    assert full["quality"]["per_step"] == [
        {"step": 0, "psnr": 1.0, "rmse": 3.0},
        {"step": 1, "psnr": 2.0, "rmse": None},
    ]


def test_what_follows_from_the_rest_is_left_out_and_comes_back() -> None:
    step = {"step": 0, "psnr": 39.9999999, "rmse": 0.0200000001, "max_abs_error": 0.25}
    window = {"window": 11, "sigma": 1.5, "data_range": 2.0, "steps": [0]}
    brief = brief_quality({"per_step": [step], "ssim_window": window}, 2.0, 1)
    assert brief == {
        "per_step": {"rmse": [0.020001], "max_abs_error": [0.25]},
        "ssim_window": {"window": 11, "sigma": 1.5},
    }
    header = {"quality": brief, "value_range": [-1.0, 1.0], "domain": {"shape": [1, 2, 3, 4]}}
    full = full_header(header)["quality"]
    assert full["ssim_window"] == window
    (entry,) = full["per_step"]
    assert 39.99 <= entry["psnr"] <= step["psnr"]
    other = {**window, "steps": [3], "data_range": 1.9}
    brief = brief_quality({"per_step": [], "ssim_window": other}, 2.0, 1)
    assert brief["ssim_window"] == other


@pytest.mark.parametrize(("rmse", "value_range"), [(0.0, [0.0, 1.0]), (0.5, [3.0, 3.0])])
def test_a_step_without_error_or_range_has_no_psnr(rmse: float, value_range: list[float]) -> None:
    quality = {"per_step": {"rmse": [rmse], "max_abs_error": [1.0]}}
    full = full_header({"quality": quality, "value_range": value_range})
    assert full["quality"]["per_step"][0]["psnr"] is None


def test_every_setting_is_there_whatever_the_file_has() -> None:
    header = {"config": {"effort": 7, "later": True}, "model": {"profile": "compact"}}
    config = full_config(header)
    assert config.pop("later") is True
    assert EncodeConfig.from_dict(config) == EncodeConfig(effort=7)


@pytest.mark.parametrize("other", [3, None, "text", {"a": 1}])
def test_a_column_of_a_history_that_is_no_list_is_left_out(other: object) -> None:
    points = history_points({"epoch": [1, 2], "psnr": [30.0, 31.0], "other": other})  # type: ignore[dict-item]
    assert [point["psnr"] for point in points] == [30.0, 31.0]
    assert all("other" not in point for point in points)
