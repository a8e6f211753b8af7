"""Cases of times: uneven, tiny, huge, descending and repeated times, and requests outside the
series."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Finding, Run
from fhash_codec.selftest.cases.fields import SHAPE, series, waves
from fhash_codec.selftest.cases.settings import COMPACT, MORE, PAPER, Settings
from fhash_formats.errors import FhashError, RegionError
from fhash_formats.series import ArraySeries

__all__ = ["TIME_CASES"]

STEPS = 6
"""Steps of the series."""
SETTINGS: Settings = {
    "bound": COMPACT["bound"],
    **PAPER,
    "paper-keys": EncodeConfig(profile="paper", width=8, epochs=5, key_frames="0,2,5"),
}
ENDS: Settings = {
    **SETTINGS,
    "paper-ends": EncodeConfig(profile="paper", width=8, epochs=5, key_frames="0,5"),
}
EVEN = np.arange(float(STEPS))


def _time_case(
    name: str, about: str, times: npt.NDArray[np.float64], settings: Settings = SETTINGS
) -> Case:
    def make() -> ArraySeries:
        return series(waves((len(times), *SHAPE[1:])).astype(np.float32), times=times)

    return Case(
        name=name,
        group="times",
        about=about,
        make=make,
        settings=settings,
        more=MORE,
        checks=(_outside,),
    )


def _outside(run: Run) -> Iterator[Finding]:
    """Steps and times before and after the series are refused by every call that takes them."""
    volume, times = run.volume, run.series.coords["t"].values
    last = volume.shape[0] - 1
    low, high = sorted((float(times[0]), float(times[-1])))
    calls: list[Callable[[], Any]] = [
        partial(volume.read, step) for step in (-1, -1e-9, last + 1e-6, last + 1, np.inf, np.nan)
    ]
    if np.array_equal(volume.key_times.times, times):
        for time in (
            float(np.nextafter(low, -np.inf)),
            float(np.nextafter(high, np.inf)),
            -np.inf,
            np.inf,
            np.nan,
        ):
            calls += [
                partial(volume.step_of_time, time),
                partial(volume.sample, time=time, z=1, y=1, x=1),
            ]
    wrong = 0
    for call in calls:
        try:
            call()
        except RegionError:
            continue
        except FhashError:
            pass
        wrong += 1
    yield Finding(name="outside is refused", worst=float(wrong), limit=0.0, unit="answers")


TIME_CASES: tuple[Case, ...] = (
    _time_case("uneven", "steps from 1e-3 to 1e3 long", np.cumsum([0, 1e-3, 1, 1e3, 0.5, 30])),
    _time_case("tiny", "steps of 1e-12", 1e-12 * EVEN),
    _time_case("denormal", "steps of the smallest number", 5e-324 * EVEN),
    _time_case("huge", "times from 3.5e5 hours on", 3.5e5 + EVEN),
    _time_case(
        "huge-and-fine",
        "times that are consecutive float64 numbers",
        np.array([3.5e5 + 2.0**-34 * n for n in range(STEPS)]),
    ),
    _time_case("descending", "times that run backwards", 10 - EVEN**2),
    _time_case("negative", "times before the epoch", -1e9 + 3600 * EVEN),
    _time_case(
        "both-ends", "times from -1.7e308 to 1.7e308", 1.7e308 * np.linspace(-1, 1, STEPS), ENDS
    ),
    _time_case(
        "repeated",
        "a repeated time: step numbers replace the times",
        np.array([0.0, 1, 1, 2, 3, 4]),
    ),
    _time_case(
        "not-a-time",
        "times that are NaN or infinite: step numbers replace them",
        np.array([0.0, 1, np.nan, np.inf, 4, 5]),
    ),
    _time_case(
        "one-time",
        "a single step at a time that is not 0",
        np.array([1e5])[:1],
        {"bound": COMPACT["bound"], **PAPER},
    ),
)
