"""The filter of HDF5: h5py keeps the promise for every type and shape, and other tools read it."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from rarely import rarely

from fhash_formats.errors import InputError
from fhash_formats.hdf5 import FILTER, Transform
from fhash_formats.native import FOLDER, crc32c
from fhash_formats.transform.tile import decode_chunk

TYPES = ("float32", "float16", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32")
TYPES += ("int64", "uint64", ">f4", ">f8", ">i2", ">u8")
SHAPES = ((7,), (9, 11), (5, 9, 11), (3, 5, 9, 11), (2, 2, 3, 5, 9), (2, 1, 2, 3, 5, 9))
PROMISES: tuple[dict[str, Any], ...] = (
    {"max_error": 2},
    {"max_error": 0},
    {"max_error_rel": 0.02, "effort": 1},
    {"step": 3, "effort": 4},
)


def noise(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """A random walk along x, with gaps in floats, and in integers the ends of the type."""
    generator, kind = np.random.default_rng(0), np.dtype(dtype)
    walk = generator.normal(scale=3, size=shape).cumsum(axis=-1) + 40
    values = walk.astype(kind)
    if kind.kind == "f":
        values.flat[::17] = np.nan
    elif kind.itemsize == 8:
        values.flat[::5] = np.iinfo(kind).max
    return values


def store(path: Path, values: npt.NDArray[Any], promise: Transform, **words: Any) -> None:
    chunks = tuple(max(1, n // 2) for n in values.shape)
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=values, **{"chunks": chunks, **promise, **words})


def run(*words: object, code: int = 0) -> str:
    """Output and errors of a program of the system; the test skips where it is not installed."""
    if shutil.which(str(words[0])) is None:
        pytest.skip(f"{words[0]} is not installed")
    done = subprocess.run(
        [str(word) for word in words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "HDF5_PLUGIN_PATH": str(FOLDER)},
    )
    assert done.returncode == code, done.stdout
    return done.stdout


def assert_kept(decoded: npt.NDArray[Any], values: npt.NDArray[Any], bound: float) -> None:
    assert decoded.dtype == values.dtype
    if values.dtype.kind == "f":
        assert np.array_equal(np.isnan(decoded), np.isnan(values))
        errors = np.abs(decoded.astype("f8") - values.astype("f8"))
    else:
        errors = np.where(decoded > values, decoded - values, values - decoded)
    assert np.nanmax(errors, initial=0) <= bound


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("shape", [SHAPES[3], *rarely(*SHAPES[:3], *SHAPES[4:])], ids=len)
def test_values_are_kept_within_the_bound(
    dtype: str, shape: tuple[int, ...], tmp_path: Path
) -> None:
    values = noise(shape, dtype)
    for promise in PROMISES:
        store(tmp_path / "a.h5", values, Transform(**promise))
        with h5py.File(tmp_path / "a.h5") as file:
            decoded, chunks = file["v"][...], file["v"].chunks
        bound = promise.get("max_error", 100)
        if "max_error_rel" in promise:
            span = float(np.nanmax(values)) - float(np.nanmin(values))
            bound = promise["max_error_rel"] * span
        assert_kept(decoded, values, bound)
        assert chunks is not None


@pytest.mark.parametrize("dtype", ["float32", "int16", ">f4", "uint64"])
def test_a_chunk_is_a_stream_of_the_codec(dtype: str, tmp_path: Path) -> None:
    values = noise((4, 6, 12, 20), dtype)
    store(tmp_path / "a.h5", values, Transform(max_error=1), chunks=(2, 6, 12, 20))
    with h5py.File(tmp_path / "a.h5") as file:
        data = file["v"]
        mask, stream = data.id.read_direct_chunk((2, 0, 0, 0))
        decoded = decode_chunk(stream, (2, 6, 12, 20), values.dtype)
        assert mask == 0
        assert decoded.tobytes() == data[2:].tobytes()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.full((30, 40), 2.5, "f4"), {}),
        (np.full((30, 40), np.nan), {}),
        (np.zeros((1, 1), "i2"), {"chunks": (1, 1)}),
        (noise((30, 40), "f8"), {"fillvalue": np.nan, "maxshape": (None, None)}),
        (noise((3, 700), "i4"), {"fillvalue": -9, "chunks": (2, 512), "shuffle": False}),
    ],
    ids=["constant", "nothing", "one", "grown", "edges"],
)
def test_odd_chunks(values: npt.NDArray[Any], words: dict[str, Any], tmp_path: Path) -> None:
    store(tmp_path / "a.h5", values, Transform(max_error=0.5), **words)
    with h5py.File(tmp_path / "a.h5") as file:
        assert_kept(file["v"][...], values, 0.5)


@pytest.mark.parametrize("bound", [{"max_error": 0.02}, {"max_error_rel": 0.01}, {"step": 0.05}])
@pytest.mark.parametrize(
    ("fill", "words"),
    [
        (-1e20, {"fillvalue": -1e20}),
        (0.5, {"fillvalue": 0.5}),  # among the values
        (np.nan, {"fillvalue": np.nan}),
        (9.969209968386869e36, {}),  # an attribute says it, which no filter sees
        (-999, {}),
        (0.5, {"missing": [0.5]}),
        (0.25, {"missing": [0.5, 0.25], "fillvalue": -1}),
    ],
)
@pytest.mark.parametrize("kind", ["<f4", ">f8"])
def test_missing_values_come_back_and_weaken_no_bound(
    fill: float, words: dict[str, Any], bound: dict[str, float], kind: str, tmp_path: Path
) -> None:
    y, x = np.mgrid[0:20, 0:30]
    values = (np.sin(x / 7) * np.cos(y / 5)).astype(kind)
    gone = (np.abs(y - 9) < 4) & (np.abs(x - 12) < 9)
    values[gone] = fill
    words, missing = dict(words), words.get("missing", ())
    words.pop("missing", None)
    store(tmp_path / "a.h5", values, Transform(**bound, missing=missing), chunks=(12, 30), **words)
    with h5py.File(tmp_path / "a.h5") as file:
        found = file["v"][...]
    assert found[gone].tobytes() == values[gone].tobytes()
    error = np.abs(found - values)[~gone].max()
    assert error <= {"max_error": 0.02, "max_error_rel": 0.02}.get(next(iter(bound)), 0.2)


def test_packed_numbers_keep_their_fill_value(tmp_path: Path) -> None:
    y, x = np.mgrid[0:20, 0:30]
    values = (4000 * np.sin(x / 7) * np.cos(y / 5)).astype("i2")
    values[3:9, 4:20] = 17
    store(tmp_path / "a.h5", values, Transform(max_error=9), chunks=(20, 30), fillvalue=17)
    with h5py.File(tmp_path / "a.h5") as file:
        found = file["v"][...]
    assert np.array_equal(found == 17, values == 17)
    assert np.abs(found.astype(int) - values).max() <= 9


@pytest.mark.parametrize("fill", [-999, None])
def test_rows_that_nobody_wrote_yet_are_the_fill_value(fill: float | None, tmp_path: Path) -> None:
    values = np.nan_to_num(noise((21, 11, 13), "f4") / 50 - 3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset(
            "v",
            shape=(2, 11, 13),
            maxshape=(None, 11, 13),
            chunks=(7, 11, 13),
            dtype="f4",
            fillvalue=fill,
            **Transform(max_error=0.01),
        )
        for end in (3, 9, 21):
            data.resize(end, 0)
            data[end - 2 : end, :6] = values[end - 2 : end, :6]
        found = data[...]
    written = np.zeros(values.shape, bool)
    for end in (3, 9, 21):
        written[end - 2 : end, :6] = True
    assert (found[~written] == (fill or 0)).all()
    assert np.abs(found - values)[written].max() <= 0.01


def test_a_copy_of_a_dataset_knows_its_missing_values(tmp_path: Path) -> None:
    """h5repack hands the numbers of the dataset on, whose fill value says nothing of others."""
    y, x = np.mgrid[0:20, 0:30]
    values = np.sin(x / 7 + y).astype("f4")
    values[y > 14] = 0.5
    store(tmp_path / "a.h5", values, Transform(max_error=0.01, missing=[0.5]), chunks=(20, 30))
    run("h5repack", "-l", "v:CHUNK=15x11", tmp_path / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5") as file:
        found = file["v"][...]
    assert np.array_equal(found == 0.5, values == 0.5)
    assert np.abs(found - values).max() <= 0.02


def test_missing_values_of_another_type_are_refused(tmp_path: Path) -> None:
    values = np.arange(600, dtype="i2").reshape(20, 30)
    with pytest.raises(ValueError, match=r"missing value -999\.5 is no number of the dataset"):
        store(tmp_path / "a.h5", values, Transform(max_error=1, missing=[-999.5]), chunks=(20, 30))
    with pytest.raises(InputError, match="9 missing values; at most 8"):
        Transform(max_error=1, missing=range(9))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"data": np.zeros(9, bool)}, "not text, compound types, enumerations, bool"),
        ({"data": np.zeros(9, "f4,i2")}, "only integers and floating numbers"),
        ({"data": np.zeros(9, "c8")}, "only integers and floating numbers"),
        ({"data": np.zeros(9, "S5")}, "only integers and floating numbers"),
        ({"shape": (1 << 28,), "dtype": "u1", "chunks": (1 << 28,)}, "at most 2\\^27"),
        ({"data": np.zeros(9), "compression_opts": ()}, "0 numbers are given; 5 are needed"),
        ({"data": np.zeros(9), "compression_opts": (2, 0, 0, 0, 2)}, "version 2 of the numbers"),
        ({"data": np.zeros(9), "compression_opts": (1, 0, 0, 0, 10)}, "effort 10; allowed"),
        ({"data": np.zeros(9), "compression_opts": (1, 0, 0, 2, 2)}, "bound is 0; .* above 0"),
        ({"data": np.zeros(9), "compression_opts": (1, 0, 0x7FF80000)}, "bound is nan"),
    ],
)
def test_what_cannot_be_coded_is_refused_when_the_dataset_is_made(
    words: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file, pytest.raises(ValueError, match=message):
        file.create_dataset("v", **{"chunks": True, **Transform(max_error=1), **words})


@pytest.mark.parametrize("words", [{}, {"max_error": 1, "step": 1}, {"max_error": -1}])
def test_a_promise_that_is_none_is_refused(words: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Transform(**words)


def test_xarray_writes_and_reads_it(tmp_path: Path) -> None:
    values = noise((4, 20, 30), "f4")
    source = xr.Dataset({"v": (("t", "y", "x"), values)})
    encoding = {"v": {**Transform(max_error=0.25), "chunksizes": (2, 20, 30)}}
    source.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=encoding)
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as found:
        assert_kept(found["v"].values, values, 0.25)


@pytest.mark.parametrize("first", range(2))
def test_a_damaged_chunk_is_an_error_and_never_a_crash(first: int, tmp_path: Path) -> None:
    generator = np.random.default_rng(first)
    values = noise((4, 12, 20), ("f4", "i2")[first])
    store(tmp_path / "a.h5", values, Transform(max_error=0.5), chunks=(4, 12, 20))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        sound = file["v"].id.read_direct_chunk((0, 0, 0))[1]
        for number in range(300):
            bad = bytearray(sound)
            if number % 3 == 0:
                bad = bad[: generator.integers(len(bad))]
            elif number % 3 == 1:
                bad[generator.integers(len(bad))] ^= 1 << generator.integers(8)
            else:  # the checksum is right, so that the decoder sees what is damaged
                bad[4 + generator.integers(len(bad) - 4)] = generator.integers(256)
                bad[:4] = crc32c(bytes(bad[4:])).to_bytes(4, "little")
            file["v"].id.write_direct_chunk((0, 0, 0), bytes(bad))
            file["v"].id.refresh()
            try:
                file["v"][...]
            except OSError:
                continue
            assert number % 3 == 2 or bytes(bad) == sound
        file["v"].id.write_direct_chunk((0, 0, 0), sound[:5])
    shown = run("h5dump", "--enable-error-stack", tmp_path / "a.h5", code=1)
    assert "fhash(): fhash: " in shown


def test_damaged_numbers_of_a_dataset_are_an_error(tmp_path: Path) -> None:
    values = noise((2, 6, 7), "f4")
    store(tmp_path / "a.h5", values, Transform(max_error=0.5), chunks=(2, 6, 7))
    data = bytearray((tmp_path / "a.h5").read_bytes())
    shape = struct.pack("<4I", 1, 2, 6, 7)
    assert data.count(shape) == 1
    data[data.index(shape) + 4] = 1  # HDF5 would read beyond the half that is decoded
    (tmp_path / "b.h5").write_bytes(data)
    with h5py.File(tmp_path / "b.h5") as file, pytest.raises(OSError, match=r"filter|damaged"):
        file["v"][...]


def test_hdf5_tools_read_and_write(tmp_path: Path) -> None:
    values = np.arange(600, dtype="f4").reshape(20, 30) / 7
    store(tmp_path / "a.h5", values, Transform(max_error=0.25))
    place = ["-d", "v", "-s", "3,0", "-c", "1,4", "-m", "%.9g"]
    shown = run("h5dump", "-p", *place, tmp_path / "a.h5")
    assert f"FILTER_ID {FILTER}" in shown
    assert "COMMENT fhash.transform" in shown
    numbers = re.findall(r" [-.0-9e]+(?=,|$)", shown.split("DATA {")[1], re.MULTILINE)
    with h5py.File(tmp_path / "a.h5") as file:
        assert [np.float32(each) for each in numbers] == list(file["v"][3, :4])
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        file.create_dataset("v", data=values, chunks=(5, 30))
    opts = ",".join(map(str, Transform(max_error=0.125)["compression_opts"]))
    run("h5repack", "-f", f"v:UD={FILTER},0,5,{opts}", tmp_path / "plain.h5", tmp_path / "b.h5")
    run("h5repack", "-l", "v:CHUNK=7x11", tmp_path / "b.h5", tmp_path / "c.h5")
    for name, bound in (("b", 0.125), ("c", 0.25)):
        with h5py.File(tmp_path / f"{name}.h5") as file:
            assert str(FILTER) in file["v"]._filters
            assert_kept(file["v"][...], values, bound)


def test_a_program_with_hdf5_linked_into_it_says_why_it_cannot_write(tmp_path: Path) -> None:
    """Its functions are out of reach: a stand-in for HDF5 makes a dataset with the filter."""
    source = Path(__file__).with_name("static_hdf5.c")
    links = [f"-L{FOLDER}", "-lfhash", f"-Wl,-rpath,{FOLDER}"]
    run("gcc", "-std=c99", "-Wall", "-Werror", source, "-o", tmp_path / "program", *links)
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "refused\n")
    (line,) = done.stderr.splitlines()
    assert line.startswith("fhash: H5Pfill_value_defined is not found: this program has HDF5")
    assert "h5cc -shlib" in line


@pytest.mark.parametrize("before", [None, "", "/a/folder"])
def test_libraries_loaded_later_find_the_plugin(before: str | None) -> None:
    """The HDF5 of netCDF4 reads the variable when it is loaded."""
    script = "import os, fhash_formats.hdf5; print(os.environ['HDF5_PLUGIN_PATH'])"
    variables = {**os.environ, **({} if before is None else {"HDF5_PLUGIN_PATH": before})}
    if before is None:
        variables.pop("HDF5_PLUGIN_PATH", None)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=variables
    )
    first, *_, last = done.stdout.strip().split(os.pathsep)
    assert Path(last) == FOLDER
    assert first == ("/usr/local/hdf5/lib/plugin" if before is None else before)


def test_netcdf_tools_read_and_write(tmp_path: Path) -> None:
    if shutil.which("nc-config") is None or shutil.which("gcc") is None:
        pytest.skip("libnetcdf-dev or gcc is not installed")
    flags = run("nc-config", "--cflags", "--libs").split()
    source = Path(__file__).with_name("netcdf_program.c")
    run("gcc", "-std=c99", "-Wall", "-Werror", source, "-o", tmp_path / "program", *flags)
    total = float(run(tmp_path / "program", tmp_path / "a.nc"))
    with h5py.File(tmp_path / "a.nc") as file:
        assert str(FILTER) in file["v"]._filters
        decoded = file["v"][...]
    assert total == pytest.approx(float(decoded.sum(dtype="f8")), rel=1e-8)
    t, y, x = np.meshgrid(np.arange(3), np.arange(20), np.arange(30), indexing="ij")
    assert_kept(decoded, (x * y / 64 + t).astype("f4"), 0.01)
    shown = run("ncdump", "-s", "-p", "9", tmp_path / "a.nc")
    assert f'v:_Filter = "{FILTER},1,' in shown
    numbers = shown.split("v =\n")[1].split(";")[0].split(",")
    assert np.array_equal(np.array(numbers, "f4"), decoded.ravel())
    run("nccopy", "-F", f"v,{FILTER},1,0.5d,0,1", tmp_path / "a.nc", tmp_path / "b.nc")
    with h5py.File(tmp_path / "b.nc") as file:
        assert file["v"]._filters[str(FILTER)][1:5] == (0, 0x3FE00000, 0, 1)
        assert_kept(file["v"][...], decoded, 0.5)
