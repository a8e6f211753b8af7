"""Promises held against figures, and remarks, on both sides of their limits."""

from __future__ import annotations

import pytest

from fhash_codec import EncodeConfig
from fhash_codec.promises import DECIDED, FAR_BELOW, decided_by_bulk, missed_promise, remarks


def figures(**others):
    """Figures of a file; by default its promise is kept."""
    psnr_bulk = others.pop("psnr_bulk", 42.0)
    bulk = None if psnr_bulk is None else {"psnr": psnr_bulk, "rmse": 0.1, "range": [1.0, 2.0]}
    usual = {"psnr": 50.0, "rmse": 0.1, "max_abs_error": 0.5, "ratio": 30.0, "data_range": 10.0}
    return {**usual, "promised": {}, "quality": {"bulk": bulk}, "psnr_bulk": psnr_bulk, **others}


@pytest.mark.parametrize(
    ("config", "kept", "missed", "text"),
    [
        ({"max_error": 0.5}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"max_error_rel": 0.05}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"psnr": 50.0}, {}, {"psnr": 49.99}, "49.99 dB over the coreset, 50 dB were asked for"),
        ({"psnr": 50.0}, {"psnr": None, "rmse": 0.0}, {"psnr": None}, "an unknown PSNR"),
        ({"psnr_bulk": 42.0}, {}, {"psnr_bulk": 41.99}, "41.99 dB over the bulk"),
        (
            {"psnr_bulk": 42.0},
            {"psnr_bulk": None, "rmse": 0.0},
            {"psnr_bulk": None},
            "all the same",
        ),
        ({"ratio": 30.0}, {}, {"ratio": 29.99}, "29.99 times smaller than the data"),
    ],
    ids=str,
)
def test_a_promise_is_missed_on_one_side_of_its_number(config, kept, missed, text) -> None:
    promised, settings = dict(config), EncodeConfig(**config)
    assert missed_promise(settings, figures(promised=promised, **kept)) is None
    assert text in (missed_promise(settings, figures(promised=promised, **missed)) or "")


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "remarked"),
    [
        ({"psnr": 50.0}, 50.0, 50.0 - FAR_BELOW, False),
        ({"psnr": 50.0}, 50.0, 49.9 - FAR_BELOW, True),
        ({"psnr": 80.0}, 80.0, 40.0, False),
        ({"psnr": 80.0}, 80.0, 39.9, True),
        ({"max_error": 1.0}, 50.0, 20.0, True),
        ({"psnr": 50.0, "psnr_bulk": 20.0}, 50.0, 20.0, False),
        ({}, 50.0, 20.0, True),
        ({}, 50.0, None, False),
        ({"psnr": 50.0}, None, 20.0, False),
    ],
)
def test_a_bulk_far_below_the_whole_is_remarked(config, psnr, psnr_bulk, remarked) -> None:
    lines = list(remarks(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk)))
    assert bool(lines) == remarked
    assert all("--psnr-bulk 40" in line and "from 1 to 2" in line for line in lines)


def test_the_remark_names_the_promise_that_the_option_stands_beside_or_replaces() -> None:
    def line(config):
        return "".join(remarks(EncodeConfig(**config), figures(psnr_bulk=10.0)))

    assert line({"psnr": 50.0}).endswith("--psnr-bulk 40 beside --psnr keeps them")
    assert line({"max_error_rel": 0.1}).endswith(
        "--psnr-bulk 40 instead of --max-error-rel keeps them"
    )
    assert line({}).endswith("whole; --psnr-bulk 40 keeps them")


@pytest.mark.parametrize(("ratio", "count"), [(31.5, 0), (31.6, 1)])
@pytest.mark.parametrize(("rmse", "why"), [(0.0, "exact already"), (0.1, "no step")])
def test_a_file_much_smaller_than_asked_for_is_remarked(ratio, count, rmse, why) -> None:
    lines = list(remarks(EncodeConfig(ratio=30.0), figures(ratio=ratio, rmse=rmse)))
    assert len(lines) == count
    assert all(why in line and "30 times were asked for" in line for line in lines)


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "decided"),
    [
        ({}, 54.5, 40.0, True),
        ({}, 50.1, 40.0, False),
        ({}, 54.5, 40.1 + DECIDED, False),
        ({"psnr": 45.0, "psnr_bulk": 41.0}, 49.5, 41.0, True),
        ({"psnr": 45.0}, 49.5, 40.0, False),
        ({"psnr_bulk": 41.0}, 49.5, 41.0, False),
        ({"max_error": 1.0}, 54.5, 40.0, False),
        ({}, 54.5, None, False),
    ],
)
def test_a_bulk_that_decided_says_what_it_took(config, psnr, psnr_bulk, decided) -> None:
    line = decided_by_bulk(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk))
    assert (line is not None) == decided
    if line is not None:
        asked = config.get("psnr", 50)
        assert f"--psnr {asked:g} alone leaves it out" in line
        assert "about 50 % of the file" in line.replace("50%", "50 %")
        assert "from 1 to 2" in line
