"""The wheel on a fresh machine: what a plain install can do, and what it says of the rest."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from fresh_install import fhash, run

LIBRARIES = (
    "fhash_formats/native/libfhash.so",
    "fhash_codec/native/_codec.so",
    "fhash_codec/native/network/_network.so",
)
HEAVY = ("torch", "vtkmodules", "matplotlib", "hdf5plugin", "skimage", "dask")
"""Packages of the extras, which a plain install leaves out."""


def test_a_plain_install_holds_no_heavy_package(site: Path, tmp_path: Path) -> None:
    script = f"from importlib.util import find_spec; print([x for x in {HEAVY} if find_spec(x)])"
    assert run(site, tmp_path, "-c", script).stdout.strip() == "[]"


def test_the_libraries_of_the_wheel_are_loaded(site: Path, tmp_path: Path) -> None:
    script = (
        "import fhash_formats.hdf5, fhash_codec.native, fhash_codec.native.network;"
        "print(fhash_formats.native.library() is not None,"
        " fhash_codec.native.library() is not None,"
        " fhash_codec.native.network.library() is not None, fhash_codec.__file__)"
    )
    result = run(site, tmp_path, "-c", script)
    assert result.stdout.split() == [
        "True",
        "True",
        "True",
        str(site / "fhash_codec" / "__init__.py"),
    ]


def test_without_a_compiler_the_installation_fails_in_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "setup.py", "-q", "build_ext", "-b", tmp_path / "b", "-t", tmp_path / "t"],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "CC": "no-gcc", "CXX": "no-g++"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: fhash needs a C++17 compiler, and 'no-g++' did not build it")


@pytest.mark.parametrize("found", [None, "/usr/bin/g++"])
def test_a_build_without_a_compiler_asks_for_one(found: str | None) -> None:
    script = (
        f"import shutil; shutil.which = lambda name: {found!r};"
        "import build_backend; print(build_backend._compiler())"
    )
    environment = {key: value for key, value in os.environ.items() if key != "CXX"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[2],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ("ziglang" in done.stdout) == (found is None)


def test_the_source_archive_holds_what_builds_it(wheel: Path, tmp_path: Path) -> None:
    command = [sys.executable, "setup.py", "-q", "sdist", "-d", tmp_path]
    subprocess.run(command, cwd=wheel.parents[1], check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert {"build_backend.py", "setup.py", "pyproject.toml"} <= names
    native = "formats/fhash_formats/native"
    assert {f"{native}/CMakeLists.txt", f"{native}/exports.map"} <= names


def test_the_wheel_holds_the_stripped_libraries(wheel: Path) -> None:
    assert "-py3-none-" in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        for name in LIBRARIES:
            assert name in names
            assert b".debug_info" not in archive.read(name)
    assert "fhash_formats/FORMAT.md" in names
    linked = ("fhash.h", "fhash.pc", "fhash-config.cmake", "fhash-config-version.cmake")
    assert {f"fhash_formats/native/{name}" for name in linked} <= set(names)
    assert "fhash_codec/views/napari.yaml" in names
    assert not [name for name in names if name.startswith(("tests/", "build/"))]


def test_a_plain_install_encodes_decodes_renders_and_verifies(site: Path, tmp_path: Path) -> None:
    values = np.linspace(0, 1, 6 * 12 * 14 * 16, dtype=np.float32).reshape(6, 12, 14, 16) ** 2
    values[:, 4:8, 4:8, 4:8] += 1
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["density"] = values
    fhash(site, tmp_path, "encode", "run.h5", "-o", "run.fhz", "--max-error", "0.01")
    fhash(site, tmp_path, "verify", "run.fhz")
    fhash(site, tmp_path, "info", "run.fhz")
    fhash(site, tmp_path, "diff", "run.h5", "run.fhz", "--max-error", "0.01")
    for suffix in (".npy", ".nc", ".zarr"):
        fhash(site, tmp_path, "decode", "run.fhz", "--t", "0", "-o", f"part{suffix}")
    decoded = np.load(tmp_path / "part.npy")
    assert np.abs(decoded - values[:1]).max() <= 0.01
    fhash(site, tmp_path, "encode", "part.nc", "-o", "again.fhz", "--max-error", "0.01")
    fhash(site, tmp_path, "encode", "part.zarr", "-o", "zarr.fhz", "--max-error", "0.01")
    fhash(site, tmp_path, "render", "run.fhz", "-o", "picture.png", "--size", "64x64")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (
            ("encode", "run.npy", "-o", "paper.fhz", "--preset", "published", "--device", "cuda"),
            "fhash[torch]",
        ),
        (("bench", "rate", "run.npy"), "fhash[bench]"),
        (("decode", "run.fhz", "--isosurface", "0.5", "-o", "surface.ply"), "fhash[mesh]"),
    ],
)
def test_a_missing_extra_is_one_line_that_names_it(
    site: Path, tmp_path: Path, arguments: tuple[str, ...], extra: str
) -> None:
    np.save(tmp_path / "run.npy", np.random.default_rng(0).random((2, 8, 8, 8)))
    fhash(site, tmp_path, "encode", "run.npy", "-o", "run.fhz", "--effort", "1", "--psnr", "30")
    result = run(site, tmp_path, "-m", "fhash_cli.main", *arguments)
    assert result.returncode == 2
    assert f"pip install '{extra}'" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert "Traceback" not in result.stderr
