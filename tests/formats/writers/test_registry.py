"""Every format: values are exact, frames come one at a time, files are complete or absent."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import nrrd
import numpy as np
import pytest
import regions
import xarray
from rarely import rarely
from regions import COORDS, READ, SHAPE, labelled_region, region_of

from fhash_formats.errors import (
    FhashError,
    InputError,
    MissingInputError,
    OutputError,
    OutputExistsError,
)
from fhash_formats.readers.registry import open_series
from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import WRITERS, save_check, save_region, save_regions

SUFFIXES = [suffix for writer in WRITERS for suffix in writer.suffixes]


def region(dtype: Any = "f4", shape: tuple[int, int, int, int] = SHAPE) -> Region:
    t, z, y, x = shape
    coords = {
        "t": Coordinate(name="time", values=347921.000277 + np.arange(t, dtype=np.float64)),
        "z": Coordinate(name="height", values=np.linspace(10.0, 20.0, z)),
        "y": Coordinate(name="lat", values=np.linspace(-1.0, 1.0, y)),
        "x": Coordinate(name="lon", values=np.linspace(0.1, 0.7, x)),
    }
    return Region(name="wind", dtype=np.dtype(dtype), shape=shape, coords=coords)


def values(dtype: Any = "f4", shape: tuple[int, int, int, int] = SHAPE) -> np.ndarray:
    made = (np.random.default_rng(7).normal(size=shape) * 40).astype(
        "i8" if np.dtype(dtype).kind != "f" else dtype
    )
    if made.dtype.kind == "f":
        made[0, 0, 0, :3] = np.nan, np.inf, -0.0
    return made.astype(dtype)


HALF = {".npy", ".h5", ".hdf5", ".zarr"}


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    "dtype",
    ["f4", "f2", ">i2", "u8", *rarely("f8", ">f4", "i1", "u1", "u2", "i4", "u4", "i8")],
)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_values_come_back_exactly(tmp_path: Path, suffix: str, dtype: str) -> None:
    data = values(dtype)
    paths = save_region(tmp_path / f"out{suffix}", region(dtype), iter(data))
    read = READ[suffix](paths)
    kept = np.dtype(dtype).newbyteorder("=")
    assert read.dtype.newbyteorder("=") == (
        kept if kept != np.float16 or suffix in HALF else np.float32
    )
    np.testing.assert_array_equal(read, data)
    if kept.kind == "f":
        assert np.signbit(read[0, 0, 0, 2])
    assert all(path.exists() for path in paths)
    assert not [name for name in names(tmp_path) if name.startswith(".")]


LAYOUTS = [
    *(values(shape=shape) for shape in [(1, 1, 1, 3), (1, 3, 1, 3), (2, 1, 4, 3), (1, 2, 3, 4)]),
    np.zeros((1, 1, 1, 1), "f4"),
    np.moveaxis(values(), 1, 3)[:, ::-1],
]


@pytest.mark.parametrize("data", LAYOUTS, ids=lambda data: "x".join(map(str, data.shape)))
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_axes_of_one_vertex_and_frames_that_are_views(
    tmp_path: Path, suffix: str, data: np.ndarray
) -> None:
    paths = save_region(tmp_path / f"out{suffix}", region(shape=data.shape), iter(data))
    np.testing.assert_array_equal(READ[suffix](paths), data)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_region_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        save_region(folder / f"out{suffix}", region(), values())
        written.append(
            [
                (name, (folder / name).read_bytes())
                for name in names(folder)
                if (folder / name).is_file()
            ]
        )
    assert written[0] == written[1]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_frame_is_gone_before_the_next_is_made(tmp_path: Path, suffix: str) -> None:
    alive: list[weakref.ref[np.ndarray]] = []

    def frames() -> Iterator[np.ndarray]:
        for step in range(6):
            assert not [frame for frame in alive if frame() is not None]
            frame = np.full((4, 5, 6), step, "f4")
            alive.append(weakref.ref(frame))
            yield frame
            del frame

    paths = save_region(tmp_path / f"out{suffix}", region(shape=(6, 4, 5, 6)), frames())
    assert len(alive) == 6
    np.testing.assert_array_equal(READ[suffix](paths)[:, 0, 0, 0], np.arange(6))


def broken(error: BaseException) -> Iterator[np.ndarray]:
    yield values()[0]
    raise error


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (ValueError("no"), ValueError),
        (MissingInputError("gone"), MissingInputError),
        (OSError(errno.EIO, "Input/output error"), InputError),
    ],
)
@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_interruption_leaves_what_was_there(
    tmp_path: Path, suffix: str, old: bool, error: BaseException, raised: type[BaseException]
) -> None:
    paths = save_region(tmp_path / f"out{suffix}", region(), values()) if old else []
    before = names(tmp_path)
    with pytest.raises(raised) as caught:
        save_region(tmp_path / f"out{suffix}", region(), broken(error), force=old)
    assert names(tmp_path) == before
    assert not isinstance(caught.value, OutputError)
    if old:
        np.testing.assert_array_equal(READ[suffix](paths), values())


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (lambda: values()[:2], "only 2 frames came for its 3 steps"),
        (lambda: [], "only 0 frames came for its 3 steps"),
        (lambda: [*values(), values()[0]], "more frames than its 3 steps"),
        (lambda: values()[:, :, :, :5], r"frame 0 is float32 \(4, 5, 5\); float32 \(4, 5, 6\)"),
        (lambda: [values()[0], values()[1].ravel()], r"frame 1 is float32 \(120,\)"),
        (lambda: values("f8"), r"frame 0 is float64"),
        (lambda: values("i4"), r"frame 0 is int32"),
    ],
)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_frames_that_do_not_fit_are_never_a_short_file(
    tmp_path: Path, suffix: str, frames: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        save_region(tmp_path / f"out{suffix}", region(), frames())
    assert names(tmp_path) == []


class Untouched:
    """Frames that must not be asked for."""

    def __iter__(self) -> Iterator[np.ndarray]:
        pytest.fail("no frame may be asked for")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_force_replaces_and_only_force(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    paths = save_region(path, region(), values())
    before = names(tmp_path)
    with pytest.raises(OutputExistsError, match="exists; use --force"):
        save_region(path, region(), Untouched())
    with pytest.raises(OutputExistsError, match="exists; use --force"):
        save_check(path, False, region())
    save_check(path, True, region())
    new = values() + 1
    assert save_region(path, region(), new, force=True) == paths
    assert names(tmp_path) == before
    np.testing.assert_array_equal(READ[suffix](paths), new)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        (
            "out.tiff",
            InputError,
            r"cannot write the suffix '\.tiff'; use one of \.npy, \.h5, .*\.pvd",
        ),
        ("out", InputError, "a name without a suffix; use one of"),
        ("missing/out.npy", OutputError, r"the folder .*missing does not exist"),
        ("folder.npy", OutputError, "is a directory"),
        ("folder.zarr", OutputError, "is a directory but no Zarr store"),
    ],
)
def test_what_can_be_refused_at_once(
    tmp_path: Path, name: str, error: type[FhashError], message: str
) -> None:
    (tmp_path / "folder.npy").mkdir()
    (tmp_path / "folder.zarr").mkdir()
    with pytest.raises(error, match=message):
        save_check(tmp_path / name, True)
    with pytest.raises(error, match=message):
        save_region(tmp_path / name, region(), Untouched(), force=True)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    paths = save_region(tmp_path / f"out{suffix}", region(), values())
    before = names(tmp_path)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)  # where a disk that allocates late says so
        with pytest.raises(OutputError, match="no space left on the disk"):
            save_region(tmp_path / f"out{suffix}", region(), values() + 1, force=True)
    assert names(tmp_path) == before
    np.testing.assert_array_equal(READ[suffix](paths), values())


FULL = """
import json, resource, sys
import numpy as np
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_region
from fhash_formats.errors import FhashError
from fhash_formats.series import Coordinate

