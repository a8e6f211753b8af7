"""Searches end at the coarsest setting that reaches a quality, in few trials."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.cost.peers import EXACT, LADDER, PeerEncodings, Search, Trial
from fhash_codec.cost.plan import PEERS, Allowance, Wish, facts_of
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def codec(slope: float, offset: float, noise: float = 0.0) -> Callable[[float], Trial]:
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


def wish(name: str, target: float) -> Wish:
    return Wish(codec=name, group=name, target=target)


def encodings(series: ArraySeries, folder: Path, allowance: Allowance) -> PeerEncodings:
    return PeerEncodings(series, facts_of(series, silent), folder, allowance, silent)


def test_each_peer_reaches_what_it_is_set_to(series: ArraySeries, tmp_path: Path) -> None:
    peers = encodings(series, tmp_path, Allowance(1000.0))
    for target in (40.0, 50.0):
        for name in PEERS:
            peers.measure(wish(name, target))
    assert [point.codec for point in peers.points] == [*PEERS, *PEERS]
    for point, target in zip(peers.points, [40.0] * 3 + [50.0] * 3, strict=True):
        assert point.psnr is not None
        assert target <= point.psnr < target + 25
        assert point.measured
        assert point.psnr_bulk is not None
        assert point.max_abs_error is not None


def test_without_time_or_package_they_are_left_out(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    allowance = Allowance(1e-9)
    peers = encodings(series, tmp_path, allowance)
    peers.measure(wish("SZ3", 40.0))
    assert [entry.late for entry in allowance.left_out] == [True]
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    allowance = Allowance(1000.0)
    peers = encodings(series, tmp_path, allowance)
    for name in PEERS:
        peers.measure(wish(name, 40.0))
    assert peers.points == []
    (entry,) = allowance.left_out
    assert "fhash[bench]" in entry.why
