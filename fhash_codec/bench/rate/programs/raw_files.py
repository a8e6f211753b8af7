"""Raw arrays in files, as the programs of `fhash bench rate` read and write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fhash_codec.bench.rate.layouts import Values
from fhash_formats.errors import InputError

__all__ = ["as_float", "read_raw", "write_raw"]


def as_float(values: Values) -> Values:
    """Values as little-endian float32, or as float64 where float32 would lose some of them."""
    narrow = values.astype("<f4")
    wide = values.dtype.itemsize > 4 and not np.array_equal(narrow, values)
    return values.astype("<f8") if wide else narrow


def write_raw(values: Values, file: Path) -> None:
    """Write an array in C order, nothing else."""
    values.tofile(file)


def read_raw(file: Path, dtype: str, shape: tuple[int, ...]) -> Values:
    """An array of a file that holds nothing else; raises InputError for another size."""
    try:
        values = np.fromfile(file, dtype=dtype)
    except OSError as error:
        raise InputError(f"it wrote no values: {error.strerror}") from error
    count = int(np.prod(shape))
    if values.size != count:
        raise InputError(f"it gave {values.size} values, not {count}")
    return values.reshape(shape)
