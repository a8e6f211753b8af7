"""Made series of labels: the kinds are what their names say, and each call makes the same."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.bench.label_kinds import KINDS


@pytest.mark.parametrize(
    ("kind", "dtype", "at_least", "at_most"),
    [
        ("components", "int32", 10, 256),
        ("refinement levels", "int8", 5, 5),
        ("tiny grid", "int16", 8, 12),
        ("checkerboard", "uint8", 2, 2),
        ("filled", "int16", 6, 6),
        ("floats", "float32", 10, 26),
        ("ranks", "int32", 257, 400),
    ],
)
def test_a_kind_has_its_type_and_number_of_values(
    kind: str, dtype: str, at_least: int, at_most: int
) -> None:
    values = KINDS[kind]()
    assert values.dtype == dtype
    assert at_least <= np.unique(values).size <= at_most
    assert values.ndim == 4
    np.testing.assert_array_equal(KINDS[kind](), values)


def test_regions_of_a_kind_are_connected_and_basins_cover_all() -> None:
    components = KINDS["components"]()
    assert (components[:, :, :, 1:] == components[:, :, :, :-1]).mean() > 0.9
    basins = KINDS["basins"]()
    assert (basins[:, :, :, 1:] == basins[:, :, :, :-1]).mean() > 0.7
