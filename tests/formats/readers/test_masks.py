"""Masks from files: any format and type, steps or one frame for all, and shapes that do not fit."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from fhash_formats import open_mask
from fhash_formats.errors import InputError, MissingInputError

MASK = np.random.default_rng(0).random((4, 3, 5, 6)) < 0.4


def save(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["mask"] = values
    elif path.suffix == ".zarr":
        zarr.create_array(path, shape=values.shape, dtype=values.dtype)[...] = values
    else:
        path = path.with_name(
            f"m_{'x'.join(map(str, reversed(values.shape)))}_{values.dtype.name}.raw"
        )
        path.write_bytes(values.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".npy", ".h5", ".zarr", ".raw"])
@pytest.mark.parametrize("dtype", ["?", "u1", "i2", "f4"])
def test_nonzero_is_true(tmp_path: Path, suffix: str, dtype: str) -> None:
    if (suffix, dtype) == (".raw", "?"):
        dtype = "u1"
    values = (MASK * (-3 if dtype in ("i2", "f4") else 1)).astype(dtype)
    mask = open_mask(save(tmp_path / f"m{suffix}", values), MASK.shape)
    for step, expected in enumerate(MASK):
        frame = mask(step)
        assert frame.dtype == bool
        np.testing.assert_array_equal(frame, expected)
    mask.close()


def test_one_frame_serves_every_step(tmp_path: Path) -> None:
    for values in (MASK[0], MASK[:1]):
        mask = open_mask(save(tmp_path / "m.npy", values), (9, 3, 5, 6))
        np.testing.assert_array_equal(mask(0), MASK[0])
        np.testing.assert_array_equal(mask(8), MASK[0])


def test_nan_is_false(tmp_path: Path) -> None:
    values = np.where(MASK, 1.0, 0.0)
    values[0, 0, 0, :2] = np.nan
    mask = open_mask(str(save(tmp_path / "m.npy", values)), MASK.shape)
    np.testing.assert_array_equal(mask(0), np.nan_to_num(values[0]) != 0)


def test_a_mask_among_others_is_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["a"], file["b"] = MASK, ~MASK
    with pytest.raises(InputError, match="2 variables"):
        open_mask(tmp_path / "m.h5", MASK.shape)
    np.testing.assert_array_equal(open_mask(tmp_path / "m.h5", MASK.shape, var="b")(1), ~MASK[1])


@pytest.mark.parametrize("shape", [(5, 3, 5, 6), (2, 3, 5, 6), (4, 3, 5, 7), (4, 6, 5, 3)])
def test_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"the mask has shape \(4, 3, 5, 6\).*the series \("):
        open_mask(save(tmp_path / "m.npy", MASK), shape)


def test_other_types_and_missing_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="complex"):
        open_mask(save(tmp_path / "m.npy", MASK.astype(complex)), MASK.shape)
    with pytest.raises(MissingInputError):
        open_mask(tmp_path / "none.npy", MASK.shape)


def test_a_mask_is_not_asked_for_its_axes(tmp_path: Path) -> None:
    mask = np.ones((16, 24, 24, 3), bool)
    np.testing.assert_array_equal(open_mask(save(tmp_path / "m.npy", mask), mask.shape)(3), mask[3])
