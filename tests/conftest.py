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
QUICK_HARD_FILES = ("test_names.py", "test_summary.py")
"""Files of the room `hard` that take no time."""
LONG_ROOMS = (
    "benchmarks/tests/pictures/",
    "benchmarks/tests/rate/",
    "benchmarks/tests/test_ablate.py",
    "benchmarks/tests/test_train.py",
    "tests/codec/cost/test_cost.py",
    "tests/codec/cost/test_report.py",
    "tests/codec/paper/engines/fused/",
)
"""Rooms of measuring tools, and of kernels that are emulated, which the long set alone runs. Not
that of the published figures: what they are wrong in is read by others."""
QUICK_CASES = 2
"""Cases of a parametrised test that the quick set runs."""
WHOLE_ROOMS = ("documents", "tests")
"""Folders whose cases all run: each is another page that somebody reads, or another law."""
SLOW_FILES = ("test_pictures.py", "test_coder.py", "test_train.py")
"""Names of files that take a good part of a minute."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Puts slow files first, and keeps the order of all others; see `_keep_some_cases`."""

    def rank(item: pytest.Item) -> int:
        room = item.path.relative_to(HERE.parent).parts[1]
        if room in SLOW_ROOMS:
            return SLOW_ROOMS.index(room)
        return len(SLOW_ROOMS) + (item.path.name not in SLOW_FILES)

    items.sort(key=rank)
    if os.environ.get("FHASH_HARD") != "1":
        _keep_some_cases(config, items)


def _keep_some_cases(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselects the long set, and most cases of a test with many: the quick set has the first
    and the last. `make hard` and `make every` run the others."""
    items_before = list(items)
    items[:] = [item for item in items if not _is_long(item)]
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    kept = set()
    for same in cases.values():
        last = len(same) - 1
        whole = same[0].path.parent.name in WHOLE_ROOMS
        if last < QUICK_CASES or whole:
            kept |= {item.nodeid for item in same}
        else:
            kept |= {same[n * last // (QUICK_CASES - 1)].nodeid for n in range(QUICK_CASES)}
    items[:] = [item for item in items if item.nodeid in kept]
    config.hook.pytest_deselected(items=[item for item in items_before if item.nodeid not in kept])


def _is_long(item: pytest.Item) -> bool:
    """Whether a test belongs to the long set: faults, hostile files, sanitizers, LONG_ROOMS."""
    place = item.path.relative_to(HERE.parent).as_posix()
    if place.startswith(LONG_ROOMS):
        return True
    if not place.startswith("tests/hard/"):
        return False
    compiles = item.path.name == "test_fuzz.py" and "folder" in getattr(item, "fixturenames", ())
    return compiles or item.path.name not in ("test_fuzz.py", *QUICK_HARD_FILES)


@pytest.fixture
def range_server() -> Iterator[RangeServer]:
    """A local HTTP server that counts what is asked of it."""
    from range_server import RangeServer

    with RangeServer() as server:
        yield server
