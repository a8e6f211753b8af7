"""Transfer functions: the colour and the extinction of a value, by named or listed opacities."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.features.features import Interval, Isosurface, Segmentation, parse_feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering.colours import (
    ColourMap,
    Preset,
    is_map,
    named_map,
    parse_colour,
    read_preset,
)
from fhash_codec.rendering.scenes import TransferFunctionSpec
from fhash_formats.errors import FhashWarning, InputError, suggestion
from fhash_formats.support.values import Double

Range = tuple[float, float]
Histogram = tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]
"""Bin edges (n + 1,), ascending, and counts (n,) of values."""
Thinnest = tuple[int, float]
"""Vertices of the axis with the fewest, and its length in unit distances of the opacity."""

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
"""Names of the presets."""
FAINTEST = 1 / 255
"""Smallest opacity of PyVista's tables of bytes; below it is 0, and need not be marched through."""
INTERVAL = 0.3
"""Largest opacity per vertex spacing within an interval or a segmentation."""
SURFACE = 0.6
"""Largest opacity per vertex spacing at the value of an isosurface."""
BACKGROUND = 0.25
"""Largest opacity per vertex spacing of values far from the background."""
THIN = 8
"""Vertices along the thinnest axis up to which a volume is thin: nothing hides behind its values.
All of them are shown, and as opaque together as so many vertex spacings would be."""
EDGE = 0.1
"""Share of an interval's width over which its opacity rises, and falls again."""
TENT = 0.02
"""Half the width of an isosurface's tent, as a share of the value range."""
KINDS = 16
"""Different values up to which they may be labels, whose colours reach over all of them. This and
the next two were chosen by eye, on a storm, a shock, a temperature and the scenes of `demo`."""
VISIBLE = 0.02
"""Share of what is visible that lies beyond each end of the colours."""
CUT = 0.05
"""Share of the value range that an end of the colours cuts off, at least."""
SHARES = np.linspace(0.0, 1.0, 65)
"""Shares of the range shown at which curved presets have points."""
MAX_VALUE = float(np.finfo(np.float64).max)
"""Largest value of float64."""


def opacity_preset(
    name: str,
    *,
    shown: Range,
    value_range: Range,
    features: Sequence[str],
    histogram: Histogram | None,
    thinnest: Thinnest | None = None,
) -> Double:
    """Find a preset by name: points (value, opacity), float64 (n, 2), values strictly ascending.

    Args:
        name: one of PRESETS.
        shown: the values that the colours reach over; PyVista's presets reach over them too.
        value_range: lowest and highest value of the series.
        features: of the file, as texts.
        histogram: of the values of the series, for `auto` without a suitable feature.
        thinnest: axis of the volume, by which `auto` makes planes opaque and thin volumes more so;
            None for a volume that is not thin.

    Raises InputError for an unknown name, with the nearest one, and for `feature` if the file has
    no feature that tells values apart.
    """
    if name not in PRESETS:
        likely = suggestion(name, PRESETS)
        known = "" if likely.startswith("known") else f" Known: {', '.join(PRESETS)}"
        raise InputError(f"opacity '{name[:60]}' is not known; {likely}{known}")
    if name not in ("auto", "feature"):
        return _pyvista(name, shown)
    if name == "auto" and thinnest is not None and thinnest[0] <= THIN:
        return _of_thin(thinnest, features, value_range)
    points = _of_features(features, value_range)
    if points is not None:
        return points
    if name == "feature":
        raise InputError(
            "opacity 'feature' needs a file of an interval, an isosurface or a segmentation; "
            "use 'auto'"
        )
    if histogram is not None:
        return _away_from_background(histogram, value_range)
    return _over(value_range, np.array([0.0, 1.0]), np.array([0.0, BACKGROUND]))


def raised(points: Double, thinnest: Thinnest) -> Double:
    """Raise opacities (n, 2) of a thin volume, so that its thickness is as opaque as THIN spacings.

    The points of other volumes stay as they are.
    """
    vertices, length = thinnest
    if vertices > THIN or not length < THIN:
        return points
    with np.errstate(divide="ignore"):
        depth = np.log1p(-points[:, 1]) * (THIN / max(length, 1e-30))
    return np.stack([points[:, 0], -np.expm1(depth)], axis=-1)