shape = (8, 16, 16, 16)
coords = {axis: Coordinate(name=axis, values=np.arange(float(n))) for axis, n in zip("tzyx", shape)}
region = Region(name="wind", dtype=np.dtype("f4"), shape=shape, coords=coords)
data = np.random.default_rng(0).normal(size=shape).astype("f4")
seen = {}
sys.dont_write_bytecode = True  # the limit would cut what later imports of other tests read
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
for suffix in sys.argv[3:]:
    try:
        save_region(sys.argv[1] + "/out" + suffix, region, data)
    except FhashError as error:
        seen[suffix] = type(error).__name__ + ": " + str(error)
print(json.dumps(seen))
"""


@pytest.mark.parametrize("limit", [0, 1000, 8192])
def test_writes_that_the_system_refuses(tmp_path: Path, limit: int) -> None:
    # A process of its own that runs to its end: HDF5 crashed when it closed its files at exit.
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path), str(limit), *SUFFIXES],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert set(seen) == set(SUFFIXES)
    assert all(
        message.startswith("OutputError: ")
        and message.endswith("cannot be written: File too large")
        for message in seen.values()
    )
    assert names(tmp_path) == []


def test_importing_the_writers_is_cheap() -> None:
    code = (
        "import sys, fhash_formats; slow = ('h5py', 'zarr', 'xarray', 'h5netcdf', 'torch');"
        " print([name for name in slow if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_file_that_is_written_may_be_a_source(tmp_path: Path, suffix: str) -> None:
    data = values()
    paths = save_region(tmp_path / f"out{suffix}", region(), iter(data))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for path in paths:
        with pytest.raises(InputError, match="is the input itself"):
            save_check(tmp_path / f"out{suffix}", True, region(), [path])
        with pytest.raises(InputError, match="is the input itself"):
            save_region(tmp_path / f"out{suffix}", region(), iter(data), force=True, sources=[path])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    save_region(
        tmp_path / f"out{suffix}", region(), iter(data), force=True, sources=[tmp_path / "other"]
    )


@pytest.mark.parametrize("dtype", ["f2", "f4", "i2"])
def test_the_file_is_the_one_that_numpy_writes_whatever_the_case_of_the_suffix(
    tmp_path: Path, dtype: str
) -> None:
    values = np.nan_to_num(regions.DATA * 10).astype(dtype)
    region = labelled_region(dtype=np.dtype(dtype))
    (path,) = save_region(str(tmp_path / "OUT.NPY"), region, iter(values))
    np.save(tmp_path / "expected.npy", values)
    assert path.read_bytes() == (tmp_path / "expected.npy").read_bytes()


POSITIONS = {
    "t": [347921.000277, 347922.0],
    "z": [0.0, 0.25],
    "y": [3.0, 2.0, 1.0],
    "x": [1.0, 1.1, 1.2, 1.3],
}
DATA = np.arange(48, dtype="f4").reshape(2, 2, 3, 4)


def region_raw(positions: dict[str, list[float]] = POSITIONS, **changes: Any) -> Region:
    made = region_of(positions)
    coords = {axis: replace(each, name=f"{axis} name") for axis, each in made.coords.items()}
    coords["t"] = replace(coords["t"], name="time", attributes={"units": "hours"})
    return replace(made, **{"coords": coords, **changes})


def header(path: Path) -> dict[str, str]:
    lines = path.read_text().splitlines()
    assert lines[0] == "NRRD0005"
    assert lines[-1] == ""
    return dict(line.split(":=" if ":=" in line else ": ", 1) for line in lines[1:-1])


@pytest.mark.parametrize(
    ("name", "dtype", "steps"),
    [
        ("run_4x3x2x2_float32.raw", "<f4", 2),
        ("a_b_4x3x2x2_FLOAT32.RAW", "<f4", 2),
        ("run_4x3x2x2_float32_be.raw", ">f4", 2),
        ("run_4x3x2_float16.raw", "<f2", 1),
    ],
)
def test_a_name_that_says_the_layout_needs_nothing_beside_it(
    tmp_path: Path, name: str, dtype: str, steps: int
) -> None:
    data = DATA[:steps].astype(np.dtype(dtype).newbyteorder("="))
    times = POSITIONS["t"][:steps]
    (path,) = save_region(
        tmp_path / name, region_raw({**POSITIONS, "t": times}, dtype=data.dtype), data
    )
    np.testing.assert_array_equal(np.fromfile(path, dtype).reshape(data.shape), data)
    assert list(tmp_path.iterdir()) == [path]
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), data)


def test_a_type_that_there_is_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="v2"):
        save_region(tmp_path / "run_4x3x2x2_v2.raw", region_raw(), DATA)


@pytest.mark.parametrize(
    "name",
    [
        "run_2x2x3x4_float32.raw",
        "run_4x3x2_float32.raw",
        "run_4x3x2x2_float64.raw",
        "run_4x3x2x2_uint8.raw",
        "4x4x4_float32.raw",
    ],
)
def test_a_name_that_says_another_layout_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(
        InputError,
        match=r"the name says another layout than the values have; use \*_4x3x2x2_float32\.raw",
    ):
        save_region(tmp_path / name, region_raw(), DATA)
    assert list(tmp_path.iterdir()) == []


def test_a_header_beside_any_other_name(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.raw", region_raw(units="m/s"), DATA)
    assert paths == [tmp_path / "out.raw", tmp_path / "out.nhdr"]
    np.testing.assert_array_equal(np.fromfile(paths[0], "<f4").reshape(2, 2, 3, 4), DATA)
    np.testing.assert_array_equal(nrrd.read(str(paths[1]))[0].T, DATA)
    assert header(paths[1]) == {
        "content": "wind",
        "type": "float",
        "dimension": "4",
        "sizes": "4 3 2 2",
        "kinds": "space space space time",
        "space dimension": "3",
        "space directions": "(0.10000000000000002,0,0) (0,-1.0,0) (0,0,0.25) none",
        "space origin": "(1.0,3.0,0.0)",
        "endian": "little",
        "encoding": "raw",
        "sample units": "m/s",
        "data file": "out.raw",
        "name_t": "time",
        "units_t": "hours",
        "coordinates_t": "347921.000277 347922.0",
        "name_z": "z name",
        "coordinates_z": "0.0 0.25",
        "name_y": "y name",
        "coordinates_y": "3.0 2.0 1.0",
        "name_x": "x name",
        "coordinates_x": "1.0 1.1 1.2 1.3",
    }


def test_one_step_is_a_plain_volume_and_uneven_axes_have_no_place(tmp_path: Path) -> None:
    paths = save_region(
        tmp_path / "out.raw", region_raw({**POSITIONS, "t": [0.5], "y": [0.0, 1.0, 3.0]}), DATA[:1]
    )
    found = header(paths[1])
    assert (found["dimension"], found["sizes"], found["kinds"]) == (
        "3",
        "4 3 2",
        "space space space",
    )
    assert not [field for field in found if field.startswith("space")]
    assert found["coordinates_y"] == "0.0 1.0 3.0"


def test_text_cannot_break_the_header(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.raw", region_raw(name="a\n\nb: c"), DATA)
    assert header(paths[1])["content"] == "a  b: c"
    with pytest.raises(InputError, match="control characters"):
        save_region(tmp_path / "a\nb.raw", region_raw(), DATA)


def test_a_header_that_exists_stops_it(tmp_path: Path) -> None:
    (tmp_path / "out.nhdr").write_text("old")
    with pytest.raises(OutputExistsError, match=r"out\.nhdr exists"):
        save_region(tmp_path / "out.raw", region_raw(), DATA)
    assert [path.name for path in tmp_path.iterdir()] == ["out.nhdr"]


RNG = np.random.default_rng(5)
VALUES = {
    "u": RNG.normal(size=SHAPE).astype("f4"),
    "v": RNG.normal(size=SHAPE),
    "n": RNG.integers(-9, 9, SHAPE).astype("i2"),
}


def region_several(name: str, coords: Mapping[str, Coordinate] = COORDS) -> Region:
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
    assert save_regions(path, [(region_several(name), VALUES[name]) for name in VALUES]) == [path]
    found = read(path)
    assert set(found) == {*VALUES, "time", "height", "lat", "lon"}
    for name, values in VALUES.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_other_positions_of_one_name_have_another_name_in_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    staggered = {**COORDS, "x": replace(COORDS["x"], values=COORDS["x"].values + 0.05)}
    save_regions(
        path, [(region_several("u"), VALUES["u"]), (region_several("v", staggered), VALUES["v"])]
    )
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
    first = (region_several("u"), VALUES["u"])
    with pytest.raises(InputError, match="variable v has another lon than the one before; write"):
        save_regions(path, [first, (region_several("v", moved), VALUES["v"])])
    two_steps = labelled_region(
        name="v",
        dtype=VALUES["v"].dtype,
        coords=short,
        shape=(2, *SHAPE[1:]),
        attributes={},
    )
    with pytest.raises(InputError, match="variable v has 2 of time, another 3; write"):
        save_regions(path, [first, (two_steps, VALUES["v"][:2])])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_two_of_one_name_and_missing_frames_leave_nothing(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    again = (region_several("u"), VALUES["u"])
    with pytest.raises(InputError, match="two variables would have the name u"):
        save_regions(path, [again, again])
    with pytest.raises(InputError, match="region 'v': only 2 frames came for its 3 steps"):
        save_regions(path, [again, (region_several("v"), VALUES["v"][:2])])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".npy", ".raw", ".vti", ".vtkhdf"])
def test_other_formats_hold_one(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    told = r"holds one variable, and there are 2; choose one, or use one of .h5, .*\.zarr"
    with pytest.raises(InputError, match=told):
        save_regions(path, [(region_several("u"), VALUES["u"]), (region_several("v"), VALUES["v"])])
    with pytest.raises(InputError, match=told):
        save_check(path, variables=2)
    assert list(tmp_path.iterdir()) == []
