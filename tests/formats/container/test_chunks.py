"""Arrays cut into chunks, and chunks joined to shards."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from sharded_files import chunk_of, random_values, write_sharded

from fhash_formats.container import shard_order
from fhash_formats.container.writer import cut
from fhash_formats.errors import InputError


@pytest.mark.parametrize("chunk_shape", [(2, 3), (5, 7), (8, 8), (1, 1)])
def test_the_chunks_of_an_array_are_all_of_it_in_order(chunk_shape) -> None:
    values = random_values((5, 7))
    grid = [range(-(-n // chunk)) for n, chunk in zip(values.shape, chunk_shape, strict=True)]
    chunks = list(cut(values, chunk_shape))
    for index, chunk in zip(product(*grid), chunks, strict=True):
        np.testing.assert_array_equal(chunk, chunk_of(values, index, chunk_shape))


BAD_CHUNKS = {
    "too few": (lambda given: given[:-1], "was not given"),
    "too many": (lambda given: [*given, given[0]], "more chunks"),
    "of a later shard": (lambda given: [((2, 0), given[4])], r"chunk \(2, 0\) is none of shard"),
    "twice": (lambda given: [((0, 0), given[0]), ((0, 0), given[0])], "given twice"),
    "in order after all": (lambda given: [((0, 1), given[1]), given[0], given[0]], "given twice"),
    "other type": (lambda given: [given[0].astype(np.float64)], r"float64 \(2, 3\)"),
    "other shape": (lambda given: [given[0][:1]], r"float32 \(1, 3\)"),
}


@pytest.mark.parametrize("case", BAD_CHUNKS)
def test_chunks_that_do_not_fit(tmp_path, samples, case) -> None:
    change, message = BAD_CHUNKS[case]
    values = random_values((7, 6))
    given = [chunk_of(values, index, (2, 3)) for index in shard_order((7, 6), (2, 3), (4, 6))]
    with pytest.raises(InputError, match=message):
        write_sharded(tmp_path / "a.fhz", samples, values, (2, 3), (4, 6), chunks=change(given))
    assert list(tmp_path.iterdir()) == []
