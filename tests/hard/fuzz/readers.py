"""A fuzzer of the readers of files: mutated sound files, read under limits of time and memory.

    python tests/hard/fuzz/readers.py --seconds 600

Sound files of a few kB, one of each format that this project reads itself, are in `sources`;
`hostile` holds inputs that once hung, took all memory or ended with another error. An input is
right if it is read, or refused by one line (FhashError). The script prints one line; an input that
is wrong is saved in the folder --keep with the reason. The exit code is 1 if there was one.
"""

from __future__ import annotations

import argparse
import gzip
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from fhash_formats.errors import FhashError
from fhash_formats.readers.registry import list_variables, open_series

HERE = Path(__file__).parent
SOURCES, HOSTILE = HERE / "sources", HERE / "hostile"
SECONDS = 5
"""Processor time of one input; sound ones take milliseconds."""
MEMORY = 2 << 30
"""Address space that a process may take beside what it has at the start."""
BATCH = 200
"""Inputs of one process."""
VARIABLES = 3
"""Variables of an input that are read."""

COMPANIONS = {"a.vti": "ascii.vti", "b.vti": "zlib.vti"}
COMPANIONS |= {f"s00{n}.raw": "density_5x4x3x2_float32.raw" for n in (1, 2, 3)}
"""Files that others name, and the sources that they are."""

NUMBERS = (
    *(b"0", b"-1", b"1", b"255", b"65536", b"16777217", b"2147483647", b"4294967296"),
    *(b"9223372036854775807", b"18446744073709551616", b"1" + b"0" * 400, b"1e308", b"nan", b"inf"),
)
"""Texts that replace numbers."""
EXTREMES = (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40)
EXTREMES += (2**63 - 1, 2**63, 2**64 - 1)
"""Integers that replace bytes."""


