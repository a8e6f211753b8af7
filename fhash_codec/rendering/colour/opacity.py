"""Opacities by name: PyVista's presets, and those that suit the features of a file or the values of a series.

Every preset is a list of points (value, opacity) between which the opacity is linear.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.features import Interval, Isosurface, Segmentation, parse_feature
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError

__all__ = ["PRESETS", "Histogram", "about", "opacity_preset", "shown_range"]

Floats = npt.NDArray[np.float64]
Range = tuple[float, float]
Histogram = tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]
"""Edges (n + 1,), ascending, and counts (n,) of values."""

PRESETS = (
    "auto",
    "feature",
    "linear",
    "linear_r",
    "geom",
    "geom_r",
    "sigmoid",
    "foreground",
    "opaque",
)
FAINTEST = 1 / 255
"""Opacities below are 0, as in PyVista's tables of bytes, so that what they are of need not be marched through."""
INTERVAL, SURFACE, BACKGROUND = 0.3, 0.6, 0.25
"""Largest opacities per vertex spacing: within an interval or segmentation, at an isosurface's value, and far from the background."""
EDGE = 0.1
"""Share of an interval over which its opacity rises, and falls again."""
TENT = 0.02
"""Half the width of an isosurface's tent, of the value range."""
SHARES = np.linspace(0.0, 1.0, 65)
ENDS = (-float(np.finfo(np.float64).max), float(np.finfo(np.float64).max))


def opacity_preset(
    name: str,
    *,
    shown: Range,
    value_range: Range,
    features: Sequence[str],
    histogram: Histogram | None,
) -> Floats:
    """Points float64 (n, 2), values strictly ascending, of a preset by name.

    shown: the values that the colours reach over, and PyVista's presets. Raises InputError for an unknown name, offering the
    nearest, and for `feature` where the file has none that tells values apart.
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1, cutoff=0.0)[0]
        raise InputError(
            f"opacity '{name[:60]}' is not known; did you mean '{near}'? Known: {', '.join(PRESETS)}"
        )
    if name in ("auto", "feature"):
        points = _of_features(features, value_range)
        if points is not None:
            return points
        if name == "feature":
            raise InputError(
                "opacity 'feature' needs a file of an interval, an isosurface or a segmentation; use 'auto'"
            )
        if histogram is not None:
            return _away_from_background(histogram, value_range)
        return _over(value_range, np.array([0.0, 1.0]), np.array([0.0, BACKGROUND]))
    if name == "opaque":
        return np.array([[shown[0], 1.0]])
    if name == "foreground":
        return _over(shown, np.array([0.0, FAINTEST, 1.0]), np.array([0.0, 1.0, 1.0]))
    if name.startswith("linear"):
        opacities = np.array([0.0, 1.0])
    elif name.startswith("geom"):
        opacities = (1e-6 / 255) ** (1 - SHARES)
    else:
        opacities = 1 / (1 + np.exp(-20 * SHARES + 10))
    opacities = np.where(opacities < FAINTEST, 0.0, opacities)
    return _over(
        shown,
        np.linspace(0.0, 1.0, len(opacities)),
        opacities[::-1] if name.endswith("_r") else opacities,
    )


def shown_range(features: Sequence[str], value_range: Range) -> Range:
    """The values that colours reach over where the scene does not say: those of the intervals and segmentations, else all."""
    found = [
        range_ for range_ in (_values(text, value_range) for text in features) if range_ is not None
    ]
    low, high = value_range
    if found and len(found) == len(features):
        low, high = min(part[0] for part in found), max(part[1] for part in found)
    return (low, high) if low < high else about(low)


def about(value: float) -> Range:
    """A narrow range that begins at a value, or where float64 ends there, ends at it."""
    extent = max(abs(value) * 1e-6, 1e-30)
    return (value, value + extent) if math.isfinite(value + extent) else (value - extent, value)


def _part(share: float, reach: Range) -> float:
    """A share of the width of a range; the width itself may overflow."""
    low, high = reach
    return share * (high - low) if math.isfinite(high - low) else share * high - share * low


def _values(text: str, value_range: Range) -> Range | None:
    feature = parse_feature(text)
    low, high = value_range
    if isinstance(feature, Interval):
        low, high = max(low, feature.low), min(high, feature.high)
    elif isinstance(feature, Segmentation) and feature.threshold is not None:
        low = max(low, feature.threshold)
    else:
        return None
    return (low, high) if low < high else None


def _of_features(texts: Sequence[str], value_range: Range) -> Floats | None:
    """The largest of the features' opacities, or None unless all of them tell values apart."""
    curves = [_of_feature(text, value_range) for text in texts]
    known = [curve for curve in curves if curve is not None]
    return None if not known or len(known) < len(curves) else _largest(known)


