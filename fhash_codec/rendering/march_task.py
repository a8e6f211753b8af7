"""The task of a marcher and its result: frame, units and arrays. All marchers take one task."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid, Warp
from fhash_codec.rendering.transfer_function import about
from fhash_codec.rendering.view import Body
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.values import Double, Single

Array = Any
"""An array of numpy or a tensor of torch."""


class Arrays:
    """The operations of numpy on the host.

    Attributes:
        xp: the library.
        device: the device of torch that holds tensors; None for arrays of numpy.
        batch: elements to work on at a time, so few that they stay in a processor's cache.
        leaps: leaps over invisible bricks after which the rays that arrived are left out.
        turns: turns of a search for roots after which those that are found are left out.
    """

    xp: Any = np
    device: Any = None
    batch = 1 << 15
    leaps = 1
    turns = 1

    def array(self, values: npt.ArrayLike, dtype: str | None = None) -> Array:
        """An array of numbers from the host, of their own type or of another, as 'float64'."""
        return np.asarray(values, dtype=dtype)

    def host(self, array: Array) -> npt.NDArray[Any]:
        """An array on the host with the numbers of an array of this library."""
        return np.asarray(array)

    def empty(self, shape: Sequence[int], dtype: str = "float64") -> Array:
        """An uninitialised array."""
        return np.empty(shape, dtype=dtype)

    def full(self, shape: Sequence[int] | int, value: float, dtype: str = "float64") -> Array:
        """An array of one number."""
        return np.full(shape, value, dtype=dtype)

    def range(self, count: int) -> Array:
        """The integers 0 .. count - 1, int64."""
        return np.arange(count)

    def to_int64(self, array: Array) -> Array:
        """Round an array towards 0 to int64."""
        return array.astype(np.int64)

    def to_float64(self, array: Array) -> Array:
        """Convert an array to float64."""
        return array.astype(np.float64)

    def to_float32(self, array: Array) -> Array:
        """Round an array to float32."""
        return array.astype(np.float32)

    def copy(self, array: Array) -> Array:
        """Copy an array."""
        return array.copy()

    def nonzero(self, array: Array) -> tuple[Array, ...]:
        """Indices of the elements that are not 0, one array for each axis, in C order."""
        return array.nonzero()  # type: ignore[no-any-return]

    def candidates(self, mask: Array) -> Array:
        """An index of elements (n,) with those of a mask (n,) among them; on the host no others."""
        return mask.nonzero()[0]

    def kept(self, mask: Array, results: Array, other: Array | float) -> Array:
        """Results (m, ...) for the candidates of a mask, and `other` for those not in the mask.

        mask: the mask at the candidates (m,).
        """
        return results

    def counts(self, *numbers: Array) -> list[int]:
        """Integers of no axis as numbers of Python, for one wait."""
        return [int(number) for number in numbers]

    def chosen(self, mask: Array, count: int) -> Array:
        """Indices (count,) of the elements of a mask (n,), whose number is known, ascending."""
        return mask.nonzero()[0]

    def take_along(self, array: Array, index: Array, axis: int) -> Array:
        """Pick the elements that `index` names from each line along an axis."""
        return np.take_along_axis(array, index, axis=axis)

    def add_rows(self, array: Array, rows: Array, values: Array) -> None:
        """Add values (m, k) to rows (m,) of an array (n, k), in order where a row is repeated."""
        width = array.shape[1]
        # Along one axis numpy is several times faster.
        np.add.at(
            array.reshape(-1),
            (rows[:, None] * width + np.arange(width)).reshape(-1),
            values.reshape(-1),
        )

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """A context that raises InputError where the memory of a device is not enough."""
        yield


NUMPY = Arrays()
"""The arrays of the host."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A transfer function at n values; beyond the ends the colour and extinction of the ends hold.

    Attributes:
        low, high: values of the first and the last entry; the others lie evenly between them.
        colours: float32 (n, 3), 0..1.
        extinctions: float64 (n,), per unit of the coordinates.
    """

    low: float
    high: float
    colours: Single
    extinctions: Double


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """Phong's model, two-sided.

    Attributes:
        ambient, diffuse, specular: strengths of the three kinds of light.
        specular_power: exponent of the highlights.
        lamp: unit vector (x, y, z) of the coordinates towards the light; None for a light at the
            camera, along each ray.
        central: whether the gradient is that of central differences, over one vertex of the frame
            to both sides, and not that of the cell.
    """

    ambient: float
    diffuse: float
    specular: float
    specular_power: float
    lamp: Double | None
    central: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """An isosurface: value in marched units, colour (3,), 0..1, and opacity 0..1."""

    value: float
    colour: Double
    opacity: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Grading:
    """Factors of the extinction by the size of the gradient; beyond the last one it holds.

    Attributes:
        factors: float64 (GRADES + 1,), 0..1, at even gradients from 0 on, linear between them.
        top: gradient of the last one, above 0, in marched units per unit of the coordinates.
    """

    factors: Double
    top: float


MAX_VALUES = 2**31 - 1
"""Values of a frame, at most: the native marcher's indices have 32 bits."""
GRADES = 1024
"""Intervals of the factors of a grading: FHASH_GRADES."""
DENSEST = 1e30
"""Largest extinction per length: its smallest part is opaque already."""