def problem(path: Path) -> str:
    """The fault in the reading of a file; "" where it is read, or refused by one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            names = [each.name for each in list_variables(path, no_external=True)]
            for name in names[:VARIABLES]:
                try:
                    _read(path, name)
                except FhashError as error:
                    if "\n" in str(error):
                        return f"a message of several lines: {error}"
    except FhashError as error:
        return f"a message of several lines: {error}" if "\n" in str(error) else ""
    except Exception:
        return traceback.format_exc()
    return ""


def _read(path: Path, name: str) -> None:
    """Read the first and the last step of a variable, at the first place of what must be chosen."""
    (listed,) = list_variables(path, var=name, no_external=True)
    select = {each: 0 for each, axis in listed.dimensions if axis == "select"}
    axes = "t,z,y,x" if "?" in [axis for _, axis in listed.dimensions] else None
    wishes = {"var": name if len(list_variables(path)) > 1 else None}
    with open_series(path, select=select, axes=axes, no_external=True, **wishes) as series:
        for step in {0, series.shape[0] - 1}:
            series.read(step)
        _ = series.metadata


def _flipped(chance: random.Random, data: bytearray) -> bytes:
    for _ in range(chance.choice((1, 1, 2, 8, 32))):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return bytes(data)


def _number(chance: random.Random, data: bytearray) -> bytes:
    """A number of a text is another."""
    found = list(re.finditer(rb"[-+]?\d+(?:\.\d*)?", bytes(data[:8192])))
    if not found:
        return _extreme(chance, data)
    match = chance.choice(found)
    return bytes(data[: match.start()]) + chance.choice(NUMBERS) + bytes(data[match.end() :])


def _extreme(chance: random.Random, data: bytearray) -> bytes:
    """An integer of 1 to 8 bytes is an extreme one, mostly in the header."""
    size = min(chance.choice((1, 2, 4, 8)), len(data))
    at = chance.randrange(min(len(data), chance.choice((64, 512, 1 << 20))) - size + 1)
    number = chance.choice(EXTREMES) % (1 << 8 * size)
    data[at : at + size] = number.to_bytes(size, chance.choice(("little", "big")))
    return bytes(data)


def _float(chance: random.Random, data: bytearray) -> bytes:
    at = 4 * chance.randrange(max(1, min(len(data), 1024) // 4 - 1))
    number = chance.choice((0.0, -1.0, float("nan"), float("inf"), 1e30, 1e-30))
    data[at : at + 4] = struct.pack(chance.choice("<>") + "f", number)
    return bytes(data)


MOST_REPEATED = 1 << 24
"""Bytes that a repeated part takes at most."""


def _repeated(chance: random.Random, data: bytearray) -> bytes:
    """A line, or a word of it, stands many times."""
    lines = bytes(data).splitlines(keepends=True)
    place = chance.randrange(min(len(lines), 60))
    part = lines[place] if chance.random() < 0.5 else chance.choice(lines[place].split() or [b" "])
    part = part if part.endswith(b"\n") else part + b" "
    # A binary file may be one long line.
    lines[place] += part * min(chance.choice((1, 3, 50, 3000)), MOST_REPEATED // len(part))
    return b"".join(lines)


def _cut(chance: random.Random, data: bytearray) -> bytes:
    return bytes(data[: chance.randrange(len(data))])


def _removed(chance: random.Random, data: bytearray) -> bytes:
    at = chance.randrange(len(data))
    return bytes(data[:at]) + bytes(data[at + chance.randrange(1, 64) :])


def _blanks(chance: random.Random, data: bytearray) -> bytes:
    """Many equal bytes stand somewhere."""
    at = chance.randrange(min(len(data), 2048))
    many = chance.choice((b" ", b"\n", b"(", b'"', b'\\"', b"#", b"    #\n", b"{", b"<a>", b"1 "))
    return bytes(data[:at]) + many * chance.choice((9, 300, 20_000)) + bytes(data[at:])


KINDS: tuple[Callable[[random.Random, bytearray], bytes], ...] = (
    *(_flipped, _number, _number, _extreme, _extreme, _float, _repeated, _cut, _removed, _blanks),
)


def mutated(chance: random.Random, data: bytes) -> bytes:
    """Other bytes of a file; those of a compressed one mostly change before they are packed."""
    packed = data[:2] == b"\x1f\x8b" and chance.random() < 0.8
    changed = gzip.decompress(data) if packed else data
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        changed = chance.choice(KINDS)(chance, bytearray(changed)) if changed else changed
    return gzip.compress(changed, mtime=0) if packed else changed


def inputs(seed: int) -> Iterator[tuple[str, bytes]]:
    """Mutated files without an end, each with its name; the same seed makes the same files."""
    chance = random.Random(seed)
    found = [(path.name, path.read_bytes()) for path in sorted(SOURCES.iterdir())]
    found += [(path.name, path.read_bytes()) for path in sorted(HOSTILE.glob("*"))]
    while True:
        name, data = chance.choice(found)
        yield name, mutated(chance, data)


def _child(folder: Path, batch: list[tuple[str, bytes]], answers: int) -> None:
    """Read a batch of inputs under limits; the number of each goes to a pipe before it is read."""
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + MEMORY, space + MEMORY))
    for name, source in COMPANIONS.items():
        (folder / name).write_bytes((SOURCES / source).read_bytes())
    for number, (name, data) in enumerate(batch):
        os.write(answers, f"{number}\n".encode())
        path = folder / name
        path.write_bytes(data)
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        _, most = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (int(used) + 1 + SECONDS, most))
        told = problem(path)
        if told:
            os.write(answers, b"!" + told.replace("\n", "\t").encode(errors="replace") + b"\n")


def run_batch(batch: list[tuple[str, bytes]]) -> list[tuple[int, str]]:
    """Numbers of the inputs of a batch that are wrong, each with the reason."""
    wrong, first = [], 0
    while first < len(batch):
        with tempfile.TemporaryDirectory(prefix="fhash-readers-") as folder:
            given, answers = os.pipe()
            process = os.fork()
            if process == 0:
                code = 1
                try:
                    os.close(given)
                    null = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(null, 2)
                    _child(Path(folder), batch[first:], answers)
                    code = 0
                finally:
                    os._exit(code)
            os.close(answers)
            with os.fdopen(given, encoding="utf-8") as told:
                lines = told.read().splitlines()
            _, status = os.waitpid(process, 0)
        at = first
        for line in lines:
            if line.startswith("!"):
                wrong.append((at, line[1:].replace("\t", "\n")))
            else:
                at = first + int(line)
        if status == 0:
            break
        how = signal.Signals(status).name if os.WIFSIGNALED(status) else f"exit code {status >> 8}"
        # the time of the system may be that of others: a machine that is out of memory
        if how != "SIGXCPU" or len(batch) == 1 or run_batch([batch[at]]):
            wrong.append((at, f"the process ended by {how}"))
        first = at + 1
    return wrong


def _work(keep: Path, seconds: float, seed: int, number: int) -> tuple[int, list[Path]]:
    """One process of `fuzz`."""
    for path in SOURCES.iterdir():
        problem(path)  # so that all modules are imported before the first fork
    end, done, saved, source = time.monotonic() + seconds, 0, [], inputs(1009 * seed + number)
    while time.monotonic() < end:
        batch = [next(source) for _ in range(BATCH)]
        for place, why in run_batch(batch):
            name, data = batch[place]
            keep.mkdir(parents=True, exist_ok=True)
            path = keep / f"{seed}-{number}-{done + place}-{name}"
            path.write_bytes(data)
            path.with_name(f"{path.name}.txt").write_text(why, encoding="utf-8")
            saved.append(path)
        done += len(batch)
    return done, saved


def fuzz(
    keep: Path, *, seconds: float, seed: int = 0, processes: int = 1
) -> tuple[int, list[Path]]:
    """The number of inputs that were read, and the files of those that are wrong, in a folder."""
    with ProcessPoolExecutor(processes) as pool:
        found = list(pool.map(partial(_work, keep, seconds, seed), range(processes)))
    return sum(done for done, _ in found), [path for _, saved in found for path in saved]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("build/hard/sources"))
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="read this file alone")
    options = parser.parse_args()
    if options.repeat is not None:
        told = run_batch([(options.repeat.name, options.repeat.read_bytes())])
        print(told[0][1] if told else "right")
        return len(told)
    given = {"seconds": options.seconds, "seed": options.seed, "processes": options.processes}
    done, wrong = fuzz(options.keep, **given)
    sys.path.insert(0, str(HERE.parent))
    from reporting import record

    record("mutated sources", {**given, "inputs": done, "wrong": len(wrong)})
    print(f"{done} inputs, {len(wrong)} wrong")
    for path in wrong:
        reason = path.with_name(f"{path.name}.txt").read_text(encoding="utf-8").strip()
        print(f"{path}: {reason.splitlines()[-1][:200]}")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
