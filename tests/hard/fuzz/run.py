"""A coverage-guided fuzzer of the native code, under address and undefined-behaviour sanitizers.

    python tests/hard/fuzz/run.py --seconds 600

The script builds into a temporary folder, runs one process per processor (or --processes), and
prints one line: executions, edges, inputs that were kept, crashes. An input that crashes or hangs
is saved with the message of the sanitizers in the folder --crashes (by default a temporary folder,
which the output names). The exit code is 1 if there was a crash, 2 if nothing can be built.
--repeat FILE runs one input alone.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
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
NETWORK = CODEC / "network"
"""Sources of the network's library, likewise."""
TARGETS = tuple(
    HERE / f"{name}.cpp"
    for name in (
        "targets",
        "target_coding",
        "target_file",
        "target_points",
        "target_tile",
        "target_values",
    )
)
SOURCES = (
    *("coder", "fast", "trellis", "mask", "mask_levels", "predict", "labels"),
    *("coder_v3", "fast_v3", "trellis_v3", "mask_v3", "predict_v3", "labels_v3"),
    *(
        "lifting",
        "head",
        "between",
        "quantise",
        "values",
        "crc32c",
        "prior_bytes",
        "priors",
        "inflate",
    ),
    *(
        "settings",
        "basis",
        "coding",
        "plan",
        "planner",
        "differences",
        "tile",
        "choose",
        "encode",
        "chunk",
        "part",
        "region",
        "blocks",
        "cut",
    ),
    "files",
)
"""Files of NATIVE that are always fuzzed."""
LIBRARIES = ("yyjson", "zlib", "zstd")
"""Folders of NATIVE / "third_party", in C, which only the address sanitizer watches."""
CODEC_SOURCES = (*("gram", "head_inputs", "march_light", "march_slopes", "quality", "train_head"),)
"""Files of CODEC that are always fuzzed."""
NETWORK_SOURCES = ("peak", "points", "kernels_v1", "kernels_v3", "kernels_v4")
"""Files of NETWORK that are always fuzzed."""
MARCH = ("march", "march_v3", "march_v4", "march_bricks")
"""Files of CODEC that are fuzzed on request, without optimisation.

The compiler takes one minute for them; with optimisation it takes ten.
"""
SANITIZE = (
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
    "-g",
)
# No target_clones: the functions that choose a clone run before the sanitizers are ready.
FLAGS = ("-std=c++17", "-ffp-contract=off", "-Dtarget_clones(...)=", "-Wno-attributes")
ENVIRONMENT = {
    "ASAN_OPTIONS": "detect_leaks=1:abort_on_error=0:exitcode=99",
    "UBSAN_OPTIONS": "print_stacktrace=1",
}


class CannotBuild(Exception):
    """There is no compiler with these sanitizers."""


@dataclass
class Figures:
    """The work of all processes of the fuzzer.

    Attributes:
        executions: inputs that were run.
        edges: the most edges that one process passed.
        kept: mutated inputs that were kept since they passed a new edge.
        crashes: files of the inputs that crashed.
    """

    executions: int = 0
    edges: int = 0
    kept: int = 0
    crashes: list[Path] = field(default_factory=list)


def build(folder: Path, optimise: str = "-O1", march: bool = False) -> Path:
    """Compile the fuzzer into a folder and return its path; raises CannotBuild with the reason.

    Args:
        folder: where the fuzzer is built.
        optimise: level of optimisation. -O1 compiles five times as long as -O0, and the fuzzer runs
            three times as fast.
        march: whether the marcher is fuzzed, too.
    """
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler.split()[0]) is None:
        raise CannotBuild(f"no compiler {compiler}")
    folder.mkdir(parents=True, exist_ok=True)
    _require_sanitizers(compiler, folder)
    tracing, headers = ("-fsanitize-coverage=trace-pc",), f"-I{NATIVE}"
    jobs: list[tuple[Path, tuple[str, ...]]] = [(HERE / "driver.cpp", ("-fsanitize=address", "-g"))]
    if march:
        # Unused lanes of vectors may hold NaN, so float-cast-overflow would report them.
        jobs += [
            (
                CODEC / f"{name}.cpp",
                (*SANITIZE, *tracing, headers, "-fno-sanitize=float-cast-overflow", "-O0"),
            )
            for name in MARCH
        ]
        jobs += [(HERE / "target_march.cpp", (*SANITIZE, headers, f"-I{CODEC}"))]
    jobs += [(NATIVE / f"{name}.cpp", (*SANITIZE, *tracing, headers)) for name in SOURCES]
    jobs += [
        (path, ("-xc", "-std=gnu11", "-w", "-DZSTD_DISABLE_ASM=1", "-fsanitize=address", "-g"))
        for name in (LIBRARIES if SOURCES else ())
        for path in (NATIVE / "third_party" / name).rglob("*.c")
    ]
    jobs += [(CODEC / f"{name}.cpp", (*SANITIZE, *tracing, headers)) for name in CODEC_SOURCES]
    jobs += [(NETWORK / f"{name}.cpp", (*SANITIZE, *tracing, headers)) for name in NETWORK_SOURCES]
    jobs += [
        (target, (*SANITIZE, headers, *(["-DFHASH_FUZZ_MARCH"] if march else [])))
        for target in TARGETS
    ]

    def compiled(job: tuple[Path, tuple[str, ...]]) -> Path:
        source, flags = job
        result = folder / f"{source.parent.name}-{source.stem}.o"
        _compile(
            [*compiler.split(), optimise, *FLAGS, *flags, "-c", str(source), "-o", str(result)]
        )
        return result

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compiled, jobs))
    binary = folder / "fuzzer"
    _compile([*compiler.split(), *SANITIZE, *map(str, objects), "-o", str(binary)])
    return binary


