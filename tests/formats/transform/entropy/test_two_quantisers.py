"""States of two quantisers: the table of FORMAT.md, and runs of zeros."""

from __future__ import annotations

import numpy as np
from trellises import NEXT

from fhash_formats.transform.entropy.two_quantisers import AFTER, after_zeros


def test_the_table_is_that_of_the_document() -> None:
    assert np.array_equal(np.array(AFTER).reshape(8, 2), NEXT)


def test_each_state_is_reached_from_two_others() -> None:
    assert sorted(AFTER) == sorted([*range(8)] * 2)


def test_runs_of_zeros() -> None:
    for first in range(8):
        state = first
        for n in range(20):
            assert after_zeros(first, n, AFTER) == state
            assert after_zeros(first, n + (1 << 40), AFTER) == state
            state = NEXT[state, 0]
