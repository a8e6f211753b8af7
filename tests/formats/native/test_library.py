"""libfhash for other languages: what it exports, its build files, and the examples of docs."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_formats.native import FOLDER

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "docs" / "examples"
CODEC = ROOT / "fhash_codec" / "native"
NETWORK = CODEC / "network"
HEADER = (FOLDER / "fhash.h").read_text(encoding="utf-8")
LINKED = [f"-I{FOLDER}", f"-L{FOLDER}", "-lfhash", f"-Wl,-rpath,{FOLDER}"]


def run(*words: object, folder: Path | None = None, more: dict[str, str] | None = None) -> str:
    """Output of a program; the test skips where it is not installed."""
    if shutil.which(str(words[0])) is None:
        pytest.skip(f"{words[0]} is not installed")
    texts, variables = [str(word) for word in words], {**os.environ, **(more or {})}
    done = subprocess.run(texts, cwd=folder, capture_output=True, text=True, env=variables)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="nm reads ELF")
def test_the_library_exports_nothing_of_others() -> None:
    shown = run("nm", "-D", "--defined-only", FOLDER / "libfhash.so")
    exported = {line.split()[-1] for line in shown.splitlines()}
    public = set(re.findall(r"^FHASH_API [^;]*?(fhash_\w+)\(", HEADER, re.MULTILINE))
    plugin = {"H5PLget_plugin_info", "H5PLget_plugin_type"}
    assert exported == public | plugin | {"fhash_function"}
    assert len(public) >= 15


@pytest.mark.parametrize("flags", [(), ("-fsanitize=address",)], ids=["operators", "asan"])
def test_a_program_with_memory_of_its_own_reads_a_file(flags: Any, tmp_path: Path) -> None:
    """A program replaces operator new, as arenas and trackers do, or ASan does."""
    source = Path(__file__).with_name("own_memory.cpp")
    sanitized = [f"-DSANITIZED={len(flags)}", *flags]
    run("g++", "-std=c++17", *sanitized, source, "-o", tmp_path / "host", *LINKED)
    found = run(tmp_path / "host", ROOT / "tests" / "golden" / "compact-bound.fhz")
    assert found.endswith("done\n")


def test_build_files_agree_on_version_and_flags() -> None:
    numbers = re.findall(r"#define FHASH_VERSION_M\w+ (\d+)", HEADER)
    version = ".".join(numbers)
    assert f"\nVersion: {version}\n" in (FOLDER / "fhash.pc").read_text()
    told = (FOLDER / "fhash-config-version.cmake").read_text()
    assert f"set(PACKAGE_VERSION {version})" in told
    assert f"MAJOR EQUAL {numbers[0]} " in told
    setup = ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))
    cmake = (FOLDER / "CMakeLists.txt").read_text(encoding="utf-8")
    (flags,) = (
        ast.literal_eval(node.value)
        for node in setup.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "GNU_FLAGS"
    )
    assert not [flag for flag in flags if flag.startswith(("-f", "-O")) and flag not in cmake]


def test_the_bill_of_materials_has_the_versions_of_the_sources() -> None:
    """CycloneDX: what a scanner of vulnerabilities looks for in libfhash."""
    folder = FOLDER / "third_party"
    bill = json.loads((folder / "sbom.cdx.json").read_text(encoding="utf-8"))
    told = {each["name"]: each["version"] for each in bill["components"]}
    zstd = (folder / "zstd" / "zstd.h").read_text(encoding="utf-8")
    parts = [
        re.search(rf"ZSTD_VERSION_{name} +(\d+)", zstd) for name in ("MAJOR", "MINOR", "RELEASE")
    ]
    found = {"zstd": ".".join(part[1] for part in parts if part)}
    for name, macro in (("zlib", "ZLIB_VERSION"), ("yyjson", "YYJSON_VERSION_STRING")):
        header = (folder / name / f"{name}.h").read_text(encoding="utf-8")
        version = re.search(rf'#define {macro} +"(.+)"', header)
        assert version
        found[name] = version[1]
    assert told == found
    assert set(told) == {path.name for path in folder.iterdir() if path.is_dir()}
    assert all(each["version"] in each["purl"] and each["licenses"] for each in bill["components"])


@pytest.mark.skipif("CXX" in os.environ, reason="the limits are those of the usual compiler")
def test_no_object_is_as_large_as_it_was() -> None:
    """The compiler takes a second for 40 kB: six of 78 units had 3.1 MB and took 81 of 154 s."""
    sizes = json.loads((ROOT / "build" / "objects.json").read_text(encoding="utf-8"))
    assert len(sizes) > 60
    assert sum(sizes.values()) < 4_870_000
    assert sizes.pop("files.o") < 640_000  # at -O1: a second for 130 kB
    assert max(sizes.values()) < 235_000, max(sizes, key=sizes.__getitem__)


@pytest.mark.every
@pytest.mark.skipif(sys.platform != "linux", reason="objdump reads ELF")
@pytest.mark.parametrize(
    "source",
    sorted([*FOLDER.glob("*_v3.cpp"), *CODEC.glob("*_v[34].cpp"), *NETWORK.glob("*_v[34].cpp")]),
    ids=lambda path: path.stem,
)
def test_what_may_be_linked_into_others_is_for_every_processor(
    source: Path, tmp_path: Path
) -> None:
    """The linker takes any copy of an inline function: none may have instructions of AVX2."""
    made = tmp_path / "unit.o"
    run("g++", "-std=c++17", "-fPIC", "-O2", f"-I{FOLDER}", "-c", source, "-o", made)
    weak = {line.split()[-1] for line in run("nm", made).splitlines() if line[17] in "VWu"}
    wide, others = 0, []
    listed = run("objdump", "-d", "--no-show-raw-insn", made)
    for function in re.split(r"\n(?=[0-9a-f]+ <)", listed):
        named = re.match(r"[0-9a-f]+ <(.*)>:", function)
        if named and re.search(r"\t(v[a-z]+|shlx|rorx) ", function):
            wide += 1
            if named[1] in weak or named[1].startswith("_GLOBAL__"):
                others.append(named[1])
    assert wide
    assert not others


INSTRUCTIONS = """
import hashlib, sys
import numpy as np
from fhash_formats.transform.numcodecs_codec import NumcodecsTransform
x = np.random.default_rng(0).normal(size=(3, 9, 21, 37)).cumsum(axis=3)
smooth = np.sin(np.linspace(0, 9, 37) * np.linspace(1, 2, 21)[:, None]) + 0.01 * x
labels = (x[0] > 0).astype("u1") + (x[0] > 2)
for values, options in (
    (smooth.astype("f4"), {"max_error": 0.01}),
    (smooth, {"max_error": 0.001, "effort": 9}),
    (smooth.astype("f4"), {"max_error": 0.1, "effort": 1}),
    (np.where(x > -1, x, np.nan), {"max_error": 0.05}),
    ((100 * x).astype("i4"), {"max_error": 0}),
    (labels, {"max_error": 0}),
):
    codec = NumcodecsTransform(**options)
    coded = bytes(codec.encode(values))
    print(hashlib.sha256(coded + codec.decode(coded).tobytes()).hexdigest())
