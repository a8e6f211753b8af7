"""Raw arrays in files: the narrow type where it holds the values, and no other size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.programs.raw_files import as_float, read_raw, write_raw
from fhash_formats.errors import InputError


def test_values_are_float32_where_that_holds_them() -> None:
    for values, dtype in (
        (np.arange(5, dtype=np.int16), "<f4"),
        (np.array([0.5, 2.0]), "<f4"),
        (np.array([0.1]), "<f8"),
        (np.array([2**24 + 1]), "<f8"),
    ):
        floats = as_float(values)
        assert floats.dtype == np.dtype(dtype)
        np.testing.assert_array_equal(floats, values)


def test_other_sizes_are_refused(tmp_path: Path) -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    write_raw(values, tmp_path / "a")
    np.testing.assert_array_equal(read_raw(tmp_path / "a", "<f4", (2, 3)), values)
    with pytest.raises(InputError, match="it gave 6 values, not 8"):
        read_raw(tmp_path / "a", "<f4", (2, 4))
    with pytest.raises(InputError, match="it wrote no values"):
        read_raw(tmp_path / "b", "<f4", (2, 4))
