"""The library of the format, compiled by Clang: it decodes and encodes the same bits as GCC's.

Clang is that of the package ziglang, as setup.py uses it where a machine has no compiler; with the
headers of GCC it need not compile a C++ library of its own, which takes longer than all else.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import fhash_codec

ROOT = Path(__file__).resolve().parents[2]
BUILD = """
import runpy, setuptools, sys
whole = setuptools.setup
setuptools.setup = lambda **words: whole(**(words | {"ext_modules": words["ext_modules"][:1]}))
sys.path.insert(0, ".")
runpy.run_path("setup.py")
"""
"""Runs setup.py, for its first library alone."""
RUN = """
import os, pathlib, pytest, sys
import numpy as np
import fhash_codec, fhash_formats.native as native
native.FOLDER = pathlib.Path(sys.argv[1])
code = 0
for tests, long, names in (
    ("golden/test_golden.py", "1", "their_values or same_bits"),
    ("reference", "0", "test_tiles"),
):
    os.environ["FHASH_HARD"] = long
    code = code or pytest.main(["-p", "no:xdist", "-k", names, tests])
config = fhash_codec.EncodeConfig(max_error_rel=1e-3, timings=False)
fhash_codec.encode(np.load(sys.argv[2]), sys.argv[3], config)
print(*(folder for folder, name, _ in native._LOADED if name == "libfhash"))
sys.exit(code)
"""
"""Runs tests and an encoding with the library in a folder, then prints whence it was loaded.

All cases of the goldens, and some random tiles, which are encoded, too.
"""

pytestmark = [
    pytest.mark.clang,
    pytest.mark.skipif(
        sys.platform != "linux" or not shutil.which("g++"),
        reason="every other library is Clang's",
    ),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a library that Clang compiled with the flags of setup.py."""
    target = tmp_path_factory.mktemp("clang")
    package = find_spec("ziglang")
    assert package is not None, "`make clang` installs ziglang"
    machine = subprocess.run(["g++", "-dumpmachine"], capture_output=True, text=True, check=True)
    clang = (
        f"{sys.executable} -m ziglang clang --driver-mode=g++ --target={machine.stdout.strip()}"
        f" -resource-dir {Path(str(package.origin)).parent / 'lib'}"
    )
    command = [sys.executable, "-c", BUILD, "-q", "build_ext", "-b", target, "-t", target / "o"]
    compiler = {"CC": clang.replace("g++", "gcc"), "CXX": clang, "LDSHARED": f"{clang} -shared"}
    compiler["LDCXXSHARED"] = compiler["LDSHARED"]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **compiler}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return target / "fhash_formats" / "native"


def test_goldens_random_tiles_and_a_file_have_the_same_bits(folder: Path, tmp_path: Path) -> None:
    assert b"clang version" in (folder / "libfhash.so").read_bytes()
    values = np.random.default_rng(0).normal(size=(3, 9, 14, 21)).astype(np.float32).cumsum(axis=3)
    np.save(tmp_path / "run.npy", values)
    config = fhash_codec.EncodeConfig(max_error_rel=1e-3, timings=False)
    fhash_codec.encode(values, tmp_path / "gcc.fhz", config)
    words = [sys.executable, "-c", RUN, folder, tmp_path / "run.npy", tmp_path / "clang.fhz"]
    done = subprocess.run(words, cwd=ROOT / "tests", capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" passed") == 2, done.stdout
    assert done.stdout.split()[-1] == str(folder)
    assert (tmp_path / "clang.fhz").read_bytes() == (tmp_path / "gcc.fhz").read_bytes()
