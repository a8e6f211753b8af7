"""`Table` reads as numpy does and decodes no more than is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec.model_parts import Mlp, Table, ceil_halvings
from fhash_formats.errors import RegionError

VALUES = np.arange(3 * 4 * 5 * 6 * 2, dtype=np.float32).reshape(3, 4, 5, 6, 2)


class Source:
    shape = VALUES.shape

    def __init__(self) -> None:
        self.regions: list[tuple[slice, ...]] = []

    def read(self, region: tuple[slice, ...]) -> Any:
        self.regions.append(region)
        return VALUES[region]


@pytest.mark.parametrize(
    "index",
    [
        (),
        1,
        (..., 1),
        (slice(1, None), 0, slice(None, None, -1)),
        (slice(0, 3, 2), slice(3, 0, -2), -1, slice(2, 5), slice(0, 1)),
        (slice(2, 2),),
        (-1, -1, -1, -1, -1),
        (np.int64(2), ...),
    ],
)
def test_indexing_is_that_of_numpy(index: Any) -> None:
    table = Table(1, Source(), "float32")
    np.testing.assert_array_equal(table[index], VALUES[index])
    assert table[index].dtype == table.dtype


def test_only_the_region_that_is_asked_for_is_read() -> None:
    source = Source()
    Table(1, source, "float32")[1, 2:4, ::2, 5]
    assert source.regions == [(slice(1, 2), slice(2, 4), slice(0, 5), slice(5, 6), slice(0, 2))]
    assert len(Table(2, source, "float32")) == 3
    np.testing.assert_array_equal(np.asarray(Table(2, source, "float32"), dtype=np.float64), VALUES)


@pytest.mark.parametrize("index", [3, (0, -5), [0], True, (0,) * 6, (..., ...), "t"])
def test_other_indices_are_refused(index: Any) -> None:
    with pytest.raises(RegionError):
        Table(1, Source(), "float32")[index]


def test_a_table_is_no_view() -> None:
    with pytest.raises(ValueError, match="decoded"):
        np.asarray(Table(1, Source(), "float32"), copy=False)


def test_lengths_after_halvings_are_rounded_up() -> None:
    assert ceil_halvings((9, 8, 1), 1) == (5, 4, 1)
    assert ceil_halvings((9, 8, 1), 3) == (2, 1, 1)
    assert ceil_halvings((9, 8, 1), 0) == (9, 8, 1)


def test_an_mlp_counts_its_numbers() -> None:
    weights, biases = np.zeros((3, 4), np.float32), np.zeros(3, np.float32)
    mlp = Mlp(weights=(weights,), biases=(biases,), activation="relu", stencil="corners")
    assert mlp.parameters == 15
    assert mlp.layers == ((weights, biases),)
