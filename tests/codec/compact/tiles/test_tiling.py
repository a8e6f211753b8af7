"""Shapes of tiles and shards."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.compact.tiles.tiling import even_tile, parse_tile
from fhash_formats.errors import InputError

Shape = tuple[int, int, int, int]


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
