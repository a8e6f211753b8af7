"""Shapes of tiles, the price of access to regions, and attempts at a plan."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Any

from fhash_codec.compact.goal import Goal
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Blocks, Coding, Outcome
from fhash_codec.compact.transform import Magnitudes
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Parts, skip
from fhash_formats.container.reader import CACHE_BYTES
from fhash_formats.errors import InputError
from fhash_formats.transform.stream import MAX_TILE_VERTICES
from fhash_formats.transform.tile import DENSITIES
from fhash_formats.transform.tile_format import Shape, TileSettings

TILE_VERTICES = 1 << 19
"""Vertices of the tiles for a first look, at most."""
MAX_VERTICES = 4 << 20
"""Vertices of a tile at most, unless it is asked for or is the whole series.

Several tiles are in memory at a time, each of them several times over.
"""
FIRST_STEPS = 8
"""Time steps of the tiles for a first look."""
MIN_LENGTH = 24
"""Vertices along a space axis below which the axis is not cut further."""
PRICE_OF_PADDING = 3.0
"""Price of vertices beyond the border, per share of all vertices."""
PRICE_OF_MORE = 0.3
"""Price of more tiles than asked for, per factor of e."""
PRICE_OF_FEWER = 0.05
"""Price of fewer tiles than asked for, per factor of e."""
PRICE_OF_SHORT = 0.1
"""Price of each space axis that is cut into parts shorter than MIN_LENGTH."""


def parse_tile(text: str, shape: Shape) -> Shape | None:
    """Return the shape that a setting names, cut to the series; None for 'auto'.

    Raises InputError for another text and for a tile that is too large to decode.
    """
    if text == "auto":
        return None
    if text == "whole":
        return _check_size(text, shape)
    try:
        numbers = [int(number) for number in text.split("x")]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or min(numbers) < 1:
        raise InputError(
            f"tile is '{text}'; allowed: auto, whole, or four whole numbers as in 4x32x32x32"
            " (t, z, y, x)"
        )
    t, z, y, x = (min(n, length) for n, length in zip(numbers, shape, strict=True))
    return _check_size(text, (t, z, y, x))


def _check_size(text: str, tile: Shape) -> Shape:
    if prod(tile) > MAX_TILE_VERTICES:
        raise InputError(
            f"tile '{text}' has {prod(tile):,} vertices; at most {MAX_TILE_VERTICES:,} are decoded"
            " together; name another"
        )
    return tile


def even_tile(shape: Shape, tiles: int, steps: int) -> Shape:
    """Return a tile of about `steps` steps, so that about `tiles` tiles make up a shape.

    Space is cut along its longest axis. The number of parts along each axis may then change by
    one, so that few vertices lie beyond the border, since those have to be coded, too.
    """
    parts_asked = [-(-shape[0] // steps), 1, 1, 1]
    while prod(parts_asked) < tiles:
        lengths = [-(-n // p) for n, p in zip(shape, parts_asked, strict=True)]
        axis = max((1, 2, 3), key=lambda a: (lengths[a], a))
        if lengths[axis] < MIN_LENGTH:
            break
        parts_asked[axis] += 1
    lowest_price, best_tile = math.inf, shape
    for change in product((0, -1, 1), repeat=4):
        parts = [min(max(p + c, 1), n) for p, c, n in zip(parts_asked, change, shape, strict=True)]
        tile = _tile_of(shape, parts)
        price = _price(shape, tile, parts, prod(parts_asked), steps)
        if price < lowest_price - 1e-9:
            lowest_price, best_tile = price, tile
    return best_tile


def _tile_of(shape: Shape, parts: list[int]) -> Shape:
    """Return the tile that cuts each axis into a number of parts."""
    t, *space = (-(-n // p) for n, p in zip(shape, parts, strict=True))
    # Even lengths keep the vertices of the first coarse level on one lattice.
    z, y, x = (n if p == 1 else n + n % 2 for n, p in zip(space, parts[1:], strict=True))
    return t, z, y, x


def _price(shape: Shape, tile: Shape, parts: list[int], tiles: int, steps: int) -> float:
    """Return the price of a tile where `tiles` tiles of `steps` steps are asked for.

    Infinite for tiles that are too long, too large, or too many or too few.
    """
    count = prod(-(-n // length) for n, length in zip(shape, tile, strict=True))
    more = math.log(count / tiles)
    if (
        tile[0] > max(steps * 1.5, 1)
        or not 0.4 <= count / tiles <= 1.5
        or (more < 0 and prod(tile) > MAX_VERTICES)
    ):
        return math.inf
    padding = count * prod(tile) / prod(shape) - 1
    short = sum(
        p > 1 and length < MIN_LENGTH for p, length in zip(parts[1:], tile[1:], strict=True)
    )
    return (
        PRICE_OF_PADDING * padding
        + PRICE_OF_SHORT * short
        + (PRICE_OF_MORE * more if more > 0 else -PRICE_OF_FEWER * more)
    )


def first_tile(shape: Shape, vertices: int = TILE_VERTICES) -> Shape:
    """Return a tile of about so many vertices, by the shape alone: many steps of small frames."""
    steps = max(FIRST_STEPS, vertices // prod(shape[1:]))
    return even_tile(shape, max(1, prod(shape) // vertices), min(shape[0], steps))


def quick_tile(shape: Shape, access: str) -> Shape:
    """Return the tile of a series that nothing is tried for.

    A region takes the time that the access allows, by the fast coder and a bit for each vertex.
    """
    most = REGION_MS[access] * 1e6 / decoding_ns(1, "fast")
    return first_tile(shape, round(min(most, MAX_VERTICES)))


MAX_WHOLE_VERTICES = 12 << 20
"""Vertices of a series up to which it may be one tile: a larger one takes long to decode."""

PRICES = {"fast": 1.5, "balanced": 1.1, "small": 1.0}
"""Bytes that tiles may take, as a multiple of those of the best tiling, by the wish for access."""
WORTH = {"fast": 1.0, "balanced": 0.01, "small": 0.0}
"""Share of the bytes that half the work for a region is worth, by the wish for access."""
REGION_MS = {"fast": 3.0, "balanced": 30.0, "small": math.inf}
"""Milliseconds that the decoding of a region may take, in the mean, by the wish for access."""
NS_PER_BYTE = {"fast": 0.0, "balanced": 10.0, "small": math.inf}
"""Nanoseconds that the decoding of a whole series may take for each byte of its values, with the
mixing coder: those of 100 MB/s. Who wishes for fast access never has that coder."""
FAST_BYTES = {"fast": 1.6, "balanced": 1.08, "small": 0.0}
"""Bytes that the fast coder may take, as a multiple of those of the other one."""
LATE = 1.0
"""Share of the bytes that half the work for a region is worth where it takes longer than that."""
DECODING_NS = {"mixing": (25.0, 110.0), "fast": (10.0, 10.0), "labels": (10.0, 65.0)}
"""Nanoseconds to decode a vertex, and more for each of its bits, by the coder.

