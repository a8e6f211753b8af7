"""A small series, the commands that the tests of faults disturb, and what these must leave."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from folders import Listing, listing
from reporting import LONG

HERE = Path(__file__).parent
Injection = tuple[Any, ...]


def build_faults(folder: Path) -> Path | None:
    """Compile `faults.c` and return the library; None without a compiler or without preloading."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        return None
    target = folder / "faults.so"
    words = [compiler, "-shared", "-fPIC", "-O1", "-o", str(target), str(HERE / "faults.c"), "-ldl"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return target if done.returncode == 0 else None


@dataclass(frozen=True, kw_only=True)
class Ended:
    """The end of a command line: exit code, or minus the signal; stdout and stderr together."""

    code: int
    output: str

    @property
    def line(self) -> str:
        """The only line that it printed."""
        lines = self.output.splitlines()
        assert len(lines) == 1, self.output
        return lines[0]


class Running:
    """A command line that runs."""

    def __init__(self, server: Server, pid: int, log: Path) -> None:
        self.server, self.pid, self.log = server, pid, log

    def kill(self, number: int) -> None:
        """Send a signal."""
        os.kill(self.pid, number)

    def wait(self) -> Ended:
        """Wait for its end."""
        code = self.server.ask({"wait": self.pid})
        # Killed before it had begun, it has none.
        return Ended(
            code=code, output=self.log.read_text(errors="replace") if self.log.exists() else ""
        )


class Server:
    """The process that forks.

    `faults` is the library of `build_faults`, which is preloaded.
    """

    def __init__(self, folder: Path, faults: Path | None) -> None:
        self.folder, self.faults, self.count = folder, faults, 0
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "FHASH_FAULTS": str(faults or "")}
        if faults is not None:
            environment["LD_PRELOAD"] = str(faults)
        words = [sys.executable, str(HERE / "fork_server.py")]
        self.process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        assert self._answer() == "ready"

    def _answer(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def ask(self, request: dict[str, Any]) -> int:
        """Send a request and return the number that is the answer."""
        assert self.process.stdin is not None
        print(json.dumps(request), file=self.process.stdin, flush=True)
        return int(self._answer())

    def start(self, *words: object, inject: Sequence[Injection] = ()) -> Running:
        """Start `fhash WORDS`; `inject` lists functions of `injections` by name, with their
        arguments."""
        self.count += 1
        log = self.folder / f"{self.count}.log"
        pid = self.ask(
            {
                "words": [str(word) for word in words],
                "log": str(log),
                "inject": [
                    [str(v) if isinstance(v, Path) else v for v in injection]
                    for injection in inject
                ],
            }
        )
        return Running(self, pid, log)

    def run(self, *words: object, inject: Sequence[Injection] = ()) -> Ended:
        """Run `fhash WORDS` to its end."""
        return self.start(*words, inject=inject).wait()

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


COMPACT = ("--effort", "1", "--no-timings", "-q")
BOUND = ("--max-error", "0.05", "--tile", "2x9x10x12", *COMPACT)
PAPER = (
    "--preset",
    "published",
    "--tables",
    "float16",
    "--epochs",
    "2",
    "--width",
    "4",
    "--no-timings",
    "-q",
)
PRESETS = {"default": COMPACT, "published": PAPER}
FORMATS = ("npy", "h5", "nc", "zarr", "raw", "vti", "vtr", "pvd", "vtkhdf")
SHAPE = (4, 9, 10, 12)


def values(seed: int = 0) -> np.ndarray:
    """Return a moving blob with noise, float32 (t, z, y, x)."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    blob = 1 + 9 * np.exp(-((z - 4) ** 2 + (y - 5) ** 2 + (x - 3 - 2 * t) ** 2) / 6)
    return (blob + 0.01 * np.random.default_rng(seed).standard_normal(SHAPE)).astype(np.float32)


def moments(count: int, most: int = 4) -> list[int]:
    """Return which of `count` operations to disturb.

    All of them in the long set, else at most `most`, evenly spread from the first to the last.
    """
    return sorted({round(n) for n in np.linspace(1, count, count if LONG else min(count, most))})


class Bench:
    """A folder `out` into which commands write, with an older output of other data in it.

    The inputs of the commands, two series and their containers, lie beside it.
    """

    def __init__(self, server: Server, folder: Path) -> None:
        self.server, self.folder, self.out = server, folder, folder / "out"
        self.out.mkdir()
        for number in range(2):
            (folder / str(number)).mkdir()
            np.save(self._place("in", number), values(number))
            self._succeed(
                ["encode", self._place("in", number), "-o", self._place("run", number), *COMPACT]
            )
        self._write_more()
        self._known: dict[str, tuple[Listing, Listing, int]] = {}

    def words(self, name: str, number: int = 0) -> list[str]:
        """Return the command line of COMMANDS[name]; number 1 is that of the older output."""
        places = {
            "in": self._place("in", number),
            "run": self._place("run", number),
            "several": self.folder / str(number) / "several.h5",
            "part1": self.folder / str(number) / "part1.fhz",
            "part2": self.folder / str(number) / "part2.fhz",
            "more": self.folder / "more.npy",
            "out": self.out,
        }
        return [word.format_map(places) for word in COMMANDS[name]]

    def run(self, name: str, *inject: Injection, force: bool = True) -> Ended:
        """Run a command; without `force`, one that replaces nothing."""
        return self.server.run(
            *(word for word in self.words(name) if force or word != "--force"), inject=inject
        )

    def start(self, name: str, *inject: Injection, number: int = 0) -> Running:
        """Start a command."""
        return self.server.start(*self.words(name, number), inject=inject)

    def old(self, name: str) -> Listing:
        """Put only the older output into the folder, and return what is then in it."""
        old = self._known_of(name)[0]
        self.empty()
        for place, data in old.items():
            if data is None:
                (self.out / place).mkdir()
            else:
                (self.out / place).write_bytes(data)
        return old

    def new(self, name: str) -> Listing:
        """Return what is in the folder after the undisturbed command."""
        return self._known_of(name)[1]

    def operations(self, name: str) -> int:
        """Return the number of file operations in the folder while the command replaces the older
        output."""
        return self._known_of(name)[2]

    def now(self) -> Listing:
        """Return what is in the folder."""
        return listing(self.out)

    def empty(self) -> None:
        """Empty the folder."""
        shutil.rmtree(self.out)
        self.out.mkdir()

    def _known_of(self, name: str) -> tuple[Listing, Listing, int]:
        if name not in self._known:
            outputs = []
            self.empty()
            if name in GROWING:
                shutil.copy(self.folder / "grown.fhz", self.out / "a.fhz")
                outputs.append(self.now())
            for number in (0,) if outputs else (1, 0):
                counted = self.folder / "operations"
                self._succeed(self.words(name, number), ("at_operation", self.out, 0, 0, counted))
                outputs.append(self.now())
            assert outputs[0].keys() == outputs[1].keys()
            assert outputs[0] != outputs[1]
            self._known[name] = outputs[0], outputs[1], int(counted.read_text())
        return self._known[name]

    def _succeed(self, words: Sequence[object], *inject: Injection) -> None:
        ended = self.server.run(*words, inject=inject)
        assert ended.code == 0, ended.output

    def _write_more(self) -> None:
        """Write the inputs of commands on several variables, parts and files that grow."""
        import h5py

        for number in range(2):
            folder = self.folder / str(number)
            with h5py.File(folder / "several.h5", "w") as file:
                file["u"], file["v"] = values(number), values(number + 5)
            for part in (1, 2):
                words = ("encode", folder / "in.npy", "-o", folder / f"part{part}.fhz")
                self._succeed([*words, "--part", f"{part}/2", *BOUND])
        np.save(self.folder / "more.npy", values(3))
        self._succeed(["encode", self._place("in", 1), "-o", self.folder / "grown.fhz", *BOUND])

    def _place(self, kind: str, number: int) -> Path:
        return (
            self.folder / str(number) / ("in.npy" if kind == "in" else "run.fhz")
        )  # the variable is called after the file


GROWING = ("append",)
"""Commands that change a file which is there before."""
COMMANDS = {
    **{
        f"encode {name}": ("encode", "{in}", "-o", "{out}/a.fhz", "--force", *words)
        for name, words in PRESETS.items()
    },
    **{
        f"decode {suffix}": ("decode", "{run}", "-o", f"{{out}}/a.{suffix}", "--force", "-q")
        for suffix in FORMATS
    },
    "encode several": (
        *("encode", "{several}", "--var", "all", "-o", "{out}/a.fhz", "--force", *COMPACT),
    ),
    "merge": ("merge", "{part1}", "{part2}", "-o", "{out}/a.fhz", "--force", "-q"),
    "append": ("append", "{out}/a.fhz", "{more}", "--keep", "4", "-q"),
    "decode vtp": (
        "decode",
        "{run}",
        "--isosurface",
        "5",
        "--t",
        "0",
        "-o",
        "{out}/a.vtp",
        "--force",
        "-q",
    ),
    "render png": ("render", "{run}", "-o", "{out}/a.png", "--size", "40x30", "--force", "-q"),
    "render gif": (
        "render",
        "{run}",
        "-o",
        "{out}/a.gif",
        "--animate",
        "steps",
        "--size",
        "40x30",
        "--force",
        "-q",
    ),
    "render pictures": (
        "render",
        "{run}",
        "-o",
        "{out}/a.png",
        "--animate",
        "steps",
        "--size",
        "20x16",
        "--force",
        "-q",
    ),
}
"""Command lines by name; {in} is the series, {run} a container and {out} the folder for outputs."""
