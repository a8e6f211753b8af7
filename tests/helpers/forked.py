"""Forked processes, as `multiprocessing` and torch's loaders of data make them on Linux."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable

import pytest

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")


def forked(work: Callable[[], bool]) -> int:
    """Begin `work` in a forked process, which is killed after a minute; its number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # this process has several threads
        process = os.fork()
    if process == 0:
        code = 1
        try:
            signal.alarm(60)
            code = 0 if work() else 2
        finally:
            os._exit(code)
    return process


def ended_well(process: int) -> bool:
    """Wait for a process of `forked`; whether its work said yes."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0