def _of_thin(thinnest: Thinnest, features: Sequence[str], value_range: Range) -> Double:
    """The points of a thin volume: a plane is opaque, of a thicker one every value is seen."""
    everything = _over(value_range, np.array([0.0, 1.0]), np.array([BACKGROUND, BACKGROUND]))
    if thinnest[0] == 1:
        return np.array([[everything[0, 0], 1.0]])
    points = _of_features(features, value_range)
    return raised(everything if points is None else points, thinnest)


def _pyvista(name: str, shown: Range) -> Double:
    """The points of PyVista's presets over the values shown."""
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
    """Choose the values that colours reach over where the scene gives none.

    They are those of the features, if all features are intervals or segmentations, else all values.
    """
    ranges = [
        inside for inside in (_inside(text, value_range) for text in features) if inside is not None
    ]
    low, high = value_range
    if ranges and len(ranges) == len(features):
        low, high = min(inside[0] for inside in ranges), max(inside[1] for inside in ranges)
    return (low, high) if low < high else about(low)


def visible_range(histogram: Histogram, points: Double | None, value_range: Range) -> Range:
    """Choose the values that colours reach over by what is visible: all but VISIBLE of it.

    An end stays that of all values where it cuts less than CUT of them off. Rare peaks would else
    leave the colours of all that is seen alike.

    Args:
        histogram: bin edges (n + 1,) and counts (n,) of values.
        points: (value, opacity) (n, 2), by which a value counts; None where all count alike.
        value_range: lowest and highest value of the series.
    """
    edges, counts = histogram
    weights = counts.astype(np.float64)
    if points is not None:
        seen = weights * np.interp(edges[:-1] / 2 + edges[1:] / 2, *points.T)
        weights = seen if seen.any() else weights
    few = np.count_nonzero(counts) <= KINDS
    if few or not weights.any() or not value_range[0] < value_range[1]:
        return value_range
    share = np.cumsum(weights) / weights.sum()
    first, last = np.searchsorted(share, [VISIBLE, 1 - VISIBLE])
    low, high = float(edges[first]), float(edges[min(int(last), len(counts) - 1) + 1])
    least = _share_of(value_range, CUT)
    return (
        low if low - value_range[0] > least else value_range[0],
        high if value_range[1] - high > least else value_range[1],
    )


def about(value: float) -> Range:
    """Make a narrow range from a value upwards, or up to it where float64 ends above it."""
    extent = max(abs(value) * 1e-6, 1e-30)
    return (value, value + extent) if math.isfinite(value + extent) else (value - extent, value)


def _share_of(width: Range, share: float) -> float:
    """A share of the width of a range; the width itself may overflow."""
    low, high = width
    return share * (high - low) if math.isfinite(high - low) else share * high - share * low


def _inside(text: str, value_range: Range) -> Range | None:
    """The values of an interval or segmentation that the data have; None if there are none."""
    feature = parse_feature(text)
    low, high = value_range
    if isinstance(feature, Interval):
        low, high = max(low, feature.low), min(high, feature.high)
    elif isinstance(feature, Segmentation) and feature.threshold is not None:
        low = max(low, feature.threshold)
    else:
        return None
    return (low, high) if low < high else None


def _of_features(texts: Sequence[str], value_range: Range) -> Double | None:
    """The largest opacity of several features; None unless all of them tell values apart."""
    curves = [_of_feature(text, value_range) for text in texts]
    drawn = [curve for curve in curves if curve is not None]
    return None if not drawn or len(drawn) < len(curves) else _largest(drawn)


def _of_feature(text: str, value_range: Range) -> Double | None:
    """The points of one feature; None if it does not tell values apart."""
    feature = parse_feature(text)
    low, high = value_range
    if isinstance(feature, Isosurface):
        return _tent(feature.value, value_range)
    inside = _inside(text, value_range)
    if inside is None:
        # An interval of one value, or of none that the data have, is drawn as a surface.
        if isinstance(feature, Interval) and math.isfinite(feature.low):
            return _tent(feature.low, value_range)
        return None
    edge = _share_of(inside, EDGE)
    rise = [[inside[0], 0.0], [inside[0] + edge, INTERVAL]]
    if isinstance(feature, Segmentation):
        return np.array(rise)
    assert isinstance(feature, Interval)
    fall = [[inside[1] - edge, INTERVAL], [inside[1], 0.0]]
    # An end that the data do not reach cuts nothing off, and needs no soft edge.
    if feature.low < low:
        rise = [[inside[0], INTERVAL]]
    if feature.high > high:
        fall = [[inside[1], INTERVAL]]
    return np.array(rise + fall)


