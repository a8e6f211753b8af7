"""A plain install of the wheel in an empty folder, without torch, extras or a compiler.

Nothing is fetched: the wheel is unpacked, and beside it only those distributions are linked that
its metadata names as plain requirements, and theirs.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

sys.path.insert(0, str(Path(__file__).parent))

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = (
    "formats/fhash_formats/native/libfhash.so",
    "fhash_codec/native/_codec.so",
    "fhash_codec/native/network/_network.so",
)


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
