"""Regions: descriptions that do not hold are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labelled_region import COORDS, labelled_region

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "has no name"),
        ({"dtype": np.dtype("c8")}, "values of type complex64"),
        ({"dtype": np.dtype(np.longdouble)}, "integers and floats up to 64 bits"),
        ({"dtype": np.dtype(bool)}, "values of type bool"),
        ({"shape": (4, 5, 6)}, "3 dimensions"),
        ({"shape": (3, 0, 5, 6)}, "an axis is empty"),
        ({"shape": (2, 4, 5, 6)}, r"coordinate of t is float64 \(3,\); float64 \(2,\) is needed"),
        ({"coords": {}}, r"coordinates of \[\]; exactly those of t, z, y and x"),
        (
            {
                "coords": {
                    **COORDS,
                    "x": Coordinate(name="x", values=np.arange(6, dtype="f4")),
                }
            },
            "coordinate of x is float32",
        ),
        (
            {"coords": {**COORDS, "w": COORDS["x"]}},
            r"\['t', 'w', 'x', 'y', 'z'\]",
        ),
    ],
)
def test_a_region_that_is_none(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        labelled_region(**changes)


def test_a_region_keeps_the_native_byte_order() -> None:
    assert labelled_region(dtype=np.dtype(">f8")).dtype.isnative
