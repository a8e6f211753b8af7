"""NumPy's .npy: every type and order of axes, exact sizes; every refusal."""

from __future__ import annotations

import itertools
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
from stored_series import VALUES as VALUES_RAW
from stored_series import assert_frames, frames, write_hdf5

from fhash_formats.errors import FhashError, InputError
from fhash_formats.readers.file_series import DTYPES, RawLayout
from fhash_formats.readers.registry import list_variables, open_series


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", "f2", "u1", ">i2", "u8"])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_of_every_type_and_order(tmp_path: Path, dtype: str, fortran: bool) -> None:
    values = (VALUES_RAW * 50).astype(dtype)
    np.save(tmp_path / "a.npy", np.asfortranarray(values) if fortran else values)
    np.testing.assert_array_equal(frames(tmp_path / "a.npy"), values)
    np.save(tmp_path / "b.npy", np.asfortranarray(values[0]) if fortran else values[0])
    np.testing.assert_array_equal(frames(tmp_path / "b.npy"), values[:1])


@pytest.mark.parametrize("order", list(itertools.permutations("tzyx"))[::2])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_with_any_order_of_axes(tmp_path: Path, order: tuple[str, ...], fortran: bool) -> None:
    stored = VALUES_RAW.transpose(["tzyx".index(axis) for axis in order])
    np.save(tmp_path / "a.npy", np.array(stored, order="F" if fortran else "C"))
    np.testing.assert_array_equal(frames(tmp_path / "a.npy", axes=",".join(order)), VALUES_RAW)


def test_npy_recognised_by_its_magic(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES_RAW)
    os.rename(tmp_path / "a.npy", tmp_path / "a.data")
    with open_series(tmp_path / "a.data") as series:
        assert (series.name, series.units, series.attributes) == ("a", "", {})
        assert all(
            np.array_equal(series.coords[axis].values, np.arange(length))
            for axis, length in zip("tzyx", VALUES_RAW.shape, strict=True)
        )


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.full((2, 2, 2), None), "Python objects"),
        (np.zeros((2, 2, 2), bool), "boolean.*mask"),
        (np.full((2, 2, 2), "word"), "text"),
        (np.zeros((2, 2, 2), "M8[s]"), "dates"),
        (np.zeros(()), "0 dimensions"),
        (np.zeros(2), "1 dimensions"),
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


@pytest.mark.parametrize("order", ["C", "F"])
def test_components_of_vectors_are_selected(tmp_path: Path, order: Any) -> None:
    values = np.arange(4 * 5 * 6 * 7 * 3, dtype=np.float32).reshape(4, 5, 6, 7, 3)
    np.save(tmp_path / "a.npy", np.asarray(values, order=order))
    with pytest.raises(InputError, match=r"5 dimensions \(dim0=4, .*--select dim4=0 \(dim4 has 3"):
        open_series(tmp_path / "a.npy")
    for name, index in (("dim4", 2), ("4", 2), ("-1", -1)):
        assert_frames(tmp_path / "a.npy", values[..., 2], select={name: index})
    assert_frames(tmp_path / "a.npy", values[1:2, ..., 0], select={"dim0": 1, "dim4": 0})
    assert_frames(
        tmp_path / "a.npy",
        values[:, 2, ..., 1][:, None],
        select={"dim1": 2, "dim4": 1},
        axes="t,y,x",
    )
    with pytest.raises(InputError, match=r"--select dim4=3 is outside the indices 0\.\.2"):
        open_series(tmp_path / "a.npy", select={"dim4": 3})
    with pytest.raises(InputError, match=r"no dimension 'c'; its dimensions are dim0=4"):
        open_series(tmp_path / "a.npy", select={"c": 3})


