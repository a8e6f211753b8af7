"""Cells: their JSON, and where a curve reaches a quality."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from made_cells import cell as cell_groups

from fhash_bench.paper.cells import (
    Cell,
    Point,
    Request,
    by_data,
    groups,
    load,
    load_all,
    save,
    settings_id,
    within,
)
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


def test_cells_are_joined_over_seeds_in_the_papers_order() -> None:
    grouped = groups(
        [cell_groups(seed=1), cell_groups(), cell_groups("dense"), cell_groups("hash", "published")]
    )
    assert [(group.protocol, group.encoding) for group in grouped] == [
        ("published", "hash"),
        ("equal", "dense"),
        ("equal", "fhash"),
    ]
    assert [each.seed for each in grouped[-1].cells] == [0, 1]


def test_unknown_names_come_last() -> None:
    grouped = groups(
        [cell_groups(data_set="mine"), cell_groups(), cell_groups(feature="all", data_set="flame")]
    )
    assert [group.data_set for group in grouped] == ["flame", "bubble", "mine"]
    assert list(by_data(grouped)) == [
        (("flame", "all"), {"fhash": grouped[0]}),
        (("bubble", "segmentation"), {"fhash": grouped[1]}),
        (("mine", "segmentation"), {"fhash": grouped[2]}),
    ]


def test_a_seed_that_does_not_reach_a_quality_counts_as_infinite() -> None:
    (group,) = groups(
        [cell_groups(rise=4.0), cell_groups(seed=1, rise=0.1), cell_groups(seed=2, rise=2.0)]
    )
    epochs = group.reached(30, "coreset_psnr", "epoch")
    assert (epochs.median, epochs.low, epochs.high) == (10, 5, math.inf)
    assert group.after(10, "coreset_psnr").median == 30  # type: ignore[union-attr]
    assert group.spread(lambda cell: None) is None


def test_the_last_point_within_some_epochs() -> None:
    made = cell_groups()
    assert within(made, 7).epoch == 7
    assert within(made, 1000).epoch == 40


REQUEST = Request(
    encoding="hash",
    protocol="equal",
    data_set="a b/c.h5",
    feature="interval:0:1",
    seed=2,
    settings={"epochs": 3},
)


def cell() -> Cell:
    return Cell(
        encoding="hash", protocol="equal", data_set="a b/c.h5", shape=(1, 2, 3, 4),
        feature="interval:0:1", key_frames=(0,), coreset_share=1.0,
        box=((0, 2), (0, 3), (0, 4)), seed=2, parameters={"tables": 1, "mlp": 1},
        buckets_used=1.0, bytes=8, raw_bytes=96, samples_an_epoch=24, steps_an_epoch=1,
        samples_per_second=1.0, training_seconds=1.0, curve=(),
    )  # fmt: skip


def test_a_cell_is_found_by_its_settings_alone(tmp_path: Path) -> None:
    assert load(tmp_path, REQUEST) is None
    save(tmp_path, REQUEST, cell())
    assert load(tmp_path, REQUEST) == cell()
    for other in (
        replace(REQUEST, settings={"epochs": 4}),
        replace(REQUEST, seed=3),
        replace(REQUEST, feature="interval:0-1"),
    ):
        assert other.filename != REQUEST.filename
        assert load(tmp_path, other) is None


def test_names_are_plain(tmp_path: Path) -> None:
    assert "/" not in REQUEST.filename
    assert ":" not in REQUEST.filename
    assert " " not in REQUEST.filename


def test_a_damaged_cell_is_no_cell(tmp_path: Path) -> None:
    save(tmp_path, REQUEST, cell())
    path = tmp_path / REQUEST.filename
    path.write_text(path.read_text()[:-20])
    (tmp_path / "other.json").write_text("[1]")
    (tmp_path / "more.json").write_text('{"a": 1}')
    assert load(tmp_path, REQUEST) is None
    assert load_all(tmp_path) == []
    save(tmp_path, REQUEST, cell())
    assert load_all(tmp_path) == [cell()]
