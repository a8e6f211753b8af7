"""`fhash bench rate`: searches end where they should, peers give back what they hold, and every figure is that of decoded values."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.bench.rate.own import PROFILES, Own, promised
from fhash_codec.bench.rate.peers import (
    LADDER,
    filled,
    peers,
    read_all,
    read_region,
    stored,
    stored_bytes,
    touched_bytes,
)
from fhash_codec.bench.rate.plot import plot
from fhash_codec.bench.rate.rate import bench_rate
from fhash_codec.bench.rate.results import PEERS, Point, RateBench
from fhash_codec.bench.rate.search import EXACT, Search, Trial
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries

VARIANTS = [variant for chosen in peers().values() for variant in chosen]
CUT = [replace(variant, chunk=8) for variant in VARIANTS if variant.layout == "frame"]
REGION = ((1, 4), (2, 12), (5, 17))


def field(shape=(4, 6, 20, 24)) -> np.ndarray:
    """A moving wave with a little noise, values in about -1 .. 2."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).normal(size=shape)
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z + 0.01 * noise).astype(np.float32)


def codec(slope: float, offset: float, noise: float = 0.0):
    """A made-up codec whose PSNR follows the level along a line, or nearly so."""

    def measure(level: float) -> Trial:
        psnr = slope * level + offset + noise * np.sin(40 * level)
        return Trial(
            level=level, bytes=round(100 * 2 ** (psnr / 6)), psnr=psnr, max_error=10 ** (-psnr / 20)
        )

    return measure


@pytest.mark.parametrize(
    ("slope", "offset", "noise"), [(1, 4.8, 0), (0.5, 20, 0), (2.5, -30, 0), (1, 0, 0.03)]
)
@pytest.mark.parametrize("goal", ["psnr", "bound"])
def test_search_ends_just_above_what_is_asked(
    slope: float, offset: float, noise: float, goal: str
) -> None:
    search = Search(codec(slope, offset, noise))
    for asked in (35.0, 45.0, 40.0):
        before = len(search.trials)
        found = search.find(goal, asked, first=asked - 4.8, slack=0.05, most=8)
        assert found is not None
        assert asked <= found.quality(goal) <= asked + 0.05
        assert len(search.trials) - before <= 8


def test_search_on_a_ladder_ends_at_the_first_step_that_reaches_it() -> None:
    for asked in (30.0, 42.0, 55.0):
        found = Search(codec(1, 2), step=LADDER).find("psnr", asked, first=50.0, slack=0.05, most=8)
        assert found is not None
        assert asked <= found.psnr < asked + LADDER


def test_search_of_what_cannot_be_set_tries_once() -> None:
    search = Search(
        lambda level: Trial(level=level, bytes=9, psnr=EXACT, max_error=0.0), fixed=True
    )
    assert [
        search.find(goal, 40.0, first=30.0, slack=0.05, most=8) for goal in ("psnr", "bound")
    ] == list(search.trials.values()) * 2


def test_search_says_that_nothing_reached_it() -> None:
    search = Search(lambda level: Trial(level=level, bytes=9, psnr=20.0, max_error=0.1))
    assert search.find("psnr", 40.0, first=30.0, slack=0.05, most=8) is None
    assert len(search.trials) == 8


@pytest.mark.parametrize("variant", [*VARIANTS, *CUT], ids=lambda variant: variant.name)
def test_a_peer_returns_the_region_of_what_it_returns(variant) -> None:
    values = field()
    with stored(values, variant, 3.0, 60.0) as file:
        decoded = read_all(file, variant)
        assert decoded.shape == values.shape
        assert np.abs(decoded - values).max() < 0.5
        region = read_region(file, variant, 2, REGION)
        np.testing.assert_array_equal(region, decoded[2][tuple(slice(*span) for span in REGION)])
        touched, total = touched_bytes(file, variant, 2, REGION), stored_bytes(file)
    assert 0 < touched <= total
    if variant.layout == "frame":
        assert touched < total / 2
    if variant.lossless:
        np.testing.assert_array_equal(decoded, values)
    else:
        assert total < values.nbytes


@pytest.mark.parametrize(
    "variant",
    [variant for variant in VARIANTS if variant.mode == "tolerance"],
    ids=lambda variant: variant.name,
)
def test_a_level_is_a_tolerance(variant) -> None:
    values = field()
    with stored(values, variant, 3.0, 40.0) as file:
        assert np.abs(read_all(file, variant).astype(np.float64) - values).max() <= 0.03 * (
            1 + 1e-4
        )


def test_sperr_is_given_the_axes_in_its_own_order() -> None:
    """A field that is smooth along x and y and noise along t costs far more where the axes are taken for others."""
    import hdf5plugin

    values = np.broadcast_to(
        np.random.default_rng(0).normal(size=(2, 3, 1, 1)), (2, 3, 40, 90)
    ).astype(np.float32)
    values = values + np.sin(np.linspace(0, 3, 90, dtype=np.float32))
    variant = next(
        variant
        for variant in peers()["SPERR"]
        if variant.layout == "frame" and variant.mode == "tolerance"
    )
    other = replace(
        variant,
        setting=lambda part, data_range, level: hdf5plugin.Sperr(
            absolute=data_range * 10 ** (-level / 20)
        ),
    )
    with (
        stored(values, variant, 6.0, 50.0) as file,
        stored(values.copy(), other, 6.0, 50.0) as file_without,
    ):
        assert stored_bytes(file) < 0.8 * stored_bytes(file_without)


