"""Lean headers: what is left out comes back; figures of steps are never better than they are."""

from __future__ import annotations

import copy
import json
import math
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.header import full_config, full_header
from fhash_codec.lean_header import CONFIG_DEFAULTS, full, lean, may_be_lean

RMSE = [0.001, 0.0, None, 0.00123456, 0.5]
LARGEST = [0.004, 0.0, None, 0.0041999, 1.9]


def header(**quality: Any) -> dict[str, Any]:
    """A header as the encoder has it before it becomes lean."""
    return {
        "format_version": [1, 5],
        "value_range": [-1.0, 3.0],
        "domain": {"shape": [5, 2, 3, 4]},
        "model": {
            "profile": "compact",
            "gains": [{"what": "start", "bytes": 9, "seconds": 0.5}, {"what": "end", "bytes": 7}],
        },
        "config": EncodeConfig(effort=7, psnr=41.5).to_dict(),
        "history": [],
        "quality": {
            "psnr": 40.0,
            "psnr_domain": 40.0,
            "rmse": 0.04,
            "rmse_domain": 0.05,
            "max_abs_error": 1.9,
            "max_abs_error_domain": None,
            "ssim": 0.5,
            "ssim_window": {"window": 11, "sigma": 1.5},
            "per_step": {"rmse": RMSE, "max_abs_error": LARGEST},
            **quality,
        },
    }


def test_a_lean_header_comes_back_and_is_shorter() -> None:
    whole = header()
    before = copy.deepcopy(whole)
    short = lean(whole)
    assert whole == before
    assert short["config"] == {"effort": 7, "psnr": 41.5}
    assert short["model"]["gains"] == [["start", 9, 0.5], ["end", 7]]
    assert not {"psnr_domain", "ssim_window", "per_step"} & short["quality"].keys()
    assert short["quality"]["max_abs_error_domain"] is None
    assert len(json.dumps(short)) < 0.5 * len(json.dumps(whole))
    back = full(json.loads(json.dumps(short)))
    steps, expected = back["quality"].pop("per_step"), before["quality"].pop("per_step")
    back["config"] = full_config(short)
    assert back == before
    for name, figures in expected.items():
        for new, old in zip(steps[name], figures, strict=True):
            assert new == old if not old else old * (1 - 1e-12) <= new <= old * 1.00125
    assert max(value for value in steps["max_abs_error"] if value is not None) == 1.9
    assert full_header(short)["quality"]["per_step"][1] == {
        "step": 1, "psnr": None, "rmse": 0.0, "max_abs_error": 0.0,
    }  # fmt: skip


def test_other_windows_stay() -> None:
    window = {"window": 7, "sigma": 1.5, "steps": [0, 2]}
    short = lean(header(ssim_window=window))
    assert short["quality"]["ssim_window"] == {"window": 7, "steps": [0, 2]}
    assert full(short)["quality"]["ssim_window"] == window


@pytest.mark.parametrize(
    ("value_range", "rmse"), [([2.0, 2.0], 0.0), ([0.0, 1e-300], 1e300)], ids=["no range", "beyond"]
)
def test_figures_of_steps_without_decibels_stay(value_range: list[float], rmse: float) -> None:
    figures = {"rmse": [rmse], "max_abs_error": [rmse]}
    whole = header(per_step=figures) | {"value_range": value_range}
    assert lean(whole)["quality"]["per_step"] == figures


@pytest.mark.parametrize(
    "steps",
    [None, 5, [], {}, {"rmse": []}, {"rmse": [0], "max_abs_error": "x"},
     {"rmse": [None, 1], "max_abs_error": [0, 1]}, {"rmse": [0, 1.5], "max_abs_error": [0, 1]},
     {"rmse": [True], "max_abs_error": [0]}],
)  # fmt: skip
def test_misshapen_figures_are_left_out(steps: object) -> None:
    whole = header(steps=steps)
    del whole["quality"]["per_step"]
    assert full_header(whole)["quality"]["per_step"] == []


def test_levels_beyond_float64_have_no_figure() -> None:
    whole = header(steps={"rmse": [-(10**6), 0, 10**6], "max_abs_error": [10**6, 0, 5]})
    assert full(whole)["quality"]["per_step"]["rmse"][0] is None
    assert full(whole)["quality"]["per_step"]["max_abs_error"] == [None, None]


@pytest.mark.parametrize("gains", [None, 5, "x", [None, 3, "a"]])
def test_misshapen_gains_are_left_out(gains: object) -> None:
    whole = header()
    whole["model"]["gains"] = gains
    assert full(whole)["model"]["gains"] == []


def test_headers_of_other_files_stay() -> None:
    old = header() | {"format_version": [1, 4]}
    paper = header()
    paper["model"]["profile"] = "paper"
    for other in (old, paper):
        assert not may_be_lean(other)
        assert full(other) == other
    assert full_config(old | {"config": {}}) == EncodeConfig().to_dict()


def test_the_settings_left_out_are_those_of_the_format() -> None:
    document = files("fhash_formats").joinpath("FORMAT.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```json config-defaults\n(.*?)^```", document, re.M | re.S)
    assert json.loads(text) == CONFIG_DEFAULTS
    assert CONFIG_DEFAULTS.keys() <= EncodeConfig().to_dict().keys()


def test_a_file_tells_all_it_told_before(tmp_path: Path) -> None:
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
