"""Clocks that advance whenever they are read, and the command line with a tiny series."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
# pytest's importlib mode puts no folder of tests on the path.
HERE = Path(__file__).resolve().parent
TESTS = HERE.parents[1] / "tests"
PATHS = (TESTS / "helpers", TESTS / "codec", HERE / "paper", HERE / "pictures")
sys.path[:0] = map(str, PATHS)

from command_line import data, fhash, refused, run  # noqa: F401


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> Callable[[Iterator[float]], None]:
    """A function that makes both clocks read times from an iterator."""

    from fhash_bench import engines

    def tick(times: Iterator[float]) -> None:
        read = lambda: next(times)  # noqa: E731
        monkeypatch.setattr(engines, "time", SimpleNamespace(perf_counter=read, process_time=read))

    return tick


@pytest.fixture
def quick(ticking: Callable[[Iterator[float]], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that advances by a millisecond whenever it is read, and little work."""
    from fhash_bench import engines, train

    ticking(tick / 1000 for tick in count())
    monkeypatch.setattr(train, "INFER_SECONDS", 0.003)
    monkeypatch.setattr(engines, "FMA_ROUNDS", 100)
    monkeypatch.setattr(engines, "COPY_BYTES", 1 << 12)
    monkeypatch.setattr(train, "POINTS", 1 << 9)
