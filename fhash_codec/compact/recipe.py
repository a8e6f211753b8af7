"""`Recipe`: how each tile of a planned series is coded, without the series; and coding by it.

A recipe is all that a machine needs to code some layers of tiles to the bytes that one encoding of
everything gives them, under a bound of the error. It is JSON, so that it can be sent and stored.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.tiles.blocks import Blocks, Tile
from fhash_codec.compact.tiles.coding import Coding, Outcome, code, total
from fhash_codec.compact.tiles.filling import fill
from fhash_codec.progress import Progress
from fhash_formats.container.record import Record
from fhash_formats.support.threads import map_ahead, usable_threads
from fhash_formats.transform.tile.decoding import transform_for
from fhash_formats.transform.tile.filling import RATIOS
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["CodedLayers", "Filling", "Recipe", "code_layers"]

MAX_LENGTH = 1 << 24
"""Vertices of a tile along an axis, at most."""
_SWITCHES = ("filled", "keep_missing", "own_settings", "exact")
"""Options of the encoder that are true or false."""
_COUNTS = ("rounds", "passes")
"""Options of the encoder that count how often it does something."""
MAX_COUNT = 64
"""Largest of these numbers."""


@dataclass(frozen=True, kw_only=True)
class Filling:
    """The way in which a search has filled the vertices that do not count; see `fill`."""

    settings: TileSettings
    density: int


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The coding of every tile of a series.

    Attributes:
        tile: shape (t, z, y, x) of a tile.
        settings: that all tiles share.
        coding: options of the encoder, the bound among them.
        filling: fill values that tiles get before they are coded; None where the encoder finds its
            own, or none are needed.
    """

    tile: Shape
    settings: TileSettings
    coding: Coding
    filling: Filling | None = None

    @classmethod
    def of(cls, plan: CodingPlan) -> Recipe:
        """The recipe of a plan under a bound of the error."""
        filling = None
        if plan.sample is not None and plan.coding.filled and plan.sample.filling is not None:
            settings, density = plan.sample.filling
            filling = Filling(settings=settings, density=density)
        return cls(
            tile=plan.blocks.tile,
            settings=plan.settings,
            coding=replace(plan.coding, bulk=None),  # it is measured by, and changes no byte
            filling=filling,
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON values; `from_dict` takes them."""
        coding = {name: value for name, value in vars(self.coding).items() if name != "bulk"}
        values = {"tile": list(self.tile), "settings": self.settings.to_text(), "coding": coding}
        if self.filling is not None:
            settings, density = self.filling.settings.to_text(), self.filling.density
            values["filling"] = {"settings": settings, "density": density}
        return values

    @classmethod
    def from_dict(cls, record: Record) -> Recipe:
        """The inverse of `to_dict`. Raises DamagedFileError or InputError for anything else."""
        t, z, y, x = record.integers("tile", 4, 1, MAX_LENGTH)
        filling = None
        if record.has("filling"):
            told = record.record("filling")
            density = told.integer("density", 0, max(RATIOS))
            told.need(density in (0, *RATIOS), "density", f"0 or one of {list(RATIOS)}")
            filling = Filling(settings=_settings(told, (t, z, y, x)), density=density)
        return cls(
            tile=(t, z, y, x),
            settings=_settings(record, (t, z, y, x)),
            coding=_coding(record.record("coding")),
            filling=filling,
        )


def _settings(record: Record, tile: Shape) -> TileSettings:
    """The settings of a record for tiles of a shape; raises InputError or DamagedFileError."""
    settings = TileSettings.from_text(record.text("settings"))
    transform_for(settings, tile)  # refuses bases of other lengths
    return settings


def _coding(record: Record) -> Coding:
    """The options of the encoder in a record; raises DamagedFileError."""
    options: dict[str, Any] = {name: record.get(name) for name in _SWITCHES}
    for name, switch in options.items():
        record.need(isinstance(switch, bool), name, "true or false")
    options |= {name: record.integer(name, 0, MAX_COUNT) for name in _COUNTS}
    density = record.integer("density", 0, max(RATIOS))
    none_needed = density == 0 and options["filled"]
    record.need(none_needed or density in RATIOS, "density", f"one of {list(RATIOS)}")
    weight, error = record.number("weight"), record.number_or_null("error")
    record.need(weight >= 0, "weight", "a number from 0 on")
    record.need(error is None or error >= 0, "error", "a number from 0 on, or null")
    return Coding(weight=weight, error=error, density=density, **options)


@dataclass(frozen=True, kw_only=True)
class CodedLayers:
    """Some layers of tiles, coded.

    Attributes:
        streams: bytes of each tile, in C order.
        outcome: size and error of all of them.
    """

    streams: list[bytes]
    outcome: Outcome


def code_layers(
    blocks: Blocks,
    recipe: Recipe,
    layers: range,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> CodedLayers:
    """Code some layers of tiles along time, with the bytes that they have in a whole table.

    blocks: the series in the tiles of the recipe. One layer is in memory at a time.

    Raises DamagedFileError for a recipe whose settings are not of these tiles. Progress stage:
    "coding".
    """

    def work(tile: Tile) -> tuple[bytes, Outcome]:
        if recipe.filling is not None:
            tile = fill(tile, recipe.filling.settings, recipe.filling.density)
        coded, outcome = code(tile, recipe.settings, recipe.coding)
        return coded.data, outcome

    assert blocks.tile == recipe.tile
    count = len(layers) * math.prod(blocks.grid[1:])
    _, *grid = blocks.grid
    indices = ((t, z, y, x) for t, z, y, x in product(layers, *map(range, grid)))
    tiles = (blocks.read(index) for index in indices)
    streams, outcomes = [], []
    for data, outcome in map_ahead(workers, work, tiles, 2 * usable_threads()):
        streams.append(data)
        outcomes.append(outcome)
        progress("coding", len(streams), count, "")
    return CodedLayers(streams=streams, outcome=total(outcomes))
