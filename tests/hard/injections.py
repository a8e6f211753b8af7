"""Faults in a forked command line; a request to the fork server names the functions."""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

SHAPE = (4, 8, 9)
"""Vertices (z, y, x) of a frame of `write_steps`."""
BOUND = 1e-2
"""Bound of the error of `write_steps`."""


def at_operation(folder: str, number: int, code: int, counted: str = "") -> None:
    """Disturb the n-th operation on files below a folder.

    Args:
        folder: the folder.
        number: the operation, from 1 on; 0 only counts.
        code: above 0, the errno with which this and all later operations fail; below 0, minus the
            signal that the process sends itself.
        counted: a file outside the folder into which the number of operations is written at the
            end.
    """
    library = ctypes.CDLL(os.environ["FHASH_FAULTS"])
    library.fhash_fault_count.restype = ctypes.c_long
    library.fhash_faults(
        os.path.realpath(folder).encode(), ctypes.c_long(number), ctypes.c_int(code)
    )
    if counted:
        leave = sys.exit

        def end(code: Any = None) -> None:
            Path(counted).write_text(str(library.fhash_fault_count()))
            leave(code)

        sys.exit = end  # type: ignore[assignment]


def write_steps(path: str, count: str, resumes: str) -> None:
    """Write a file by `Writer`, step by step, and end as the command line does.

    Args:
        path: of the file.
        count: number of steps.
        resumes: "yes" to go on with a file whose last layer is whole.
    """
    import fhash_codec
    from fhash_cli.output import describe_error, say

    first = 0
    try:
        if resumes == "yes":
            writer = fhash_codec.Writer.resume(path)
            first = writer.steps
        else:
            writer = fhash_codec.Writer(path, shape=SHAPE, config=_grown_settings(), force=True)
        with writer:
            for step in range(first, int(count)):
                writer.append(frame(step))
    except KeyboardInterrupt:
        say("error: interrupted")
        sys.exit(130)
    except Exception as error:
        line, code = describe_error(error)
        say(f"error: {line}")
        sys.exit(code)
    sys.exit(0)


def frame(step: int) -> Any:
    """Return the values (z, y, x) of a step of `write_steps`."""
    import numpy as np

    z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return (np.sin(x / 3 + step) + np.cos(y / 2) + z / 4).astype(np.float32)


def _grown_settings() -> Any:
    from fhash_codec import EncodeConfig

    return EncodeConfig(max_error=BOUND, effort=1, tile="2x4x8x9", timings=False)


def file_limit(size: int) -> None:
    """Limit the length of files, bytecode left out. SIGXFSZ is ignored, as Python does."""
    sys.dont_write_bytecode = True
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def memory_limit(size: int, report: str = "") -> None:
    """Limit the data (heap and private maps) of the process to `size` bytes.

    `report` is a file into which the peak of the resident set is written, in KiB.
    """
    resource.setrlimit(resource.RLIMIT_DATA, (size, size))
    if report:
        leave = sys.exit

        def end(code: Any = None) -> None:
            Path(report).write_text(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
            leave(code)

        sys.exit = end  # type: ignore[assignment]


def user(number: int) -> None:
    """Become another user, for whom permissions hold."""
    os.setgid(number)
    os.setuid(number)


def _at_progress(stage: str, done: int, act: Callable[[], None]) -> None:
    """Call `act` once, when a stage first reports at least `done` parts."""
    from fhash_cli.output import Progress

    listen, acts = Progress.__call__, [act]

    def listening(self: Progress, now: str, count: int, *rest: Any) -> None:
        listen(self, now, count, *rest)
        if now == stage and count >= done and acts:
            acts.pop()()

    Progress.__call__ = listening  # type: ignore[method-assign]


def signal_at(stage: str, done: int, number: int) -> None:
    """Send a signal to this process when a stage reports at least `done` parts."""
    _at_progress(stage, done, lambda: signal.raise_signal(number))


def no_memory_at(stage: str, done: int) -> None:
    """Raise MemoryError when a stage reports at least `done` parts."""

    def act() -> None:
        raise MemoryError

    _at_progress(stage, done, act)


def no_memory_in(module: str, name: str) -> None:
    """Raise MemoryError in a function of a module, or in a method "Class.name"."""
    import importlib

    owner: Any = importlib.import_module(module)
    *path, last = name.split(".")
    for attribute in path:
        owner = getattr(owner, attribute)

    def act(*_: Any, **__: Any) -> Any:
        raise MemoryError

    setattr(owner, last, act)


def note_stages(path: str) -> None:
    """Write a line "stage done" for each report of progress."""
    from fhash_cli.output import Progress

    listen = Progress.__call__

    def listening(self: Progress, stage: str, done: int, *rest: Any) -> None:
        listen(self, stage, done, *rest)
        with open(path, "a", encoding="utf-8") as file:
            print(stage, done, file=file)

    Progress.__call__ = listening  # type: ignore[method-assign]


def eager_checkpoints() -> None:
    """Let a training save its checkpoint as often as it can."""
    import functools

    from fhash_codec.paper import fit

    fit.Breaks = functools.partial(fit.Breaks, save_seconds=0.0)  # type: ignore


def change_at(stage: str, done: int, path: str, how: str) -> None:
    """Change a source when a stage reports `done` parts.

    `how` is 'touch', 'shrink', 'vanish', 'grow', or the path of a file or folder that replaces it.
    """
    _at_progress(stage, done, lambda: change(path, how))


def change(path: str, how: str) -> None:
    """Change a file or folder as `change_at` says."""
    target = Path(path)
    if how == "vanish":
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    elif how == "shrink":
        os.truncate(target, target.stat().st_size // 2)
    elif how == "grow":
        with target.open("ab") as file:
            file.write(b"0" * 1000)
    elif how == "touch":
        os.utime(target)
    else:
        source = Path(how)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        else:
            target.write_bytes(source.read_bytes())
