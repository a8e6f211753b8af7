"""The bench: all cells once, finished ones never again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fhash_bench.paper import bench
from fhash_bench.paper.bench import BenchPlan, bench_paper, requests_of
from fhash_bench.paper.cells import load_all
from fhash_bench.paper.data import PROTOCOLS
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

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
    assert sorted(load_all(tmp_path), key=str) == sorted(result.cells, key=str)
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
    assert [cell.encoding for cell in load_all(tmp_path)] == ["dense"]
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