def test_missing_values_are_filled_from_their_row_first() -> None:
    values = np.arange(24, dtype=np.float32).reshape(1, 2, 3, 4)
    broken = values.copy()
    broken[0, 0, 0, 1:3] = np.nan
    broken[0, 0, 1, 0] = np.inf
    broken[0, 1, 2] = np.nan
    result = filled(broken)
    known = np.isfinite(broken)
    np.testing.assert_array_equal(result[known], values[known])
    assert result[0, 0, 0].tolist() == [0, 0, 0, 3]
    assert result[0, 0, 1, 0] == 5
    np.testing.assert_array_equal(result[0, 1, 2], values[0, 1, 1])


@pytest.fixture(scope="module")
def result() -> RateBench:
    config = {"epochs": 2, "width": 4, "seed": 1}
    return bench_rate(field(), config, targets=(35.0, 50.0), bounds=(0.02,), profiles=("paper",))


def test_every_codec_has_a_point_for_everything_asked(result: RateBench) -> None:
    expected = {
        (codec, *goal)
        for codec in (*PEERS, "fhash paper")
        for goal in (("psnr", 35.0), ("psnr", 50.0), ("bound", 0.02))
    }
    assert {(point.codec, point.goal, point.asked) for point in result.points} == expected
    assert len(result.points) == len(expected)
    assert result.refused == {}


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


def test_small_chunks_are_measured_where_frames_are_larger() -> None:
    values = field((2, 6, 130, 120))
    result = bench_rate(values, targets=(50.0,), bounds=(), names=("SZ3",), profiles=())
    whole, small = result.access
    assert whole.bytes < small.bytes
    assert small.bytes_read < whole.bytes_read
    assert small.psnr >= 50


def test_own_figures_are_those_of_diff(tmp_path: Path) -> None:
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


def test_missing_values_do_not_count() -> None:
    values = field()
    values[1, :, 3:9, 4:11] = np.nan
    values[2, 0, 0, 0] = -np.inf
    config = {"epochs": 1, "width": 4}
    result = bench_rate(
        values, config, targets=(40.0,), bounds=(0.01,), profiles=("paper",), speed=False
    )
    assert result.missing == 6 * 6 * 7 + 1
    assert all(point.reached for point in result.points if point.codec in PEERS)
    assert result.refused == {}
    assert (result.speeds, result.access) == ((), ())


def test_integers_are_compared_as_they_are() -> None:
    values = np.round(100 * field()).astype(np.int16)
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.05,), names=("SZ3", "Blosc"), profiles=(), speed=False
    )
    assert result.raw_bytes == values.nbytes
    assert all(point.reached for point in result.points)
    assert all(point.bytes < values.nbytes for point in result.points)


def test_what_a_filter_refuses_is_said() -> None:
    values = field((1, 1, 1, 64))
    result = bench_rate(
        values, targets=(40.0,), bounds=(0.01,), names=("SPERR", "ZFP"), profiles=(), speed=False
    )
    assert {point.codec for point in result.points} == {"ZFP"}
    assert all(name.startswith("SPERR ") for name in result.refused)
    assert len(result.refused) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ("TTHRESH",)}, "peer is 'TTHRESH'; allowed: SZ3, "),
        ({"profiles": ("small",)}, "profile is 'small'; allowed: "),
        ({"targets": (3.0,)}, "target is 3 dB; allowed: 5 to 200"),
        ({"bounds": (0.0,)}, "bound is 0 of the range"),
        ({"targets": (), "bounds": ()}, "nothing to measure"),
        ({"names": (), "profiles": ()}, "nothing to measure"),
        ({"settings": {"efort": 1}}, "did you mean 'effort'"),
        ({"settings": {"features": ("interval:0:1",)}}, "feature is interval:0:1"),
    ],
)
def test_unsuitable_arguments_are_refused(arguments, message: str) -> None:
    with pytest.raises(InputError, match=message):
        bench_rate(field(), **arguments)


def test_a_constant_series_has_no_quality_to_compare() -> None:
    with pytest.raises(InputError, match="is constant"):
        bench_rate(np.ones((2, 3, 4, 5)))


def test_peers_need_hdf5plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        bench_rate(field())


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


def test_ratios_are_to_the_best_peer_that_reached_it(result: RateBench) -> None:
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
    assert replace(result, points=points).best_peers() == [row]
    unreached = replace(result, points=(*points[:3], point("fhash compact", 80, False)))
    assert unreached.best_peers() == [row | {"ratios": {"fhash compact": None}}]
    alone = replace(result, points=points[3:])
    assert alone.best_peers() == [
        row | {"peer": None, "bytes": None, "ratios": {"fhash compact": None}}
    ]
