"""Types of numbers by the names that Zarr gives them."""

import numpy as np

from fhash_formats.support.number_types import DTYPES


def test_names_are_those_of_numpy_in_native_order() -> None:
    assert len(DTYPES) == 11
    for name, dtype in DTYPES.items():
        assert dtype == np.dtype(name)
        assert dtype.name == name
        assert dtype.isnative
