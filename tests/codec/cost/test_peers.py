"""Peers: the smallest of their layouts at a quality, and what keeps them out."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.facts import facts_of
from fhash_codec.cost.peers import PeerEncodings
from fhash_codec.cost.plan import PEERS, Wish
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


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