"""
"""Prints a digest of the bytes and of the decoded values of arrays that all coders take part in."""


def test_every_instruction_set_has_the_same_bits() -> None:
    shown = {
        run(sys.executable, "-c", INSTRUCTIONS, more={"FHASH_INSTRUCTIONS": instructions})
        for instructions in ("baseline", "avx2", "all")
    }
    assert len(shown) == 1
    assert len(set(shown.pop().split())) == 6


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container with missing values."""
    t, z, y, x = np.meshgrid(*map(np.arange, (4, 9, 12, 14)), indexing="ij", sparse=True)
    values = np.sin(0.3 * x + 0.2 * y * t) + 0.1 * z
    values[:, 2, 3:6, 4:9] = np.nan
    path = tmp_path_factory.mktemp("library") / "run.fhz"
    config = fhash_codec.EncodeConfig(effort=1, max_error=0.01)
    fhash_codec.encode(values.astype("f4"), path, config)
    return path


def check(shown: str, path: Path) -> None:
    """Compare what an example prints with Python's values."""
    with fhash_codec.open(path) as volume:
        region = volume.read(1.5, ((0, 5), (0, 6), (0, 7)))
        assert f"{volume.name} (4, 9, 12, 14) {volume.units}" in shown
    found = re.search(r"last +(\S+) mean +(\S+) of +(\d+)", shown)
    assert found is not None, shown
    known = region[np.isfinite(region)].astype("f8")
    assert float(found[1]) == pytest.approx(float(region[-1, -1, -1]), rel=1e-8)
    assert float(found[2]) == pytest.approx(known.mean(), rel=1e-10)
    assert int(found[3]) == known.size < region.size


