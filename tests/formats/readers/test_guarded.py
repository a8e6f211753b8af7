"""Readers go by the bytes that are there, and open other files through one gate."""

from __future__ import annotations

import io
import os
import re
import shutil
import time
import warnings
from pathlib import Path
from typing import Any

import fsspec
import h5py
import nibabel
import numpy as np
import numpy.typing as npt
import pytest
import segyio
import tifffile
import zarr

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.cf import role_of_name
from fhash_formats.readers.images import quoted, vectors
from fhash_formats.readers.registry import list_variables, open_series
from fhash_formats.readers.simulations import Blocks
from fhash_formats.readers.stored_bytes import numbers_in_text
from fhash_formats.readers.variables import Variable, join
from fhash_formats.support.dates import clock, in_days

SOURCES = Path(__file__).parents[2] / "hard" / "fuzz" / "sources"
"""Sound files of each format that this project reads itself."""
LISTS = {"run.pvd", "run.vti.series", "whole.pvti", "files.nhdr"}
"""Those that name other files."""
OWN = sorted(path.name for path in SOURCES.iterdir())
NUMBERS = np.arange(60, dtype="f4").reshape(3, 4, 5)


def read_all(path: Path) -> None:
    """Read each variable of a file that can be one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        listed = list_variables(path)
        for each in listed:
            var = each.name if len(listed) > 1 else None
            if not each.problem and len(each.options) == 1:
                with open_series(path, var=var) as series:
                    series.read(series.shape[0] - 1)


@pytest.mark.parametrize("name", [name for name in OWN if name not in LISTS])
def test_sound_files_are_read_and_cut_ones_are_told(tmp_path: Path, name: str) -> None:
    path, data = tmp_path / name, (SOURCES / name).read_bytes()
    path.write_bytes(data)
    read_all(path)
    for share in (0.4, 0.8):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError, match=r"cut|need exactly") as caught:
            read_all(path)
        assert "\n" not in str(caught.value)


def write_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=NUMBERS, chunks=(1, 4, 5), compression="gzip")


def write_segy(path: Path) -> None:
    spec = segyio.spec()
    spec.sorting, spec.format, spec.samples = 2, 5, np.arange(4) * 4.0
    spec.ilines, spec.xlines = [1, 2], [5, 6]
    with segyio.create(path, spec) as file:
        for number in range(4):
            file.header[number] = {189: number // 2 + 1, 193: number % 2 + 5}
            file.trace[number] = np.zeros(4, "f4")


def write_zip(path: Path) -> None:
    with zarr.storage.ZipStore(path, mode="w") as store:
        array = zarr.create_array(store, shape=NUMBERS.shape, dtype="f4", chunks=(1, 4, 5))
        array[...] = NUMBERS


CUT = {
    "a.h5": write_hdf5,
    "a.nc": write_hdf5,
    "a.sgy": write_segy,
    "a.zip": write_zip,
    "a.tif": lambda path: tifffile.imwrite(path, NUMBERS, photometric="minisblack"),
    "b.tif": lambda path: tifffile.imwrite(
        path, NUMBERS, photometric="minisblack", compression="zlib"
    ),
}


@pytest.mark.parametrize("name", CUT)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_cut_files_of_libraries_are_told(tmp_path: Path, name: str, share: float) -> None:
    path = tmp_path / name
    CUT[name](path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match="cut") as caught:
        read_all(path)
    assert "\n" not in str(caught.value)


def test_nifti_without_an_affine_is_read(tmp_path: Path) -> None:
    """Its header of 64-bit numbers, as NIfTI-2 has it, was one that nobody may change."""
    image = nibabel.Nifti2Image(NUMBERS.T, None)
    image.header["pixdim"][1:4] = [2, 3, 4]
    image.to_filename(tmp_path / "a.nii")
    with open_series(tmp_path / "a.nii") as series:
        np.testing.assert_array_equal(series.read(0), NUMBERS)
        assert series.coords["x"].values[:2].tolist() == [0, 2]


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.Nifti2Pair])
def test_compressed_pairs_of_nifti(tmp_path: Path, kind: Any) -> None:
    kind(NUMBERS.T, np.eye(4)).to_filename(tmp_path / "a.img.gz")
    with open_series(tmp_path / "a.hdr.gz") as series:
        np.testing.assert_array_equal(series.read(0), NUMBERS)


def nifti_pair(folder: Path, outside: Path) -> str:
    nibabel.Nifti1Pair(NUMBERS.T, np.eye(4)).to_filename(folder / "a.img")
    shutil.move(folder / "a.img", outside / "a.img")
    (folder / "a.img").symlink_to(outside / "a.img")
    return "a.hdr"


def nrrd_header(folder: Path, outside: Path) -> str:
    (outside / "a.raw").write_bytes(NUMBERS.tobytes())
    (folder / "a.nhdr").write_text(
        "NRRD0004\ntype: float\ndimension: 3\nsizes: 5 4 3\nendian: little\nencoding: raw\n"
        f"data file: ../{outside.name}/a.raw\n"
    )
    return "a.nhdr"


def pieces(folder: Path, outside: Path) -> str:
    shutil.copy(SOURCES / "ascii.vti", outside / "a.vti")
    text = (SOURCES / "whole.pvti").read_text()
    (folder / "a.pvti").write_text(text.replace("a.vti", f"../{outside.name}/a.vti"))
    return "a.pvti"


def collection(folder: Path, outside: Path) -> str:
    shutil.copy(SOURCES / "ascii.vti", outside / "a.vti")
    text = (SOURCES / "run.pvd").read_text()
    (folder / "a.pvd").write_text(re.sub(r"[ab]\.vti", f"../{outside.name}/a.vti", text))
    return "a.pvd"


def pages(folder: Path, outside: Path) -> str:
    for number in (0, 1):
        tifffile.imwrite(outside / f"s{number}.tif", NUMBERS[number])
        (folder / f"s{number}.tif").symlink_to(outside / f"s{number}.tif")
    return "s*.tif"


def array_of_a_group(folder: Path, outside: Path) -> str:
    """An array whose positions are in a neighbour: a link to a folder elsewhere."""
    group = zarr.open_group(folder / "g.zarr", mode="w", zarr_format=2)
    array = group.create_array("v", shape=NUMBERS.shape, dtype="f4")
    array[...] = NUMBERS
    array.attrs["_ARRAY_DIMENSIONS"] = ["z", "y", "x"]
    line = zarr.create_array(outside / "z", shape=(3,), dtype="f4", zarr_format=2)
    line[...] = [1, 2, 3]
    line.attrs["_ARRAY_DIMENSIONS"] = ["z"]
    (folder / "g.zarr" / "z").symlink_to(outside / "z")
    return "g.zarr/v"


@pytest.mark.parametrize(
    "write", [nifti_pair, nrrd_header, pieces, collection, pages, array_of_a_group]
)
def test_no_reader_leaves_the_folder_of_its_file(tmp_path: Path, write: Any) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    place = inside / write(inside, outside)
    wishes: dict[str, Any] = {"axes": "z,y,x"} if write is pages else {}
    if write in (pieces, collection):
        wishes["var"] = "n"
    open_series(place, **wishes).close()
    with pytest.raises(InputError, match="outside its folder"):
        open_series(place, no_external=True, **wishes)


def test_hdf5_at_a_url_reads_no_file_of_this_machine(tmp_path: Path) -> None:
    """HDF5 opens raw files by their names, wherever the file itself is."""
    (tmp_path / "secret.raw").write_bytes(NUMBERS.tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        external = [(str(tmp_path / "secret.raw"), 0, NUMBERS.nbytes)]
        file.create_dataset("v", NUMBERS.shape, "f4", external=external)
    with fsspec.open("memory://a.h5", "wb") as written:
        written.write((tmp_path / "a.h5").read_bytes())
    with open_series("memory://a.h5") as series:
        np.testing.assert_array_equal(series.read(0), NUMBERS)
    with pytest.raises(InputError, match=r"refers to .*secret\.raw, a file of this machine"):
        open_series("memory://a.h5", no_external=True)


def test_tables_and_positions_are_bounded(tmp_path: Path) -> None:
    """Nobody wrote them, so that a file of 3 kB promises 8 GiB."""
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset("v", (1 << 30, 1, 1, 1), "f4", chunks=(1 << 20, 1, 1, 1))
        file.create_dataset("time", (1 << 30,), "f8", chunks=(1 << 20,))
        file["time"].make_scale("time")
        file["v"].dims[0].attach_scale(file["time"])
    with pytest.raises(InputError, match=r"1073741824 .*possible"):
        open_series(tmp_path / "a.nc")


def test_the_work_on_a_text_grows_with_its_length() -> None:
    """Each took seconds for a header of 64 kB, or minutes."""
    many, start = 60_000, time.process_time()
    assert clock({"units": f"days since 2000{' ' * many}x"}) is None
    assert in_days([0], {"units": f"months since 2000{' ' * many}x"}) is None
    assert role_of_name("1" * many + "x") is None
    assert join(
        [Variable(name="_" * many + "/v", shape=(2, 2), dtype=np.dtype("f4"))], lambda path: {}
    )
    assert quoted('"' + '\\"' * many) == []
    with pytest.raises(InputError):
        vectors("( " * many)
    assert time.process_time() - start < 1


def test_labels_of_nrrd() -> None:
    assert quoted('"a" "b c" "" "d\\"e" "f\\\\"') == ["a", "b c", "", 'd\\"e', "f\\\\"]
    assert quoted("none") == []


def test_nested_blocks_are_refused_at_once() -> None:
    """The time did not grow with their number alone, but with its square."""
    many = 1 << 20
    firsts = np.zeros((many, 1), np.int64)
    with pytest.raises(InputError, match="overlap"):
        Blocks(firsts, np.arange(1, many + 1)[:, None])


def test_numbers_in_text_are_read_in_parts(tmp_path: Path) -> None:
    """A number may lie across two parts."""
    values = np.random.default_rng(0).normal(size=120_000)
    path = tmp_path / "a.txt"
    path.write_text(", ".join(map(repr, values.tolist())))
    size = path.stat().st_size
    assert size > 2 << 20
    with path.open("rb") as file:
        found = numbers_in_text(file, size, np.dtype("f8"), len(values))
        np.testing.assert_array_equal(found, values)
        for count in (len(values) - 1, len(values) + 1):
            file.seek(0)
            with pytest.raises(InputError, match="120000 numbers"):
                numbers_in_text(file, size, np.dtype("f8"), count)


def test_a_file_at_a_url_that_changes_is_named() -> None:
    """The server tells its state; nothing else changes it."""

    def put(values: npt.NDArray[Any]) -> None:
        data = io.BytesIO()
        with h5py.File(data, "w") as file:
            file.create_dataset("v", data=values)
        with fsspec.open("memory://changing.h5", "wb") as written:
            written.write(data.getvalue())

    put(NUMBERS)
    with open_series("memory://changing.h5") as series:
        series.read(0)
        series.check()
        put(NUMBERS + 1)
        with pytest.raises(InputError, match=r"changing\.h5 changed while it was being read"):
            series.check()


def test_a_chunk_that_was_cut_is_a_change_and_no_damage(tmp_path: Path) -> None:
    array = zarr.create_array(
        tmp_path / "a.zarr", shape=(3, 2, 40, 40), chunks=(1, 2, 40, 40), dtype="f4"
    )
    array[...] = np.random.default_rng(0).normal(size=array.shape)
    with open_series(tmp_path / "a.zarr") as series:
        series.read(0)
        os.truncate(tmp_path / "a.zarr" / "c" / "2" / "0" / "0" / "0", 99)
        series.read(1)
        with pytest.raises(InputError, match="changed while it was being read"):
            series.read(2)
