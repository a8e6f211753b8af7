"""Records of the self-test: a hard case, a run of it under one of its settings, and a finding."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.volume import Volume
from fhash_formats.series import Series

RUN_THREADS = 4
"""Threads with which every case is encoded. A check repeats the encoding with other numbers of
threads."""


@dataclass(frozen=True)
class Finding:
    """A property of a case, measured. It holds if `worst` is at most `limit`; NaN does not hold."""

    name: Annotated[str, "name of the property"]
    worst: Annotated[float, float | str, "the largest figure; a text where it is not finite"]
    limit: Annotated[float, float | str, "the largest figure that is allowed"]
    unit: Annotated[str, "unit of both"]
    under: Annotated[str, "the settings or engine that gave the figure"] = ""

    def __post_init__(self) -> None:
        """Make a count a figure."""
        object.__setattr__(self, "worst", float(self.worst))

    @property
    def holds(self) -> bool:
        """Whether the figure is within its limit."""
        return bool(self.worst <= self.limit)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A case that was encoded with one of its settings.

    Attributes:
        case: the case.
        series: the source.
        values: values of the source (t, z, y, x), in the source's dtype.
        under: name of the settings.
        config: the settings.
        folder: a temporary folder in which checks may write files.
        path: the container.
        volume: the container, opened.
        thorough: whether the run belongs to the long set, where a check may take more time.
    """

    case: Case
    series: Series
    values: npt.NDArray[np.generic]
    under: str
    config: EncodeConfig
    folder: Path
    path: Path
    volume: Volume
    thorough: bool = False

    @cached_property
    def decoded(self) -> npt.NDArray[Any]:
        """All decoded values (t, z, y, x) as floats, NaN outside the coreset."""
        return as_floats(self.volume)

    @property
    def data_range(self) -> float:
        """Range of the finite values in data units, as the codec computes it; infinite if it
        overflows."""
        return self.volume.value_range.high - self.volume.value_range.low


def as_floats(volume: Volume) -> npt.NDArray[Any]:
    """All values (t, z, y, x) of a volume as floats, NaN where there is none."""
    return np.stack([volume.read(step) for step in range(volume.shape[0])])


Check = Callable[[Run], Iterable[Finding]]


@dataclass(frozen=True, eq=False)
class Case:
    """One hard case.

    Attributes:
        group: one of values, shapes, fronts, features, times, networks, rays.
        name: short and unique, in lower case with hyphens.
        about: one line that says what is hard and what must hold.
        make: returns the series, which is small (some 10,000 values) and the same on every call.
            The series may have no finite value.
        settings: settings by name; the case is encoded and checked with each of them.
        more: additional settings of the long set.
        checks: checks of this case, in addition to the checks of every run.
        quick: whether the case belongs to the quick set, which takes less than three minutes in
            total.
        refused: a part of the message, if encoding must raise InputError or QualityError; else
            None.
    """

    group: str
    name: str
    about: str
    make: Callable[[], Series]
    settings: Mapping[str, EncodeConfig]
    more: Mapping[str, EncodeConfig] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()
    quick: bool = True
    refused: str | None = None


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Sets environment variables of this process, such as FHASH_THREADS, within a `with`
    block.

    Not for several threads at once: the environment belongs to the process.
    """
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
