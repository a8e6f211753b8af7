"""Transfer functions: the colour and the extinction of a value.

Opacity is given per unit distance and turned into extinction per length, extinction = -log(1 - opacity) / distance, so that the
light that passes a length does not depend on the steps it is sampled in: alpha = 1 - exp(-extinction * length). Opacity is
linear in the value between its points, and beyond the ends that of the ends.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering.colour.colours import ColourMap, is_map, named_map, parse_colour
from fhash_codec.rendering.colour.opacity import Histogram, about, opacity_preset, shown_range
from fhash_codec.rendering.colour.paraview import Preset, read_preset
from fhash_codec.rendering.scene.scene import TransferFunctionSpec
from fhash_formats.errors import FhashWarning, InputError

__all__ = ["OPAQUE", "TransferFunction", "alpha", "extinction_of"]

Floats = npt.NDArray[np.float64]

OPAQUE = 64.0
"""Extinction per unit distance of opacity 1, which would be infinite: exp(-64) of the light, 1e-28, passes."""
ENTRIES = 4096


def alpha(extinction: npt.ArrayLike, length: npt.ArrayLike) -> Floats:
    """Opacity 0..1 of a length, in float64: exact for tiny steps, where 1 - (1 - opacity)^length is 0 or noise."""
    return np.asarray(
        -np.expm1(-np.multiply(extinction, length, dtype=np.float64)), dtype=np.float64
    )


def extinction_of(opacity: npt.ArrayLike, distance: float) -> Floats:
    """Extinction per length of an opacity 0..1 after `distance`; at most OPAQUE / distance, which opacity 1 has."""
    with np.errstate(divide="ignore"):
        depth = -np.log1p(-np.asarray(opacity, dtype=np.float64))
    return np.asarray(np.minimum(depth, OPAQUE) / distance, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class TransferFunction:
    """Colour and extinction of values in data units.

    Attributes:
        colours: the colour map, over data units.
        points: float64 (n, 2), values, strictly ascending, and opacities 0..1 after the unit distance.
        unit_distance: in units of the coordinates, above 0.
        density: factor of the extinction.
        span: the lowest and the highest value between which colour or extinction change, or could be met.
    """

    colours: ColourMap
    points: Floats
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
    ) -> TransferFunction:
        """The transfer function that a scene asks for.

        value_range: of the data. spacing: between vertices in units of the coordinates, the unit distance if the scene has none.
        features: of the file, as texts. histogram: edges (n + 1,) and counts (n,) of values, for the opacity `auto`.
        Raises InputError for an unknown name, points that do not ascend, and where nothing would be visible, unless `spec.nothing`.
        """
        low, high = value_range
        if spec.range is not None and spec.range[0] >= spec.range[1]:
            raise InputError(
                f"range is {spec.range[0]:g} to {spec.range[1]:g}; the first value must be below the second"
            )
        shown = spec.range or shown_range(features, value_range)
        colours, preset = _colours(spec, shown)
        if spec.nothing:
            points = np.array([[low, 0.0]])
        elif not isinstance(spec.opacity, str):
            points = _ascending(spec.opacity)
        elif spec.opacity == "auto" and preset is not None and preset.opacity is not None:
            points = preset.opacity
        else:
            points = opacity_preset(
                spec.opacity,
                shown=shown,
                value_range=value_range,
                features=features,
                histogram=histogram,
            )
        found = cls(
            colours=colours,
            points=points,
            unit_distance=spec.unit_distance or spacing,
            density=spec.density,
            span=_span(points, colours, value_range),
        )
        if not spec.nothing and not (found.density > 0 and bool(found.visible(low, high))):
            raise InputError(
                f"the transfer function shows nothing: no value from {low:g} to {high:g} has an opacity above 0; "
                "change 'opacity' or 'density', or say 'nothing' for surfaces alone"
            )
        return found

    def colour(self, values: npt.ArrayLike) -> Floats:
        """Colours (..., 3), 0..1, of values of any shape, as a screen takes them; NaN has a grey."""
        return self.colours(values)

    def opacity(self, values: npt.ArrayLike) -> Floats:
        """Opacity 0..1 after the unit distance, without the density; 0 where a value is NaN."""
        array = np.asarray(values, dtype=np.float64)
        # By a power of two, 1 for ordinary values: the distance of two points may overflow, and so may its reciprocal.
        scale = ValueRange(self.points[0, 0], self.points[-1, 0]).scale
        found = np.interp(scale * array, scale * self.points[:, 0], self.points[:, 1])
        return np.where(np.isnan(array), 0.0, found)

    def extinction(self, values: npt.ArrayLike) -> Floats:
        """Extinction per length of the coordinates, at least 0 and finite; 0 where a value is NaN."""
        return self.density * extinction_of(self.opacity(values), self.unit_distance)

    def table(self, n: int = ENTRIES) -> tuple[float, float, npt.NDArray[np.float32], Floats]:
        """Colours float32 (n, 3) and extinctions float64 (n,) at n values spread evenly over `span`, and its ends before them.

        Values between two entries have what lies linearly between them, values beyond the ends those of the ends.
        Warns with FhashWarning where a peak of the opacity falls between two entries.
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
                f"a peak of the opacity is narrower than {(high - low) / (n - 1):.3g}, a {n}th of the values it lies among, "
                "and is not drawn; use an isosurface for it",
                FhashWarning,
                stacklevel=2,
            )
        return low, high, self.colour(values).astype(np.float32), extinctions

    def visible(
        self, minimum: npt.ArrayLike, maximum: npt.ArrayLike, n: int = ENTRIES
    ) -> npt.NDArray[np.bool_]:
        """Whether any value from `minimum` to `maximum` (arrays of one shape) has an extinction above 0, by a table of n too.

        Exact by the points, for an interval widened by one entry of the table on either side. False where either end is NaN or
        the minimum is above the maximum.
        """
        entry = self.span[1] / (n - 1) - self.span[0] / (n - 1)
        low, high = np.asarray(minimum, dtype=np.float64), np.asarray(maximum, dtype=np.float64)
        known = low <= high
        with np.errstate(over="ignore"):
            low, high = np.where(known, low, 0.0) - entry, np.where(known, high, 0.0) + entry
        at, positive = self.points[:, 0], self.points[:, 1] > 0
        # Between two points the opacity is above 0 if it is at either; beyond the ends it is that of the ends.
        pieces = np.concatenate([positive[:1], positive[1:] | positive[:-1], positive[-1:]])
        before = np.concatenate([[0], np.cumsum(pieces)])
        first, last = np.searchsorted(at, low, side="right"), np.searchsorted(at, high, side="left")
        touched = before[last + 1] > before[np.minimum(first, last + 1)]
        return np.asarray(known & touched & (self.density > 0), dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: what was made of the scene's words."""
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
    """The colour map over data units, and the preset that it is from.

    A preset that reaches from 0 or -1 to 1 is stretched over `shown`; one over other values keeps them unless the scene has a range.
    """
    if not isinstance(spec.colours, str):
        rows = [value for value, _ in spec.colours]
        if not rows or np.any(np.diff(rows) <= 0):
            raise InputError(
                "the values of 'colours' do not ascend; give at least one [value, '#rrggbb'], each value above the one before"
            )
        points = np.array([parse_colour(colour) for _, colour in spec.colours])
        return ColourMap(positions=np.array(rows, dtype=np.float64), points=points), None
    if is_map(spec.colours) or not (
        spec.colours.lower().endswith(".json") or os.path.isfile(spec.colours)
    ):
        return named_map(spec.colours).rescaled(*shown), None
    preset = read_preset(spec.colours)
    if spec.range is not None or preset.is_relative:
        preset = preset.rescaled(*shown)
    return preset.colours, preset


def _ascending(rows: Sequence[tuple[float, float]]) -> Floats:
    """Control points of the opacity, checked."""
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
    points: Floats, colours: ColourMap, value_range: tuple[float, float]
) -> tuple[float, float]:
    """The values that a table has to cover: no more than the data have, nor than is visible, so that its entries lie close."""
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
