"""Times are as the names of their cases say, and the check of requests outside them can fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.cases import times

CASES = {case.name: case for case in times.CASES}


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("uneven", lambda times: np.diff(times).max() >= 1e5 * np.diff(times).min() > 0),
        ("tiny", lambda times: (np.diff(times) < 2e-12).all()),
        ("denormal", lambda times: (np.diff(times) == 5e-324).all()),
        ("huge-and-fine", lambda times: (np.nextafter(times[:-1], np.inf) == times[1:]).all()),
        ("descending", lambda times: (np.diff(times) < 0).all()),
        ("negative", lambda times: (times < 0).all()),
        ("both-ends", lambda times: not np.isfinite(times[-1] * 2 - times[0] * 2)),
        ("repeated", lambda times: (np.diff(times) == 0).sum() == 1),
        ("not-a-time", lambda times: (~np.isfinite(times)).sum() == 2),
        ("one-time", lambda times: times.tolist() == [1e5]),
    ],
)
def test_times_are_as_their_name_says(name: str, holds: Callable[[np.ndarray], bool]) -> None:
    with np.errstate(over="ignore"):
        assert holds(CASES[name].make().coords["t"].values)


def test_answers_outside_the_series_are_counted(
    compact_run: Run, broken: Callable[[Run, Check], set[str]]
) -> None:
    (outside,) = CASES["tiny"].checks
    assert broken(compact_run, outside) == set()
    volume = compact_run.volume
    clamped = SimpleNamespace(
        shape=volume.shape,
        key_times=volume.key_times,
        read=lambda step: volume.read(0),
        step_of_time=volume.step_of_time,
        sample=volume.sample,
    )
    assert broken(replace(compact_run, volume=clamped), outside) == {"outside is refused"}
