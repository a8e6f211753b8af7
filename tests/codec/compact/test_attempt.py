"""Prices of tiles: work for a region, tiles that are tried, and what is foretold of them."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.compact.attempt import (
    FAST_ENOUGH,
    MAX_WHOLE_VERTICES,
    PRICES,
    Tiling,
    TilingTrial,
    cheap_tiling,
    even_tile,
    foretold_price,
    parse_tile,
    part_of,
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


@pytest.mark.parametrize("shape", LONG)
def test_tiles_of_a_large_series_stay_small_however_few_bytes_it_takes(shape: Shape) -> None:
    """Some tiles are in memory at a time: a file of a few kB must not ask for gigabytes."""
    assert prod(cheap_tiling(shape, 1000.0, "small").tile) <= 4 << 20


def test_more_cuts_are_foretold_to_cost_more() -> None:
    shape = (12, 25, 125, 125)
    prices = [
        foretold_price(shape, tile, 1e5)
        for tile in [shape, (12, 25, 64, 64), (6, 25, 64, 64), (6, 25, 32, 32)]
    ]
    assert prices[0] == 1.0
    assert prices == sorted(prices)


@pytest.mark.parametrize("tile", [(21, 80, 80, 80), (2, 4, 400, 400), (9000, 8, 8, 8)])
def test_a_part_of_a_tile_is_as_large_as_it_may_be(tile: Shape) -> None:
    part = part_of(tile, 100_000)
    assert all(n <= length for n, length in zip(part, tile, strict=True))
    assert prod(part) <= 100_000
    assert prod(part) > 100_000 / 8
    assert part_of(tile, prod(tile)) == tile


def test_slabs_are_cut_across_the_longest_axes_alone() -> None:
    shape, most = (81, 64, 64, 128), 4 << 20
    plain, more = tiles_to_try(shape, most), tiles_to_try(shape, most, slabs=True)
    assert len(set(more)) == len(more)
    assert set(plain[1:]) <= set(more)
    added = set(more) - set(plain)
    assert added
    for tile in added:
        cut = [axis for axis in (1, 2, 3) if tile[axis] < shape[axis]]
        assert cut in ([3], [2, 3])
        assert prod(tile) <= most
    # The largest of all steps is between two of the usual edges.
    assert (81, 64, 64, 12) in added


def test_one_axis_in_space_gives_no_slabs_twice() -> None:
    shape = (8, 1, 1, 4096)
    more = tiles_to_try(shape, 1 << 14, slabs=True)
    assert len(set(more)) == len(more)
    assert all(tile[1:3] == (1, 1) for tile in more)


def test_a_choice_describes_itself() -> None:
    trials = [TilingTrial(tile=(4, 8, 8, 8), size=120.0), TilingTrial(tile=(4, 8, 8, 16), size=100)]
    tiling = Tiling(tile=(4, 8, 8, 8), price=1.2, trials=trials, parts=[(4, 8, 8, 16)])
    assert tiling.best == (4, 8, 8, 16)
    told = (
        "tried 4 x 8 x 8 x 8 at 1.20, 4 x 8 x 8 x 16 at 1.00, on parts of 4 x 8 x 8 x 16 vertices"
    )
    assert tiling.describe() == told
    foretold = Tiling(tile=(4, 8, 8, 8), price=1.05)
    assert foretold.best is None
    assert foretold.describe() == "foretold: 1.05 times the bytes of one tile"


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