@pytest.mark.parametrize(("last", "asked"), [(1, False), (2, True), (9, True), (10, False)])
def test_a_short_last_axis_is_asked_about(tmp_path: Path, last: int, asked: bool) -> None:
    values = np.arange(4 * 11 * 12 * last, dtype=np.float32).reshape(4, 11, 12, last)
    np.save(tmp_path / "a.npy", values)
    if asked:
        with pytest.raises(
            InputError,
            match=rf"a is 4 steps of 11x12x{last} vertices \(--axes t,z,y,x\), or a 4x11x12 field"
            rf" of {last} components \(--select dim3=0\)",
        ):
            open_series(tmp_path / "a.npy")
    else:
        assert_frames(tmp_path / "a.npy", values)
    assert_frames(tmp_path / "a.npy", values, axes="t,z,y,x")
    assert_frames(tmp_path / "a.npy", values[None, ..., last - 1], select={"dim3": last - 1})
    commands = [
        line.split(".fhz")[1] for line in list_variables(tmp_path / "a.npy")[0].commands("a")
    ]
    assert commands == ([" --axes t,z,y,x", " --select dim3=0"] if asked else [""])


def test_a_last_axis_as_long_as_another_is_x(tmp_path: Path) -> None:
    for shape in ((20, 8, 30, 8), (20, 30, 7, 8), (8, 8, 8)):
        np.save(tmp_path / "a.npy", np.zeros(shape, np.float32))
        with open_series(tmp_path / "a.npy") as series:
            assert series.shape[-len(shape) :] == shape


@pytest.mark.parametrize("order", ["C", "F"])
def test_fields_of_structured_arrays_are_variables(tmp_path: Path, order: Any) -> None:
    state = np.zeros((4, 3, 5, 6), [("n", "i2"), ("gas", [("rho", ">f4"), ("v", "f8", (2,))])])
    state["gas"]["rho"] = VALUES_RAW
    state["gas"]["v"] = VALUES_RAW[..., None] * [1, 2]
    np.save(tmp_path / "state.npy", np.asarray(state, order=order))
    assert_frames(tmp_path / "state.npy", VALUES_RAW, var="state.gas.rho")
    assert_frames(
        tmp_path / "state.npy", (VALUES_RAW * 2).astype("f8"), var="v", select={"dim4": 1}
    )
    with pytest.raises(InputError, match=r"holds 2 variables: state\.n .*, state\.gas\.rho"):
        open_series(tmp_path / "state.npy")


@pytest.mark.parametrize(
    ("stored", "missing", "expected"),
    [
        ("f4", 1e20, "f4"),
        ("f8", -9999, "f8"),
        ("i2", -32768, "f4"),
        (">u2", 65535, "f4"),
        ("i4", -9999, "f8"),
        ("i8", 2**62 + 1, "f8"),
    ],
)
def test_missing_values_of_the_user(
    tmp_path: Path, stored: str, missing: float, expected: str
) -> None:
    values = np.arange(60).reshape(3, 4, 5).astype(stored)
    values[1, 2] = missing
    values[0, 0, 0] = 2**62 if stored == "i8" else 0
    np.save(tmp_path / "a.npy", values)
    wanted = np.where(values == np.array(missing, stored), np.nan, values.astype(expected))
    assert_frames(tmp_path / "a.npy", wanted.astype(expected)[None], missing=[missing, 7.5])
    with open_series(tmp_path / "a.npy", missing=[missing]) as series:
        assert series.fill == np.array(missing, stored).item()
        assert series.source_dtype == (
            None if "f" in stored else np.dtype(stored).newbyteorder("=")
        )
        assert np.isnan(series.read(0)[1, 2]).all()


def test_a_missing_value_that_the_type_cannot_hold_changes_nothing(tmp_path: Path) -> None:
    np.save(tmp_path / "b.npy", VALUES_RAW.astype("f2"))
    assert_frames(tmp_path / "b.npy", VALUES_RAW.astype("f2"), missing=[1e20])
    values = np.arange(60, dtype=np.uint8).reshape(1, 3, 4, 5)
    np.save(tmp_path / "a.npy", values)
    assert_frames(tmp_path / "a.npy", values, missing=[-9999, 1e20, float("nan"), 0.5])


