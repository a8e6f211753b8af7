"""The wheel on a fresh machine: a plain install, without torch, extras or a compiler.

The test needs no index: it unpacks the wheel into an empty folder, and links there only those
distributions that the wheel's metadata names as plain requirements, and theirs.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import h5py
import numpy as np
import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
LIBRARIES = (
    "formats/fhash_formats/native/_core.abi3.so",
    "fhash_codec/native/_codec.abi3.so",
)
HEAVY = ("torch", "vtkmodules", "matplotlib", "numba", "hdf5plugin", "skimage", "dask")
"""Packages of the extras, which a plain install leaves out."""


def plain_requirements(texts: list[str] | None) -> Iterator[str]:
    """The names of requirements that hold here without any extra."""
    for text in texts or []:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield requirement.name


def closure(names: list[str]) -> list[metadata.Distribution]:
    """The installed distributions of these names and of all that they require."""
    found: dict[str, metadata.Distribution] = {}
    while names:
        name = names.pop()
        distribution = metadata.distribution(name)
        if distribution.name not in found:
            found[distribution.name] = distribution
            names += plain_requirements(distribution.requires)
    return list(found.values())


def build_wheel(folder: Path) -> Path:
    """A wheel of a copy of the source tree, with the libraries that are built already.

    Compiling them again would take minutes; they are newer than their sources here, so that the
    build takes them.
    """
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        if not name.startswith("tests/") and (ROOT / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    # The platform's name for build/lib is setuptools' own: ask for it.
    script = (
        "from setuptools.dist import Distribution;"
        "command = Distribution().get_command_obj('build'); command.ensure_finalized();"
        "print(command.build_platlib)"
    )
    shown = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, check=True, capture_output=True, text=True
    )
    target = folder / shown.stdout.strip()
    for name in LIBRARIES:
        place = target / name.removeprefix("formats/")
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, place)
    result = subprocess.run(
        [sys.executable, "setup.py", "-q", "bdist_wheel", "-d", "dist"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return next((folder / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not all((ROOT / name).exists() for name in LIBRARIES):
        pytest.skip("the native libraries are not built in this source tree")
    return build_wheel(tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages: the wheel, and links to its plain requirements."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    info = next(folder.glob("fhash-*.dist-info"))
    own = metadata.PathDistribution(info)
    for distribution in closure(list(plain_requirements(own.requires))):
        files = distribution.files or []
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            if not (folder / top).exists():
                (folder / top).symlink_to(Path(str(distribution.locate_file(top))))
    return folder


def run(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python with the packages of `site` alone, and without any program on its path."""
    environment = {"PYTHONPATH": str(site), "PATH": "", "HOME": str(folder)}
    environment |= {name: os.environ[name] for name in ("LANG", "TMPDIR") if name in os.environ}
    return subprocess.run(
        [sys.executable, "-S", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def fhash(site: Path, folder: Path, *arguments: str) -> str:
    result = run(site, folder, "-m", "fhash_cli.main", *arguments)
    assert result.returncode == 0, f"fhash {' '.join(arguments)}: {result.stderr}"
    return result.stdout


def test_a_plain_install_holds_no_heavy_package(site: Path, tmp_path: Path) -> None:
    for name in HEAVY:
        script = f"import importlib.util; print(importlib.util.find_spec({name!r}))"
        assert run(site, tmp_path, "-c", script).stdout.strip() == "None", name


def test_both_libraries_of_the_wheel_are_loaded(site: Path, tmp_path: Path) -> None:
    script = (
        "import fhash_formats.native, fhash_codec.native;"
        "print(fhash_formats.native.library() is not None,"
        " fhash_codec.native.library() is not None, fhash_codec.__file__)"
    )
    result = run(site, tmp_path, "-c", script)
    assert result.stdout.split() == ["True", "True", str(site / "fhash_codec" / "__init__.py")]


def test_the_wheel_holds_the_stripped_abi3_libraries(wheel: Path) -> None:
    assert "-cp311-abi3-" in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        for name in LIBRARIES:
            inside = name.removeprefix("formats/")
            assert inside in names
            assert b".debug_info" not in archive.read(inside)
    assert "fhash_formats/FORMAT.md" in names
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
    for suffix in (".npy", ".nc", ".h5", ".zarr", ".vti", ".vtkhdf"):
        fhash(site, tmp_path, "decode", "run.fhz", "--t", "0", "-o", f"part{suffix}")
    decoded = np.load(tmp_path / "part.npy")
    assert np.abs(decoded - values[:1]).max() <= 0.01
    fhash(site, tmp_path, "encode", "part.nc", "-o", "again.fhz", "--max-error", "0.01")
    fhash(site, tmp_path, "encode", "part.zarr", "-o", "zarr.fhz", "--max-error", "0.01")
    fhash(site, tmp_path, "render", "run.fhz", "-o", "picture.png", "--size", "64x64")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_the_default_encode_needs_no_torch(site: Path, tmp_path: Path) -> None:
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n) for n in (20, 24, 28)], indexing="ij")
    frames = [np.tanh(6 * (x - 0.1 * t) * y + 3 * z) for t in range(6)]
    np.save(tmp_path / "run.npy", np.array(frames, np.float32))
    fhash(site, tmp_path, "encode", "run.npy", "-o", "run.fhz")
    assert '"psnr"' in fhash(site, tmp_path, "info", "run.fhz", "--json")


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (("encode", "run.npy", "-o", "paper.fhz", "--profile", "paper"), "fhash[train]"),
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
