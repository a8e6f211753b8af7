"""Prices of tiles: work for a region, tiles that are tried, and what is foretold of them."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.compact.attempt import (
    FAST_ENOUGH,
    MAX_WHOLE_VERTICES,
    PRICES,
    cheap_tiling,
    even_tile,
    parse_tile,
    region_vertices,
    tiles_to_try,
)
from fhash_codec.config import ACCESSES
from fhash_formats.errors import InputError

Shape = tuple[int, int, int, int]
SHAPES = [(12, 25, 125, 125), (600, 12, 14, 16), (2, 128, 160, 160), (40, 3, 160, 200)]
LONG = [(64, 128, 256, 256), (1, 512, 512, 512), (500, 3, 100, 400)]


def test_the_mean_work_for_a_region_is_that_of_regions_at_all_places() -> None:
    shape, tile = (6, 20, 40, 64), (3, 20, 8, 16)
    places = [range(length - 16 + 1) for length in shape[1:]]
    touched = [
        np.mean([n * ((low + 15) // n - low // n + 1) for low in lows])
        for n, lows in zip(tile[1:], places, strict=True)
    ]
    assert region_vertices(shape, tile) == pytest.approx(tile[0] * prod(touched), rel=0.07)
    assert region_vertices(shape, shape) == prod(shape)


@pytest.mark.parametrize("shape", [*SHAPES, *LONG, (1, 1, 1, 1), (3, 5, 7, 1)])
def test_tiles_are_tried_from_the_fastest_region_to_the_whole(shape: Shape) -> None:
    tiles = tiles_to_try(shape, MAX_WHOLE_VERTICES)
    works = [region_vertices(shape, tile) for tile in tiles]
    assert works == sorted(works)
    assert len(set(tiles)) == len(tiles)
    assert sum(work <= FAST_ENOUGH for work in works) <= 1
    assert (shape in tiles) == (prod(shape) <= MAX_WHOLE_VERTICES)
    assert all(1 <= n <= length for tile in tiles for n, length in zip(tile, shape, strict=True))
    few = [tile for tile in tiles if prod(tile) > 1 << 14]
    for tile in few:  # and few of their vertices lie beyond the border
        covered = prod(-(-length // n) * n for n, length in zip(tile, shape, strict=True))
        assert covered <= 1.7 * prod(shape)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1e3, 1e5, 1e7])
def test_a_wish_for_access_is_never_answered_by_slower_tiles(shape: Shape, size: float) -> None:
    works = []
    for access in ACCESSES:
        tiling = cheap_tiling(shape, size, access)
        assert tiling.price is not None
        assert 1 <= tiling.price <= PRICES[access]
        works.append(region_vertices(shape, tiling.tile))
    assert works == sorted(works)
    assert cheap_tiling(shape, size, "small").tile == shape


def test_every_wish_has_a_price() -> None:
    assert tuple(PRICES) == ACCESSES
    assert list(PRICES.values()) == sorted(PRICES.values(), reverse=True)


@pytest.mark.parametrize("shape", [(10, 64, 64, 64), (12, 25, 125, 125), (33, 64, 64, 64)])
def test_few_vertices_of_tiles_lie_beyond_the_border(shape: Shape) -> None:
    tile = even_tile(shape, 27, -(-shape[0] // 3))
    covered = np.prod([-(-n // length) * length for n, length in zip(shape, tile, strict=True)])
    assert covered <= 1.04 * np.prod(shape)


@pytest.mark.parametrize("text", ["whole", "200x1000x1000x1"])
def test_a_tile_that_no_reader_would_take_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"at most 134,217,728 are decoded together"):
        parse_tile(text, (200, 1000, 1000, 2))
    assert parse_tile("1x1000x1000x9", (200, 1000, 1000, 2)) == (1, 1000, 1000, 2)
