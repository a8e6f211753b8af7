"""What decoded values say of the occupancy: scores (fhash_formats.transform.entropy.mask_levels) from the features, or learned from a sample."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from fhash_codec.compact.tiles.blocks import Care, Values
from fhash_codec.coreset.features import Feature, Interval, Isosurface, Segmentation
from fhash_formats.transform.entropy.mask_levels import MAX_EDGES, MAX_REACH, UNIT, MaskLevels

OFFSETS = {
    1: (0, 0.15, 0.35, 0.6, 1, 1.5, 2.2, 3.2),
    2: (0, 0.4, 1, 2.2),
    5: (0, 0.8),
    MAX_EDGES: (0,),
}
"""Edges around a threshold, to both sides, in errors: fewer where there are many thresholds."""
SURE = 2.0**-16
CLASSES = 16


def mask_levels(
    features: Sequence[Feature], dilation: int, error: float, tiles: Iterable[tuple[Values, Care]]
) -> MaskLevels:
    """Scores for features that grew by `dilation`, where values are decoded with that root of the mean squared error.

    Features whose thresholds say nothing, or too many of them, are learned from tiles.
    """
    reach = min(dilation, MAX_REACH)
    error = max(error, 1e-30)
    if len(features) == 1 and isinstance(features[0], Isosurface):
        value = features[0].value
        edges = _edges([value], error)
        above = [_normal((center - value) / error) for center in _centers(edges, error)]
        scores, others = (tuple(map(_score, odds)) for odds in (above, [1 - p for p in above]))
        return MaskLevels(edges=edges, scores=scores, others=others, reach=max(reach, 1))
    spans = [_span(feature) for feature in features]
    thresholds = sorted(
        {end for span in spans if span is not None for end in span if math.isfinite(end)}
    )
    if None in spans or not 1 <= len(thresholds) <= MAX_EDGES:
        return _learned(tiles)
    edges = _edges(thresholds, error)
    outside = [
        math.prod(
            1 - _normal((high - center) / error) + _normal((low - center) / error)
            for low, high in filter(None, spans)
        )
        for center in _centers(edges, error)
    ]
    return MaskLevels(edges=edges, scores=tuple(_score(1 - p) for p in outside), reach=reach)


def _span(feature: Feature) -> tuple[float, float] | None:
    if isinstance(feature, Interval):
        return feature.low, feature.high
    if isinstance(feature, Segmentation) and feature.threshold is not None:
        return feature.threshold, math.inf
    return None


def _edges(thresholds: list[float], error: float) -> tuple[float, ...]:
    offsets = OFFSETS[min(count for count in OFFSETS if count >= len(thresholds))]
    every = {
        _short(threshold + sign * offset * error)
        for threshold in thresholds
        for offset in offsets
        for sign in (-1, 1)
    }
    return tuple(sorted(every))[:MAX_EDGES]


def _centers(edges: tuple[float, ...], error: float) -> list[float]:
    """A value that stands for each class."""
    inner = [low + (high - low) / 2 for low, high in pairwise(edges)]
    return [edges[0] - 0.8 * error, *inner, edges[-1] + 0.8 * error]


def _learned(tiles: Iterable[tuple[Values, Care]]) -> MaskLevels:
    """How many of the vertices of each class count; classes of equal size."""
    pairs = [
        (values.ravel(), np.ones(values.size, bool) if care is None else care.ravel())
        for values, care in tiles
    ]
    values, care = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    finite = np.isfinite(values)
    values, care = values[finite].astype(np.float64), care[finite]
    if not values.size:
        return MaskLevels()
    edges = tuple(
        sorted(
            {_short(float(edge)) for edge in np.quantile(values, np.arange(1, CLASSES) / CLASSES)}
        )
    )
    classes = np.searchsorted(edges, values, side="right")
    share = np.bincount(classes, weights=care, minlength=len(edges) + 1) / np.maximum(
        np.bincount(classes, minlength=len(edges) + 1), 1
    )
    return MaskLevels(edges=edges, scores=tuple(_score(float(p)) for p in share))


def _score(p: float) -> int:
    return round(-UNIT * math.log2(max(1 - p, SURE)))


def _normal(deviation: float) -> float:
    """Of the standard normal distribution, up to a deviation."""
    return (
        0.5 * (1 + math.erf(deviation / math.sqrt(2)))
        if math.isfinite(deviation)
        else float(deviation > 0)
    )


def _short(value: float) -> float:
    """Few digits: the settings are text."""
    return float(f"{value:.7g}")
