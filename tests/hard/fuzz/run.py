"""The native code under address and undefined-behaviour sanitizers with a coverage-guided fuzzer.

    python tests/hard/fuzz/run.py --seconds 600

builds into a temporary folder, runs one process per processor (or --processes), and prints one line: executions, edges, inputs that
were kept, crashes. An input that crashes or hangs is saved, with what the sanitizers said, in the folder --crashes (default: a temporary
one, which the output names). The exit code is 1 if there was any, 2 if nothing can be built. --repeat FILE runs one input alone.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
NATIVE = HERE.parents[2] / "formats" / "fhash_formats" / "native"
"""Sources of the file format's library."""
CODEC = HERE.parents[2] / "fhash_codec" / "native"
"""Sources of the codec's library, which include headers of the other one."""
TARGETS = tuple(HERE / f"{name}.cpp" for name in ("targets", "target_encode", "target_light"))
SOURCES = ("coder", "mask", "predict", "lifting", "head", "quantise", "values")
"""Files of NATIVE that are always fuzzed."""
CODEC_SOURCES = ("march_light",)
"""Files of CODEC that are always fuzzed."""
MARCH = ("march", "march_bricks")
"""Files of CODEC that are fuzzed on request, without optimisation: that takes the compiler a minute
instead of ten.
"""
SANITIZE = (
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
    "-g",
)
# One build for one machine: functions chosen when a library is loaded run before the sanitizers are ready.
FLAGS = ("-std=c++17", "-ffp-contract=off", "-Dtarget_clones(...)=", "-Wno-attributes")
ENVIRONMENT = {
    "ASAN_OPTIONS": "detect_leaks=1:abort_on_error=0:exitcode=99",
    "UBSAN_OPTIONS": "print_stacktrace=1",
}


class CannotBuild(Exception):
    """No compiler with these sanitizers."""


@dataclass
class Found:
    """What the fuzzers did together; edges: the most that one of them saw."""

    executions: int = 0
    edges: int = 0
    kept: int = 0
    crashes: list[Path] = field(default_factory=list)


def build(folder: Path, optimise: str = "-O1", march: bool = False) -> Path:
    """The fuzzer, compiled into a folder; raises CannotBuild, which says why.

    optimise: -O1 takes the compiler five times as long as -O0 and runs three times as fast. march: whether the marcher is fuzzed, too.
    """
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler.split()[0]) is None:
        raise CannotBuild(f"no compiler {compiler}")
    folder.mkdir(parents=True, exist_ok=True)
    tracing, headers = ("-fsanitize-coverage=trace-pc",), f"-I{NATIVE}"
    jobs: list[tuple[Path, tuple[str, ...]]] = [(HERE / "driver.cpp", ("-fsanitize=address", "-g"))]
    if march:
        # Lanes of vectors that are not wanted may hold what is no number.
        jobs += [
            (
                CODEC / f"{name}.cpp",
                (*SANITIZE, *tracing, headers, "-fno-sanitize=float-cast-overflow", "-O0"),
            )
            for name in MARCH
        ]
        jobs += [(HERE / "target_march.cpp", (*SANITIZE, headers, f"-I{CODEC}"))]
    jobs += [(NATIVE / f"{name}.cpp", (*SANITIZE, *tracing)) for name in SOURCES]
    jobs += [(CODEC / f"{name}.cpp", (*SANITIZE, *tracing, headers)) for name in CODEC_SOURCES]
    jobs += [
        (target, (*SANITIZE, *(["-DFHASH_FUZZ_MARCH"] if march else []))) for target in TARGETS
    ]

    def compiled(job: tuple[Path, tuple[str, ...]]) -> Path:
        source, flags = job
        result = folder / f"{source.stem}.o"
        _compile(
            [*compiler.split(), optimise, *FLAGS, *flags, "-c", str(source), "-o", str(result)]
        )
        return result

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compiled, jobs))
    binary = folder / "fuzzer"
    _compile([*compiler.split(), *SANITIZE, *map(str, objects), "-o", str(binary)])
    return binary


