"""Times of work: on the wall and by the processor."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_bench.rate.measuring import (
    PEERS,
    PROFILES,
    Own,
    Point,
    RateBench,
    Spent,
    access_of,
    places,
    promised,
    shown_psnr,
    speed_of,
    spent,
    user_seconds,
)
from fhash_bench.rate.rate import bench_rate
from fhash_codec import EncodeConfig
from fhash_codec.boxes import Box
from fhash_codec.cost.peers import EXACT, Trial
from fhash_formats.series import ArraySeries


def test_both_times_are_above_0() -> None:
    done = []
    times = spent(lambda: done.append(1))
    assert done == [1]
    assert times.wall > 0
    assert times.core > 0


def test_programs_count() -> None:
    before = user_seconds()
    times = spent(lambda: subprocess.run([sys.executable, "-c", "sum(range(3000000))"], check=True))
    assert times.core > 0.005
    assert user_seconds() - before >= times.core * 0.99


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
        "fhash paper": None,
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
        assert 0 < entry.bytes_read <= entry.bytes


def test_small_chunks_are_measured_where_frames_are_larger(field: Field) -> None:
    values = field((2, 6, 130, 120))
    result = bench_rate(values, targets=(50.0,), bounds=(), names=("SZ3",), profiles=())
    whole, small = result.access
    assert whole.bytes < small.bytes
    assert small.bytes_read < whole.bytes_read
    assert small.psnr >= 50


def test_what_a_filter_refuses_is_said(field: Field) -> None:
    values = field((1, 1, 1, 64))
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.01,), names=("SPERR", "ZFP"), profiles=(), speed=False
    )
    assert {point.codec for point in result.points} == {"ZFP"}
    assert all(name.startswith("SPERR ") for name in result.refused)
    assert len(result.refused) == 9


def test_own_figures_are_those_of_diff(tmp_path: Path, field: Field) -> None:
    values = field()
    config = EncodeConfig(profile="paper", epochs=2, width=4)
    data_range = float(values.max()) - float(values.min())
    own = Own(ArraySeries(values), data_range, tmp_path)
    trial = own.trial(config)
    (path,) = tmp_path.iterdir()
    report = fhash_codec.diff(values, path)
    assert trial.bytes == path.stat().st_size
    assert trial.psnr == pytest.approx(report["psnr"], abs=1e-9)
    assert trial.max_error == pytest.approx(report["max_abs_error"] / data_range)
    assert own.trial(config) is trial
    count, seconds = own.read_region(config, 1, ((0, 6), (4, 20), (4, 20)))
    assert 0 < count <= trial.bytes
    assert seconds > 0


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles_are_promised_what_they_can_keep(profile: str) -> None:
    settings = {"seed": 7, "epochs": 3, "effort": 2}
    quality = promised(settings, profile, "psnr", 41.0).to_dict()
    bound = promised(settings, profile, "bound", 0.02).to_dict()
    assert (quality["epochs"], quality["effort"]) == ((3, 5) if profile == "paper" else (0, 2))
    assert quality["profile"] == bound["profile"] == profile
    assert quality["seed"] == bound["seed"] == 7
    if profile == "paper":
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
        point("fhash compact", 80, True),
    )
    row = {
        "goal": "psnr",
        "asked": 45.0,
        "peer": "SPERR",
        "bytes": 200,
        "ratios": {"fhash compact": 2.5},
    }
    assert result(points).best_peers() == result(points).to_dict()["best_peers"] == [row]
    unreached = result((*points[:3], point("fhash compact", 80, False)))
    assert unreached.best_peers() == [row | {"ratios": {"fhash compact": None}}]
    alone = result(points[3:])
    assert alone.best_peers() == [
        row | {"peer": None, "bytes": None, "ratios": {"fhash compact": None}}
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
    assert list(places(shape)) == list(places(shape))
    for step, box in places(shape):
        assert 0 <= step < 3
        assert box.shape == (16, 5, 16)
        assert all(0 <= low < high <= n for (low, high), n in zip(box, shape[1:], strict=True))


def test_access_is_the_median_without_the_first() -> None:
    answers = iter([(10**6, 99.0), (1, 0.001), (3, 0.003), (2, 0.002)])

    def read(step: int, box: Box) -> tuple[int, float]:
        return next(answers)

    access = access_of("a", "b", TRIAL, (3, 20, 5, 40), read, 3)
    assert (access.milliseconds, access.bytes_read) == (2.0, 2)
    assert access.region == (16, 5, 16)


def test_exact_values_have_no_psnr() -> None:
    assert shown_psnr(TRIAL) == 45.0
    assert shown_psnr(Trial(level=0, bytes=1, psnr=EXACT, max_error=0)) is None
