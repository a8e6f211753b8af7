"""Records that the stages of planning hand on: what is planned, and the best attempt so far."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from fhash_codec.compact.choices.head import HeadHistory
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.access import Tiling
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.features import Feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Parts
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings


class GainLog:
    """Approximate size of the file after each stage, for the header.

    Attributes:
        entries: `what`, `bytes` of the file and `seconds` since the beginning, per stage.
    """

    def __init__(self, overhead: int) -> None:
        """Begin to count the seconds. overhead: bytes of the file that are no tiles, roughly."""
        self._overhead, self._begun = overhead, time.perf_counter()
        self.entries: list[dict[str, Any]] = []

    def note(self, what: str, outcome: Outcome) -> None:
        """Add the size of the file by the outcome of a stage."""
        self.entries.append(
            {
                "what": what,
                "bytes": round(outcome.size + self._overhead),
                "seconds": round(time.perf_counter() - self._begun, 3),
            }
        )


@dataclass(frozen=True, kw_only=True)
class PlanTask:
    """A series and what is asked for: the same in all stages of planning."""

    blocks: Blocks
    """The series as one tile."""
    value_range: ValueRange
    features: Sequence[Feature]
    config: EncodeConfig
    goal: Goal
    fixed_tile: Shape | None
    """Tile that the settings name; None if it is to be chosen."""
    workers: ThreadPoolExecutor
    gains: GainLog
    parts: Parts = field(default_factory=Parts)
    """Progress of the planning."""

    @property
    def density(self) -> int:
        """Thoroughness of filling the vertices that do not count, see `fill`."""
        effort = self.config.effort
        return 8 if effort >= 4 else 4 if effort > 1 else 1


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Settings and options that the series would be coded with, by the choices made so far."""

    sample: Sample
    """Tiles that the choices are tried on; their grid is the chosen one."""
    settings: TileSettings
    """Settings of the tiles: all that a decoder needs to know."""
    outcome: Outcome
    """Outcome of the sample with these settings."""
    coding: Coding
    """Options of the encoder, without the bound."""
    tried: list[Outcome] = field(default_factory=list)
    """Outcomes on the way of the search for the PSNR, without a head."""
    history: HeadHistory = field(default_factory=list)
    """Training of the head."""
    tiling: Tiling | None = None
    """Choice of the tiles; None where they were asked for."""