def test_npz_is_refused_with_advice(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", v=VALUES_RAW)
    with pytest.raises(InputError, match=r"numpy.save"):
        open_series(tmp_path / "a.npz")


@pytest.mark.parametrize("change", [-1, 1, 8])
def test_npy_of_a_wrong_size_is_refused(tmp_path: Path, change: int) -> None:
    np.save(tmp_path / "a.npy", VALUES_RAW)
    size = (tmp_path / "a.npy").stat().st_size
    os.truncate(tmp_path / "a.npy", size + change)
    with pytest.raises(InputError, match=r"mmap length is greater|header promises") as caught:
        open_series(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_npy_with_a_broken_header_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES_RAW)
    data = bytearray((tmp_path / "a.npy").read_bytes())
    data[12:20] = b"\xff" * 8
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(InputError, match=r"cannot be read as \.npy"):
        open_series(tmp_path / "a.npy")


def test_a_complex_array_names_its_parts(tmp_path: Path) -> None:
    wave = VALUES_RAW * (1 + 2j)
    np.save(tmp_path / "a.npy", wave)
    with pytest.raises(InputError, match=r"--var a\.real and --var a\.imag$"):
        open_series(tmp_path / "a.npy")
    assert_frames(tmp_path / "a.npy", wave.imag, var="a.imag")


SHAPE = {"x": 6, "y": 5, "z": 3, "t": 4}


@pytest.mark.parametrize("name", [*DTYPES, *DTYPES.values()])
@pytest.mark.parametrize("endian", ["", "_be", "_le"])
def test_raw_layout_from_the_name(tmp_path: Path, name: str, endian: str) -> None:
    dtype = np.dtype(DTYPES.get(name, name)).newbyteorder(">" if endian == "_be" else "<")
    values = (VALUES_RAW * 50).astype(dtype)
    path = tmp_path / f"my_density_6x5x3x4_{name}{endian}.raw"
    path.write_bytes(values.tobytes())
    with open_series(path) as series:
        assert series.name == "my_density"
    np.testing.assert_array_equal(frames(path), values)


def test_raw_of_three_dimensions_is_one_step(tmp_path: Path) -> None:
    path = tmp_path / "6x5x3_float32_0007.raw"
    path.write_bytes(VALUES_RAW[0].tobytes())
    np.testing.assert_array_equal(frames(path), VALUES_RAW[:1])


@pytest.mark.parametrize("suffix", [".raw", ".bin", ".dat", ".whatever"])
def test_raw_layout_from_the_user(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(VALUES_RAW.astype(">f8").tobytes())
    np.testing.assert_array_equal(frames(path, raw=RawLayout(SHAPE, "float64", "big")), VALUES_RAW)
    path.write_bytes(VALUES_RAW[:, 0].tobytes())
    np.testing.assert_array_equal(
        frames(path, raw=RawLayout({"t": 4, "y": 5, "x": 6}, "f4")), VALUES_RAW[:, :1]
    )


def test_the_user_overrides_the_name(tmp_path: Path) -> None:
    path = tmp_path / "a_6x5x3x4_uint32_le.raw"
    path.write_bytes(VALUES_RAW.astype(">f4").tobytes())
    np.testing.assert_array_equal(frames(path, raw=RawLayout(dtype="f4", endian="big")), VALUES_RAW)
    np.testing.assert_array_equal(
        frames(path, raw=RawLayout())[0], VALUES_RAW.astype(">f4").view("<u4")[0]
    )


def test_raw_in_another_order(tmp_path: Path) -> None:
    path = tmp_path / "a_6x5x3x4_f4.raw"
    path.write_bytes(np.ascontiguousarray(VALUES_RAW.transpose(3, 2, 1, 0)).tobytes())
    np.testing.assert_array_equal(frames(path, axes="x,y,z,t"), VALUES_RAW)
    with pytest.raises(InputError, match="does not name the axes of the raw shape, t,z,y,x"):
        open_series(path, axes="z,y,x")


def test_raw_bytes_that_look_like_another_format(tmp_path: Path) -> None:
    values = np.frombuffer(b"\x89HDF\r\n\x1a\n", np.uint8).reshape(2, 2, 2)
    path = tmp_path / "a_2x2x2_uint8.raw"
    path.write_bytes(values.tobytes())
    np.testing.assert_array_equal(frames(path)[0], values)


@pytest.mark.parametrize(
    ("name", "layout", "words"),
    [
        (
            "a.raw",
            None,
            r"shape and type of the raw values is not known; name the file name_XxYxZ.*--shape",
        ),
        ("a.bin", RawLayout(shape=SHAPE), "the type of the raw values"),
        ("a.dat", RawLayout(dtype="f4"), "the shape of the raw values"),
        ("a_6x5x3x4_float33.raw", None, "'float33' is not a number type; allowed: uint8,"),
        (
            "a_6x5x3x4_f8.raw",
            None,
            r"has 1440 bytes; 4x3x5x6 \(t,z,y,x\) of float64 need exactly 2880",
        ),
        ("a_6x5x3_f4.raw", None, "need exactly 360; with t=4 the size would fit"),
        ("a_6x5x3x5_f4.raw", None, "has 1440 bytes.*exactly 1800"),
        ("a_6x5x0x4_f4.raw", None, "z=0; a length is at least 1"),
    ],
)
def test_raw_that_does_not_fit_is_refused(
    tmp_path: Path, name: str, layout: RawLayout | None, words: str
) -> None:
    (tmp_path / name).write_bytes(VALUES_RAW.tobytes())
    with pytest.raises(InputError, match=words):
        open_series(tmp_path / name, raw=layout)


def test_a_header_beside_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "part.raw").write_bytes(bytes(24))
    (tmp_path / "part.nhdr").write_text("NRRD0005\n")
    with pytest.raises(InputError, match=r"part\.nhdr may say it: give that file instead"):
        open_series(tmp_path / "part.raw")


tifffile = pytest.importorskip("tifffile")

RNG = np.random.default_rng(0)
VALUES = RNG.integers(0, 60_000, (4, 3, 5, 6)).astype("u2")


def write(path: Path, values: np.ndarray, **options: Any) -> Path:
    options = options if options.get("imagej") else {"photometric": "minisblack", **options}
    tifffile.imwrite(path, values, **options)
    return path


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"byteorder": ">"}, {"bigtiff": True}]
)
def test_pages_are_slices(tmp_path: Path, options: dict[str, Any], dtype: str) -> None:
    values = VALUES[0].astype(dtype)
    path = write(tmp_path / "a.tif", values, **options)
    with open_series(path) as series:
        assert (series.name, series.shape) == ("a", (1, *values.shape))
        np.testing.assert_array_equal(series.read(0), values)
    np.testing.assert_array_equal(frames(path, axes="t,y,x"), values[:, None])
    path = write(tmp_path / "b.tif", values[0], **options)
    np.testing.assert_array_equal(frames(path), values[None, :1])


