"""Shapes of tiles and shards."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.compact.tiles.tiling import parse_tile, tile_for
from fhash_formats.errors import InputError

Shape = tuple[int, int, int, int]


@pytest.mark.parametrize("shape", [(64, 128, 256, 256), (1, 512, 512, 512), (500, 3, 100, 400)])
def test_tiles_of_a_large_series_stay_small_however_few_bytes_it_takes(shape: Shape) -> None:
    """Some tiles are in memory at a time: a file of a few kB must not ask for gigabytes."""
    assert np.prod(tile_for(shape, 1000.0)) <= 4 << 20


@pytest.mark.parametrize("shape", [(10, 64, 64, 64), (12, 25, 125, 125), (33, 64, 64, 64)])
def test_few_vertices_of_tiles_lie_beyond_the_border(shape: Shape) -> None:
    tile = tile_for(shape, 1e6)
    covered = np.prod([-(-n // length) * length for n, length in zip(shape, tile, strict=True)])
    assert covered <= 1.04 * np.prod(shape)


@pytest.mark.parametrize("text", ["whole", "200x1000x1000x1"])
def test_a_tile_that_no_reader_would_take_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"at most 134,217,728 are decoded together"):
        parse_tile(text, (200, 1000, 1000, 2))
    assert parse_tile("1x1000x1000x9", (200, 1000, 1000, 2)) == (1, 1000, 1000, 2)
