"""Tiles that were coded before: the searches come by the same settings again and again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["Known", "Run", "TileRun"]

MAX_BYTES = 64 << 20
"""Bytes of streams that are kept; the oldest go first."""


class TileRun(NamedTuple):
    """A tile as it was coded once."""

    stream: bytes
    outcome: Outcome


@dataclass(frozen=True)
class Run:
    """Tiles of a sample as they were coded once."""

    settings: TileSettings
    coding: Coding
    tiles: list[TileRun]
    """The tiles, in the order of the sample."""

    def is_of(self, settings: TileSettings, coding: Coding) -> bool:
        """Whether the tiles would be coded to these streams, and decode to the same values."""
        return self.settings.head is settings.head and self.has_streams_of(settings, coding)

    def has_streams_of(self, settings: TileSettings, coding: Coding) -> bool:
        """Whether the tiles would be coded to these streams.

        Without a bound, a head changes what streams decode to and no byte of them.
        """
        if self.coding != coding:
            return False
        if self.settings.head is not settings.head and coding.error is not None:
            return False
        return replace(self.settings, head=None) == replace(settings, head=None)


class Known:
    """The latest runs of a sample."""

    def __init__(self) -> None:
        """Begin without any."""
        self._runs: list[Run] = []

    def run(self, settings: TileSettings, coding: Coding) -> Run | None:
        """Return the run of these settings and coding; None where it was not kept."""
        return next((run for run in self._runs if run.is_of(settings, coding)), None)

    def same_streams(self, settings: TileSettings, coding: Coding) -> Run | None:
        """Return a run of the same streams; None where none was kept."""
        runs = self._runs
        return next((run for run in runs if run.has_streams_of(settings, coding)), None)

    def keep(self, run: Run) -> None:
        """Keep a run, and forget the oldest of too many bytes."""
        self._runs.insert(0, run)
        total = 0
        for number, each in enumerate(self._runs):
            total += sum(len(tile.stream) for tile in each.tiles)
            if total > MAX_BYTES:
                del self._runs[number:]
                break
