"""Types of numbers by the names that Zarr gives them."""

import numpy as np

from fhash_formats.support.number_types import DTYPES, is_wide_integer


def test_names_are_those_of_numpy_in_native_order() -> None:
    assert len(DTYPES) == 11
    for name, dtype in DTYPES.items():
        assert dtype == np.dtype(name)
        assert dtype.name == name
        assert dtype.isnative


def test_only_integers_of_64_bits_are_wide() -> None:
    assert {name for name, dtype in DTYPES.items() if is_wide_integer(dtype)} == {
        "int64",
        "uint64",
    }
    assert is_wide_integer(np.dtype(">i8"))
