"""Times of work: on the wall and by the processor."""

from __future__ import annotations

import subprocess
import sys

from fhash_codec.bench.rate.clock import spent, user_seconds


def test_both_times_are_above_0() -> None:
    done = []
    times = spent(lambda: done.append(1))
    assert done == [1]
    assert times.wall > 0
    assert times.core > 0


def test_programs_count() -> None:
    before = user_seconds()
    times = spent(lambda: subprocess.run([sys.executable, "-c", "sum(range(3000000))"], check=True))
    assert times.core > 0.005
    assert user_seconds() - before >= times.core * 0.99