def _of_feature(text: str, value_range: Range) -> Floats | None:
    feature = parse_feature(text)
    low, high = value_range
    if isinstance(feature, Isosurface):
        half = _part(TENT, value_range) or max(abs(low) * 1e-6, 1e-30)
        tent = [[feature.value - half, 0.0], [feature.value, SURFACE], [feature.value + half, 0.0]]
        return np.array([point for point in tent if math.isfinite(point[0])])
    inside = _values(text, value_range)
    if inside is None:
        # A feature of one value, or of none that the data have, is drawn as a surface.
        return (
            _of_feature(f"isosurface:{feature.low}", value_range)
            if isinstance(feature, Interval) and math.isfinite(feature.low)
            else None
        )
    edge = _part(EDGE, inside)
    if isinstance(feature, Segmentation):
        return np.array([[inside[0], 0.0], [inside[0] + edge, INTERVAL]])
    assert isinstance(feature, Interval)
    # An end that the data do not reach cuts nothing off, and needs no soft edge.
    rise = (
        [[inside[0], INTERVAL]]
        if feature.low < low
        else [[inside[0], 0.0], [inside[0] + edge, INTERVAL]]
    )
    fall = (
        [[inside[1], INTERVAL]]
        if feature.high > high
        else [[inside[1] - edge, INTERVAL], [inside[1], 0.0]]
    )
    return np.array(rise + fall)


def _largest(curves: list[Floats]) -> Floats:
    """The largest of several piecewise linear curves, exactly: their points, and where two of them cross."""
    values = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    heights = np.array([np.interp(values, *curve.T) for curve in curves])
    crossings = []
    for one in range(len(curves)):
        apart = heights[one] - heights[one + 1 :]
        left, right = apart[:, :-1], apart[:, 1:]
        share = (left / np.where(left == right, 1.0, left - right))[left * right < 0]
        begin = np.broadcast_to(values[:-1], left.shape)[left * right < 0]
        end = np.broadcast_to(values[1:], left.shape)[left * right < 0]
        crossings.append(begin * (1 - share) + end * share)
    values = np.unique(np.concatenate([values, *crossings]))
    return np.stack(
        [values, np.max([np.interp(values, *curve.T) for curve in curves], axis=0)], axis=-1
    )


def _away_from_background(histogram: Histogram, value_range: Range) -> Floats:
    """Opacity 0 about the most frequent value, rising with the distance from it to that of the rarest values.

    It is 0 within the distance that holds half of the vertices, and largest from the distance beyond which 0.5 % lie.
    """
    edges, counts = histogram
    low, high = value_range
    if not low < high:
        return np.array([[low, BACKGROUND]])
    if len(edges) != len(counts) + 1 or len(counts) == 0 or not counts.sum() > 0:
        return _over(value_range, np.array([0.0, 1.0]), np.array([0.0, BACKGROUND]))
    # By a power of two, 1 for every ordinary range, so that no difference overflows or is a denormal.
    scale = ValueRange(low, high).scale
    edges, low, high = edges * scale, low * scale, high * scale
    middles = edges[:-1] / 2 + edges[1:] / 2
    background = float(middles[np.argmax(counts)])
    distance = np.abs(middles - background)
    order = np.argsort(distance, kind="stable")
    share = np.cumsum(counts[order]) / counts.sum()
    width = float(edges[1] - edges[0])
    half, most = np.minimum(np.searchsorted(share, [0.5, 0.995]), len(order) - 1)
    near = float(distance[order[half]]) + width
    far = max(float(distance[order[most]]), near + width)
    rise = (
        [[background + near, 0.0], [background + far, BACKGROUND]]
        if background + near < high
        else []
    )
    fall = (
        [[background - far, BACKGROUND], [background - near, 0.0]]
        if background - near > low
        else []
    )
    points = np.array(fall + rise or [[low, BACKGROUND]])
    points[:, 0] = np.clip(points[:, 0], ENDS[0] * scale, ENDS[1] * scale) / scale
    return points


def _over(shown: Range, shares: Floats, opacities: Floats) -> Floats:
    low, high = shown
    if not low < high:
        low, high = about(low)
    return np.stack([low * (1 - shares) + high * shares, opacities], axis=-1)
