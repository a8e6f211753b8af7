"""Values that a header leaves out come back, and nothing else."""

from __future__ import annotations

import copy

from fhash_formats.container.header import CONFIG_DEFAULTS, DEFAULTS, brief, complete


def test_a_brief_header_comes_back(samples) -> None:
    quality = {"psnr": 40.0, "psnr_domain": 40.0, "rmse": 1.0, "rmse_domain": None}
    whole = {
        **samples.header(),
        "features": ["all"],
        "config": {**CONFIG_DEFAULTS, "effort": 7},
        "training": {"seconds": None, "steps": 3, "epochs": 0, "device": "none"},
        "history": {},
        "quality": {**quality, "ssim_window": {"window": 7, "sigma": 1.5, "steps": [0]}},
    }
    before = copy.deepcopy(whole)
    short = brief(whole)
    assert whole == before
    assert short["config"] == {"effort": 7}
    assert short["training"] == {"steps": 3}
    assert not {"features", "history", "dilation"} & short.keys()
    assert short["quality"] == {
        "psnr": 40.0,
        "rmse": 1.0,
        "rmse_domain": None,
        "ssim_window": {"window": 7, "steps": [0]},
    }
    assert complete(short) == before
    assert complete(complete(short)) == before


def test_a_quality_that_nobody_measured_stays_empty() -> None:
    assert complete({"quality": {}})["quality"] == {}
    assert brief({"quality": {"ssim_window": {}}}) == {"quality": {"ssim_window": {}}}


def test_values_of_another_form_stay() -> None:
    odd = {"config": 5, "training": [1], "features": None, "history": {"epoch": []}, "quality": 3}
    whole = complete(odd)
    assert {key: whole[key] for key in odd} == odd
    assert complete({})["config"] == CONFIG_DEFAULTS
    complete({})["config"]["without"].append("ssim")
    assert CONFIG_DEFAULTS["without"] == DEFAULTS["config"]["without"] == []