def _tent(value: float, value_range: Range) -> Double:
    """The points of a peak at a value; those beyond float64 are left out."""
    half = _share_of(value_range, TENT) or max(abs(value_range[0]) * 1e-6, 1e-30)
    points = [[value - half, 0.0], [value, SURFACE], [value + half, 0.0]]
    return np.array([point for point in points if math.isfinite(point[0])])


def _largest(curves: list[Double]) -> Double:
    """The largest of several piecewise linear curves, with the points where two of them cross."""
    values = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    heights = np.array([np.interp(values, *curve.T) for curve in curves])
    crossings = []
    for number in range(len(curves)):
        apart = heights[number] - heights[number + 1 :]
        left, right = apart[:, :-1], apart[:, 1:]
        crossed = left * right < 0
        share = (left / np.where(left == right, 1.0, left - right))[crossed]
        begin = np.broadcast_to(values[:-1], left.shape)[crossed]
        end = np.broadcast_to(values[1:], left.shape)[crossed]
        crossings.append(begin * (1 - share) + end * share)
    values = np.unique(np.concatenate([values, *crossings]))
    return np.stack(
        [values, np.max([np.interp(values, *curve.T) for curve in curves], axis=0)], axis=-1
    )


def _away_from_background(histogram: Histogram, value_range: Range) -> Double:
    """Make the most frequent value, the background, transparent and values far from it opaque.

    The opacity is 0 within the distance from the background that holds half of the vertices. It
    rises to BACKGROUND at the distance beyond which 0.5 % of them lie.
    """
    edges, counts = histogram
    low, high = value_range
    if not low < high:
        return np.array([[low, BACKGROUND]])
    if not counts.any():
        return _over(value_range, np.array([0.0, 1.0]), np.array([0.0, BACKGROUND]))
    # Scaled by a power of two, 1 for every ordinary range, so that no difference overflows or is a
    # denormal.
    scale = ValueRange(low, high).scale
    edges, low, high = edges * scale, low * scale, high * scale
    middles = edges[:-1] / 2 + edges[1:] / 2
    background = float(middles[np.argmax(counts)])
    distance = np.abs(middles - background)
    order = np.argsort(distance, kind="stable")
    share = np.cumsum(counts[order]) / counts.sum()
    width = float(edges[1] - edges[0])
    half, nearly_all = np.minimum(np.searchsorted(share, [0.5, 0.995]), len(order) - 1)
    near = float(distance[order[half]]) + width
    far = max(float(distance[order[nearly_all]]), near + width)
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
    points[:, 0] = np.clip(points[:, 0], -MAX_VALUE * scale, MAX_VALUE * scale) / scale
    return points


def _over(shown: Range, shares: Double, opacities: Double) -> Double:
    """Points with opacities (n,) at shares (n,) of a range."""
    low, high = shown
    if not low < high:
        low, high = about(low)
    return np.stack([low * (1 - shares) + high * shares, opacities], axis=-1)


OPAQUE = 64.0
"""Extinction per unit distance of opacity 1, in place of infinity; exp(-64) = 1e-28 passes."""
ENTRIES = 4096
"""Entries of the table of a transfer function."""


