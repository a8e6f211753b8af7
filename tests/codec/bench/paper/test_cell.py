"""Cells: their JSON, and where a curve reaches a quality."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from fhash_codec.bench.paper.cell import Cell, Point, settings_id
from fhash_formats.errors import InputError

CELL = Cell(
    encoding="fhash",
    protocol="equal",
    data_set="flame",
    shape=(34, 14, 43, 50),
    feature="segmentation",
    key_frames=(0, 10, 21, 33),
    coreset_share=0.3,
    box=((0, 14), (2, 40), (0, 50)),
    seed=1,
    parameters={"tables": 100, "mlp": 20},
    buckets_used=0.4,
    bytes=480,
    raw_bytes=4_000_000,
    samples_an_epoch=1000,
    steps_an_epoch=20,
    samples_per_second=1e5,
    training_seconds=0.2,
    curve=(
        Point(step=0, epoch=0, seconds=0.0, coreset_psnr=5.0),
        Point(step=20, epoch=1, seconds=0.1, coreset_psnr=None),
        Point(step=40, epoch=2, seconds=0.2, coreset_psnr=25.0, picture_psnr=31.0),
    ),
    trial=({"steps": 20, "psnr": 25.0},),
)


def test_json_gives_the_same_cell() -> None:
    assert Cell.from_dict(json.loads(json.dumps(CELL.to_dict()))) == CELL


def test_missing_and_unknown_fields_are_refused() -> None:
    values = CELL.to_dict()
    with pytest.raises(InputError, match="needed: "):
        Cell.from_dict(values | {"colour": 1})
    del values["seed"]
    with pytest.raises(InputError, match="needed: "):
        Cell.from_dict(values)


def test_the_first_point_that_reaches_a_quality() -> None:
    assert CELL.reached(20) == CELL.curve[2]
    assert CELL.reached(5) == CELL.curve[0]
    assert CELL.reached(30) is None
    assert CELL.reached(30, "picture_psnr") == CELL.curve[2]
    assert replace(CELL, curve=()).reached(5) is None


def test_settings_identify() -> None:
    assert settings_id({"a": 1, "b": [2]}) == settings_id({"b": [2], "a": 1})
    assert settings_id({"a": 1}) != settings_id({"a": 2})
