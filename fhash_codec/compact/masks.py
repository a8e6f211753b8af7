"""Scores by which the mask of the vertices that count is coded beside decoded values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from fhash_codec.compact.attempt import PlanTask
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Tile
from fhash_codec.features.features import Feature, Interval, Isosurface, Segmentation
from fhash_formats.transform.spec import MAX_EDGES, MAX_REACH, UNIT, MaskLevels
from fhash_formats.transform.tile_format import TileSettings

EDGE_OFFSETS = {
    1: (0, 0.15, 0.35, 0.6, 1, 1.5, 2.2, 3.2),
    2: (0, 0.4, 1, 2.2),
    5: (0, 0.8),
    MAX_EDGES: (0,),
}
"""Edges to both sides of a threshold, in errors, by the largest number of thresholds for them."""
MIN_PROBABILITY = 2.0**-16
"""Smallest probability that a score expresses."""
CLASSES = 16
"""Number of classes of values where scores are learned."""


def with_mask(task: PlanTask, sample: Sample, settings: TileSettings, error: float) -> TileSettings:
    """Return settings with scores for the mask of the vertices that count, if there is one.

    error: root of the mean squared error of the decoded values, in data units.
    """
    if task.blocks.complete:
        return settings
    levels = mask_levels(task.features, task.config.dilation, error, sample.tiles)
    return replace(settings, mask=levels)


def mask_levels(
    features: Sequence[Feature], dilation: int, error: float, tiles: Iterable[Tile]
) -> MaskLevels:
    """Return the scores for features.

    Features without thresholds, or with too many of them, are learned from tiles.

    features: what was selected.
    dilation: vertices by which the features were grown.
    error: root of the mean squared error of the decoded values, in data units.
    tiles: tiles of a sample.
    """
    reach = min(dilation, MAX_REACH)
    error = max(error, 1e-30)
    if len(features) == 1 and isinstance(features[0], Isosurface):
        return _isosurface_levels(features[0].value, reach, error)
    spans = [_span(feature) for feature in features]
    thresholds = sorted(
        {end for span in spans if span is not None for end in span if math.isfinite(end)}
    )
    if None in spans or not 1 <= len(thresholds) <= MAX_EDGES:
        return _learned_levels(tiles)
    edges = _edges(thresholds, error)
    outside = [
        math.prod(
            1 - _normal((high - center) / error) + _normal((low - center) / error)
            for low, high in filter(None, spans)
        )
        for center in _centers(edges, error)
    ]
    return MaskLevels(edges=edges, scores=tuple(_score(1 - p) for p in outside), reach=reach)


def _isosurface_levels(value: float, reach: int, error: float) -> MaskLevels:
    """Return the scores that a vertex lies above and below an isosurface."""
    edges = _edges([value], error)
    above = [_normal((center - value) / error) for center in _centers(edges, error)]
    return MaskLevels(
        edges=edges,
        scores=tuple(_score(p) for p in above),
        others=tuple(_score(1 - p) for p in above),
        reach=max(reach, 1),
    )


def _span(feature: Feature) -> tuple[float, float] | None:
    """Return the interval of values that a feature selects; None if it selects otherwise."""
    if isinstance(feature, Interval):
        return feature.low, feature.high
    if isinstance(feature, Segmentation) and feature.threshold is not None:
        return feature.threshold, math.inf
    return None


def _edges(thresholds: list[float], error: float) -> tuple[float, ...]:
    """Return the edges of the classes of values around thresholds."""
    offsets = EDGE_OFFSETS[min(count for count in EDGE_OFFSETS if count >= len(thresholds))]
    edges = {
        _rounded(threshold + sign * offset * error)
        for threshold in thresholds
        for offset in offsets
        for sign in (-1, 1)
    }
    return tuple(sorted(edges))[:MAX_EDGES]


def _centers(edges: tuple[float, ...], error: float) -> list[float]:
    """Return a value that stands for each class."""
    inner = [low + (high - low) / 2 for low, high in pairwise(edges)]
    return [edges[0] - 0.8 * error, *inner, edges[-1] + 0.8 * error]


def _learned_levels(tiles: Iterable[Tile]) -> MaskLevels:
    """Return scores by the share of vertices that count in each of some classes of equal size."""
    tiles = list(tiles)
    values = np.concatenate([tile.values.ravel() for tile in tiles])
    counted = np.concatenate(
        [
            np.ones(tile.values.size, bool) if tile.counted is None else tile.counted.ravel()
            for tile in tiles
        ]
    )
    finite = np.isfinite(values)
    values, counted = values[finite].astype(np.float64), counted[finite]
    if not values.size:
        return MaskLevels()
    quantiles = np.quantile(values, np.arange(1, CLASSES) / CLASSES)
    edges = tuple(sorted({_rounded(float(edge)) for edge in quantiles}))
    classes = np.searchsorted(edges, values, side="right")
    sizes = np.bincount(classes, minlength=len(edges) + 1)
    counted_sizes = np.bincount(classes, weights=counted, minlength=len(edges) + 1)
    shares = counted_sizes / np.maximum(sizes, 1)
    return MaskLevels(edges=edges, scores=tuple(_score(float(p)) for p in shares))


def _score(p: float) -> int:
    """Return the score of a probability that a vertex counts."""
    return round(-UNIT * math.log2(max(1 - p, MIN_PROBABILITY)))


def _normal(deviation: float) -> float:
    """Return the standard normal distribution function."""
    if not math.isfinite(deviation):
        return float(deviation > 0)
    return 0.5 * (1 + math.erf(deviation / math.sqrt(2)))


def _rounded(value: float) -> float:
    """Return a value of few digits: the settings are stored as text."""
    return float(f"{value:.7g}")