def extinction_of(opacity: npt.ArrayLike, distance: float) -> Double:
    """Convert an opacity 0..1 after `distance` to extinction per length.

    Opacity 1 has the extinction OPAQUE / distance, the largest possible.
    """
    with np.errstate(divide="ignore"):
        depth = -np.log1p(-np.asarray(opacity, dtype=np.float64))
    return np.asarray(np.minimum(depth, OPAQUE) / distance, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class TransferFunction:
    """Colour and extinction of values in data units.

    Attributes:
        colours: the colour map, over data units.
        points: float64 (n, 2), values, strictly ascending, and opacities 0..1 after the unit
            distance.
        unit_distance: in units of the coordinates, above 0.
        density: factor of the extinction.
        span: lowest and highest value that the table covers: between them the data have values,
            and colour or extinction change.
    """

    colours: ColourMap
    points: Double
    unit_distance: float
    density: float
    span: tuple[float, float]

    @classmethod
    def of(
        cls,
        spec: TransferFunctionSpec,
        *,
        value_range: tuple[float, float],
        spacing: float,
        features: Sequence[str] = (),
        histogram: Histogram | None = None,
        thinnest: Thinnest | None = None,
    ) -> TransferFunction:
        """Make the transfer function that a scene asks for.

        Args:
            spec: of the scene.
            value_range: lowest and highest value of the data.
            spacing: between vertices in units of the coordinates; the unit distance by default.
            features: of the file, as texts.
            histogram: bin edges (n + 1,) and counts (n,) of values, for the opacity `auto`.
            thinnest: axis of the volume, by which `auto` makes thin volumes opaque, unless the
                scene has a unit distance of its own.

        Raises InputError for an unknown name, for points that do not ascend, and where nothing
        would be visible, unless `spec.nothing`.
        """
        low, high = value_range
        if spec.range is not None and spec.range[0] >= spec.range[1]:
            raise InputError(
                f"range is {spec.range[0]:g} to {spec.range[1]:g}; "
                "the first value must be below the second"
            )

        def over(shown: Range) -> tuple[ColourMap, Double]:
            """Colours that reach over some values, and the opacities then."""
            colours, preset = _colours(spec, shown)
            if spec.nothing:
                return colours, np.array([[low, 0.0]])
            if not isinstance(spec.opacity, str):
                return colours, _checked_points(spec.opacity)
            if spec.opacity == "auto" and preset is not None and preset.opacity is not None:
                return colours, preset.opacity
            return colours, opacity_preset(
                spec.opacity,
                shown=shown,
                value_range=value_range,
                features=features,
                histogram=histogram,
                thinnest=thinnest if spec.unit_distance is None else None,
            )

        shown = spec.range or shown_range(features, value_range)
        colours, points = over(shown)
        if spec.range is None and histogram is not None and shown == value_range:
            follows = isinstance(spec.opacity, str) and spec.opacity not in ("auto", "feature")
            weights = None if follows else points
            colours, points = over(visible_range(histogram, weights, value_range))
        function = cls(
            colours=colours,
            points=points,
            unit_distance=spec.unit_distance or spacing,
            density=spec.density,
            span=_span(points, colours, value_range),
        )
        if not spec.nothing and not function.shows(low, high):
            raise InputError(
                f"the transfer function shows nothing: no value from {low:g} to {high:g} has an "
                "opacity above 0; change 'opacity' or 'density', "
                "or say 'nothing' for surfaces alone"
            )
        return function

    def colour(self, values: npt.ArrayLike) -> Double:
        """Look up the colours (..., 3), 0..1 in sRGB, of values of any shape; NaN has a grey."""
        return self.colours(values)

    def opacity(self, values: npt.ArrayLike) -> Double:
        """Look up the opacity 0..1 after the unit distance, without the density; 0 for NaN."""
        array = np.asarray(values, dtype=np.float64)
        # Scaled by a power of two, 1 for ordinary values: the distance of two points may overflow,
        # and so may its reciprocal.
        scale = ValueRange(self.points[0, 0], self.points[-1, 0]).scale
        opacity = np.interp(scale * array, scale * self.points[:, 0], self.points[:, 1])
        return np.where(np.isnan(array), 0.0, opacity)

    def extinction(self, values: npt.ArrayLike) -> Double:
        """Look up the extinction per length of the coordinates, finite; 0 for NaN."""
        return self.density * extinction_of(self.opacity(values), self.unit_distance)

    def table(self, n: int = ENTRIES) -> tuple[float, float, npt.NDArray[np.float32], Double]:
        """Tabulate the function at n values spread evenly over `span`.

        A table is linear between its entries, and beyond the ends it is that of the ends. Warns
        with FhashWarning where a peak of the opacity falls between two entries.

        Returns:
            The ends of `span`, colours float32 (n, 3), extinctions float64 (n,).
        """
        low, high = self.span
        share = np.arange(n) / (n - 1)
        values = low * (1 - share) + high * share
        extinctions = self.extinction(values)
        scale = ValueRange(low, high).scale
        places = np.clip(
            np.interp(self.points[:, 0] * scale, [low * scale, high * scale], [0, n - 1]), 0, n - 1
        )
        around = np.maximum(
            extinctions[np.floor(places).astype(np.int64)],
            extinctions[np.ceil(places).astype(np.int64)],
        )
        inside = (self.points[:, 0] >= low) & (self.points[:, 0] <= high)
        if np.any(inside & (self.points[:, 1] > 0) & (around == 0)) and self.density > 0:
            warnings.warn(
                f"a peak of the opacity is narrower than {(high - low) / (n - 1):.3g}, a {n}th of "
                "the values it lies among, and is not drawn; use an isosurface for it",
                FhashWarning,
                stacklevel=2,
            )
        return low, high, self.colours(values).astype(np.float32), extinctions

    def shows(self, low: float, high: float) -> bool:
        """Whether a value of a range, or within an entry of a table of it, has an extinction."""
        entry = self.span[1] / (ENTRIES - 1) - self.span[0] / (ENTRIES - 1)
        with np.errstate(over="ignore"):
            ends = np.float64(low) - entry, np.float64(high) + entry
        at, opacities = self.points.T
        inside = opacities[(at >= ends[0]) & (at <= ends[1])]
        return self.density > 0 and bool(np.any(inside > 0) or np.any(self.opacity(ends) > 0))

    def to_dict(self) -> dict[str, Any]:
        """JSON values of what the scene's words came to."""
        return {
            "range": self.colours.positions[[0, -1]].tolist(),
            "colours": np.column_stack([self.colours.positions, self.colours.points]).tolist(),
            "space": self.colours.space,
            "opacity": self.points.tolist(),
            "unit_distance": self.unit_distance,
            "density": self.density,
        }


def _colours(
    spec: TransferFunctionSpec, shown: tuple[float, float]
) -> tuple[ColourMap, Preset | None]:
    """The colour map over data units, and the ParaView preset that it is from, if any.

    A preset that reaches from 0 or -1 to 1 is stretched over `shown`. A preset over other values
    keeps them, unless the scene has a range.
    """
    if not isinstance(spec.colours, str):
        return _colour_points(spec.colours), None
    is_file = spec.colours.lower().endswith(".json") or os.path.isfile(spec.colours)
    if is_map(spec.colours) or not is_file:
        return named_map(spec.colours).rescaled(*shown), None
    preset = read_preset(spec.colours)
    if spec.range is not None or preset.is_relative:
        preset = preset.rescaled(*shown)
    return preset.colours, preset


def _colour_points(rows: Sequence[tuple[float, str]]) -> ColourMap:
    """The colour map of points (value, colour); raises InputError if they do not ascend."""
    values = [value for value, _ in rows]
    if not values or np.any(np.diff(values) <= 0):
        raise InputError(
            "the values of 'colours' do not ascend; give at least one [value, '#rrggbb'], "
            "each value above the one before"
        )
    points = np.array([parse_colour(colour) for _, colour in rows])
    return ColourMap(positions=np.array(values, dtype=np.float64), points=points)


def _checked_points(rows: Sequence[tuple[float, float]]) -> Double:
    """Points (value, opacity) as float64 (n, 2); raises InputError for what they may not be."""
    if not rows:
        raise InputError(
            "'opacity' has no points; give [value, opacity] pairs or the name of a preset"
        )
    points = np.array(rows, dtype=np.float64)
    if np.any(np.diff(points[:, 0]) <= 0):
        raise InputError("the values of 'opacity' do not ascend; each must be above the one before")
    wrong = points[(points[:, 1] < 0) | (points[:, 1] > 1)]
    if len(wrong):
        raise InputError(
            f"opacity is {wrong[0, 1]:g} at the value {wrong[0, 0]:g}; allowed: 0 to 1"
        )
    return points


def _span(
    points: Double, colours: ColourMap, value_range: tuple[float, float]
) -> tuple[float, float]:
    """The values that a table has to cover.

    They are no more than the data have and no more than is visible, so that entries lie close.
    """
    low, high = value_range
    positive = np.flatnonzero(points[:, 1] > 0)
    if positive.size:
        first, last = positive[0], positive[-1]
        ends = colours.positions[[0, -1]]
        low = max(low, points[first - 1, 0] if first > 0 else min(points[0, 0], ends[0]))
        high = min(
            high, points[last + 1, 0] if last + 1 < len(points) else max(points[-1, 0], ends[1])
        )
    if not low < high:
        low, high = about(float(min(low, high)))
    return float(low), float(high)
