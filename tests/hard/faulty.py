"""What the tests of faults share: a small series, the commands that they disturb, and what must stay."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from forks import Ended, Injection, Running, Server
from reporting import LONG

Listing = dict[str, bytes | None]

COMPACT = ("--effort", "1", "--no-timings", "-q")
PAPER = ("--profile", "paper", "--epochs", "2", "--width", "4", "--no-timings", "-q")
PROFILES = {"compact": COMPACT, "paper": PAPER}
FORMATS = ("npy", "h5", "nc", "zarr", "raw", "vti", "vtr", "pvd", "vtkhdf")
SHAPE = (4, 9, 10, 12)


def values(seed: int = 0) -> np.ndarray:
    """A moving blob with noise, (t, z, y, x) float32."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    blob = 1 + 9 * np.exp(-((z - 4) ** 2 + (y - 5) ** 2 + (x - 3 - 2 * t) ** 2) / 6)
    return (blob + 0.01 * np.random.default_rng(seed).standard_normal(SHAPE)).astype(np.float32)


def listing(folder: Path) -> Listing:
    """Everything below a folder with its bytes (None for a folder)."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def moments(count: int, most: int = 6) -> list[int]:
    """Which of `count` operations to disturb: all of them in the long set, else some from the first to the last."""
    return sorted({round(n) for n in np.linspace(1, count, count if LONG else min(count, most))})


class Bench:
    """A folder `out` to which commands write, with an older output of other data in it, and what they are made from beside it."""

    def __init__(self, server: Server, folder: Path) -> None:
        self.server, self.folder, self.out = server, folder, folder / "out"
        self.out.mkdir()
        for number in range(2):
            (folder / str(number)).mkdir()
            np.save(self._place("in", number), values(number))
            self._succeed(
                ["encode", self._place("in", number), "-o", self._place("run", number), *COMPACT]
            )
        self._known: dict[str, tuple[Listing, Listing, int]] = {}

    def words(self, name: str, number: int = 0) -> list[str]:
        """The command line of COMMANDS[name]; number: 1 for that of the older output."""
        places = {
            "in": self._place("in", number),
            "run": self._place("run", number),
            "out": self.out,
        }
        return [word.format_map(places) for word in COMMANDS[name]]

    def run(self, name: str, *inject: Injection, force: bool = True) -> Ended:
        """Run a command; without `force` it is one that replaces nothing."""
        return self.server.run(
            *(word for word in self.words(name) if force or word != "--force"), inject=inject
        )

    def start(self, name: str, *inject: Injection, number: int = 0) -> Running:
        """Start a command."""
        return self.server.start(*self.words(name, number), inject=inject)

    def old(self, name: str) -> Listing:
        """Put the older output into the folder, and nothing else; what is then in it."""
        old = self._known_of(name)[0]
        self.empty()
        for place, data in old.items():
            if data is None:
                (self.out / place).mkdir()
            else:
                (self.out / place).write_bytes(data)
        return old

    def new(self, name: str) -> Listing:
        """What is in the folder once the command is done."""
        return self._known_of(name)[1]

    def operations(self, name: str) -> int:
        """How many operations on files in the folder the command makes while it replaces the older output."""
        return self._known_of(name)[2]

    def now(self) -> Listing:
        """What is in the folder."""
        return listing(self.out)

    def empty(self) -> None:
        """Leave nothing in the folder."""
        shutil.rmtree(self.out)
        self.out.mkdir()

    def _known_of(self, name: str) -> tuple[Listing, Listing, int]:
        if name not in self._known:
            found = []
            self.empty()
            for number in (1, 0):
                counted = self.folder / "operations"
                self._succeed(self.words(name, number), ("at_operation", self.out, 0, 0, counted))
                found.append(self.now())
            assert found[0].keys() == found[1].keys()
            assert found[0] != found[1]
            self._known[name] = found[0], found[1], int(counted.read_text())
        return self._known[name]

    def _succeed(self, words: Sequence[object], *inject: Injection) -> None:
        ended = self.server.run(*words, inject=inject)
        assert ended.code == 0, ended.output

    def _place(self, kind: str, number: int) -> Path:
        return (
            self.folder / str(number) / ("in.npy" if kind == "in" else "run.fhz")
        )  # the variable is called after the file


COMMANDS = {
    **{
        f"encode {name}": ("encode", "{in}", "-o", "{out}/a.fhz", "--force", *words)
        for name, words in PROFILES.items()
    },
    **{
        f"decode {suffix}": ("decode", "{run}", "-o", f"{{out}}/a.{suffix}", "--force", "-q")
        for suffix in FORMATS
    },
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
"""Command lines by name; {in}, {run} and {out} stand for the series, a container and the folder of the outputs."""
