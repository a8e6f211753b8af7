"""Several variables in one output of HDF5, NetCDF and Zarr."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray
from regions import COORDS, SHAPE, labelled_region

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_check, save_region, save_regions

RNG = np.random.default_rng(5)
VALUES = {
    "u": RNG.normal(size=SHAPE).astype("f4"),
    "v": RNG.normal(size=SHAPE),
    "n": RNG.integers(-9, 9, SHAPE).astype("i2"),
}


def region(name: str, coords: Mapping[str, Coordinate] = COORDS) -> Region:
    return labelled_region(
        name=name, dtype=VALUES[name].dtype, coords=coords, attributes={}, units=f"units of {name}"
    )


def read(path: Path) -> dict[str, np.ndarray]:
    """Every variable and coordinate of an output."""
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return {name: np.asarray(values) for name, values in file.items()}
    engine = "zarr" if path.suffix == ".zarr" else "h5netcdf"
    with xarray.open_dataset(path, decode_times=False, engine=engine) as data:
        return {str(name): np.asarray(values) for name, values in data.variables.items()}


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_all_are_there_and_what_they_share_is_there_once(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    assert save_regions(path, [(region(name), VALUES[name]) for name in VALUES]) == [path]
    found = read(path)
    assert set(found) == {*VALUES, "time", "height", "lat", "lon"}
    for name, values in VALUES.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_one_is_written_as_it_is_alone(tmp_path: Path, suffix: str) -> None:
    save_region(tmp_path / f"one{suffix}", region("u"), VALUES["u"])
    save_regions(tmp_path / f"all{suffix}", [(region("u"), VALUES["u"])])
    one, both = read(tmp_path / f"one{suffix}"), read(tmp_path / f"all{suffix}")
    assert one.keys() == both.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, both[name])


def test_other_positions_of_one_name_have_another_name_in_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    staggered = {**COORDS, "x": replace(COORDS["x"], values=COORDS["x"].values + 0.05)}
    save_regions(path, [(region("u"), VALUES["u"]), (region("v", staggered), VALUES["v"])])
    with h5py.File(path) as file:
        assert set(file) == {"u", "v", "time", "height", "lat", "lon", "lon_2"}
        np.testing.assert_array_equal(file["v"].dims[3]["lon_2"], staggered["x"].values)
        np.testing.assert_array_equal(file["u"].dims[3]["lon"], COORDS["x"].values)


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_what_does_not_fit_together_is_refused_and_leaves_nothing(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"out{suffix}"
    moved = {**COORDS, "x": replace(COORDS["x"], values=COORDS["x"].values + 0.05)}
    short = {**COORDS, "t": replace(COORDS["t"], values=COORDS["t"].values[:2])}
    first = (region("u"), VALUES["u"])
    with pytest.raises(InputError, match="variable v has another lon than the one before; write"):
        save_regions(path, [first, (region("v", moved), VALUES["v"])])
    two_steps = labelled_region(
        name="v", dtype=VALUES["v"].dtype, coords=short, shape=(2, *SHAPE[1:]), attributes={}
    )
    with pytest.raises(InputError, match="variable v has 2 of time, another 3; write"):
        save_regions(path, [first, (two_steps, VALUES["v"][:2])])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_two_of_one_name_and_missing_frames_leave_nothing(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    again = (region("u"), VALUES["u"])
    with pytest.raises(InputError, match="two variables would have the name u"):
        save_regions(path, [again, again])
    with pytest.raises(InputError, match="region 'v': only 2 frames came for its 3 steps"):
        save_regions(path, [again, (region("v"), VALUES["v"][:2])])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".npy", ".raw", ".vti", ".vtkhdf"])
def test_other_formats_hold_one(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    told = r"holds one variable, and there are 2; choose one, or use one of .h5, .*\.zarr"
    with pytest.raises(InputError, match=told):
        save_regions(path, [(region("u"), VALUES["u"]), (region("v"), VALUES["v"])])
    with pytest.raises(InputError, match=told):
        save_check(path, variables=2)
    assert list(tmp_path.iterdir()) == []