@pytest.mark.parametrize(
    ("compiler", "source"),
    [
        ("gcc -std=c99 -Wall -Wextra -pedantic -Werror", "read_region.c"),
        ("g++ -std=c++17 -Wall -Wextra -pedantic -Werror", "read_region.cpp"),
        ("gfortran -std=f2018 -ffree-line-length-none -Wall -Werror", "read_region.f90"),
    ],
)
def test_an_example_reads_a_region(
    compiler: str, source: str, container: Path, tmp_path: Path
) -> None:
    words = [*compiler.split(), EXAMPLES / source, *LINKED, "-lm", "-o", tmp_path / "program"]
    run(*words, folder=tmp_path)
    check(run(tmp_path / "program", container), container)
    failed = subprocess.run([tmp_path / "program", "no.fhz"], capture_output=True, text=True)
    assert failed.returncode == 1
    assert "cannot be opened" in failed.stdout + failed.stderr


def test_the_example_of_octave_reads_a_region(container: Path, tmp_path: Path) -> None:
    run("mkoctfile", "--mex", EXAMPLES / "fhash_read.c", *LINKED, folder=tmp_path)
    words = ["octave-cli", "--norc", "-q", "--path", EXAMPLES, "--path", tmp_path, "--eval"]
    check(run(*words, f'read_region("{container}")'), container)
    line = 'try, fhash_read("no.fhz", 0, 0, []), catch e, disp(["refused " e.message]), end'
    assert "refused fhash_read: the file cannot be opened" in run(*words, line)


@pytest.mark.parametrize("place", ["package", "make lib"])
def test_pkg_config_and_cmake_find_the_library(place: str, container: Path, tmp_path: Path) -> None:
    system = ROOT / "build" / "lib" / "lib"
    if place == "make lib" and not system.is_dir():
        pytest.skip("`make lib` was not run")
    package, library, config = (
        (FOLDER, FOLDER, FOLDER)
        if place == "package"
        else (system / "pkgconfig", system, system / "cmake" / "fhash")
    )
    words = ["pkg-config", f"--with-path={package}", "--cflags", "--libs"]
    flags = [Path(flag[2:]).resolve() for flag in run(*words, "fhash").split() if "/" in flag]
    assert flags[1:] == [library]
    assert (flags[0] / "fhash.h").is_file()
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(example C)\nfind_package(fhash 1.0 REQUIRED)"
        f"\nadd_executable(example {EXAMPLES / 'read_region.c'})"
        "\ntarget_link_libraries(example fhash::fhash m)"
    )
    run("cmake", f"-Dfhash_DIR={config}", "-S", tmp_path, "-B", tmp_path / "build")
    run("cmake", "--build", tmp_path / "build")
    check(run(tmp_path / "build" / "example", container), container)
    if place == "make lib":
        static = run(*words, "--static", "fhash").replace("-lfhash", f"{library / 'libfhash.a'}")
        source = EXAMPLES / "read_region.c"
        (tmp_path / "own.c").write_text("int inflate; int yyjson_read_opts;")
        own = tmp_path / "own.c"
        run("gcc", own, source, *static.split(), "-lm", "-o", tmp_path / "static")
        assert "fhash" not in run("ldd", tmp_path / "static")
        check(run(tmp_path / "static", container), container)
        assert (library / "hdf5/plugin/libh5fhash.so").resolve().is_file()
