"""Speed and access in `fhash bench rate`: the same runs and places for every codec."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import median

import numpy as np

from fhash_codec.bench.rate.clock import Spent
from fhash_codec.bench.rate.results import Access, Speed
from fhash_codec.bench.rate.search import EXACT, Trial
from fhash_codec.boxes import Box

__all__ = [
    "LONG_SECONDS",
    "PLACES",
    "RUNS",
    "Read",
    "access_of",
    "places",
    "shown_psnr",
    "speed_of",
]

RUNS = 3
"""Runs of which the best counts."""
LONG_SECONDS = 20.0
"""Seconds of encoding after which there is no further run."""
PLACES = 8
"""Random places at which access is measured."""
REGION = 16
"""Vertices of a region along each axis."""

Read = Callable[[int, Box], tuple[int, float]]
"""A function of a step and a region: bytes read, and seconds."""


def shown_psnr(trial: Trial) -> float | None:
    """PSNR in dB, None where nothing differs."""
    return None if trial.psnr == EXACT else trial.psnr


def speed_of(
    codec: str,
    setting: str,
    trial: Trial,
    raw_bytes: int,
    encoding: Sequence[Spent],
    decoding: Sequence[Spent],
) -> Speed:
    """The speed of the fastest runs, on the wall and by the processor each."""
    megabytes = raw_bytes / 1e6
    return Speed(
        codec=codec,
        setting=setting,
        psnr=shown_psnr(trial),
        encode_mb_s=megabytes / min(run.wall for run in encoding),
        decode_mb_s=megabytes / min(run.wall for run in decoding),
        encode_core_mb_s=megabytes / min(run.core for run in encoding),
        decode_core_mb_s=megabytes / min(run.core for run in decoding),
        encode_runs=len(encoding),
    )


def places(shape: Sequence[int], count: int = PLACES) -> Iterator[tuple[int, Box]]:
    """Yield steps and regions of a series (t, z, y, x): one to warm up, and `count` others."""
    rng = np.random.default_rng(0)
    steps, *space = shape
    size = [min(REGION, n) for n in space]
    for _ in range(count + 1):
        low = [int(rng.integers(0, n - length + 1)) for n, length in zip(space, size, strict=True)]
        step = int(rng.integers(0, steps))
        yield step, Box.of_shape(size).shift(low)


def access_of(
    codec: str, setting: str, trial: Trial, shape: Sequence[int], read: Read, count: int = PLACES
) -> Access:
    """Access to regions at the same places for every codec: medians over them.

    shape: of the series (t, z, y, x). count: of the places.
    """
    measured = [read(step, box) for step, box in places(shape, count)][1:]
    z, y, x = (min(REGION, n) for n in shape[1:])
    return Access(
        codec=codec,
        setting=setting,
        region=(z, y, x),
        bytes=trial.bytes,
        psnr=shown_psnr(trial),
        milliseconds=1000 * median(seconds for _, seconds in measured),
        bytes_read=round(median(touched for touched, _ in measured)),
    )