def declared() -> dict[str, list[str]]:
    """Return the functions of each file of the three libraries, as their headers name them."""
    headers = (NATIVE / "functions.h", CODEC / "codec.h", NETWORK / "network.h")
    text = "".join(header.read_text(encoding="utf-8") for header in headers)
    _, *parts = re.split(r"/\* (\w+)\.cpp \*/", text)
    files = zip(parts[::2], parts[1::2], strict=True)
    return {file: re.findall(r"^\w.* \*?(fhash_\w+)\(", body, re.MULTILINE) for file, body in files}


def _compile(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the fuzzer does not compile: {done.stderr[-2000:]}")


def _require_sanitizers(compiler: str, folder: Path) -> None:
    """Raise CannotBuild where a compiler does not build a program of one line."""
    source = folder / "probe.cpp"
    source.write_text("int main() { return 0; }\n", encoding="utf-8")
    command = [*compiler.split(), *SANITIZE, "-fsanitize-coverage=trace-pc", str(source)]
    # The function that trace-pc calls is the driver's; none is here, so that nothing is linked.
    for more in (["-c"], ["-fno-sanitize-coverage=trace-pc"]):
        done = subprocess.run(
            [*command, *more, "-o", str(folder / "probe")], capture_output=True, text=True
        )
        if done.returncode:
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            raise CannotBuild(f"{compiler} does not build with {SANITIZE[0]} and trace-pc: {last}")


def prepare(folder: Path, every: int = 1, only: str | None = None) -> dict[str, str]:
    """Write setups and seeds into a folder, and return the environment that the fuzzer needs.

    With `every`, only every so many of the seeds of each kind are written, with `only` those of one
    target.
    """
    sys.path[:0] = found = [str(HERE), str(HERE.parents[1])]
    try:
        import seeds
    finally:
        for place in found:
            sys.path.remove(place)
    folder.mkdir(parents=True, exist_ok=True)
    seeds.write_seeds(folder / "corpus", *seeds.write_setups(folder / "setups"), every, only)
    chosen = {} if only is None else {"FHASH_FUZZ_TARGET": str(seeds.NAMES.index(only))}
    return {**os.environ, **ENVIRONMENT, **chosen, "FHASH_FUZZ_SETUPS": str(folder / "setups")}


def fuzz(
    folder: Path,
    crashes: Path,
    *,
    seconds: float,
    processes: int,
    seed: int = 0,
    every: int = 1,
    only: str | None = None,
    **options: Any,
) -> Figures:
    """Build the fuzzer and run it.

    Args:
        folder: where the fuzzer is built and its corpus lies.
        crashes: where inputs that crash are saved.
        seconds: how long each process runs after it has run all seeds.
        processes: number of processes at the same time.
        seed: seed of the mutations.
        every: share of the seeds that are run: every so many of each kind.
        only: name of the one target that is fuzzed (NAMES of seeds.py); None for all.
        **options: options of `build`.

    Raises CannotBuild.
    """
    binary = build(folder, **options)
    environment = prepare(folder, every, only)
    result = Figures()
    with ThreadPoolExecutor(processes) as pool:
        futures = [
            pool.submit(_run_process, folder, binary, environment, crashes, seconds, seed, number)
            for number in range(processes)
        ]
        for future in futures:
            figures = future.result()
            result.executions += figures.executions
            result.edges = max(result.edges, figures.edges)
            result.kept += figures.kept
            result.crashes += figures.crashes
    return result


def _run_process(
    folder: Path,
    binary: Path,
    environment: dict[str, str],
    crashes: Path,
    seconds: float,
    seed: int,
    number: int,
) -> Figures:
    """Run one process after the other until the time is over.

    After a crash, another process starts with another seed.
    """
    result, end, turn = Figures(), time.monotonic() + seconds, 0
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
    """Run one input and return the exit code of the fuzzer."""
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
    parser.add_argument("--only", metavar="TARGET", help="one target, by its name in seeds.py")
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="run this input alone")
    options = parser.parse_args()
    if options.repeat is not None:
        return repeat(options.repeat, options.march)
    kept = options.crashes or Path(tempfile.mkdtemp(prefix="fhash-fuzz-crashes-"))
    march = options.march or options.only == "march"
    with tempfile.TemporaryDirectory(prefix="fhash-fuzz-") as folder:
        try:
            result = fuzz(
                Path(folder),
                kept,
                seconds=options.seconds,
                processes=options.processes,
                seed=options.seed,
                only=options.only,
                march=march,
            )
        except CannotBuild as error:
            print(f"fuzz: {error}", file=sys.stderr)
            return 2
    sys.path.insert(0, str(HERE.parent))
    from reporting import record

    figures = {
        "target": options.only or "all",
        "seconds": options.seconds,
        "processes": options.processes,
        "executions": result.executions,
    }
    record(
        "the native code under sanitizers",
        {**figures, "edges": result.edges, "crashes": len(result.crashes)},
    )
    print(
        f"{result.executions} executions, {result.edges} edges, {result.kept} inputs kept, "
        f"{len(result.crashes)} crashes"
    )
    for path in result.crashes:
        print(f"{path}: {path.with_suffix('.txt').read_text(encoding='utf-8').splitlines()[1:2]}")
    if not result.crashes and options.crashes is None:
        kept.rmdir()
    return 1 if result.crashes else 0


if __name__ == "__main__":
    sys.exit(main())
