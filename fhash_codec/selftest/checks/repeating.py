"""Properties of repetition: the same bytes again and with any number of threads."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fhash_codec.encoding import encode
from fhash_codec.selftest.case import Finding, Run
from fhash_codec.selftest.environment import environment

__all__ = ["REPEATING_CHECKS"]

THREADS = (1, 2)
"""Numbers of threads to compare with `case.RUN_THREADS`, with which the file of a run was made."""


def same_bytes(run: Run) -> Iterator[Finding]:
    """The same input gives the same bytes; in profile compact with any number of threads, too.

    The long set compares all of `THREADS`, the quick set one of them in turn.
    """
    written = run.path.read_bytes()
    again = run.folder / "again.fhz"
    if run.config.profile == "paper":
        encode(run.series, again, run.config, force=True)
        yield Finding(
            name="same bytes again",
            worst=_count_unequal_bytes(written, again),
            limit=0.0,
            unit="bytes",
        )
        return
    wrong = 0.0
    turn = zlib.crc32(f"{run.case.name} {run.under}".encode()) % len(THREADS)
    for count in THREADS if run.thorough else THREADS[turn : turn + 1]:
        with environment(FHASH_THREADS=str(count)):
            encode(run.series, again, run.config, force=True)
        wrong = max(wrong, _count_unequal_bytes(written, again))
    yield Finding(name="same bytes by other threads", worst=wrong, limit=0.0, unit="bytes")


def sound(run: Run) -> Iterator[Finding]:
    """The file passes `verify`, which raises for a damaged file."""
    yield Finding(
        name="verify",
        worst=0.0 if run.volume.verify() > 0 else 1.0,
        limit=0.0,
        unit="damaged parts",
    )


REPEATING_CHECKS = (same_bytes, sound)


def _count_unequal_bytes(written: bytes, path: Path) -> float:
    """The number of bytes that differ."""
    other = path.read_bytes()
    first, second = (
        np.frombuffer(data[: min(len(written), len(other))], dtype=np.uint8)
        for data in (written, other)
    )
    return float(np.count_nonzero(first != second) + abs(len(written) - len(other)))