def test_hyperstacks_of_imagej(tmp_path: Path) -> None:
    about = {"axes": "TZYX", "spacing": 3.0, "unit": "um", "finterval": 0.5}
    path = write(tmp_path / "a.tif", VALUES, imagej=True, resolution=(2, 4), metadata=about)
    with open_series(path) as series:
        for step in (3, 0, 1, 2):
            np.testing.assert_array_equal(series.read(step), VALUES[step])
        assert series.coords["t"].values.tolist() == [0, 0.5, 1, 1.5]
        assert series.coords["z"].values.tolist() == [0, 3, 6]
        assert series.coords["y"].values.tolist() == [0, 0.25, 0.5, 0.75, 1]
        assert series.coords["x"].values.tolist() == [0, 0.5, 1, 1.5, 2, 2.5]
        assert series.coords["x"].attributes == {"units": "um"}


def test_channels_are_variables(tmp_path: Path) -> None:
    channels = np.stack([VALUES, VALUES[::-1]], axis=2)
    path = write(tmp_path / "a.tif", channels, imagej=True, metadata={"axes": "TZCYX"})
    np.testing.assert_array_equal(frames(path, var="a.1"), VALUES[::-1])
    with pytest.raises(InputError, match=r"a\.0 .*a\.1 .*choose one with --var"):
        open_series(path)


