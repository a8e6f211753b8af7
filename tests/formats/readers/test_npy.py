"""NumPy's .npy: every type and order of axes, exact sizes; every refusal."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from stored_series import (
    VALUES,
    frames,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", "f2", "u1", ">i2", "u8"])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_of_every_type_and_order(tmp_path: Path, dtype: str, fortran: bool) -> None:
    values = (VALUES * 50).astype(dtype)
    np.save(tmp_path / "a.npy", np.asfortranarray(values) if fortran else values)
    np.testing.assert_array_equal(frames(tmp_path / "a.npy"), values)
    np.save(tmp_path / "b.npy", np.asfortranarray(values[0]) if fortran else values[0])
    np.testing.assert_array_equal(frames(tmp_path / "b.npy"), values[:1])


@pytest.mark.parametrize("order", list(itertools.permutations("tzyx"))[::2])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_with_any_order_of_axes(tmp_path: Path, order: tuple[str, ...], fortran: bool) -> None:
    stored = VALUES.transpose(["tzyx".index(axis) for axis in order])
    np.save(tmp_path / "a.npy", np.array(stored, order="F" if fortran else "C"))
    np.testing.assert_array_equal(frames(tmp_path / "a.npy", axes=",".join(order)), VALUES)


def test_npy_recognised_by_its_magic(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    os.rename(tmp_path / "a.npy", tmp_path / "a.data")
    with open_series(tmp_path / "a.data") as series:
        assert (series.name, series.units, series.attributes) == ("a", "", {})
        assert all(
            np.array_equal(series.coords[axis].values, np.arange(length))
            for axis, length in zip("tzyx", VALUES.shape, strict=True)
        )


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.zeros((2, 2, 2), [("a", "i4")]), "compound"),
        (np.full((2, 2, 2), None), "Python objects"),
        (np.zeros((2, 2, 2), bool), "boolean.*mask"),
        (np.full((2, 2, 2), "word"), "text"),
        (np.zeros((2, 2, 2), "M8[s]"), "dates"),
        (np.zeros(()), "0 dimensions"),
        (np.zeros((2, 2)), "2 dimensions"),
        (np.zeros((1, 1, 1, 1, 1)), "5 dimensions"),
        (np.zeros((0, 2, 2)), "length 0"),
        (np.zeros((2, 2, 2), np.longdouble), "float128|longdouble"),
    ],
)
def test_unsuitable_npy_is_described(tmp_path: Path, array: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=words) as caught:
        open_series(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_npz_is_refused_with_advice(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", v=VALUES)
    with pytest.raises(InputError, match=r"numpy.save"):
        open_series(tmp_path / "a.npz")


@pytest.mark.parametrize("change", [-1, 1, 8])
def test_npy_of_a_wrong_size_is_refused(tmp_path: Path, change: int) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    size = (tmp_path / "a.npy").stat().st_size
    os.truncate(tmp_path / "a.npy", size + change)
    with pytest.raises(InputError, match=r"mmap length is greater|header promises") as caught:
        open_series(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_npy_with_a_broken_header_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    data = bytearray((tmp_path / "a.npy").read_bytes())
    data[12:20] = b"\xff" * 8
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(InputError, match=r"cannot be read as \.npy"):
        open_series(tmp_path / "a.npy")
