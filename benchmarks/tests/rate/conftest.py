"""A noisy wave, and everything that is measured of it."""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_bench.rate.measuring import RateBench
from fhash_bench.rate.rate import bench_rate


def wave(shape: tuple[int, ...] = (4, 6, 20, 24)) -> np.ndarray:
    """A moving wave with a little noise, values in about -1 .. 2."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).normal(size=shape)
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z + 0.01 * noise).astype(np.float32)


@pytest.fixture(scope="session")
def field() -> Callable[..., np.ndarray]:
    """A function of a shape (t, z, y, x): the noisy wave."""
    return wave


@pytest.fixture(scope="session")
def result() -> RateBench:
    """Every peer and the preset published, measured at two targets and one bound."""
    config = {"epochs": 2, "width": 4, "seed": 1}
    return bench_rate(wave(), config, targets=(35.0, 50.0), bounds=(0.02,), presets=("published",))


TTHRESH = """
import pickle, zlib
options = dict(zip(sys.argv[1::2], sys.argv[2::2])) if "-s" not in sys.argv else {}
if "-s" in sys.argv:
    words = sys.argv[1:]
    at = words.index("-s")
    sizes = []
    for word in words[at + 1:]:
        if word.startswith("-"):
            break
        sizes.append(int(word))
    rest = words[:at] + words[at + 1 + len(sizes):]
    options = dict(zip(rest[::2], rest[1::2]))
    assert len(sizes) >= 3
    kind = {"float": "f4", "double": "f8"}[options["-t"]]
    values = np.fromfile(options["-i"], kind)
    assert values.size == np.prod(sizes)
    # The program's PSNR is relative to half of the range.
    step = np.ptp(values.astype(float)) / 2 * 10 ** (-float(options["-p"]) / 20) * 12 ** 0.5
    whole = np.rint(values / step).astype("i4")
    open(options["-c"], "wb").write(zlib.compress(pickle.dumps((whole, step, kind))))
else:
    whole, step, kind = pickle.loads(zlib.decompress(open(options["-c"], "rb").read()))
    (whole * step).astype(kind).tofile(options["-o"])
"""
QOZ = """
import pickle, zlib
words = sys.argv[1:]
kind = {"-f": "f4", "-d": "f8"}[words[0]]
dims = next(number for number, word in enumerate(words) if word[1:] in ("1", "2", "3", "4"))
count = int(words[dims][1:])
sizes = [int(word) for word in words[dims + 1 : dims + 1 + count]]
if "-i" in words:
    assert words[words.index("-M") + 1] == "ABS"
    step = 2 * float(words[words.index("-M") + 2])
    values = np.fromfile(words[words.index("-i") + 1], kind)
    assert values.size == np.prod(sizes)
    whole = np.rint(values.astype(float) / step).astype("i4")
    open(words[words.index("-z") + 1], "wb").write(zlib.compress(pickle.dumps((whole, step))))
else:
    whole, step = pickle.loads(zlib.decompress(open(words[words.index("-z") + 1], "rb").read()))
    (whole * step).astype(kind).tofile(words[words.index("-o") + 1])
"""
FFMPEG = """
import pickle, zlib
words = sys.argv[1:]
if "-encoders" in words:
    print(" V....D libx265   libx265 H.265 / HEVC")
    sys.exit(0)
source = words[words.index("-i") + 1]
if "-c:v" in words:
    assert words[words.index("-c:v") + 1] == "libx265"
    settings = words[words.index("-x265-params") + 1]
    step = int(2 ** (int(settings.split("=")[1].split(":")[0]) / 6))
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert width % 8 == height % 8 == 0 and min(width, height) >= 64
    values = np.fromfile(source, "u2").astype(int)
    assert values.size % (width * height * 3 // 2) == 0
    whole = (values + step // 2) // step
    open(words[-1], "wb").write(zlib.compress(pickle.dumps((whole, step))))
else:
    whole, step = pickle.loads(zlib.decompress(open(source, "rb").read()))
    (whole * step).astype("u2").tofile(words[-1])
"""


@pytest.fixture
def script(tmp_path: Path) -> Callable[[str, str], str]:
    """A function of a name and Python code, that makes a program of it and returns its path."""

    def made(name: str, code: str) -> str:
        path = tmp_path / name
        path.write_text(f"#!{sys.executable}\nimport sys\nimport numpy as np\n{code}")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    return made


@pytest.fixture
def tthresh(script: Callable[[str, str], str]) -> str:
    """Path of a stand-in for TTHRESH."""
    return script("tthresh", TTHRESH)


@pytest.fixture
def qoz(script: Callable[[str, str], str]) -> str:
    """Path of a stand-in for QoZ."""
    return script("qoz", QOZ)


@pytest.fixture
def ffmpeg(script: Callable[[str, str], str]) -> str:
    """Path of a stand-in for an ffmpeg that has HEVC alone."""
    return script("ffmpeg", FFMPEG)
