"""Coding of tiles as labels, values of which few differ, beside the transform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.attempt import (
    MAX_WHOLE_VERTICES,
    REGION_MS,
    TILE_BYTES,
    Attempt,
    PlanTask,
    Tiling,
    burden,
    decoding_ns,
    region_vertices,
    tiles_of_large,
    tiles_to_try,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Blocks, Coding, Tile
from fhash_codec.compact.transform import usual_transform
from fhash_codec.measure.value_range import mean_of
from fhash_formats.transform.spec import MAX_LABELS, MAX_LENGTH, MaskLevels
from fhash_formats.transform.tile_format import FEW, TileSettings, has_regions, surely_exceeds

LOOK_VERTICES = 1 << 18
"""Vertices that are looked at, and coded for the size estimate."""
CLEARLY = 3
"""Ratio of deflated tiles to tiles of labels from which on nothing else is tried."""
HOPELESS = 1.25
"""Size of the first guess, as a multiple of that of labels, from which on nothing else is tried."""
ENERGY = 0.99
"""Share of the squared deviations from the mean that the counted vectors of a basis hold."""
STRUCTURELESS = 0.97
"""Share of the values' own entropy from which on labels are taken for noise."""


@dataclass(frozen=True, kw_only=True)
class LabelTrial:
    """Outcome of coding as labels.

    Attributes:
        attempt: tiles that were looked at, and settings.
        clearly: whether nothing else can take fewer bytes; never where values need not be exact.
        alone: whether nothing but labels may be tried: values must be exact, or all tiles may be
            labels. A sample may lie on a plateau beside a shell, whose tiles then have the settings
            of a first guess.
        entropy: bytes of the values by how often each occurs in its tile, whatever stands around.
        rank: see `rank_share`.
    """

    attempt: Attempt
    clearly: bool
    alone: bool
    entropy: float
    rank: float


def ends_trials(trial: LabelTrial, other: float) -> bool:
    """Whether labels are taken after a first guess of `other` bytes without a transform."""
    size = trial.attempt.outcome.size
    return trial.alone and is_hopeless(size, other, trial.entropy, trial.rank)


def is_hopeless(labels: float, other: float, entropy: float, rank: float) -> bool:
    """Whether trials that begin with a first guess of `other` bytes can end below `labels` bytes.

    They hardly change the size of noise, which neither way takes for anything else. Elsewhere they
    save less, the larger the first guess is beside labels, unless the data's own basis of an axis
    needs but few vectors: a trial of it leaves about this share of the first guess.

    Args:
        labels: bytes as labels.
        other: bytes of the first guess.
        entropy, rank: see `LabelTrial`.
    """
    if labels >= STRUCTURELESS * entropy:
        return other >= labels
    return rank * other >= HOPELESS * labels


def rank_share(tiles: Sequence[npt.NDArray[Any]]) -> float:
    """Return the share of the vectors of an axis that hold ENERGY of tiles (t, z, y, x).

    It is that of the axis with the smallest share, of those along which a tile may have a basis; 1
    for tiles of one value. The basis is the data's own, one for all tiles of one length.
    """
    deviations = [_unit_deviations(tile) for tile in tiles]
    smallest = 1.0
    for axis in range(4):
        moments: dict[int, npt.NDArray[np.float64]] = {}
        for tile in deviations:
            if 1 < tile.shape[axis] <= MAX_LENGTH:
                lines = np.moveaxis(tile, axis, -1).reshape(-1, tile.shape[axis])
                moments[lines.shape[1]] = moments.get(lines.shape[1], 0.0) + lines.T @ lines
        vectors = length = 0
        for moment in moments.values():
            energies = np.cumsum(np.linalg.eigvalsh(moment)[::-1])
            if energies[-1] > 0:
                vectors += 1 + int(np.searchsorted(energies, ENERGY * energies[-1]))
                length += len(moment)
        if length:
            smallest = min(smallest, vectors / length)
    return smallest