def _compile(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise CannotBuild(
            f"{command[0]} does not build this with {SANITIZE[0]} and trace-pc: {last}"
        )


def prepare(folder: Path) -> dict[str, str]:
    """Write setups and seeds into a folder; the environment that the fuzzer needs."""
    sys.path.insert(0, str(HERE))
    try:
        import seeds
    finally:
        sys.path.remove(str(HERE))
    seeds.write_seeds(folder / "corpus", *seeds.write_setups(folder / "setups"))
    return {**os.environ, **ENVIRONMENT, "FHASH_FUZZ_SETUPS": str(folder / "setups")}


def fuzz(
    folder: Path, crashes: Path, *, seconds: float, processes: int, seed: int = 0, **options: Any
) -> Found:
    """Build, with options of `build`, and run; raises CannotBuild."""
    binary = build(folder, **options)
    environment = prepare(folder)
    result = Found()
    with ThreadPoolExecutor(processes) as pool:
        work = [
            pool.submit(_one, folder, binary, environment, crashes, seconds, seed, number)
            for number in range(processes)
        ]
        for one in work:
            found = one.result()
            result.executions += found.executions
            result.edges = max(result.edges, found.edges)
            result.kept += found.kept
            result.crashes += found.crashes
    return result


def _one(
    folder: Path,
    binary: Path,
    environment: dict[str, str],
    crashes: Path,
    seconds: float,
    seed: int,
    number: int,
) -> Found:
    """One process after the other, until the time is over: after a crash another one with another seed."""
    result, end, turn = Found(), time.monotonic() + seconds, 0
    while (left := end - time.monotonic()) > 0:
        current = folder / f"current-{number}"
        command = [
            str(binary),
            str(folder / "corpus"),
            str(current),
            f"{left:.1f}",
            str(1_000_003 * seed + 1009 * number + turn),
        ]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        turn += 1
        if done.returncode == 0:
            executions, edges, kept = map(int, done.stdout.split())
            result.executions += executions
            result.edges = max(result.edges, edges)
            result.kept += kept
            continue
        data = current.read_bytes()
        data = data[8 : 8 + struct.unpack_from("<Q", data)[0]]
        crashes.mkdir(parents=True, exist_ok=True)
        path = crashes / f"crash-{hashlib.sha256(data).hexdigest()[:16]}"
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(
            f"exit code {done.returncode}\n{done.stderr}", encoding="utf-8"
        )
        result.crashes.append(path)
    return result


def repeat(path: Path, march: bool) -> int:
    """Run one input; the exit code of the fuzzer."""
    with tempfile.TemporaryDirectory(prefix="fhash-fuzz-") as folder:
        binary = build(Path(folder), march=march)
        return subprocess.run([str(binary), str(path)], env=prepare(Path(folder))).returncode


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="how long each process runs")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--crashes", type=Path, help="folder for inputs that crash; kept")
    parser.add_argument("--march", action="store_true", help="the marcher as well")
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="run this input alone")
    options = parser.parse_args()
    if options.repeat is not None:
        return repeat(options.repeat, options.march)
    kept = options.crashes or Path(tempfile.mkdtemp(prefix="fhash-fuzz-crashes-"))
    with tempfile.TemporaryDirectory(prefix="fhash-fuzz-") as folder:
        try:
            found = fuzz(
                Path(folder),
                kept,
                seconds=options.seconds,
                processes=options.processes,
                seed=options.seed,
                march=options.march,
            )
        except CannotBuild as error:
            print(f"fuzz: {error}", file=sys.stderr)
            return 2
    sys.path.insert(0, str(HERE.parent))
    from reporting import record

    figures = {
        "seconds": options.seconds,
        "processes": options.processes,
        "executions": found.executions,
    }
    record(
        "the native code under sanitizers",
        {**figures, "edges": found.edges, "crashes": len(found.crashes)},
    )
    print(
        f"{found.executions} executions, {found.edges} edges, {found.kept} inputs kept, {len(found.crashes)} crashes"
    )
    for path in found.crashes:
        print(f"{path}: {path.with_suffix('.txt').read_text(encoding='utf-8').splitlines()[1:2]}")
    if not found.crashes and options.crashes is None:
        kept.rmdir()
    return 1 if found.crashes else 0


if __name__ == "__main__":
    sys.exit(main())
