"""Trials of tilings: a series, or parts of it, coded whole in tiles of one shape after another.

Each tiling is coded with one step and plainly (no head, no second pass). What later stages save,
they save in about the same proportion with any tiles.
"""

from __future__ import annotations

import math
from dataclasses import replace
from math import prod

from fhash_codec.compact.attempt import PlanTask
from fhash_codec.compact.choices.search import EXCHANGE, exchange, step_after_gain
from fhash_codec.compact.choices.step import find_step
from fhash_codec.compact.choices.transform import (
    basis_bytes,
    refit,
    rough_transform,
    usual_transform,
    wavelet,
)
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.axes.spec import AxisTransform
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["PICKED_VERTICES", "Trials"]

PICKED_VERTICES = 1 << 19
"""Vertices coded for each trial of a transform."""
FITTED_LINES = 1 << 15
"""Lines of a series that the data's own bases are fitted on, for trials."""
MIN_LINES = 256
"""The least of them in each tile."""
ENTRY_BYTES = 16
"""Bytes of the directory of a file for each tile."""
MIN_EXCHANGE = 2.0
"""Fewest dB that an octave of bytes is believed to buy."""
MAX_EXCHANGE = 8.0
"""Most dB that it is believed to buy."""
FAR = 0.25
"""Difference in dB from which on a tiling is coded again, with a step of its own."""
MOST_MISSING = 6.0
"""Difference in dB that is corrected for, at most."""


class Trials:
    """Tilings of a series, or of parts of it, coded at one step.

    Attributes:
        shape: of the series, or of each part.
        sizes: bytes of the series at equal quality by tiling, in the order of the trials.
    """

    def __init__(
        self, task: PlanTask, blocks: Blocks, settings: TileSettings, coding: Coding
    ) -> None:
        self._task, self._blocks, self.shape = task, blocks, blocks.shape
        self._settings, self._coding = settings, task.goal.bounded(coding)
        self._known: dict[tuple[int, int], AxisTransform] = {}
        self._psnr: float | None = None
        self._settled: list[Outcome] = []
        self.sizes: dict[Shape, float] = {}

    def size(self, tile: Shape) -> float:
        """Return the bytes of the series with a tile, which is coded if it was not before."""
        if tile not in self.sizes:
            settings, tried = self._settings, None
            if not settings.labels:
                settings, tried = self._picked(tile)
            sample = self._sample(tile, 1 << 62)
            outcome = tried or sample.run(settings, self._coding)
            missing = self._missing(outcome)
            if abs(missing) > FAR and self._coding.error is None and not settings.labels:
                settings = replace(settings, step=step_after_gain(settings.step, -missing))
                outcome = sample.run(settings, self._coding)
            self._note(sample, outcome, settings)
        return self.sizes[tile]

    def settle(self, in_space: Shape | None) -> TileSettings:
        """Look for the step that keeps the promise with one tile, and return settings with it.

        All trials then take it.

        The first guess knows no good transform, and its step may be far too fine. With other tiles
        another step may be better; at that of one tile they then seem to cost more, never less.

        in_space: tile of all steps, on which transforms are tried sooner than on all vertices.
        """
        goal, settings = self._task.goal, self._settings
        if settings.labels or goal.size is not None or (not goal.error and not goal.psnr):
            return settings
        if in_space is not None:
            self._picked(in_space)
        found, _ = self._picked(self.shape)
        coding = self._coding
        if self.shape != self._task.blocks.shape:
            # A part coded without its bound seems cheap, and wins. With it columns of many steps
            # win under loose bounds, where they took 1.7 times the bytes (a shock within 5 %).
            coding = replace(coding, error=None)
        sample = self._sample(self.shape, 1 << 62)
        found, outcome = find_step(sample, found, coding, goal, tries=2, tried=self._settled)
        # Bases made for the finer step of the first guess would take too many bytes beside others.
        refitted = refit(sample, found)
        if refitted is not found:
            found, outcome = refitted, sample.run(refitted, coding)
        self._settings = replace(found, transform=settings.transform)
        self._note(sample, outcome, found)
        return self._settings

    def _picked(self, tile: Shape) -> tuple[TileSettings, Outcome | None]:
        """Return settings with a transform, and the outcome of the series if it was coded."""
        sample = self._sample(tile, PICKED_VERTICES)
        settings, tried = rough_transform(
            sample,
            self._settings,
            self._coding,
            self._known_for(tile),
            max(FITTED_LINES // prod(sample.blocks.grid), MIN_LINES),
        )
        for axis in (0, 1):
            self._known.setdefault((axis, tile[axis]), settings.transform.axes[axis])
        return settings, tried if sample.complete else None

    def _sample(self, tile: Shape, vertices: int) -> Sample:
        blocks = self._blocks.retile(tile)
        settings = replace(self._settings, transform=usual_transform(blocks.tile))
        sample = Sample(blocks, vertices, self._task.workers, tick=self._task.parts.tick)
        return sample.filled(settings, 1)

    def _known_for(self, tile: Shape) -> dict[int, AxisTransform]:
        """Return the transforms that need no trial: those of axes as long, and wavelets along z."""
        known: dict[int, AxisTransform] = {}
        for (axis, length), transform in self._known.items():
            same = length == tile[axis] and (axis == 0 or transform.basis is None)
            if same or (axis == 1 and transform.wavelet and tile[1] > 1):
                kind, depth = transform.kind, transform.depth
                known[axis] = transform if same else wavelet(kind, depth, tile[1])
        return known

    def _note(self, sample: Sample, outcome: Outcome, settings: TileSettings) -> None:
        size = float(outcome.size)
        if self._coding.error is None:
            size *= 2 ** (self._missing(outcome) / self._exchange())
        size += ENTRY_BYTES * sum(sample.weights) + basis_bytes(settings.transform)
        self.sizes[sample.blocks.tile] = size

    def _missing(self, outcome: Outcome) -> float:
        """Return the dB that an outcome is worse by than the first one."""
        psnr = outcome.psnr(self._task.goal.data_range)
        if math.isinf(psnr):
            return 0.0
        if self._psnr is None:
            self._psnr = psnr
        return min(max(self._psnr - psnr, -MOST_MISSING), MOST_MISSING)

    def _exchange(self) -> float:
        """Return the dB that an octave of bytes buys."""
        points = [(math.log2(o.size), o.psnr(self._task.goal.data_range)) for o in self._settled]
        return min(max(exchange(points, EXCHANGE), MIN_EXCHANGE), MAX_EXCHANGE)
