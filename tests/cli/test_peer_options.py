"""Options for peers: filters by name, programs by path."""

from __future__ import annotations

import click
import pytest

from fhash_cli.peer_options import Peer, PeerType, filters_of, opened, programs_of
from fhash_codec.bench.rate.results import PEERS
from fhash_codec.progress import silent


def test_filters_are_all_unless_some_are_named() -> None:
    program = Peer(name="vvc", path="/usr/bin/ffmpeg")
    assert filters_of([]) == filters_of([program]) == list(PEERS)
    assert filters_of([Peer(name="SZ3"), program, Peer(name="SZ3")]) == ["SZ3"]
    assert filters_of([Peer(name="none"), program]) == []
    assert programs_of([Peer(name="SZ3"), program]) == {"vvc": "/usr/bin/ffmpeg"}


def test_a_peer_is_a_name_or_a_program() -> None:
    kind = PeerType()
    assert kind.convert("SZ3", None, None) == Peer(name="SZ3")
    assert kind.convert("tthresh=a=b", None, None) == Peer(name="tthresh", path="a=b")
    assert kind.convert(Peer(name="none"), None, None) == Peer(name="none")
    for wrong in ("SZ3=/bin/true", "tthresh", "", "=x"):
        with pytest.raises(click.BadParameter, match="is no peer; allowed: SZ3"):
            kind.convert(wrong, None, None)


def test_a_generated_series_has_no_options() -> None:
    with opened("generated:long", None, silent) as series:
        assert series.shape == (600, 6, 10, 14)
