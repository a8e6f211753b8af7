"""Properties of repetition: the same bytes again and with any number of threads, and the same
values from the native and the portable decoder."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fhash_codec.encoding import encode
from fhash_codec.selftest.case import Finding, Run, as_floats
from fhash_codec.selftest.checks.access import rounding
from fhash_codec.selftest.environment import environment
from fhash_codec.volume import open as open_volume
from fhash_formats import native

__all__ = ["CHECKS"]

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


def portable_encoder(run: Run) -> Iterator[Finding]:
    """A compact file of effort 1 has the same bytes without the native library. In the long set
    only.

    With more effort, the portable encoder takes too long.
    """
    if (
        native.library() is None
        or not run.thorough
        or run.config.profile != "compact"
        or run.config.effort > 1
    ):
        return
    again = run.folder / "portable.fhz"
    with environment(FHASH_NATIVE="0"):
        encode(run.series, again, run.config)
    yield Finding(
        name="same bytes, portable encoder",
        worst=_count_unequal_bytes(run.path.read_bytes(), again),
        limit=0.0,
        unit="bytes",
    )


def portable(run: Run) -> Iterator[Finding]:
    """The portable decoder gives the values of the native one."""
    if native.library() is None:
        return
    with environment(FHASH_NATIVE="0"), open_volume(run.path) as volume:
        other = as_floats(volume)
    if run.volume.profile == "compact":
        kind = f"u{other.dtype.itemsize}"
        wrong = int(np.count_nonzero(other.view(kind) != run.decoded.view(kind)))
        yield Finding(name="portable = native", worst=float(wrong), limit=0.0, unit="values")
        return
    lost = float(np.count_nonzero(np.isnan(other) != np.isnan(run.decoded)))
    yield Finding(name="portable: finite as native", worst=lost, limit=0.0, unit="values")
    yield Finding(
        name="portable = native",
        worst=rounding(run, other, run.decoded),
        limit=1.0,
        unit="of 1e-5 of the range",
    )


def sound(run: Run) -> Iterator[Finding]:
    """The file passes `verify`, which raises for a damaged file."""
    yield Finding(
        name="verify",
        worst=0.0 if run.volume.verify() > 0 else 1.0,
        limit=0.0,
        unit="damaged parts",
    )


CHECKS = (same_bytes, portable_encoder, portable, sound)


def _count_unequal_bytes(written: bytes, path: Path) -> float:
    """The number of bytes that differ."""
    other = path.read_bytes()
    first, second = (
        np.frombuffer(data[: min(len(written), len(other))], dtype=np.uint8)
        for data in (written, other)
    )
    return float(np.count_nonzero(first != second) + abs(len(written) - len(other)))
