"""The even grid that a volume is drawn on, from axes that are even, uneven, or depths downwards."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Coordinate
from fhash_formats.support.values import Double

if TYPE_CHECKING:
    from fhash_codec.volume import Volume

Vector = tuple[float, float, float]

TOLERANCE = 1e-3
"""Largest distance of even coordinates from evenly spaced ones, as a share of the extent."""
MAX_POSITION = 1e100
"""Largest position that is drawn where it is; its reciprocal is the extent of the shortest axis."""
LEAST_FINER = 2
"""Drawn vertices for each vertex of an uneven axis, at least: half a vertex apart, values between
two vertices of the series stay nearly linear."""
MOST_FINER = 16
"""Drawn vertices for each vertex of an uneven axis, at most."""
MOST_ALONG = 512
"""Drawn vertices of an uneven axis above which it is only LEAST_FINER times finer: pictures of
usual size show no more."""
MAX_DRAWN = 2**25
"""Drawn vertices of a frame above which uneven axes are drawn less finely, 128 MiB of float32."""
DOWNWARD_NAMES = frozenset(
    {
        "air_pressure",
        "atmosphere_hybrid_sigma_pressure_coordinate",
        "atmosphere_ln_pressure_coordinate",
        "atmosphere_sigma_coordinate",
        "depth",
        "depth_below_geoid",
        "depth_below_sea_surface",
        "sea_water_pressure",
    }
)
"""Standard names of CF whose values ascend downwards; an attribute `positive` goes before them."""
PRESSURES = frozenset(
    {"pa", "hpa", "kpa", "mb", "mbar", "millibar", "millibars", "bar", "dbar", "decibar", "atm"}
)
"""Units of pressure in lower case: CF takes an axis in such units for a vertical one."""


NORTH = re.compile(r"degrees?_?(?:n|north)|degrees?_?(?P<east>e|east)", re.IGNORECASE)
"""Units of latitudes and of longitudes (CF 1.11, sections 4.1 and 4.2)."""
MAX_DEGREES = 1e4
"""Degrees above which a latitude or longitude is a missing one."""
THICK = 0.25
"""Length of an axis in other units than the rest have, as a share of the longest one, at least."""
THIN = 1 / 16
"""Share of both other axes below which one is thin: the volume is seen along it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Warp:
    """Vertices of an even drawn grid among the vertices of a series.

    Attributes:
        counts: vertices of the series along x, y, z.
        places: for x, y and z the place (n,) of each drawn vertex in vertices of the series,
            ascending from 0 to the last one; None for an axis that is drawn as it is.
    """

    counts: tuple[int, int, int]
    places: tuple[Double | None, Double | None, Double | None]

    def to_series(self, axis: int, drawn: npt.ArrayLike) -> Double:
        """Places in drawn vertices along x, y or z (0, 1, 2) as places in the series' vertices."""
        places = self.places[axis]
        given = np.asarray(drawn, dtype=np.float64)
        return given if places is None else np.interp(given, np.arange(len(places)), places)


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """An axis of at least one vertex.

    Attributes:
        values: the positions (n,); 0, 1, 2 ... where those of the series are no line.
        even: whether the positions are evenly spaced.
        problem: reason why the positions of the series are not drawn, '' if they are.
    """

    values: Double
    even: bool
    problem: str = ""

    @classmethod
    def of(cls, coordinate: Coordinate) -> Axis:
        """The axis of a coordinate; longitudes that pass 360 degrees go on beyond it."""
        values = np.asarray(coordinate.values, dtype=np.float64)
        if len(values) == 1:
            ordinary = bool(abs(values[0]) <= MAX_POSITION)
            return cls(values=values if ordinary else np.zeros(1), even=True)
        # Products of a few lengths, and squares of distances, stay far from the ends of float64.
        # NaN is not ordinary, either.
        if not np.all(np.abs(values) <= MAX_POSITION):
            return cls._unplaced(len(values), "are no positions along a line")
        if str(coordinate.attributes.get("units", "")).lower().startswith("degree"):
            values = unwrapped(values)
        extent = float(values[-1] - values[0])
        if abs(extent) < 1 / MAX_POSITION:
            return cls._unplaced(len(values), "are no positions along a line")
        evenly = np.linspace(values[0], values[-1], len(values))
        if np.max(np.abs(values - evenly)) <= TOLERANCE * abs(extent):
            return cls(values=evenly, even=True)
        steps = np.diff(values)
        if not (np.all(steps > 0) or np.all(steps < 0)):
            return cls._unplaced(len(values), "neither ascend nor descend throughout")
        return cls(values=values, even=False)

    @classmethod
    def _unplaced(cls, count: int, problem: str) -> Axis:
        return cls(
            values=np.arange(count, dtype=np.float64),
            even=True,
            problem=f"{problem}; vertices are drawn one unit apart",
        )

    @property
    def spacing(self) -> float:
        """The mean distance from a vertex to the next, negative on descending axes; NaN for one."""
        if len(self.values) == 1:
            return math.nan
        return float(self.values[-1] - self.values[0]) / (len(self.values) - 1)

    @property
    def coarsest(self) -> float:
        """The largest distance of two neighbouring vertices as a multiple of the mean one."""
        if self.even:
            return 1.0
        return float(np.max(np.abs(np.diff(self.values))) / abs(self.spacing))

    def places(self, count: int) -> Double:
        """The places of `count` evenly drawn vertices, in vertices of the series."""
        ascending = self.values if self.spacing > 0 else -self.values
        evenly = np.linspace(ascending[0], ascending[-1], count)
        return np.interp(evenly, ascending, np.arange(len(ascending)))


