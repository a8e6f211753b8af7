"""Measurements: what counts as reached, tolerances, speed and access."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fhash_codec.bench.rate.rate import bench_rate
from fhash_codec.bench.rate.results import PEERS, RateBench

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
