"""`no_external`: no file outside the folder of the one that is read, whatever refers to it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from fhash_formats.errors import FhashError, InputError
from fhash_formats.readers.registry import list_variables, open_series

VALUES = np.arange(2 * 3 * 4 * 5, dtype="<f4").reshape(2, 3, 4, 5) + 1
GRID = (
    '<VTKFile type="ImageData"><ImageData WholeExtent="0 4 0 3 0 0"><Piece Extent="0 4 0 3 0 0">'
    '<PointData><DataArray type="Float32" Name="u" format="ascii">{}</DataArray></PointData>'
    "</Piece></ImageData></VTKFile>"
).format(" ".join(map(str, range(20))))
NRRD = "NRRD0004\ntype: float\ndimension: 4\nsizes: 5 4 3 2\nencoding: raw\nendian: little\n"
META = "NDims = 4\nDimSize = 5 4 3 2\nElementType = MET_FLOAT\n"


def hdf5(path: Path, other: str) -> None:
    with h5py.File(path, "w") as file:
        file["u"] = h5py.ExternalLink(other, "u")


def netcdf(path: Path, other: str) -> None:
    hdf5(path, other)


def deep(path: Path, other: str) -> None:
    """A link in a file inside the folder that a first one refers to."""
    hdf5(path.with_name("inner.h5"), other)
    hdf5(path, "inner.h5")


def virtual(path: Path, other: str) -> None:
    layout = h5py.VirtualLayout(VALUES.shape, "f4")
    layout[...] = h5py.VirtualSource(other, "u", VALUES.shape)
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("u", layout)


def raw_file(path: Path, other: str) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("u", VALUES.shape, "f4", external=[(other, 0, h5py.h5f.UNLIMITED)])


def nrrd(path: Path, other: str) -> None:
    path.write_text(f"{NRRD}data file: {other}\n\n")


def nrrd_list(path: Path, other: str) -> None:
    path.write_text(f"{NRRD}data file: LIST\n{other}\n")


def nrrd_pattern(path: Path, other: str) -> None:
    path.write_text(f"{NRRD}data file: {other.replace('0', '%d')} 0 0 1\n\n")


def metaimage(path: Path, other: str) -> None:
    path.write_text(f"{META}ElementDataFile = {other}\n")


def metaimage_pattern(path: Path, other: str) -> None:
    path.write_text(f"{META}ElementDataFile = {other.replace('0', '%d')} 0 0 1\n")


def pvti(path: Path, other: str) -> None:
    path.write_text(
        '<VTKFile type="PImageData"><PImageData WholeExtent="0 4 0 3 0 0">'
        f'<Piece Extent="0 4 0 3 0 0" Source="{other}"/></PImageData></VTKFile>'
    )


def pvd(path: Path, other: str) -> None:
    path.write_text(
        '<VTKFile type="Collection"><Collection><DataSet timestep="0"'
        f' file="{other}"/></Collection></VTKFile>'
    )


def listed_json(path: Path, other: str) -> None:
    path.write_text(json.dumps({"files": [{"name": other, "time": 0}]}))


def symbolic_link(path: Path, other: str) -> None:
    path.symlink_to(path.parent / other)


def zarr_link(path: Path, other: str) -> None:
    made = zarr.create_array(path, data=VALUES, chunks=(1, 3, 4, 5))
    assert made.shape == VALUES.shape
    chunk = path / "c" / "0" / "0" / "0" / "0"
    chunk.unlink()
    chunk.symlink_to(path.parent / other)


CASES: list[tuple[Callable[[Path, str], None], str, str]] = [
    (hdf5, "a.h5", "s0.h5"),
    (netcdf, "a.nc", "s0.h5"),
    (deep, "a.h5", "s0.h5"),
    (virtual, "a.h5", "s0.h5"),
    (raw_file, "a.h5", "s0.bin"),
    (nrrd, "a.nhdr", "s0.bin"),
    (nrrd_list, "a.nhdr", "s0.bin"),
    (nrrd_pattern, "a.nhdr", "s0.bin"),
    (metaimage, "a.mhd", "s0.bin"),
    (metaimage_pattern, "a.mhd", "s0.bin"),
    (pvti, "a.pvti", "s0.vti"),
    (pvd, "a.pvd", "s0.vti"),
    (listed_json, "a.vti.series", "s0.vti"),
    (symbolic_link, "a.npy", "s0.npy"),
]


def secrets(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    with h5py.File(folder / "s0.h5", "w") as file:
        file["u"] = VALUES
    (folder / "s0.bin").write_bytes(VALUES.tobytes())
    (folder / "s0.vti").write_text(GRID)
    np.save(folder / "s0.npy", VALUES)


@pytest.mark.parametrize(("make", "name", "other"), CASES)
@pytest.mark.parametrize("form", ["relative", "absolute", "here"])
def test_files_outside_the_folder_are_not_read(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    make: Callable[[Path, str], None],
    name: str,
    other: str,
    form: str,
) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "upload"
    secrets(outside)
    folder.mkdir()
    if form == "here":  # HDF5 looks in the current folder too
        monkeypatch.chdir(outside)
    path = folder / name
    make(
        path, {"relative": f"../outside/{other}", "absolute": str(outside / other)}.get(form, other)
    )
    with pytest.raises(FhashError) as caught:
        open_series(path, no_external=True)
    if form != "here" or make in (hdf5, netcdf, virtual, raw_file):
        assert isinstance(caught.value, InputError)
        assert "outside its folder" in str(caught.value)
    if make in (hdf5, netcdf, virtual, raw_file):
        with pytest.raises(InputError, match="outside its folder"):
            list_variables(path, no_external=True)


@pytest.mark.parametrize(("make", "name", "other"), CASES)
def test_files_inside_the_folder_are_read(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    make: Callable[[Path, str], None],
    name: str,
    other: str,
) -> None:
    secrets(tmp_path)
    monkeypatch.chdir(tmp_path)  # where HDF5 looks for raw files
    make(tmp_path / name, other)
    for options in ({}, {"no_external": True}):
        with open_series(tmp_path / name, **options) as series:
            assert series.read(0).ravel()[-1] in (VALUES[0].ravel()[-1], 19)


def test_links_in_a_zarr_folder_are_not_followed(tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "upload"
    outside.mkdir()
    folder.mkdir()
    zarr.create_array(outside / "b.zarr", data=VALUES, chunks=(1, 3, 4, 5))
    shutil.copy(outside / "b.zarr" / "c" / "0" / "0" / "0" / "0", outside / "chunk")
    zarr_link(folder / "a.zarr", "../outside/chunk")
    with open_series(folder / "a.zarr") as series:
        np.testing.assert_array_equal(series.read(0), VALUES[0])
    with pytest.raises(InputError, match="outside its folder"):
        open_series(folder / "a.zarr", no_external=True)
    with pytest.raises(InputError, match="outside its folder"):
        list_variables(folder / "a.zarr", no_external=True)


def test_a_url_in_a_header_is_a_name_of_a_file(tmp_path: Path) -> None:
    secrets(tmp_path)
    nrrd(tmp_path / "a.nhdr", f"file://{tmp_path}/s0.bin")
    for no_external in (False, True):
        with pytest.raises(InputError, match=r"is not there|outside"):
            open_series(tmp_path / "a.nhdr", no_external=no_external)
