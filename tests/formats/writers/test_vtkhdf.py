"""VTKHDF: all steps of an even grid in one file, as vtkHDFReader wants it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate
from fhash_formats.writers import Region, save_check, save_region

EVEN = {"t": [3.5, 4.0, 9.0], "z": [2.0, 2.5], "y": [-1.0, 0.0, 1.0, 2.0], "x": [10.0, 10.5, 11.0]}
DATA = np.arange(72, dtype="f4").reshape(3, 2, 4, 3)


def region(dtype: str = "f4", name: str = "wind", **axes: list[float]) -> Region:
    positions = {**EVEN, **axes}
    coords = {
        axis: Coordinate(name=axis, values=np.array(values)) for axis, values in positions.items()
    }
    t, z, y, x = (len(positions[axis]) for axis in "tzyx")
    return Region(name=name, units="m/s", dtype=np.dtype(dtype), shape=(t, z, y, x), coords=coords)


def test_the_structure_of_the_specification(tmp_path: Path) -> None:
    assert save_region(tmp_path / "out.vtkhdf", region(), DATA) == [tmp_path / "out.vtkhdf"]
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        group = file["VTKHDF"]
        assert group.attrs["Version"].tolist() == [2, 0]
        assert group.attrs["Type"] == b"ImageData"
        kind = h5py.h5a.open(group.id, b"Type").get_type()
        assert (kind.is_variable_str(), kind.get_cset(), kind.get_size()) == (
            False,
            h5py.h5t.CSET_ASCII,
            9,
        )
        assert group.attrs["WholeExtent"].tolist() == [0, 2, 0, 3, 0, 1]
        assert group.attrs["Origin"].tolist() == [10.0, -1.0, 2.0]
        assert group.attrs["Spacing"].tolist() == [0.5, 1.0, 0.5]
        assert group.attrs["Direction"].tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        steps = group["Steps"]
        assert steps.attrs["NSteps"] == 3
        assert steps["Values"][:].tolist() == EVEN["t"]
        assert steps["PointDataOffsets/wind"][:].tolist() == [0, 1, 2]
        values = group["PointData/wind"]
        np.testing.assert_array_equal(values, DATA)
        assert (values.dtype, values.attrs["units"]) == (np.dtype("<f4"), "m/s")


@pytest.mark.parametrize("turned", ["x", "yz", "xyz"])
def test_descending_axes_are_turned_round(tmp_path: Path, turned: str) -> None:
    axes = {axis: values[::-1] for axis, values in EVEN.items() if axis in turned}
    flipped = DATA[:, *(slice(None, None, -1 if axis in turned else 1) for axis in "zyx")]
    save_region(tmp_path / "out.vtkhdf", region(**axes), flipped)
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        np.testing.assert_array_equal(file["VTKHDF/PointData/wind"], DATA)
        assert file["VTKHDF"].attrs["Origin"].tolist() == [10.0, -1.0, 2.0]
        assert file["VTKHDF"].attrs["Spacing"].tolist() == [0.5, 1.0, 0.5]


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"x": [0.0, 1.0, 3.0]}, r"coordinate 'x' of x is not evenly spaced, as \.vtkhdf needs"),
        ({"z": [1.0, 1.0]}, "not evenly spaced"),
        ({"t": [0.0, np.nan, 1.0]}, "times are not all finite"),
    ],
)
def test_grids_that_it_cannot_hold(
    tmp_path: Path, axes: dict[str, list[float]], message: str
) -> None:
    for act in (
        lambda: save_region(tmp_path / "out.vtkhdf", region(**axes), DATA),
        lambda: save_check(tmp_path / "out.vtkhdf", False, region(**axes)),
    ):
        with pytest.raises(InputError, match=message) as caught:
            act()
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "u1", "i2", "i8"])
def test_vtk_reads_every_step(tmp_path: Path, dtype: str) -> None:
    io = pytest.importorskip("vtkmodules.vtkIOHDF")
    pipeline = pytest.importorskip(
        "vtkmodules.vtkCommonExecutionModel"
    ).vtkStreamingDemandDrivenPipeline
    arrays = pytest.importorskip("vtkmodules.util.numpy_support")
    data = DATA.astype(dtype)
    save_region(tmp_path / "out.vtkhdf", region(dtype, name="a/b"), data)
    reader = io.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "out.vtkhdf"))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(pipeline.TIME_STEPS())
    assert list(times) == EVEN["t"]
    for step, time in enumerate(times):
        reader.UpdateTimeStep(time)
        image = reader.GetOutputDataObject(0)
        assert image.GetDimensions() == (3, 4, 2)
        assert image.GetOrigin() == (10.0, -1.0, 2.0)
        assert image.GetSpacing() == (0.5, 1.0, 0.5)
        found = arrays.vtk_to_numpy(image.GetPointData().GetArray("a_b"))
        np.testing.assert_array_equal(found, data[step].ravel())


def test_one_step_of_one_vertex(tmp_path: Path) -> None:
    save_region(
        tmp_path / "out.vtkhdf", region(t=[1.0], z=[1.0], y=[2.0], x=[3.0]), DATA[:1, :1, :1, :1]
    )
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        assert file["VTKHDF"].attrs["Spacing"].tolist() == [1, 1, 1]
        assert file["VTKHDF/PointData/wind"].shape == (1, 1, 1)


@pytest.mark.parametrize("dtype", ["f4", "u1", "i8"])
def test_one_step_is_of_the_first_version(tmp_path: Path, dtype: str) -> None:
    data = DATA[1:2].astype(dtype)
    save_region(tmp_path / "out.vtkhdf", region(dtype, t=[4.0]), data)
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        group = file["VTKHDF"]
        assert group.attrs["Version"].tolist() == [1, 0]
        assert sorted(group) == ["FieldData", "PointData"]
        assert group["FieldData/TimeValue"][:].tolist() == [4.0]
    io = pytest.importorskip("vtkmodules.vtkIOHDF")
    arrays = pytest.importorskip("vtkmodules.util.numpy_support")
    reader = io.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "out.vtkhdf"))
    reader.Update()
    image = reader.GetOutputDataObject(0)
    assert image.GetDimensions() == (3, 4, 2)
    assert image.GetOrigin() == (10.0, -1.0, 2.0)
    found = arrays.vtk_to_numpy(image.GetPointData().GetArray("wind"))
    np.testing.assert_array_equal(found, data.ravel())
    assert image.GetFieldData().GetArray("TimeValue").GetTuple1(0) == 4.0