These are counts of work rather than times, so that every machine makes the same choice: of one core
of an EPYC of 2021.
"""
TRANSFORM_NS = 8.0
"""The same of all else."""
REGION = 16
"""Vertices of a region along each axis in space; it is of one step."""
FAST_ENOUGH = 1 << 17
"""Vertices that decode in a moment (2.4 ms by count), so that nothing smaller is worth any bytes.

Of half as many, tiles took up to 1.5 times the bytes, and decoded half as fast.
"""
LENGTHS = (1024, 512, 256, 128, 64, 32, 16, 8, 4, 2, 1)
"""Lengths in steps that tiles are tried at, approximately."""
EDGES = (256, 192, 128, 96, 64, 48, 32, 24, 16)
"""Edges in space in vertices that tiles are tried at, approximately."""
SHORTEST = 8
"""Vertices of a tile along the longest axis in space, at least, where it alone is cut."""
LONGEST_BASIS = 128
"""Vertices along an axis with a basis of the data's own, at most (native/planner.cpp)."""
TILE_BYTES = 100
"""Bytes that each further tile costs: its place in the file, and the beginning of its coder."""


@dataclass(frozen=True, kw_only=True)
class Tiling:
    """The chosen tiles, and what was tried."""

    tile: Shape
    price: float | None
    """Bytes as a multiple of those of the best tiling; foretold where none was tried, and None for
    tiles that were asked for."""
    tried: int = 0
    """Number of tilings that were priced; 0 where the price is foretold."""

    def describe(self) -> str:
        """Return how the tiling was chosen, and its price, as one line."""
        priced = f"priced {self.tried} tilings" if self.tried else "foretold"
        return f"{priced}: {self.price:.2f} times the bytes of the best one"


def region_vertices(shape: Shape, tile: Shape) -> float:
    """Return the vertices that a reader decodes for a region of one step, in the mean.

    shape: of the box over all steps. tile: of a tile.
    """
    mean = 1.0
    for axis, (length, n) in enumerate(zip(shape, tile, strict=True)):
        span = 1 if axis == 0 else min(REGION, length)
        mean *= n if n >= length else n + span - 1
    return mean


def decoding_ns(bits: float, coder: str) -> float:
    """Return the nanoseconds in which a vertex of so many bits is decoded, by count.

    coder: a name of `DECODING_NS`.
    """
    first, more = DECODING_NS[coder]
    return TRANSFORM_NS + first + more * bits


