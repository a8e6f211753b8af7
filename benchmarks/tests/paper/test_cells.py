"""Data sets, protocols, cells and the bench of the paper's encodings; the figures it prints."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from made_cells import cell as cell_groups

from fhash_bench.kept import load
from fhash_bench.paper import bench
from fhash_bench.paper.bench import BenchPlan, bench_paper, requests_of
from fhash_bench.paper.cells import (
    Cell,
    Point,
    Request,
    by_data,
    groups,
    within,
)
from fhash_bench.paper.data import (
    ENCODINGS,
    FEATURES,
    KINDS,
    PROTOCOLS,
    SETS,
    Data,
    arrangement,
    dense_levels,
    feature_text,
    hash_resolutions,
    hash_table,
    paper_parameters,
    paper_set,
    published_batch,
    scaled,
    simulated,
    tcnn_network,
)
from fhash_bench.paper.printed import (
    DECIBELS,
    NOT_REACHED_TEXT,
    NOTES,
    PARAMETERS,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    TABLE_4,
    TABLE_5,
    TABLE_6,
    PaperTable,
    Spread,
    notes_of,
    shown,
)
from fhash_bench.paper.printed import (
    ENCODINGS as ENCODINGS_PRINTED,
)
from fhash_bench.paper.printed import (
    SETS as SETS_PRINTED,
)
from fhash_codec.features.bricks import sample_places
from fhash_codec.features.features import parse_feature
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def test_masks_hold_the_samples(data: Data) -> None:
    every = np.concatenate([f[m] for f, m in zip(data.frames, data.masks, strict=True)])
    np.testing.assert_array_equal(np.sort(every), np.sort(data.unfringed.values))
    assert data.coreset.fringe is not None
    of_key_frames = data.coreset.values[~data.coreset.fringe]
    np.testing.assert_array_equal(np.sort(every), np.sort(of_key_frames))
    assert data.coreset.fringe.any()
    assert 0.1 < data.coreset.fraction < 0.8


def test_boxes_hold_the_bounding_box_of_each_key_frame(data: Data) -> None:
    places = sample_places(data.boxes)
    for key, mask in enumerate(data.masks):
        at = np.argwhere(mask)
        expected = np.prod(at.max(axis=0) - at.min(axis=0) + 1)
        assert (places[:, 0] == key).sum() == expected > mask.sum()
    assert data.boxes.box == data.coreset.box
    assert data.boxes.brick_shape == (1, 1, 1)


def test_everything_is_the_domain(data: Data) -> None:
    assert data.everything.box.shape == data.frame_shape
    assert len(data.everything.values) == sum(frame.size for frame in data.frames)
    assert data.raw_bytes == 5 * 7 * 9 * 12 * 4


@pytest.mark.parametrize("name", FEATURES)
def test_scenes_at_a_quarter_of_the_papers_shape(name: str) -> None:
    shapes = {"flame": (34, 14, 43, 50), "bubble": (61, 64, 32, 32), "shell": (34, 54, 54, 54)}
    assert simulated(name, "quarter").shape == shapes[name]
    for kind in KINDS:
        parse_feature(feature_text(name, kind))


def test_other_features_are_taken_as_they_are() -> None:
    assert feature_text("flame", "interval:0:1") == "interval:0:1"
    assert feature_text("mine.h5", "segmentation") == "segmentation"


def test_an_unknown_scale_is_refused() -> None:
    with pytest.raises(InputError, match="quarter"):
        simulated("flame", "tenth")


@pytest.mark.parametrize(("name", "steps"), [("flame", 1), ("bubble", 2), ("shell", 5)])
@pytest.mark.parametrize("divisor", [1, 2, 4])
def test_published_steps_are_the_papers(name: str, steps: int, divisor: int, data: Data) -> None:
    frame = scaled(SETS[name].frame, divisor)
    if divisor == 1:
        assert published_batch(name, frame) == 2**21
    values = np.broadcast_to(np.zeros((), np.float32), (1, *frame))
    sized = dataclasses.replace(data, name=name, series=ArraySeries(values))
    for encoding in ("dense", "dense-multi", "hash", "tcnn"):
        arranged = arrangement("published", encoding, sized)
        assert arranged.steps == (steps,)
        assert arranged.whole
        assert not arranged.joint


def test_published_fhash_is_joint_on_the_coreset(data: Data) -> None:
    arranged = arrangement("published", "fhash", data)
    assert arranged.joint
    assert not arranged.whole
    assert arranged.steps == (1,)  # 2^21 samples are more than there are


def test_released_is_the_authors_code(data: Data) -> None:
    arranged = arrangement("released", "fhash", data)
    batch = round(published_batch("blob", data.frame_shape) * 2_000_000 / 2**21)
    assert batch == 2_000_000
    assert (arranged.joint, arranged.samples, arranged.steps) == (True, "boxes", (1,))
    assert (arranged.engine, arranged.schedule) == ("gather", "constant")
    assert arrangement("published", "fhash", data).samples == "unfringed"
    with pytest.raises(InputError, match="released with fhash alone"):
        arrangement("released", "hash", data)


def test_equal_differs_by_the_encoding_alone(data: Data) -> None:
    arranged = {name: arrangement("equal", name, data) for name in ENCODINGS if name != "tcnn"}
    assert len(set(arranged.values())) == 1
    assert not arranged["hash"].whole


def test_best_takes_the_fastest_engine(data: Data) -> None:
    engines = {name: arrangement("best", name, data).engine for name in ENCODINGS}
    assert engines == {
        "dense": "lattice",
        "dense-multi": "lattice",
        "hash": "gather",
        "tcnn": "tcnn",
        "fhash": "lattice",
    }
    assert len(arrangement("best", "hash", data).steps) > 1


def test_unknown_names_are_refused(data: Data) -> None:
    with pytest.raises(InputError, match="published, released, equal, best"):
        arrangement("fair", "hash", data)


COUNTS = {
    "flame": {
        "hash": 125_829_120,
        "tcnn": 47_994_880,
        "dense": 47_185_920,
        "fhash": 25_374_176,
    },
    "bubble": {"hash": 264_241_152, "tcnn": 80_945_280, "dense": 75_497_472},
    "shell": {
        "hash": 1_174_405_120,
        "tcnn": 215_768_320,
        "dense": 141_557_760,
        "fhash": 112_857_968,
    },
}


@pytest.mark.parametrize("name", SETS)
def test_parameters_to_the_unit(name: str) -> None:
    counts = paper_parameters(name)
    assert {key: counts[key] for key in COUNTS[name]} == COUNTS[name]
    assert counts["dense-multi"] == pytest.approx(8 / 7 * counts["dense"], rel=2e-6)


def test_hash_configurations_are_the_papers() -> None:
    found = {
        name: (hash_table(s.frame), hash_resolutions(s.frame, s.coarsest))
        for name, s in SETS.items()
    }
    assert {name: table for name, (table, _) in found.items()} == {
        "flame": 2**20,
        "bubble": 2**21,
        "shell": 2**23,
    }
    assert [len(resolutions) for _, resolutions in found.values()] == [6, 7, 7]
    assert {resolutions[0] for _, resolutions in found.values()} == {256}


def test_a_quarter_of_the_papers_lengths() -> None:
    assert [scaled(s.frame, 4) for s in SETS.values()] == [
        (14, 43, 50),
        (64, 32, 32),
        (54, 54, 54),
    ]


def test_dense_levels_halve_down_to_two_corners() -> None:
    assert dense_levels((5, 3, 1)) == [(5, 3, 1), (3, 2, 1), (2, 1, 1)]


def test_tcnn_pads_its_network() -> None:
    assert tcnn_network(6, 1) == 16 * 64 + 64 * 64 + 64 * 16 == 6144
    assert tcnn_network(9, 2) == 2 * (32 * 64 + 64 * 64 + 64 * 16)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(InputError, match="bubbel"):
        paper_set("bubbel")


M = 2**20


def test_every_table_has_every_cell() -> None:
    for table in (TABLE_4, TABLE_6, PARAMETERS):
        assert [tuple(row) for row in table.values()] == [tuple(ENCODINGS_PRINTED)] * len(
            SETS_PRINTED
        )
    for name, decibels in product(SETS_PRINTED, DECIBELS):
        assert tuple(TABLE_3[name][decibels]) == tuple(ENCODINGS_PRINTED)
    assert len(TABLE_1) == 12


def test_time_is_proportional_to_the_embedding() -> None:
    for (fold, size), minutes in TABLE_1.items():
        assert minutes / size == pytest.approx(TABLE_1[fold, 1], rel=0.01)


@pytest.mark.parametrize("name", SETS_PRINTED)
def test_sizes_and_boxes_agree(name: str) -> None:
    data = TABLE_2[name]
    assert data.raw_bytes / 2**30 == pytest.approx(data.gigabytes, abs=0.01)
    assert prod(data.box) / prod(data.shape) == pytest.approx(data.box_share, abs=1e-4)


@pytest.mark.parametrize("name", SETS_PRINTED)
def test_more_decibels_never_take_less_time(name: str) -> None:
    for encoding in ENCODINGS_PRINTED:
        for feature in range(3):
            times = [TABLE_3[name][decibels][encoding][feature] for decibels in DECIBELS]
            reached = [minutes for minutes in times if minutes is not None]
            assert reached == sorted(reached)
            assert times[: len(reached)] == reached


@pytest.mark.parametrize("name", SETS_PRINTED)
def test_ratios_follow_from_parameters(name: str) -> None:
    raw = TABLE_2[name].raw_bytes / 2**20
    assert PARAMETERS[name]["dense-multi"][0] / PARAMETERS[name]["dense"][0] == pytest.approx(
        8 / 7, abs=0.002
    )
    for encoding in set(ENCODINGS_PRINTED) - {"tcnn"}:
        for feature, ratio in enumerate(TABLE_5[name][encoding]):
            assert raw / (4 * PARAMETERS[name][encoding][feature] * M / 1e6) == pytest.approx(
                ratio, abs=0.06, rel=0.005
            )


def test_times_are_whole_epochs_of_table_4() -> None:
    for encoding in set(ENCODINGS_PRINTED) - {"fhash"}:
        an_epoch = TABLE_4["bubble"][encoding].minutes / 30
        for decibels in DECIBELS:
            minutes = TABLE_3["bubble"][decibels][encoding][2]
            if minutes is not None:
                assert minutes / an_epoch == pytest.approx(round(minutes / an_epoch), abs=0.1)


def test_adaptive_marching_gains_half_everywhere() -> None:
    gains = [cell.gain for row in TABLE_6.values() for cell in row.values()]
    assert min(gains) == pytest.approx(1.44, abs=0.005)
    assert max(gains) == pytest.approx(1.55, abs=0.005)


def test_notes_name_tables() -> None:
    assert all(set(note.tables) <= {1, 2, 3, 4, 5, 6} for note in NOTES)
    assert len(notes_of(5)) == 3


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ([2.0], "2"),
        ([1.234], "1.23"),
        ([3.0, 1.0, 2.5], "2.5 (1-3)"),
        ([2.0, 2.0], "2"),
        ([None], NOT_REACHED_TEXT),
        ([4.0, None, None], "NR (4-NR)"),
        ([4.0, 5.0, None], "5 (4-NR)"),
        ([12345.6], "12,346"),
        ([0.0], "0"),
    ],
)
def test_a_spread_has_its_median_and_its_ends(figures: list[float | None], text: str) -> None:
    assert str(Spread.of(figures)) == text


def test_no_seed_has_no_spread() -> None:
    assert Spread.of([]) is None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        ("a", "a"),
        (1234567, "1,234,567"),
        (205.83, "205.8"),
        (1223.84, "1,223.8"),
        (0.05, "0.05"),
    ],
)
def test_values_as_text(value: float | str | None, text: str) -> None:
    assert shown(value) == text


def test_a_table_as_markdown_and_json() -> None:
    table = PaperTable(
        name="t",
        title="A title",
        columns=("set", "a|b"),
        rows=(("x", Spread.of([1.0, None])), ("y", None)),
        notes=("a note",),
    )
    assert table.lines() == [["set", "a|b"], ["x", "NR (1-NR)"], ["y", "-"]]
    assert table.markdown().splitlines() == [
        "### A title",
        "",
        "| set | a\\|b |",
        "| --- | --- |",
        "| x | NR (1-NR) |",
        "| y | - |",
        "",
        "- a note",
    ]
    rows = json.loads(json.dumps(table.to_dict(), allow_nan=False))["rows"]
    assert rows[0]["a|b"] == {
        "median": NOT_REACHED_TEXT,
        "low": 1.0,
        "high": NOT_REACHED_TEXT,
        "seeds": 2,
    }
    assert rows[1] == {"set": "y", "a|b": None}
    assert math.isinf(table.rows[0][1].median)  # type: ignore[union-attr]


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


def loaded(folder: Path) -> list[Cell]:
    """Every cell in a folder."""
    cells = [load(path, Cell.from_dict) for path in sorted(folder.iterdir())]
    return [cell for cell in cells if cell is not None]


def test_names_are_plain_and_those_of_their_settings_alone() -> None:
    assert not set("/: ") & set(REQUEST.filename)
    for other in (
        replace(REQUEST, settings={"epochs": 4}),
        replace(REQUEST, seed=3),
        replace(REQUEST, feature="interval:0-1"),
    ):
        assert other.filename != REQUEST.filename


PLAN = BenchPlan.quick(
    features=("interval:0.2:2",),
    key_frames="0,2,4",
    epochs=2,
    device="cpu",
    latency=False,
    picture_size=32,
)


def test_every_encoding_in_every_protocol(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_bench.paper.data.CANDIDATES", (1, 2))
    result = bench_paper(replace(PLAN, epochs=1), tmp_path, series, name="blob")
    assert [(cell.protocol, cell.encoding) for cell in result.cells] == [
        (protocol, encoding)
        for protocol in PROTOCOLS
        for encoding in ("dense", "dense-multi", "hash", "fhash")
        if protocol != "released" or encoding == "fhash"
    ]
    assert len(result.notes) == 1
    assert "tcnn" in result.notes[0]
    assert sorted(loaded(tmp_path), key=str) == sorted(result.cells, key=str)
    cells = {(cell.protocol, cell.encoding): cell for cell in result.cells}
    equal = [cells["equal", name] for name in ("dense", "dense-multi", "hash", "fhash")]
    for figure in ("samples_an_epoch", "steps_an_epoch", "box", "engine"):
        assert len({getattr(cell, figure) for cell in equal}) == 1
    assert cells["published", "hash"].samples_an_epoch == 3 * 7 * 9 * 12
    assert cells["published", "hash"].collisions > 0
    assert [entry["steps"] for entry in cells["best", "hash"].trial] == [1, 2]
    for cell in result.cells:
        epochs = [0, 1, 2] if cell.protocol == "released" else [0, 1]
        assert [point.epoch for point in cell.curve] == epochs
        assert all(point.picture_psnr is not None for point in cell.curve)
        assert cell.curve[-1].step == epochs[-1] * cell.steps_an_epoch
        assert 0 < cell.bytes <= 4 * sum(cell.parameters.values()) + 1000
        assert cell.between is not None
        assert 0 < cell.buckets_used <= 1


def test_finished_cells_are_not_run_again(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = replace(PLAN, protocols=("equal",), encodings=("dense", "fhash"))
    first = bench_paper(plan, tmp_path, series, name="blob")
    ran = []
    run = bench._run

    def counted(*words: object) -> object:
        ran.append(words[0])
        return run(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(bench, "_run", counted)
    assert bench_paper(plan, tmp_path, series, name="blob") == first
    assert not ran
    bench_paper(replace(plan, encodings=("dense", "hash")), tmp_path, series, name="blob")
    assert [request.encoding for request in ran] == ["hash"]  # type: ignore[attr-defined]
    bench_paper(replace(plan, epochs=1), tmp_path, series, name="blob")
    assert len(ran) == 3


def test_an_interrupt_leaves_finished_cells(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = replace(PLAN, protocols=("equal",), encodings=("dense", "fhash"))
    train, calls = bench.train, []

    def stopped(*words: object, **settings: object) -> object:
        calls.append(words)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return train(*words, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(bench, "train", stopped)
    with pytest.raises(KeyboardInterrupt):
        bench_paper(plan, tmp_path, series, name="blob")
    assert [cell.encoding for cell in loaded(tmp_path)] == ["dense"]
    assert len(list(tmp_path.iterdir())) == 1
    assert len(bench_paper(plan, tmp_path, series, name="blob").cells) == 2
    assert len(calls) == 3


def test_the_same_seed_gives_the_same_curve(series: ArraySeries, tmp_path: Path) -> None:
    plan = replace(PLAN, protocols=("equal",), encodings=("hash",))
    curves = []
    for folder in ("a", "b"):
        (cell,) = bench_paper(plan, tmp_path / folder, series, name="blob").cells
        curves.append([point.coreset_psnr for point in cell.curve])
    assert curves[0] == curves[1]


def test_an_unknown_protocol_is_refused(series: ArraySeries, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fair"):
        bench_paper(replace(PLAN, protocols=("fair",)), tmp_path, series)


QUICK = BenchPlan.quick(device="cpu")


def test_the_quick_plan_of_the_scenes() -> None:
    requests = list(requests_of(QUICK, QUICK.encodings, None, "data"))
    assert len(requests) == 3 * (3 * 5 + 1)  # the protocol released has one encoding
    assert len({request.filename for request in requests}) == len(requests)
    shapes = {request.data_set: request.settings["shape"] for request in requests}
    assert shapes == {
        "flame": [17, 7, 22, 25],
        "bubble": [31, 32, 16, 16],
        "shell": [17, 27, 27, 27],
    }
    keys = {request.data_set: request.settings["key_frames"] for request in requests}
    assert keys == {"flame": "auto:10", "bubble": "auto:9", "shell": "auto:10"}
    assert {request.feature for request in requests} == {"segmentation"}


def test_the_full_plan_has_the_papers_key_frames() -> None:
    plan = BenchPlan(device="cpu")
    requests = list(requests_of(plan, ("fhash",), None, "data"))
    assert len(requests) == 3 * 3 * 4 * 3
    epochs = {request.protocol: request.settings["epochs"] for request in requests}
    assert epochs == {"published": 60, "released": 120, "equal": 60, "best": 60}
    keys = {request.data_set: request.settings["key_frames"] for request in requests}
    assert keys == {"flame": "auto:10", "bubble": "auto:9", "shell": "auto:10"}


def test_latency_is_timed_once_for_each_published_encoding() -> None:
    requests = requests_of(replace(QUICK, seeds=2), ("fhash",), None, "data")
    timed = [request for request in requests if request.settings["latency"]]
    assert {(request.protocol, request.seed) for request in timed} == {("published", 1)}


@pytest.mark.parametrize(
    "changed", [{"epochs": 5}, {"key_frames": "0,2,4"}, {"picture_size": 64}, {"views": 2}]
)
def test_a_changed_setting_is_another_cell(series: ArraySeries, changed: dict) -> None:
    names = [
        {request.filename for request in requests_of(plan, ("fhash",), series, "blob")}
        for plan in (QUICK, replace(QUICK, **changed))
    ]
    assert names[0] != names[1]
    assert len(names[0]) == 4
