"""Hostile files through the commands of `fhash`, in a pool of worker processes (hostile_trial.py).

If a worker ends or hangs, its mutation counts as a crash, and another worker is started.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import mutations

HANG = 600.0
"""Seconds without an answer after which a worker is ended: it waits for ever, since processor time
has a limit of its own."""


@dataclass
class Report:
    """The results of all mutations.

    Ends are counted by command and by kind; `met` has the goldens that each kind changed. The worst
    figures are kept with the number of their mutation.
    """

    mutations: int = 0
    ends: dict[str, Counter[str]] = field(default_factory=dict)
    kinds: dict[str, Counter[str]] = field(default_factory=dict)
    met: dict[str, set[str]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    worst_seconds: tuple[float, str] = (0.0, "")
    worst_bytes: tuple[int, str] = (0, "")

    def add(self, answer: dict[str, Any]) -> None:
        """Add a worker's answer about one mutation."""
        self.mutations += 1
        name = f"{answer['number']} ({answer['kind']} of {answer['golden']})"
        self.met.setdefault(answer["kind"], set()).add(answer["golden"])
        for end in answer["ends"]:
            self.ends.setdefault(end["command"], Counter())[end["end"]] += 1
            self.kinds.setdefault(answer["kind"], Counter())[end["end"]] += 1
            self.worst_seconds = max(
                self.worst_seconds, (end["seconds"], f"{name}, {end['command']}")
            )
            self.worst_bytes = max(self.worst_bytes, (end["bytes"], f"{name}, {end['command']}"))
            if end["wrong"]:
                self.wrong.append(f"{name}, {end['command']}: {end['wrong']}")

    def figures(self) -> dict[str, Any]:
        """Return JSON values."""
        return {
            "mutations": self.mutations,
            "wrong": len(self.wrong),
            "worst_seconds": round(self.worst_seconds[0], 3),
            "slowest": self.worst_seconds[1],
            "worst_bytes": self.worst_bytes[0],
            "largest": self.worst_bytes[1],
            "command": {command: dict(counts) for command, counts in self.ends.items()},
            "kind of mutation": {kind: dict(counts) for kind, counts in sorted(self.kinds.items())},
        }


def trials(numbers: Iterable[int], processes: int, folder: Path) -> Report:
    """Run mutations in worker processes."""
    waiting: SimpleQueue[int] = SimpleQueue()
    for number in numbers:
        waiting.put(number)
    report = Report()
    with ThreadPoolExecutor(processes) as pool:
        for answers in pool.map(
            lambda worker: list(_answers(waiting, folder / str(worker))), range(processes)
        ):
            for answer in answers:
                report.add(answer)
    return report


def _answers(waiting: SimpleQueue[int], folder: Path) -> Iterator[dict[str, Any]]:
    folder.mkdir(parents=True, exist_ok=True)
    process = None
    while not waiting.empty():
        try:
            number = waiting.get_nowait()
        except Empty:  # another worker took the last one
            break
        process = process or _started(folder)
        line = _asked(process, number)
        if line:
            yield json.loads(line)
            continue
        process.kill()
        code = _ended(process)
        process = None
        how = (
            f"the process ended by {signal.Signals(-code).name}"
            if code < 0
            else f"the process ended with exit code {code}"
        )
        yield _crashed(number, how)
    if process is not None:
        _ended(process)


def _ended(process: subprocess.Popen[str]) -> int:
    """Let a worker end and return its exit code."""
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(OSError):  # text that a crashed worker did not read
        process.stdin.close()
    code = process.wait()
    process.stdout.close()
    return code


def _started(folder: Path) -> subprocess.Popen[str]:
    # A heap of glibc that checks itself: the process ends if it frees an array behind whose end
    # something was written.
    checks = {"LD_PRELOAD": "libc_malloc_debug.so.0", "MALLOC_CHECK_": "3"}
    found = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # what pytest has put there
    environment = {**os.environ, **checks, **found, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).with_name("hostile_trial.py")), str(folder)]
    with (folder / "log").open("a") as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=environment,
        )


def _asked(process: subprocess.Popen[str], number: int) -> str:
    """Return the worker's answer; empty if it ended or hangs."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(f"{number}\n")
        process.stdin.flush()
    except OSError:
        return ""
    ready, _, _ = select.select([process.stdout], [], [], HANG)
    return process.stdout.readline() if ready else ""


def _crashed(number: int, how: str) -> dict[str, Any]:
    mutation = mutations.mutation(number)
    end = {"command": "any", "end": "crashed", "seconds": 0.0, "bytes": 0, "wrong": how}
    return {"number": number, "kind": mutation.kind, "golden": mutation.golden, "ends": [end]}
