"""How a series is cut into tiles."""

from __future__ import annotations

import math
from itertools import product
from math import prod

from fhash_formats.errors import InputError
from fhash_formats.transform.stream import MAX_TILE_VERTICES
from fhash_formats.transform.tile.sections import Shape

__all__ = ["even_tile", "first_tile", "parse_tile", "tile_for"]

TILE_BYTES, TILE_VERTICES, FEWEST_TILES = 1500, 1 << 19, 27
"""A tile should take at least so many bytes, and hold at most so many vertices once there are enough tiles for random access."""
LARGEST = 4 << 20
"""Vertices of a tile, unless it is asked for or is everything: some are in memory at a time, each several times over."""
TILE_STEPS = 4
FIRST_STEPS = 8
SHORTEST = 24
"""Vertices along an axis of space that is not cut further."""
PRICE_OF_PADDING, PRICE_OF_MORE, PRICE_OF_FEWER = 3.0, 0.3, 0.05
"""Of vertices beyond the border, as a part of all; of an e-fold number of tiles, and of an e-th of it."""
PRICE_OF_SHORT = 0.1
"""Of each axis of space that is cut shorter than SHORTEST."""


def parse_tile(text: str, shape: Shape) -> Shape | None:
    """The shape that a setting names, cut to the series; None for 'auto'. Raises InputError."""
    if text == "auto":
        return None
    if text == "whole":
        return _allowed(text, shape)
    try:
        numbers = [int(part) for part in text.split("x")]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or min(numbers) < 1:
        raise InputError(
            f"tile is '{text}'; allowed: auto, whole, or four whole numbers as in 4x32x32x32 (t, z, y, x)"
        )
    t, z, y, x = (min(n, length) for n, length in zip(numbers, shape, strict=True))
    return _allowed(text, (t, z, y, x))


def _allowed(text: str, tile: Shape) -> Shape:
    if prod(tile) > MAX_TILE_VERTICES:
        raise InputError(
            f"tile '{text}' has {prod(tile):,} vertices; at most {MAX_TILE_VERTICES:,} are decoded together; name another"
        )
    return tile


def even_tile(shape: Shape, tiles: int, steps: int) -> Shape:
    """A tile of about `steps` steps of which about `tiles` make up a shape: space is cut along its longest part.

    Around that wish, the number of parts along each axis is chosen so that little lies beyond the border, since that has to be coded, too.
    """
    wished = [-(-shape[0] // steps), 1, 1, 1]
    while prod(wished) < tiles:
        lengths = [-(-n // p) for n, p in zip(shape, wished, strict=True)]
        axis = max((1, 2, 3), key=lambda a: (lengths[a], a))
        if lengths[axis] < SHORTEST:
            break
        wished[axis] += 1
    best, tile = math.inf, shape
    for change in product((0, -1, 1), repeat=4):
        parts = [min(max(p + c, 1), n) for p, c, n in zip(wished, change, shape, strict=True)]
        t, *space = (-(-n // p) for n, p in zip(shape, parts, strict=True))
        # Even lengths keep the vertices of the first coarse level on one lattice.
        z, y, x = (n if p == 1 else n + n % 2 for n, p in zip(space, parts[1:], strict=True))
        count = prod(-(-n // length) for n, length in zip(shape, (t, z, y, x), strict=True))
        more = math.log(count / prod(wished))
        if (
            t > max(steps * 1.5, 1)
            or not 0.4 <= count / prod(wished) <= 1.5
            or (more < 0 and t * z * y * x > LARGEST)
        ):
            continue
        padding = count * t * z * y * x / prod(shape) - 1
        short = sum(
            p > 1 and length < SHORTEST for p, length in zip(parts[1:], (z, y, x), strict=True)
        )
        price = (
            PRICE_OF_PADDING * padding
            + PRICE_OF_SHORT * short
            + (PRICE_OF_MORE * more if more > 0 else -PRICE_OF_FEWER * more)
        )
        if price < best - 1e-9:
            best, tile = price, (t, z, y, x)
    return tile


def first_tile(shape: Shape) -> Shape:
    """Tiles for a first look."""
    return even_tile(shape, max(1, prod(shape) // TILE_VERTICES), min(shape[0], FIRST_STEPS))


def tile_for(shape: Shape, size: float) -> Shape:
    """Tiles of a series whose tiles take so many bytes together; more than FEWEST_TILES only where they get too large."""
    tiles = max(
        int(min(size / TILE_BYTES, max(FEWEST_TILES, prod(shape) / TILE_VERTICES))),
        -(-prod(shape) // LARGEST),
    )
    steps = shape[0]
    if tiles > 1:
        parts = -(-steps // TILE_STEPS) if tiles >= 16 else 1
        steps = -(-steps // min(parts, max(1, tiles // 8)))
    return even_tile(shape, max(1, tiles), steps)