def drawn_counts(axes: Sequence[Axis]) -> list[int]:
    """Choose how many vertices each axis is drawn with.

    An even axis keeps its own. An uneven one takes its smallest distance throughout, within
    LEAST_FINER, MOST_FINER and MOST_ALONG and, with all the others, MAX_DRAWN.
    """
    counts = [len(axis.values) for axis in axes]
    finer = np.ones(len(axes))
    for number, axis in enumerate(axes):
        if not axis.even:
            smallest = float(np.min(np.abs(np.diff(axis.values))))
            with np.errstate(over="ignore"):
                wanted = abs(axis.spacing) / np.float64(smallest)
            most = min(MOST_FINER, MOST_ALONG / counts[number])
            finer[number] = max(min(wanted, most), LEAST_FINER)
    excess = math.prod(counts) * float(np.prod(finer)) / MAX_DRAWN
    while excess > 1 and np.any(finer > 1):
        share = excess ** (1 / np.count_nonzero(finer > 1))
        finer = np.maximum(finer / share, 1.0)
        excess = math.prod(counts) * float(np.prod(finer)) / MAX_DRAWN
        if share < 1 + 1e-9:
            break
    return [
        count if axis.even else math.ceil((count - 1) * factor - 1e-9) + 1
        for axis, count, factor in zip(axes, counts, finer, strict=True)
    ]


def downward(coordinate: Coordinate) -> bool:
    """Whether the values of a coordinate ascend downwards, as depths and pressures do.

    CF 1.11, section 4.3: the attribute `positive`, else a standard name or units of pressure.
    """
    attributes = coordinate.attributes
    positive = str(attributes.get("positive", "")).strip().lower()
    if positive in ("up", "down"):
        return positive == "down"
    return (
        str(attributes.get("standard_name", "")).strip().lower() in DOWNWARD_NAMES
        or str(attributes.get("units", "")).strip().lower() in PRESSURES
    )


def proportions(coords: Sequence[Coordinate], spacing: Double) -> Double:
    """Factors (3,) that draw vertices of axes in uncommon units as far apart as the others.

    Such an axis has at least THICK of the length of the longest other one. Axes in the commonest
    units keep their lengths. Where an axis has no units, all do.

    Args:
        coords: of x, y, z.
        spacing: between vertices, at least 0; NaN for an axis of one vertex, which does not count.
    """
    units = [_plain_units(coordinate) for coordinate in coords]
    extended = np.isfinite(spacing)
    extended_units = [unit for unit, counts in zip(units, extended, strict=True) if counts]
    factors = np.ones(3)
    if len(set(extended_units)) < 2 or "" in extended_units:
        return factors
    usual = max(extended_units, key=extended_units.count)
    is_usual = np.array([unit == usual for unit in units])
    across = float(np.mean(spacing[extended & is_usual]))
    other = extended & ~is_usual
    counts = np.array([len(coordinate.values) for coordinate in coords])
    longest = float(np.max((spacing * (counts - 1))[extended & is_usual]))
    factors[other] = np.maximum(across, THICK * longest / (counts[other] - 1)) / spacing[other]
    return factors


