"""Series in memory and selections of steps: the contract that every reader keeps, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr

from fhash_formats import open_mask, open_series
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import ArraySeries, Coordinate, StepsSeries

VALUES = np.random.default_rng(0).normal(size=(4, 2, 3, 5)).astype(np.float32)


@pytest.mark.parametrize("step", [-1, 4])
def test_no_step_counts_from_the_end(step: int) -> None:
    all_steps = ArraySeries(VALUES)
    for series in (all_steps, StepsSeries(all_steps, [3, 2, 1, 0])):
        with pytest.raises(RegionError, match=rf"array: step {step} is outside 0\.\.3"):
            series.read(step)
    with pytest.raises(RegionError, match=rf"step {step} is outside"):
        StepsSeries(all_steps, [0, step])


def test_some_steps() -> None:
    some = StepsSeries(ArraySeries(VALUES), [2, 0])
    np.testing.assert_array_equal(np.stack(list(some.frames())), VALUES[[2, 0]])
    np.testing.assert_array_equal(some.coords["t"].values, [2, 0])
    with pytest.raises(InputError, match="empty"):
        StepsSeries(ArraySeries(VALUES), [])


def test_three_axes_are_one_step() -> None:
    series = ArraySeries(VALUES[0].astype(">f8"))
    assert (series.shape, series.dtype) == ((1, 2, 3, 5), np.dtype(np.float64))
    np.testing.assert_array_equal(series.read(0), VALUES[0])


def test_masked_values_are_nan_and_never_what_is_under_the_mask() -> None:
    masked = np.ma.masked_greater(VALUES, 0)
    np.testing.assert_array_equal(
        np.stack(list(ArraySeries(masked).frames())), np.where(VALUES > 0, np.nan, VALUES)
    )
    integers = (VALUES * 9).astype(np.int16)
    np.testing.assert_array_equal(ArraySeries(np.ma.asarray(integers)).read(1), integers[1])
    with pytest.raises(InputError, match="masked values of type int16, which has no NaN"):
        ArraySeries(np.ma.masked_greater(integers, 0))


@pytest.mark.parametrize(
    ("array", "coords", "message"),
    [
        (VALUES[0, 0], {}, "2 dimensions"),
        (VALUES > 0, {}, "type bool"),
        (VALUES[:0], {}, "an axis is empty"),
        (
            VALUES,
            {"t": Coordinate(name="t", values=np.zeros(3))},
            r"coordinate of t is float64 \(3,\); float64 \(4,\)",
        ),
        (
            VALUES,
            {"x": Coordinate(name="x", values=np.zeros(5, np.float32))},
            "coordinate of x is float32",
        ),
        (VALUES, {"w": Coordinate(name="w", values=np.zeros(5))}, "exactly those of t, z, y and x"),
    ],
)
def test_what_cannot_be_a_series(array: Any, coords: dict[str, Coordinate], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ArraySeries(array, coords=coords)


def test_a_series_knows_its_files(tmp_path: Path) -> None:
    assert ArraySeries(VALUES).files == ()
    for step in range(2):
        np.save(tmp_path / f"f{step}.npy", VALUES[step])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
        layout[:] = h5py.VirtualSource("a.h5", "v", VALUES.shape)
        file.create_virtual_dataset("v", layout)
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["v"] = h5py.ExternalLink("a.h5", "v")
    zarr.create_array(tmp_path / "a.zarr", data=VALUES)
    names = {
        "f0.npy": ["f0.npy"],
        "f?.npy": ["f0.npy", "f1.npy"],
        "a.h5": ["a.h5"],
        "virtual.h5": ["virtual.h5", "a.h5"],
        "virtual[.]h5": ["virtual.h5", "a.h5"],
        "linked.h5": ["linked.h5", "a.h5"],
        "a.zarr": ["a.zarr"],
    }
    for opened, files in names.items():
        for steps in (None, slice(0, 1)):
            with open_series(tmp_path / opened, steps=steps) as series:
                assert series.files == tuple(tmp_path / name for name in files)
    mask = open_mask(tmp_path / "f0.npy", VALUES.shape)
    mask.close()
    assert mask.files == (tmp_path / "f0.npy",)
