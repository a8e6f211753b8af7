"""Choice of the shape of the tiles that a series is cut into."""

from __future__ import annotations

import math
from itertools import product
from math import prod

from fhash_formats.errors import InputError
from fhash_formats.transform.stream import MAX_TILE_VERTICES
from fhash_formats.transform.tile.sections import Shape

__all__ = ["even_tile", "first_tile", "parse_tile"]

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


def first_tile(shape: Shape) -> Shape:
    """Return the tile for a first look at a series."""
    return even_tile(shape, max(1, prod(shape) // TILE_VERTICES), min(shape[0], FIRST_STEPS))
