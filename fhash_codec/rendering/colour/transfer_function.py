"""Transfer functions: the colour and the extinction of a value.

Opacity is given per unit distance and converted to extinction per length,
extinction = -log(1 - opacity) / distance. The light that passes a length, with
alpha = 1 - exp(-extinction * length), then does not depend on the steps it is sampled in.
Opacity is linear in the value between its points; beyond the ends it is that of the ends.
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
from fhash_codec.rendering.colour.opacity import (
    Histogram,
    Thinnest,
    about,
    opacity_preset,
    shown_range,
)
from fhash_codec.rendering.colour.paraview import Preset, read_preset
from fhash_codec.rendering.scene.scene import TransferFunctionSpec
from fhash_formats.errors import FhashWarning, InputError

__all__ = ["OPAQUE", "TransferFunction", "alpha", "extinction_of"]

Floats = npt.NDArray[np.float64]

OPAQUE = 64.0
"""Extinction per unit distance of opacity 1, in place of infinity; exp(-64) = 1e-28 passes."""
ENTRIES = 4096
"""Entries of the table of a transfer function."""


def alpha(extinction: npt.ArrayLike, length: npt.ArrayLike) -> Floats:
    """Convert extinction per length to the opacity 0..1 of a length, in float64.

    It is exact for tiny steps too, where 1 - (1 - opacity)^length would be 0 or noise.
    """
    return np.asarray(
        -np.expm1(-np.multiply(extinction, length, dtype=np.float64)), dtype=np.float64
    )


def extinction_of(opacity: npt.ArrayLike, distance: float) -> Floats:
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
        shown = spec.range or shown_range(features, value_range)
        colours, preset = _colours(spec, shown)
        if spec.nothing:
            points = np.array([[low, 0.0]])
        elif not isinstance(spec.opacity, str):
            points = _checked_points(spec.opacity)
        elif spec.opacity == "auto" and preset is not None and preset.opacity is not None:
            points = preset.opacity
        else:
            points = opacity_preset(
                spec.opacity,
                shown=shown,
                value_range=value_range,
                features=features,
                histogram=histogram,
                thinnest=thinnest if spec.unit_distance is None else None,
            )
        function = cls(
            colours=colours,
            points=points,
            unit_distance=spec.unit_distance or spacing,
            density=spec.density,
            span=_span(points, colours, value_range),
        )
        if not spec.nothing and not (function.density > 0 and bool(function.visible(low, high))):
            raise InputError(
                f"the transfer function shows nothing: no value from {low:g} to {high:g} has an "
                "opacity above 0; change 'opacity' or 'density', "
                "or say 'nothing' for surfaces alone"
            )
        return function

    def colour(self, values: npt.ArrayLike) -> Floats:
        """Look up the colours (..., 3), 0..1 in sRGB, of values of any shape; NaN has a grey."""
        return self.colours(values)

    def opacity(self, values: npt.ArrayLike) -> Floats:
        """Look up the opacity 0..1 after the unit distance, without the density; 0 for NaN."""
        array = np.asarray(values, dtype=np.float64)
        # Scaled by a power of two, 1 for ordinary values: the distance of two points may overflow,
        # and so may its reciprocal.
        scale = ValueRange(self.points[0, 0], self.points[-1, 0]).scale
        opacity = np.interp(scale * array, scale * self.points[:, 0], self.points[:, 1])
        return np.where(np.isnan(array), 0.0, opacity)

    def extinction(self, values: npt.ArrayLike) -> Floats:
        """Look up the extinction per length of the coordinates, finite; 0 for NaN."""
        return self.density * extinction_of(self.opacity(values), self.unit_distance)

    def table(self, n: int = ENTRIES) -> tuple[float, float, npt.NDArray[np.float32], Floats]:
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
        return low, high, self.colour(values).astype(np.float32), extinctions

    def visible(
        self, minimum: npt.ArrayLike, maximum: npt.ArrayLike, n: int = ENTRIES
    ) -> npt.NDArray[np.bool_]:
        """Whether ranges of values hold any value with an extinction above 0.

        The answer is exact for ranges widened by one entry of a table on either side, so that it
        also holds for the table.

        Args:
            minimum: lowest values, of any shape.
            maximum: highest values, of the same shape.
            n: entries of the table.

        Returns:
            A bool for each range; False where an end is NaN or the minimum is above the maximum.
        """
        entry = self.span[1] / (n - 1) - self.span[0] / (n - 1)
        low, high = np.asarray(minimum, dtype=np.float64), np.asarray(maximum, dtype=np.float64)
        is_range = low <= high
        with np.errstate(over="ignore"):
            low, high = np.where(is_range, low, 0.0) - entry, np.where(is_range, high, 0.0) + entry
        at, positive = self.points[:, 0], self.points[:, 1] > 0
        # Between two points the opacity is above 0 if it is at either of them.
        pieces = np.concatenate([positive[:1], positive[1:] | positive[:-1], positive[-1:]])
        before = np.concatenate([[0], np.cumsum(pieces)])
        first, last = np.searchsorted(at, low, side="right"), np.searchsorted(at, high, side="left")
        touched = before[last + 1] > before[np.minimum(first, last + 1)]
        return np.asarray(is_range & touched & (self.density > 0), dtype=bool)

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


def _checked_points(rows: Sequence[tuple[float, float]]) -> Floats:
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
    points: Floats, colours: ColourMap, value_range: tuple[float, float]
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
