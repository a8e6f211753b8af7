"""Cells in a folder: found again by their settings, never half written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fhash_codec.bench.paper.cell import Cell
from fhash_codec.bench.paper.store import Request, load, load_all, save

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
