"""Every format: values are exact, frames come one at a time, files are complete or absent."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from regions import READ

from fhash_formats.errors import (
    FhashError,
    InputError,
    MissingInputError,
    OutputError,
    OutputExistsError,
)
from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import WRITERS, save_check, save_region

SUFFIXES = [suffix for writer in WRITERS for suffix in writer.suffixes]
SHAPE = (3, 4, 5, 6)


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
    "dtype", ["f4", "f8", "f2", ">f4", "i1", "u1", ">i2", "u2", "i4", "u4", "i8", "u8"]
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


@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (1, 3, 1, 2), (2, 1, 4, 1), (1, 2, 3, 4)])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_axes_of_one_vertex(tmp_path: Path, suffix: str, shape: tuple[int, int, int, int]) -> None:
    data = np.arange(np.prod(shape), dtype="f4").reshape(shape)
    paths = save_region(tmp_path / f"out{suffix}", region(shape=shape), data)
    np.testing.assert_array_equal(READ[suffix](paths), data)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_frames_that_are_views_come_back_exactly(tmp_path: Path, suffix: str) -> None:
    data = np.moveaxis(values(), 1, 3)[:, ::-1]
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


def test_a_suffix_in_capitals(tmp_path: Path) -> None:
    (path,) = save_region(str(tmp_path / "OUT.NPY"), region(), values())
    np.testing.assert_array_equal(np.load(path), values())


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
