"""Settings of the process that all tests share."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

if TYPE_CHECKING:
    from range_server import RangeServer

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "helpers"), str(HERE)]  # helpers, and the package `reference`

# The tests' models are tiny: a second thread costs more than it brings, above all where several
# test runs share a machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A loaded machine is no failure.
hypothesis.settings.register_profile(
    "no clock", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("no clock")

# A shell starts a background job with Ctrl-C ignored, and nohup starts one with SIGHUP ignored;
# some tests send both signals.
for _name, _usual in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    _number = getattr(signal, _name, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)

SLOW_ROOMS = ("documents", "fresh", "hard", "golden")
"""Rooms of `tests` whose files take minutes: they run first, so that no process ends alone."""
SLOW_FILES = ("test_pictures.py", "test_coder.py", "test_train.py")
"""Names of files that take a good part of a minute."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts slow files first, and keeps the order of all others."""

    def rank(item: pytest.Item) -> int:
        room = item.path.relative_to(HERE.parent).parts[1]
        if room in SLOW_ROOMS:
            return SLOW_ROOMS.index(room)
        return len(SLOW_ROOMS) + (item.path.name not in SLOW_FILES)

    items.sort(key=rank)


@pytest.fixture
def range_server() -> Iterator[RangeServer]:
    """A local HTTP server that counts what is asked of it."""
    from range_server import RangeServer

    with RangeServer() as server:
        yield server
