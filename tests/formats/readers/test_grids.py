"""NIfTI, MRC, OpenDX and legacy VTK as the libraries that own these formats write them."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import mrcfile
import nibabel
import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.registry import list_variables, open_series

VALUES = np.random.default_rng(0).normal(size=(3, 4, 5, 6)).astype(np.float32)
"""(t, z, y, x)"""
AFFINE = np.array([[2.0, 0, 0, 10], [0, -3, 0, 20], [0, 0, 4, 30], [0, 0, 0, 1]])


def positions(path: Path, **wishes: Any) -> tuple[np.ndarray, dict[str, list[float]], list[str]]:
    """All values of a file, the first two positions along each axis, and the units of these."""
    with open_series(path, **wishes) as series:
        values = np.stack(list(series.frames()))
        ends = {axis: each.values[:2].tolist() for axis, each in series.coords.items()}
        units = [str(series.coords[axis].attributes.get("units", "")) for axis in "tzyx"]
    return values, ends, units


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        (nibabel.Nifti1Image, "nii"),
        (nibabel.Nifti1Image, "nii.gz"),
        (nibabel.Nifti2Image, "nii"),
        (nibabel.Nifti2Image, "nii.gz"),
        (nibabel.Nifti1Pair, "img"),
    ],
)
def test_nifti(tmp_path: Path, kind: Any, suffix: str) -> None:
    image = kind(VALUES.T, AFFINE)
    image.header.set_xyzt_units("mm", "msec")
    image.header["pixdim"][4] = 2.5
    image.to_filename(tmp_path / f"a.{suffix}")
    path = tmp_path / ("a.hdr" if suffix == "img" else f"a.{suffix}")
    values, ends, units = positions(path)
    np.testing.assert_array_equal(values, VALUES)
    assert ends == {"t": [0, 2.5], "z": [30, 34], "y": [20, 17], "x": [10, 12]}
    assert units == ["ms", "mm", "mm", "mm"]


def test_nifti_scaled_and_by_quaternions(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image((VALUES[0].T * 100).astype("i2"), AFFINE)
    image.header.set_slope_inter(0.5, 7)
    image.set_sform(None, code=0)
    image.set_qform(AFFINE, code=1)
    nibabel.save(image, tmp_path / "a.nii")
    values, ends, _ = positions(tmp_path / "a.nii")
    expected = nibabel.load(tmp_path / "a.nii").get_fdata().T
    np.testing.assert_array_equal(values[0], expected)
    np.testing.assert_allclose([ends[axis] for axis in "zyx"], [[30, 34], [20, 17], [10, 12]])
    with open_series(tmp_path / "a.nii", raw_values=True) as series:
        np.testing.assert_array_equal(series.read(0), (VALUES[0] * 100).astype("i2"))


def test_a_turned_grid_has_positions_of_its_own_and_says_so(tmp_path: Path) -> None:
    turned = AFFINE.copy()
    turned[:3, :3] = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]] @ AFFINE[:3, :3]
    nibabel.Nifti1Image(VALUES.T, turned).to_filename(tmp_path / "a.nii")
    with pytest.warns(FhashWarning, match="turned against"):
        _, ends, _ = positions(tmp_path / "a.nii")
    np.testing.assert_allclose([ends[axis] for axis in "zyx"], [[0, 4], [0, 3], [0, 2]])


@pytest.mark.parametrize("dtype", ["f4", "i1", "i2", "u2", "f2"])
@pytest.mark.parametrize("compression", [None, "gzip"])
def test_mrc(tmp_path: Path, dtype: str, compression: str | None) -> None:
    stored = (VALUES[0] * 20 + 100 * (dtype == "u2")).astype(dtype)
    path = tmp_path / ("a.map" if compression is None else "a.map.gz")
    with mrcfile.new(path, compression=compression) as file:
        file.set_data(stored)
        file.voxel_size = (1.5, 2.5, 3.5)
        file.header.origin = (1, 2, 3)
    values, ends, units = positions(path)
    np.testing.assert_array_equal(values[0], stored)
    assert ends == {"t": [0], "z": [3, 6.5], "y": [2, 4.5], "x": [1, 2.5]}
    assert units == ["", "angstrom", "angstrom", "angstrom"]


def test_mrc_of_other_axes_and_starts(tmp_path: Path) -> None:
    with mrcfile.new(tmp_path / "a.mrc") as file:
        file.set_data(VALUES[0])
        file.header.mapc, file.header.mapr, file.header.maps = 3, 2, 1
        file.header.nxstart = -2
        file.header.mx, file.header.my, file.header.mz = 4, 5, 6
        file.header.cella = (4.0, 10.0, 18.0)
    values, ends, _ = positions(tmp_path / "a.mrc")
    np.testing.assert_array_equal(values[0], VALUES[0].transpose(2, 1, 0))
    assert ends == {"t": [0], "z": [-6, -3], "y": [0, 2], "x": [0, 1]}


def cube(path: Path, orbitals: int = 1, *, sign: int = 1) -> np.ndarray:
    """A cube file as Gaussian writes it; its values (orbitals, x, y, z)."""
    values = np.stack([VALUES[0].T.astype("f8") * (n + 1) for n in range(orbitals)])
    atoms = 2 if orbitals == 1 else -2
    lines = ["a density", "made by hand", f"{atoms:5d} 1.000000 2.000000 3.000000"]
    for n, length in enumerate(values.shape[1:]):
        lines.append(f"{sign * length:5d}" + "".join(f"{0.5 * (n == m):12.6f}" for m in range(3)))
    lines += ["    8    0.0    0.1    0.2    0.3", "    1    0.0    1.1    0.2    0.3"]
    if orbitals > 1:
        lines += [f"{orbitals:5d}" + "".join(f"{n:5d}" for n in range(2)), "    2"]
    rows = np.moveaxis(values, 0, -1).reshape(values.shape[1] * values.shape[2], -1)
    for row in rows.tolist():
        for first in range(0, len(row), 6):
            lines.append("".join(f"{each:13.5E}" for each in row[first : first + 6]))
    path.write_text("\n".join(lines) + "\n")
    return values


def test_cube_of_a_density(tmp_path: Path) -> None:
    expected = cube(tmp_path / "a.cube")
    values, ends, units = positions(tmp_path / "a.cube")
    np.testing.assert_allclose(values[0], expected[0].T, rtol=1e-5)
    assert ends == {"t": [0], "z": [3, 3.5], "y": [2, 2.5], "x": [1, 1.5]}
    assert units == ["", "bohr", "bohr", "bohr"]
    data = (tmp_path / "a.cube").read_bytes()
    for end in range(0, len(data) - 14, 37):
        (tmp_path / "a.cube").write_bytes(data[:end])
        with pytest.raises(InputError):
            positions(tmp_path / "a.cube")


def test_cube_of_orbitals_in_angstrom(tmp_path: Path) -> None:
    expected = cube(tmp_path / "a.cube", 3, sign=-1)
    assert [each.name for each in list_variables(tmp_path / "a.cube")] == ["a.0", "a.1", "a.2"]
    values, _, units = positions(tmp_path / "a.cube", var="a.2")
    np.testing.assert_allclose(values[0], expected[2].T, rtol=1e-5)
    assert units[1:] == ["angstrom"] * 3


def dx(values: np.ndarray, data: bytes, kind: str) -> bytes:
    """An OpenDX file of an array (x, y, z)."""
    x, y, z = values.shape
    lines = [
        "# a comment",
        f"object 1 class gridpositions counts {x} {y} {z}",
        "origin 1 2 3",
        "delta 0.5 0 0",
        "delta 0 0.25 0",
        "delta 0 0 0.125",
        f"object 2 class gridconnections counts {x} {y} {z}",
        f"object 3 class array type {kind} data follows",
    ]
    end = b'\nattribute "dep" string "positions"\nobject "a" class field\n'
    return "\n".join(lines).encode() + b"\n" + data + end


@pytest.mark.parametrize("binary", [False, True])
def test_opendx(tmp_path: Path, binary: bool) -> None:
    values = VALUES[0].T.copy()
    text = "\n".join(f"{each:.9g}" for each in values.ravel()).encode()
    kind = f"float rank 0 items {values.size}" + (" lsb binary" if binary else "")
    data = values.astype("<f4").tobytes() if binary else text
    (tmp_path / "a.dx").write_bytes(dx(values, data, kind))
    found, ends, _ = positions(tmp_path / "a.dx")
    np.testing.assert_array_equal(found[0], VALUES[0])
    assert ends == {"t": [0], "z": [3, 3.125], "y": [2, 2.25], "x": [1, 1.5]}


def legacy(path: Path, *, even: bool, binary: bool, time: float) -> None:
    """A legacy file of the first step, with a vector, numbers of cells and a time, as of VTK."""

    def of(values: npt.ArrayLike, kind: str) -> bytes:
        array = np.asarray(values, kind).ravel()
        text = " ".join(str(each) for each in array).encode()
        return (array.tobytes() if binary else text) + b"\nMETADATA\nINFORMATION 0\n\n"

    axes = b"".join(
        b"%c_COORDINATES %d double\n" % (name, count) + of(np.arange(count) ** 2.0, ">f8")
        for name, count in zip(b"XYZ", (6, 5, 4), strict=True)
    )
    path.write_bytes(
        b"# vtk DataFile Version 5.1\nvtk output\n"
        + (b"BINARY\n" if binary else b"ASCII\n")
        + (b"DATASET STRUCTURED_POINTS\n" if even else b"DATASET RECTILINEAR_GRID\n")
        + (b"FIELD FieldData 1\nTimeValue 1 1 double\n" + of(time, ">f8"))
        + b"DIMENSIONS 6 5 4\n"
        + (b"SPACING 0.5 0.25 2\nORIGIN 1 2 3\n" if even else axes)
        + (b"CELL_DATA 60\nSCALARS cell%20id int\nLOOKUP_TABLE default\n")
        + of(np.arange(60), ">i4")
        + (b"POINT_DATA 120\nSCALARS rho float\nLOOKUP_TABLE default\n" + of(VALUES[0], ">f4"))
        + (b"FIELD FieldData 1\nvelocity 3 120 float\n")
        + of(VALUES.reshape(3, -1).T, ">f4")
    )


@pytest.mark.vtk
@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("binary", [True, False])
def test_vtk_reads_these_legacy_files(tmp_path: Path, even: bool, binary: bool) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOLegacy import vtkRectilinearGridReader, vtkStructuredPointsReader

    legacy(tmp_path / "a.vtk", even=even, binary=binary, time=4.25)
    reader: Any = vtkStructuredPointsReader() if even else vtkRectilinearGridReader()
    reader.SetFileName(str(tmp_path / "a.vtk"))
    reader.ReadAllVectorsOn()
    reader.ReadAllFieldsOn()
    reader.Update()
    grid = reader.GetOutput()
    assert grid.GetBounds() == ((1, 3.5, 2, 3, 3, 9) if even else (0, 25, 0, 16, 0, 9))
    for holder, name, expected in (
        (grid.GetPointData(), "rho", VALUES[0].ravel()),
        (grid.GetPointData(), "velocity", VALUES.reshape(3, -1).T),
        (grid.GetCellData(), "cell id", np.arange(60)),
        (grid.GetFieldData(), "TimeValue", [4.25]),
    ):
        np.testing.assert_array_equal(vtk_to_numpy(holder.GetArray(name)), expected)


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("binary", [True, False])
def test_legacy_vtk(tmp_path: Path, even: bool, binary: bool) -> None:
    path = tmp_path / "a.vtk"
    legacy(path, even=even, binary=binary, time=4.25)
    rounding = 0 if binary else 1e-5
    found, ends, _ = positions(path, var="rho")
    np.testing.assert_allclose(found[0], VALUES[0], rtol=rounding)
    squares = {"z": [0, 1], "y": [0, 1], "x": [0, 1]}
    expected = {"z": [3, 5], "y": [2, 2.25], "x": [1, 1.5]} if even else squares
    assert ends == {"t": [4.25], **expected}
    found = positions(path, var="velocity.y")[0]
    np.testing.assert_allclose(found[0], VALUES[1], rtol=rounding)
    found, ends, _ = positions(path, var="cell id")
    np.testing.assert_array_equal(found[0], np.arange(60).reshape(3, 4, 5))
    assert ends["x"] == ([1.25, 1.75] if even else [0.5, 2.5])
    names = {each.name for each in list_variables(path)}
    assert names == {"rho", "velocity.x", "velocity.y", "velocity.z", "cell id"}


def test_legacy_files_of_a_pattern_are_steps(tmp_path: Path) -> None:
    for step in range(3):
        legacy(tmp_path / f"run.{step:05d}.vtk", even=True, binary=True, time=step * 0.5)
    found, ends, _ = positions(tmp_path / "run.?????.vtk", var="rho")
    assert (found.shape, ends["t"]) == ((3, 4, 5, 6), [0, 0.5])


def test_other_legacy_grids_and_files_that_are_cut_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_bytes(b"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 0 float\n")
    with pytest.raises(InputError, match="POLYDATA; STRUCTURED_POINTS"):
        open_series(path)
    nibabel.Nifti1Image(VALUES.T, AFFINE).to_filename(tmp_path / "a.nii")
    with mrcfile.new(tmp_path / "a.mrc") as file:
        file.set_data(VALUES[0])
    legacy(tmp_path / "b.vtk", even=False, binary=True, time=0)
    for name in ("a.nii", "a.mrc", "b.vtk"):
        whole, cut = (tmp_path / name).read_bytes(), tmp_path / f"cut_{name}"
        for count in range(0, len(whole), 37):
            cut.write_bytes(whole[:count])
            try:
                with open_series(cut, var="rho" if name == "b.vtk" else None) as one:
                    frame = one.read(0)
            except InputError:
                continue
            # what lies behind a whole array of a legacy file tells nothing of it
            assert name == "b.vtk"
            np.testing.assert_array_equal(frame, VALUES[0])
    packed = gzip.compress((tmp_path / "a.nii").read_bytes())
    (tmp_path / "a.nii.gz").write_bytes(packed[: len(packed) // 2])
    with pytest.raises(InputError), open_series(tmp_path / "a.nii.gz") as one:
        one.read(2)
