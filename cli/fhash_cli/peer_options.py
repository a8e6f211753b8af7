"""Options of the benches that compare with other codecs: qualities, peers, generated series."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import click

from fhash_cli.options import RealRange, SourceOptions

__all__ = [
    "Peer",
    "PeerType",
    "filters_of",
    "opened",
    "peer_option",
    "programs_of",
    "quality_options",
]

Command = TypeVar("Command", bound=Callable[..., Any])

NONE = "none"
"""Name that stands for no peer at all."""


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A peer that was named.

    Attributes:
        name: of a filter, of a program, or NONE.
        path: of the program; empty for a filter.
    """

    name: str
    path: str = ""


class PeerType(click.ParamType[Peer]):
    """A filter of HDF5 by its name, a program as NAME=PATH, or 'none'.

    Names are looked up only when one is given, so that --help loads nothing.
    """

    name = "NAME[=PATH]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Peer:
        """The peer; refuses a name that is unknown, and a program without a path."""
        from fhash_codec.bench.rate.programs.registry import PROGRAMS
        from fhash_codec.bench.rate.results import PEERS

        if isinstance(value, Peer):
            return value
        name, equals, path = str(value).partition("=")
        if name in (PROGRAMS if equals else (*PEERS, NONE)):
            return Peer(name=name, path=path)
        allowed = f"{', '.join((*PEERS, NONE))}, and as NAME=PATH {', '.join(PROGRAMS)}"
        self.fail(f"'{value}' is no peer; allowed: {allowed}", param, ctx)


peer_option = click.option(
    "--peer",
    "peers",
    type=PeerType(),
    multiple=True,
    help="SZ3, SPERR, ZFP, BitRound, Blosc or none; repeat. Default: all. Besides, as NAME=PATH,"
    " a program: tthresh, qoz, hpez, sz3, or an ffmpeg for hevc, av1 or vvc.",
)
"""Option for the codecs to compare with."""


def quality_options(command: Command) -> Command:
    """Add the options for qualities that are compared at: PSNRs and bounds."""
    for option in (
        click.option(
            "--bound",
            "bounds",
            type=RealRange(1e-9, 0.5),
            multiple=True,
            metavar="X",
            help="Largest error as a share of the range; repeat.",
        ),
        click.option(
            "--target",
            "targets",
            type=RealRange(5, 200),
            multiple=True,
            metavar="X",
            help="PSNR over all frames in dB; repeat.",
        ),
    ):
        command = option(command)
    return command


def filters_of(peers: Sequence[Peer]) -> list[str]:
    """Names of the filters among the peers, once each; all there are where none was named."""
    from fhash_codec.bench.rate.results import PEERS

    given = [peer.name for peer in peers if not peer.path]
    return [name for name in dict.fromkeys(given or PEERS) if name != NONE]


def programs_of(peers: Sequence[Peer]) -> dict[str, str]:
    """Paths of the programs among the peers by name."""
    return {peer.name: peer.path for peer in peers if peer.path}


@contextmanager
def opened(
    data: str, source: SourceOptions | None, progress: Callable[[str, int, int, str], None]
) -> Iterator[Any]:
    """The series of a file, or a generated one.

    source: options of files, which are refused for a generated series; None where there are none.
    """
    from fhash_codec.bench.rate.generated import generated, is_generated

    if is_generated(data):
        if source is not None:
            source.refuse_without_data()
        yield generated(data)
        return
    assert source is not None
    with source.open(data, progress) as series:
        yield series