def northward(coords: Mapping[str, Coordinate], volume: Volume) -> dict[str, Coordinate]:
    """Coordinates by axis for a curvilinear grid that is drawn with the north up and east right.

    Along y or x without positions, vertices lie downwards or leftwards where two-dimensional
    latitudes or longitudes descend.
    """
    found = dict(coords)
    bare = [axis for axis in "yx" if len(coords[axis].values) > 1 and not coords[axis].attributes]
    metadata = volume.metadata if bare else None
    for each in () if metadata is None else metadata.variables:
        match = NORTH.fullmatch(str(each.attributes.get("units", "")))
        axis = "x" if match is not None and match["east"] else "y"
        axes = [metadata.dimensions.get(name) for name in each.dimensions] if metadata else []
        numeric = each.values.dtype.kind in "iuf"
        if match is None or axis not in bare or sorted(map(str, axes)) != ["x", "y"] or not numeric:
            continue
        values = np.where(each.values < MAX_DEGREES, each.values, np.nan).astype(np.float64)
        steps = [np.diff(values, axis=axes.index(name)) for name in (axis, "xy".strip(axis))]
        if not all(np.isfinite(step).any() for step in steps):
            continue
        # half of all steps, so that a seam does not count
        own, across = map(np.nanmedian, steps)
        if own < 0 and -own > abs(across):
            found[axis] = replace(coords[axis], attributes={"positive": "down"})
    return found


def _plain_units(coordinate: Coordinate) -> str:
    """The units of a coordinate; degrees north, east and of a rotated pole are the same units."""
    units = str(coordinate.attributes.get("units", "")).strip()
    return "degrees" if units.lower().startswith("degree") else units


def unwrapped(degrees: Double) -> Double:
    """Longitudes without their jump by 360 degrees; others as they are."""
    steps = np.abs(np.diff(degrees))
    return np.unwrap(degrees, period=360.0) if np.any(np.abs(steps - 360) < 180) else degrees