def burden(access: str, price: float, work: float, ns: float) -> float:
    """Return what tiles cost in bytes and in work for a region together, as a logarithm.

    access: the wish, a name of `WORTH`.
    price: bytes as a multiple of those of the best tiling.
    work: vertices that are decoded for a region.
    ns: nanoseconds to decode a vertex.
    """
    late = work * ns * 1e-6 / REGION_MS[access]
    return math.log(price) + WORTH[access] * math.log2(work) + LATE * math.log2(max(late, 1.0))


def tiles_to_try(shape: Shape, max_vertices: int, *, slabs: bool = False) -> list[Shape]:
    """Return tiles of at most some vertices, those of the fastest region first.

    Axes in space are cut into parts of about one edge, time into parts of about one length. Of the
    tiles whose regions take no more than FAST_ENOUGH vertices, only the one of the slowest is
    among them, and where its steps are too many for a basis the largest one that has one.

    slabs: whether there are also tiles with cuts across the longest axes in space alone: where all
        of space is too much, these have the fewest cuts.
    """
    lengths = {_even_length(shape[0], length, even=False) for length in (shape[0], *LENGTHS)}
    spaces = {
        (_even_length(z, edge), _even_length(y, edge), _even_length(x, edge))
        for z, y, x in [shape[1:]]
        for edge in (max(shape[1:]), *EDGES)
    }
    if slabs:
        spaces |= {slab for space in spaces for slab in _slabs(shape, space)}
    tiles: list[Shape] = [(t, *space) for t in lengths for space in spaces]
    if slabs:
        tiles += [tile for t in lengths for tile in _largest_slabs(shape, t, max_vertices)]
    tiles = [tile for tile in tiles if prod(tile) <= max_vertices]
    tiles = sorted(set(tiles), key=lambda tile: (region_vertices(shape, tile), tile))
    fast = max(sum(region_vertices(shape, tile) <= FAST_ENOUGH for tile in tiles) - 1, 0)
    of_basis = [tile for tile in tiles[:fast] if tile[0] <= LONGEST_BASIS < tiles[fast][0]]
    return sorted(of_basis, key=prod)[-1:] + tiles[fast:]