def test_ome_axes_and_sizes(tmp_path: Path) -> None:
    about = {"axes": "TCZYX", "PhysicalSizeX": 0.25, "PhysicalSizeXUnit": "nm", "TimeIncrement": 2}
    channels = np.stack([VALUES, VALUES + 1], axis=1)
    path = write(tmp_path / "a.ome.tif", channels, metadata=about)
    with open_series(path, var="a.1") as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES + 1)
        assert series.coords["x"].values.tolist() == [0, 0.25, 0.5, 0.75, 1, 1.25]
        assert series.coords["x"].attributes == {"units": "nm"}
        assert series.coords["t"].values.tolist() == [0, 2, 4, 6]


def test_files_of_one_page_are_asked_about(tmp_path: Path) -> None:
    for number, plane in enumerate(VALUES[0]):
        write(tmp_path / f"s_{number}.tif", plane)
    with pytest.raises(InputError, match=r"3 files of one page each; .*--axes z,y,x.*--axes t,y,x"):
        open_series(tmp_path / "s_*.tif")
    with open_series(tmp_path / "s_*.tif", axes="z,y,x") as series:
        assert series.name == "s"
        assert len(series.files) >= 3
        np.testing.assert_array_equal(series.read(0), VALUES[0])
    np.testing.assert_array_equal(frames(tmp_path / "s_*.tif", axes="t,y,x"), VALUES[0][:, None])
    write(tmp_path / "s_3.tif", VALUES[0, 0, :3])
    with pytest.raises(InputError, match=r"s_3\.tif: its page is not uint16 \(5, 6\)"):
        frames(tmp_path / "s_*.tif", axes="z,y,x")


def test_files_of_stacks_are_steps(tmp_path: Path) -> None:
    for step, frame in enumerate(VALUES):
        write(tmp_path / f"a_{step}.tif", frame)
    np.testing.assert_array_equal(frames(tmp_path / "a_*.tif"), VALUES)


