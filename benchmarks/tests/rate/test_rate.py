"""`fhash bench rate` and `table`: every codec has its points, speeds and cells."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rarely import rarely

import fhash_codec
from fhash_bench.kept import load, save
from fhash_bench.rate.generated import (
    DEFAULT,
    GENERATED,
    MADE,
    PREFIX,
    generated,
    is_generated,
    is_made,
    made_series,
)
from fhash_bench.rate.measuring import (
    PEERS,
    Own,
    Point,
    RateBench,
    access_of,
    promised,
    random_regions,
    shown_psnr,
    speed_of,
)
from fhash_bench.rate.peers import Spent, core_seconds, spent
from fhash_bench.rate.rate import bench_rate, plot
from fhash_bench.rate.table import CSV, RateCell, Request, bench_table, own_coders
from fhash_codec import EncodeConfig
from fhash_codec.boxes import Box
from fhash_codec.config import PRESETS
from fhash_codec.cost.peers import EXACT, Trial
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries


@pytest.mark.parametrize("kind", ["thin", *rarely(*(kind for kind in GENERATED if kind != "thin"))])
def test_a_series_is_the_same_for_a_seed(kind: str) -> None:
    series, again = generated(PREFIX + kind), generated(PREFIX + kind)
    other = generated(PREFIX + kind, seed=1)
    assert series.source == PREFIX + kind
    assert series.dtype == np.float32
    np.testing.assert_array_equal(series.values, again.values)
    assert not np.array_equal(series.values, other.values)
    assert np.isfinite(series.values).all()
    assert 100_000 <= series.values.size <= 12_000_000
    times = series.coords["t"].values
    assert (np.diff(times) > 0).all()
    assert times.size == series.shape[0]


@pytest.mark.every
def test_kinds_are_what_they_say() -> None:
    plateau = generated("generated:plateau")
    assert plateau.shape == (21, 80, 80, 80)
    assert np.ptp(plateau.values[0]) == 0
    assert (plateau.values[10] == 1).mean() > 0.3
    assert np.ptp(np.diff(plateau.coords["t"].values)) > 0.01
    assert np.unique(generated("generated:labels").values).size <= 40
    assert min(generated("generated:thin").shape[1:]) == 3
    assert generated("generated:long").shape[0] == 600
    assert generated("generated:short").shape[0] == 2


def test_an_unknown_kind_is_refused() -> None:
    assert is_generated("generated:x")
    assert not is_generated("x.h5")
    with pytest.raises(InputError, match="did you mean 'generated:plateau'"):
        generated("generated:plateu")


def test_every_name_gives_a_series_of_its_shape() -> None:
    for name, made in MADE.items():
        series, described = made_series(f"generated:{name}")
        assert described is made
        assert tuple(series.shape) == made.shape
    assert DEFAULT.removeprefix("generated:") in MADE


def test_the_argon_box_has_the_papers_size() -> None:
    assert sorted(MADE["argon"].shape) == [9, 80, 83, 204]


def test_other_names_are_none() -> None:
    assert not is_made("data.npy")
    assert not is_made(None)
    assert is_made("generated:argon")
    with pytest.raises(InputError, match="generated:argon"):
        made_series("generated:argn")


def test_both_times_are_above_0() -> None:
    done = []
    times = spent(lambda: done.append(1))
    assert done == [1]
    assert times.wall > 0
    assert times.core > 0


def test_programs_count() -> None:
    before = core_seconds()
    times = spent(lambda: subprocess.run([sys.executable, "-c", "sum(range(3000000))"], check=True))
    assert times.core > 0.005
    assert core_seconds() - before >= times.core * 0.99


Field = Callable[..., np.ndarray]


def test_points_that_reached_it_did(result: RateBench) -> None:
    peers_of = [point for point in result.points if point.codec in PEERS]
    assert all(point.reached for point in peers_of)
    for point in result.points:
        assert point.bytes > 0
        quality = (
            point.max_error <= point.asked
            if point.goal == "bound"
            else point.psnr is None or point.psnr >= point.asked
        )
        assert quality == point.reached
    fine = {point.codec: point for point in peers_of if (point.goal, point.asked) == ("psnr", 50.0)}
    coarse = {
        point.codec: point for point in peers_of if (point.goal, point.asked) == ("psnr", 35.0)
    }
    assert all(
        coarse[name].bytes < fine[name].bytes for name in ("SZ3", "SPERR", "ZFP", "BitRound")
    )
    assert all(fine[name].psnr < 50.06 for name in ("SZ3", "SPERR"))
    assert (fine["Blosc"].psnr, fine["Blosc"].max_error) == (None, 0.0)


def test_tolerances_are_checked_for_bounds_alone(result: RateBench) -> None:
    kept = {point.codec: point.as_asked for point in result.points if point.goal == "bound"}
    assert kept == {
        "SZ3": True,
        "SPERR": True,
        "ZFP": True,
        "BitRound": None,
        "Blosc": None,
        "fhash published": None,
    }
    assert all(point.as_asked is None for point in result.points if point.goal == "psnr")


def test_speed_and_access_are_those_of_the_target_nearest_to_50_db(result: RateBench) -> None:
    found = {
        point.codec: point.bytes
        for point in result.points
        if (point.goal, point.asked) == ("psnr", 50.0)
    }
    assert [speed.codec for speed in result.speeds] == list(found)
    assert all(
        speed.encode_mb_s > 0 and speed.decode_mb_s > 0 and speed.encode_runs == 3
        for speed in result.speeds
    )
    assert {entry.codec: entry.bytes for entry in result.access} == found
    for entry in result.access:
        assert entry.region == (6, 16, 16)
        assert entry.milliseconds > 0
        # Small files are read once, whole; the times in them have more digits or fewer.
        assert 0 < entry.bytes_read <= entry.bytes + 64


def test_small_chunks_are_measured_where_frames_are_larger(field: Field) -> None:
    values = field((2, 6, 130, 120))
    result = bench_rate(values, targets=(50.0,), bounds=(), names=("SZ3",), presets=())
    whole, small = result.access
    assert whole.bytes < small.bytes
    assert small.bytes_read < whole.bytes_read
    assert small.psnr >= 50


def test_what_a_filter_refuses_is_said(field: Field) -> None:
    values = field((1, 1, 1, 64))
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.01,), names=("SPERR", "ZFP"), presets=(), speed=False
    )
    assert {point.codec for point in result.points} == {"ZFP"}
    assert all(name.startswith("SPERR ") for name in result.refused)
    assert len(result.refused) == 9


def test_own_figures_are_those_of_diff(tmp_path: Path, field: Field) -> None:
    values = field()
    config = EncodeConfig(preset="published", tables="float16", epochs=2, width=4)
    data_range = float(values.max()) - float(values.min())
    own = Own(ArraySeries(values), data_range, tmp_path)
    trial = own.trial(config)
    (path,) = tmp_path.iterdir()
    report = fhash_codec.diff(values, path)
    assert trial.bytes == path.stat().st_size
    assert trial.psnr == pytest.approx(report["psnr"], abs=1e-9)
    assert trial.max_error == pytest.approx(report["max_abs_error"] / data_range)
    assert own.trial(config) is trial
    count, taken = own.read_region(config, 1, ((0, 6), (4, 20), (4, 20)))
    assert 0 < count <= trial.bytes
    assert min(taken.wall, taken.core) > 0


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_promised_what_they_can_keep(preset: str) -> None:
    settings = {"seed": 7, "epochs": 3, "effort": 2}
    quality = promised(settings, preset, "psnr", 41.0).to_dict()
    bound = promised(settings, preset, "bound", 0.02).to_dict()
    assert (quality["epochs"], quality["effort"]) == ((3, 5) if preset == "published" else (0, 2))
    assert quality["preset"] == bound["preset"] == preset
    assert quality["seed"] == bound["seed"] == 7
    if preset == "published":
        assert quality == bound
        assert quality["psnr"] is None
    else:
        assert (quality["psnr"], bound["psnr"]) == (41.0, None)
        assert (quality["max_error_rel"], bound["max_error_rel"]) == (None, 0.02)


def result(points: tuple[Point, ...]) -> RateBench:
    return RateBench(
        series="a",
        shape=(2, 3, 4, 5),
        dtype="float32",
        raw_bytes=480,
        value_range=(0.0, 1.0),
        missing=0,
        points=points,
        speeds=(),
        access=(),
        tiles=(),
        refused={},
        machine={},
        notes=(),
    )


def test_ratios_are_to_the_best_peer_that_reached_it() -> None:
    def point(codec: str, count: int, reached: bool) -> Point:
        return Point(
            codec=codec,
            goal="psnr",
            asked=45.0,
            reached=reached,
            bytes=count,
            psnr=45.0,
            max_error=0.1,
            setting="",
            as_asked=None,
        )

    points = (
        point("SZ3", 300, True),
        point("ZFP", 100, False),
        point("SPERR", 200, True),
        point("fhash default", 80, True),
    )
    row = {
        "goal": "psnr",
        "asked": 45.0,
        "peer": "SPERR",
        "bytes": 200,
        "ratios": {"fhash default": 2.5},
    }
    assert result(points).best_peers() == result(points).to_dict()["best_peers"] == [row]
    unreached = result((*points[:3], point("fhash default", 80, False)))
    assert unreached.best_peers() == [row | {"ratios": {"fhash default": None}}]
    alone = result(points[3:])
    assert alone.best_peers() == [
        row | {"peer": None, "bytes": None, "ratios": {"fhash default": None}}
    ]


TRIAL = Trial(level=40.0, bytes=1000, psnr=45.0, max_error=0.1)


def test_the_fastest_runs_count() -> None:
    runs = [Spent(wall=2.0, core=4.0), Spent(wall=3.0, core=1.0)]
    speed = speed_of("a", "b", TRIAL, 8_000_000, runs, runs[:1])
    assert (speed.encode_mb_s, speed.encode_core_mb_s) == (4.0, 8.0)
    assert (speed.decode_mb_s, speed.decode_core_mb_s) == (4.0, 2.0)
    assert speed.encode_runs == 2


def test_places_are_the_same_for_all_and_within_the_series() -> None:
    shape = (3, 20, 5, 40)
    assert list(random_regions(shape)) == list(random_regions(shape))
    for step, box in random_regions(shape):
        assert 0 <= step < 3
        assert box.shape == (16, 5, 16)
        assert all(0 <= low < high <= n for (low, high), n in zip(box, shape[1:], strict=True))


def test_access_is_the_median_without_the_first() -> None:
    answers = iter([(10**6, 99.0), (1, 0.001), (3, 0.003), (2, 0.002)])

    def read(step: int, box: Box) -> tuple[int, Spent]:
        count, seconds = next(answers)
        return count, Spent(wall=seconds, core=2 * seconds)

    access = access_of("a", "b", TRIAL, (3, 20, 5, 40), read, 3)
    assert (access.milliseconds, access.core_milliseconds, access.bytes_read) == (2.0, 4.0, 2)
    assert access.region == (16, 5, 16)


def test_exact_values_have_no_psnr() -> None:
    assert shown_psnr(TRIAL) == 45.0
    assert shown_psnr(Trial(level=0, bytes=1, psnr=EXACT, max_error=0)) is None


CELL = RateCell(
    series="a b.h5",
    shape=(1, 2, 3, 4),
    dtype="float32",
    raw_bytes=96,
    codec="SZ3",
    goal="psnr",
    asked=45.0,
    reached=True,
    bytes=12,
)
REQUEST = Request(series="a b.h5", codec="SZ3", goal="psnr", asked=45.0, settings={"checksum": 1})


def test_a_cell_comes_back_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "cells" / REQUEST.filename
    assert load(path, RateCell.from_dict) is None
    for cell in (CELL, replace(CELL, bytes=None, why="broken")):
        save(path, cell.to_dict())
        assert load(path, RateCell.from_dict) == cell
    for text in ("", "[]", "{}", '{"series": 1}', "\xff", path.read_text()[:-20]):
        path.write_text(text, encoding="latin-1")
        assert load(path, RateCell.from_dict) is None


def test_another_question_has_another_name() -> None:
    assert REQUEST.filename.startswith("a-b.h5_SZ3_psnr45_")
    others = [
        replace(REQUEST, series="a_b.h5"),
        replace(REQUEST, asked=46.0),
        replace(REQUEST, settings={"checksum": 2}),
    ]
    assert len({request.filename for request in (REQUEST, *others)}) == 4


def source(values: np.ndarray):
    @contextmanager
    def opened():
        yield ArraySeries(values)

    return opened


@pytest.mark.every
def test_cells_are_measured_once(field: Field, tmp_path: Path) -> None:
    sources = {"wave": source(field()), "other": source(field((2, 3, 9, 9)))}
    coders = own_coders((1, 2), (), {})
    options = {"targets": (40.0,), "bounds": (0.05,), "names": ("SZ3", "ZFP")}
    first = bench_table(sources, tmp_path, coders, **options)
    assert first.measured == len(first.cells) == len(list(tmp_path.glob("*.json"))) == 16
    for cell in first.cells:
        assert cell.reached
        assert min(cell.encode_mb_s, cell.decode_mb_s, cell.region_ms) > 0
    assert [cell.codec for cell in first.cells[:4]] == ["fhash 1", "fhash 2", "SZ3", "ZFP"]
    assert 0.01 < first.startup_seconds < 60
    again = bench_table(sources, tmp_path, coders, **options)
    assert again.measured == 0
    assert again.cells == first.cells
    next(tmp_path.glob("wave_ZFP_bound*")).unlink()
    assert bench_table(sources, tmp_path, coders, **options).measured == 1
    changed = {"wave": source(2 * field())}
    assert bench_table(changed, tmp_path, coders, **options, speed=False).measured == 8


def test_a_run_that_is_cut_off_keeps_its_cells(field: Field, tmp_path: Path) -> None:
    def cut(stage: str, done: int, total: int, note: str) -> None:
        assert (stage, total) == ("table", 2)
        if done == 1:
            raise KeyboardInterrupt

    options = {"targets": (40.0,), "bounds": (), "names": ("SZ3",), "speed": False}
    sources, coders = {"a, b": source(field((2, 3, 9, 9)))}, own_coders((1,), ("fast",), {})
    with pytest.raises(KeyboardInterrupt):
        bench_table(sources, tmp_path, coders, **options, progress=cut)
    with (tmp_path / CSV).open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["series"], row["shape"], row["codec"]) == ("a, b", "2x3x9x9", "fhash 1 fast")
    assert bench_table(sources, tmp_path, coders, **options).measured == 1


def test_a_codec_that_cannot_be_measured_says_why(field: Field, tmp_path: Path) -> None:
    sources, coders = {"line": source(field((1, 1, 1, 64)))}, own_coders((1,), (), {})
    options = {"targets": (40.0,), "bounds": (), "speed": False}
    cell = bench_table(sources, tmp_path, coders, names=("SPERR",), **options).cells[1]
    assert cell.why.startswith("SPERR ")
    assert (cell.reached, cell.bytes) == (False, None)
    flat = {"flat": source(np.ones((2, 3, 4, 5)))}
    for cell in bench_table(flat, tmp_path, coders, names=("SZ3",), **options).cells:
        assert "is constant" in cell.why
    with pytest.raises(InputError, match="peer is 'zip'"):
        bench_table(sources, tmp_path, coders, names=("zip",))


def test_the_plot_needs_matplotlib(
    monkeypatch: pytest.MonkeyPatch, result: RateBench, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        plot(result, tmp_path / "rate.png")


def test_the_plot_has_a_panel_for_each_kind_of_quality(result: RateBench, tmp_path: Path) -> None:
    from PIL import Image

    plot(result, tmp_path / "both.png")
    plot(
        replace(result, points=tuple(point for point in result.points if point.goal == "psnr")),
        tmp_path / "one.png",
    )
    with Image.open(tmp_path / "both.png") as both, Image.open(tmp_path / "one.png") as one:
        assert both.width > 1.5 * one.width
        assert len(both.convert("RGB").getcolors(2**24)) > 50


def test_every_codec_has_a_point_for_everything_asked(result: RateBench) -> None:
    expected = {
        (codec, *goal)
        for codec in (*PEERS, "fhash published")
        for goal in (("psnr", 35.0), ("psnr", 50.0), ("bound", 0.02))
    }
    assert {(point.codec, point.goal, point.asked) for point in result.points} == expected
    assert len(result.points) == len(expected)
    assert result.refused == {}


def test_missing_values_do_not_count(field: Field) -> None:
    values = field()
    values[1, :, 3:9, 4:11] = np.nan
    values[2, 0, 0, 0] = -np.inf
    config = {"epochs": 1, "width": 4}
    result = bench_rate(
        values, config, targets=(40.0,), bounds=(0.01,), presets=("published",), speed=False
    )
    assert result.missing == 6 * 6 * 7 + 1
    assert all(point.reached for point in result.points if point.codec in PEERS)
    assert result.refused == {}
    assert (result.speeds, result.access) == ((), ())


def test_integers_are_compared_as_they_are(field: Field) -> None:
    values = np.round(100 * field()).astype(np.int16)
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.05,), names=("SZ3", "Blosc"), presets=(), speed=False
    )
    assert result.raw_bytes == values.nbytes
    assert all(point.reached for point in result.points)
    assert all(point.bytes < values.nbytes for point in result.points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ("TTHRESH",)}, "peer is 'TTHRESH'; allowed: SZ3, "),
        ({"presets": ("tiny",)}, "preset is 'tiny'; allowed: "),
        ({"targets": (3.0,)}, "target is 3 dB; allowed: 5 to 200"),
        ({"bounds": (0.0,)}, "bound is 0 of the range"),
        ({"targets": (), "bounds": ()}, "nothing to measure"),
        ({"names": (), "presets": ()}, "nothing to measure"),
        ({"settings": {"efort": 1}}, "did you mean 'effort'"),
        ({"settings": {"features": ("interval:0:1",)}}, "feature is interval:0:1"),
    ],
)
def test_unsuitable_arguments_are_refused(
    arguments: dict[str, Any], message: str, field: Field
) -> None:
    with pytest.raises(InputError, match=message):
        bench_rate(field(), **arguments)


def test_a_constant_series_has_no_quality_to_compare() -> None:
    with pytest.raises(InputError, match="is constant"):
        bench_rate(np.ones((2, 3, 4, 5)))


def test_peers_need_hdf5plugin(monkeypatch: pytest.MonkeyPatch, field: Field) -> None:
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        bench_rate(field())