def _unit_deviations(tile: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the deviations of a tile from its middle, of magnitudes up to 1; 0 for NaN."""
    values = np.nan_to_num(tile.astype(np.float64), posinf=0.0, neginf=0.0)
    values /= max(np.abs(values).max(), np.finfo(np.float64).tiny)
    values -= values.mean()
    return values


def has_labels(task: PlanTask, tiled: Blocks) -> bool:
    """Whether any tile of a sample has few enough different values, or regions of equal ones."""
    if not (tiled.complete or tiled.masked):
        return False  # vertices that do not count would need a label
    sample = Sample(tiled, LOOK_VERTICES, task.workers)
    return any(_is_labels(tile, tiled) for tile in sample.tiles)


def _are_all_labels(task: PlanTask, tiled: Blocks) -> bool:
    """Whether all tiles of a series may be labels; of one larger than memory, those of a sample."""
    if not tiled.in_memory:
        sample = Sample(tiled, LOOK_VERTICES, task.workers)
        return all(_is_labels(tile, tiled) for tile in sample.tiles)
    return all(_is_labels(tiled.read(index), tiled) for index in tiled.indices())


def _is_labels(tile: Tile, tiled: Blocks) -> bool:
    """Whether a tile has few enough different values to be coded as labels."""
    # Vertices that are not occupied take a label of their own.
    spare = not tiled.complete
    most = (MAX_LABELS if has_regions(tile.values) else FEW) - spare
    return not surely_exceeds(tile.values, most) and np.unique(tile.values).size <= most


def look_at_labels(task: PlanTask, tiled: Blocks, settings: TileSettings) -> LabelTrial:
    """Return the trial of labels on a sample of some tiles."""
    if not task.blocks.complete:
        settings = replace(settings, mask=MaskLevels())
    settings = replace(settings, labels=True, quantum=0.0, clip=False)
    coding = Coding(filled=True, density=0)
    exact = replace(coding, exact=True)
    sample = Sample(tiled, LOOK_VERTICES, task.workers)
    outcome = sample.run(settings, replace(coding, error=0.0))
    entropy = sum(
        weight * _entropy(tile.counted_values)
        for weight, tile in zip(sample.weights, sample.tiles, strict=True)
    )
    rank = rank_share(
        [
            tile.values
            if tile.counted is None
            else np.where(tile.counted, tile.values, mean_of(tile.counted_values))
            for tile in sample.tiles
            if not tile.is_empty
        ]
    )
    clearly = task.goal.lossless and CLEARLY * outcome.size <= sample.run(settings, exact).size
    alone = task.goal.lossless or _are_all_labels(task, tiled)
    task.gains.note("labels", outcome)
    attempt = Attempt(sample=sample, settings=settings, outcome=outcome, coding=coding)
    return LabelTrial(attempt=attempt, clearly=clearly, alone=alone, entropy=entropy, rank=rank)


def with_step_of(trial: LabelTrial, guess: Attempt) -> LabelTrial:
    """Return a trial whose tiles of too many values keep the promise of a first guess.

    guess: its outcome has the promise that is not an exact one.
    """
    mask = trial.attempt.settings.mask
    settings = replace(guess.settings, labels=True, mask=mask, head=None, predictor=None)
    coding = replace(trial.attempt.coding, bulk=guess.coding.bulk)
    return replace(trial, attempt=replace(trial.attempt, settings=settings, coding=coding))


TILINGS = 3
"""Tilings that are coded as labels: a fourth saved 1 % at most."""
CODED_VERTICES = 1 << 20
"""Vertices that are coded of each."""


def tiled_labels(task: PlanTask, trial: LabelTrial) -> Attempt:
    """Return the attempt of labels with the tiles that are best for them.

    Of the tiles whose regions are decoded in time some are coded, from the fastest to the largest.
    """
    attempt, access = trial.attempt, task.config.access
    if task.fixed_tile is not None:
        settings = replace(attempt.settings, transform=usual_transform(attempt.sample.blocks.tile))
        return replace(attempt, settings=settings)
    shape = task.blocks.shape
    bits = 8 * attempt.outcome.size / prod(shape)
    ns = decoding_ns(bits, "labels")
    tiles = tiles_to_try(shape, MAX_WHOLE_VERTICES)
    if prod(shape) > MAX_WHOLE_VERTICES:
        tiles = tiles_of_large(task.blocks)
    works = [region_vertices(shape, tile) for tile in tiles]
    within = [
        tile
        for tile, work in zip(tiles, works, strict=True)
        if work * ns <= max(1e6 * REGION_MS[access], works[0] * ns)
    ]
    last = len(within) - 1
    count = 1 if task.config.effort == 1 or not task.asks("tiles") else TILINGS
    numbers = {round(last * number / max(count - 1, 1)) for number in range(count)}
    tried: list[tuple[float, Attempt]] = []
    for tile in (within[number] for number in sorted(numbers)):
        settings = replace(attempt.settings, transform=usual_transform(tile))
        sample = Sample(task.blocks.retile(tile), CODED_VERTICES, task.workers)
        outcome = sample.run(settings, task.goal.bounded(attempt.coding))
        found = replace(attempt, sample=sample, settings=settings, outcome=outcome)
        tried.append((float(outcome.size) + TILE_BYTES * prod(sample.blocks.grid), found))
    least = max(min(size for size, _ in tried), 1.0)
    _, size, best = min(
        (burden(access, size / least, region_vertices(shape, one.sample.blocks.tile), ns), size, n)
        for n, (size, one) in enumerate(tried)
    )
    tiling = Tiling(tile=tried[best][1].sample.blocks.tile, price=size / least, tried=len(tried))
    return replace(tried[best][1], tiling=tiling)


def holds_beside(task: PlanTask, labelled: Attempt, other: Attempt) -> bool:
    """Whether labels take no more bytes than another attempt does.

    Where that is known of a sample only, they must also do so on the sample of the other one: their
    own may lie on a plateau.
    """
    if labelled.outcome.size > other.outcome.size:
        return False
    if other.sample.complete:
        return True
    transform = usual_transform(other.sample.blocks.tile)
    settings = replace(labelled.settings, transform=transform)
    outcome = other.sample.run(settings, task.goal.bounded(labelled.coding))
    return outcome.size <= other.outcome.size


def _entropy(values: npt.NDArray[Any]) -> float:
    """Bytes of values by how often each occurs."""
    counts = np.unique(values, return_counts=True)[1]
    return float(-(counts * np.log2(counts / max(values.size, 1))).sum()) / 8
