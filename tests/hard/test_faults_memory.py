"""Little memory: any limit ends in a result or in one line, and gigabytes are decoded within a
limit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty import Bench
from reporting import LONG, record

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_formats.series import AXES, Series, index_coordinate

MIB = 2**20
LIMITS = (
    (1, 2, 4, 8, 12, 16, 20, 24, 28, 32, 40, 48, 64, 80, 96, 128, 192, 256, 400)
    if LONG
    else (2, 256)
)
"""Data in MiB that a command may use beyond what the interpreter and the libraries use already.

The last one suffices: the series may be coded as one tile of 3 M vertices.
"""
SHAPE = (12, 48, 64, 80)


@pytest.fixture(scope="module")
def larger(_bench: Bench) -> Path:
    """A container whose decoding needs memory beyond that of the libraries."""
    place = _bench.folder / "larger"
    place.mkdir()
    field = np.random.default_rng(0).standard_normal(SHAPE).astype(np.float32).cumsum(3)
    np.save(place / "in.npy", field)
    fhash_codec.encode(field, place / "run.fhz", EncodeConfig(effort=1))
    return place


COMMANDS = {
    "encode": ("encode", "{in}", "--effort", "1", "-o", "a.fhz"),
    "decode npy": ("decode", "{run}", "-o", "a.npy"),
    "decode raw": ("decode", "{run}", "-o", "a.raw"),
    "decode vti": ("decode", "{run}", "--t", "1", "-o", "a.vti"),
    "render": ("render", "{run}", "--size", "200x200", "-o", "a.png"),
    "verify": ("verify", "{run}"),
}
"""Commands by name. HDF5, OpenBLAS and scikit-image end the process without memory and are left
out."""


@pytest.mark.parametrize("name", COMMANDS)
def test_any_limit_gives_a_result_or_one_line(bench: Bench, larger: Path, name: str) -> None:
    taken = data_of(bench.server.process.pid)
    places = {"in": str(larger / "in.npy"), "run": str(larger / "run.fhz")}
    words = [word.format_map(places) for word in COMMANDS[name]]
    words[-1:] = [str(bench.out / words[-1])] if "-o" in words else words[-1:]
    done = died = 0
    for limit in LIMITS:
        bench.empty()
        running = bench.server.start(*words, inject=[("memory_limit", taken + limit * MIB)])
        timer = threading.Timer(60, running.kill, [signal.SIGKILL])
        timer.start()
        ended = running.wait()
        timer.cancel()
        if ended.code == 0:
            done += 1
            continue
        if LONG and ended.code in (-signal.SIGSEGV, -signal.SIGKILL):
            # CPython 3.11: a thread without memory to start dies, and `Thread.start` sometimes
            # waits for it forever.
            died += 1
            continue
        assert ended.code == 1, (limit, ended.output)
        assert ended.line.startswith("fhash: error: "), limit
        assert "memory" in ended.line, limit
        assert "please report" not in ended.line, limit
        assert bench.now() == {}, limit
    assert done
    assert died <= 3
    record(
        "little memory",
        {
            "command": name,
            "limits": len(LIMITS),
            "done": done,
            "the interpreter died or hung": died,
        },
    )


def data_of(pid: int) -> int:
    """Return the bytes of data of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData"))


class Streamed(Series):
    """A moving wave that is made frame by frame and never held in memory."""

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        self.source, self.name, self.units, self.attributes = "streamed", "wave", "", {}
        self.dtype, self.shape = np.dtype(np.float32), shape
        self.coords = {
            axis: index_coordinate(axis, length) for axis, length in zip(AXES, shape, strict=True)
        }
        z, y, x = np.meshgrid(
            *(np.linspace(0, 6, n, dtype=np.float32) for n in shape[1:]), indexing="ij", sparse=True
        )
        self.still, self.moving = np.sin(3 * x) * np.cos(2 * y), np.cos(z + y)

    def read(self, step: int) -> np.ndarray[Any, Any]:
        self.require_step(step)
        return np.ascontiguousarray(
            self.still + np.float32(np.sin(0.2 * step)) * self.moving, dtype=np.float32
        )


@pytest.fixture(scope="module")
def huge(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int, float]]:
    """A container of a series of 3 GiB, the bytes of the series, and the largest error."""
    path = tmp_path_factory.mktemp("huge") / "wave.fhz"
    series = Streamed((48, 256, 256, 256))
    raw = 4 * int(np.prod(series.shape))
    begun = time.perf_counter()
    figures = fhash_codec.encode(series, path, EncodeConfig(effort=1, psnr=40))
    record(
        "a large series",
        {
            "bytes": raw,
            "container": figures["bytes"],
            "psnr": figures["psnr"],
            "seconds": time.perf_counter() - begun,
        },
    )
    yield path, raw, figures["max_abs_error"]
    path.unlink()


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
from fhash_cli.main import main
sys.argv = ["fhash", *sys.argv[2:]]
try:
    main()
finally:
    # not getrusage, which begins with the parent's peak
    lines = open("/proc/self/status").read().splitlines()
    open(PEAK, "w").write(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
"""


@pytest.mark.skipif(not LONG, reason="minutes, and 3 GiB of disk: FHASH_HARD=1")
@pytest.mark.parametrize("suffix", ["raw", "npy", "h5", "zarr", "nc", "vti", "statistics", "png"])
def test_a_large_file_is_decoded_within_one_gibibyte(
    huge: tuple[Path, int, float], tmp_path: Path, suffix: str
) -> None:
    path, raw, error = huge
    output, peak = tmp_path / f"out.{suffix}", tmp_path / "peak"
    words = ["decode", str(path), "-q"] + ([] if suffix == "statistics" else ["-o", str(output)])
    if suffix == "png":
        words = ["render", str(path), "--size", "300x300", "-o", str(output), "-q"]
    script = LIMITED.replace("PEAK", repr(str(peak)))
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "FHASH_THREADS": "2",
    }
    done = subprocess.run(
        [sys.executable, "-c", script, "-", *words],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if (
        suffix == "zarr" and done.returncode
    ):  # its threads reserve much more than they use; the limit is on reserved memory
        assert done.returncode in (1, 4)
        assert len(done.stderr.splitlines()) == 1
        assert "memory" in done.stderr
        assert not output.exists()
        return
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    record(
        "a large decode within 1 GiB",
        {"output": suffix, "bytes": raw, "peak resident bytes": 1024 * int(peak.read_text())},
    )
    if suffix in ("raw", "npy"):
        offset = output.stat().st_size - raw
        series = Streamed((48, 256, 256, 256))
        for step in (0, 17, 47):
            count = int(np.prod(series.shape[1:]))
            frame = np.fromfile(output, np.float32, count, offset=offset + step * 4 * count)
            assert np.abs(frame.reshape(series.shape[1:]) - series.read(step)).max() <= error
