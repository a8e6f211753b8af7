"""Rows of an ablation: medians over seeds."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from fhash_codec.bench.ablate.results import AblateBench, Run
from fhash_formats.errors import InputError

RUN: dict[str, Any] = {
    "axis": "effort",
    "settings": {"effort": 5},
    "reference": True,
    "seed": 0,
    "seconds": 2.0,
    "training_seconds": None,
    "epochs": 0,
    "bytes": 100,
    "parameters": 7,
    "points_per_second": 3e6,
    "psnr": 40.0,
    "psnr_domain": 41.0,
    "max_abs_error": 0.5,
}


def bench(*changes: dict[str, Any]) -> AblateBench:
    runs = tuple(Run(**{**RUN, **change}) for change in changes)
    return AblateBench(
        series="s", shape=(1, 2, 3, 4), features=("all",), common={}, runs=runs, left_out=()
    )


def test_rows_have_medians_and_the_spread() -> None:
    other = {"settings": {"effort": 1}, "reference": False}
    reference, row = bench(
        {},
        {"seed": 1, "psnr": 42.0},
        {**other, "psnr": 30.0, "bytes": 50, "seconds": 1.0},
        {**other, "psnr": 33.0, "bytes": 70, "seconds": 3.0, "seed": 1},
    ).rows
    assert (reference.psnr, reference.psnr_spread) == (41.0, 2.0)
    assert (row.psnr, row.psnr_gain, row.psnr_spread) == (31.5, -9.5, 3.0)
    assert (row.bytes, row.bytes_ratio, row.seconds_ratio) == (60, 0.6, 1.0)


def test_without_its_reference_a_row_has_no_ratios() -> None:
    (row,) = bench({"reference": False, "psnr": None}).rows
    assert (row.psnr, row.psnr_gain, row.bytes_ratio, row.seconds_ratio) == (None, None, None, None)


def test_records_come_back_from_their_dict() -> None:
    run = Run(**{**RUN, "settings": {"without": ("head",)}}, curve=({"epoch": 1, "psnr": 3.0},))
    assert Run.from_dict(json.loads(json.dumps(asdict(run)))) == run
    with pytest.raises(InputError, match="not a run of bench ablate"):
        Run.from_dict({**asdict(run), "more": 1})
