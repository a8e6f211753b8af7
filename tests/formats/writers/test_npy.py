"""NumPy's .npy: the same bytes as NumPy writes, half precision included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from labelled_region import DATA, labelled_region

from fhash_formats import save_region


@pytest.mark.parametrize("dtype", ["f2", "f4", "i2"])
def test_the_file_is_the_one_that_numpy_writes(tmp_path: Path, dtype: str) -> None:
    values = np.nan_to_num(DATA * 10).astype(dtype)
    region = labelled_region(dtype=np.dtype(dtype))
    (path,) = save_region(tmp_path / "out.npy", region, iter(values))
    np.save(tmp_path / "expected.npy", values)
    assert path.read_bytes() == (tmp_path / "expected.npy").read_bytes()


def test_values_of_the_other_byte_order_are_swapped(tmp_path: Path) -> None:
    values = DATA.astype(">f4")
    (path,) = save_region(tmp_path / "out.npy", labelled_region(dtype=values.dtype), iter(values))
    stored = np.load(path)
    assert stored.dtype == np.dtype("<f4")
    np.testing.assert_array_equal(stored, values)