def test_colours_and_several_series_are_refused(tmp_path: Path) -> None:
    colours = RNG.integers(0, 255, (4, 5, 6, 3)).astype("u1")
    write(tmp_path / "a.tif", colours, photometric="rgb")
    with pytest.raises(InputError, match="colour pictures of 3 samples"):
        open_series(tmp_path / "a.tif")
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        file.write(VALUES[0], photometric="minisblack")
        file.write(VALUES[0, :, :3], photometric="minisblack")
    with pytest.raises(InputError, match="2 series of pages"):
        open_series(tmp_path / "b.tif")


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_cut_files_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path / "a.tif", VALUES[0], **options)
    whole = path.read_bytes()
    for length in (6, len(whole) // 2, len(whole) - 40):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as caught:
            frames(path)
        assert "\n" not in str(caught.value)


def test_tifffile_is_named_where_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.tif", VALUES[0])
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(
        ImportError, match=r"a\.tif: TIFF needs tifffile: pip install 'fhash\[formats\]'"
    ):
        open_series(path)


PLAIN = np.arange(2 * 3 * 4 * 5, dtype="<f4").reshape(2, 3, 4, 5) + 1
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


def deep(path: Path, other: str) -> None:
    """A link in a file inside the folder that a first one refers to."""
    hdf5(path.with_name("inner.h5"), other)
    hdf5(path, "inner.h5")


def virtual(path: Path, other: str) -> None:
    layout = h5py.VirtualLayout(PLAIN.shape, "f4")
    layout[...] = h5py.VirtualSource(other, "u", PLAIN.shape)
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("u", layout)


def raw_file(path: Path, other: str) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("u", PLAIN.shape, "f4", external=[(other, 0, h5py.h5f.UNLIMITED)])


def text(form: str) -> Callable[[Path, str], None]:
    """A file that names the other where OTHER or, as a pattern of numbers, PATTERN stands."""

    def make(path: Path, other: str) -> None:
        named = form.replace("OTHER", other).replace("PATTERN", other.replace("s0.", "s%d."))
        path.write_text(named)

    return make


PVTI = """<VTKFile type="PImageData"><PImageData WholeExtent="0 4 0 3 0 0">
<Piece Extent="0 4 0 3 0 0" Source="OTHER"/></PImageData></VTKFile>"""
PVD = """<VTKFile type="Collection"><Collection><DataSet timestep="0" file="OTHER"/></Collection>
</VTKFile>"""


def symbolic_link(path: Path, other: str) -> None:
    path.symlink_to(path.parent / other)


def zarr_link(path: Path, other: str) -> None:
    made = zarr.create_array(path, data=PLAIN, chunks=(1, 3, 4, 5))
    assert made.shape == PLAIN.shape
    chunk = path / "c" / "0" / "0" / "0" / "0"
    chunk.unlink()
    chunk.symlink_to(path.parent / other)


CASES: list[tuple[Callable[[Path, str], None], str, str]] = [
    (hdf5, "a.h5", "s0.h5"),
    (hdf5, "a.nc", "s0.h5"),
    (deep, "a.h5", "s0.h5"),
    (virtual, "a.h5", "s0.h5"),
    (raw_file, "a.h5", "s0.bin"),
    (text(f"{NRRD}data file: OTHER\n\n"), "a.nhdr", "s0.bin"),
    (text(f"{NRRD}data file: LIST\nOTHER\n"), "a.nhdr", "s0.bin"),
    (text(f"{NRRD}data file: PATTERN 0 0 1\n\n"), "a.nhdr", "s0.bin"),
    (text(f"{META}ElementDataFile = OTHER\n"), "a.mhd", "s0.bin"),
    (text(f"{META}ElementDataFile = PATTERN 0 0 1\n"), "a.mhd", "s0.bin"),
    (text(PVTI), "a.pvti", "s0.vti"),
    (text(PVD), "a.pvd", "s0.vti"),
    (text('{"files": [{"name": "OTHER", "time": 0}]}'), "a.vti.series", "s0.vti"),
    (symbolic_link, "a.npy", "s0.npy"),
]


def secrets(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    write_hdf5(folder / "s0.h5", u=PLAIN)
    (folder / "s0.bin").write_bytes(PLAIN.tobytes())
    (folder / "s0.vti").write_text(GRID)
    np.save(folder / "s0.npy", PLAIN)


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
    if form != "here" or make in (hdf5, virtual, raw_file):
        assert isinstance(caught.value, InputError)
        assert "outside its folder" in str(caught.value)
    if make in (hdf5, virtual, raw_file):
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
            assert series.read(0).ravel()[-1] in (PLAIN[0].ravel()[-1], 19)


def test_links_in_a_zarr_folder_are_not_followed(tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "upload"
    outside.mkdir()
    folder.mkdir()
    zarr.create_array(outside / "b.zarr", data=PLAIN, chunks=(1, 3, 4, 5))
    shutil.copy(outside / "b.zarr" / "c" / "0" / "0" / "0" / "0", outside / "chunk")
    zarr_link(folder / "a.zarr", "../outside/chunk")
    with open_series(folder / "a.zarr") as series:
        np.testing.assert_array_equal(series.read(0), PLAIN[0])
    with pytest.raises(InputError, match="outside its folder"):
        open_series(folder / "a.zarr", no_external=True)
    with pytest.raises(InputError, match="outside its folder"):
        list_variables(folder / "a.zarr", no_external=True)


def test_a_url_in_a_header_is_a_name_of_a_file(tmp_path: Path) -> None:
    secrets(tmp_path)
    (tmp_path / "a.nhdr").write_text(f"{NRRD}data file: file://{tmp_path}/s0.bin\n\n")
    for no_external in (False, True):
        with pytest.raises(InputError, match=r"is not there|outside"):
            open_series(tmp_path / "a.nhdr", no_external=no_external)
