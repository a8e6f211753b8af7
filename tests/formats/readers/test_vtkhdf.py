"""VTKHDF: single steps, series, vectors, cells, shared entries, and files that do not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fhash_formats import open_series
from fhash_formats.errors import InputError

RNG = np.random.default_rng(0)
VALUES = RNG.normal(size=(3, 2, 3, 4)).astype("f4")


def write(path: Path, arrays: dict[str, np.ndarray], **options: Any) -> Path:
    """A file of datasets such as "PointData/u"; options `times`, `offsets` and attributes."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        attributes = {
            "Version": [2, 0],
            "Type": np.bytes_(b"ImageData"),
            "WholeExtent": [1, 4, 0, 2, -1, 0],
            "Origin": [0.0, 10.0, 1.0],
            "Spacing": [0.5, 1.0, 2.0],
            "Direction": np.eye(3).ravel(),
            **options.get("attributes", {}),
        }
        for name, value in attributes.items():
            if value is not None:
                root.attrs[name] = value
        for name, values in arrays.items():
            root[name] = values
        if "times" in options:
            root["Steps/Values"] = np.array(options["times"], dtype="f8")
            root["Steps"].attrs["NSteps"] = options.get("count", len(options["times"]))
        for name, values in options.get("offsets", {}).items():
            root[f"Steps/{name}"] = values
    return path


def frames(path: Path, **options: Any) -> np.ndarray:
    with open_series(path, **options) as series:
        return np.stack(list(series.frames()))


def test_a_series_with_times_and_positions(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtkhdf", {"PointData/u": VALUES}, times=[3.0, 4.5, 9.0])
    with open_series(path) as series:
        assert (series.name, series.shape) == ("u", VALUES.shape)
        assert series.coords["t"].values.tolist() == [3, 4.5, 9]
        assert series.coords["x"].values.tolist() == [0.5, 1, 1.5, 2]
        assert series.coords["y"].values.tolist() == [10, 11, 12]
        assert series.coords["z"].values.tolist() == [-1, 1]
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)


def test_one_step_without_times_whatever_its_suffix(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf", {"PointData/u": VALUES[0]}, attributes={"Version": [1, 0]})
    with open_series(path) as series:
        assert series.shape == (1, *VALUES.shape[1:])
        np.testing.assert_array_equal(series.read(0), VALUES[0])
        assert series.coords["x"].values.tolist() == [0.5, 1, 1.5, 2]


def test_vectors_and_cells(tmp_path: Path) -> None:
    vector = RNG.normal(size=(3, 2, 3, 4, 3))
    cells = RNG.integers(0, 9, (3, 1, 2, 3)).astype("u1")
    arrays = {"PointData/v": vector, "CellData/label": cells, "CellData/vtkGhostType": cells}
    path = write(tmp_path / "a.vtkhdf", arrays, times=[0, 1, 2])
    np.testing.assert_array_equal(frames(path, var="v.y"), vector[..., 1])
    np.testing.assert_array_equal(frames(path, var="v.2"), vector[..., 2])
    with open_series(path, var="label") as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), cells)
        assert series.coords["x"].values.tolist() == [0.75, 1.25, 1.75]
        assert series.coords["z"].values.tolist() == [0]
    with pytest.raises(InputError, match=r"4 variables: v\.x .*label \(3, 1, 2, 3\); choose"):
        open_series(path)


def test_steps_may_share_an_entry(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.vtkhdf",
        {"PointData/u": VALUES[:2]},
        times=[0, 1, 2, 3],
        offsets={"PointDataOffsets/u": [1, 0, 0, 1]},
    )
    np.testing.assert_array_equal(frames(path), VALUES[[1, 0, 0, 1]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"attributes": {"Type": np.bytes_(b"PolyData")}}, "type PolyData; ImageData can be read"),
        ({"attributes": {"Direction": [0, 1, 0, 1, 0, 0, 0, 0, 1]}}, "turned against the axes"),
        ({"attributes": {"Spacing": [1.0, np.nan, 1.0]}}, "Spacing has not 3 numbers"),
        ({"attributes": {"Origin": None}}, "Origin has not 3 numbers"),
        ({"attributes": {"WholeExtent": [0, 9, 0, 2, 0, 1]}}, "does not fit the grid"),
        ({"times": [0, 1, 2], "count": 4}, "4 steps and has the times of 3"),
        ({"times": [0, 1, 2, 3]}, "do not fit its 3 entries"),
        ({"times": [0, 1], "offsets": {"PointDataOffsets/u": [0, 3]}}, "do not fit its 3 entries"),
    ],
)
def test_files_that_do_not_fit(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "a.vtkhdf", {"PointData/u": VALUES}, **{"times": [0, 1, 2], **options})
    with pytest.raises(InputError, match=message) as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_hdf5_without_the_group_stays_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["u"] = VALUES
    np.testing.assert_array_equal(frames(tmp_path / "a.h5"), VALUES)


def test_cut_files_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtkhdf", {"PointData/u": VALUES}, times=[0, 1, 2])
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"a\.vtkhdf cannot be read"):
        open_series(path)
