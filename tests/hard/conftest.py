"""Fixtures of the hard tests, which import modules beside them.

pytest's importlib mode puts no folder of tests on the path, so this file does.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from faulty import Bench, Server, build_faults


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A process that has imported everything and runs command lines in forks of itself."""
    folder = tmp_path_factory.mktemp("logs")
    server = Server(folder, build_faults(folder))
    yield server
    server.close()


@pytest.fixture(scope="session")
def _bench(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    if server.faults is None:
        pytest.skip("needs Linux and a C compiler")
    return Bench(server, tmp_path_factory.mktemp("bench"))


@pytest.fixture
def bench(_bench: Bench) -> Bench:
    """Commands whose file operations can be counted and made to fail, and an empty folder for
    outputs."""
    _bench.empty()
    return _bench
