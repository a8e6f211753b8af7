"""Clocks that advance whenever they are read, and small measurements of the machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from types import SimpleNamespace

import pytest

from fhash_codec.bench.train import bench, clock, peak, points


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> Callable[[Iterator[float]], None]:
    """A function that makes both clocks read times from an iterator."""

    def tick(times: Iterator[float]) -> None:
        read = lambda: next(times)  # noqa: E731
        monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=read, process_time=read))

    return tick


@pytest.fixture
def quick(ticking: Callable[[Iterator[float]], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that advances by a millisecond whenever it is read, and little work."""
    ticking(tick / 1000 for tick in count())
    monkeypatch.setattr(bench, "INFER_SECONDS", 0.003)
    monkeypatch.setattr(peak, "FMA_ROUNDS", 100)
    monkeypatch.setattr(peak, "COPY_BYTES", 1 << 12)
    monkeypatch.setattr(points, "POINTS", 1 << 9)