MAX_AXES_RATIO = 1e14
"""Largest ratio of the longest axis to the shortest vertex spacing.

The eye is a few times as far away as the axis is long, and there float64 tells apart 0.1 spacings.
"""
LINE = 1 / 32
"""Thickness of a line of vertices, as a share of its length, at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """The even grid of vertices that is drawn.

    An axis of one vertex has the mean spacing of the others and reaches half of it to both sides.
    A line of vertices is at least LINE of its length thick.

    Attributes:
        counts: drawn vertices along x, y, z.
        origin: physical position (x, y, z) of the first vertex, stretched by `scale`.
        spacing: between two vertices (x, y, z), stretched; negative where coordinates descend.
        scale: factors by which the axes (x, y, z) are stretched, negative for depths.
        warp: where the drawn vertices lie among those of the series; None where they are the same.
        coarseness: largest distance of two vertices of the series, in drawn vertices, x, y, z.
    """

    counts: tuple[int, int, int]
    origin: Double
    spacing: Double
    scale: Vector = (1.0, 1.0, 1.0)
    warp: Warp | None = None
    coarseness: Vector = (1.0, 1.0, 1.0)

    @classmethod
    def of_volume(cls, volume: Volume, scale: Vector | None = None) -> Grid:
        """The grid of a volume, `of` its coordinates; north is up on a curvilinear grid."""
        return cls.of(northward(volume.coords, volume), scale)

    @classmethod
    def of(cls, coords: Mapping[str, Coordinate], scale: Vector | None = None) -> Grid:
        """Make the grid of a volume's coordinates.

        Uneven coordinates are drawn where they lie, on a finer grid. Values that ascend downwards,
        such as depths, are drawn downwards. Coordinates that are no positions are spread evenly,
        with an FhashWarning.

        Args:
            coords: by axis.
            scale: factors by which the axes are stretched. If None, axes have the lengths of their
                coordinates, except an axis in other units than most have, see `proportions`.

        Raises InputError where axes have lengths too different to place rays.
        """
        axes = [Axis.of(coords[axis]) for axis in "xyz"]
        for name, axis in zip("xyz", axes, strict=True):
            if axis.problem:
                warnings.warn(
                    f"the coordinates {coords[name].name!r} of {name} {axis.problem}",
                    FhashWarning,
                    stacklevel=2,
                )
        mean = np.array([axis.spacing for axis in axes])
        factors = (
            proportions([coords[axis] for axis in "xyz"], np.abs(mean))
            if scale is None
            else np.array(scale, dtype=np.float64)
        )
        single = np.isnan(mean)
        mean[single] = _thickness(np.abs(mean * factors), axes) / factors[single]
        factors = np.where([downward(coords[axis]) for axis in "xyz"], -factors, factors)
        series_counts = [len(axis.values) for axis in axes]
        counts = drawn_counts(axes)
        finer = np.array(_finer(counts, series_counts))
        spacing = mean * factors / finer
        _check_lengths(spacing, counts)
        uneven = not all(axis.even for axis in axes)
        places = [
            None if axis.even else axis.places(n) for axis, n in zip(axes, counts, strict=True)
        ]
        return cls(
            counts=(counts[0], counts[1], counts[2]),
            origin=np.array([axis.values[0] for axis in axes]) * factors,
            spacing=spacing,
            scale=vector(factors),
            warp=Warp(
                counts=(series_counts[0], series_counts[1], series_counts[2]),
                places=(places[0], places[1], places[2]),
            )
            if uneven
            else None,
            coarseness=vector(finer * [axis.coarsest for axis in axes]),
        )

    @property
    def flat(self) -> bool:
        """Whether an axis has one vertex, so that a plane, a line or a point is drawn."""
        return 1 in self.counts

    @property
    def thin(self) -> int | None:
        """The axis (0, 1 or 2) along which the volume is seen: of one vertex, or a thin one."""
        lengths = np.abs(np.diff(self.corners, axis=1)[:, 0])
        for axis in (2, 1, 0):
            others = np.delete(lengths, axis)
            if self.counts[axis] == 1 or lengths[axis] < THIN * others.min():
                return axis
        return None

    @property
    def thinnest(self) -> tuple[int, float]:
        """Vertices of the axis with the fewest, and its length in mean vertex spacings."""
        count = min(self.series_counts)
        lengths = np.abs(self.spacing) * np.diff(self.bounds, axis=1)[:, 0] / self.series_spacing
        axes = [axis for axis in range(3) if self.series_counts[axis] == count]
        return count, float(min(lengths[axes]))

    @property
    def series_counts(self) -> tuple[int, int, int]:
        """Vertices of the series along x, y, z."""
        return self.counts if self.warp is None else self.warp.counts

    @property
    def series_spacing(self) -> float:
        """The mean distance between vertices of the series: the geometric mean over the axes."""
        finer = _finer(self.counts, self.series_counts)
        return float(np.exp(np.mean(np.log(np.abs(self.spacing) * finer))))

    @property
    def vertex_spacing(self) -> float:
        """The distance between vertices as one length: the geometric mean over the axes."""
        return float(np.exp(np.mean(np.log(np.abs(self.spacing)))))

    @property
    def bounds(self) -> Double:
        """The box that is drawn in index space: float64 (3, 2), x, y, z."""
        return np.array(
            [[-0.5, 0.5] if count == 1 else [0.0, count - 1.0] for count in self.counts]
        )

    @property
    def corners(self) -> Double:
        """The drawn box in physical coordinates (3, 2); descending on descending axes."""
        return self.origin[:, None] + self.bounds * self.spacing[:, None]


def vector(numbers: npt.ArrayLike) -> Vector:
    """Three numbers of an array."""
    x, y, z = (float(number) for number in np.asarray(numbers))
    return x, y, z


def _finer(counts: Sequence[int], series_counts: Sequence[int]) -> list[float]:
    """Factors by which the drawn vertices of each axis are finer than those of the series."""
    return [
        max(count - 1, 1) / max(own - 1, 1)
        for count, own in zip(counts, series_counts, strict=True)
    ]


def _thickness(spacing: Double, axes: Sequence[Axis]) -> float:
    """The thickness of axes of one vertex; spacing: mean ones (3,), stretched, NaN for one vertex.

    It is the mean spacing of the other axes, 1 without any.
    """
    extended = ~np.isnan(spacing)
    if not extended.any():
        return 1.0
    thickness = float(np.mean(spacing[extended]))
    if np.count_nonzero(extended) == 1:
        longest = max(len(axis.values) for axis in axes)
        thickness = max(thickness, LINE * thickness * (longest - 1))
    return thickness


def _check_lengths(spacing: Double, counts: Sequence[int]) -> None:
    """Raise InputError where one axis is too long for the vertex spacing of another."""
    longest = float(np.max(np.abs(spacing) * counts))
    shortest = float(np.min(np.abs(spacing)))
    if longest > MAX_AXES_RATIO * shortest:
        raise InputError(
            f"the longest axis of the volume is {longest:.3g}, and vertices of the shortest are "
            f"{shortest:.3g} apart: no ray can be placed that finely, at most "
            f"{MAX_AXES_RATIO:.0e} times; stretch the axes with 'scale'"
        )
