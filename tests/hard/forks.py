"""Command lines in processes that start in milliseconds and can be killed.

One process imports fhash once and runs each command line in a fork of itself.
"""

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