def _slabs(shape: Shape, space: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Return parts of space with the cuts of one part across the one or two longest axes alone."""
    longest = sorted(range(3), key=lambda axis: (shape[1 + axis], axis), reverse=True)
    slabs = []
    for cut in (longest[:1], longest[:2]):
        z, y, x = (space[axis] if axis in cut else shape[1 + axis] for axis in range(3))
        slabs.append((z, y, x))
    return slabs


def _largest_slabs(shape: Shape, steps: int, max_vertices: int) -> list[Shape]:
    """Return tiles of some steps with cuts across the longest axis in space alone.

    They are as large as they may be.
    """
    across = max((1, 2, 3), key=lambda axis: (shape[axis], axis))
    most = max_vertices * shape[across] // (steps * prod(shape[1:]))
    if not SHORTEST <= most < shape[across]:
        return []
    tile = [steps, *shape[1:]]
    parts = -(-shape[across] // (most - most % 2))
    tile[across] = _even_length(shape[across], -(-shape[across] // parts))
    t, z, y, x = tile
    return [(t, z, y, x)]


def sub_tile(tile: Shape, vertices: int) -> Shape:
    """Return the lengths of a part of a tile: x and y are shortened first, to 8 at least."""
    lengths = list(tile)
    for axis in (3, 2, 1, 0):
        while prod(lengths) > vertices and lengths[axis] > 8:
            lengths[axis] = max(8, (lengths[axis] + 1) // 2)
            other = {3: 2, 2: 3}.get(axis)
            if other is not None and prod(lengths) > vertices and lengths[other] > lengths[axis]:
                lengths[other] = max(8, (lengths[other] + 1) // 2)
    t, z, y, x = lengths
    return t, z, y, x


def _even_length(length: int, edge: int, *, even: bool = True) -> int:
    """Return the length of equal parts of about `edge`; even, where there are several."""
    parts = max(1, math.floor(length / edge + 0.5)) if even else -(-length // edge)
    part = -(-length // parts)
    # Even lengths keep the vertices of the first coarse level on one lattice.
    return part + part % 2 if even and parts > 1 else part


def is_small(shape: Shape) -> bool:
    """Whether a series is one tile without a trial, since all of it decodes in a moment."""
    return prod(shape) <= 2 * FAST_ENOUGH


def largest_tile(shape: Shape) -> Shape:
    """Return the tile of the most space and then the most steps, some at least, that may be tried.

    It is that of a series that is too large for a single one.
    """
    tiles = tiles_to_try(shape, MAX_VERTICES)
    some = [tile for tile in tiles if tile[0] >= min(FIRST_STEPS, shape[0])]
    return max(some or tiles, key=lambda tile: (prod(tile[1:]), tile[0]))


def tiles_of_large(blocks: Blocks) -> list[Shape]:
    """Return the tiles that may be tried for a series that is too large for a single one.

    A reader that goes from step to step keeps the tiles of a layer as far as its cache reaches; of
    longer ones it would decode all for each step.
    """
    frame = prod(blocks.shape[1:]) * blocks.dtype.itemsize
    steps = max(CACHE_BYTES // frame, largest_tile(blocks.shape)[0])
    tiles = tiles_to_try(blocks.shape, MAX_VERTICES, slabs=True)
    return [tile for tile in tiles if tile[0] <= steps]


class GainLog:
    """Approximate size of the file after each stage, for the header.

    Attributes:
        entries: `what`, `bytes` of the file and `seconds` since the beginning, per stage.
    """

    def __init__(self, overhead: int) -> None:
        """Begin to count the seconds. overhead: bytes of the file that are no tiles, roughly."""
        self._overhead, self._begun = overhead, time.perf_counter()
        self.entries: list[dict[str, Any]] = []

    def note(self, what: str, outcome: Outcome) -> None:
        """Add the size of the file by the outcome of a stage."""
        self.entries.append(
            {
                "what": what,
                "bytes": round(outcome.size + self._overhead),
                "seconds": round(time.perf_counter() - self._begun, 3),
            }
        )


@dataclass(frozen=True, kw_only=True)
class PlanTask:
    """A series and what is asked for: the same in all stages of planning."""

    blocks: Blocks
    """The series as one tile."""
    value_range: ValueRange
    features: Sequence[Feature]
    config: EncodeConfig
    goal: Goal
    fixed_tile: Shape | None
    """Tile that the settings name; None if it is to be chosen."""
    workers: ThreadPoolExecutor
    gains: GainLog
    parts: Parts = field(default_factory=Parts)
    """Progress of the planning."""

    def asks(self, name: str) -> bool:
        """Whether the settings leave a stage in; one that they leave out is recorded."""
        if name not in self.config.without:
            return True
        skip(name, f"--without {name}")
        return False

    @property
    def density(self) -> int:
        """Thoroughness of filling the vertices that do not count, see `fill`."""
        return DENSITIES[self.config.effort > 1]

    @property
    def takes_fast_coder(self) -> bool:
        """Whether the fast coder is taken without a trial."""
        quick = self.config.effort == 1 and FAST_BYTES[self.config.access] > 1
        return quick and not is_small(self.blocks.shape)

    def is_slow(self, tile: Shape, size: float) -> bool:
        """Whether reading would take longer than is wished for with the mixing coder.

        tile: of the series. size: its bytes.
        """
        access, shape = self.config.access, self.blocks.shape
        ns = decoding_ns(8 * size / prod(shape), "mixing")
        in_region = 1e-6 * ns * region_vertices(shape, tile)
        slow = ns > NS_PER_BYTE[access] * self.blocks.dtype.itemsize
        return slow or in_region > REGION_MS[access]


HeadHistory = list[dict[str, float | None]]
"""Training of a head: `seconds`, `epoch` (training updates), `psnr` of held-out samples in dB.

`samples` is the number of voxels that it learns from, the same at each point.
"""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Settings and options that the series would be coded with, by the choices made so far."""

    sample: Sample
    """Tiles that the choices are tried on; their grid is the chosen one."""
    settings: TileSettings
    """Settings of the tiles: all that a decoder needs to know."""
    outcome: Outcome
    """Outcome of the sample with these settings."""
    coding: Coding
    """Options of the encoder, without the bound."""
    plain: Attempt | None = None
    """The same without an MLP, where the settings have one."""
    saved: float | None = None
    """Share of the bytes of the tiles that the MLP saves, about; None without one."""
    coded: bool = False
    """Whether the outcome is that of all tiles, or of many where a series is large."""
    history: HeadHistory = field(default_factory=list)
    """Training of the head."""
    tiling: Tiling | None = None
    """Choice of the tiles; None where they were asked for, or follow from the shape."""
    parts: Sample | None = None
    """Parts of the tiles that were coded."""
    moved: TileSettings | None = None
    """Settings of these parts."""
    magnitudes: Magnitudes | None = None
    """Coefficients of all tiles, or of these parts; None without a promised PSNR."""
    ratio: float = 0.0
    """Promised error as a multiple of what these predict; 0 where they do not."""