def extinctions_in(extinctions: Double, length: float) -> Double:
    """Extinctions per `length` from those per unit of the coordinates, DENSEST at most.

    Infinite extinctions would give NaN between the entries of a table.
    """
    with np.errstate(over="ignore"):
        return np.minimum(extinctions * length, DENSEST)


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkValues:
    """A network that is evaluated at the marcher's samples.

    Attributes:
        fields: of the marcher, that name the network's function and what it takes.
        low, high: values of the network's 0 and 1.
        mask: float32 (z, y, x), NaN at vertices of the network's box that have no value.
        whole: whether there is none.
        held: what the fields point to.
        bounds: the box (3, 2), x, y, z, in drawn vertices, in which it has values, where its axes
            are uneven.
        device: the network on a device; None for the processor.
    """

    fields: Mapping[str, Any]
    low: float
    high: float
    mask: Single
    whole: bool
    held: Any = None
    bounds: Double | None = None
    device: Any = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """The values of one time step in a region.

    Attributes:
        values: float32 (z, y, x), NaN where there is none.
        first: vertex (z, y, x) of the domain at which the first value lies.
        stride: vertices of the domain from one value to the next (level of detail).
        network: has the values, also between vertices, for the native marcher; then `values` are
            any numbers where there is one.
    """

    values: Single
    first: tuple[int, int, int]
    stride: int = 1
    network: NetworkValues | None = None

    def bounds(self, grid: Grid) -> Double:
        """The box (3, 2), x, y, z, in vertices of the domain, in which the frame has values.

        It reaches to the end of the domain where no further vertex of the frame would fit.
        """
        first, counts = (
            np.array(self.first[::-1], dtype=np.float64),
            np.array(self.values.shape[::-1]),
        )
        ends = first + counts * self.stride
        if self.network is not None and self.network.bounds is not None:
            return self.network.bounds
        low = np.where(first == 0, grid.bounds[:, 0], first)
        high = np.where(ends > np.array(grid.counts) - 1, grid.bounds[:, 1], ends - self.stride)
        return np.stack([low, high], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightGrid:
    """Shares of the light that reach the points of a grid; trilinear between them, clamped beyond.

    Attributes:
        shares: float32 (z, y, x, 2), 0..1, of the light from the lamp and of that from around.
        first: vertex (x, y, z) of the domain at which the first point lies.
        cell: vertices of the domain from one point to the next.
        secondary_rays: number of rays that the grid took.
    """

    shares: Single
    first: Double
    cell: float
    secondary_rays: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """Everything that decides a picture of a given frame or model.

    Attributes:
        rays: the rays of the pixels, in vertices of the domain.
        step: length from one sample to the next, in units of the coordinates.
        threshold: a ray ends where less than this share of the light behind comes through.
        table: transfer function; None where no volume is drawn, for surfaces alone.
        lighting: lighting of the surfaces, and of the volume if `shaded`.
        shaded: whether the volume is lit.
        light: shares of the light that shadows and surroundings leave.
        surfaces: isosurfaces.
        projection: 'maximum', 'minimum', 'average' or 'attenuated' to draw that value along each
            ray, opaque in the colour of the table, instead of the volume; '' for the volume.
        attenuation: of the attenuated maximum, per unit of the coordinates.
        grading: opacity by gradient, that of `lighting`, or of the cell without one.
        body: the part of the drawn box that is marched; all of it if None.
        depth, normal: whether to fill these buffers.
        antialiasing: rays along a pixel's side.
        jitter: whether the first sample of each ray is shifted by a share of the ray's own.
        skipping: whether rays leap over invisible bricks.
        noise: difference of two neighbouring vertices, in marched units, below which shading fades.
        error: largest error of a value, in marched units: smoothed values stay within it.
    """

    rays: Rays
    step: float
    threshold: float
    table: Table | None
    lighting: Lighting | None = None
    shaded: bool = False
    light: LightGrid | None = None
    surfaces: tuple[Surface, ...] = ()
    projection: str = ""
    attenuation: float = 0.0
    grading: Grading | None = None
    body: Body | None = None
    depth: bool = False
    normal: bool = False
    antialiasing: int = 1
    jitter: bool = False
    skipping: bool = True
    noise: float = 0.0
    error: float = math.inf

    @property
    def bounds(self) -> Double:
        """The box (3, 2), x, y, z, in vertices, that is drawn and in which steps are counted."""
        return self.rays.grid.bounds if self.body is None else self.body.bounds

    @property
    def planes(self) -> Double:
        """The planes (n, 4) that cut the box, as `Body` has them."""
        return np.empty((0, 4)) if self.body is None else self.body.planes

    @property
    def visibility(self) -> tuple[object, ...]:
        """All that decides which values can be seen, as a key: table and values of surfaces."""
        surfaces = tuple(surface.value for surface in self.surfaces)
        if self.table is None:
            return surfaces
        return self.table.low, self.table.high, self.table.extinctions.tobytes(), *surfaces

    @property
    def marched(self) -> Task:
        """The task with the table that samples take: that of the projection, if there is one.

        A value counts for a projection where it has an extinction: any value for the maximum, the
        minimum and the mean. For the attenuated maximum the extinction grows with the value.
        """
        if not self.projection or self.table is None:
            return self
        shape = self.table.extinctions.shape
        extinctions = (
            np.linspace(0.0, self.attenuation, *shape)
            if self.projection == "attenuated"
            else np.full(shape, 1 / self.step)
        )
        return replace(self, table=replace(self.table, extinctions=extinctions))


@dataclass(frozen=True, kw_only=True, eq=False)
class Marched:
    """A finished picture.

    Attributes:
        rgba: float32 (H, W, 4), the colour multiplied by the opacity.
        depth: float32 (H, W), as `Image` has it, or None.
        normal: float32 (H, W, 3), as `Image` has it, or None.
        counters: amounts of work by the names of COUNTERS (below).
    """

    rgba: Single
    depth: Single | None = None
    normal: Single | None = None
    counters: Mapping[str, int] = field(default_factory=dict)


COUNTERS: Mapping[str, str] = MappingProxyType(
    {
        "rays": "that meet the volume",
        "passes": "of samples; for packets, those of each packet",
        "samples": "values looked up along rays",
        "evaluations": "of the network itself",
        "gradients": "at lit samples and surfaces",
        "secondary_rays": "towards light and surroundings",
        "skipped_bricks": "places where rays leapt over what cannot be seen",
        "decoded_vertices": "of the decoded frame, kept ones included",
    }
)
"""Names of the counters and what they count."""


def complete(*parts: Mapping[str, int]) -> dict[str, int]:
    """Sums of counters in the order of COUNTERS, 0 where none is given.

    Raises KeyError for a name that is not among COUNTERS.
    """
    total = dict.fromkeys(COUNTERS, 0)
    for part in parts:
        for name, count in part.items():
            total[name] += int(count)
    return total


def rows(counters: Mapping[str, int]) -> list[tuple[str, str, str]]:
    """Rows (name, count, what it counts) for people to read."""
    return [
        (name.replace("_", " "), f"{counters.get(name, 0):,}", text)
        for name, text in COUNTERS.items()
    ]


LARGE_OFFSET = 2.0**9
"""Largest magnitude of float32 values that are marched as they are, in halves of the value range.
The range then has 15 bits of the significand left.
"""


@dataclass(frozen=True, kw_only=True)
class Units:
    """Marched values, (value - shift) * factor.

    They let float32 hold data whose range is small beside their offset.
    """

    shift: float = 0.0
    factor: float = 1.0

    @classmethod
    def of(cls, volume: Volume) -> Units:
        """The units of a volume: the middle of its value range, and a power of two near its size.

        float32 values are marched as they are, unless they are so much larger than their range that
        the values between them would be coarse.

        Raises InputError for 64-bit integers that float64, of which pictures are, has all in one.
        """
        low, high = volume.value_range.low, volume.value_range.high
        if isinstance(low, int) and low < high and high - low < 2 * math.ulp(max(-low, high)):
            raise InputError(
                f"pictures are of float64, which cannot tell values from {low} to {high} apart;"
                " encode their differences from one of them to draw them"
            )
        if low == high:
            low, high = about(low)
        extent = high / 2 - low / 2
        if volume.float_dtype == np.float32 and max(abs(low), abs(high)) <= LARGE_OFFSET * extent:
            return cls()
        exponent = math.frexp(extent)[1]
        return cls(
            shift=low / 2 + high / 2, factor=math.ldexp(1.0, -max(-1000, min(1000, exponent)))
        )

    def to(self, values: npt.ArrayLike) -> Double:
        """Convert data units to marched units, float64."""
        return np.asarray(
            (np.asarray(values, dtype=np.float64) - self.shift) * self.factor, dtype=np.float64
        )

    def single(self, values: npt.NDArray[Any]) -> Single:
        """Convert data units to marched units, float32 and contiguous."""
        converted = values if self == Units() else self.to(values)
        return np.ascontiguousarray(converted, dtype=np.float32)


def warped(frame: Frame, warp: Warp | None) -> Frame:
    """Resample a frame of the series to the vertices that are drawn, linearly along each axis.

    The result has every `stride`-th drawn vertex between the first and the last value of the frame.
    A drawn vertex has no value where a vertex of weight beside it has none. Without a warp the
    frame itself is returned.
    """
    if warp is None:
        return frame
    lattice = [
        range(first, first + count * frame.stride, frame.stride)
        for first, count in zip(frame.first, frame.values.shape, strict=True)
    ]
    drawn, places = zip(*drawn_places(lattice, frame.stride, warp), strict=True)
    z, y, x = (along.start for along in drawn)
    return replace(frame, values=resampled(frame.values, places, warp), first=(z, y, x))


def drawn_places(
    lattice: Sequence[range], stride: int, warp: Warp | None
) -> Iterator[tuple[range, Double]]:
    """The drawn vertices along z, y and x, and their places in numbers of the lattice's vertices.

    At least one is drawn, and every `stride`-th of those that the lattice reaches. It reaches to
    the end of the domain where no further vertex of it would fit.

    lattice: vertices of the series.
    """
    for own, number in zip(lattice, (2, 1, 0), strict=True):
        places = None if warp is None else warp.places[number]
        if warp is None or places is None:
            yield own, np.arange(len(own), dtype=np.float64)
            continue
        low, last = own.start, warp.counts[number] - 1
        high = last if own.stop > last else own[-1]
        begin = min(int(np.searchsorted(places, low - 1e-9, side="left")), len(places) - 1)
        stop = int(np.searchsorted(places, high + 1e-9, side="right"))
        drawn = range(begin, max(stop, begin + 1), stride)
        at = (places[drawn.start : drawn.stop : stride] - low) / stride
        yield drawn, np.clip(at, 0, len(own) - 1)


def resampled(values: Single, places: Sequence[Double], warp: Warp | None) -> Single:
    """Values at places along z, y and x, in vertices of the values, where the axis is uneven."""
    for axis, at in enumerate(places):
        if warp is not None and warp.places[2 - axis] is not None:
            values = _resampled(values, at, axis)
    return np.ascontiguousarray(values)


def _resampled(values: Single, at: npt.NDArray[np.float64], axis: int) -> Single:
    """Values at places along an axis, in vertices of the frame."""
    before = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
    after = np.minimum(before + 1, values.shape[axis] - 1)
    shape = [1, 1, 1]
    shape[axis] = len(at)
    share = (at - before).astype(np.float32).reshape(shape)
    low = np.take(values, before, axis=axis)
    mixed: Single = np.take(values, after, axis=axis)
    # A missing vertex of no weight does not matter.
    with np.errstate(invalid="ignore", over="ignore"):
        mixed -= low
        mixed *= share
        mixed += low
    if np.isnan(mixed).any():
        np.copyto(mixed, low, where=share == 0)
        np.copyto(mixed, np.take(values, after, axis=axis), where=share == 1)
    return mixed
