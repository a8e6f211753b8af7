"""Lets the tests of this folder import the modules beside them: pytest's importlib mode puts no folder of tests on the path."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from faulty import Bench
from forks import Server, build_faults


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Runs command lines in forks of a process that has imported everything."""
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
    """Commands whose operations on files can be counted and made to fail, and an empty folder for their outputs."""
    _bench.empty()
    return _bench
