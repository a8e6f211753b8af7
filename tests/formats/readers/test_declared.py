"""Declarations of formats on their numbers hold: hidden places, signs, valid ranges, dates."""

from __future__ import annotations

import struct
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
import segyio
import tifffile

from fhash_codec import EncodeConfig, encode
from fhash_codec import open as open_container
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.registry import open_series
from fhash_formats.support.dates import in_days

NUMBERS = np.arange(24).reshape(2, 3, 4)
"""(z, y, x)"""


def read(path: Path, **wishes: Any) -> np.ndarray:
    """All frames of a file, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        with open_series(path, **wishes) as series:
            return np.stack(list(series.frames()))


def words(values: npt.ArrayLike) -> str:
    return " ".join(map(str, np.ravel(values).tolist()))


def legacy(folder: Path, ghosts: dict[str, np.ndarray], *, cells: bool) -> Path:
    place, extra = ("CELL", 1) if cells else ("POINT", 0)
    text = "# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET STRUCTURED_POINTS\n"
    text += f"DIMENSIONS {4 + extra} {3 + extra} {2 + extra}\nORIGIN 0 0 0\nSPACING 1 1 1\n"
    text += f"{place}_DATA 24\nSCALARS n int 1\nLOOKUP_TABLE default\n{words(NUMBERS)}\n"
    for name, values in ghosts.items():
        text += f"FIELD more 1\n{name} 1 24 unsigned_char\n{words(values)}\n"
    path = folder / "a.vtk"
    path.write_text(text)
    return path


def xml(folder: Path, ghosts: dict[str, np.ndarray], *, cells: bool) -> Path:
    place, extra = ("CellData", 1) if cells else ("PointData", 0)
    extent = f"0 {3 + extra} 0 {2 + extra} 0 {1 + extra}"
    arrays = {"n": ("Int32", NUMBERS)} | {name: ("UInt8", each) for name, each in ghosts.items()}
    inside = "".join(
        f'<DataArray type="{kind}" Name="{name}" format="ascii">{words(values)}</DataArray>'
        for name, (kind, values) in arrays.items()
    )
    path = folder / "a.vti"
    path.write_text(
        f'<VTKFile type="ImageData"><ImageData WholeExtent="{extent}" Origin="0 0 0"'
        f' Spacing="1 1 1"><Piece Extent="{extent}"><{place}>{inside}</{place}></Piece>'
        "</ImageData></VTKFile>"
    )
    return path


def hdf(folder: Path, ghosts: dict[str, np.ndarray], *, cells: bool) -> Path:
    extra = int(cells)
    path = folder / "a.vtkhdf"
    with h5py.File(path, "w") as file:
        group = file.create_group("VTKHDF")
        group.attrs["Type"] = np.bytes_("ImageData")
        group.attrs["WholeExtent"] = [0, 3 + extra, 0, 2 + extra, 0, 1 + extra]
        group.attrs["Origin"], group.attrs["Spacing"] = [0.0, 0, 0], [1.0, 1, 1]
        for name, values in {"n": NUMBERS.astype("i4"), **ghosts}.items():
            group[f"{'CellData' if cells else 'PointData'}/{name}"] = values
    return path


@pytest.mark.parametrize("write", [legacy, xml, hdf])
@pytest.mark.parametrize(
    ("name", "cells", "bits"),
    [
        ("vtkGhostType", False, 2),
        ("vtkGhostType", True, 32),
        ("vtkGhostType", True, 32 | 1),
        ("avtGhostZones", True, 32),
        ("avtGhostNodes", False, 2),
    ],
)
def test_hidden_places_of_vtk_are_missing(
    tmp_path: Path, write: Callable[..., Path], name: str, cells: bool, bits: int
) -> None:
    hidden = NUMBERS % 5 == 0
    found = read(write(tmp_path, {name: (bits * hidden).astype("u1")}, cells=cells))
    np.testing.assert_array_equal(found[0], np.where(hidden, np.nan, NUMBERS))


@pytest.mark.parametrize("write", [legacy, xml, hdf])
@pytest.mark.parametrize(("name", "bits"), [("vtkGhostType", 1), ("vtkGhostLevels", 2)])
def test_duplicates_of_vtk_are_sound(
    tmp_path: Path, write: Callable[..., Path], name: str, bits: int
) -> None:
    """An array of other bits hides nothing, and is none of the variables."""
    ghosts = {name: (bits * (NUMBERS % 5 == 0)).astype("u1")}
    np.testing.assert_array_equal(read(write(tmp_path, ghosts, cells=True))[0], NUMBERS)


def test_points_without_values_of_a_resampling_are_missing(tmp_path: Path) -> None:
    valid = (NUMBERS > 3).astype("u1")
    found = read(xml(tmp_path, {"vtkValidPointMask": valid}, cells=False))
    np.testing.assert_array_equal(found[0], np.where(valid, NUMBERS, np.nan))


def test_hidden_integers_of_vtk_stay_integers_in_a_container(tmp_path: Path) -> None:
    hidden = NUMBERS % 5 == 0
    path = legacy(tmp_path, {"vtkGhostType": (2 * hidden).astype("u1")}, cells=False)
    encode(path, tmp_path / "a.fhz", EncodeConfig(max_error=0, effort=1))
    with open_container(tmp_path / "a.fhz") as container:
        np.testing.assert_array_equal(container[...][0], np.where(hidden, np.nan, NUMBERS))


def mrc(path: Path, stored: np.ndarray, **words: float) -> Path:
    """An MRC file of mode 0. words: numbers of the header by their place, `at152` and so on."""
    head = bytearray(1024)
    struct.pack_into("<4i", head, 0, *stored.shape[::-1], 0)
    struct.pack_into("<3i", head, 28, *stored.shape[::-1])
    struct.pack_into("<3i", head, 64, 1, 2, 3)
    head[208:216] = b"MAP DD\0\0"
    for name, number in words.items():
        form = "<f" if isinstance(number, float) else "<i"
        struct.pack_into(form, head, int(name[2:]), number)
    path.write_bytes(bytes(head) + stored.tobytes())
    return path


IMOD = {"at152": 1146047817}


@pytest.mark.parametrize(
    ("words", "unsigned"),
    [
        ({**IMOD, "at156": 0}, True),
        ({**IMOD, "at156": 1}, False),
        ({**IMOD, "at156": 1, "at76": 0.0, "at80": 255.0}, False),
        ({"at76": 0.0, "at80": 209.0}, True),
        ({"at76": -100.0, "at80": 127.0}, False),
        ({"at76": 0.0, "at80": 127.0}, False),
        ({"at76": 255.0, "at80": 0.0}, False),  # nobody set them
        ({}, False),
    ],
)
def test_bytes_of_mrc(tmp_path: Path, words: dict[str, float], unsigned: bool) -> None:
    stored = np.arange(210, dtype="u1").reshape(5, 6, 7)
    found = read(mrc(tmp_path / "a.mrc", stored, **words))
    np.testing.assert_array_equal(found[0], stored if unsigned else stored.view("i1"))


def test_mrc_of_half_bytes_is_refused_and_volumes_are_steps(tmp_path: Path) -> None:
    stored = np.arange(120, dtype="u1").reshape(4, 5, 6)
    with pytest.raises(InputError, match="mode 0"):
        open_series(mrc(tmp_path / "a.mrc", stored, **IMOD, at156=16))
    path = mrc(tmp_path / "b.mrc", stored, at88=401, at36=2)
    with open_series(path) as series:
        assert series.shape == (2, 2, 5, 6)


@pytest.mark.parametrize(("flags", "version", "first"), [(0, 0, -3), (4, 0, 3), (0, 20140, 3)])
def test_the_origin_of_imod(tmp_path: Path, flags: int, version: int, first: float) -> None:
    """Before it wrote that of MRC2014, IMOD wrote the place of the axes in the grid."""
    stored = np.zeros((2, 2, 2), "u1")
    path = mrc(tmp_path / "a.mrc", stored, **IMOD, at156=flags, at108=version, at196=3.0)
    with open_series(path) as series:
        assert series.coords["x"].values[0] == first


def test_cells_of_other_angles_are_told(tmp_path: Path) -> None:
    path = mrc(tmp_path / "a.mrc", np.zeros((2, 2, 2), "u1"), at52=90.0, at56=105.0, at60=90.0)
    with pytest.warns(FhashWarning, match="angles 90, 105, 90"):
        open_series(path).close()


def netcdf(path: Path, values: np.ndarray, **attributes: Any) -> Path:
    with h5py.File(path, "w") as file:
        file["v"] = values
        file["v"].attrs.update(attributes)
    return path


VALID = np.array([[[[-999.0, 0, 1], [2, 3, 50]]]], "f4")


@pytest.mark.parametrize(
    ("values", "attributes", "count"),
    [
        (VALID, {"valid_min": np.float32(-10)}, 1),
        (VALID, {"valid_range": np.array([-10, 10], "f4")}, 2),
        (VALID, {"valid_range": np.array([-999, 50], "f4")}, 0),
        (VALID, {"valid_min": np.float32(-10), "_FillValue": np.float32(-999)}, 0),
        (VALID, {"valid_min": "none"}, 0),
        # packed numbers, in packed terms and in those of the values
        (VALID.astype("i2"), {"valid_max": np.int16(10), "scale_factor": np.float32(0.01)}, 1),
        (VALID.astype("i2"), {"valid_max": np.float32(0.1), "scale_factor": np.float32(0.01)}, 1),
        (VALID.astype("i2"), {"valid_range": np.array([-10, 10], "i2"), "scale_factor": -0.5}, 2),
        # unsigned numbers in a type with a sign: -6 stands for 250
        (
            np.array([[[[1, 250, 255]]]], "u1").view("i1"),
            {"_Unsigned": "true", "valid_max": np.int8(-6)},
            1,
        ),
    ],
)
def test_values_outside_the_valid_range_are_told(
    tmp_path: Path, values: np.ndarray, attributes: dict[str, Any], count: int
) -> None:
    """They are data, as in xarray; one line says how many there are."""
    path = netcdf(tmp_path / "a.nc", values, **attributes)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with open_series(path, keep_extremes=True) as series:
            encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0, effort=1))
    lines = [str(each.message) for each in told if "valid range" in str(each.message)]
    assert len(lines) == bool(count)
    assert not count or f"({count}) are outside" in lines[0]


@pytest.mark.parametrize(
    ("units", "values", "days", "since"),
    [
        ("day as %Y%m%d.%f", [20010131, 20010201.25, 20010301], [0, 1.25, 29], "2001-01-31"),
        ("month as %Y%m.%f", [200101, 200102.5], [0, 45], "2001-01-01"),
        ("year as %Y.%f", [2000.5, 2001], [0, 183], "2000-07-02"),
        ("YYYYMMDD", [20010131, 20010201], [0, 1], "2001-01-31"),
        ("common_years since 1990-01-01", [0, 1], [0, 365], "1990-01-01"),
    ],
)
def test_dates_written_as_numbers(
    tmp_path: Path, units: str, values: list[float], days: list[float], since: str
) -> None:
    path, calendar = tmp_path / "a.nc", "noleap" if "common" in units else "standard"
    with h5py.File(path, "w") as file:
        file["v"] = np.zeros((len(values), 2, 2, 2), "f4")
        file["time"] = np.array(values)
        file["time"].make_scale("time")
        file["v"].dims[0].attach_scale(file["time"])
        file["time"].attrs.update(units=units, calendar=calendar)
    with pytest.warns(FhashWarning, match="it is read as days"):
        series = open_series(path)
    with series:
        np.testing.assert_allclose(series.coords["t"].values, days, rtol=0, atol=1e-9)
        assert series.coords["t"].attributes["units"] == f"days since {since}"


@pytest.mark.parametrize("number", [0.0, 20010230, 20011301])
def test_numbers_that_are_no_dates(number: float) -> None:
    assert in_days([number], {"units": "day as %Y%m%d.%f"}) is None
    assert in_days([0, 1], {"units": "common_years since 1990-01-01"}) is None  # of noleap alone


def test_missing_values_have_several_names(tmp_path: Path) -> None:
    values = np.array([[[[-1, 2, -9999, 5]]]], "f4")
    for attributes in (
        {"MissingValue": np.float32(-9999)},
        {"CodeMissingValue": "-9999"},
        {"FillValue": np.array([-9999, 5], "f4")},
    ):
        path = netcdf(tmp_path / "a.h5", values, **attributes)
        assert np.isnan(read(path)[0, 0, 0, 2]), attributes


def test_scales_of_no_convention_are_told(tmp_path: Path) -> None:
    path = netcdf(tmp_path / "a.h5", VALID, ScaleFactor=0.5, Offset=0.0)
    with pytest.warns(FhashWarning, match=r"has ScaleFactor = 0\.5, which no convention"):
        open_series(path).close()
    open_series(netcdf(tmp_path / "b.h5", VALID, ScaleFactor=1.0, Offset=0.0)).close()


def test_signed_numbers_of_imagej_and_tags_of_gdal(tmp_path: Path) -> None:
    stored = np.arange(60, dtype="u2").reshape(3, 4, 5)
    line = {"axes": "ZYX", "cf": 0, "c0": -32768.0, "c1": 1.0}
    tifffile.imwrite(tmp_path / "a.tif", stored, imagej=True, metadata=line)
    np.testing.assert_array_equal(read(tmp_path / "a.tif")[0], stored.astype("i4") - 32768)
    line = {"axes": "ZYX", "cf": 0, "c0": 1.0, "c1": 0.5, "vunit": "K"}
    tifffile.imwrite(tmp_path / "b.tif", stored, imagej=True, metadata=line)
    with open_series(tmp_path / "b.tif") as series:
        assert series.units == "K"
        np.testing.assert_array_equal(series.read(0), stored * 0.5 + 1)
    tags = [(42113, "s", 0, "7", True)]
    tifffile.imwrite(
        tmp_path / "c.tif", stored, photometric="minisblack", metadata=None, extratags=tags
    )
    np.testing.assert_array_equal(
        read(tmp_path / "c.tif")[0], np.where(stored == 7, np.nan, stored)
    )
    tifffile.imwrite(tmp_path / "d.tif", stored, photometric="miniswhite")
    with pytest.warns(FhashWarning, match="0 is white"):
        open_series(tmp_path / "d.tif").close()


def test_dead_traces_are_missing(tmp_path: Path) -> None:
    spec = segyio.spec()
    spec.sorting, spec.format, spec.samples = 2, 5, np.arange(4) * 4.0
    spec.ilines, spec.xlines = [1, 2], [5, 6, 7]
    with segyio.create(tmp_path / "a.sgy", spec) as file:
        for number in range(6):
            inline, crossline = divmod(number, 3)
            kind = {4: 2, 5: 3}.get(number, 1)
            file.header[number] = {189: inline + 1, 193: crossline + 5, 29: kind}
            file.trace[number] = np.full(4, number, "f4")
    expected = np.array([[0, 1, 2], [3, np.nan, np.nan]])
    np.testing.assert_array_equal(read(tmp_path / "a.sgy")[0], [expected] * 4)
    data = bytearray((tmp_path / "a.sgy").read_bytes())
    data[3224:3226] = b"\0\7"  # segyio takes unknown types for IBM's floats
    (tmp_path / "b.sgy").write_bytes(data)
    with pytest.raises(InputError, match="values are of type 7"):
        open_series(tmp_path / "b.sgy")


def nrrd(path: Path, values: np.ndarray, *lines: str) -> Path:
    kind = {"f4": "float", "i2": "short"}[values.dtype.str[1:]]
    head = [
        *("NRRD0004", f"type: {kind}", f"dimension: {values.ndim}", "encoding: raw"),
        f"sizes: {words(values.shape[::-1])}",
    ]
    path.write_bytes("\n".join([*head, *lines, "", ""]).encode() + values.tobytes())
    return path


LITTLE = "endian: little"


@pytest.mark.parametrize("place", [0, 3])
def test_a_sequence_of_slicer_is_time(tmp_path: Path, place: int) -> None:
    values = np.random.default_rng(0).normal(size=(4, 5, 6, 7)).astype("f4")  # (t, z, y, x)
    kinds, directions = ["domain"] * 3, ["(2,0,0)", "(0,3,0)", "(0,0,4)"]
    kinds.insert(place, "list")
    directions.insert(place, "none")
    path = nrrd(
        tmp_path / "a.seq.nrrd",
        np.ascontiguousarray(np.moveaxis(values, 0, 3 - place)),
        *(LITTLE, "space: left-posterior-superior", f"space directions: {' '.join(directions)}"),
        *(f"kinds: {' '.join(kinds)}", "space origin: (1,2,3)"),
        *(f"axis {place} index type:=numeric", f"axis {place} index values:=0 0.5 1 2"),
        f"axis {place} index unit:=s",
    )
    np.testing.assert_array_equal(read(path), values)
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [0, 0.5, 1, 2]
        assert series.coords["t"].attributes["units"] == "s"
        assert series.coords["x"].values[:2].tolist() == [1, 3]


def test_nrrd_says_its_byte_order_its_ends_and_that_it_was_quantised(tmp_path: Path) -> None:
    values = NUMBERS.astype("i2")
    with pytest.raises(InputError, match="byte order"):
        open_series(nrrd(tmp_path / "a.nrrd", values))
    path = nrrd(tmp_path / "b.nrrd", values, LITTLE, "axis mins: 1 0 0", "axis maxs: 9 6 2")
    with open_series(path) as series:
        assert series.coords["y"].values.tolist() == [0, 3, 6]
    centres = "centerings: cell cell cell"
    path = nrrd(
        tmp_path / "d.nrrd", values, LITTLE, "axis mins: 1 0 0", "axis maxs: 9 6 2", centres
    )
    with open_series(path) as series:
        assert series.coords["x"].values.tolist() == [2, 4, 6, 8]
    path = nrrd(tmp_path / "c.nrrd", values, LITTLE, "old min: -1", "old max: 1")
    with pytest.warns(FhashWarning, match="quantised from -1 to 1"):
        open_series(path).close()


def test_the_line_of_metaimage_is_applied(tmp_path: Path) -> None:
    head = "NDims = 3\nDimSize = 4 3 2\nElementType = MET_SHORT\n"
    head += "ElementToIntensityFunctionSlope = 0.5\nElementToIntensityFunctionOffset = -1\n"
    path = tmp_path / "a.mha"
    path.write_bytes(f"{head}ElementDataFile = LOCAL\n".encode() + NUMBERS.astype("<i2").tobytes())
    np.testing.assert_array_equal(read(path)[0], NUMBERS * 0.5 - 1)


WRITER = """
import sys, h5py
file = h5py.File(sys.argv[1], "w", libver="latest")
more = {"maxshape": (None, 3, 4, 5), "chunks": (1, 3, 4, 5), "dtype": "f4"}
file.create_dataset("v", shape=(2, 3, 4, 5), **more)[:] = 1
if sys.argv[2] == "swmr":
    file.swmr_mode = True
file.flush()
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("mode", ["swmr", "plain"])
def test_hdf5_that_another_program_is_writing(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "a.h5"
    command = [sys.executable, "-c", WRITER, str(path), mode]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        try:
            if mode == "swmr":
                assert read(path).shape == (2, 3, 4, 5)
            else:
                with pytest.raises(InputError, match="another program is writing it") as caught:
                    open_series(path)
                assert "h5clear" not in str(caught.value)
                assert "HDF5_USE_FILE_LOCKING" in str(caught.value)
        finally:
            writer.kill()
