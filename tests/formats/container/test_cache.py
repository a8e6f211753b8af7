"""The cache of chunks: bounded, and the least recently used go first."""

from __future__ import annotations

import numpy as np

from fhash_formats.container import Container
from fhash_formats.container.stored import ChunkCache


def chunk(size: int = 100) -> np.ndarray:
    return np.zeros(size, dtype=np.uint8)


def test_the_least_recently_used_chunk_is_dropped_first() -> None:
    cache, kept = ChunkCache(300), chunk()
    cache.put(("a", (0,), 0), kept)
    cache.put(("a", (1,), 0), chunk())
    cache.put(("a", (0,), 1), chunk())
    assert cache.get(("a", (0,), 0)) is kept
    cache.put(("b", (0,), 0), chunk())
    assert cache.get(("a", (1,), 0)) is None
    assert cache.get(("a", (0,), 0)) is kept
    cache.clear()
    assert cache.get(("a", (0,), 0)) is None


def test_a_chunk_beyond_the_limit_is_not_kept() -> None:
    cache = ChunkCache(100)
    cache.put(("a", (0,), 0), chunk(101))
    assert cache.get(("a", (0,), 0)) is None


def test_cache_holds_no_more_than_its_limit(sample) -> None:
    with Container.open(sample, cache_bytes=200) as container:
        table = container.arrays["tables/level_1"]
        for _ in range(2):
            table.read(tuple(slice(0, n) for n in table.shape))
        assert 0 < container._cache._bytes <= 200
        assert container._cache._bytes == sum(
            chunk.nbytes for chunk in container._cache._chunks.values()
        )
    with Container.open(sample, cache_bytes=0) as container:
        table = container.arrays["tables/level_1"]
        table.read(tuple(slice(0, n) for n in table.shape))
        assert container._cache._bytes == 0
